#include "dendro_slam/sensors/pose_stream.h"

#include <random>
#include <sstream>
#include <string>

#include <gtest/gtest.h>

namespace dendro {
namespace {

std::string ErrorOf(const std::string& text, bool tum) {
  std::istringstream in(text);
  try {
    tum ? ReadTumPoses(in) : ReadRealSensePoses(in);
  } catch (const PoseStreamError& e) {
    return e.what();
  }
  return "";
}

TEST(RosFromRealSense, AxesByHand) {
  // Forward is -z, left is -x, up is y.
  EXPECT_EQ(RosFromRealSense(Eigen::Vector3d(0, 0, -1)), Eigen::Vector3d(1, 0, 0));
  EXPECT_EQ(RosFromRealSense(Eigen::Vector3d(-1, 0, 0)), Eigen::Vector3d(0, 1, 0));
  EXPECT_EQ(RosFromRealSense(Eigen::Vector3d(0, 1, 0)), Eigen::Vector3d(0, 0, 1));
  // A turn to the left is one about +y there and about +z here.
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  T.linear() = Eigen::AngleAxisd(0.3, Eigen::Vector3d::UnitY()).toRotationMatrix();
  EXPECT_TRUE(RosFromRealSense(T).linear().isApprox(
      Eigen::AngleAxisd(0.3, Eigen::Vector3d::UnitZ()).toRotationMatrix(), 1e-12));
}

TEST(RosFromRealSense, QuaternionAsRealsense2CameraAndHomomorphism) {
  std::mt19937 rng(1);
  std::normal_distribution<double> n;
  for (int i = 0; i < 50; ++i) {
    const Eigen::Quaterniond q = Eigen::Quaterniond(n(rng), n(rng), n(rng), n(rng)).normalized();
    Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
    T.linear() = q.toRotationMatrix();
    T.translation() = Eigen::Vector3d(n(rng), n(rng), n(rng));
    const Eigen::Quaterniond ros(q.w(), -q.z(), -q.x(), q.y());
    EXPECT_TRUE(RosFromRealSense(T).linear().isApprox(ros.toRotationMatrix(), 1e-12));
    EXPECT_TRUE(RosFromRealSense(T * T).isApprox(RosFromRealSense(T) * RosFromRealSense(T), 1e-12));
    const Eigen::Vector3d p(n(rng), n(rng), n(rng));
    EXPECT_TRUE(RosFromRealSense(T * p).isApprox(RosFromRealSense(T) * RosFromRealSense(p), 1e-12));
  }
}

TEST(Tum, Reads) {
  std::istringstream in(
      "# time tx ty tz qx qy qz qw\n"
      "1700000000.123456789 1 2 3 0 0 0 1\n"
      "\n"
      "1.700000000223456789e9\t-1.5 2e-3 3 0 0 0.7071068 0.7071068  # comment\r\n");
  const auto poses = ReadTumPoses(in);
  ASSERT_EQ(poses.size(), 2U);
  EXPECT_EQ(poses[0].stamp_ns, 1700000000123456789LL);
  EXPECT_EQ(poses[1].stamp_ns, 1700000000223456789LL);
  EXPECT_EQ(poses[0].T_odom_camera.translation(), Eigen::Vector3d(1, 2, 3));
  EXPECT_TRUE(poses[1].T_odom_camera.linear().col(0).isApprox(Eigen::Vector3d::UnitY(), 1e-6));
  EXPECT_EQ(poses[0].confidence, 3);
}

TEST(Tum, NamesTheLine) {
  EXPECT_NE(ErrorOf("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0\n", true).find("line 2"), std::string::npos);
  EXPECT_NE(ErrorOf("1 0 0 nan 0 0 0 1\n", true).find("nan"), std::string::npos);
  EXPECT_NE(ErrorOf("1 0 0 0 0 0 0 2\n", true).find("quaternion"), std::string::npos);
  EXPECT_NE(ErrorOf("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", true).find("grow"), std::string::npos);
  EXPECT_NE(ErrorOf("-1 0 0 0 0 0 0 1\n", true).find("range"), std::string::npos);
  EXPECT_NE(ErrorOf("1e300 0 0 0 0 0 0 1\n", true).find("range"), std::string::npos);
  EXPECT_NE(ErrorOf("1x 0 0 0 0 0 0 1\n", true).find("1x"), std::string::npos);
}

TEST(RealSense, RsConvert) {
  std::istringstream in(
      "\n\nStream Type,F#,HW Timestamp (ms),Backend Timestamp(ms),Host Timestamp(ms),"
      "3DOF_x,3DOF_y,3DOF_z\n"
      "Gyro,1,10.000,1600000000001.000,1600000000002.000,0.1,0.2,0.3\n"
      "\n\nStream Type,F#,HW Timestamp (ms),Backend Timestamp(ms),Host Timestamp(ms),"
      "t_x,t_y,t_z,r_x,r_y,r_z,r_w\n"
      "Pose,1,10.000,1600000000001.000,1600000000002.125,1.000,2.000,-3.000,0,0.707,0,0.707\n"
      "Pose,2,15.000,1600000000007.000,0.000,1.000,2.000,-3.000,0,0,0,1\n");
  const auto poses = ReadRealSensePoses(in);
  ASSERT_EQ(poses.size(), 2U);
  EXPECT_EQ(poses[0].stamp_ns, 1600000000002125000LL);
  EXPECT_EQ(poses[1].stamp_ns, 1600000000007000000LL);
  EXPECT_EQ(poses[0].T_odom_camera.translation(), Eigen::Vector3d(3, -1, 2));
  EXPECT_TRUE(poses[0].T_odom_camera.linear().col(0).isApprox(Eigen::Vector3d::UnitY(), 1e-9));
}

TEST(RealSense, NamedColumnsUnitsAndConfidence) {
  for (const char* stamp : {"1600000000.5", "1600000000500", "1600000000500000",
                            "1600000000500000000"}) {
    std::istringstream in(std::string("timestamp,tracker_confidence,qw,qx,qy,qz,tx,ty,tz\n") +
                          stamp + ",1,1,0,0,0,0,0,-2\n");
    const auto poses = ReadRealSensePoses(in);
    ASSERT_EQ(poses.size(), 1U);
    EXPECT_EQ(poses[0].stamp_ns, 1600000000500000000LL) << stamp;
    EXPECT_EQ(poses[0].confidence, 1);
    EXPECT_EQ(poses[0].T_odom_camera.translation(), Eigen::Vector3d(2, 0, 0));
  }
  EXPECT_NE(ErrorOf("a,b,c\n1,2,3\n", false).find("header"), std::string::npos);
  EXPECT_NE(ErrorOf("", false).find("no poses"), std::string::npos);
  EXPECT_NE(ErrorOf("time,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,1\n", false).find("line 2"),
            std::string::npos);
  EXPECT_NE(ErrorOf("time,x,y,z,qx,qy,qz,qw,confidence\n1,0,0,0,0,0,0,1,7\n", false)
                .find("confidence"),
            std::string::npos);
}

TEST(Confidence, LowConfidenceIsAThousandTimesTheVariance) {
  const Matrix6d high = PoseCovarianceFromConfidence(3, 0.01, 0.02);
  EXPECT_DOUBLE_EQ(high(0, 0), 1e-4);
  EXPECT_DOUBLE_EQ(high(5, 5), 4e-4);
  EXPECT_TRUE((PoseCovarianceFromConfidence(0, 0.01, 0.02)).isApprox(1000.0 * high, 1e-12));
}

}  // namespace
}  // namespace dendro
