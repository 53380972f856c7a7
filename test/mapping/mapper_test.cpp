#include "dendro_slam/mapping/mapper.h"

#include <malloc.h>

#include <cmath>
#include <limits>

#include <gtest/gtest.h>

#include "dendro_slam/mapping/pipeline.h"
#include "synthetic_tree.h"

namespace dendro {
namespace {

using namespace dendro_test;

Eigen::Isometry3d TruthFromMap(const FlightResult& flight, const Mapper& mapper) {
  return flight.truth.front() * mapper.Trajectory().front().T_map_lidar.inverse();
}

// Trunks and branches are chains of pieces whose middles are at least `max_reach_m` apart.
std::size_t MostPieces(const std::vector<TrueBranch>& branches) {
  const double spacing = MapperConfig().association.max_reach_m;
  std::size_t most = 0;
  for (const TrueBranch& b : branches) {
    most += 1 + static_cast<std::size_t>(b.Length() / spacing);
  }
  return most;
}

void ExpectGoodMap(const Mapper& mapper,
                   const FlightResult& flight,
                   const World& world,
                   double ate_limit) {
  const double ate = TrajectoryAte(flight, mapper);
  const MapScore score =
      Score(mapper.Landmarks(), world.branches(), TruthFromMap(flight, mapper));
  int within1 = 0;
  for (double sigmas : score.radius_error_sigmas) within1 += sigmas < 1.0 ? 1 : 0;
  std::printf(
      "ATE %.3f m (odometry %.3f), %d key frames, %zu landmarks on %d branches, %d false, radius "
      "median %.2f %%, within one sigma %.0f %%, axis median %.2f deg\n",
      ate,
      flight.odometry_ate,
      mapper.num_key_frames(),
      mapper.Landmarks().size(),
      score.branches_found,
      score.false_count,
      100.0 * Median(score.radius_error_rel),
      100.0 * within1 / std::max<std::size_t>(1, score.radius_error_sigmas.size()),
      Median(score.axis_error_rad) * 180.0 / M_PI);
  EXPECT_LT(ate, ate_limit);
  EXPECT_EQ(score.branches_found, static_cast<int>(world.branches().size()));
  EXPECT_EQ(score.false_count, 0);
  EXPECT_LE(mapper.Landmarks().size(), MostPieces(world.branches()));
  EXPECT_LT(Median(score.radius_error_rel), 0.01);
  EXPECT_LT(Median(score.axis_error_rad), M_PI / 180.0);
}

TEST(Mapper, MapsATreeBetterThanTheOdometryFlies) {
  World world(ThesisLikeTree(), 1);
  Mapper mapper;
  const FlightResult flight = Fly(&mapper, &world, {});
  ExpectGoodMap(mapper, flight, world, 0.03);
  EXPECT_LT(TrajectoryAte(flight, mapper), 0.5 * flight.odometry_ate);
  // The map frame is the odometry's at the start.
  EXPECT_LT(mapper.Trajectory().front().T_map_lidar.translation().norm(), 1e-3);
  for (const MapperResult& result : flight.results) {
    EXPECT_LE(result.error_after, result.error_before * (1.0 + 1e-9) + 1e-9);
  }
}

TEST(Mapper, ARelocalisationJumpDoesNotBendTheMap) {
  World world(ThesisLikeTree(), 2);
  Mapper mapper;
  FlightOptions options;
  options.jump_at = 400;
  const FlightResult flight = Fly(&mapper, &world, options);
  ExpectGoodMap(mapper, flight, world, 0.03);
  int rejected = 0;
  for (const MapperResult& result : flight.results) rejected += result.odometry_rejected ? 1 : 0;
  EXPECT_GE(rejected, 1);
  EXPECT_LE(rejected, 5);
  // The transform to the odometry frame takes the jump.
  EXPECT_GT(mapper.T_map_odom().translation().norm(), 0.3);
}

TEST(Mapper, AJumpWithoutIcpIsFoundByTheMap) {
  World world(ThesisLikeTree(), 3);
  Mapper mapper;
  FlightOptions options;
  options.jump_at = 400;
  options.icp = false;
  const FlightResult flight = Fly(&mapper, &world, options);
  ExpectGoodMap(mapper, flight, world, 0.03);
}

TEST(Mapper, WithoutIcp) {
  World world(ThesisLikeTree(), 4);
  Mapper mapper;
  FlightOptions options;
  options.icp = false;
  ExpectGoodMap(mapper, Fly(&mapper, &world, options), world, 0.03);
}

TEST(Mapper, WithoutVio) {
  World world(ThesisLikeTree(), 5);
  Mapper mapper;
  FlightOptions options;
  options.vio = false;
  const FlightResult flight = Fly(&mapper, &world, options);
  ExpectGoodMap(mapper, flight, world, 0.05);
  EXPECT_LT(mapper.T_map_odom().translation().norm(), 1e-9);
}

TEST(Mapper, VioLostForFiveSeconds) {
  World world(ThesisLikeTree(), 6);
  Mapper mapper;
  FlightOptions options;
  options.vio_lost_from = 300;
  options.vio_lost_to = 350;
  ExpectGoodMap(mapper, Fly(&mapper, &world, options), world, 0.03);
}

// Round a lone trunk nothing but the odometry tells how far the way has gone round. What it had too much
// where branches were in view is known then.
TEST(Mapper, TheOdometrysScaleIsLearntWhereBranchesAreInView) {
  FlightOptions options;
  options.vio_scale = 1.02;
  options.trunk_only_from = 500;
  options.climb = 0.02;
  MapperConfig ignorant;
  ignorant.vio_scale_sigma = 0.0;
  ignorant.vio_drift_m_per_m = 0.0;
  double with = 0.0, without = 0.0;
  for (const int seed : {21, 22, 23}) {
    World world(ThesisLikeTree(), seed), same(ThesisLikeTree(), seed);
    Mapper learning, other(ignorant);
    const FlightResult flight = Fly(&learning, &world, options);
    with += TrajectoryAte(flight, learning);
    without += TrajectoryAte(Fly(&other, &same, options), other);
  }
  std::printf("ATE %.3f m, with the scale unknown %.3f m\n", with / 3.0, without / 3.0);
  EXPECT_LT(with, 0.7 * without);
}

TEST(Mapper, ATrunkDoesNotLoseItsTaper) {
  World world({ThesisLikeTree()[0], ThesisLikeTree()[1]}, 7);
  Mapper mapper;
  FlightOptions options;
  options.z0 = 0.8;
  options.climb = 0.05;
  const FlightResult flight = Fly(&mapper, &world, options);
  const MapScore score = Score(mapper.Landmarks(), world.branches(), TruthFromMap(flight, mapper));
  EXPECT_EQ(score.branches_found, 2);
  ASSERT_GT(score.radius_error_rel.size(), 8u);
  // At every height, not only on average: the trunk goes from 20 to 12 cm.
  for (double error : score.radius_error_rel) EXPECT_LT(error, 0.04);
}

TEST(Mapper, CollinearBranchesWithAGapStayTwo) {
  std::vector<TrueBranch> branches = ThesisLikeTree();
  const Eigen::Vector3d a(0.9, 0.15, 2.55), d = Eigen::Vector3d(1.8, 0.3, 1.1).normalized();
  branches[1] = {{0, 0, 2.0}, {0.9, 0.15, 2.55}, 0.06, 0.06};
  branches.push_back({a + 0.5 * d, a + 1.5 * d, 0.06, 0.06});
  World world(branches, 8);
  Mapper mapper;
  const FlightResult flight = Fly(&mapper, &world, {});
  const MapScore score = Score(mapper.Landmarks(), branches, TruthFromMap(flight, mapper));
  EXPECT_EQ(score.branches_found, 5);
  EXPECT_EQ(score.false_count, 0);
}

TEST(Mapper, AlongALoneTrunkTheDriftIsBoundedByTheOdometry) {
  World world({{{0, 0, -1}, {0, 0, 12}, 0.2, 0.18}}, 9);
  Mapper mapper;
  FlightOptions options;
  options.icp = false;
  options.climb = 0.08;
  const FlightResult flight = Fly(&mapper, &world, options);
  // Neither the motion along the trunk nor that around it is observable: both stay with the
  // odometry, and the pose covariance says so.
  EXPECT_LT(TrajectoryAte(flight, mapper), 1.6 * flight.odometry_ate + 0.03);
  const Matrix6d P = flight.results.back().pose_covariance;
  const Eigen::Matrix3d R = flight.results.back().T_map_lidar.linear();
  const double sigma_z = std::sqrt((R * P.bottomRightCorner<3, 3>() * R.transpose())(2, 2));
  EXPECT_GT(sigma_z, 0.03);
  EXPECT_LT(sigma_z, 0.5);
  EXPECT_LE(mapper.Landmarks().size(), MostPieces(world.branches()));
}

TEST(Mapper, FalseDetectionsDoNotEnterTheMap) {
  World world(ThesisLikeTree(), 10);
  Mapper mapper;
  DriftingOdometry odometry(&world);
  for (int i = 0; i < 300; ++i) {
    const Eigen::Isometry3d T = CirclePose(0.1 * i, 4.0, 1.0, 1.2, 0.0);
    MapperInput input;
    input.stamp_ns = 100000000LL * (i + 1);
    input.cylinders = world.Scan(T);
    // A clump of leaves that looks like a cylinder, elsewhere every time.
    const Eigen::Vector3d p(2.0 * world.Normal(), 2.0 * world.Normal(), 2.0 + world.Normal());
    const TrueBranch ghost{p, p + Eigen::Vector3d(world.Normal(), world.Normal(), world.Normal()), 0.05, 0.05};
    if (auto fit = world.Observe(ghost, T, 7)) input.cylinders.push_back(*fit);
    input.T_odom_lidar = odometry.Next(T);
    mapper.AddScan(input);
  }
  EXPECT_LE(mapper.Landmarks().size(), MostPieces(world.branches()));
}

TEST(Mapper, ACrowdOfPassingFitsDoesNotHideTheMap) {
  // Thirty fits around the sensor that never come again, in every scan: nearer than the tree, and
  // many more. The tree has to be recognised all the same, or its pieces would be started anew.
  World world(ThesisLikeTree(), 16);
  MapperConfig config;
  config.nearby_max = 50;
  Mapper mapper(config);
  DriftingOdometry odometry(&world);
  std::size_t most = 0;
  for (int i = 0; i < 300; ++i) {
    const Eigen::Isometry3d T = CirclePose(0.1 * i, 4.0, 1.0, 1.2, 0.0);
    MapperInput input;
    input.stamp_ns = 100000000LL * (i + 1);
    input.cylinders = world.Scan(T);
    for (int k = 0; k < 30; ++k) {
      const Eigen::Vector3d p = T * Eigen::Vector3d(-1.5 + 0.7 * world.Normal(), world.Normal(), 0.0);
      const Eigen::Vector3d d(world.Normal(), world.Normal(), world.Normal());
      const TrueBranch ghost{p, p + d, 0.03, 0.03};
      if (auto fit = world.Observe(ghost, T, 10 + k)) input.cylinders.push_back(*fit);
    }
    input.T_odom_lidar = odometry.Next(T);
    mapper.AddScan(input);
    most = std::max(most, mapper.Snapshot().landmarks.size());
  }
  std::size_t confirmed = 0;
  for (const LandmarkState& state : mapper.Snapshot().landmarks) confirmed += state.confirmed ? 1 : 0;
  EXPECT_LE(confirmed, MostPieces(world.branches()));
  EXPECT_GE(confirmed, 3u);  // Of four: one is out of sight of a level path.
  EXPECT_GT(most, 200u);  // They were a crowd.
  EXPECT_LT(most, 1000u);
}

// Memory that is in use on the heap [bytes]; 0 where the allocator does not tell (sanitizers).
double HeapInUse() {
  const struct mallinfo2 info = mallinfo2();
  return static_cast<double>(info.uordblks) + static_cast<double>(info.hblkhd);
}

// Stems on a grid, 2.5 m apart.
std::vector<TrueBranch> Stems(int side) {
  std::vector<TrueBranch> stems;
  for (int i = 0; i < side * side; ++i) {
    const Eigen::Vector3d foot(2.5 * (i % side - 0.5 * (side - 1)), 2.5 * (i / side - 0.5 * (side - 1)), 0.0);
    stems.push_back({foot, foot + Eigen::Vector3d(0.05, 0.0, 3.0), 0.09, 0.07});
  }
  return stems;
}

TEST(Mapper, WhatIsNotLookedForIsNotBegunASecondTime) {
  // A scan shows more of the map than is looked for. The stems beyond must not be begun anew: their twins
  // would push more of the map out of reach, which would get twins, without end.
  World world(Stems(5), 18);
  MapperConfig config;
  config.nearby_max = 10;
  Mapper mapper(config);
  DriftingOdometry odometry(&world);
  for (int i = 0; i < 900; ++i) {
    const Eigen::Isometry3d T = CirclePose(0.1 * i, 4.0, 1.0, 1.5, 0.0);
    MapperInput input;
    input.stamp_ns = 100000000LL * (i + 1);
    // They come into sight one after the other.
    for (const FittedCylinder& fit : world.Scan(T)) {
      if (fit.segment_id < 5 + i / 20) input.cylinders.push_back(fit);
    }
    input.T_odom_lidar = odometry.Next(T);
    mapper.AddScan(input);
  }
  std::size_t confirmed = 0;
  for (const LandmarkState& state : mapper.Snapshot().landmarks) confirmed += state.confirmed ? 1 : 0;
  EXPECT_LE(confirmed, MostPieces(world.branches()));
  EXPECT_GE(confirmed, world.branches().size() - 1);
}

// A post that one key frame saw whole and another one in two pieces, and now and then a scan between key
// frames, so that it stays a candidate: when the second of them goes, so would all that holds the post.
TEST(Mapper, AKeyFrameThatSawACandidateTwiceStaysForIt) {
  World world(ThesisLikeTree(), 23);
  MapperConfig config;
  config.key_frame_window = 20;
  Mapper mapper(config);
  DriftingOdometry odometry(&world);
  const auto post = [](const Eigen::Isometry3d& T_map_lidar, double low, double high) {
    FittedCylinder fit;
    fit.status = FitStatus::kMeasured;
    fit.cylinder = TransformCylinder(
        T_map_lidar.inverse(), Cylinder{Eigen::Vector3d::UnitZ(), {1.2, 1.2, 2.0 + 0.5 * (low + high)}, 1.0 / 0.03});
    Vector5d sigma;
    sigma << 0.02, 0.02, 0.01, 0.01, 0.1 / 0.03;
    fit.covariance = sigma.cwiseAbs2().asDiagonal();
    fit.start_s_m = -0.5 * (high - low);
    fit.end_s_m = 0.5 * (high - low);
    fit.num_points = 40;
    fit.num_rings = 4;
    fit.distance_m = 3.0;
    fit.visible_arc_rad = 1.0;
    return fit;
  };
  constexpr int kLap = 252, kShown = 8 * kLap;
  int with_post = 0;  // Key frames.
  int last_seen = 0;
  for (int i = 0; i < 11 * kLap; ++i) {
    const Eigen::Isometry3d T = CirclePose(0.1 * i, 4.0, 1.0, 2.0, 0.0);
    MapperInput input;
    input.stamp_ns = 100000000LL * (i + 1);
    input.cylinders = world.Scan(T);
    const std::size_t own = input.cylinders.size();
    if (i >= kShown && with_post == 0) input.cylinders.push_back(post(T, -0.6, 0.6));
    if (i >= kShown && with_post == 1) {
      input.cylinders.push_back(post(T, -0.6, -0.1));
      input.cylinders.push_back(post(T, 0.1, 0.6));
    }
    if (with_post == 2 && i == last_seen + 201) {
      input.cylinders.push_back(post(T, -0.6, 0.6));
    }
    for (std::size_t k = own; k < input.cylinders.size(); ++k) input.cylinders[k].segment_id = 100 + static_cast<int>(k);
    input.T_odom_lidar = odometry.Next(T);
    const MapperResult result = mapper.AddScan(input);
    if (input.cylinders.size() > own) {
      last_seen = i;
      if (with_post < 2 && result.is_key_frame) ++with_post;
    }
  }
  EXPECT_EQ(with_post, 2);
}

TEST(Mapper, LapsLeaveMemoryWhereItWas) {
  // The circle's height is the border of two of the cubes in which key frames are looked up.
  World world(ThesisLikeTree(), 19);
  MapperConfig config;
  config.key_frame_window = 20;
  Mapper mapper(config);
  DriftingOdometry odometry(&world);
  constexpr int kLap = 252;  // Scans.
  double before = 0.0;
  int kept_before = 0;
  for (int i = 0; i < 18 * kLap; ++i) {
    if (i == 6 * kLap) {
      before = HeapInUse();
      kept_before = mapper.num_kept_key_frames();
    }
    const Eigen::Isometry3d T = CirclePose(0.1 * i, 4.0, 1.0, 2.0, 0.0);
    MapperInput input;
    input.stamp_ns = 100000000LL * (i + 1);
    input.cylinders = world.Scan(T);
    input.T_odom_lidar = odometry.Next(T);
    mapper.AddScan(input);
  }
  const int kept = mapper.num_kept_key_frames();
  EXPECT_LE(kept, kept_before + 8);
  // What may grow: the path, its capacity up to twice its length, and a tenth of the graph.
  constexpr double kPathBytesPerScan = 2.0 * 160.0;
  const double grown = HeapInUse() - before;
  std::printf("kept key frames %d after 6 laps, %d after 18; heap %.2f MB and %.2f MB more\n",
              kept_before,
              kept,
              1e-6 * before,
              1e-6 * grown);
  if (before > 0.0) {
    EXPECT_LE(grown, 12 * kLap * kPathBytesPerScan + 0.1 * before);
  }
}

TEST(Mapper, FewExactCovariancesMapATreeAsWell) {
  World world(ThesisLikeTree(), 17), same_world(ThesisLikeTree(), 17);
  MapperConfig config;
  config.nearby_exact = 2;
  Mapper mapper(config), exact;
  const double exact_ate = TrajectoryAte(Fly(&exact, &same_world, {}), exact);
  EXPECT_LT(exact_ate, 0.04);
  ExpectGoodMap(mapper, Fly(&mapper, &world, {}), world, 1.15 * exact_ate);
}

TEST(Mapper, ASecondSessionFindsItselfAndKeepsTheIds) {
  World world(ThesisLikeTree(), 11);
  Mapper first;
  const FlightResult flight1 = Fly(&first, &world, {});
  const std::vector<Landmark> before = first.Landmarks();
  const MapScore score1 = Score(before, world.branches(), TruthFromMap(flight1, first));
  const MapSnapshot snapshot = first.Snapshot();

  Mapper second;
  second.Load(snapshot);
  EXPECT_TRUE(second.relocalizing());
  FlightOptions options;
  options.start_time = 8.4;  // 120 degrees farther on, 3 m higher up in its own odometry frame
  options.z0 = 1.5;
  const FlightResult flight2 = Fly(&second, &world, options);
  ASSERT_FALSE(second.relocalizing());
  const std::vector<Landmark> after = second.Landmarks();
  // The same landmarks under the same ids; the second flight, higher up, may add a piece of trunk.
  EXPECT_GE(after.size(), before.size());
  EXPECT_LE(after.size(), MostPieces(world.branches()));
  for (const Landmark& l : before) {
    bool kept = false;
    for (const Landmark& m : after) kept = kept || (m.id == l.id && m.num_scans > l.num_scans);
    EXPECT_TRUE(kept) << "landmark " << l.id;
  }
  const MapScore score2 = Score(after, world.branches(), TruthFromMap(flight1, first));
  EXPECT_EQ(score2.branches_found, 4);
  EXPECT_EQ(score2.false_count, 0);
  std::printf("radius median %.2f %% after one session, %.2f %% after two\n",
              100 * Median(score1.radius_error_rel),
              100 * Median(score2.radius_error_rel));
  EXPECT_LE(Median(score2.radius_error_rel), Median(score1.radius_error_rel) * 1.2 + 0.001);
  // The pose is in the loaded map's frame.
  const Eigen::Isometry3d T_truth_map = TruthFromMap(flight1, first);
  EXPECT_LT(((T_truth_map * flight2.results.back().T_map_lidar).translation() -
             flight2.truth.back().translation())
                .norm(),
            0.1);
}

// Breast height counts from the ground, which a level path from 0.8 m up sees, but not the foot of the trunk.
TEST(TreeMappingStage, ALoadedMapStandsOnItsGround) {
  World world(ThesisLikeTree(), 18);
  TreeMappingStage stage{TreeMappingConfig{}};
  DriftingOdometry odometry(&world);
  for (int i = 0; i < 120; ++i) {
    const Eigen::Isometry3d T = CirclePose(0.1 * i, 4.0, 1.0, 1.8, 0.0);
    MapperInput input;
    input.stamp_ns = 100000000LL * (i + 1);
    input.cylinders = world.Scan(T);
    input.T_odom_lidar = odometry.Next(T);
    GroundPlane ground;
    ground.normal = (T.linear().transpose() * Eigen::Vector3d::UnitZ()).cast<float>();
    ground.offset = static_cast<float>(T.translation().z());
    stage.Process(input, ground);
  }
  const MapFiles saved = stage.Files({});
  ASSERT_EQ(saved.model.trees.size(), 1u);
  ASSERT_TRUE(saved.model.trees[0].dbh_m);
  TreeMappingStage later{TreeMappingConfig{}};
  later.Load(saved);
  const MapFiles again = later.Files({});
  ASSERT_EQ(again.model.trees.size(), 1u);
  EXPECT_NEAR(*again.model.trees[0].dbh_m, *saved.model.trees[0].dbh_m, 1e-9);
  EXPECT_NEAR(again.model.trees[0].height_m, saved.model.trees[0].height_m, 1e-9);
  ASSERT_EQ(again.model.cylinders.size(), saved.model.cylinders.size());
  for (std::size_t i = 0; i < saved.model.cylinders.size(); ++i) {
    EXPECT_EQ(again.model.cylinders[i].id, saved.model.cylinders[i].id);
  }
}

TEST(Mapper, ManyLapsLeaveAGraphOfOne) {
  World world(ThesisLikeTree(), 15);
  MapperConfig config;
  config.key_frames_in_reach = 2;
  config.key_frame_window = 20;
  Mapper mapper(config);
  FlightOptions options;
  options.scans = 2000;  // Eight laps.
  options.climb = 0.0;
  options.z0 = 1.5;
  const FlightResult flight = Fly(&mapper, &world, options);
  EXPECT_LT(TrajectoryAte(flight, mapper), 0.02);
  const MapScore score =
      Score(mapper.Landmarks(), world.branches(), TruthFromMap(flight, mapper));
  EXPECT_GE(score.branches_found, 3);  // Of four: one is out of sight of a level path.
  EXPECT_EQ(score.false_count, 0);
  EXPECT_LT(Median(score.radius_error_rel), 0.01);
  ASSERT_EQ(mapper.Trajectory().size(), flight.truth.size());
  EXPECT_GT(mapper.num_key_frames(), 400);
  // A lap is 25 m long; the newest key frames stay as long as candidates do, 30 s.
  EXPECT_LT(mapper.num_kept_key_frames(), 150);
}

TEST(Mapper, TheThinnedPathIsShortAndEndsWhereThePathDoes) {
  World world(ThesisLikeTree(), 20);
  Mapper mapper;
  EXPECT_TRUE(mapper.ThinnedTrajectory(10).empty());
  FlightOptions options;
  options.scans = 150;
  Fly(&mapper, &world, options);
  const std::vector<StampedPose> all = mapper.Trajectory();
  ASSERT_EQ(all.size(), 150u);
  EXPECT_EQ(mapper.ThinnedTrajectory(200).size(), 150u);
  const std::vector<StampedPose> thin = mapper.ThinnedTrajectory(50);
  ASSERT_EQ(thin.size(), 39u);  // Every fourth, from 0 to 148, and number 149.
  for (std::size_t i = 0; i + 1 < thin.size(); ++i) EXPECT_EQ(thin[i].stamp_ns, all[4 * i].stamp_ns);
  EXPECT_EQ(thin.back().stamp_ns, all.back().stamp_ns);
  EXPECT_EQ(thin.back().T_map_lidar.matrix(), all.back().T_map_lidar.matrix());
}

TEST(Mapper, SameInputSameBytes) {
  std::vector<Landmark> maps[2];
  for (auto& map : maps) {
    World world(ThesisLikeTree(), 12);
    Mapper mapper;
    FlightOptions options;
    options.scans = 150;
    Fly(&mapper, &world, options);
    map = mapper.Landmarks();
  }
  ASSERT_EQ(maps[0].size(), maps[1].size());
  for (std::size_t i = 0; i < maps[0].size(); ++i) {
    EXPECT_EQ(maps[0][i].cylinder.point, maps[1][i].cylinder.point);
    EXPECT_EQ(maps[0][i].covariance, maps[1][i].covariance);
    EXPECT_EQ(maps[0][i].RadiusAt(0.0), maps[1][i].RadiusAt(0.0));
  }
}

TEST(Mapper, BadInputIsRefusedAndTheMapGoesOn) {
  World world(ThesisLikeTree(), 13);
  Mapper mapper;
  FlightOptions options;
  options.scans = 30;
  const FlightResult flight = Fly(&mapper, &world, options);
  MapperInput late;
  late.stamp_ns = flight.results.back().stamp_ns;
  EXPECT_FALSE(mapper.AddScan(late).warning.empty());
  MapperInput bad;
  bad.stamp_ns = flight.results.back().stamp_ns + 100000000;
  bad.cylinders = world.Scan(flight.truth.back());
  bad.cylinders[0].cylinder.point.x() = std::numeric_limits<double>::quiet_NaN();
  if (bad.cylinders.size() > 1) bad.cylinders[1].covariance.setZero();
  bad.T_odom_lidar = Eigen::Isometry3d::Identity();
  bad.T_odom_lidar->translation().x() = std::numeric_limits<double>::infinity();
  EXPECT_TRUE(mapper.AddScan(bad).T_map_lidar.matrix().allFinite());
  MapperInput empty;
  empty.stamp_ns = bad.stamp_ns + 100000000;
  EXPECT_TRUE(mapper.AddScan(empty).T_map_lidar.matrix().allFinite());
  mapper.Reset();
  EXPECT_TRUE(mapper.Landmarks().empty());
  EXPECT_TRUE(mapper.AddScan(empty).is_key_frame);
}

TEST(Mapper, BadSnapshotsAreRefusedAndTheMapStays) {
  World world(ThesisLikeTree(), 14);
  Mapper mapper;
  FlightOptions options;
  options.scans = 60;
  Fly(&mapper, &world, options);
  MapSnapshot snapshot = mapper.Snapshot();
  ASSERT_FALSE(snapshot.landmarks.empty());
  const std::size_t count = mapper.AllLandmarks().size();
  MapSnapshot bad = snapshot;
  bad.landmarks[0].line.point.x() = std::numeric_limits<double>::quiet_NaN();
  EXPECT_THROW(mapper.Load(bad), std::invalid_argument);
  bad = snapshot;
  bad.next_landmark_id = 0;
  EXPECT_THROW(mapper.Load(bad), std::invalid_argument);
  EXPECT_EQ(mapper.AllLandmarks().size(), count);
  EXPECT_FALSE(mapper.relocalizing());
}

}  // namespace
}  // namespace dendro
