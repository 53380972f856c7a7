#include <cmath>
#include <random>

#include <gtest/gtest.h>

#include "../factor_graph/graph_test_util.h"
#include "dendro_slam/mapping/data_association.h"
#include "dendro_slam/mapping/level_factors.h"
#include "dendro_slam/mapping/odometry_drift.h"
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
  config.common_sigma_m = 0.0;
  RadiusProfile profile;
  profile.Add(Seen(-0.05, 0.05, 0.1, 0.003, 0.0), config);
  const auto knots = profile.Knots(config);
  ASSERT_EQ(knots.size(), 1u);
  EXPECT_DOUBLE_EQ(knots[0].radius_m, 0.1);
  EXPECT_NEAR(knots[0].radius_sigma_m, std::hypot(0.003, 0.002), 1e-12);
}

TEST(RadiusProfile, AThousandScansFromOneSideAreWorthAFew) {
  RadiusProfileConfig config;
  config.common_sigma_m = 0.0;
  RadiusProfile one_side, all_sides;
  for (int i = 0; i < 1000; ++i) {
    one_side.Add(Seen(-0.05, 0.05, 0.1, 0.003, 0.1), config);
    all_sides.Add(Seen(-0.05, 0.05, 0.1, 0.003, 0.00628 * i), config);
  }
  const double side = one_side.Knots(config)[0].radius_sigma_m;
  const double around = all_sides.Knots(config)[0].radius_sigma_m;
  EXPECT_GE(side, config.bin_sigma_rel * 0.1);  // what that side shares
  EXPECT_LT(around, 0.4 * side);
  EXPECT_GE(around, config.common_sigma_rel * 0.1);  // what all share
  config.common_sigma_m = 0.0008;
  const double shared = 0.0008 * std::hypot(1.0, 0.008 / 0.1);  // More on wood thinner than the beam.
  EXPECT_NEAR(all_sides.Knots(config)[0].radius_sigma_m, std::hypot(around, shared), 1e-12);
}

