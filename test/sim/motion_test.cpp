#include "dendro_slam/sim/motion.h"

#include <cmath>
#include <thread>

#include <gtest/gtest.h>

#include "dendro_slam/geometry/so3.h"
#include "dendro_slam/sim/flight_path.h"
#include "dendro_slam/sim/imu_simulator.h"

namespace dendro {
namespace {

Eigen::Isometry3d PoseOf(double x, double y, double z, double yaw) {
  return Eigen::Translation3d(x, y, z) * Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ());
}

TEST(FollowedMotion, AnswersAStepAsACriticallyDampedBody) {
  FollowerConfig config;
  config.response_s = 0.25;
  FollowedMotion motion(PoseOf(0, 0, 1, 0), config);
  motion.SetTarget(PoseOf(1, 0, 1, 0.8));
  motion.AdvanceTo(2.0);
  for (double t = 0.0; t < 1.9; t += 0.05) {
    const double rest = (1.0 + t / 0.25) * std::exp(-t / 0.25);  // The closed solution.
    EXPECT_NEAR(motion.Pose(t).translation().x(), 1.0 - rest, 0.01) << t;
    EXPECT_NEAR(LogSo3(motion.Pose(t).linear()).z(), 0.8 * (1.0 - rest), 0.01) << t;
  }
  // It remembers two seconds, and beyond holds the nearest pose.
  motion.AdvanceTo(6.0);
  EXPECT_TRUE(motion.Pose(6.0).isApprox(PoseOf(1, 0, 1, 0.8), 1e-6));
  EXPECT_TRUE(motion.Pose(99.0).isApprox(motion.Pose(6.0), 1e-12));
  EXPECT_TRUE(motion.Pose(0.0).isApprox(motion.Pose(4.0), 1e-12));
}

TEST(FollowedMotion, FarTargetsKeepTheSpeedAndTheVelocityHasNoJumps) {
  FollowerConfig config;
  config.max_speed_mps = 3.0;
  FollowedMotion motion(PoseOf(0, 0, 0, 0), config);
  const MotionFunction pose = [&](double t) { return motion.Pose(t); };
  double fastest = 0.0, jump = 0.0, turned = 0.0;
  Vector6d before = Vector6d::Zero();
  for (int i = 1; i <= 200; ++i) {
    const double t = 0.05 * i;
    // A pilot who changes their mind every two seconds.
    if (i % 40 == 1) motion.SetTarget(PoseOf(i % 80 == 1 ? 10.0 : -10.0, 3.0, 1.0, i % 80 == 1 ? 3.0 : -3.0));
    motion.AdvanceTo(t + 0.01);
    const Vector6d twist = TwistOf(pose, t);
    fastest = std::max(fastest, twist.tail<3>().norm());
    jump = std::max(jump, (twist - before).tail<3>().norm());
    turned = std::max(turned, twist.head<3>().norm());
    before = twist;
  }
  EXPECT_LT(fastest, 3.05);
  EXPECT_GT(fastest, 2.5);
  EXPECT_LT(jump, 2.5);  // 0.05 s of the largest acceleration, 2 * 6 m/s / 0.2 s.
  EXPECT_GT(turned, 1.0);
}

TEST(FollowedMotion, ThreadsMaySteerWhileItFliesAndBadTargetsAreRefused) {
  FollowedMotion motion(PoseOf(0, 0, 0, 0), FollowerConfig());
  std::thread pilot([&] {
    for (int i = 0; i < 2000; ++i) motion.SetTarget(PoseOf(0.001 * i, 0, 0, 0.0005 * i));
  });
  for (int i = 1; i <= 100; ++i) {
    motion.AdvanceTo(0.1 * i);
    EXPECT_TRUE(motion.Pose(0.1 * i - 0.05).matrix().allFinite());
  }
  pilot.join();
  Eigen::Isometry3d bad = Eigen::Isometry3d::Identity();
  bad.translation().x() = std::nan("");
  EXPECT_THROW(motion.SetTarget(bad), std::invalid_argument);
  bad = Eigen::Isometry3d::Identity();
  bad.linear() *= 2.0;
  EXPECT_THROW(motion.SetTarget(bad), std::invalid_argument);
  FollowerConfig config;
  config.response_s = 0.0;
  EXPECT_THROW(FollowedMotion(PoseOf(0, 0, 0, 0), config), std::invalid_argument);
}

class Imu : public ::testing::Test {
 protected:
  FlightPath path_ = ParseFlightPath(
      "type: quadrangle\nside_m: 8\naltitudes_m: [1.5, 3]\nspeed_mps: 1.5\nhover_s: 3\nlook_at: [0, 0, 1]\n"
      "wobble: {roll_deg: 5, pitch_deg: 4, period_s: 3, seed: 2}\n", "p.yaml");

