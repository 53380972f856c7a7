#include "dendro_slam/sensors/pose_buffer.h"

#include <cmath>
#include <limits>
#include <stdexcept>

#include <gtest/gtest.h>

#include "dendro_slam/geometry/se3.h"
#include "dendro_slam/sensors/deskew.h"

namespace dendro {
namespace {

constexpr std::int64_t kMs = 1000000;

Eigen::Isometry3d Pose(double x, double yaw) {
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  T.linear() = Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  T.translation() = Eigen::Vector3d(x, 0, 0);
  return T;
}

TEST(PoseBuffer, InterpolatesByHand) {
  PoseBuffer buffer;
  EXPECT_EQ(buffer.Add(1000 * kMs, Pose(0.0, 0.0)), PoseBuffer::AddStatus::kAdded);
  EXPECT_EQ(buffer.Add(1100 * kMs, Pose(2.0, 0.4)), PoseBuffer::AddStatus::kAdded);
  const auto middle = buffer.Lookup(1025 * kMs);
  ASSERT_TRUE(middle.has_value());
  EXPECT_TRUE(middle->isApprox(Pose(0.5, 0.1), 1e-12));
  EXPECT_TRUE(buffer.Lookup(1000 * kMs)->isApprox(Pose(0.0, 0.0), 1e-12));
  EXPECT_TRUE(buffer.Lookup(1100 * kMs)->isApprox(Pose(2.0, 0.4), 1e-12));
}

TEST(PoseBuffer, ExtrapolatesOnlyTheSmallGap) {
  PoseBufferConfig config;
  config.max_extrapolation_s = 0.01;
  PoseBuffer buffer(config);
  EXPECT_FALSE(buffer.Lookup(0).has_value());
  buffer.Add(100 * kMs, Pose(1.0, 0.1));
  EXPECT_TRUE(buffer.Lookup(105 * kMs)->isApprox(Pose(1.0, 0.1), 1e-12)) << "one pose is held";
  buffer.Add(200 * kMs, Pose(2.0, 0.2));
  EXPECT_TRUE(buffer.Lookup(210 * kMs)->isApprox(Pose(2.1, 0.21), 1e-9));
  EXPECT_TRUE(buffer.Lookup(90 * kMs)->isApprox(Pose(0.9, 0.09), 1e-9));
  EXPECT_FALSE(buffer.Lookup(211 * kMs).has_value());
  EXPECT_FALSE(buffer.Lookup(89 * kMs).has_value());
  EXPECT_TRUE(buffer.Covers(90 * kMs, 210 * kMs));
  EXPECT_FALSE(buffer.Covers(89 * kMs, 150 * kMs));
  EXPECT_FALSE(buffer.Covers(150 * kMs, 211 * kMs));
}

TEST(PoseBuffer, RefusesToBridgeASilence) {
  PoseBufferConfig config;
  config.max_gap_s = 0.25;
  PoseBuffer buffer(config);
  for (const int ms : {0, 100, 200, 451, 551}) buffer.Add(ms * kMs, Pose(ms, 0));
  EXPECT_TRUE(buffer.Lookup(150 * kMs).has_value());
  EXPECT_FALSE(buffer.Lookup(300 * kMs).has_value());
  EXPECT_TRUE(buffer.Lookup(500 * kMs).has_value());
  EXPECT_TRUE(buffer.Covers(0, 200 * kMs));
  EXPECT_TRUE(buffer.Covers(451 * kMs, 551 * kMs));
  EXPECT_FALSE(buffer.Covers(150 * kMs, 500 * kMs));
}

TEST(PoseBuffer, RefusesDisorderAndBadPoses) {
  PoseBuffer buffer;
  buffer.Add(100 * kMs, Pose(1, 0));
  EXPECT_EQ(buffer.Add(100 * kMs, Pose(2, 0)), PoseBuffer::AddStatus::kDuplicate);
  EXPECT_EQ(buffer.Add(99 * kMs, Pose(2, 0)), PoseBuffer::AddStatus::kTimeWentBack);
  EXPECT_EQ(buffer.Add(200 * kMs, Pose(std::nan(""), 0)), PoseBuffer::AddStatus::kInvalid);
  Eigen::Isometry3d sheared = Pose(0, 0);
  sheared.linear()(0, 1) = 0.2;
  EXPECT_EQ(buffer.Add(200 * kMs, sheared), PoseBuffer::AddStatus::kInvalid);
  Eigen::Isometry3d mirrored = Pose(0, 0);
  mirrored.linear()(2, 2) = -1.0;
  EXPECT_EQ(buffer.Add(200 * kMs, mirrored), PoseBuffer::AddStatus::kInvalid);
  EXPECT_EQ(buffer.size(), 1U);
  buffer.Clear();
  EXPECT_TRUE(buffer.empty());
  EXPECT_EQ(buffer.Add(5 * kMs, Pose(1, 0)), PoseBuffer::AddStatus::kAdded);
}

TEST(PoseBuffer, ForgetsTheOldest) {
  PoseBufferConfig config;
  config.max_poses = 3;
  PoseBuffer buffer(config);
  for (int i = 0; i < 10; ++i) buffer.Add(i * 10 * kMs, Pose(i, 0));
  EXPECT_EQ(buffer.size(), 3U);
  EXPECT_EQ(buffer.oldest_ns(), 70 * kMs);
  EXPECT_EQ(buffer.newest_ns(), 90 * kMs);
}

TEST(PoseBuffer, ConfigNamesTheField) {
  PoseBufferConfig config;
  config.max_gap_s = 0.0;
  try {
    PoseBuffer buffer(config);
    FAIL() << "accepted max_gap_s = 0";
  } catch (const std::invalid_argument& e) {
    EXPECT_NE(std::string(e.what()).find("max_gap_s"), std::string::npos);
  }
}

TEST(SweepMotion, ConstantVelocityIsTheExponential) {
  Vector6d twist;
  twist << 0.5, -1.0, 2.0, 1.0, -2.0, 0.3;
  const SweepMotion motion = SweepMotion::ConstantVelocity(twist, -0.1, 0.1);
  for (const double t : {-0.1, -0.04321, 0.0, 0.00049, 0.0731, 0.1}) {
    const Eigen::Isometry3d expected = ExpSe3(twist * t);
    EXPECT_LT(LogSe3(expected.inverse() * motion.At(t)).norm(), 1e-6) << t;
    const Eigen::Vector3d p(3, -4, 1);
    EXPECT_LT((motion.TransformPoint(t, p) - expected * p).norm(), 1e-6);
  }
  // On for 20 ms, then still.
  EXPECT_LT(LogSe3(ExpSe3(twist * 0.11).inverse() * motion.At(0.11)).norm(), 1e-3);
  EXPECT_TRUE(motion.At(5.0).isApprox(motion.At(0.12), 1e-9));
  EXPECT_TRUE(motion.At(0.0).isApprox(Eigen::Isometry3d::Identity(), 1e-9));
}

// A point that stands still in the world, measured from a moving and turning base at many times,
// comes back to one place.
TEST(SweepMotion, FromOdometryWithMounting) {
  Vector6d twist;
  twist << 0.2, 0.1, 1.5, 1.0, 0.5, -0.2;
  Eigen::Isometry3d T_base_lidar = Eigen::Isometry3d::Identity();
  T_base_lidar.linear() =
      Eigen::AngleAxisd(0.7, Eigen::Vector3d(1, 2, 3).normalized()).toRotationMatrix();
  T_base_lidar.translation() = Eigen::Vector3d(0.1, -0.2, 0.3);
  const std::int64_t stamp = 1700000000LL * 1000000000LL + 123456789LL;
  const auto T_odom_base = [&](double t) { return Pose(5, 1) * ExpSe3(twist * t); };
  PoseBuffer buffer;
  for (int ms = -200; ms <= 200; ms += 5) {
    buffer.Add(stamp + ms * kMs, T_odom_base(ms * 1e-3));
  }
  LidarScan scan;
  scan.stamp_ns = stamp;
  const Eigen::Vector3d p_odom(4, 3, 2);
  for (int i = 0; i <= 50; ++i) {
    LidarPoint point;
    point.time_s = static_cast<float>(-0.08 + i * 0.002);
    point.position =
        ((T_odom_base(point.time_s) * T_base_lidar).inverse() * p_odom).cast<float>();
    scan.points.push_back(point);
  }
  const auto motion = MakeSweepMotion(buffer, T_base_lidar, scan);
  ASSERT_TRUE(motion.has_value());
  const Eigen::Vector3d expected = (T_odom_base(0) * T_base_lidar).inverse() * p_odom;
  double raw = 0.0;
  for (const LidarPoint& point : scan.points) {
    const Eigen::Vector3d p = point.position.cast<double>();
    raw = std::max(raw, (p - expected).norm());
    EXPECT_LT((motion->TransformPoint(point.time_s, p) - expected).norm(), 2e-5);
  }
  EXPECT_GT(raw, 0.3) << "the motion must matter for this test to mean anything";

  EXPECT_FALSE(MakeSweepMotion(buffer, T_base_lidar, stamp, -0.25, 0.0).has_value());
  EXPECT_FALSE(MakeSweepMotion(buffer, T_base_lidar, stamp + 500 * kMs, 0.0, 0.1).has_value());
  EXPECT_FALSE(MakeSweepMotion(buffer, T_base_lidar, stamp, std::nan(""), 0.1).has_value());
}

TEST(SweepMotion, SpanIgnoresInvalidPoints) {
  LidarScan scan;
  EXPECT_EQ(ScanTimeSpan(scan), std::make_pair(0.0, 0.0));
  scan.points.resize(3);
  scan.points[0].time_s = 0.25F;
  scan.points[1].time_s = -0.5F;
  scan.points[2].time_s = 7.0F;
  scan.points[2].position.x() = std::numeric_limits<float>::quiet_NaN();
  EXPECT_EQ(ScanTimeSpan(scan), std::make_pair(-0.5, 0.25));
  scan.has_time = false;
  EXPECT_EQ(ScanTimeSpan(scan), std::make_pair(0.0, 0.0));
}

}  // namespace
}  // namespace dendro
