#include <algorithm>
#include <cmath>
#include <cstdint>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include <gtest/gtest.h>

#include "dendro_slam/sensors/scan_assembler.h"
#include "dendro_slam/sensors/vlp16_decoder.h"
#include "dendro_slam/sensors/vlp16_encoder.h"
#include "dendro_slam/sim/lidar_simulator.h"
#include "dendro_slam/sim/scene.h"

// The simulator's revolutions as packets, through the decoder, against the simulator's own points.
namespace dendro {
namespace {

// A returned point with its place in the sensor's time.
struct Point {
  std::int64_t stamp_ns;
  LidarPoint point;
};

void Append(const LidarScan& scan, std::vector<Point>& out) {
  for (const LidarPoint& p : scan.points) {
    out.push_back({scan.stamp_ns + std::llround(static_cast<double>(p.time_s) * 1e9), p});
  }
}

struct Case {
  const char* return_mode;
  ReturnMode mode;
  double rpm;
  double cut_azimuth_deg;
};

void PrintTo(const Case& c, std::ostream* out) {
  *out << c.return_mode << " at " << c.rpm << " rpm, cut at " << c.cut_azimuth_deg;
}

class SimulatedPackets : public ::testing::TestWithParam<Case> {};

TEST_P(SimulatedPackets, ComeBackAsTheSimulatorsPoints) {
  const Case& c = GetParam();
  const Scene scene = LoadScene(std::string(DENDRO_SOURCE_DIR) + "/config/scenes/thesis_tree.yaml");
  const Raycaster raycaster(scene);
  LidarSimulatorConfig config;
  config.rpm = c.rpm;
  config.return_mode = c.return_mode;
  config.sub_rays_width = 4;  // Enough for two returns at the edges of the branches.
  config.sub_rays_height = 1;
  // 2024-05-01 09:59:59.9 UTC: the sensor's hour wraps on the way.
  const LidarSimulator simulator(raycaster, config, 1714557599900000000LL);
  // The sensor walks past the tree and turns, so that its own sweep is distorted.
  const LidarPoseFunction pose = [](std::int64_t stamp_ns) {
    const double t = 1e-9 * static_cast<double>(stamp_ns - 1714557599900000000LL);
    Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
    T.translation() = Eigen::Vector3d(-4.0 + 1.0 * t, 1.0, 1.5);
    T.rotate(Eigen::AngleAxisd(0.5 * t, Eigen::Vector3d(0.1, 0.1, 1.0).normalized()));
    return T;
  };

  constexpr int kRevolutions = 4;
  Vlp16Encoder encoder(c.mode);
  Vlp16Decoder decoder;
  ScanAssemblerConfig assembler_config;
  assembler_config.cut_azimuth_deg = c.cut_azimuth_deg;
  ScanAssembler assembler(assembler_config);
  std::vector<Point> truth;
  std::vector<Point> decoded;
  std::vector<std::size_t> truth_sizes;
  std::vector<LidarScan> scans;
  std::vector<Vlp16Firing> firings;
  std::int64_t encoded_until_ns = 0;
  for (int i = 0; i < kRevolutions; ++i) {
    const SimulatedScan scan = simulator.SimulateScan(i, pose);
    Append(scan.scan, truth);
    truth_sizes.push_back(scan.scan.points.size());
    for (const RawFiring& firing : scan.firings) {
      const auto packet = encoder.Add(firing);
      if (!packet) continue;
      encoded_until_ns = packet->stamp_ns;
      firings.clear();
      ASSERT_EQ(decoder.DecodeData(packet->data.data(), packet->data.size(), packet->stamp_ns,
                                   firings),
                Vlp16Decoder::Status::kDecoded);
      for (const Vlp16Firing& f : firings) {
        if (auto done = assembler.Add(f)) scans.push_back(std::move(*done));
      }
    }
  }
  if (auto done = assembler.Flush()) scans.push_back(std::move(*done));
  for (const LidarScan& scan : scans) Append(scan, decoded);
  // The last firings do not fill a packet.
  while (!truth.empty() && truth.back().stamp_ns >= encoded_until_ns) truth.pop_back();

  ASSERT_GT(truth.size(), 5000U);
  ASSERT_EQ(decoded.size(), truth.size());
  double range_off_m = 0.0;
  double angle_off_deg = 0.0;
  double time_off_ns = 0.0;
  std::size_t second_returns = 0;
  for (std::size_t i = 0; i < truth.size(); ++i) {
    const LidarPoint& p = decoded[i].point;
    const LidarPoint& q = truth[i].point;
    ASSERT_EQ(p.ring, q.ring) << i;
    ASSERT_EQ(p.intensity, q.intensity) << i;
    const Eigen::Vector3d origin(0.0, 0.0, vlp16::RingVerticalOffsetM(p.ring));
    const Eigen::Vector3d a = p.position.cast<double>() - origin;
    const Eigen::Vector3d b = q.position.cast<double>() - origin;
    range_off_m = std::max(range_off_m, std::abs(a.norm() - b.norm()));
    angle_off_deg = std::max(angle_off_deg, std::atan2(a.cross(b).norm(), a.dot(b)) * 180.0 / M_PI);
    time_off_ns = std::max(
        time_off_ns, std::abs(static_cast<double>(decoded[i].stamp_ns - truth[i].stamp_ns)));
    second_returns += i > 0 && truth[i].stamp_ns == truth[i - 1].stamp_ns ? 1 : 0;
  }
  EXPECT_LE(range_off_m, 0.002);
  EXPECT_LE(angle_off_deg, 0.02);
  EXPECT_LE(time_off_ns, 1000.0);
  if (c.mode == ReturnMode::kDual) {
    EXPECT_GT(second_returns, 10U);
  } else {
    EXPECT_EQ(second_returns, 0U);
  }
  EXPECT_EQ(decoder.counters().lost, 0U);
  EXPECT_EQ(decoder.counters().bad_blocks, 0U);
  EXPECT_EQ(decoder.counters().decoded, decoder.counters().packets);

  // Cut where the simulator cuts, whole revolutions have its points. A cut can only lie at a measured
  // azimuth, every other firing, so one firing may change sides.
  if (c.cut_azimuth_deg == 0.0) {
    ASSERT_EQ(scans.size(), static_cast<std::size_t>(kRevolutions));
    for (std::size_t i = 0; i + 1 < scans.size(); ++i) {
      EXPECT_NEAR(static_cast<double>(scans[i].points.size()), static_cast<double>(truth_sizes[i]),
                  2.0 * vlp16::kLasers);
    }
  } else {
    EXPECT_EQ(scans.size(), static_cast<std::size_t>(kRevolutions) + 1);
  }
  std::printf("%zu points, range within %.4f m, angle within %.4f degrees, time within %.0f ns\n",
              truth.size(), range_off_m, angle_off_deg, time_off_ns);
}

INSTANTIATE_TEST_SUITE_P(
    ModesAndSpeeds, SimulatedPackets,
    ::testing::Values(Case{"strongest", ReturnMode::kStrongest, 300.0, 0.0},
                      Case{"strongest", ReturnMode::kStrongest, 600.0, 123.4},
                      Case{"strongest", ReturnMode::kStrongest, 1200.0, 0.0},
                      Case{"last", ReturnMode::kLast, 300.0, 350.0},
                      Case{"last", ReturnMode::kLast, 600.0, 0.0},
                      Case{"last", ReturnMode::kLast, 1200.0, 180.0},
                      Case{"dual", ReturnMode::kDual, 300.0, 0.0},
                      Case{"dual", ReturnMode::kDual, 600.0, 0.05},
                      Case{"dual", ReturnMode::kDual, 1200.0, 0.0}));

}  // namespace
}  // namespace dendro
