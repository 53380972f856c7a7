#include "dendro_slam/ros/map_session.h"

#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "dendro_slam/ros/conversions.h"

namespace dendro_ros {
namespace {

namespace fs = std::filesystem;

class MapSessionTest : public ::testing::Test {
 protected:
  void SetUp() override {
    folder_ = fs::temp_directory_path() / ("dendro_session_" + std::to_string(::getpid()));
    fs::remove_all(folder_);
  }
  void TearDown() override { fs::remove_all(folder_); }

  static dendro_slam::MappedScan Scan(int i) {
    dendro_slam::MappedScan scan;
    scan.cylinders.header.stamp = ros::Time(100 + i, 5);
    scan.cylinders.cylinders.resize(static_cast<std::size_t>(i % 3));
    scan.icp_from_ns = i;
    return scan;
  }
  std::vector<std::int64_t> Read(const MapSession& session) {
    std::vector<std::int64_t> found;
    session.ForEach(
        [&found](const dendro_slam::MappedScan& scan) { found.push_back(scan.icp_from_ns); });
    return found;
  }
  std::string Path() const { return folder_.string(); }
  std::size_t Earlier() const {
    std::size_t count = 0;
    for (const auto& entry : fs::directory_iterator(folder_)) {
      count += entry.path().filename().string().rfind("earlier-", 0) == 0 ? 1U : 0U;
    }
    return count;
  }

