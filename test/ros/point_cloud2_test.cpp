#include "dendro_slam/ros/point_cloud2.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <limits>

#include "dendro_slam/ros/conversions.h"

namespace dendro_ros {
namespace {

using sensor_msgs::PointCloud2;
using sensor_msgs::PointField;

constexpr std::uint32_t kStampS = 1700000000;

/// A cloud built field by field.
class CloudBuilder {
 public:
  CloudBuilder& Field(const std::string& name, std::uint8_t datatype, std::uint32_t size) {
    PointField field;
    field.name = name;
    field.datatype = datatype;
    field.offset = cloud_.point_step;
    field.count = 1;
    cloud_.fields.push_back(field);
    cloud_.point_step += size;
    return *this;
  }
  CloudBuilder& Xyz() {
    return Field("x", PointField::FLOAT32, 4)
        .Field("y", PointField::FLOAT32, 4)
        .Field("z", PointField::FLOAT32, 4);
  }
  PointCloud2 Make(std::uint32_t width, std::uint32_t height, std::uint32_t padding = 0) {
    cloud_.header.stamp = ros::Time(kStampS, 0);
    cloud_.width = width;
    cloud_.height = height;
    cloud_.row_step = width * cloud_.point_step + padding;
    cloud_.data.assign(std::size_t{cloud_.row_step} * height, 0);
    return cloud_;
  }

