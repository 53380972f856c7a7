#include "dendro_slam/ros/point_cloud2.h"

#include <boost/make_shared.hpp>
#include <fmt/format.h>

#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <optional>

#include "dendro_slam/ros/conversions.h"

namespace dendro_ros {
namespace {

using sensor_msgs::PointField;

std::size_t SizeOf(std::uint8_t datatype) {
  switch (datatype) {
    case PointField::INT8:
    case PointField::UINT8:
      return 1;
    case PointField::INT16:
    case PointField::UINT16:
      return 2;
    case PointField::INT32:
    case PointField::UINT32:
    case PointField::FLOAT32:
      return 4;
    case PointField::FLOAT64:
      return 8;
    default:
      return 0;
  }
}

bool IsFloating(std::uint8_t datatype) {
  return datatype == PointField::FLOAT32 || datatype == PointField::FLOAT64;
}

template <class T>
double Load(const std::uint8_t* data) {
  T value;
  std::memcpy(&value, data, sizeof(T));
  return static_cast<double>(value);
}

std::string FieldNames(const sensor_msgs::PointCloud2& cloud) {
  std::string names;
  for (const PointField& field : cloud.fields) names += (names.empty() ? "" : " ") + field.name;
  return names.empty() ? "none" : names;
}

const PointField* Find(const sensor_msgs::PointCloud2& cloud, const char* name) {
  for (const PointField& field : cloud.fields) {
    if (field.name == name) return &field;
  }
  return nullptr;
}

/// Seconds relative to the stamp, from whatever the driver writes.
float RelativeSeconds(double value, std::uint8_t datatype, std::int64_t stamp_ns) {
  constexpr double kAbsoluteSeconds = 1e6;
  if (IsFloating(datatype)) {
    if (std::abs(value) < kAbsoluteSeconds) return static_cast<float>(value);
    return static_cast<float>(value - dendro::NsToSeconds(stamp_ns));
  }
  return static_cast<float>(value * 1e-9);
}

}  // namespace

FieldReader::FieldReader(const sensor_msgs::PointCloud2& cloud,
                         const std::string& topic,
                         const char* name) {
  const PointField* field = Find(cloud, name);
  if (field == nullptr) {
    throw PointCloud2Error(fmt::format(
        "{}: the cloud has no field '{}' (found: {})", topic, name, FieldNames(cloud)));
  }
  const std::size_t size = SizeOf(field->datatype);
  if (size == 0) {
    throw PointCloud2Error(fmt::format(
        "{}: field '{}' has the unknown datatype {}", topic, name, int{field->datatype}));
  }
  if (std::size_t{field->offset} + size > cloud.point_step) {
    throw PointCloud2Error(fmt::format("{}: field '{}' at offset {} does not fit point_step {}",
                                       topic,
                                       name,
                                       field->offset,
                                       cloud.point_step));
  }
  offset_ = field->offset;
  datatype_ = field->datatype;
}

double FieldReader::Read(const std::uint8_t* point) const {
  const std::uint8_t* data = point + offset_;
  switch (datatype_) {
    case PointField::INT8:
      return Load<std::int8_t>(data);
    case PointField::UINT8:
      return Load<std::uint8_t>(data);
    case PointField::INT16:
      return Load<std::int16_t>(data);
    case PointField::UINT16:
      return Load<std::uint16_t>(data);
    case PointField::INT32:
      return Load<std::int32_t>(data);
    case PointField::UINT32:
      return Load<std::uint32_t>(data);
    case PointField::FLOAT32:
      return Load<float>(data);
    default:
      return Load<double>(data);
  }
}

void CheckLayout(const sensor_msgs::PointCloud2& cloud, const std::string& topic) {
  const std::size_t width = cloud.width;
  const std::size_t height = cloud.height;
  if (width * height == 0) return;
  if (cloud.is_bigendian) {
    throw PointCloud2Error(topic + ": the cloud is big-endian; publish it little-endian");
  }
  if (cloud.point_step == 0 || cloud.row_step < width * cloud.point_step) {
    throw PointCloud2Error(fmt::format("{}: row_step {} is less than width {} x point_step {}",
                                       topic,
                                       cloud.row_step,
                                       width,
                                       cloud.point_step));
  }
  if (cloud.data.size() < (height - 1) * cloud.row_step + width * cloud.point_step) {
    throw PointCloud2Error(fmt::format("{}: {} bytes of data are less than height {} x row_step {}",
                                       topic,
                                       cloud.data.size(),
                                       height,
                                       cloud.row_step));
  }
}

bool HasField(const sensor_msgs::PointCloud2& cloud, const char* name) {
  return Find(cloud, name) != nullptr;
}

dendro::LidarScan ReadPointCloud2(const sensor_msgs::PointCloud2& cloud, const std::string& topic) {
  CheckLayout(cloud, topic);
  dendro::LidarScan scan;
  scan.stamp_ns = ToNs(cloud.header.stamp);
  const char* time_name = nullptr;
  for (const char* name : {"time", "t", "timestamp", "offset_time"}) {
    if (time_name == nullptr && HasField(cloud, name)) time_name = name;
  }
  scan.has_ring = HasField(cloud, "ring");
  scan.has_time = time_name != nullptr;
  const std::size_t count = std::size_t{cloud.width} * cloud.height;
  if (count == 0) return scan;

  const std::array<FieldReader, 3> xyz = {FieldReader(cloud, topic, "x"),
                                          FieldReader(cloud, topic, "y"),
                                          FieldReader(cloud, topic, "z")};
  for (const FieldReader& reader : xyz) {
    if (!IsFloating(reader.datatype())) {
      throw PointCloud2Error(topic + ": fields x, y and z must be float32 or float64");
    }
  }
  std::optional<FieldReader> intensity;
  std::optional<FieldReader> ring;
  std::optional<FieldReader> time;
  if (HasField(cloud, "intensity")) intensity.emplace(cloud, topic, "intensity");
  if (scan.has_ring) ring.emplace(cloud, topic, "ring");
  if (scan.has_time) time.emplace(cloud, topic, time_name);

  scan.points.resize(count);
  std::size_t i = 0;
  for (std::size_t row = 0; row < cloud.height; ++row) {
    const std::uint8_t* data = cloud.data.data() + row * cloud.row_step;
    for (std::size_t col = 0; col < cloud.width; ++col, ++i, data += cloud.point_step) {
      dendro::LidarPoint& point = scan.points[i];
      for (std::size_t axis = 0; axis < 3; ++axis) {
        point.position[static_cast<Eigen::Index>(axis)] = static_cast<float>(xyz[axis].Read(data));
      }
      if (intensity) point.intensity = static_cast<float>(intensity->Read(data));
      if (time) point.time_s = RelativeSeconds(time->Read(data), time->datatype(), scan.stamp_ns);
      if (ring) {
        const double value = ring->Read(data);
        if (!(value >= 0.0 && value <= std::numeric_limits<std::uint16_t>::max())) {
          throw PointCloud2Error(
              fmt::format("{}: field 'ring' of point {} is {}, expected 0 to 15", topic, i, value));
        }
        point.ring = static_cast<std::uint16_t>(value);
      }
    }
  }
  return scan;
}

sensor_msgs::PointCloud2Ptr ToVelodyneCloud(const dendro::LidarScan& scan,
                                            const std::string& frame_id) {
  auto cloud = boost::make_shared<sensor_msgs::PointCloud2>();
  cloud->header.stamp = ToRosTime(scan.stamp_ns);
  cloud->header.frame_id = frame_id;
  cloud->height = 1;
  cloud->width = static_cast<std::uint32_t>(scan.points.size());
  const auto add = [&cloud](const char* name, std::uint32_t offset, std::uint8_t datatype) {
    PointField field;
    field.name = name;
    field.offset = offset;
    field.datatype = datatype;
    field.count = 1;
    cloud->fields.push_back(field);
  };
  add("x", 0, PointField::FLOAT32);
  add("y", 4, PointField::FLOAT32);
  add("z", 8, PointField::FLOAT32);
  add("intensity", 12, PointField::FLOAT32);
  add("ring", 16, PointField::UINT16);
  add("time", 18, PointField::FLOAT32);
  cloud->is_bigendian = false;
  cloud->point_step = 22;
  cloud->row_step = cloud->point_step * cloud->width;
  cloud->data.resize(cloud->row_step);
  cloud->is_dense = true;
  std::uint8_t* data = cloud->data.data();
  for (const dendro::LidarPoint& point : scan.points) {
    std::memcpy(data, point.position.data(), 12);
    std::memcpy(data + 12, &point.intensity, 4);
    std::memcpy(data + 16, &point.ring, 2);
    std::memcpy(data + 18, &point.time_s, 4);
    cloud->is_dense = cloud->is_dense && point.position.allFinite();
    data += cloud->point_step;
  }
  return cloud;
}

}  // namespace dendro_ros