  fs::path folder_;
};

TEST_F(MapSessionTest, TheSameRunGoesOn) {
  {
    MapSession session(Path(), "run 1", false);
    EXPECT_FALSE(session.found());
    for (int i = 0; i < 5; ++i) session.Append(Scan(i));
  }
  {
    MapSession session(Path(), "run 1", false);
    EXPECT_TRUE(session.found());
    EXPECT_TRUE(session.same_run());
    EXPECT_EQ(Read(session), (std::vector<std::int64_t>{0, 1, 2, 3, 4}));
    session.Append(Scan(5));
  }
  EXPECT_EQ(Read(MapSession(Path(), "run 1", false)), (std::vector<std::int64_t>{0, 1, 2, 3, 4, 5}));
}

TEST_F(MapSessionTest, AnotherRunMovesItAsideOrResumesIt) {
  { MapSession(Path(), "run 1", false).Append(Scan(7)); }
  {
    const MapSession resumed(Path(), "run 2", true);
    EXPECT_TRUE(resumed.found());
    EXPECT_FALSE(resumed.same_run());
    EXPECT_EQ(Read(resumed), std::vector<std::int64_t>{7});
  }
  EXPECT_EQ(Earlier(), 0U);
  const MapSession session(Path(), "run 3", false);
  EXPECT_FALSE(session.found());
  EXPECT_TRUE(Read(session).empty());
  EXPECT_EQ(Earlier(), 1U);
}

TEST_F(MapSessionTest, ARecordCutShortAtAnyByteCostsOnlyItself) {
  {
    MapSession session(Path(), "run", false);
    for (int i = 0; i < 3; ++i) session.Append(Scan(i));
  }
  const std::string journal = Path() + "/scans.journal";
  std::ifstream in(journal, std::ios::binary);
  const std::string bytes((std::istreambuf_iterator<char>(in)), std::istreambuf_iterator<char>());
  std::size_t last = 0;
  for (std::size_t size = 0; size <= bytes.size(); ++size) {
    std::ofstream(journal, std::ios::binary | std::ios::trunc) << bytes.substr(0, size);
    MapSession session(Path(), "run", false);
    const std::size_t count = Read(session).size();
    EXPECT_GE(count, last);
    EXPECT_LE(count, last + 1);
    last = count;
    session.Append(Scan(9));
    EXPECT_EQ(Read(session).size(), count + 1);
  }
  EXPECT_EQ(last, 3U);
}

TEST_F(MapSessionTest, AFlippedBitIsNoticed) {
  {
    MapSession session(Path(), "run", false);
    for (int i = 0; i < 3; ++i) session.Append(Scan(i));
  }
  const std::string journal = Path() + "/scans.journal";
  std::fstream file(journal, std::ios::binary | std::ios::in | std::ios::out);
  file.seekp(-10, std::ios::end);
  file.put('\x7f');
  file.close();
  EXPECT_EQ(Read(MapSession(Path(), "run", false)), (std::vector<std::int64_t>{0, 1}));
}

TEST_F(MapSessionTest, StartingAnewKeepsTheOld) {
  MapSession session(Path(), "run", false);
  session.Append(Scan(1));
  fs::create_directories(session.map_directory());
  session.StartAnew();
  EXPECT_FALSE(fs::exists(session.map_directory()));
  session.Append(Scan(2));
  EXPECT_EQ(Read(session), std::vector<std::int64_t>{2});
  session.StartAnew();
  EXPECT_EQ(Earlier(), 2U);
}

TEST_F(MapSessionTest, StartsOnALoadedMapOrStaysAsItWas) {
  MapSession session(Path(), "run", false);
  session.Append(Scan(1));
  EXPECT_FALSE(session.HasBase());
  // The disk is full halfway.
  EXPECT_THROW(session.StartAnew([](const std::string& directory) {
    fs::create_directories(directory);
    std::ofstream(directory + "/cylinders.csv") << "id";
    throw std::runtime_error("no space left on device");
  }),
               std::runtime_error);
  EXPECT_EQ(Earlier(), 0U);
  EXPECT_FALSE(session.HasBase());
  session.Append(Scan(2));
  EXPECT_EQ(Read(MapSession(Path(), "run", false)), (std::vector<std::int64_t>{1, 2}));

  session.StartAnew([](const std::string& directory) {
    fs::create_directories(directory);
    std::ofstream(directory + "/tree_map.json") << "{}";
  });
  EXPECT_EQ(Earlier(), 1U);
  session.Append(Scan(3));
  const MapSession next(Path(), "run", false);
  EXPECT_TRUE(next.HasBase());
  EXPECT_TRUE(next.same_run());
  EXPECT_EQ(Read(next), std::vector<std::int64_t>{3});
}

TEST_F(MapSessionTest, SaysWhatCannotBeWritten) {
  EXPECT_THROW(MapSession("/proc/nothing", "run", false), MapSessionError);
}

TEST(MappedScan, ComesBackBitByBit) {
  dendro::MapperInput input;
  input.stamp_ns = 1700000000123456789LL;
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  T.linear() = Eigen::AngleAxisd(0.1234567, Eigen::Vector3d(1, 2, 3).normalized()).matrix();
  T.translation() = Eigen::Vector3d(0.1, 1e-17, -3e5);
  input.T_odom_lidar = T;
  dendro::RelativeMotion icp;
  icp.from_stamp_ns = input.stamp_ns - 100000001;
  icp.to_stamp_ns = input.stamp_ns;
  icp.T_from_to = T.inverse();
  icp.covariance.setRandom();
  input.icp = icp;
  dendro_slam::ScanCylinders cylinders;
  cylinders.header.stamp = ToRosTime(input.stamp_ns);
  const dendro::MapperInput back = FromMsg(ToMappedScan(input, cylinders));
  EXPECT_EQ(back.stamp_ns, input.stamp_ns);
  EXPECT_EQ(back.T_odom_lidar->matrix(), T.matrix());
  EXPECT_EQ(back.icp->from_stamp_ns, icp.from_stamp_ns);
  EXPECT_EQ(back.icp->to_stamp_ns, icp.to_stamp_ns);
  EXPECT_EQ(back.icp->T_from_to.matrix(), icp.T_from_to.matrix());
  EXPECT_EQ(back.icp->covariance, icp.covariance);
  input.T_odom_lidar.reset();
  input.icp.reset();
  EXPECT_FALSE(FromMsg(ToMappedScan(input, cylinders)).T_odom_lidar);
  EXPECT_FALSE(FromMsg(ToMappedScan(input, cylinders)).icp);
}

}  // namespace
}  // namespace dendro_ros
