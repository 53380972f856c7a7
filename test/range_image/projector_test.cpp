#include "dendro_slam/range_image/projector.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>
#include <set>
#include <stdexcept>

#include <gtest/gtest.h>

#include "dendro_slam/sensors/vlp16_model.h"

namespace dendro {
namespace {

using Reach = double (*)(double azimuth_deg, int ring);  // Range [m], 0 for none.

struct SweepOptions {
  double rpm = 600.0;
  double start_deg = 123.45;
  double quantum_deg = 0.0;  ///< Rounds the firing azimuths as packets do.
  double duration_s = 0.1;
};

// A revolution as a VLP-16 fires it.
LidarScan Sweep(Reach reach, const SweepOptions& options = SweepOptions()) {
  LidarScan scan;
  scan.stamp_ns = 1000;
  const double rate = vlp16::AzimuthRateDegPerS(options.rpm);
  const int firings = static_cast<int>(options.duration_s / vlp16::kFiringPeriodS);
  for (int n = 0; n < firings; ++n) {
    double firing_deg = options.start_deg + n * vlp16::FiringPitchDeg(options.rpm);
    if (options.quantum_deg > 0) {
      firing_deg = std::round(firing_deg / options.quantum_deg) * options.quantum_deg;
    }
    for (int laser = 0; laser < vlp16::kLasers; ++laser) {
      const double azimuth =
          vlp16::WrapAzimuthDeg(firing_deg + rate * vlp16::LaserTimeS(laser));
      const int ring = vlp16::RingOfLaser(laser);
      const double range = reach(azimuth, ring);
      if (range <= 0.0) continue;
      LidarPoint point;
      point.position = vlp16::PointAt(laser, azimuth, range).cast<float>();
      point.time_s =
          static_cast<float>(n * vlp16::kFiringPeriodS + vlp16::LaserTimeS(laser));
      point.ring = static_cast<std::uint16_t>(ring);
      point.intensity = static_cast<float>(ring);
      scan.points.push_back(point);
    }
  }
  return scan;
}

double Everywhere(double, int ring) { return 5.0 + 0.1 * ring; }
// A trunk 2.4 degrees wide at azimuth 40, and a post across azimuth 0.
double TrunkAndPost(double azimuth, int) {
  if (std::abs(azimuth - 40.0) < 1.2) return 5.0;
  if (azimuth < 3.0 || azimuth > 358.0) return 8.0;
  return 0.0;
}
double Nothing(double, int) { return 0.0; }

int Returns(const RangeImage& image) {
  int n = 0;
  for (std::size_t i = 0; i < image.size(); ++i) n += image.HasReturn(i) ? 1 : 0;
  return n;
}

TEST(Vlp16Model, ByHand) {
  EXPECT_DOUBLE_EQ(vlp16::RingElevationDeg(0), -15.0);
  EXPECT_DOUBLE_EQ(vlp16::RingElevationDeg(15), 15.0);
  for (int laser = 0; laser < 16; ++laser) {
    EXPECT_EQ(vlp16::LaserOfRing(vlp16::RingOfLaser(laser)), laser);
    EXPECT_DOUBLE_EQ(vlp16::RingElevationDeg(vlp16::RingOfLaser(laser)),
                     vlp16::kElevationDeg[static_cast<std::size_t>(laser)]);
    // All beams cross at one distance from the axis.
    const double e = vlp16::kElevationDeg[static_cast<std::size_t>(laser)] * vlp16::kDegToRad;
    EXPECT_NEAR(-vlp16::kVerticalOffsetM[static_cast<std::size_t>(laser)] / std::tan(e), 0.0418,
                0.002);
  }
  EXPECT_TRUE(vlp16::Direction(0, 0).isApprox(Eigen::Vector3d(1, 0, 0), 1e-12));
  EXPECT_TRUE(vlp16::Direction(90, 0).isApprox(Eigen::Vector3d(0, -1, 0), 1e-12));
  EXPECT_DOUBLE_EQ(vlp16::AzimuthDegOf(0, 1), 270.0);
  EXPECT_DOUBLE_EQ(vlp16::WrapAzimuthDeg(-1e-20), 0.0);
  EXPECT_NEAR(vlp16::FiringPitchDeg(600), 0.1990656, 1e-12);
  EXPECT_EQ(vlp16::ColumnsPerRevolution(600), 1800);
  EXPECT_EQ(vlp16::ColumnsPerRevolution(1200), 896);
}

TEST(Projector, EveryReturnFindsItsPixel) {
  Projector projector;
  const LidarScan scan = Sweep(Everywhere);
  const RangeImage image = projector.Project(scan, nullptr);
  EXPECT_EQ(image.rows, 16);
  EXPECT_EQ(image.cols, 1800);
  EXPECT_FALSE(image.deskewed);
  ASSERT_EQ(image.pixel_of_point.size(), scan.points.size());
  int beyond = 0;
  for (std::size_t i = 0; i < scan.points.size(); ++i) {
    ASSERT_GE(image.pixel_of_point[i], 0);
    const std::size_t pixel = static_cast<std::size_t>(image.pixel_of_point[i]);
    EXPECT_EQ(pixel / 1800, scan.points[i].ring);
    ASSERT_TRUE(image.HasReturn(pixel));
    const double azimuth =
        vlp16::AzimuthDegOf(scan.points[i].position.x(), scan.points[i].position.y()) -
        3600.0 * vlp16::RingTimeS(scan.points[i].ring);
    double off = azimuth * 5.0 - (static_cast<double>(pixel % 1800) + 0.5);
    off -= 1800.0 * std::round(off / 1800.0);
    EXPECT_LT(std::abs(off), 0.82);
    beyond += std::abs(off) > 0.52 ? 1 : 0;
    if (image.point_index[pixel] == static_cast<int>(i)) {
      EXPECT_EQ(image.intensity[pixel], scan.points[i].intensity);
      EXPECT_FLOAT_EQ(image.time_s[pixel], scan.points[i].time_s);
      EXPECT_TRUE(image.point[pixel].isApprox(
          image.beam_origin[pixel] + image.range[pixel] * image.beam_direction[pixel], 1e-5F));
      EXPECT_NEAR(image.range[pixel], 5.0 + 0.1 * scan.points[i].ring, 1e-4);
    }
  }
  EXPECT_EQ(Returns(image), 16 * 1800) << "a wall all around leaves no pixel empty";
  // 1808 firings end 0.09 degrees before the revolution does, so at the seam a column is stepped
  // over; the firings after it lie a little beyond their columns until the first shared one.
  EXPECT_LT(beyond, 16 * 80);
  EXPECT_EQ(projector.report().filled_columns, 0);
  EXPECT_EQ(projector.report().hidden_points,
            static_cast<int>(scan.points.size()) - 16 * 1800);
  EXPECT_NEAR(projector.report().rpm, 600.0, 0.1);
  EXPECT_FALSE(projector.report().ring_derived);
  EXPECT_FALSE(projector.report().time_derived);
}

// No false misses in a wall, whatever the speed, start and rounding; and what is doubled is rare.
TEST(Projector, WallHasNoHoles) {
  for (const double quantum : {0.0, 0.01}) {
    for (const double rpm : {592.0, 597.0, 599.9, 600.0, 601.3, 603.0, 606.0}) {
      for (const double start : {0.0, 0.1, 77.777, 359.95}) {
        SweepOptions options;
        options.rpm = rpm;
        options.start_deg = start;
        options.quantum_deg = quantum;
        options.duration_s = 60.0 / rpm + 2e-4;
        Projector projector;
        const RangeImage image = projector.Project(Sweep(Everywhere, options), nullptr);
        EXPECT_EQ(Returns(image), 16 * 1800) << rpm << " " << start << " " << quantum;
        EXPECT_LE(projector.report().filled_columns, rpm > 602.0 ? 25 : 3)
            << rpm << " " << start << " " << quantum;
      }
    }
  }
}

TEST(Projector, TurnsFasterThanItsColumns) {
  SweepOptions options;
  options.rpm = 1200.0;
  options.duration_s = 0.0505;
  ProjectorConfig config;
  config.rpm = 1200.0;
  Projector projector(config);
  const RangeImage image = projector.Project(Sweep(Everywhere, options), nullptr);
  EXPECT_EQ(Returns(image), 16 * 1800);
  EXPECT_NEAR(projector.report().filled_columns, 1800 - 904, 12);

  config.cols = vlp16::ColumnsPerRevolution(1200);
  Projector fitting(config);
  EXPECT_EQ(Returns(fitting.Project(Sweep(Everywhere, options), nullptr)), 16 * config.cols);
  EXPECT_EQ(fitting.report().filled_columns, 0);
}

// The beams that missed are the beams that were fired: predicted for every firing of a sweep in
// which only a trunk and a post came back.
TEST(Projector, MissingPixelsHoldTheBeamThatWasFired) {
  const SweepOptions options;
  const LidarScan scan = Sweep(TrunkAndPost, options);
  const LidarScan full = Sweep(Everywhere, options);
  Projector projector;
  const RangeImage image = projector.Project(scan, nullptr);
  double worst = 0.0;
  int compared = 0;
  std::vector<double> nearest(image.size(), 1e9);
  for (const LidarPoint& point : full.points) {
    const Eigen::Vector3f origin(0, 0, static_cast<float>(vlp16::RingVerticalOffsetM(point.ring)));
    const Eigen::Vector3f direction = (point.position - origin).normalized();
    const double firing_deg = vlp16::WrapAzimuthDeg(
        vlp16::AzimuthDegOf(point.position.x(), point.position.y()) -
        3600.0 * vlp16::RingTimeS(point.ring));
    for (int d = -1; d <= 1; ++d) {
      const std::size_t pixel =
          image.Index(point.ring, image.WrapColumn(static_cast<int>(firing_deg * 5.0) + d));
      if (image.HasReturn(pixel)) continue;
      const double angle = (image.beam_direction[pixel] - direction).norm() / vlp16::kDegToRad;
      nearest[pixel] = std::min(nearest[pixel], angle);
    }
  }
  for (std::size_t pixel = 0; pixel < image.size(); ++pixel) {
    EXPECT_NEAR(image.beam_direction[pixel].norm(), 1.0, 1e-5);
    if (image.HasReturn(pixel)) continue;
    EXPECT_TRUE(std::isnan(image.range[pixel]));
    EXPECT_TRUE(image.point[pixel].hasNaN());
    EXPECT_EQ(image.intensity[pixel], 0.0F);
    EXPECT_FLOAT_EQ(image.beam_origin[pixel].z(),
                    static_cast<float>(vlp16::RingVerticalOffsetM(
                        static_cast<int>(pixel) / image.cols)));
    // Away from the sweep's seam, where the firings start anew.
    const int col = static_cast<int>(pixel) % image.cols;
    if (std::abs(col - 123.45 * 5) < 200 || std::abs(col - 617 - 900) < 800) continue;
    worst = std::max(worst, nearest[pixel]);
    ++compared;
  }
  EXPECT_GT(compared, 3000);
  EXPECT_LT(worst, 0.02);
}

TEST(Projector, TheTrunkIsWholeAndItsNeighboursMiss) {
  Projector projector;
  const LidarScan scan = Sweep(TrunkAndPost);
  const RangeImage image = projector.Project(scan, nullptr);
  for (int row = 0; row < 16; ++row) {
    int first = -1;
    int last = -1;
    int hits = 0;
    for (int col = 150; col < 250; ++col) {
      if (!image.HasReturn(image.Index(row, col))) continue;
      if (first < 0) first = col;
      last = col;
      ++hits;
    }
    EXPECT_EQ(hits, last - first + 1) << "row " << row;
    EXPECT_NEAR(hits, 12, 1);
    // The post across azimuth 0.
    EXPECT_TRUE(image.HasReturn(image.Index(row, 0)));
    EXPECT_TRUE(image.HasReturn(image.Index(row, 1799)));
  }
}

TEST(Projector, RemovesTheMotionOfTheSweep) {
  Vector6d twist;
  twist << 0.1, -0.2, 1.0, 1.5, 0.5, 0.2;
  const SweepMotion motion = SweepMotion::ConstantVelocity(twist, 0.0, 0.1);
  const LidarScan scan = Sweep(TrunkAndPost);
  Projector projector;
  RangeImage raw = projector.Project(scan, nullptr);
  RangeImage image;
  projector.Project(scan, &motion, image);
  EXPECT_TRUE(image.deskewed);
  EXPECT_EQ(image.point_index, raw.point_index);
  EXPECT_EQ(image.pixel_of_point, raw.pixel_of_point);
  for (std::size_t pixel = 0; pixel < image.size(); ++pixel) {
    const Eigen::Isometry3d T = ExpSe3(twist * raw.time_s[pixel]);
    if (raw.time_s[pixel] < 0.0F || raw.time_s[pixel] > 0.1F) continue;
    EXPECT_LT((image.beam_origin[pixel].cast<double>() -
               T * raw.beam_origin[pixel].cast<double>()).norm(), 1e-5);
    EXPECT_LT((image.beam_direction[pixel].cast<double>() -
               T.linear() * raw.beam_direction[pixel].cast<double>()).norm(), 1e-5);
    if (!image.HasReturn(pixel)) continue;
    EXPECT_EQ(image.range[pixel], raw.range[pixel]);
    EXPECT_LT((image.point[pixel].cast<double>() -
               T * raw.point[pixel].cast<double>()).norm(), 1e-4);
  }
}

TEST(Projector, DualReturnsShareThePixel) {
  LidarScan scan = Sweep(TrunkAndPost);
  const std::size_t n = scan.points.size();
  for (std::size_t i = 0; i < n; ++i) {
    LidarPoint far = scan.points[i];
    far.position *= 2.0F;
    scan.points.push_back(far);
  }
  std::mt19937 rng(7);
  std::shuffle(scan.points.begin(), scan.points.end(), rng);
  Projector projector;
  const RangeImage image = projector.Project(scan, nullptr);
  for (std::size_t i = 0; i < scan.points.size(); ++i) {
    ASSERT_GE(image.pixel_of_point[i], 0);
    const std::size_t pixel = static_cast<std::size_t>(image.pixel_of_point[i]);
    EXPECT_LT(image.range[pixel], 8.1F);
  }
}

// The same image in whatever order the returns come, and without rings and times nearly the same.
TEST(Projector, OrderDoesNotMatterAndRingsAndTimesCanBeDerived) {
  const LidarScan scan = Sweep(Everywhere);
  Projector projector;
  const RangeImage image = projector.Project(scan, nullptr);

  LidarScan by_ring = scan;
  std::stable_sort(by_ring.points.begin(), by_ring.points.end(),
                   [](const LidarPoint& a, const LidarPoint& b) { return a.ring < b.ring; });
  const RangeImage sorted = projector.Project(by_ring, nullptr);
  EXPECT_EQ(sorted.range, image.range);
  EXPECT_EQ(sorted.time_s, image.time_s);

  for (LidarScan bare : {scan, by_ring}) {
    bare.has_ring = false;
    bare.has_time = false;
    for (LidarPoint& p : bare.points) {
      p.ring = 0;
      p.time_s = 0.0F;
    }
    const RangeImage derived = projector.Project(bare, nullptr);
    EXPECT_TRUE(projector.report().ring_derived);
    EXPECT_TRUE(projector.report().time_derived);
    EXPECT_EQ(derived.range, image.range);
    for (std::size_t i = 0; i < image.size(); ++i) {
      EXPECT_NEAR(derived.time_s[i], image.time_s[i], 1e-4);
    }
  }
}

TEST(Projector, SkipsWhatIsNoReturn) {
  LidarScan scan = Sweep(TrunkAndPost);
  const std::size_t n = scan.points.size();
  LidarPoint bad;
  bad.position = Eigen::Vector3f::Constant(std::numeric_limits<float>::quiet_NaN());
  scan.points.push_back(bad);
  bad.position = Eigen::Vector3f(std::numeric_limits<float>::infinity(), 0, 0);
  scan.points.push_back(bad);
  bad.position = Eigen::Vector3f::Zero();
  scan.points.push_back(bad);
  bad.position = Eigen::Vector3f(5, 0, 0);
  bad.ring = 16;
  scan.points.push_back(bad);
  bad.ring = 7;
  bad.position = Eigen::Vector3f(0.01F, 0, 0);
  scan.points.push_back(bad);
  bad.position = Eigen::Vector3f(1e30F, 0, 0);
  scan.points.push_back(bad);
  bad.position = Eigen::Vector3f(5, 0, 0);
  bad.time_s = std::numeric_limits<float>::quiet_NaN();
  scan.points.push_back(bad);
  Projector projector;
  const RangeImage image = projector.Project(scan, nullptr);
  EXPECT_EQ(projector.report().nan_points, 4);
  EXPECT_EQ(projector.report().out_of_image, 3);
  for (std::size_t i = n; i < scan.points.size(); ++i) EXPECT_EQ(image.pixel_of_point[i], -1);

  const RangeImage empty = projector.Project(Sweep(Nothing), nullptr);
  EXPECT_EQ(Returns(empty), 0);
  EXPECT_TRUE(empty.beam_direction[empty.Index(7, 0)].isApprox(
      vlp16::Direction(0.1 + 3600 * vlp16::RingTimeS(7), -1.0).cast<float>(), 1e-6F));
  EXPECT_FALSE(projector.report().time_derived);
}

TEST(Projector, UniformModelOfTheThesis) {
  ProjectorConfig config;
  config.model = "uniform";
  config.rows = 32;
  config.cols = 360;
  Projector projector(config);
  EXPECT_DOUBLE_EQ(projector.RowElevationDeg(0), -15.0);
  EXPECT_DOUBLE_EQ(projector.RowElevationDeg(31), 15.0);
  const LidarScan scan = Sweep(Everywhere);
  const RangeImage image = projector.Project(scan, nullptr);
  std::set<std::size_t> rows;
  for (std::size_t i = 0; i < image.size(); ++i) {
    if (image.HasReturn(i)) rows.insert(i / 360);
  }
  EXPECT_EQ(rows.size(), 16U) << "half the rows of 32 stay empty";
  const std::size_t centre = image.Index(16, 90);
  EXPECT_TRUE(image.beam_direction[centre].isApprox(
      vlp16::Direction(90.5, projector.RowElevationDeg(16)).cast<float>(), 1e-5F));
}

TEST(Projector, SameInputSameBytesAndMemoryUsedAgain) {
  Projector a;
  Projector b;
  const LidarScan scan = Sweep(Everywhere);
  RangeImage image = a.Project(Sweep(TrunkAndPost), nullptr);
  const Eigen::Vector3f* memory = image.beam_origin.data();
  a.Project(scan, nullptr, image);
  EXPECT_EQ(image.beam_origin.data(), memory);
  const RangeImage other = b.Project(scan, nullptr);
  EXPECT_EQ(image.range, other.range);
  EXPECT_EQ(image.time_s, other.time_s);
  EXPECT_EQ(image.beam_direction, other.beam_direction);
}

TEST(Projector, ConfigNamesTheField) {
  const auto message = [](const ProjectorConfig& config) -> std::string {
    try {
      config.Validate();
    } catch (const std::invalid_argument& e) {
      return e.what();
    }
    return "";
  };
  ProjectorConfig config;
  config.rows = 32;
  EXPECT_NE(message(config).find("rows"), std::string::npos);
  config = ProjectorConfig();
  config.model = "hdl32";
  EXPECT_NE(message(config).find("model"), std::string::npos);
  config = ProjectorConfig();
  config.max_range_m = std::nan("");
  EXPECT_NE(message(config).find("max_range_m"), std::string::npos);
}

}  // namespace
}  // namespace dendro