  static ImuSimulatorConfig Perfect() {
    ImuSimulatorConfig config;
    config.gyro_noise_dps_per_sqrt_hz = config.gyro_bias_dps = config.gyro_bias_walk_dps_per_sqrt_s = 0.0;
    config.accel_noise_mps2_per_sqrt_hz = config.accel_bias_mps2 = config.accel_bias_walk_mps2_per_sqrt_s = 0.0;
    return config;
  }
  std::vector<ImuSample> Simulate(const ImuSimulatorConfig& config, double until_s) const {
    return ImuSimulator([this](double t) { return path_.trajectory.Pose(t); }, path_.start_stamp_ns, config)
        .AdvanceTo(until_s);
  }
};

TEST_F(Imu, AtRestItFeelsGravityUpwards) {
  const ImuSample sample = Simulate(Perfect(), 0.0).front();
  const Eigen::Matrix3d R = path_.trajectory.Pose(0.0).linear();
  EXPECT_TRUE((R * sample.specific_force_mps2).isApprox(Eigen::Vector3d(0, 0, 9.80665), 1e-3));
  EXPECT_EQ(sample.stamp_ns, path_.start_stamp_ns);
}

TEST_F(Imu, IntegratedItGivesTheFlight) {
  // Strapdown integration, independent of how the samples were made: errors of the integration itself
  // and of the second differences stay in the centimetres over 30 s.
  const auto samples = Simulate(Perfect(), 30.0);
  Eigen::Isometry3d T = path_.trajectory.Pose(0.0);
  Eigen::Vector3d v = Eigen::Vector3d::Zero();
  const double dt = 1.0 / 200.0;
  double worst_m = 0.0, worst_rad = 0.0;
  for (std::size_t i = 0; i + 1 < samples.size(); ++i) {
    const Eigen::Vector3d omega = 0.5 * (samples[i].angular_velocity_rps + samples[i + 1].angular_velocity_rps);
    const Eigen::Matrix3d after = T.linear() * ExpSo3(dt * omega);
    const Eigen::Vector3d a = 0.5 * (T.linear() * samples[i].specific_force_mps2 +
                                     after * samples[i + 1].specific_force_mps2) -
                              Eigen::Vector3d(0, 0, 9.80665);
    T.translation() += dt * v + 0.5 * dt * dt * a;
    v += dt * a;
    T.linear() = after;
    const Eigen::Isometry3d truth = path_.trajectory.Pose(static_cast<double>(i + 1) * dt);
    worst_m = std::max(worst_m, (T.translation() - truth.translation()).norm());
    worst_rad = std::max(worst_rad, LogSo3(T.linear().transpose() * truth.linear()).norm());
  }
  EXPECT_LT(worst_m, 0.05);
  EXPECT_LT(worst_rad, 1e-3);
}

TEST_F(Imu, NoiseAndBiasHaveTheirSize) {
  ImuSimulatorConfig config = Perfect();
  config.gyro_noise_dps_per_sqrt_hz = 0.014;
  config.accel_noise_mps2_per_sqrt_hz = 0.0015;
  const auto clean = Simulate(Perfect(), 40.0), noisy = Simulate(config, 40.0);
  double gyro = 0.0, accel = 0.0;
  for (std::size_t i = 0; i < clean.size(); ++i) {
    gyro += (noisy[i].angular_velocity_rps - clean[i].angular_velocity_rps).squaredNorm();
    accel += (noisy[i].specific_force_mps2 - clean[i].specific_force_mps2).squaredNorm();
  }
  const double n = 3.0 * static_cast<double>(clean.size());
  EXPECT_NEAR(std::sqrt(gyro / n), 0.014 * M_PI / 180.0 * std::sqrt(200.0), 1e-4);
  EXPECT_NEAR(std::sqrt(accel / n), 0.0015 * std::sqrt(200.0), 6e-4);
  // Biases over seeds.
  double bias = 0.0, walk = 0.0;
  constexpr int kSeeds = 200;
  for (int seed = 1; seed <= kSeeds; ++seed) {
    ImuSimulatorConfig biased = Perfect();
    biased.rate_hz = 10.0;
    biased.seed = seed;
    biased.gyro_bias_dps = 0.1;
    biased.accel_bias_walk_mps2_per_sqrt_s = 0.001;
    ImuSimulatorConfig still = Perfect();
    still.rate_hz = 10.0;
    const auto a = Simulate(biased, 25.0), b = Simulate(still, 25.0);
    bias += (a.back().angular_velocity_rps - b.back().angular_velocity_rps).squaredNorm() / (3.0 * kSeeds);
    walk += (a.back().specific_force_mps2 - b.back().specific_force_mps2).squaredNorm() / (3.0 * kSeeds);
  }
  EXPECT_NEAR(std::sqrt(bias), 0.1 * M_PI / 180.0, 0.1 * 0.1 * M_PI / 180.0);
  EXPECT_NEAR(std::sqrt(walk), 0.001 * std::sqrt(25.0), 0.1 * 0.005);
}

TEST_F(Imu, PiecesMakeTheWholeAndBadNumbersAreRefused) {
  const auto whole = Simulate(ImuSimulatorConfig(), 5.0);
  ImuSimulator imu([this](double t) { return path_.trajectory.Pose(t); }, path_.start_stamp_ns, ImuSimulatorConfig());
  std::vector<ImuSample> pieces;
  for (int i = 1; i <= 50; ++i) {
    for (const ImuSample& s : imu.AdvanceTo(0.1 * i)) pieces.push_back(s);
  }
  ASSERT_EQ(pieces.size(), whole.size());
  EXPECT_EQ(pieces.back().angular_velocity_rps, whole.back().angular_velocity_rps);
  EXPECT_EQ(pieces.back().specific_force_mps2, whole.back().specific_force_mps2);
  ImuSimulatorConfig config;
  config.accel_bias_mps2 = -1.0;
  try {
    config.Validate();
    FAIL();
  } catch (const std::invalid_argument& error) {
    EXPECT_STREQ(error.what(), "imu.accel_bias_mps2: expected >= 0");
  }
}

}  // namespace
}  // namespace dendro