 private:
  PointCloud2 cloud_;
};

template <class T>
void Put(PointCloud2& cloud, std::size_t point, std::size_t field, T value) {
  const std::size_t row = point / cloud.width;
  const std::size_t col = point % cloud.width;
  std::memcpy(&cloud.data[row * cloud.row_step + col * cloud.point_step + cloud.fields[field].offset],
              &value,
              sizeof(T));
}

std::string ErrorOf(const PointCloud2& cloud) {
  try {
    ReadPointCloud2(cloud, "/velodyne_points");
  } catch (const PointCloud2Error& error) {
    return error.what();
  }
  return "";
}

TEST(ReadPointCloud2, VelodyneLayoutRoundTrips) {
  dendro::LidarScan scan;
  scan.stamp_ns = 1234567890123;
  for (int i = 0; i < 5; ++i) {
    dendro::LidarPoint point;
    point.position = {1.0F * i, 2.0F, -3.0F};
    point.intensity = 10.0F * i;
    point.time_s = 0.001F * i;
    point.ring = static_cast<std::uint16_t>(i);
    scan.points.push_back(point);
  }
  const auto cloud = ToVelodyneCloud(scan, "velodyne");
  EXPECT_EQ(cloud->point_step, 22U);
  EXPECT_EQ(cloud->height, 1U);
  const dendro::LidarScan read = ReadPointCloud2(*cloud, "t");
  EXPECT_EQ(read.stamp_ns, scan.stamp_ns);
  EXPECT_TRUE(read.has_ring);
  EXPECT_TRUE(read.has_time);
  ASSERT_EQ(read.points.size(), 5U);
  EXPECT_EQ(read.points[4].position, scan.points[4].position);
  EXPECT_EQ(read.points[4].intensity, 40.0F);
  EXPECT_EQ(read.points[4].time_s, 0.004F);
  EXPECT_EQ(read.points[4].ring, 4);
}

TEST(ReadPointCloud2, OrganisedWidth16WithPaddedRows) {
  PointCloud2 cloud = CloudBuilder().Xyz().Make(16, 3, 5);
  Put(cloud, 2 * 16 + 7, 0, 4.5F);
  const dendro::LidarScan scan = ReadPointCloud2(cloud, "t");
  ASSERT_EQ(scan.points.size(), 48U);
  EXPECT_EQ(scan.points[2 * 16 + 7].position.x(), 4.5F);
  EXPECT_FALSE(scan.has_ring);
  EXPECT_FALSE(scan.has_time);
  EXPECT_EQ(scan.points[0].intensity, 0.0F);
}

TEST(ReadPointCloud2, TimeInEveryForm) {
  PointCloud2 nanoseconds = CloudBuilder().Xyz().Field("t", PointField::UINT32, 4).Make(1, 1);
  Put(nanoseconds, 0, 3, std::uint32_t{50000000});
  EXPECT_FLOAT_EQ(ReadPointCloud2(nanoseconds, "t").points[0].time_s, 0.05F);

  PointCloud2 absolute = CloudBuilder().Xyz().Field("timestamp", PointField::FLOAT64, 8).Make(1, 1);
  Put(absolute, 0, 3, kStampS + 0.075);
  EXPECT_NEAR(ReadPointCloud2(absolute, "t").points[0].time_s, 0.075F, 1e-6);

  PointCloud2 relative = CloudBuilder().Xyz().Field("time", PointField::FLOAT64, 8).Make(1, 1);
  Put(relative, 0, 3, -0.02);
  EXPECT_FLOAT_EQ(ReadPointCloud2(relative, "t").points[0].time_s, -0.02F);
}

TEST(ReadPointCloud2, DoubleCoordinatesAndSmallRings) {
  PointCloud2 cloud = CloudBuilder()
                          .Field("x", PointField::FLOAT64, 8)
                          .Field("y", PointField::FLOAT64, 8)
                          .Field("z", PointField::FLOAT64, 8)
                          .Field("ring", PointField::UINT8, 1)
                          .Field("intensity", PointField::UINT8, 1)
                          .Make(1, 1);
  Put(cloud, 0, 0, 1.25);
  Put(cloud, 0, 3, std::uint8_t{9});
  Put(cloud, 0, 4, std::uint8_t{200});
  const dendro::LidarScan scan = ReadPointCloud2(cloud, "t");
  EXPECT_EQ(scan.points[0].position.x(), 1.25F);
  EXPECT_EQ(scan.points[0].ring, 9);
  EXPECT_EQ(scan.points[0].intensity, 200.0F);
}

TEST(ReadPointCloud2, KeepsNanPointsAndTheirOrder) {
  PointCloud2 cloud = CloudBuilder().Xyz().Make(3, 1);
  Put(cloud, 1, 0, std::numeric_limits<float>::quiet_NaN());
  const dendro::LidarScan scan = ReadPointCloud2(cloud, "t");
  ASSERT_EQ(scan.points.size(), 3U);
  EXPECT_TRUE(std::isnan(scan.points[1].position.x()));
  EXPECT_EQ(scan.points[2].position.x(), 0.0F);
}

TEST(ReadPointCloud2, EmptyCloudIsAnEmptyScan) {
  EXPECT_TRUE(ReadPointCloud2(CloudBuilder().Xyz().Make(0, 1), "t").points.empty());
  EXPECT_TRUE(ReadPointCloud2(PointCloud2(), "t").points.empty());
}

TEST(ReadPointCloud2, ErrorsNameTopicAndField) {
  const std::string missing = ErrorOf(CloudBuilder().Field("a", PointField::FLOAT32, 4).Make(1, 1));
  EXPECT_NE(missing.find("/velodyne_points"), std::string::npos) << missing;
  EXPECT_NE(missing.find("'x'"), std::string::npos) << missing;
  EXPECT_NE(missing.find("found: a"), std::string::npos) << missing;

  PointCloud2 shortened = CloudBuilder().Xyz().Make(4, 1);
  shortened.data.resize(20);
  EXPECT_NE(ErrorOf(shortened).find("20 bytes"), std::string::npos) << ErrorOf(shortened);

  PointCloud2 narrow_rows = CloudBuilder().Xyz().Make(4, 1);
  narrow_rows.row_step = 12;
  EXPECT_NE(ErrorOf(narrow_rows).find("row_step 12"), std::string::npos);

  PointCloud2 outside = CloudBuilder().Xyz().Make(1, 1);
  outside.fields[2].offset = 9;
  EXPECT_NE(ErrorOf(outside).find("'z'"), std::string::npos);

  PointCloud2 huge_offset = CloudBuilder().Xyz().Make(1, 1);
  huge_offset.fields[2].offset = std::numeric_limits<std::uint32_t>::max();
  EXPECT_NE(ErrorOf(huge_offset).find("'z'"), std::string::npos);

  PointCloud2 integers = CloudBuilder().Xyz().Make(1, 1);
  integers.fields[0].datatype = PointField::INT32;
  EXPECT_NE(ErrorOf(integers).find("float32"), std::string::npos);

  PointCloud2 unknown = CloudBuilder().Xyz().Make(1, 1);
  unknown.fields[0].datatype = 99;
  EXPECT_NE(ErrorOf(unknown).find("datatype 99"), std::string::npos);

  PointCloud2 big_endian = CloudBuilder().Xyz().Make(1, 1);
  big_endian.is_bigendian = 1;
  EXPECT_NE(ErrorOf(big_endian).find("big-endian"), std::string::npos);

  PointCloud2 overflow = CloudBuilder().Xyz().Make(1, 1);
  overflow.width = overflow.height = std::numeric_limits<std::uint32_t>::max();
  EXPECT_NE(ErrorOf(overflow), "");

  PointCloud2 bad_ring = CloudBuilder().Xyz().Field("ring", PointField::INT16, 2).Make(1, 1);
  Put(bad_ring, 0, 3, std::int16_t{-3});
  EXPECT_NE(ErrorOf(bad_ring).find("'ring'"), std::string::npos);
}

}  // namespace
}  // namespace dendro_ros
