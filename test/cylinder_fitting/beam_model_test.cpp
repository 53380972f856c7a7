#include "dendro_slam/cylinder_fitting/beam_model.h"

#include <cmath>
#include <random>

#include <gtest/gtest.h>

#include "cone_scan.h"
#include "dendro_slam/geometry/cylinder.h"

namespace dendro {
namespace {

using Eigen::Vector3d;

struct Case {
  Cone cone;
  Vector3d origin, direction;
};

// A random cone a few metres off and a beam that passes near its axis.
Case RandomCase(std::mt19937* rng) {
  std::uniform_real_distribution<double> u(-1.0, 1.0);
  Case c;
  c.cone.axis = Vector3d(0.5 * u(*rng), 0.5 * u(*rng), 1.0).normalized();
  c.cone.point = Vector3d(4.0 + u(*rng), u(*rng), 0.5 * u(*rng));
  c.cone.radius = 0.2 + 0.1 * u(*rng);
  c.cone.slope = 0.03 * u(*rng);
  c.origin = Vector3d(0.05 * u(*rng), 0.05 * u(*rng), 0.05 * u(*rng));
  const Vector3d target = c.cone.point + u(*rng) * c.cone.axis +
                          0.8 * c.cone.radius * u(*rng) * Vector3d::UnitY();
  c.direction = (target - c.origin).normalized();
  return c;
}

TEST(LocateBeam, HandComputedVerticalCylinder) {
  // A vertical cylinder of radius 0.3 at (4, 0.1); the beam runs along x at height 0.
  Cone cone;
  cone.point = {4.0, 0.1, 2.0};
  cone.radius = 0.3;
  const BeamOnCone beam = LocateBeam(cone, Vector3d::Zero(), Vector3d::UnitX());
  ASSERT_TRUE(beam.valid);
  EXPECT_NEAR(std::abs(beam.offset), 0.1, 1e-12);
  EXPECT_NEAR(beam.silhouette, 0.3, 1e-12);
  EXPECT_NEAR(beam.mid_range, 4.0, 1e-12);
  EXPECT_NEAR(beam.sin_angle, 1.0, 1e-12);
  const RangePrediction thin = PredictRange(beam, Footprint());
  EXPECT_NEAR(thin.range, 4.0 - std::sqrt(0.09 - 0.01), 1e-12);
}

TEST(LocateBeam, SilhouetteOfAConeIsWhereTheDiscriminantVanishes) {
  std::mt19937 rng(3);
  for (int i = 0; i < 50; ++i) {
    const Case c = RandomCase(&rng);
    const BeamOnCone beam = LocateBeam(c.cone, c.origin, c.direction);
    ASSERT_TRUE(beam.valid);
    // Shift the ray across until it grazes: just inside it hits, just outside it misses.
    const Vector3d across = c.cone.axis.cross(c.direction).normalized();
    dendro_test::TestCone test;
    test.base = c.cone.point - 3.0 * c.cone.axis;
    test.tip = c.cone.point + 3.0 * c.cone.axis;
    test.base_radius = c.cone.radius - 3.0 * c.cone.slope;
    test.tip_radius = c.cone.radius + 3.0 * c.cone.slope;
    double cosine = 0.0;
    const Vector3d graze = c.origin + (beam.silhouette - beam.offset) * across;
    EXPECT_TRUE(std::isfinite(RayCone(test, graze - 1e-6 * across, c.direction, &cosine)));
    EXPECT_FALSE(std::isfinite(RayCone(test, graze + 1e-6 * across, c.direction, &cosine)));
  }
}

TEST(LocateBeam, ParallelBeamIsInvalid) {
  EXPECT_FALSE(LocateBeam(Cone(), Vector3d(1, 0, 0), Vector3d::UnitZ()).valid);
}

template <class Get>
Vector6d Numeric(const Case& c, Get get) {
  Vector6d J;
  constexpr double kStep = 1e-6;
  for (int k = 0; k < 6; ++k) {
    Vector6d d = Vector6d::Zero();
    d[k] = kStep;
    J[k] = (get(c.cone.Retract(d)) - get(c.cone.Retract(-d))) / (2.0 * kStep);
  }
  return J;
}

TEST(LocateBeam, JacobiansMatchCentralDifferences) {
  std::mt19937 rng(5);
  for (int i = 0; i < 100; ++i) {
    const Case c = RandomCase(&rng);
    const BeamOnCone beam = LocateBeam(c.cone, c.origin, c.direction);
    ASSERT_TRUE(beam.valid);
    const auto at = [&](const Cone& cone) { return LocateBeam(cone, c.origin, c.direction); };
    EXPECT_LT((beam.d_offset - Numeric(c, [&](const Cone& k) { return at(k).offset; })).norm(), 1e-6);
    EXPECT_LT((beam.d_silhouette - Numeric(c, [&](const Cone& k) { return at(k).silhouette; })).norm(),
              1e-6);
    EXPECT_LT((beam.d_mid_range - Numeric(c, [&](const Cone& k) { return at(k).mid_range; })).norm(),
              1e-6);
    EXPECT_LT((beam.d_sin_angle - Numeric(c, [&](const Cone& k) { return at(k).sin_angle; })).norm(),
              1e-6);
  }
}

TEST(BentCone, TouchesItsAxisAndIsTheConeWithoutABend) {
  BentCone bent;
  bent.middle.point = {4.0, 0.5, 1.0};
  bent.middle.radius = 0.1;
  bent.middle.slope = -0.02;
  EXPECT_LT((bent.Touching(0.7).point - Vector3d(4.0, 0.5, 1.7)).norm(), 1e-12);
  EXPECT_NEAR(bent.Touching(0.7).radius, 0.1 - 0.02 * 0.7, 1e-12);
  bent.bend = {0.0, 0.2, 0.0};  // A sagitta of 2.5 cm on a metre.
  EXPECT_LT((bent.Touching(0.5).point - Vector3d(4.0, 0.525, 1.5)).norm(), 1e-12);
  EXPECT_LT((bent.Touching(0.5).axis - Vector3d(0.0, 0.1, 1.0).normalized()).norm(), 1e-12);
  EXPECT_NEAR(bent.StationOf(Vector3d::Zero(), Vector3d(4.0, 0.5, 1.3).normalized()), 0.3, 1e-9);
}

TEST(BentCone, JacobianMatchesCentralDifferences) {
  std::mt19937 rng(11);
  std::uniform_real_distribution<double> u(-1.0, 1.0);
  for (int i = 0; i < 100; ++i) {
    const Case c = RandomCase(&rng);
    BentCone bent;
    bent.middle = c.cone;
    bent.bend = 0.2 * (u(rng) * PerpendicularBasis(c.cone.axis).col(0) +
                       u(rng) * PerpendicularBasis(c.cone.axis).col(1));
    const double s = 0.8 * u(rng);
    BentCone::TouchJacobian touching;
    const BeamOnCone beam = LocateBeam(bent.Touching(s, &touching), c.origin, c.direction);
    ASSERT_TRUE(beam.valid);
    BentCone::Tangent offset, silhouette;
    constexpr double kStep = 1e-6;
    for (int k = 0; k < 8; ++k) {
      BentCone::Tangent d = BentCone::Tangent::Zero();
      d[k] = kStep;
      const BeamOnCone plus =
          LocateBeam(bent.Retract(d).Touching(s), c.origin, c.direction);
      const BeamOnCone minus =
          LocateBeam(bent.Retract(-d).Touching(s), c.origin, c.direction);
      offset[k] = (plus.offset - minus.offset) / (2.0 * kStep);
      silhouette[k] = (plus.silhouette - minus.silhouette) / (2.0 * kStep);
    }
    // (s bend)^2 is left out: the axis' length along a bend.
    EXPECT_LT((touching.transpose() * beam.d_offset - offset).norm(), 0.02 * offset.norm());
    EXPECT_LT((touching.transpose() * beam.d_silhouette - silhouette).norm(),
              0.02 * silhouette.norm() + 1e-3);
  }
}

TEST(PredictRange, JacobianMatchesCentralDifferences) {
  std::mt19937 rng(7);
  for (const double reach : {0.0, 0.012, 0.05}) {
    for (int i = 0; i < 100; ++i) {
      const Case c = RandomCase(&rng);
      Footprint footprint;
      footprint.half_width_m = reach;
      footprint.half_slope_m = 0.3 * reach;
      footprint.skew = 0.2;
      const BeamOnCone located = LocateBeam(c.cone, c.origin, c.direction);
      ASSERT_TRUE(located.valid);
      // The two quadratures meet where the footprint comes near the limb; not within one step.
      const double to_limb = located.silhouette - std::abs(located.offset);
      if (std::abs(footprint.reach() - 0.5 * to_limb) < 1e-4) continue;
      const RangePrediction p = PredictRange(located, footprint);
      const Vector6d numeric = Numeric(c, [&](const Cone& k) {
        return PredictRange(LocateBeam(k, c.origin, c.direction), footprint).range;
      });
      EXPECT_LT((p.jacobian - numeric).norm(), 0.02 * (1.0 + numeric.norm()))
          << "reach " << reach << "\n" << p.jacobian.transpose() << "\n" << numeric.transpose();
    }
  }
}

// Mean range and energy by brute force over the rectangle.
void BruteForce(const Case& c, double half_h, double half_v, double* range, double* energy) {
  dendro_test::TestCone test;
  test.base = c.cone.point - 10.0 * c.cone.axis;
  test.tip = c.cone.point + 10.0 * c.cone.axis;
  test.base_radius = c.cone.radius - 10.0 * c.cone.slope;
  test.tip_radius = c.cone.radius + 10.0 * c.cone.slope;
  const Vector3d h = Vector3d::UnitZ().cross(c.direction).normalized();
  const Vector3d v = c.direction.cross(h);
  constexpr int kSteps = 200;
  double sum = 0.0, weighted = 0.0;
  for (int i = 0; i < kSteps; ++i) {
    for (int j = 0; j < kSteps; ++j) {
      const double x = (2.0 * (i + 0.5) / kSteps - 1.0) * half_h;
      const double y = (2.0 * (j + 0.5) / kSteps - 1.0) * half_v;
      double cosine = 0.0;
      const double t = RayCone(test, c.origin + x * h + y * v, c.direction, &cosine);
      if (!std::isfinite(t)) continue;
      sum += cosine;
      weighted += cosine * t;
    }
  }
  *energy = sum / (kSteps * kSteps);
  *range = weighted / sum;
}

TEST(PredictRange, EqualsBruteForceOverTheFootprint) {
  std::mt19937 rng(11);
  std::uniform_real_distribution<double> u(-1.0, 1.0);
  int partial = 0;
  for (int i = 0; i < 60; ++i) {
    Case c = RandomCase(&rng);
    c.cone.radius = 0.08;
    const Vector3d across = c.cone.axis.cross(Vector3d::UnitX()).normalized();
    c.direction = (c.cone.point + 0.5 * u(rng) * c.cone.axis + 0.085 * u(rng) * across - c.origin)
                      .normalized();
    const double half_h = 0.014, half_v = 0.010;
    double range = 0.0, energy = 0.0;
    BruteForce(c, half_h, half_v, &range, &energy);
    if (energy < 0.1) continue;
    partial += energy < 0.6;
    const Footprint footprint =
        FootprintOnCone(c.cone.axis, c.direction, Vector3d::UnitZ(), half_h, half_v);
    const RangePrediction p = PredictRange(LocateBeam(c.cone, c.origin, c.direction), footprint);
    EXPECT_NEAR(p.range, range, 1.0e-3) << "energy " << energy;
    EXPECT_NEAR(p.energy, energy, 0.02);
  }
  EXPECT_GT(partial, 5) << "the limb must be among the cases";
}

TEST(DetectionOffset, HandComputedShare) {
  // A beam 24 mm wide: a fifth of it is 4.8 mm, so its centre is 7.2 mm outside the silhouette.
  Footprint footprint;
  footprint.half_width_m = 0.012;
  EXPECT_NEAR(DetectionOffset(0.1, 1.0, footprint, 0.2, 0.0), 0.1072, 1e-7);
  EXPECT_NEAR(DetectionOffset(0.1, 1.0, footprint, 0.5, 0.0), 0.1, 1e-7);
  // A twig of 4 mm fills a third of a centred beam, never a half.
  EXPECT_GT(DetectionOffset(0.004, 1.0, footprint, 0.2, 0.0), 0.004);
  EXPECT_EQ(DetectionOffset(0.004, 1.0, footprint, 0.5, 0.0), 0.0);
}

TEST(DetectionOffset, TrapezoidShareByCounting) {
  Footprint footprint;
  footprint.half_width_m = 0.012;
  footprint.half_slope_m = 0.005;
  const double e = DetectionOffset(0.05, 1.0, footprint, 0.2, 0.0);
  int met = 0, all = 0;
  for (int i = 0; i < 400; ++i) {
    for (int j = 0; j < 400; ++j) {
      const double u = 0.012 * (2.0 * (i + 0.5) / 400 - 1.0) + 0.005 * (2.0 * (j + 0.5) / 400 - 1.0);
      met += std::abs(e + u) < 0.05;
      ++all;
    }
  }
  EXPECT_NEAR(static_cast<double>(met) / all, 0.2, 0.003);
  double slope = 0.0;
  DetectionOffset(0.05, 1.0, footprint, 0.2, 0.0, &slope);
  EXPECT_NEAR(slope, 1.0, 1e-6);
}

TEST(DetectionOffset, ThinRayEndsAtTheSilhouette) {
  EXPECT_DOUBLE_EQ(DetectionOffset(0.1, 1.0, Footprint(), 0.2, 0.0), 0.1);
}

TEST(DetectionOffset, ABrightSurfaceBehindTakesMoreOfTheBeam) {
  Footprint footprint;
  footprint.half_width_m = 0.012;
  const double alone = DetectionOffset(0.1, 1.0, footprint, 0.2, 0.0);
  const double against = DetectionOffset(0.1, 1.0, footprint, 0.2, 1.0);
  EXPECT_LT(against, alone);
  // Hidden when the surface behind outshines it: a twig much thinner than the beam.
  EXPECT_EQ(DetectionOffset(0.003, 1.0, footprint, 0.05, 1.0), 0.0);
}

}  // namespace
}  // namespace dendro