TEST(RadiusProfile, SidesThatSeeABendThickerDoNotDragTheRadius) {
  const RadiusProfileConfig config;
  RadiusProfile profile;
  // Twelve sides agree on 3 cm, six see the bend from the side and take it for 5 cm.
  for (int i = 0; i < 180; ++i) {
    const bool bend = i % 3 == 0;
    profile.Add(Seen(-0.05, 0.05, bend ? 0.05 : 0.03, 0.002, (i % 18 + 0.5) * 2.0 * M_PI / 18.0), config);
  }
  const RadiusKnot knot = profile.Knots(config)[0];
  EXPECT_NEAR(knot.radius_m, 0.03, 0.002);  // The mean is 3.67 cm.
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

// Begun at its foot and then seen up to its tip, 1.45 m from there. What goes on at an angle is another piece.
TEST(TreeMap, AStraightBranchIsFollowedToItsTipAndABentOneIsNot) {
  const Eigen::Isometry3d I = Eigen::Isometry3d::Identity();
  const auto top = [&](const FittedCylinder& later) {
    TreeMap map(TreeMapConfig{}, RadiusProfileConfig{});
    const int id = map.Add(Fit({3, 0, 0}, {0, 0, 1}, 0.3, 0.1), I, 1);
    for (int i = 2; i < 40; ++i) map.Observe(id, later, I, i);
    const Landmark l = map.Landmarks(true).front();
    EXPECT_LE(l.s_max_m - l.s_min_m, TreeMapConfig{}.max_length_m + 0.1);
    return l.PointAt(l.s_max_m).z();
  };
  EXPECT_NEAR(top(Fit({3, 0, 0.7}, {0, 0, 1}, 0.75, 0.1)), 1.45, 0.06);
  EXPECT_NEAR(top(Fit({3, 0, 1.5}, {0, 0, 1}, 1.5, 0.1)), 2.0, 0.12);  // No longer than it may be.
  const double angle = 12.0 * M_PI / 180.0;
  EXPECT_NEAR(top(Fit({3, 0, 0.7}, {std::sin(angle), 0, std::cos(angle)}, 0.75, 0.1)), 1.0, 0.06);
}

TEST(TreeMap, ATwigIsConfirmedByMillimetresAndWoodOfUnknownThicknessIsNot) {
  TreeMap map(TreeMapConfig{}, RadiusProfileConfig{});
  const Eigen::Isometry3d I = Eigen::Isometry3d::Identity();
  const FittedCylinder twig = Fit({3, 0, 0}, {0, 0, 1}, 0.5, 0.005);
  FittedCylinder vague = Fit({4, 0, 0}, {0, 0, 1}, 0.5, 0.03);
  vague.covariance(4, 4) = std::pow(0.3 / (0.03 * 0.03), 2);  // 30 cm of radius
  const int twig_id = map.Add(twig, I, 1), vague_id = map.Add(vague, I, 1);
  for (int scan = 2; scan <= 10; ++scan) {
    map.Observe(twig_id, twig, I, scan);
    map.Observe(vague_id, vague, I, scan);
  }
  EXPECT_TRUE(map.Promote(10).empty());
  EXPECT_TRUE(map.State(twig_id).confirmed);
  EXPECT_FALSE(map.State(vague_id).confirmed);
}

// A thin branch is measured by few of the scans that pass it. Seen from all around it is map; as often
// seen from one side, or a few times, it is not.
TEST(TreeMap, WhatWasSeenFromAllAroundIsMapHoweverSeldom) {
  const auto confirmed = [](int scans, double turn_rad) {
    TreeMap map(TreeMapConfig{}, RadiusProfileConfig{});
    int id = -1;
    for (int i = 0; i < scans; ++i) {
      Eigen::Isometry3d T_map_lidar = Eigen::Isometry3d::Identity();
      T_map_lidar.linear() = Eigen::AngleAxisd(turn_rad * i / scans, Eigen::Vector3d::UnitZ())
                                 .toRotationMatrix();
      T_map_lidar.translation() = T_map_lidar.linear() * Eigen::Vector3d(-3, 0, 0);
      const FittedCylinder fit = Fit({3, 0, 0}, {0, 0, 1}, 0.5, 0.012);
      if (id < 0) {
        id = map.Add(fit, T_map_lidar, 1);
      } else {
        map.Observe(id, fit, T_map_lidar, 1 + 8 * i);
      }
    }
    EXPECT_TRUE(map.Promote(8 * scans).empty());
    return map.State(id).confirmed;
  };
  EXPECT_TRUE(confirmed(30, 2.0 * M_PI));
  EXPECT_FALSE(confirmed(30, 0.3));
  EXPECT_FALSE(confirmed(12, 2.0 * M_PI));
}

TEST(TreeMap, WhatHardlyAScanSawBesideAWellSeenBranchIsNotMap) {
  const auto seen = [](Landmark l, int scans) {
    l.num_scans = scans;
    return l;
  };
  const Landmark branch = seen(Known(0, {0, 0, 0}, {0, 0, 1}, 1.0, 0.05), 370);
  // Fits across it and its neighbour, 12 cm beside it and 15 degrees off.
  const Eigen::Vector3d off(0.26, 0, 0.97);
  EXPECT_EQ(SeparatePieces({branch, seen(Known(1, {0.12, 0, 0}, off, 0.3, 0.045), 13)}).size(), 1u);
  // As often seen, it is a neighbour; thin, a twig; beyond the branch's end, its tip.
  EXPECT_EQ(SeparatePieces({branch, seen(Known(1, {0.12, 0, 0}, off, 0.3, 0.045), 100)}).size(), 2u);
  EXPECT_EQ(SeparatePieces({branch, seen(Known(1, {0.12, 0, 0}, off, 0.3, 0.01), 13)}).size(), 2u);
  EXPECT_EQ(SeparatePieces({branch, seen(Known(1, {0.05, 0, 1.35}, off, 0.3, 0.045), 13)}).size(), 2u);
}

TEST(TreeMap, APieceThatCutsTheCornerOfAnElbowIsNotMap) {
  // A saguaro's arm as it was mapped: out of the trunk, up, and across the corner.
  const auto piece = [](int id, const Eigen::Vector3d& from, const Eigen::Vector3d& to, int scans) {
    Landmark l = Known(id, 0.5 * (from + to), to - from, 0.5 * (to - from).norm(), 0.21);
    l.num_scans = scans;
    return l;
  };
  const Landmark out = piece(0, {5.57, 0, 1.29}, {6.24, 0, 1.88}, 75);
  const Landmark up = piece(1, {6.11, 0, 1.87}, {6.12, 0, 3.87}, 292);
  const auto kept = SeparatePieces({out, up, piece(2, {5.85, 0, 1.29}, {6.20, 0, 2.17}, 22)});
  ASSERT_EQ(kept.size(), 2u);
  EXPECT_EQ(kept[0].id, 0);
  EXPECT_EQ(kept[1].id, 1);
  // Between two that do not meet it is the way from one to the other.
  const Landmark higher = piece(1, {6.5, 0, 2.7}, {6.5, 0, 4.0}, 292);
  EXPECT_EQ(SeparatePieces({out, higher, piece(2, {6.15, 0, 1.8}, {6.5, 0, 2.75}, 22)}).size(), 3u);
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

// A trunk and one branch fix the pose; the ground has to confirm it, and nothing else may fit.
TEST(Relocalizer, ATrunkAndOneBranchAreEnoughOnKnownGround) {
  const std::vector<Landmark> loaded{Known(4, {0, 0, 2}, {0, 0, 1}, 1.0, 0.2),
                                     Known(5, {0.8, 0.2, 2.5}, {0.8, 0.2, 0.5}, 0.6, 0.08)};
  Eigen::Isometry3d truth = Eigen::Isometry3d::Identity();
  truth.rotate(Eigen::AngleAxisd(2.1, Eigen::Vector3d::UnitZ()));
  truth.translation() << 3.0, -1.0, 0.5;
  std::vector<Landmark> local = loaded;
  for (Landmark& l : local) l = TransformLandmark(truth.inverse(), l);
  RelocalizerConfig config;
  EXPECT_FALSE(Relocalize(local, loaded, config));  // Neither gravity nor ground.
  config.upright = true;
  EXPECT_FALSE(Relocalize(local, loaded, config));
  config.loaded_ground = Eigen::Vector3d(0.1, 0.0, 0.0);
  config.local_ground = Eigen::Vector3d(-0.4, 0.0, 0.0);
  const auto found = Relocalize(local, loaded, config);
  ASSERT_TRUE(found);
  EXPECT_LT(LogSe3(found->T_map_local.inverse() * truth).norm(), 0.02);

  config.local_ground = Eigen::Vector3d(0.0, 0.0, 0.0);  // The branch leaves the trunk higher up.
  EXPECT_FALSE(Relocalize(local, loaded, config));
  config.local_ground = Eigen::Vector3d(-0.4, 0.0, 0.0);
  // Another branch of the map that it could be just as well, or nearly.
  for (const double radius : {0.08, 0.09}) {
    std::vector<Landmark> two = loaded;
    two.push_back(Known(6, {-0.8, 0.1, 2.52}, {-0.8, 0.1, 0.5}, 0.6, radius));
    EXPECT_FALSE(Relocalize(local, two, config)) << radius;
  }
}

TEST(BentAxis, AConstantBendIsAParabola) {
  const Eigen::Vector3d b(0.2, -0.1, 0.0);
  for (const int first : {-6, 1}) {  // Knots around the anchor, and on one side of it.
    const BentAxis axis(first, 0.25, std::vector<Eigen::Vector3d>(8, b));
    for (const double s : {-1.7, -0.3, 0.0, 0.11, 0.9, 2.3}) {
      EXPECT_LT((axis.At(s).offset - 0.5 * s * s * b).norm(), 1e-12);
      EXPECT_LT((axis.At(s).slope - s * b).norm(), 1e-12);
    }
    // Nearest line of a parabola over [m - h, m + h]: slope b m, offset b (m^2 / 2 + h^2 / 6).
    const AxisOffset chord = axis.Chord(0.1, 1.3);
    EXPECT_LT((chord.slope - 0.7 * b).norm(), 1e-12);
    EXPECT_LT((chord.offset - (0.5 * 0.7 * 0.7 + 0.6 * 0.6 / 6.0) * b).norm(), 1e-3);
    const BentAxis beside = axis.BesideChord(0.1, 1.3);
    EXPECT_LT((beside.At(0.9).offset - (axis.At(0.9).offset - chord.offset - 0.2 * chord.slope)).norm(), 1e-12);
    EXPECT_LT(beside.Chord(0.1, 1.3).offset.norm() + beside.Chord(0.1, 1.3).slope.norm(), 1e-12);
  }
}

// The fit of the stretch [m - h, m + h] of a parabola along +x that bends by b.
FittedCylinder FitOfParabola(const Eigen::Vector3d& b, double m, double h, double b_sigma) {
  FittedCylinder fit = Fit(Eigen::Vector3d(3.0 + m, 0, 0) + (0.5 * m * m + h * h / 6.0) * b,
                           Eigen::Vector3d::UnitX() + m * b,
                           h,
                           0.04);
  fit.bend_information = Eigen::Matrix2d::Identity() / (b_sigma * b_sigma);
  fit.bend_vector = fit.bend_information * PerpendicularBasis(fit.cylinder.axis).transpose() * b;
  return fit;
}

// Stretches of a bent branch, each fitted by the straight line nearest to it, make one landmark that
// bends as it does about the line of the graph; merging does not change that.
TEST(TreeMap, ABentBranchKeepsItsCourse) {
  const Eigen::Vector3d b(0.0, 0.1, 0.12);
  const Eigen::Isometry3d I = Eigen::Isometry3d::Identity();
  TreeMap map(TreeMapConfig{}, RadiusProfileConfig{});
  const int id = map.Add(FitOfParabola(b, -0.3, 0.6, 0.03), I, 1);
  for (int scan = 2; scan < 12; ++scan) {
    map.Observe(id, FitOfParabola(b, 0.1 * (scan % 6) - 0.3, 0.5, 0.03), I, scan);
  }
  // As the graph does: the line nearest to all that was seen.
  const auto set_line = [&] {
    const Landmark seen = map.Summary(id);
    const double x0 = seen.cylinder.point.x() - 3.0, dx = seen.cylinder.axis.x();
    const double lo = x0 + std::min(seen.s_min_m * dx, seen.s_max_m * dx);
    const double hi = x0 + std::max(seen.s_min_m * dx, seen.s_max_m * dx);
    Cylinder nearest = FitOfParabola(b, 0.5 * (lo + hi), 0.5 * (hi - lo), 0.03).cylinder;
    const Cylinder& now = map.State(id).line;  // Its anchor and its sense stay.
    nearest.point += (now.point.x() - nearest.point.x()) / nearest.axis.x() * nearest.axis;
    if (nearest.axis.dot(now.axis) < 0.0) nearest.axis = -nearest.axis;
    map.SetLine(id, nearest, 1e-4 * Matrix5d::Identity());
  };
  set_line();
  const auto check = [&](const Landmark& l) {
    for (const double s : {0.9 * l.s_min_m, 0.0, 0.9 * l.s_max_m}) {
      const Eigen::Vector3d p = l.PointAt(s);
      const double x = p.x() - 3.0;
      EXPECT_LT((p - Eigen::Vector3d(p.x(), 0, 0) - 0.5 * x * x * b).norm(), 0.006) << s;
      EXPECT_GT(std::abs(l.AxisAt(s).dot((Eigen::Vector3d::UnitX() + x * b).normalized())),
                std::cos(2.0 * M_PI / 180.0))
          << s;
    }
  };
  const Landmark whole = map.Summary(id);
  EXPECT_GT(whole.s_max_m - whole.s_min_m, 1.2);
  check(whole);
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  T.rotate(Eigen::AngleAxisd(1.0, Eigen::Vector3d(1, 2, 3).normalized()));
  T.translation() << 1, -2, 0.5;
  check(TransformLandmark(T.inverse(), TransformLandmark(T, whole)));
  // What is compared with a fit is the line nearest to the same stretch.
  const FittedCylinder tip = FitOfParabola(b, 0.45, 0.2, 0.03);
  const LineResidual r =
      ComputeLineResidual(tip, whole, I, Matrix6d::Zero(), DataAssociationConfig{});
  EXPECT_LT(r.residual.head<2>().norm(), 0.02);
  EXPECT_LT(r.residual.tail<2>().norm(), 0.005);

  const int other = map.Add(FitOfParabola(b, 0.4, 0.4, 0.03), I, 12);
  map.Merge({id, other});
  set_line();
  check(map.Summary(id));
}

// Two pieces of one trunk that share a stretch, and a third that lies within the first.
TEST(SeparatePieces, CutsInTheMiddleOfTheCommonStretchAndDropsWhatLiesWithin) {
  const auto piece = [](int id, double z, double half, double x) {
    Landmark l;
    l.id = id;
    l.cylinder.axis = Eigen::Vector3d::UnitZ();
    l.cylinder.point = {x, 0.0, z};
    l.cylinder.curvature = 5.0;
    l.s_min_m = -half;
    l.s_max_m = half;
    l.profile = {{0.0, 0.2, 0.002, 10}};
    l.covariance = 1e-4 * Matrix5d::Identity();
    l.confirmed = true;
    return l;
  };
  const std::vector<Landmark> out = SeparatePieces(
      {piece(0, 1.0, 1.0, 0.0), piece(1, 2.4, 1.0, 0.01), piece(2, 1.0, 0.3, 0.0), piece(3, 2.0, 1.0, 1.0)});
  ASSERT_EQ(out.size(), 3u);
  EXPECT_EQ(out[0].id, 0);
  EXPECT_EQ(out[1].id, 1);
  EXPECT_EQ(out[2].id, 3);  // A neighbour a metre away stays as it is.
  // The common stretch is z from 1.4 to 2.0.
  EXPECT_NEAR(out[0].cylinder.point.z() + out[0].s_min_m, 0.0, 1e-12);
  EXPECT_NEAR(out[0].cylinder.point.z() + out[0].s_max_m, 1.7, 1e-12);
  EXPECT_NEAR(out[1].cylinder.point.z() + out[1].s_min_m, 1.7, 1e-12);
  EXPECT_NEAR(out[1].cylinder.point.z() + out[1].s_max_m, 3.4, 1e-12);
  EXPECT_NEAR(out[0].RadiusAt(0.0), 0.2, 1e-12);
  EXPECT_NEAR(out[2].s_max_m, 1.0, 1e-12);
}

// What was taken for a thin piece in the middle of a thick stem is no wood; a thin branch that leaves the
// stem at a small angle is.
TEST(SeparatePieces, DropsAThinPieceInsideAThickOneAndKeepsABranchThatLeavesIt) {
  const auto piece = [](int id, const Eigen::Vector3d& from, const Eigen::Vector3d& to, double radius, int scans) {
    Landmark l;
    l.id = id;
    l.cylinder.axis = (to - from).normalized();
    l.cylinder.point = 0.5 * (from + to);
    l.cylinder.curvature = 1.0 / radius;
    l.s_max_m = 0.5 * (to - from).norm();
    l.s_min_m = -l.s_max_m;
    l.profile = {{0.0, radius, 0.002, 10}};
    l.covariance = 1e-4 * Matrix5d::Identity();
    l.num_scans = scans;
    l.confirmed = true;
    return l;
  };
  const Landmark stem = piece(0, {0, 0, 0}, {0, 0, 2}, 0.18, 250);
  const std::vector<Landmark> inside = SeparatePieces({stem, piece(1, {-0.07, -0.1, 1}, {-0.1, 0.08, 2.5}, 0.105, 14)});
  ASSERT_EQ(inside.size(), 1u);
  EXPECT_EQ(inside[0].id, 0);
  EXPECT_NEAR(inside[0].s_max_m, 1.0, 1e-12);  // Nor is the stem cut by it.
  EXPECT_EQ(SeparatePieces({stem, piece(1, {0.05, 0, 1.4}, {0.35, 0, 2.6}, 0.06, 60)}).size(), 2u);
  // Nearly as thick, but hardly ever seen: it does not cut the stem either. Seen often, it goes on with it.
  EXPECT_EQ(SeparatePieces({stem, piece(1, {-0.07, -0.05, 1}, {-0.06, 0.02, 2.5}, 0.15, 18)}).size(), 1u);
  EXPECT_EQ(SeparatePieces({stem, piece(1, {0, 0, 1.4}, {0, 0, 2.6}, 0.17, 100)}).size(), 2u);
  // Two over the same stretch: the well seen one stays, and with it the branch's id, though it is shorter.
  const std::vector<Landmark> same =
      SeparatePieces({piece(5, {-0.53, 0.36, 3.06}, {-1.03, 0.23, 4.03}, 0.0171, 439),
                      piece(37, {-0.37, 0.36, 2.84}, {-0.98, 0.26, 3.90}, 0.0254, 11)});
  ASSERT_EQ(same.size(), 1u);
  EXPECT_EQ(same[0].id, 5);
}

TEST(LevelFactors, JacobiansMatchCentralDifferences) {
  std::mt19937 rng(5);
  for (int i = 0; i < 20; ++i) {
    const Key pose = MakeKey('x', 0), ground = MakeKey('g', 0);
    PointN plane(3);
    plane << test::RandomVector<3>(rng, 0.3);
    Values values;
    const Eigen::Isometry3d T = test::RandomPose(rng);
    values.Insert(pose, Value(T));
    values.Insert(ground, Value(plane));
    const Eigen::Vector3d up =
        (T.linear().transpose() * Eigen::Vector3d::UnitZ() + test::RandomVector<3>(rng, 0.05))
            .normalized();
    test::ExpectJacobianMatches(GravityFactor(pose, up, NoiseModel::Isotropic(2, 0.01)), values);
    test::ExpectJacobianMatches(
        GroundFactor(pose, ground, up, 1.5, NoiseModel::Isotropic(3, 0.02)), values);
  }
}

TEST(LevelFactors, VanishAtTheTruthAndLeaveHeadingFree) {
  Vector6d xi;
  xi << 0.1, -0.2, 1.0, 2.0, 3.0, 4.0;
  const Eigen::Isometry3d T = ExpSe3(xi);
  const Eigen::Vector3d up = T.linear().transpose() * Eigen::Vector3d::UnitZ();
  Values values;
  Eigen::Isometry3d turned = T;
  turned.linear() = Eigen::AngleAxisd(0.7, Eigen::Vector3d::UnitZ()).toRotationMatrix() * T.linear();
  values.Insert(MakeKey('x', 0), Value(turned));
  PointN plane = PointN::Zero(3);
  plane[0] = 1.0;  // The ground at z = 1: the sensor is t_z - 1 above it.
  values.Insert(MakeKey('g', 0), Value(plane));
  const GravityFactor gravity(MakeKey('x', 0), up, NoiseModel::Unit(2));
  const GroundFactor ground(
      MakeKey('x', 0), MakeKey('g', 0), up, T.translation().z() - 1.0, NoiseModel::Unit(3));
  EXPECT_NEAR(gravity.Error(values), 0.0, 1e-18);
  EXPECT_NEAR(ground.Error(values), 0.0, 1e-18);
  EXPECT_THROW(GravityFactor(MakeKey('x', 0), 2.0 * up, NoiseModel::Unit(2)), std::invalid_argument);
}

TEST(OdometryDrift, JacobiansMatchCentralDifferences) {
  std::mt19937 rng(6);
  const Key from = MakeKey('x', 0), to = MakeKey('x', 1), drift = MakeKey('d', 0), later = MakeKey('d', 1);
  for (int i = 0; i < 20; ++i) {
    Values values;
    const Eigen::Isometry3d T_from = test::RandomPose(rng);
    const Eigen::Isometry3d measured = ExpSe3(test::RandomVector<6>(rng, 0.4));
    values.Insert(from, Value(T_from));
    values.Insert(to, Value(Eigen::Isometry3d(T_from * measured * ExpSe3(test::RandomVector<6>(rng, 0.1)))));
    for (const Key key : {drift, later}) {
      values.Insert(key, Value(PointN(test::RandomVector<4>(rng, 0.1))));
    }
    test::ExpectJacobianMatches(DriftingMotionFactor(from,
                                                     to,
                                                     drift,
                                                     measured,
                                                     test::RandomPose(rng).linear(),
                                                     NoiseModel::Isotropic(6, 0.01)),
                                values);
    test::ExpectJacobianMatches(
        DriftChangeFactor(drift, later, {1.0, 0.8, 0.8, 0.5}, NoiseModel::Isotropic(4, 0.02)), values);
  }
}

// One per cent too long and 2 cm up per metre of way, on a motion of 3 m.
TEST(OdometryDrift, ByHand) {
  Eigen::Isometry3d measured = Eigen::Isometry3d::Identity();
  measured.translation() << 3.0, 0.0, 0.0;
  const Eigen::Matrix3d R =  // The sensor hangs upside down: up is its -z.
      Eigen::AngleAxisd(M_PI, Eigen::Vector3d::UnitX()).toRotationMatrix();
  const DriftingMotionFactor factor(
      MakeKey('x', 0), MakeKey('x', 1), MakeKey('d', 0), measured, R, NoiseModel::Unit(6));
  PointN drift(4);
  drift << 0.01 * kDriftWayM, 0.0, 0.0, 0.02 * kDriftWayM;
  EXPECT_LT((factor.Without(drift).translation() - Eigen::Vector3d(2.97, 0.0, 0.06)).norm(), 1e-12);
  EXPECT_THROW(DriftingMotionFactor(
                   MakeKey('x', 0), MakeKey('x', 0), MakeKey('d', 0), measured, R, NoiseModel::Unit(6)),
               std::invalid_argument);
  EXPECT_THROW(DriftChangeFactor(MakeKey('d', 0),
                                 MakeKey('d', 1),
                                 Eigen::Vector4d::Constant(1.5),
                                 NoiseModel::Unit(4)),
               std::invalid_argument);
}

}  // namespace
}  // namespace dendro
