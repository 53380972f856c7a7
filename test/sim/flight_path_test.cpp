#include "dendro_slam/sim/flight_path.h"

#include <array>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>

#include <unistd.h>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "dendro_slam/geometry/so3.h"
#include "dendro_slam/sim/odometry_simulator.h"
#include "dendro_slam/sim/scene.h"

namespace dendro {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;

double Yaw(const Eigen::Isometry3d& T) { return std::atan2(T(1, 0), T(0, 0)); }

/// Largest jump of the twist between neighbouring instants: none for a C1 motion.
double LargestTwistJump(const FlightPath& path) {
  double worst = 0.0;
  for (double t = 0.01; t < path.duration_s; t += 0.0173) {
    const Eigen::Isometry3d& a = path.trajectory.Pose(t - 1e-4);
    const Eigen::Isometry3d& b = path.trajectory.Pose(t);
    const Eigen::Isometry3d& c = path.trajectory.Pose(t + 1e-4);
    const Eigen::Vector3d dv = (c.translation() - 2 * b.translation() + a.translation()) / 1e-4;
    const Eigen::Vector3d dw =
        (LogSo3(b.linear().transpose() * c.linear()) - LogSo3(a.linear().transpose() * b.linear())) / 1e-4;
    worst = std::max({worst, dv.norm(), dw.norm()});
  }
  return worst;
}

const char kSquare[] =
    "type: quadrangle\nside_m: 8\naltitudes_m: [1.5, 3]\nspeed_mps: 1.6\nyaw: 30\n"
    "extrinsics: {base_to_lidar: {position: [0, 0, 0.2], rpy_deg: [0, 0, 90]}}\n";

TEST(FlightPath, SquareByHand) {
  const FlightPath path = ParseFlightPath(kSquare, "config/square.yaml");
  EXPECT_EQ(path.name, "square");
  // Two laps of 32 m and a climb of 1.5 m at 1.6 m/s, a second of rest at both ends.
  EXPECT_NEAR(path.duration_s, (64.0 + 1.5) / 1.6 + 2.0, 1e-9);
  EXPECT_EQ(path.start_stamp_ns, 1600000000LL * 1000000000LL);
  EXPECT_TRUE(path.trajectory.Pose(0).translation().isApprox(Eigen::Vector3d(4, -4, 1.5), 1e-9));
  // The middle of the first side, 4 m of way after the start.
  EXPECT_TRUE(path.trajectory.Pose(1.0 + 4.0 / 1.6).translation().isApprox(Eigen::Vector3d(4, 0, 1.5), 1e-6));
  EXPECT_NEAR(Yaw(path.trajectory.Pose(7.0)), M_PI / 6, 1e-9);
  // The corner is rounded: the drone does not reach it, but comes near.
  const double at_corner = (path.trajectory.Pose(1.0 + 8.0 / 1.6).translation() - Eigen::Vector3d(4, 4, 1.5)).norm();
  EXPECT_GT(at_corner, 0.1);
  EXPECT_LT(at_corner, 0.6);
  double fastest = 0.0;
  for (double t = 0; t < path.duration_s; t += 0.05) fastest = std::max(fastest, path.trajectory.Twist(t).tail<3>().norm());
  EXPECT_NEAR(fastest, 1.6, 0.02);
  const Eigen::Isometry3d T = path.LidarPose(path.start_stamp_ns);
  EXPECT_TRUE(T.translation().isApprox(Eigen::Vector3d(4, -4, 1.7), 1e-9));
  EXPECT_NEAR(Yaw(T), M_PI / 6 + M_PI / 2, 1e-9);
}

TEST(FlightPath, EveryTypeMovesWithContinuousVelocity) {
  const std::string common = "speed_mps: 1.2\nlook_at: [0, 0, 2]\nwobble: {roll_deg: 2, pitch_deg: 2}\n";
  for (const std::string& text :
       {std::string("type: circle\nradius_m: 5\naltitude_m: 2\nlaps: 0.5\n"),
        std::string("type: helix\nradius_m: 5\naltitudes_m: [1, 4]\nlaps: 0.5\n"),
        std::string("type: conical_helix\nradii_m: [5, 3]\naltitudes_m: [1, 4]\nlaps: 0.5\n"),
        std::string("type: quadrangle\ncorners: [[3, 3], [-3, 3], [0, -4]]\naltitudes_m: [2]\n"),
        std::string("type: walk\nwaypoints: [[4, 0, 1.6], [4, 4, 1.6], [0, 5, 1.7]]\n")}) {
    const FlightPath path = ParseFlightPath(text + common, "p.yaml");
    // Accelerations of a few m/s^2 over 0.1 ms: a jump of the velocity would show as its size.
    EXPECT_LT(LargestTwistJump(path), 0.01) << text;
    // It looks at the tree.
    for (double t = 1; t < path.duration_s; t += 1.7) {
      const Eigen::Isometry3d T = path.trajectory.Pose(t);
      const double bearing = std::atan2(-T.translation().y(), -T.translation().x());
      EXPECT_LT(std::abs(std::remainder(bearing - Yaw(T), 2 * M_PI)), 0.03) << text;
    }
  }
}

TEST(FlightPath, HelixEndsWhereItShould) {
  const FlightPath path = ParseFlightPath(
      "type: conical_helix\nradii_m: [5, 3]\naltitudes_m: [1, 4]\nlaps: 1.5\nspeed_mps: 1\nyaw: 0\n", "p.yaml");
  EXPECT_TRUE(path.trajectory.Pose(0).translation().isApprox(Eigen::Vector3d(5, 0, 1), 1e-6));
  EXPECT_TRUE(path.trajectory.Pose(1e9).translation().isApprox(Eigen::Vector3d(-3, 0, 4), 1e-6));
}

TEST(FlightPath, AWalkerLeansTheRigBackBetweenWayPoints) {
  // Level for the first 4 m, then up to 30 degrees over the next 4 m, at 1 m/s without gait.
  const std::string text =
      "type: walk\nwaypoints: [[0, 0, 1.5], [4, 0, 1.5], [8, 0, 1.5]]\ntilt_deg: [0, 0, 30]\nspeed_mps: 1\n"
      "hover_s: 2\nyaw: 90\ngait: {step_hz: 1, bob_m: 0, sway_m: 0, roll_deg: 0, pitch_deg: 0}\n";
  const FlightPath path = ParseFlightPath(text, "p.yaml");
  const auto rise_deg = [&](double t) {
    const Eigen::Vector3d nose = path.trajectory.Pose(t).linear() * Eigen::Vector3d::UnitX();
    EXPECT_NEAR(nose.x(), 0.0, 1e-9);  // Leaning turns the nose up where it looks, not aside.
    return std::asin(nose.z()) * 180.0 / M_PI;
  };
  EXPECT_NEAR(rise_deg(3.0), 0.0, 1e-6);
  EXPECT_NEAR(rise_deg(8.0), 15.0, 0.01);
  EXPECT_NEAR(rise_deg(path.duration_s), 30.0, 0.1);
  EXPECT_THROW(ParseFlightPath(text + "\n# one too few\n" + "wobble: {seed: 1, tilt: 2}\n", "p.yaml"), SceneFileError);
  std::string few = text;
  few.replace(few.find("[0, 0, 30]"), 10, "[0, 30]");
  try {
    ParseFlightPath(few, "p.yaml");
    ADD_FAILURE() << "two angles for three way-points";
  } catch (const SceneFileError& e) {
    EXPECT_THAT(e.what(), AllOf(HasSubstr("p.yaml:3"), HasSubstr("tilt_deg"), HasSubstr("every way-point")));
  }
}

TEST(FlightPath, PosesArePassedThroughExactly) {
  const auto folder = std::filesystem::temp_directory_path() / ("dendro_path_test_" + std::to_string(::getpid()));
  std::filesystem::create_directories(folder);
  std::ofstream(folder / "poses.tum") << "# stamp x y z qx qy qz qw\n"
                                         "1700000000.25 1 2 3 0 0 0 1\n1700000000.75 2 2 3 0 0 0.70710678 0.70710678\n"
                                         "1700000001.75 2 4 3 0 0 1 0\n";
  const FlightPath path = ParseFlightPath("type: poses\nfile: poses.tum\n", (folder / "p.yaml").string());
  EXPECT_NEAR(path.duration_s, 1.5, 1e-6);
  EXPECT_TRUE(path.trajectory.Pose(0.5).translation().isApprox(Eigen::Vector3d(2, 2, 3), 1e-6));
  EXPECT_NEAR(Yaw(path.trajectory.Pose(0.5)), M_PI / 2, 1e-6);
  EXPECT_LT(LargestTwistJump(path), 0.02);
  const auto error = [&](const std::string& rows) -> std::string {
    std::ofstream(folder / "poses.tum") << rows;
    try {
      ParseFlightPath("type: poses\nfile: poses.tum\n", (folder / "p.yaml").string());
    } catch (const SceneFileError& e) {
      return e.what();
    }
    return "";
  };
  EXPECT_THAT(error("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n"), AllOf(HasSubstr("line 2"), HasSubstr("ascend")));
  EXPECT_THAT(error("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0\n"), AllOf(HasSubstr("line 2"), HasSubstr("qx qy qz qw")));
  EXPECT_THAT(error("1 0 0 0 0 0 0 2\n2 0 0 0 0 0 0 1\n"), HasSubstr("unit length"));
}

TEST(FlightPath, EveryMistakeGetsTheFileTheLineTheKeyAndWhatIsExpected) {
  const auto error = [](const std::string& from, const std::string& to) -> std::string {
    std::string text = kSquare;
    const std::size_t at = text.find(from);
    EXPECT_NE(at, std::string::npos) << from;
    text.replace(at, from.size(), to);
    try {
      ParseFlightPath(text, "p.yaml");
    } catch (const SceneFileError& e) {
      return e.what();
    }
    return "";
  };
  EXPECT_EQ(error("yaw: 30", "yaw: 30"), "");
  EXPECT_THAT(error("speed_mps", "speed"), AllOf(HasSubstr("p.yaml:4"), HasSubstr("speed"), HasSubstr("unknown key"), HasSubstr("speed_mps")));
  EXPECT_THAT(error("speed_mps: 1.6\n", ""), AllOf(HasSubstr("speed_mps"), HasSubstr("missing")));
  EXPECT_THAT(error("1.6", "-1"), AllOf(HasSubstr("speed_mps"), HasSubstr("> 0")));
  EXPECT_THAT(error("quadrangle", "square"), AllOf(HasSubstr("p.yaml:1"), HasSubstr("type"), HasSubstr("quadrangle")));
  EXPECT_THAT(error("yaw: 30", "yaw: north"), HasSubstr("number"));
  EXPECT_THAT(error("yaw: 30\n", ""), HasSubstr("look_at or yaw"));
  EXPECT_THAT(error("side_m: 8\n", ""), HasSubstr("corners or side_m"));
  EXPECT_THAT(error("yaw: 30", "yaw: 30\nodometry: {model: gps}"), AllOf(HasSubstr("odometry"), HasSubstr("t265, mavros or none")));
  EXPECT_THAT(error("yaw: 30", "yaw: 30\nodometry: {sed: 1}"), AllOf(HasSubstr("p.yaml:6"), HasSubstr("sed"), HasSubstr("unknown key")));
  EXPECT_THAT(error("1.6", "1e-6"), AllOf(HasSubstr("p.yaml:4"), HasSubstr("speed_mps"), HasSubstr("at most a day")));
  EXPECT_THAT(error("yaw: 30", "yaw: 30\nduration_s: 1e6"), AllOf(HasSubstr("p.yaml:6"), HasSubstr("duration_s"), HasSubstr("day")));
  EXPECT_THAT(error("yaw: 30", "yaw: 30\norigin: {latitude_deg: 95, longitude_deg: 0}"), AllOf(HasSubstr("p.yaml:6"), HasSubstr("latitude_deg")));
  EXPECT_THAT(error("yaw: 30", "yaw: 30\nduration_s: 0"), AllOf(HasSubstr("duration_s"), HasSubstr("> 0")));
}

TEST(FlightPath, EveryShippedPathLoads) {
  int count = 0;
  for (const auto& entry : std::filesystem::directory_iterator(std::string(DENDRO_SOURCE_DIR) + "/config/paths")) {
    if (entry.path().extension() != ".yaml") continue;
    const FlightPath path = LoadFlightPath(entry.path().string());
    EXPECT_GT(path.duration_s, 10.0) << entry.path();
    EXPECT_LT(path.duration_s, 200.0) << entry.path();
    EXPECT_LT(LargestTwistJump(path), 0.02) << entry.path();
    ++count;
  }
  EXPECT_GE(count, 6);
}

TEST(Trajectory, RefusesWhatIsNotAMotion) {
  EXPECT_THROW(Trajectory({}), std::invalid_argument);
  EXPECT_THROW(Trajectory({{0.0, Eigen::Isometry3d::Identity()}, {0.0, Eigen::Isometry3d::Identity()}}), std::invalid_argument);
  EXPECT_THROW(Trajectory({{std::nan(""), Eigen::Isometry3d::Identity()}}), std::invalid_argument);
  const Trajectory still({{1.0, Eigen::Isometry3d(Eigen::Translation3d(1, 2, 3))}});
  EXPECT_TRUE(still.Pose(-5.0).translation().isApprox(Eigen::Vector3d(1, 2, 3)));
  EXPECT_EQ(still.Twist(1.0).norm(), 0.0);
}

class Odometry : public ::testing::Test {
 protected:
  FlightPath path_ = ParseFlightPath(
      "type: quadrangle\nside_m: 10\naltitudes_m: [1.5, 3, 4.5, 6]\nspeed_mps: 1.5\nlook_at: [0, 0, 1]\n", "p.yaml");

