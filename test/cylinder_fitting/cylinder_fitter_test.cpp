#include "dendro_slam/cylinder_fitting/cylinder_fitter.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <random>
#include <stdexcept>

#include <Eigen/Eigenvalues>
#include <gtest/gtest.h>

#include "cone_scan.h"

namespace dendro {
namespace {

using dendro_test::SegmentOf;
using dendro_test::SimulateCones;
using dendro_test::TestCone;
using dendro_test::TestScan;
using dendro_test::TestSensor;
using Eigen::Vector3d;

TestCone Upright(double x, double y, double radius, double half_height = 1.2) {
  return {Vector3d(x, y, -half_height), Vector3d(x, y, half_height), radius, radius};
}

TEST(CylinderFitter, NoiseFreeTrunkIsExact) {
  TestSensor sensor;
  sensor.sigma = 0.0;
  const TestScan test = SimulateCones({Upright(5.0, 0.0, 0.15)}, sensor, 1);
  const FittedCylinder fit = CylinderFitter().FitSegment(test.scan, SegmentOf(test, 0));
  ASSERT_EQ(fit.status, FitStatus::kMeasured) << ToString(fit.reason);
  EXPECT_NEAR(fit.cylinder.radius(), 0.15, 0.001);
  EXPECT_NEAR(fit.cylinder.Foot().x(), 5.0, 0.002);
  EXPECT_NEAR(fit.cylinder.Foot().y(), 0.0, 0.001);
  EXPECT_GT(std::abs(fit.cylinder.axis.z()), 0.9999);
  EXPECT_NEAR(fit.distance_m, 5.0, 0.05);
  EXPECT_GT(fit.visible_arc_rad, 2.0);
  EXPECT_LE(fit.visible_arc_rad, M_PI);
}

TEST(CylinderFitter, ThinRaysWithoutFootprint) {
  TestSensor sensor;
  sensor.footprint = false;
  CylinderFitterConfig config;
  config.beam_exit_horizontal_m = config.beam_exit_vertical_m = 0.0;
  config.beam_divergence_horizontal_rad = config.beam_divergence_vertical_rad = 0.0;
  double sum = 0.0;
  for (unsigned seed = 1; seed <= 20; ++seed) {
    sensor.azimuth_offset_deg = 0.013 * seed;
    const TestScan test = SimulateCones({Upright(4.0, 1.0, 0.1)}, sensor, seed);
    const FittedCylinder fit = CylinderFitter(config).FitSegment(test.scan, SegmentOf(test, 0));
    ASSERT_EQ(fit.status, FitStatus::kMeasured) << ToString(fit.reason);
    sum += fit.cylinder.radius() - 0.1;
  }
  EXPECT_LT(std::abs(sum / 20.0), 0.001);
}

// Bias, scatter and calibration over random poses; the full table is fit_benchmark's.
TEST(CylinderFitter, BiasScatterAndCoverage) {
  const CylinderFitter fitter;
  std::mt19937 rng(42);
  std::uniform_real_distribution<double> u(-1.0, 1.0);
  for (const double radius : {0.05, 0.1, 0.3}) {
    double sum = 0.0, squares = 0.0;
    int n = 0, one_sigma = 0, two_sigma = 0;
    constexpr int kTrials = 40;
    for (int i = 0; i < kTrials; ++i) {
      const double azimuth = M_PI * u(rng);
      const Vector3d centre(5.0 * std::cos(azimuth), 5.0 * std::sin(azimuth), 0.3 * u(rng));
      const Vector3d axis = Vector3d(0.3 * u(rng), 0.3 * u(rng), 1.0).normalized();
      const TestScan test =
          SimulateCones({{centre - 1.2 * axis, centre + 1.2 * axis, radius, radius}}, TestSensor(),
                        static_cast<unsigned>(i));
      const FittedCylinder fit = fitter.FitSegment(test.scan, SegmentOf(test, 0));
      if (fit.status != FitStatus::kMeasured) continue;
      const double error = fit.cylinder.radius() - radius;
      ++n;
      sum += error;
      squares += error * error;
      one_sigma += std::abs(error) < fit.radius_sigma_m();
      two_sigma += std::abs(error) < 2.0 * fit.radius_sigma_m();
    }
    ASSERT_GE(n, kTrials - 1);
    EXPECT_LT(std::abs(sum / n), 0.01 * radius) << radius;
    EXPECT_LT(std::sqrt(squares / n), (radius < 0.06 ? 0.05 : radius < 0.2 ? 0.02 : 0.006) * radius);
    EXPECT_GE(one_sigma, n / 2) << radius;
    EXPECT_GE(two_sigma, n * 85 / 100) << radius;
  }
}

TEST(CylinderFitter, MarshallOnlyKeepsItsBias) {
  CylinderFitterConfig config;
  config.marshall_only = true;
  const CylinderFitter marshall(config), full;
  double plain = 0.0, better = 0.0;
  TestSensor sensor;
  sensor.sigma = 0.02;
  constexpr unsigned kTrials = 25;
  for (unsigned seed = 1; seed <= kTrials; ++seed) {
    sensor.azimuth_offset_deg = 0.0637 * seed;
    const TestScan test = SimulateCones({Upright(3.0, 0.0, 0.05)}, sensor, seed);
    plain += marshall.FitSegment(test.scan, SegmentOf(test, 0)).cylinder.radius() - 0.05;
    better += full.FitSegment(test.scan, SegmentOf(test, 0)).cylinder.radius() - 0.05;
  }
  EXPECT_GT(std::abs(plain / kTrials), 0.002) << "eq. 4.2 shrinks a thin branch in noise";
  EXPECT_LT(std::abs(better / kTrials), 0.0006);
}

TEST(CylinderFitter, TiltedBranchAndItsEnds) {
  const Vector3d axis = Vector3d(0.3, 0.8, 1.0).normalized();
  const Vector3d centre(4.0, -1.0, 0.2);
  const TestScan test =
      SimulateCones({{centre - 1.0 * axis, centre + 1.0 * axis, 0.08, 0.08}}, TestSensor(), 5);
  const FittedCylinder fit = CylinderFitter().FitSegment(test.scan, SegmentOf(test, 0));
  ASSERT_EQ(fit.status, FitStatus::kMeasured) << ToString(fit.reason);
  EXPECT_LT(fit.cylinder.axis.cross(axis).norm(), 0.03);
  EXPECT_NEAR(fit.cylinder.radius(), 0.08, 0.005);
  const double low = (fit.cylinder.point + fit.start_s_m * fit.cylinder.axis - centre).dot(axis);
  const double high = (fit.cylinder.point + fit.end_s_m * fit.cylinder.axis - centre).dot(axis);
  EXPECT_NEAR(std::min(low, high), -1.0, 3.0 * fit.end_sigma_m);
  EXPECT_NEAR(std::max(low, high), 1.0, 3.0 * fit.end_sigma_m);
  EXPECT_NEAR(fit.start_s_m, -fit.end_s_m, 1e-3) << "the anchor is the middle";
}

TEST(CylinderFitter, TaperIsFoundOnALongTrunk) {
  TestCone trunk = Upright(4.0, 0.5, 0.0, 1.5);
  trunk.base_radius = 0.24;
  trunk.tip_radius = 0.15;  // -0.03 m/m
  const TestScan test = SimulateCones({trunk}, TestSensor(), 9);
  const FittedCylinder fit = CylinderFitter().FitSegment(test.scan, SegmentOf(test, 0));
  ASSERT_EQ(fit.status, FitStatus::kMeasured) << ToString(fit.reason);
  ASSERT_TRUE(fit.taper_estimated);
  const double up = fit.cylinder.axis.z() > 0.0 ? 1.0 : -1.0;
  EXPECT_NEAR(up * fit.taper_m_per_m, -0.03, 4.0 * fit.taper_sigma_m_per_m);
  EXPECT_LT(up * fit.taper_m_per_m, -0.01);
  const double s = (fit.cylinder.point.z() + 1.5) / 3.0;
  EXPECT_NEAR(fit.cylinder.radius(), 0.24 - 0.09 * s, 0.003);
}

// A branch of 2.5 cm that sags by more than its radius: a straight cylinder covers or cuts the bow.
TEST(CylinderFitter, BentBranchHasTheRadiusOfAStraightOne) {
  constexpr double kRadius = 0.025, kBend = 0.3, kHalf = 0.55;
  const Vector3d along = Vector3d(0.1, 0.6, 0.8).normalized();
  const Vector3d sag = Vector3d::UnitX().cross(along).normalized();
  const CylinderFitter fitter;
  CylinderFitterConfig stiff_config;
  stiff_config.bend_sigma_per_m = 1e-3;
  const CylinderFitter stiff(stiff_config);
  double sum = 0.0, stiff_sum = 0.0;
  int n = 0, within = 0;
  for (unsigned seed = 1; seed <= 12; ++seed) {
    const Vector3d centre(3.5, 0.2 * seed - 1.0, 0.3);
    std::vector<TestCone> chain;
    constexpr int kPieces = 8;
    const auto at = [&](int i) {
      const double s = kHalf * (2.0 * i / kPieces - 1.0);
      return Vector3d(centre + s * along + 0.5 * kBend * s * s * sag);
    };
    for (int i = 0; i < kPieces; ++i) chain.push_back({at(i), at(i + 1), kRadius, kRadius});
    TestSensor sensor;
    sensor.azimuth_offset_deg = 0.0371 * seed;
    const TestScan test = SimulateCones(chain, sensor, seed);
    Segment segment;
    for (std::size_t i = 0; i < test.truth.size(); ++i) {
      if (test.truth[i] >= 0) segment.pixels.push_back(static_cast<std::int32_t>(i));
    }
    const FittedCylinder fit = fitter.FitSegment(test.scan, segment);
    if (fit.status != FitStatus::kMeasured) continue;
    ++n;
    sum += fit.cylinder.radius() - kRadius;
    within += std::abs(fit.cylinder.radius() - kRadius) < 2.0 * fit.radius_sigma_m();
    stiff_sum += stiff.FitSegment(test.scan, segment).cylinder.radius() - kRadius;
    // The line lies amid the branch.
    const Vector3d mean = centre + kBend * kHalf * kHalf / 6.0 * sag;
    EXPECT_LT((fit.cylinder.point - mean).cross(along).norm(), 0.012);
  }
  ASSERT_GE(n, 10);
  EXPECT_LT(std::abs(sum / n), 0.03 * kRadius);
  EXPECT_GE(within, n - 2);
  EXPECT_GT(std::abs(stiff_sum / n), 0.05 * kRadius);
}

TEST(CylinderFitter, AcrossTheColumnSeam) {
  // The same trunk ahead (columns 0 and 1799 both on it) and turned by a whole number of columns.
  const TestScan seam = SimulateCones({Upright(4.0, 0.0, 0.15)}, TestSensor(), 3);
  const Segment segment = SegmentOf(seam, 0);
  bool first = false, last = false;
  for (const std::int32_t p : segment.pixels) {
    first = first || p % 1800 == 0;
    last = last || p % 1800 == 1799;
  }
  ASSERT_TRUE(first && last);
  const FittedCylinder fit = CylinderFitter().FitSegment(seam.scan, segment);
  ASSERT_EQ(fit.status, FitStatus::kMeasured);
  EXPECT_NEAR(fit.cylinder.radius(), 0.15, 0.004);
}

TEST(CylinderFitter, HalvesSeenARevolutionApartAreLessSure) {
  TestScan test = SimulateCones({Upright(4.0, 0.0, 0.15)}, TestSensor(), 3);
  const Segment segment = SegmentOf(test, 0);
  const FittedCylinder at_once = CylinderFitter().FitSegment(test.scan, segment);
  for (std::size_t i = 0; i < test.scan.image.size(); ++i) {
    test.scan.image.time_s[i] = static_cast<float>(i % 1800) * 0.1F / 1800.0F;
  }
  const FittedCylinder apart = CylinderFitter().FitSegment(test.scan, segment);
  EXPECT_EQ(apart.cylinder.curvature, at_once.cylinder.curvature);
  const double half = 0.5 * CylinderFitterConfig().revolution_sigma_m;
  EXPECT_NEAR(apart.radius_sigma_m(), std::hypot(at_once.radius_sigma_m(), half), 1e-6);
}

// A branch that climbs by a quarter of a right angle: its silhouettes are seen along the rings only.
TEST(CylinderFitter, NearlyLevelBranchKeepsItsSilhouettes) {
  constexpr double kRadius = 0.035;
  const Vector3d along = Vector3d(0.05, 0.9, 0.45).normalized();
  double sum = 0.0;
  int n = 0;
  for (unsigned seed = 1; seed <= 10; ++seed) {
    const Vector3d centre(4.3, 0.15 * seed - 0.7, 0.1);
    TestSensor sensor;
    sensor.azimuth_offset_deg = 0.0371 * seed;
    const TestScan test = SimulateCones({{centre - 0.6 * along, centre + 0.6 * along, kRadius, kRadius}},
                                        sensor, seed);
    const FittedCylinder fit = CylinderFitter().FitSegment(test.scan, SegmentOf(test, 0));
    if (fit.status != FitStatus::kMeasured) continue;
    ++n;
    sum += fit.cylinder.radius() - kRadius;
  }
  ASSERT_GE(n, 8);
  EXPECT_LT(std::abs(sum / n), 0.08 * kRadius);
}

// The thesis' noise, even within 3 cm: no bias, and no more confidence than it deserves.
TEST(CylinderFitter, EvenNoiseOnALeaningBranch) {
  const CylinderFitter fitter;
  std::mt19937 rng(5);
  std::uniform_real_distribution<double> u(-1.0, 1.0);
  constexpr double kRadius = 0.1;
  constexpr int kTrials = 60;
  double sum = 0.0;
  int n = 0, one_sigma = 0, two_sigma = 0;
  for (int i = 0; i < kTrials; ++i) {
    const Vector3d axis = Vector3d(0.8 * u(rng), 0.8 + 0.6 * u(rng), 0.8).normalized();
    const Vector3d centre(4.5, 0.4 * u(rng), 0.2 * u(rng));
    TestSensor sensor;
    sensor.sigma = 0.0;
    sensor.uniform = 0.03;
    sensor.azimuth_offset_deg = 0.1 * u(rng);
    const TestScan test = SimulateCones({{centre - 0.8 * axis, centre + 0.8 * axis, kRadius, kRadius}},
                                        sensor, static_cast<unsigned>(i + 1));
    const FittedCylinder fit = fitter.FitSegment(test.scan, SegmentOf(test, 0));
    if (fit.status != FitStatus::kMeasured) continue;
    const double error = fit.cylinder.radius() - kRadius;
    ++n;
    sum += error;
    one_sigma += std::abs(error) < fit.radius_sigma_m();
    two_sigma += std::abs(error) < 2.0 * fit.radius_sigma_m();
  }
  ASSERT_GE(n, kTrials - 3);
  EXPECT_LT(std::abs(sum / n), 0.005 * kRadius);
  EXPECT_GE(one_sigma, n * 55 / 100);
  EXPECT_GE(two_sigma, n * 88 / 100);
}

TEST(CylinderFitter, LeavesInTheSegmentDoNotMoveIt) {
  const TestCone trunk = Upright(4.0, 1.0, 0.12);
  double clean = 0.0, dirty = 0.0;
  for (unsigned seed = 1; seed <= 10; ++seed) {
    TestScan test = SimulateCones({trunk}, TestSensor(), seed);
    const Segment segment = SegmentOf(test, 0);
    clean += std::abs(CylinderFitter().FitSegment(test.scan, segment).cylinder.radius() - 0.12);
    std::mt19937 rng(seed);
    std::uniform_real_distribution<double> u(0.0, 1.0);
    for (const std::int32_t p : segment.pixels) {
      if (u(rng) > 0.1) continue;  // One return in ten is a leaf up to 30 cm before the bark.
      const auto i = static_cast<std::size_t>(p);
      const float r = test.scan.image.range[i] - static_cast<float>(0.06 + 0.24 * u(rng));
      test.scan.image.range[i] = r;
      test.scan.image.point[i] = r * test.scan.image.beam_direction[i];
    }
    const FittedCylinder fit = CylinderFitter().FitSegment(test.scan, segment);
    ASSERT_EQ(fit.status, FitStatus::kMeasured) << ToString(fit.reason);
    dirty += std::abs(fit.cylinder.radius() - 0.12);
  }
  EXPECT_LT(dirty / 10.0, 2.0 * clean / 10.0 + 0.001);
}

TEST(CylinderFitter, CovarianceIsPositiveDefiniteAndGrowsWithDistance) {
  double previous = 0.0;
  for (const double distance : {3.0, 5.0, 8.0}) {
    const TestScan test = SimulateCones({Upright(distance, 0.0, 0.1)}, TestSensor(), 4);
    const FittedCylinder fit = CylinderFitter().FitSegment(test.scan, SegmentOf(test, 0));
    const Eigen::SelfAdjointEigenSolver<Matrix5d> solver(fit.covariance);
    EXPECT_GT(solver.eigenvalues().minCoeff(), 0.0);
    EXPECT_GT(fit.radius_sigma_m(), previous);
    previous = fit.radius_sigma_m();
  }
}

TEST(CylinderFitter, SameInputSameBytes) {
  const TestScan test = SimulateCones({Upright(4.0, 1.0, 0.12)}, TestSensor(), 8);
  const FittedCylinder a = CylinderFitter().FitSegment(test.scan, SegmentOf(test, 0));
  const FittedCylinder b = CylinderFitter().FitSegment(test.scan, SegmentOf(test, 0));
  EXPECT_EQ(std::memcmp(a.covariance.data(), b.covariance.data(), sizeof(double) * 25), 0);
  EXPECT_EQ(a.cylinder.curvature, b.cylinder.curvature);
}

TEST(CylinderFitter, FitKeepsTheOrderAndIds) {
  const TestScan test = SimulateCones({Upright(4.0, 1.0, 0.12), Upright(0.0, 5.0, 0.2)},
                                      TestSensor(), 8);
  Segment second = SegmentOf(test, 1), first = SegmentOf(test, 0);
  second.id = 7;
  first.id = 3;
  const auto fits = CylinderFitter().Fit(test.scan, {second, first});
  ASSERT_EQ(fits.size(), 2u);
  EXPECT_EQ(fits[0].segment_id, 7);
  EXPECT_EQ(fits[1].segment_id, 3);
  EXPECT_NEAR(fits[0].cylinder.radius(), 0.2, 0.01);
  EXPECT_NEAR(fits[1].cylinder.radius(), 0.12, 0.01);
}

// ---- Degenerate segments: UNRESOLVED with the reason, never a wild cylinder. -------------------

// An image of 16 x 1800 true beams whose returns are set by hand.
class Degenerate : public ::testing::Test {
 protected:
  Degenerate() : test_(SimulateCones({}, TestSensor(), 1)) {}

