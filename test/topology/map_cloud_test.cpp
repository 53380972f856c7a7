// The map's points and the crowns that they show.

#include "dendro_slam/topology/map_cloud.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>
#include <set>

#include "dendro_slam/topology/crown.h"

namespace dendro {
namespace {

using Eigen::Isometry3d;
using Eigen::Vector3d;
using Eigen::Vector3f;

LabelledScan Scan(std::int64_t stamp_ns, const std::vector<std::pair<Vector3f, Label>>& returns) {
  LabelledScan scan;
  scan.image.stamp_ns = stamp_ns;
  scan.image.rows = 1;
  scan.image.cols = static_cast<int>(returns.size());
  for (const auto& [point, label] : returns) {
    scan.image.point.push_back(point);
    scan.image.range.push_back(point.norm());
    scan.label.push_back(label);
  }
  return scan;
}

Isometry3d At(double x, double y, double z) {
  Isometry3d T = Isometry3d::Identity();
  T.translation() = Vector3d(x, y, z);
  return T;
}

MapCloudConfig Enabled() {
  MapCloudConfig config;
  config.enabled = true;
  return config;
}

TEST(MapCloud, KeepsOnePointPerVoxelAndFollowsThePoses) {
  MapCloud cloud(Enabled());
  const float nan = std::numeric_limits<float>::quiet_NaN();
  cloud.Add(Scan(100,
                 {{{1.001F, 0, 0}, Label::kWood},
                  {{1.009F, 0, 0}, Label::kWood},      // same cube of 2 cm
                  {{1.001F, 0.5F, 0}, Label::kLeaf},
                  {{1.05F, 0.55F, 0.05F}, Label::kLeaf},  // same cube of 10 cm
                  {{2, 0, 0}, Label::kGround},
                  {{2, 1, 0}, Label::kOther},
                  {{nan, nan, nan}, Label::kWood},
                  {{40, 0, 0}, Label::kWood}}),           // beyond max_range_m
            At(0, 0, 0));
  // The next scan, half a metre on, sees the same wood at the same place of the map.
  cloud.Add(Scan(200, {{{0.502F, 0, 0}, Label::kWood}, {{0.602F, 0, 0}, Label::kWood}}),
            At(0.5, 0, 0));
  EXPECT_EQ(cloud.size(), 3U);
  // The graph moves the second pose up by a metre: its point moves, the first scan's do not.
  const std::vector<CloudPoint> points =
      cloud.Points({{100, At(0, 0, 0)}, {150, At(9, 9, 9)}, {200, At(0.5, 0, 1)}});
  ASSERT_EQ(points.size(), 3U);
  EXPECT_LT((points[0].position - Vector3d(1.001, 0, 0)).norm(), 1e-6);
  EXPECT_LT((points[1].position - Vector3d(1.102, 0, 1)).norm(), 1e-6);
  EXPECT_LT((points[2].position - Vector3d(1.001, 0.5, 0)).norm(), 1e-6);
  EXPECT_EQ(points[1].label, Label::kWood);
  EXPECT_EQ(points[2].label, Label::kLeaf);
  // A scan whose pose is gone takes its points with it.
  EXPECT_EQ(cloud.Points({{100, At(0, 0, 0)}}).size(), 2U);
  cloud.Reset();
  EXPECT_TRUE(cloud.Points({{100, At(0, 0, 0)}}).empty());
}

TEST(MapCloud, IsBoundedAndCoarsensEvenly) {
  MapCloudConfig config = Enabled();
  config.max_points = 2000;
  config.max_range_m = 100.0;
  MapCloud cloud(config);
  std::mt19937 rng(3);
  std::uniform_real_distribution<float> coordinate(-5.0F, 5.0F);
  std::vector<StampedPose> poses;
  for (int scan = 0; scan < 20; ++scan) {
    std::vector<std::pair<Vector3f, Label>> returns;
    for (int i = 0; i < 1000; ++i) {
      returns.push_back({{coordinate(rng), coordinate(rng), coordinate(rng)}, Label::kWood});
    }
    poses.push_back({scan, At(0, 0, 0)});
    cloud.Add(Scan(scan, returns), At(0, 0, 0));
    EXPECT_LE(cloud.size(), 2000U);
  }
  // A cube of 10 m, 2 cm doubled until at most 2000 cubes are filled: 1.28 m, 512 to 729 of them.
  const std::vector<CloudPoint> points = cloud.Points(poses);
  std::set<std::tuple<int, int, int>> cells;
  for (const CloudPoint& p : points) {
    const auto cell = [](double v) { return static_cast<int>(std::floor(v / 1.28)); };
    cells.insert({cell(p.position.x()), cell(p.position.y()), cell(p.position.z())});
  }
  EXPECT_EQ(cells.size(), points.size());
  EXPECT_GE(points.size(), 500U);
  // What was saved goes on where it was.
  MapCloud again(config);
  again.Restore(points);
  const std::vector<CloudPoint> restored = again.Points({});
  ASSERT_FALSE(restored.empty());
  EXPECT_LT((restored[0].position - points[0].position).norm(), 1e-5);
}

TEST(MapCloud, RefusesBadSettings) {
  MapCloudConfig config;
  config.wood_voxel_m = 0.0;
  EXPECT_THROW(MapCloud{config}, std::invalid_argument);
  config = MapCloudConfig();
  config.max_points = 10;
  EXPECT_THROW(MapCloud{config}, std::invalid_argument);
}

TreeModel TrunkAndBranch() {
  TreeModel model;
  MapCylinder trunk;
  trunk.id = 0;
  trunk.tree_id = 0;
  trunk.branch_id = 0;
  trunk.end = Vector3d(0, 0, 4);
  trunk.radius_m = 0.2;
  MapCylinder branch = trunk;
  branch.id = 1;
  branch.branch_id = 1;
  branch.start = Vector3d(0.2, 0, 3);
  branch.end = Vector3d(2.2, 0, 3);
  branch.radius_m = 0.05;
  branch.taper_m_per_m = -0.02;
  MapCylinder other = trunk;
  other.id = 2;
  other.tree_id = 1;
  other.branch_id = 2;
  other.start = Vector3d(6, 0, 0);
  other.end = Vector3d(6, 0, 4);
  model.cylinders = {trunk, branch, other};
  MapTree tree;
  model.trees = {tree, tree};
  model.trees[1].id = 1;
  return model;
}

TEST(AssignPoints, WoodToItsBranchLeavesToTheirTree) {
  const TreeModel model = TrunkAndBranch();
  const auto point = [](double x, double y, double z, Label label) {
    CloudPoint p;
    p.position = Vector3d(x, y, z);
    p.label = label;
    return p;
  };
  std::vector<CloudPoint> points = {
      point(0, 0.21, 1, Label::kWood),      // 1 cm off the trunk
      point(1.2, 0.05, 3, Label::kWood),    // on the branch, whose radius is 5 cm there
      point(0, 0, 1, Label::kWood),         // on the trunk's axis: 20 cm inside
      point(3, 3, 1, Label::kWood),         // far from all
      point(2.0, 0.6, 3.2, Label::kLeaf),   // 0.6 m from the branch
      point(5.5, 0.1, 3.0, Label::kLeaf),   // beside the other tree
      point(3.6, 3.0, 2.0, Label::kLeaf)};  // more than a metre from all wood
  AssignPoints(model, 0.06, 1.0, &points);
  const std::vector<std::pair<int, int>> expected = {
      {0, 0}, {0, 1}, {-1, -1}, {-1, -1}, {0, -1}, {1, -1}, {-1, -1}};
  for (std::size_t i = 0; i < points.size(); ++i) {
    EXPECT_EQ(points[i].tree_id, expected[i].first) << i;
    EXPECT_EQ(points[i].branch_id, expected[i].second) << i;
  }
}

/// Points of an ellipsoid: half of them spread evenly inside, half on its surface. Points inside
/// alone make a body that is smaller by about half their spacing all round.
std::vector<Vector3d> Ellipsoid(const Vector3d& centre, const Vector3d& half, int count) {
  std::mt19937 rng(7);
  std::uniform_real_distribution<double> unit(-1.0, 1.0);
  std::vector<Vector3d> points;
  while (static_cast<int>(points.size()) < count) {
    Vector3d p(unit(rng), unit(rng), unit(rng));
    if (p.norm() > 1.0 || p.norm() < 1e-3) continue;
    if (points.size() % 2 == 1) p.normalize();
    points.push_back(centre + half.cwiseProduct(p));
  }
  return points;
}

TEST(Crown, BallAndEllipsoidByTheirFormulas) {
  for (const Vector3d& half : {Vector3d(2, 2, 2), Vector3d(2.5, 1.5, 3)}) {
    const std::vector<Vector3d> points = Ellipsoid({1, 2, 6}, half, 20000);
    const auto crown = MeasureCrown(points, 1.0, 0.5);
    ASSERT_TRUE(crown);
    std::vector<double> heights;
    for (const Vector3d& p : points) heights.push_back(p.z() - 1.0);
    std::sort(heights.begin(), heights.end());
    const double volume = 4.0 / 3.0 * M_PI * half.prod(), area = M_PI * half.x() * half.y();
    EXPECT_NEAR(crown->volume_m3 / volume, 1.0, 0.04);
    EXPECT_LE(crown->volume_m3, volume);
    EXPECT_NEAR(crown->projected_area_m2 / area, 1.0, 0.03);
    EXPECT_NEAR(crown->hull_volume_m3 / volume, 1.0, 0.04);
    EXPECT_NEAR(crown->hull_area_m2 / area, 1.0, 0.03);
    EXPECT_NEAR(crown->base_height_m, heights[400], 0.01);
    EXPECT_NEAR(crown->top_height_m, heights[19599], 0.01);
    EXPECT_EQ(crown->num_points, 20000);
  }
}

TEST(Crown, AHollowOnePartsAndABowlAreNotFilled) {
  // Two balls: the hull spans the gap, the crown does not.
  std::vector<Vector3d> points = Ellipsoid({0, 0, 5}, {1, 1, 1}, 8000);
  for (const Vector3d& p : Ellipsoid({6, 0, 5}, {1, 1, 1}, 8000)) points.push_back(p);
  const auto two = MeasureCrown(points, 0.0, 0.5);
  ASSERT_TRUE(two);
  EXPECT_NEAR(two->volume_m3, 2.0 * 4.0 / 3.0 * M_PI, 0.4);
  EXPECT_GT(two->hull_volume_m3, 2.0 * two->volume_m3);
  EXPECT_NEAR(two->projected_area_m2, 2.0 * M_PI, 0.2);
  // A shell from 1.6 to 2 m: a ball of half a metre fits into its hollow.
  std::vector<Vector3d> shell;
  const Vector3d middle(0, 0, 5);
  for (const Vector3d& p : Ellipsoid(middle, {2, 2, 2}, 20000)) {
    const double r = (p - middle).norm();
    shell.push_back(r >= 1.6 ? p : Vector3d(middle + (p - middle) * (1.6 / r)));
  }
  const auto hollow = MeasureCrown(shell, 0.0, 0.5);
  ASSERT_TRUE(hollow);
  EXPECT_NEAR(hollow->volume_m3 / (4.0 / 3.0 * M_PI * (8.0 - 4.096)), 1.0, 0.06);
}

TEST(Crown, TooLittleIsNone) {
  EXPECT_FALSE(MeasureCrown({}, 0.0, 0.5));
  EXPECT_FALSE(MeasureCrown(Ellipsoid({0, 0, 0}, {1, 1, 1}, 9), 0.0, 0.5));
  EXPECT_FALSE(MeasureCrown(Ellipsoid({0, 0, 3}, {1, 1, 0}, 500), 0.0, 0.5));       // flat
  EXPECT_FALSE(MeasureCrown(std::vector<Vector3d>(50, {1, 2, 3}), 0.0, 0.5));       // one place
  EXPECT_FALSE(MeasureCrown(Ellipsoid({0, 0, 3}, {50, 50, 50}, 20), 0.0, 0.5));     // all strays
  EXPECT_THROW(MeasureCrown({}, 0.0, 0.0), std::invalid_argument);
  EXPECT_THROW(MeasureCrown({{0, 0, std::nan("")}}, 0.0, 0.5), std::invalid_argument);
}

TEST(Crown, OfEveryTreeFromItsOwnLeaves) {
  TreeModel model = TrunkAndBranch();
  std::vector<CloudPoint> points;
  for (const Vector3d& p : Ellipsoid({0, 0, 4}, {1.5, 1.5, 1.0}, 8000)) {
    CloudPoint point;
    point.position = p;
    point.label = Label::kLeaf;
    points.push_back(point);
    point.position.z() = 0.1;  // grass at the foot
    if (points.size() % 100 == 0) points.push_back(point);
  }
  AssignPoints(model, 0.06, 2.0, &points);
  MeasureCrowns(points, 0.5, &model);
  ASSERT_TRUE(model.trees[0].crown);
  EXPECT_FALSE(model.trees[1].crown);
  EXPECT_NEAR(model.trees[0].crown->volume_m3, 4.0 / 3.0 * M_PI * 2.25, 0.5);
  EXPECT_GT(model.trees[0].crown->base_height_m, 2.9);
}

}  // namespace
}  // namespace dendro
