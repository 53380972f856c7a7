#include "dendro_slam/ros/bag.h"

#include <gtest/gtest.h>
#include <nav_msgs/Odometry.h>
#include <sensor_msgs/PointCloud2.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>

namespace dendro_ros {
namespace {

class BagTest : public ::testing::Test {
 protected:
  void SetUp() override {
    std::string name = (std::filesystem::temp_directory_path() / "dendro_bag_XXXXXX").string();
    ASSERT_NE(mkdtemp(name.data()), nullptr);
    folder_ = name;
  }
  void TearDown() override { std::filesystem::remove_all(folder_); }

  std::string Path(const std::string& name) const { return (folder_ / name).string(); }

  template <class Function>
  static std::string ErrorOf(Function&& function) {
    try {
      function();
    } catch (const BagError& error) {
      return error.what();
    }
    return "";
  }

  std::filesystem::path folder_;
};

TEST_F(BagTest, WritesAndReadsInOrderOfTime) {
  {
    BagWriter writer(Path("a.bag"));
    nav_msgs::Odometry odometry;
    sensor_msgs::PointCloud2 cloud;
    writer.Write("/odom", ros::Time(2.0), odometry);
    writer.Write("/velodyne_points", ros::Time(1.0), cloud);
    writer.Write("/odom", ros::Time(3.0), odometry);
    EXPECT_FALSE(std::filesystem::exists(Path("a.bag")));
    writer.Close();
  }
  BagReader reader(Path("a.bag"));
  ASSERT_EQ(reader.topics().size(), 2U);
  EXPECT_EQ(reader.topics()[0].name, "/odom");
  EXPECT_EQ(reader.topics()[0].type, "nav_msgs/Odometry");
  EXPECT_EQ(reader.topics()[0].num_messages, 2U);
  std::vector<double> times;
  reader.ForEach({"/odom", "/velodyne_points"},
                 [&](const rosbag::MessageInstance& m) { times.push_back(m.getTime().toSec()); });
  EXPECT_EQ(times, (std::vector<double>{1.0, 2.0, 3.0}));
}

TEST_F(BagTest, AnUnfinishedBagLeavesNothing) {
  { BagWriter writer(Path("a.bag")); }
  EXPECT_TRUE(std::filesystem::is_empty(folder_));
}

TEST_F(BagTest, ErrorsSayWhatToDo) {
  EXPECT_NE(ErrorOf([&] { BagReader(Path("none.bag")); }).find("no such bag"), std::string::npos);
  EXPECT_NE(ErrorOf([&] { BagReader(folder_.string()); }).find("folder"), std::string::npos);
  std::ofstream(Path("text.bag")) << "this is not a bag\n";
  EXPECT_NE(ErrorOf([&] { BagReader(Path("text.bag")); }).find("text.bag"), std::string::npos);
  std::ofstream(Path("empty.bag")).close();
  EXPECT_NE(ErrorOf([&] { BagReader(Path("empty.bag")); }).find("empty.bag"), std::string::npos);
  EXPECT_NE(ErrorOf([&] { BagWriter("/nonexistent/x.bag"); }).find("/nonexistent/x.bag"),
            std::string::npos);
}

TEST_F(BagTest, UnindexedBagSaysReindex) {
  // A recording that was cut has its header but no index position.
  {
    BagWriter writer(Path("a.bag"));
    for (int i = 0; i < 50; ++i) writer.Write("/odom", ros::Time(1.0 + i), nav_msgs::Odometry());
    std::filesystem::copy(Path("a.bag.active"), Path("cut.bag"));
  }
  const std::string error = ErrorOf([&] { BagReader(Path("cut.bag")); });
  EXPECT_NE(error.find("cut.bag"), std::string::npos) << error;
  EXPECT_NE(error.find("reindex"), std::string::npos) << error;
}

TEST_F(BagTest, ChoosesTopicsAndListsWhatItFound) {
  {
    BagWriter writer(Path("a.bag"));
    writer.Write("/left/points", ros::Time(1.0), sensor_msgs::PointCloud2());
    writer.Write("/right/points", ros::Time(1.0), sensor_msgs::PointCloud2());
    writer.Close();
  }
  BagReader reader(Path("a.bag"));
  const std::string cloud = "sensor_msgs/PointCloud2";
  EXPECT_EQ(reader.ChooseTopic("/left/points", {}, cloud, "scans", true), "/left/points");
  EXPECT_EQ(reader.ChooseTopic("", {"/velodyne_points", "/right/points"}, cloud, "scans", true),
            "/right/points");
  EXPECT_EQ(reader.ChooseTopic("", {}, "nav_msgs/Odometry", "odometry", false), "");
  const std::string ambiguous =
      ErrorOf([&] { reader.ChooseTopic("", {}, cloud, "scans", true); });
  EXPECT_NE(ambiguous.find("/left/points, /right/points"), std::string::npos) << ambiguous;
  const std::string absent =
      ErrorOf([&] { reader.ChooseTopic("", {}, "nav_msgs/Odometry", "odometry", true); });
  EXPECT_NE(absent.find("/left/points (sensor_msgs/PointCloud2, 1)"), std::string::npos) << absent;
  const std::string wrong =
      ErrorOf([&] { reader.ChooseTopic("/left/points", {}, "nav_msgs/Odometry", "odometry", true); });
  EXPECT_NE(wrong.find("must be nav_msgs/Odometry"), std::string::npos) << wrong;
}

}  // namespace
}  // namespace dendro_ros
