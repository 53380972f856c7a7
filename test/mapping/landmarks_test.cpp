#include <cmath>

#include <gtest/gtest.h>

#include "dendro_slam/mapping/data_association.h"
#include "dendro_slam/mapping/radius_profile.h"
#include "dendro_slam/mapping/relocalizer.h"
#include "dendro_slam/mapping/tree_map.h"

namespace dendro {
namespace {

RadiusProfile::Observation Seen(double s0, double s1, double radius, double sigma, double angle) {
  RadiusProfile::Observation o;
  o.s_start_m = s0;
  o.s_end_m = s1;
  o.s_anchor_m = 0.5 * (s0 + s1);
  o.radius_m = radius;
  o.radius_sigma_m = sigma;
  o.view_angle_rad = angle;
  o.distance_m = 4.0;
  return o;
}

TEST(RadiusProfile, OneObservationByHand) {
  RadiusProfileConfig config;
  config.bin_sigma_rel = 0.02;
  config.bin_sigma_m = 0.0;
  config.common_sigma_rel = 0.0;
  RadiusProfile profile;
  profile.Add(Seen(-0.05, 0.05, 0.1, 0.003, 0.0), config);
  const auto knots = profile.Knots(config);
  ASSERT_EQ(knots.size(), 1u);
  EXPECT_DOUBLE_EQ(knots[0].radius_m, 0.1);
  EXPECT_NEAR(knots[0].radius_sigma_m, std::hypot(0.003, 0.002), 1e-12);
}

TEST(RadiusProfile, AThousandScansFromOneSideAreWorthAFew) {
  const RadiusProfileConfig config;
  RadiusProfile one_side, all_sides;
  for (int i = 0; i < 1000; ++i) {
    one_side.Add(Seen(-0.05, 0.05, 0.1, 0.003, 0.1), config);
    all_sides.Add(Seen(-0.05, 0.05, 0.1, 0.003, 0.00628 * i), config);
  }
  const double side = one_side.Knots(config)[0].radius_sigma_m;
  const double around = all_sides.Knots(config)[0].radius_sigma_m;
  EXPECT_GE(side, 0.002);           // what that side shares
  EXPECT_LT(around, 0.4 * side);
  EXPECT_GE(around, 0.0003);        // what all share
}

TEST(RadiusProfile, AStretchNewlySeenDoesNotDragTheRest) {
  const RadiusProfileConfig config;
  RadiusProfile profile;
  for (int i = 0; i < 50; ++i) profile.Add(Seen(0.0, 1.0, 0.20, 0.004, 0.12 * i), config);
  const double before = profile.Knots(config)[2].radius_m;
  for (int i = 0; i < 500; ++i) profile.Add(Seen(1.2, 2.0, 0.15, 0.004, 0.12 * i), config);
  const auto knots = profile.Knots(config);
  EXPECT_EQ(knots[2].radius_m, before);
  EXPECT_NEAR(knots.back().radius_m, 0.15, 1e-9);
}

TEST(RadiusProfile, ATaperIsFollowed) {
  const RadiusProfileConfig config;
  RadiusProfile profile;
  RadiusProfile::Observation o = Seen(0.0, 2.0, 0.15, 0.002, 0.0);
  o.taper_m_per_m = -0.02;
  profile.Add(o, config);
  const auto knots = profile.Knots(config);
  EXPECT_NEAR(knots.front().radius_m, 0.17, 1e-12);
  EXPECT_NEAR(knots.back().radius_m, 0.13, 1e-12);
}

FittedCylinder Fit(const Eigen::Vector3d& middle,
                   const Eigen::Vector3d& axis,
                   double half,
                   double r) {
  FittedCylinder fit;
  fit.status = FitStatus::kMeasured;
  fit.cylinder = {axis.normalized(), middle, 1.0 / r};
  Vector5d sigma;
  sigma << 0.01, 0.01, 0.005, 0.005, 0.05 / r;
  fit.covariance = sigma.cwiseAbs2().asDiagonal();
  fit.start_s_m = -half;
  fit.end_s_m = half;
  fit.num_points = 100;
  return fit;
}

Landmark Known(
    int id, const Eigen::Vector3d& middle, const Eigen::Vector3d& axis, double half, double r) {
  TreeMap map(TreeMapConfig{}, RadiusProfileConfig{});
  map.Add(Fit(middle, axis, half, r), Eigen::Isometry3d::Identity(), 1);
  Landmark l = map.Landmarks(true).front();
  l.id = id;
  return l;
}

TEST(Association, ExtentsKeepCollinearPiecesApart) {
  const Landmark below = Known(0, {3, 0, 0}, {0, 0, 1}, 0.5, 0.1);
  const Landmark above = Known(1, {3, 0, 2}, {0, 0, 1}, 0.5, 0.1);
  const std::vector<const Landmark*> landmarks{&below, &above};
  const auto matches = Associate({Fit({3, 0, 1.9}, {0, 0, -1}, 0.5, 0.1),
                                  Fit({3, 0, 0.1}, {0, 0, 1}, 0.5, 0.1),
                                  Fit({3, 0, 1.0}, {0, 0, 1}, 0.2, 0.1)},
                                 landmarks,
                                 Eigen::Isometry3d::Identity(),
                                 Matrix6d::Identity() * 1e-6,
                                 DataAssociationConfig{});
  ASSERT_EQ(matches.size(), 2u);
  EXPECT_EQ(matches[0].observation, 0);
  EXPECT_EQ(matches[0].landmark, 1);
  EXPECT_EQ(matches[1].observation, 1);
  EXPECT_EQ(matches[1].landmark, 0);
}

TEST(Association, NeighboursAndOtherRadiiAreNotTaken) {
  const Landmark trunk = Known(0, {3, 0, 0}, {0, 0, 1}, 0.5, 0.2);
  const std::vector<const Landmark*> landmarks{&trunk};
  const auto match = [&](const FittedCylinder& fit) {
    return !Associate({fit}, landmarks, Eigen::Isometry3d::Identity(), Matrix6d::Identity() * 1e-6,
                      DataAssociationConfig{}).empty();
  };
  EXPECT_TRUE(match(Fit({3.01, 0, 0.1}, {0.01, 0, 1}, 0.5, 0.21)));
  EXPECT_FALSE(match(Fit({3.4, 0, 0.1}, {0, 0, 1}, 0.5, 0.2)));    // beside it
  EXPECT_FALSE(match(Fit({3, 0, 0.1}, {0.5, 0, 1}, 0.5, 0.2)));    // another direction
  EXPECT_FALSE(match(Fit({3, 0, 0.1}, {0, 0, 1}, 0.5, 0.05)));     // a twig inside it
  FittedCylinder unresolved = Fit({3, 0, 0}, {0, 0, 1}, 0.5, 0.2);
  unresolved.status = FitStatus::kUnresolved;
  EXPECT_FALSE(match(unresolved));
}

TEST(Association, AnObservationIsNotPassedOnToTheSecondBest) {
  const Landmark a = Known(0, {3, 0, 0}, {0, 0, 1}, 0.5, 0.1);
  const std::vector<const Landmark*> landmarks{&a};
  // Two fits of one stretch: one of them, not both.
  const auto matches = Associate({Fit({3, 0.012, 0}, {0, 0, 1}, 0.5, 0.1),
                                  Fit({3, 0, 0}, {0, 0, 1}, 0.5, 0.1)},
                                 landmarks,
                                 Eigen::Isometry3d::Identity(),
                                 Matrix6d::Identity() * 1e-6,
                                 DataAssociationConfig{});
  ASSERT_EQ(matches.size(), 1u);
  EXPECT_EQ(matches[0].observation, 1);
}

TEST(TreeMap, AGapSplitsAndADuplicateMerges) {
  TreeMap map(TreeMapConfig{}, RadiusProfileConfig{});
  const Eigen::Isometry3d I = Eigen::Isometry3d::Identity();
  const int id = map.Add(Fit({3, 0, 0}, {0, 0, 1}, 1.0, 0.1), I, 1);  // one fit across the gap
  for (int i = 2; i < 60; ++i) {
    map.Observe(id, Fit({3, 0, 0.7}, {0, 0, 1}, 0.3, 0.1), I, i);
    map.Observe(id, Fit({3, 0, -0.7}, {0, 0, 1}, 0.3, 0.1), I, i);
  }
  const auto split = map.FindSplit();
  ASSERT_TRUE(split);
  EXPECT_NEAR(split->gap_begin_m, -0.4, 0.06);
  EXPECT_NEAR(split->gap_end_m, 0.4, 0.06);
  map.Split(*split);
  ASSERT_EQ(map.Landmarks(true).size(), 2u);
  EXPECT_FALSE(map.FindSplit());

  TreeMap twins(TreeMapConfig{}, RadiusProfileConfig{});
  const int first = twins.Add(Fit({3, 0, 0}, {0, 0, 1}, 0.5, 0.1), I, 1);
  const int second = twins.Add(Fit({3.004, 0, 0.3}, {0, 0, -1}, 0.5, 0.1), I, 1);
  for (int i = 2; i < 20; ++i) twins.Observe(first, Fit({3, 0, 0}, {0, 0, 1}, 0.5, 0.1), I, i);
  twins.Promote(20);
  const auto merge = twins.FindDuplicate(DataAssociationConfig{});
  ASSERT_TRUE(merge);
  EXPECT_EQ(merge->keep_id, first);
  EXPECT_EQ(merge->drop_id, second);
  twins.Merge(*merge);
  EXPECT_FALSE(twins.Has(second));
  EXPECT_EQ(twins.State(first).num_scans, 20);
}

TEST(Relocalizer, FindsAnyPoseAndRefusesASymmetricScene) {
  const std::vector<Landmark> loaded{Known(4, {0, 0, 2}, {0, 0, 1}, 2.0, 0.2),
                                     Known(5, {0.8, 0.2, 2.5}, {0.8, 0.2, 0.5}, 0.6, 0.08),
                                     Known(7, {-0.5, 0.6, 3.4}, {-0.5, 0.6, 0.4}, 0.5, 0.06)};
  Vector6d xi;
  xi << 0.02, -0.03, 2.1, 3.0, -1.0, 0.5;
  const Eigen::Isometry3d truth = ExpSe3(xi);
  std::vector<Landmark> local = loaded;
  for (Landmark& l : local) l.cylinder = TransformCylinder(truth.inverse(), l.cylinder);
  const auto found = Relocalize(local, loaded, RelocalizerConfig{});
  ASSERT_TRUE(found);
  EXPECT_EQ(found->matches.size(), 3u);
  EXPECT_LT(LogSe3(found->T_map_local.inverse() * truth).norm(), 0.02);

  // A trunk with two equal branches opposite each other looks the same after half a turn.
  const std::vector<Landmark> symmetric{Known(0, {0, 0, 2}, {0, 0, 1}, 2.0, 0.2),
                                        Known(1, {0.8, 0, 2.5}, {0.8, 0, 0.5}, 0.6, 0.08),
                                        Known(2, {-0.8, 0, 2.5}, {-0.8, 0, 0.5}, 0.6, 0.08)};
  EXPECT_FALSE(Relocalize(symmetric, symmetric, RelocalizerConfig{}));
}

}  // namespace
}  // namespace dendro
