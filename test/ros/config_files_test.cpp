#include <gtest/gtest.h>

#include <chrono>
#include <condition_variable>
#include <filesystem>
#include <mutex>
#include <set>
#include <string>
#include <thread>
#include <vector>

#include "dendro_slam/ros/node_config.h"
#include "dendro_slam/ros/params.h"
#include "dendro_slam/ros/scan_gate.h"
#include "dendro_slam/ros/stamp_join.h"
#include "dendro_slam/ros/worker.h"

namespace dendro_ros {
namespace {

TEST(ShippedConfig, EveryFileLoads) {
  std::set<std::string> sections;
  for (const auto& entry :
       std::filesystem::directory_iterator(std::string(DENDRO_SOURCE_DIR) + "/config")) {
    if (entry.path().extension() != ".yaml") continue;
    if (entry.path().filename() == "rig.yaml") continue;  // Of driver_bridge, which tests it.
    const std::string path = entry.path().string();
    const ParamTree tree = ReadYamlFile(path);
    EXPECT_NO_THROW(ReadConfig<NodesConfig>(tree, path)) << path;
    for (const auto& section : tree.AsMap(path)) {
      EXPECT_TRUE(sections.insert(section.first).second) << section.first << " twice";
      EXPECT_EQ(section.first, entry.path().stem().string());
    }
  }
  EXPECT_EQ(sections.size(), 6U);
}

TEST(ShippedConfig, DefaultsAreValid) {
  NodesConfig config;
  EXPECT_NO_THROW(config.Pipeline().Validate());
  EXPECT_NO_THROW(LidarSimulatorNodeConfig().Validate());
  EXPECT_NO_THROW(Vlp16DecoderNodeConfig().Validate());
}

nav_msgs::Odometry OdometryAt(double stamp_s) {
  nav_msgs::Odometry msg;
  msg.header.stamp.fromSec(stamp_s);
  msg.header.frame_id = "odom";
  msg.child_frame_id = "velodyne";
  msg.pose.pose.orientation.w = 1.0;
  return msg;
}

class ScanGateTest : public ::testing::Test {
 protected:
  GateEvent Scan(double stamp_s) {
    const auto ns = static_cast<std::int64_t>(stamp_s * 1e9);
    return gate_.AddScan(ns, ns + 100000000, "velodyne", stamp_s, &dropped_);
  }
  ScanGate<double> gate_{0.5, 3, dendro::PoseBufferConfig(), LidarMount(LidarMountConfig(), nullptr)};
  std::size_t dropped_ = 0;
};

TEST_F(ScanGateTest, WaitsForTheWholeSweep) {
  gate_.AddOdometry(OdometryAt(10.0));
  Scan(10.0);
  gate_.AddOdometry(OdometryAt(10.05));
  EXPECT_FALSE(gate_.Pop().has_value());
  gate_.AddOdometry(OdometryAt(10.1));
  EXPECT_EQ(gate_.Pop().value(), 10.0);
  EXPECT_NE(gate_.poses(), nullptr);
}

TEST_F(ScanGateTest, GoesOnWithoutOdometryAfterTheTimeout) {
  Scan(10.0);
  EXPECT_FALSE(gate_.Pop().has_value());
  Scan(10.4);
  EXPECT_FALSE(gate_.Pop().has_value());
  Scan(10.6);
  EXPECT_EQ(gate_.Pop().value(), 10.0);
  EXPECT_EQ(gate_.Pop().value(), 10.4);
  EXPECT_EQ(gate_.Pop().value(), 10.6);
  Scan(10.7);
  EXPECT_EQ(gate_.Pop().value(), 10.7);
  EXPECT_EQ(gate_.poses(), nullptr);
}

TEST_F(ScanGateTest, DropsTheOldestBeyondItsCapacity) {
  for (int i = 0; i < 5; ++i) Scan(10.0 + 0.1 * i);
  EXPECT_EQ(dropped_, 2U);
  EXPECT_EQ(gate_.size(), 3U);
}

TEST_F(ScanGateTest, NoticesTimeThatJumpsBack) {
  gate_.AddOdometry(OdometryAt(100.0));
  EXPECT_EQ(gate_.AddOdometry(OdometryAt(99.9)), GateEvent::kRefused);
  EXPECT_EQ(Scan(100.0), GateEvent::kAccepted);
  EXPECT_EQ(Scan(100.0), GateEvent::kRefused);
  EXPECT_EQ(Scan(50.0), GateEvent::kTimeJumpedBack);
  EXPECT_EQ(gate_.size(), 1U);
  EXPECT_EQ(gate_.AddOdometry(OdometryAt(50.2)), GateEvent::kAccepted);
  EXPECT_EQ(gate_.Pop().value(), 50.0);
}

TEST_F(ScanGateTest, SaysWhatTransformIsMissing) {
  nav_msgs::Odometry msg = OdometryAt(10.0);
  msg.child_frame_id = "camera_pose_frame";
  gate_.AddOdometry(msg);
  Scan(10.0);
  EXPECT_NE(gate_.mount_error().find("camera_pose_frame"), std::string::npos);
  EXPECT_NE(gate_.mount_error().find("lidar_mount"), std::string::npos);
  EXPECT_EQ(gate_.poses(), nullptr);
}

TEST_F(ScanGateTest, RefusesAPoseThatIsNone) {
  nav_msgs::Odometry msg = OdometryAt(10.0);
  msg.pose.pose.orientation.w = 0.0;
  EXPECT_EQ(gate_.AddOdometry(msg), GateEvent::kInvalid);
}

TEST(LidarMount, NumbersTurnAboutFixedAxes) {
  LidarMountConfig config;
  config.from_tf = false;
  config.x_m = 1.0;
  config.roll_deg = 90.0;
  config.yaw_deg = 90.0;
  LidarMount mount(config, nullptr);
  const auto T = mount.Find("", "velodyne");
  ASSERT_TRUE(T.has_value());
  // y of the lidar goes to z by the roll and stays there under the yaw.
  EXPECT_TRUE((*T * Eigen::Vector3d(0, 1, 0)).isApprox(Eigen::Vector3d(1, 0, 1), 1e-12));
}

TEST(StampJoin, JoinsInOrderAndKnowsWhatIsMissing) {
  StampJoin<int, int> join(10, StampJoin<int, int>::Missing::kAccept);
  join.AddFirst(1, 10);
  EXPECT_FALSE(join.Pop().has_value());
  join.AddFirst(2, 20);
  join.AddSecond(2, 21);
  auto joined = join.Pop();
  ASSERT_TRUE(joined.has_value());
  EXPECT_EQ(joined->first, 10);
  EXPECT_FALSE(joined->second.has_value());
  joined = join.Pop();
  ASSERT_TRUE(joined.has_value());
  EXPECT_EQ(joined->second.value(), 21);
  EXPECT_FALSE(join.Pop().has_value());

  StampJoin<int, int> strict(10, StampJoin<int, int>::Missing::kDrop);
  strict.AddFirst(1, 10);
  strict.AddSecond(2, 21);
  strict.AddFirst(2, 20);
  EXPECT_EQ(strict.Pop()->first, 20);
  EXPECT_EQ(strict.TakeDropped(), 1U);
}

TEST(Worker, DropsTheOldestBulkyItemAndStops) {
  std::mutex mutex;
  std::condition_variable wake;
  bool blocked = true;
  std::vector<int> done;
  {
    Worker<int> worker(2, [&](int& item) {
      std::unique_lock<std::mutex> lock(mutex);
      wake.wait(lock, [&] { return !blocked; });
      done.push_back(item);
      wake.notify_all();
    });
    std::size_t dropped = 0;
    worker.Push(0, true);
    std::this_thread::sleep_for(std::chrono::milliseconds(50));  // The worker holds 0 now.
    worker.Push(-1, false);
    for (int i = 1; i <= 4; ++i) dropped += worker.Push(i, true);
    EXPECT_EQ(dropped, 2U);
    std::unique_lock<std::mutex> lock(mutex);
    blocked = false;
    wake.notify_all();
    wake.wait_for(lock, std::chrono::seconds(10), [&] { return done.size() == 4; });
  }
  EXPECT_EQ(done, (std::vector<int>{0, -1, 3, 4}));
}

}  // namespace
}  // namespace dendro_ros
