#include "dendro_slam/odometry/rig_calibrator.h"

#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <string>
#include <tuple>
#include <vector>

#include <gtest/gtest.h>

#include "dendro_slam/geometry/so3.h"
#include "dendro_slam/sim/flight_path.h"
#include "dendro_slam/sim/lidar_simulator.h"
#include "dendro_slam/sim/odometry_simulator.h"
#include "dendro_slam/sim/scene.h"

// Simulated rigs with a known mounting and clock offset, drifting odometry and noisy ranges.
namespace dendro {
namespace {

constexpr double kDeg = 180.0 / M_PI;

// A yard: three walls, a crate, the ground.
const char* kYard = R"(
frame: map
trees: []
ground: {type: plane, z: 0.0}
obstacles:
  - {type: box, size_m: [0.2, 14, 4], position: [8, 0, 2], yaw_deg: 0}
  - {type: box, size_m: [0.2, 12, 4], position: [-7, 1, 2], yaw_deg: 12}
  - {type: box, size_m: [16, 0.2, 4], position: [0, 7, 2], yaw_deg: 0}
  - {type: box, size_m: [1.0, 1.0, 1.5], position: [3, 3, 0.75], yaw_deg: 30}
)";

struct Rig {
  std::string lidar;   ///< Keys of base_to_lidar.
  std::string camera;  ///< Keys of base_to_camera.
};

const Rig kRigA = {"{position: [0.05, 0.1, 0.10], rpy_deg: [10, -20, 35]}",
                   "{position: [0.16, -0.05, -0.08], rpy_deg: [5, 15, -10]}"};
const Rig kRigB = {"{position: [-0.1, 0.05, 0.15], rpy_deg: [40, 10, -30]}",
                   "{position: [0.0, 0.0, -0.05], rpy_deg: [0, 30, 5]}"};

std::string Walk(const Rig& rig, const std::string& motion, double duration_s, int seed) {
  return "type: walk\n"
         "waypoints: [[0,0,1.5],[3,0,1.6],[3,-3,1.4],[0,-3,1.6],[-2,-1,1.5],[0,1,1.6],[3,0,1.5]]\n"
         "corner_s: 0.8\n" +
         motion + "\nduration_s: " + std::to_string(duration_s) +
         "\nextrinsics:\n  base_to_lidar: " + rig.lidar + "\n  base_to_camera: " + rig.camera +
         "\nodometry: {model: t265, seed: " + std::to_string(seed) + "}\n";
}

const char* kTurning =
    "speed_mps: 0.6\nyaw: along\n"
    "gait: {step_hz: 1.8, bob_m: 0.02, sway_m: 0.025, roll_deg: 1.2, pitch_deg: 1.5}\n"
    "wobble: {roll_deg: 25, pitch_deg: 25, period_s: 3.0, seed: 5}";

struct Outcome {
  RigCalibration found;
  Eigen::Isometry3d truth;
};

// @param time_offset_s  To be added to the odometry's stamps to get the lidar's clock.
Outcome Calibrate(const std::string& path_text, double time_offset_s, int seed) {
  const Scene scene = ParseScene(kYard, "yard");
  const FlightPath path = ParseFlightPath(path_text, "walk");
  const Raycaster raycaster(scene);
  LidarSimulatorConfig lidar;
  lidar.seed = seed;
  lidar.enable_footprint = false;  // Thin rays are twenty times as fast.
  lidar.enable_detection_limit = false;
  const LidarSimulator simulator(raycaster, lidar, path.start_stamp_ns);
  RigCalibratorConfig config;
  config.max_points = 800;
  RigCalibrator calibrator(config);
  SimulateFlight(simulator, path, 1, [&](int, const SimulatedScan& scan) {
    calibrator.AddScan(scan.scan);
    return true;
  });
  PoseBuffer odometry;
  for (const OdometrySample& sample :
       SimulateOdometry(path.trajectory, path.duration_s, path.start_stamp_ns, path.odometry)) {
    odometry.Add(sample.stamp_ns - static_cast<std::int64_t>(std::llround(1e9 * time_offset_s)),
                 sample.T_odom_base * path.T_base_camera);
  }
  return {calibrator.Calibrate(odometry), path.T_base_camera.inverse() * path.T_base_lidar};
}

void Print(const char* name, const Outcome& o, double time_offset_s) {
  const HandEyeResult& rig = o.found.rig;
  const Eigen::Isometry3d off = o.truth.inverse() * rig.T_body_lidar;
  std::printf("%s: rotation off %.3f degrees (sigma %.3f), position off %.1f mm (sigma %.1f), time off "
              "%.2f ms (sigma %.2f); turned %.1f degrees about the second axis; %d of %d scans, surfaces "
              "within %.1f mm, residual %.3f degrees %.1f mm\n",
              name, kDeg * LogSo3(off.linear()).norm(), rig.rotation_sigma_deg,
              1e3 * (o.truth.translation() - rig.T_body_lidar.translation()).norm(),
              1e3 * rig.position_sigma_m, 1e3 * (rig.time_offset_s - time_offset_s),
              1e3 * rig.time_sigma_s, rig.second_turn_deg, o.found.registered, o.found.scans,
              1e3 * o.found.registration_rms_m, rig.residual_rotation_deg,
              1e3 * rig.residual_position_m);
  for (const std::string& text : rig.missing) std::printf("  missing: %s\n", text.c_str());
}

class KnownRig : public ::testing::TestWithParam<std::tuple<int, double>> {};

TEST_P(KnownRig, IsFound) {
  const Rig& rig = *std::array<const Rig*, 2>{&kRigA, &kRigB}[static_cast<std::size_t>(
      std::get<0>(GetParam()))];
  const double offset_s = std::get<1>(GetParam());
  const int seed = 10 + std::get<0>(GetParam());
  const Outcome o = Calibrate(Walk(rig, kTurning, 14.0, seed), offset_s, seed);
  Print("rig", o, offset_s);
  const HandEyeResult& found = o.found.rig;
  ASSERT_TRUE(found.known()) << (found.missing.empty() ? "" : found.missing.front());
  EXPECT_TRUE(found.missing.empty());
  const Eigen::Isometry3d off = o.truth.inverse() * found.T_body_lidar;
  EXPECT_LT(kDeg * LogSo3(off.linear()).norm(), 0.5);
  EXPECT_LT((o.truth.translation() - found.T_body_lidar.translation()).norm(), 0.01);
  EXPECT_NEAR(found.time_offset_s, offset_s, 0.002);
}

INSTANTIATE_TEST_SUITE_P(RigsAndClocks, KnownRig,
                         ::testing::Values(std::make_tuple(0, 0.05), std::make_tuple(1, -0.05)));

bool Says(const HandEyeResult& rig, const std::string& words) {
  for (const std::string& text : rig.missing) {
    if (text.find(words) != std::string::npos) return true;
  }
  return false;
}

TEST(MotionThatShowsNothing, TurningAboutOneAxis) {
  const Outcome o = Calibrate(Walk(kRigA, "speed_mps: 0.6\nyaw: along", 8.0, 3), 0.02, 3);
  Print("one axis", o, 0.02);
  EXPECT_FALSE(o.found.rig.position_known);
  EXPECT_FALSE(o.found.rig.known());
  EXPECT_TRUE(Says(o.found.rig, "about one axis only"));
}

TEST(MotionThatShowsNothing, PureTranslation) {
  const Outcome o = Calibrate(Walk(kRigA, "speed_mps: 0.6\nyaw: 30", 6.0, 4), 0.02, 4);
  Print("translation", o, 0.02);
  EXPECT_FALSE(o.found.rig.rotation_known);
  EXPECT_FALSE(o.found.rig.position_known);
  EXPECT_FALSE(o.found.rig.time_known);
  EXPECT_TRUE(Says(o.found.rig, "hardly turned"));
}

TEST(MotionThatShowsNothing, StandingStill) {
  const std::string path =
      "type: walk\nwaypoints: [[0,0,1.5],[0.01,0,1.5]]\nspeed_mps: 0.001\nyaw: 30\nduration_s: 5\n"
      "extrinsics:\n  base_to_lidar: " + kRigA.lidar + "\n  base_to_camera: " + kRigA.camera +
      "\nodometry: {model: t265, seed: 5}\n";
  const Outcome o = Calibrate(path, 0.0, 5);
  Print("still", o, 0.0);
  EXPECT_FALSE(o.found.rig.rotation_known || o.found.rig.position_known || o.found.rig.time_known);
  EXPECT_TRUE(Says(o.found.rig, "hardly turned"));
}

TEST(RigCalibrator, NeedsTimesAndOdometry) {
  RigCalibrator calibrator;
  LidarScan scan;
  scan.has_time = false;
  EXPECT_FALSE(calibrator.AddScan(scan));
  const RigCalibration found = calibrator.Calibrate(PoseBuffer());
  EXPECT_FALSE(found.rig.known());
  EXPECT_FALSE(found.rig.missing.empty());
  RigCalibratorConfig config;
  config.max_points = 10;
  EXPECT_THROW(RigCalibrator{config}, std::invalid_argument);
}

}  // namespace
}  // namespace dendro