  std::vector<OdometrySample> Simulate(const OdometrySimulatorConfig& config) const {
    return SimulateOdometry(path_.trajectory, path_.duration_s, path_.start_stamp_ns, config);
  }
  Eigen::Isometry3d Truth(const OdometrySample& s) const {
    return path_.trajectory.Pose(static_cast<double>(s.stamp_ns - path_.start_stamp_ns) * 1e-9);
  }
  double Distance() const {
    double distance = 0.0;
    for (double t = 0.05; t < path_.duration_s; t += 0.05) {
      distance += (path_.trajectory.Pose(t).translation() - path_.trajectory.Pose(t - 0.05).translation()).norm();
    }
    return distance;
  }
  static OdometrySimulatorConfig Perfect() {
    OdometrySimulatorConfig config;
    config.Visit([](const char* name, auto& value) {
      using T = std::decay_t<decltype(value)>;
      const std::string key = name;
      if constexpr (std::is_same_v<T, double>) {
        if (key != "rate_hz" && key != "tilt_time_s" && key != "drift_length_m" && key != "mavros_correlation_s") value = 0.0;
      }
    });
    return config;
  }
};

TEST_F(Odometry, WithoutErrorsItIsTheTruthFromTheStart) {
  const auto samples = Simulate(Perfect());
  ASSERT_NEAR(static_cast<double>(samples.size()), 200.0 * path_.duration_s, 1.5);
  EXPECT_LT(samples[0].T_odom_base.translation().norm(), 1e-12);
  EXPECT_NEAR(Yaw(samples[0].T_odom_base), 0.0, 1e-12);
  const Eigen::Isometry3d T_map_odom = Truth(samples[0]) * samples[0].T_odom_base.inverse();
  for (std::size_t i = 0; i < samples.size(); i += 97) {
    EXPECT_EQ(samples[i].stamp_ns, path_.start_stamp_ns + static_cast<std::int64_t>(i) * 5000000);
    EXPECT_TRUE((T_map_odom * samples[i].T_odom_base).isApprox(Truth(samples[i]), 1e-9));
  }
  OdometrySimulatorConfig mavros = Perfect();
  mavros.model = "mavros";
  const auto world = Simulate(mavros);
  for (std::size_t i = 0; i < world.size(); i += 97) EXPECT_TRUE(world[i].T_odom_base.isApprox(Truth(world[i]), 1e-9));
}

TEST_F(Odometry, TheScaleErrorStretchesTheWay) {
  OdometrySimulatorConfig config = Perfect();
  config.scale_error = 0.02;
  const auto samples = Simulate(config);
  const Eigen::Isometry3d T_map_odom = Truth(samples[0]) * samples[0].T_odom_base.inverse();
  const Eigen::Vector3d truth = Truth(samples.back()).translation() - Truth(samples[0]).translation();
  const Eigen::Vector3d measured = T_map_odom.linear() * (samples.back().T_odom_base.translation() - samples[0].T_odom_base.translation());
  EXPECT_TRUE(measured.isApprox(1.02 * truth, 1e-6));
}

// The thesis' flight over many seeds: error of the relative translation over pieces of way, and of the
// place at the end, both over the way travelled.
TEST_F(Odometry, TheDefaultDriftOfTheThesisFlightIsAboutOnePercentOfTheWay) {
  const FlightPath path =
      LoadFlightPath(std::string(DENDRO_SOURCE_DIR) + "/config/paths/thesis_quadrangle.yaml");
  constexpr int kSeeds = 40;
  constexpr std::array<double, 4> kPiecesM = {10.0, 20.0, 40.0, 80.0};
  std::array<double, 4> square{}, count{};
  double end_square = 0.0, distance = 0.0;
  for (int seed = 1; seed <= kSeeds; ++seed) {
    OdometrySimulatorConfig config = path.odometry;
    config.rate_hz = 20.0;
    config.seed = seed;
    const auto samples = SimulateOdometry(path.trajectory, path.duration_s, path.start_stamp_ns, config);
    std::vector<Eigen::Isometry3d> truth;
    std::vector<double> way = {0.0};
    for (const OdometrySample& s : samples) {
      truth.push_back(path.trajectory.Pose(static_cast<double>(s.stamp_ns - path.start_stamp_ns) * 1e-9));
      if (truth.size() > 1) {
        way.push_back(way.back() + (truth.back().translation() - truth[truth.size() - 2].translation()).norm());
      }
    }
    distance = way.back();
    for (std::size_t k = 0; k < kPiecesM.size(); ++k) {
      for (std::size_t i = 0; i < samples.size(); i += 40) {
        const auto j = static_cast<std::size_t>(
            std::lower_bound(way.begin(), way.end(), way[i] + kPiecesM[k]) - way.begin());
        if (j >= samples.size()) break;
        const Eigen::Isometry3d error = (truth[i].inverse() * truth[j]).inverse() *
                                        (samples[i].T_odom_base.inverse() * samples[j].T_odom_base);
        square[k] += std::pow(error.translation().norm() / kPiecesM[k], 2);
        count[k] += 1.0;
      }
    }
    const Eigen::Vector3d end =
        (truth[0] * samples[0].T_odom_base.inverse() * samples.back().T_odom_base).translation();
    end_square += std::pow((end - truth.back().translation()).norm() / distance, 2) / kSeeds;
  }
  EXPECT_NEAR(distance, 159.0, 1.0);  // Rounded corners are shorter than 5 laps of 32 m.
  for (std::size_t k = 0; k < kPiecesM.size(); ++k) {
    const double ratio = std::sqrt(square[k] / count[k]);
    std::printf("pieces of %2.0f m: %.2f %% of the way\n", kPiecesM[k], 100.0 * ratio);
    EXPECT_NEAR(ratio, 0.010, 0.003) << kPiecesM[k];
  }
  std::printf("at the end of %.0f m: %.2f %% of the way\n", distance, 100.0 * std::sqrt(end_square));
  EXPECT_NEAR(std::sqrt(end_square), 0.010, 0.004);
}

TEST_F(Odometry, CovarianceIsTheDriversAndDoesNotTellTheDrift) {
  const auto samples = Simulate(OdometrySimulatorConfig());
  Vector6d expected;
  expected << 0.01, 0.01, 0.01, 1e-4, 1e-4, 1e-4;  // Confidence 3.
  EXPECT_TRUE(samples.front().pose_covariance.diagonal().isApprox(expected));
  EXPECT_EQ(samples.front().pose_covariance, samples.back().pose_covariance);
}

TEST_F(Odometry, MavrosStaysBounded) {
  OdometrySimulatorConfig config;
  config.model = "mavros";
  double square = 0.0, worst = 0.0;
  const auto samples = Simulate(config);
  for (const OdometrySample& s : samples) {
    const double e = (s.T_odom_base.translation() - Truth(s).translation()).norm();
    square += e * e;
    worst = std::max(worst, e);
  }
  EXPECT_LT(worst, 5 * 0.05 * std::sqrt(3.0));
  EXPECT_GT(std::sqrt(square / static_cast<double>(samples.size())), 0.01);
}

TEST_F(Odometry, JumpsAndLossesHappenWhenAskedFor) {
  OdometrySimulatorConfig config = Perfect();
  config.jump_interval_s = 10.0;
  config.jump_position_m = 0.5;
  config.loss_interval_s = 20.0;
  config.loss_duration_s = 1.0;
  const auto samples = Simulate(config);
  int jumps = 0, gaps = 0;
  for (std::size_t i = 1; i < samples.size(); ++i) {
    const double dt = static_cast<double>(samples[i].stamp_ns - samples[i - 1].stamp_ns) * 1e-9;
    if (dt > 0.5) {
      ++gaps;
    } else if ((samples[i].T_odom_base.translation() - samples[i - 1].T_odom_base.translation()).norm() > 0.1) {
      ++jumps;
    }
  }
  EXPECT_GT(jumps, 2);
  EXPECT_GT(gaps, 1);
}

TEST_F(Odometry, OneJumpAndOneLossHappenWhenTheyShould) {
  OdometrySimulatorConfig config = Perfect();
  config.jump_time_s = 12.0;
  config.jump_distance_m = 0.5;
  config.loss_time_s = 30.0;
  config.loss_duration_s = 5.0;
  const auto samples = Simulate(config);
  int jumps = 0, gaps = 0;
  for (std::size_t i = 1; i < samples.size(); ++i) {
    const double time_s = static_cast<double>(samples[i].stamp_ns - path_.start_stamp_ns) * 1e-9;
    const double dt = static_cast<double>(samples[i].stamp_ns - samples[i - 1].stamp_ns) * 1e-9;
    const Eigen::Isometry3d moved = samples[i - 1].T_odom_base.inverse() * samples[i].T_odom_base;
    const Eigen::Isometry3d really = Truth(samples[i - 1]).inverse() * Truth(samples[i]);
    const double off = (moved.translation() - really.translation()).norm();
    if (off > 0.01) {
      ++jumps;
      EXPECT_NEAR(time_s, 12.0, 0.006);
      EXPECT_NEAR(off, 0.5, 1e-9);
    }
    if (dt > 0.006) {
      ++gaps;
      EXPECT_NEAR(time_s, 35.0, 0.006);
      EXPECT_NEAR(dt, 5.0, 0.006);
    }
  }
  EXPECT_EQ(jumps, 1);
  EXPECT_EQ(gaps, 1);
}

TEST_F(Odometry, PiecesMakeTheWholeAndSeedsDiffer) {
  const OdometrySimulatorConfig config;
  const auto whole = Simulate(config);
  OdometrySimulator simulator(path_.trajectory, path_.start_stamp_ns, config);
  std::vector<OdometrySample> pieces;
  for (double t = 0.1; t < path_.duration_s + 0.1; t += 0.1) {
    for (const OdometrySample& s : simulator.AdvanceTo(std::min(t, path_.duration_s))) pieces.push_back(s);
  }
  ASSERT_EQ(pieces.size(), whole.size());
  for (std::size_t i = 0; i < whole.size(); i += 31) {
    EXPECT_EQ(pieces[i].stamp_ns, whole[i].stamp_ns);
    EXPECT_EQ(pieces[i].T_odom_base.matrix(), whole[i].T_odom_base.matrix());
  }
  OdometrySimulatorConfig other;
  other.seed = 2;
  EXPECT_NE(Simulate(other).back().T_odom_base.matrix(), whole.back().T_odom_base.matrix());
  other.model = "none";
  EXPECT_TRUE(Simulate(other).empty());
  other.model = "gps";
  EXPECT_THROW(other.Validate(), std::invalid_argument);
}

}  // namespace
}  // namespace dendro