  // Puts a return at the beam's range; returns the pixel.
  std::int32_t Set(int row, int col, double range) {
    RangeImage& image = test_.scan.image;
    const std::size_t pixel = image.Index(row, image.WrapColumn(col));
    image.range[pixel] = static_cast<float>(range);
    image.point[pixel] = static_cast<float>(range) * image.beam_direction[pixel];
    image.point_index[pixel] = static_cast<std::int32_t>(pixel);
    test_.scan.label[pixel] = Label::kWood;
    return static_cast<std::int32_t>(pixel);
  }
  FittedCylinder FitPixels(std::vector<std::int32_t> pixels) const {
    std::sort(pixels.begin(), pixels.end());
    Segment segment;
    segment.pixels = std::move(pixels);
    return CylinderFitter().FitSegment(test_.scan, segment);
  }
  TestScan test_;
};

TEST_F(Degenerate, Empty) {
  const FittedCylinder fit = FitPixels({});
  EXPECT_EQ(fit.status, FitStatus::kUnresolved);
  EXPECT_EQ(fit.reason, UnresolvedReason::kTooFewPoints);
}

TEST_F(Degenerate, TwoPoints) {
  const FittedCylinder fit = FitPixels({Set(5, 10, 4.0), Set(6, 10, 4.0)});
  EXPECT_EQ(fit.status, FitStatus::kUnresolved);
  EXPECT_EQ(fit.reason, UnresolvedReason::kTooFewPoints);
}

TEST_F(Degenerate, OneRing) {
  std::vector<std::int32_t> pixels;
  for (int c = 0; c < 40; ++c) pixels.push_back(Set(8, c, 4.0));
  const FittedCylinder fit = FitPixels(pixels);
  EXPECT_EQ(fit.status, FitStatus::kUnresolved);
  EXPECT_EQ(fit.reason, UnresolvedReason::kTooFewRings);
}

TEST_F(Degenerate, CollinearColumn) {
  // One return in each ring, straight up: a line holds no radius... but each ring's silhouette
  // brackets one, so the answer may only be a twig or no answer.
  std::vector<std::int32_t> pixels;
  for (int r = 0; r < 16; ++r) pixels.push_back(Set(r, 100, 4.0 / std::cos((-15 + 2 * r) * M_PI / 180)));
  const FittedCylinder fit = FitPixels(pixels);
  if (fit.status == FitStatus::kMeasured) {
    EXPECT_LT(fit.cylinder.radius(), 0.03);
  } else {
    EXPECT_NE(fit.reason, UnresolvedReason::kNone);
  }
}

TEST_F(Degenerate, Plane) {
  std::mt19937 rng(3);
  std::normal_distribution<double> gauss(0.0, 0.01);
  std::vector<std::int32_t> pixels;
  for (int r = 3; r < 13; ++r) {
    for (int c = -60; c <= 60; ++c) {
      const auto& d = test_.scan.image.beam_direction[test_.scan.image.Index(r, (c + 1800) % 1800)];
      pixels.push_back(Set(r, c, 4.0 / static_cast<double>(d.x()) + gauss(rng)));
    }
  }
  const FittedCylinder fit = FitPixels(pixels);
  EXPECT_EQ(fit.status, FitStatus::kUnresolved) << fit.cylinder.radius();
  EXPECT_NE(fit.reason, UnresolvedReason::kNone);
}

// A few columns out of the middle of a trunk, or the strip that a nearer post leaves: where such a
// segment ends is no silhouette, though a thin stem fits it.
TEST_F(Degenerate, StripOfATrunk) {
  for (const bool behind_posts : {false, true}) {
    for (unsigned seed = 1; seed <= 30; ++seed) {
      std::vector<TestCone> cones{Upright(4.3, 0.0, 0.22)};
      if (behind_posts) {
        cones.push_back(Upright(2.5, 0.12, 0.08));
        cones.push_back(Upright(2.5, -0.12, 0.08));
      }
      TestScan test = SimulateCones(cones, TestSensor(), seed);
      Segment strip;
      for (const std::int32_t pixel : SegmentOf(test, 0).pixels) {
        const int col = pixel % test.scan.image.cols;
        if (std::min(col, test.scan.image.cols - col) <= 3) strip.pixels.push_back(pixel);
      }
      ASSERT_GT(strip.pixels.size(), 20u);
      const FittedCylinder fit = CylinderFitter().FitSegment(test.scan, strip);
      EXPECT_EQ(fit.status, FitStatus::kUnresolved) << fit.cylinder.radius() << " +- " << fit.radius_sigma_m();
    }
  }
}

// A wall close behind mixes with the limb of a trunk but does not hide it.
TEST(CylinderFitter, TrunkBeforeAWall) {
  for (const double radius : {0.1, 0.2, 0.3}) {
    double squares = 0.0;
    constexpr int kTrials = 10;
    for (unsigned seed = 1; seed <= kTrials; ++seed) {
      TestSensor sensor;
      sensor.azimuth_offset_deg = 0.0637 * seed;
      TestScan test = SimulateCones({Upright(5.0, 0.0, radius), Upright(8.4, 0.0, 3.0, 3.0)}, sensor, seed);
      for (std::size_t i = 0; i < test.truth.size(); ++i) {
        if (test.truth[i] == 1) test.scan.label[i] = Label::kOther;
      }
      const FittedCylinder fit = CylinderFitter().FitSegment(test.scan, SegmentOf(test, 0));
      ASSERT_EQ(fit.status, FitStatus::kMeasured) << radius << " " << ToString(fit.reason);
      const double error = fit.cylinder.radius() - radius;
      EXPECT_LT(std::abs(error), 3.5 * fit.radius_sigma_m());
      squares += error * error;
    }
    EXPECT_LT(std::sqrt(squares / kTrials), 0.1 * radius);
  }
}

TEST_F(Degenerate, Sphere) {
  std::mt19937 rng(3);
  std::normal_distribution<double> gauss(0.0, 0.01);
  for (const double radius : {0.35, 0.6}) {
    std::vector<std::int32_t> pixels;
    const Vector3d centre(3.0, 0.0, 0.1);
    for (int r = 0; r < 16; ++r) {
      for (int c = -150; c <= 150; ++c) {
        const std::size_t i = test_.scan.image.Index(r, (c + 1800) % 1800);
        const Vector3d d = test_.scan.image.beam_direction[i].cast<double>();
        const double b = d.dot(centre);
        const double disc = b * b - centre.squaredNorm() + radius * radius;
        if (disc > 0.0) pixels.push_back(Set(r, c, b - std::sqrt(disc) + gauss(rng)));
      }
    }
    const FittedCylinder fit = FitPixels(pixels);
    EXPECT_EQ(fit.status, FitStatus::kUnresolved) << radius << " -> " << fit.cylinder.radius()
                                                  << " mad " << fit.mean_abs_deviation_m;
    EXPECT_NE(fit.reason, UnresolvedReason::kNone);
  }
}

TEST_F(Degenerate, NaNPoints) {
  std::vector<std::int32_t> pixels;
  for (int r = 4; r < 12; ++r) {
    for (int c = 0; c < 5; ++c) {
      pixels.push_back(Set(r, c, 4.0));
      test_.scan.image.point[static_cast<std::size_t>(pixels.back())].x() =
          std::numeric_limits<float>::quiet_NaN();
    }
  }
  const FittedCylinder fit = FitPixels(pixels);
  EXPECT_EQ(fit.status, FitStatus::kUnresolved);
  EXPECT_EQ(fit.reason, UnresolvedReason::kNonFinite);
}

TEST_F(Degenerate, RadiusThatRunsOff) {
  // A wall curved with a radius of 3 m.
  std::vector<std::int32_t> pixels;
  const TestScan wall = SimulateCones({Upright(7.0, 0.0, 3.0)}, TestSensor(), 2);
  const FittedCylinder fit = CylinderFitter().FitSegment(wall.scan, SegmentOf(wall, 0));
  EXPECT_EQ(fit.status, FitStatus::kUnresolved);
  EXPECT_EQ(fit.reason, UnresolvedReason::kRadiusOutOfRange);
}

TEST_F(Degenerate, LevelBranchOnTwoRings) {
  const TestCone level{Vector3d(4.0, -1.5, 0.03), Vector3d(4.0, 1.5, 0.06), 0.05, 0.05};
  const TestScan test = SimulateCones({level}, TestSensor(), 2);
  const FittedCylinder fit = CylinderFitter().FitSegment(test.scan, SegmentOf(test, 0));
  EXPECT_EQ(fit.status, FitStatus::kUnresolved);
  EXPECT_EQ(fit.reason, UnresolvedReason::kTooFewRings);
}

TEST_F(Degenerate, PixelOutsideTheImageIsTheCallersError) {
  Segment segment;
  segment.pixels = {-1};
  EXPECT_THROW(CylinderFitter().FitSegment(test_.scan, segment), std::invalid_argument);
}

TEST_F(Degenerate, RandomCloudsAreNeverWild) {
  std::mt19937 rng(17);
  std::uniform_real_distribution<double> u(0.0, 1.0);
  int measured = 0;
  constexpr int kClouds = 400;
  for (int k = 0; k < kClouds; ++k) {
    std::vector<std::int32_t> pixels;
    const int rows = 1 + static_cast<int>(15 * u(rng));
    const int first_col = static_cast<int>(1800 * u(rng));
    const int cols = 1 + static_cast<int>(60 * u(rng));
    const double spread = 2.0 * u(rng), centre = 1.0 + 8.0 * u(rng), fill = u(rng);
    for (int r = 0; r < rows; ++r) {
      for (int c = 0; c < cols; ++c) {
        if (u(rng) < fill) pixels.push_back(Set(r, first_col + c, centre + spread * (u(rng) - 0.5)));
      }
    }
    const FittedCylinder fit = FitPixels(pixels);
    ASSERT_TRUE(fit.cylinder.point.allFinite() && fit.cylinder.axis.allFinite());
    ASSERT_TRUE(fit.covariance.allFinite());
    if (fit.status == FitStatus::kMeasured) {
      ++measured;
      EXPECT_GT(fit.cylinder.radius(), 0.0);
      EXPECT_LE(fit.cylinder.radius(), 0.8);
      EXPECT_LT(fit.radius_sigma_m(), 0.25 * fit.cylinder.radius());
    } else {
      EXPECT_NE(fit.reason, UnresolvedReason::kNone);
    }
    for (const std::int32_t p : pixels) {
      test_.scan.image.point_index[static_cast<std::size_t>(p)] = -1;
    }
  }
  EXPECT_LT(measured, kClouds / 20);
}

TEST(CylinderFitterConfig, NamesTheBadField) {
  CylinderFitterConfig config;
  config.max_radius_m = 0.0;
  try {
    CylinderFitter fitter(config);
    FAIL();
  } catch (const std::invalid_argument& e) {
    EXPECT_NE(std::string(e.what()).find("max_radius_m"), std::string::npos);
  }
}

}  // namespace
}  // namespace dendro
