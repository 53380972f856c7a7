#include "dendro_slam/topology/tree_topology.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <set>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "landmark_maker.h"

namespace dendro {
namespace {

using Eigen::Vector2d;
using Eigen::Vector3d;
using test::MakeLandmark;
using testing::HasSubstr;

constexpr double kDeg = M_PI / 180.0;

const MapBranch& BranchOf(const TreeModel& model, int landmark_id) {
  for (const MapCylinder& c : model.cylinders) {
    if (c.landmark_id != landmark_id) continue;
    for (const MapBranch& b : model.branches) {
      if (b.id == c.branch_id) return b;
    }
  }
  throw std::runtime_error("landmark " + std::to_string(landmark_id) + " is in no branch");
}

const MapCylinder& CylinderOf(const TreeModel& model, int id) {
  for (const MapCylinder& c : model.cylinders) {
    if (c.id == id) return c;
  }
  throw std::runtime_error("no cylinder " + std::to_string(id));
}

// Every branch is one connected chain whose first cylinder hangs on the parent branch; ids unique.
void ExpectConsistent(const TreeModel& model) {
  std::set<int> ids;
  std::map<int, const MapBranch*> branches;
  for (const MapCylinder& c : model.cylinders) EXPECT_TRUE(ids.insert(c.id).second);
  for (const MapBranch& b : model.branches) EXPECT_TRUE(branches.emplace(b.id, &b).second);
  for (const MapBranch& b : model.branches) {
    ASSERT_FALSE(b.cylinder_ids.empty());
    int position = 0, previous = -1;
    for (const int id : b.cylinder_ids) {
      const MapCylinder& c = CylinderOf(model, id);
      EXPECT_EQ(c.branch_id, b.id);
      EXPECT_EQ(c.tree_id, b.tree_id);
      EXPECT_EQ(c.branch_order, b.order);
      EXPECT_EQ(c.position_in_branch, position++);
      if (previous >= 0) {
        EXPECT_EQ(c.parent_id, previous);
      } else if (b.parent_id >= 0) {
        EXPECT_EQ(CylinderOf(model, c.parent_id).branch_id, b.parent_id);
      } else {
        EXPECT_EQ(c.parent_id, -1);
      }
      previous = id;
    }
    if (b.parent_id >= 0) {
      EXPECT_EQ(b.order, branches.at(b.parent_id)->order + 1);
      EXPECT_EQ(b.tree_id, branches.at(b.parent_id)->tree_id);
    }
  }
  for (const MapTree& t : model.trees) {
    EXPECT_EQ(branches.at(t.trunk_branch_id)->order, 0);
    EXPECT_EQ(branches.at(t.trunk_branch_id)->parent_id, -1);
  }
}

// A trunk in two sections with a gap, two branches on opposite sides, a twig on the first branch.
std::vector<Landmark> SmallTree() {
  return {
      MakeLandmark(3, {0, 0, 0}, {0, 0, 2.0}, 0.20, 0.18),
      MakeLandmark(1, {0, 0, 2.6}, {0, 0, 5.0}, 0.174, 0.15),
      // Leaves the trunk at z = 2, seen from 0.3 m outside its surface on.
      MakeLandmark(7, {0.5, 0, 2.5}, {2.0, 0, 4.0}, 0.06, 0.04),
      MakeLandmark(4, {-0.5, 0, 2.5}, {-2.0, 0, 4.0}, 0.06, 0.04),
      MakeLandmark(9, {1.2, 0.05, 3.2}, {1.2, 0.9, 3.2}, 0.02, 0.015),
  };
}

// A branch that leaves at 60 degrees and bends by 40 degrees a metre: its first cylinder is at 50 in its
// middle, the angle is that at the base, 6 cm along where it comes out of the trunk.
TEST(TreeTopology, TheAngleOfABentBranchIsThatAtItsBase) {
  std::vector<Landmark> landmarks = {MakeLandmark(1, {0, 0, 0}, {0, 0, 5.0}, 0.05, 0.05)};
  Vector3d at(0.0, 0.0, 2.0);
  for (int i = 0; i < 4; ++i) {
    const double angle = (60.0 - 40.0 * (0.25 + 0.5 * i)) * kDeg;
    const Vector3d to = at + 0.5 * Vector3d(std::sin(angle), 0.0, std::cos(angle));
    landmarks.push_back(MakeLandmark(2 + i, at, to, 0.03 - 0.003 * i, 0.027 - 0.003 * i));
    at = to;
  }
  TreeTopology topology{TopologyConfig()};
  const TreeModel model = topology.Build(landmarks, 0);
  const MapBranch& branch = BranchOf(model, 2);
  EXPECT_EQ(BranchOf(model, 4).id, branch.id);
  EXPECT_NEAR(branch.angle_rad, (60.0 - 40.0 * 0.058) * kDeg, 3.0 * kDeg);
}

TEST(TreeTopology, ASmallTreeByHand) {
  TreeTopology topology{TopologyConfig()};
  const TreeModel model = topology.Build(SmallTree(), 123);
  ExpectConsistent(model);
  EXPECT_EQ(model.stamp_ns, 123);
  ASSERT_EQ(model.trees.size(), 1u);
  ASSERT_EQ(model.branches.size(), 4u);
  const MapBranch& trunk = BranchOf(model, 3);
  EXPECT_EQ(model.trees[0].trunk_branch_id, trunk.id);
  EXPECT_EQ(BranchOf(model, 1).id, trunk.id);
  EXPECT_NEAR(trunk.length_m, 5.0, 1e-9);
  EXPECT_NEAR(trunk.base.z(), 0.0, 1e-9);
  EXPECT_NEAR(trunk.base_radius_m, 0.20, 1e-9);
  EXPECT_NEAR(trunk.tip_radius_m, 0.15, 1e-9);
  EXPECT_NEAR(trunk.middle_radius_m, 0.175, 1e-3);
  for (const int id : {7, 4}) {
    const MapBranch& branch = BranchOf(model, id);
    EXPECT_EQ(branch.parent_id, trunk.id);
    EXPECT_EQ(branch.order, 1);
    EXPECT_NEAR(branch.angle_rad, 45.0 * kDeg, 1e-6);
    EXPECT_NEAR(branch.zenith_rad, 45.0 * kDeg, 1e-6);
    // It loses 2 cm from x = 0.5 to 2: as much more to the surface at x = 0.18.
    EXPECT_NEAR(branch.base_radius_m, 0.06 + 0.02 * (0.5 - 0.18) / 1.5, 1e-6);
    // From the trunk's surface, r = 0.18 at z = 2: the axis leaves it at x = 0.18, z = 2.18.
    EXPECT_NEAR(std::abs(branch.base.x()), 0.18, 0.01);
    EXPECT_NEAR(branch.height_m, 2.18, 0.01);
    EXPECT_NEAR(branch.length_m, std::sqrt(2.0) * (2.0 - 0.18), 0.02);
    EXPECT_EQ(CylinderOf(model, branch.cylinder_ids.front()).status, FitStatus::kInferred);
  }
  EXPECT_NEAR(BranchOf(model, 7).azimuth_rad, 0.0, 1e-9);
  EXPECT_NEAR(std::abs(BranchOf(model, 4).azimuth_rad), M_PI, 1e-9);
  const MapBranch& twig = BranchOf(model, 9);
  EXPECT_EQ(twig.parent_id, BranchOf(model, 7).id);
  EXPECT_EQ(twig.order, 2);
  EXPECT_NEAR(twig.angle_rad, 90.0 * kDeg, 1e-6);
  // The gap of the trunk is bridged and says so.
  double inferred = 0.0;
  for (const int id : trunk.cylinder_ids) {
    const MapCylinder& c = CylinderOf(model, id);
    if (c.status != FitStatus::kInferred) continue;
    inferred += c.Length();
    EXPECT_GE(c.start.z(), 2.0 - 1e-9);
    EXPECT_LE(c.end.z(), 2.6 + 1e-9);
    EXPECT_EQ(c.landmark_id, -1);
    EXPECT_EQ(c.num_points, 0);
  }
  EXPECT_NEAR(inferred, 0.6, 1e-9);
  for (const MapCylinder& c : model.cylinders) EXPECT_LE(c.Length(), 0.5 * 1.5);
}

TEST(TreeTopology, DendrometryOfTheSmallTree) {
  TreeTopology topology{TopologyConfig()};
  const TreeModel model = topology.Build(SmallTree(), 0);
  const MapTree& tree = model.trees[0];
  ASSERT_TRUE(tree.dbh_m.has_value());
  EXPECT_NEAR(*tree.dbh_m, 2.0 * (0.20 - 0.01 * 1.3), 1e-6);
  EXPECT_NEAR(tree.dbh_sigma_m, 0.004, 1e-9);
  EXPECT_NEAR(tree.height_m, 5.0, 1e-9);
  EXPECT_EQ(tree.max_branch_order, 2);
  EXPECT_NEAR(tree.lean_rad, 0.0, 1e-9);
  EXPECT_NEAR(tree.arc_coverage_rad, M_PI, 1e-9);
  // The frustum from 0.20 to 0.15 over 5 m; its pieces follow the same straight line.
  EXPECT_NEAR(tree.stem_volume_m3, M_PI * 5.0 / 3.0 * (0.04 + 0.03 + 0.0225), 2e-4);
  // The twig (2 cm) is below the smallest radius that counts, the branches are above.
  const double branch = M_PI * 1.5 * std::sqrt(2.0) / 3.0 * (0.0036 + 0.0024 + 0.0016);
  EXPECT_GT(tree.wood_volume_m3, tree.stem_volume_m3 + 2.0 * branch);
  // Their unseen stretches from the trunk's surface on count too, 0.45 m of a radius of 6.0 to 6.43 cm.
  EXPECT_LT(tree.wood_volume_m3,
            tree.stem_volume_m3 + 2.0 * (branch + 0.47 * M_PI * 0.0643 * 0.0643) + 2e-4);
  EXPECT_GT(tree.volume_sigma_m3, 0.0);
  const std::vector<StemDiameter> taper = StemTaper(model, tree);
  ASSERT_GE(taper.size(), 9u);
  for (const StemDiameter& entry : taper) {
    EXPECT_NEAR(entry.diameter_m, 2.0 * (0.20 - 0.01 * entry.height_m), 2e-3);
  }
  EXPECT_TRUE(std::is_sorted(taper.begin(), taper.end(), [](const auto& a, const auto& b) {
    return a.height_m < b.height_m;
  }));
  EXPECT_FALSE(DiameterAtHeight(model, tree, 7.0).has_value());
  const auto bridged = DiameterAtHeight(model, tree, 2.3);
  ASSERT_TRUE(bridged.has_value());
  EXPECT_EQ(bridged->status, FitStatus::kInferred);
  EXPECT_NEAR(bridged->diameter_m, 2.0 * 0.177, 1e-3);
  EXPECT_GT(bridged->sigma_m, 0.004);
}

TEST(TreeTopology, AxisSignAndOrderOfInputDoNotMatter) {
  std::vector<Landmark> landmarks = SmallTree();
  TreeTopology a{TopologyConfig()}, b{TopologyConfig()};
  const TreeModel first = a.Build(landmarks, 0);
  std::reverse(landmarks.begin(), landmarks.end());
  for (Landmark& landmark : landmarks) {
    landmark.cylinder.axis = -landmark.cylinder.axis;
    std::swap(landmark.s_min_m, landmark.s_max_m);
    landmark.s_min_m = -landmark.s_min_m;
    landmark.s_max_m = -landmark.s_max_m;
    for (RadiusKnot& knot : landmark.profile) knot.s_m = -knot.s_m;
    std::reverse(landmark.profile.begin(), landmark.profile.end());
  }
  const TreeModel second = b.Build(landmarks, 0);
  ASSERT_EQ(first.cylinders.size(), second.cylinders.size());
  for (std::size_t i = 0; i < first.branches.size(); ++i) {
    EXPECT_EQ(first.branches[i].parent_id, second.branches[i].parent_id);
    EXPECT_LT((first.branches[i].base - second.branches[i].base).norm(), 1e-6);
    EXPECT_LT((first.branches[i].tip - second.branches[i].tip).norm(), 1e-6);
  }
}

TEST(TreeTopology, IdsStayWhileTheMapGrows) {
  const std::vector<Landmark> all = SmallTree();
  TreeTopology topology{TopologyConfig()};
  std::map<int, int> branch_of, cylinders_of_first;
  std::vector<Landmark> known;
  for (std::size_t i = 0; i < all.size(); ++i) {
    known.push_back(all[i]);
    const TreeModel model = topology.Build(known, static_cast<std::int64_t>(i));
    ExpectConsistent(model);
    for (const Landmark& landmark : known) {
      const int id = BranchOf(model, landmark.id).id;
      const auto [it, is_new] = branch_of.emplace(landmark.id, id);
      EXPECT_EQ(it->second, id) << "landmark " << landmark.id;
    }
  }
  // A landmark that grows at both ends keeps the ids of the sections it had.
  const TreeModel before = topology.Build(known, 10);
  known[2] = MakeLandmark(7, {0.4, 0, 2.4}, {2.5, 0, 4.5}, 0.062, 0.035);
  const TreeModel after = topology.Build(known, 11);
  std::map<int, Vector3d> old_places;
  for (const MapCylinder& c : before.cylinders) {
    if (c.landmark_id == 7) old_places[c.id] = 0.5 * (c.start + c.end);
  }
  std::size_t kept = 0, now = 0;
  for (const MapCylinder& c : after.cylinders) {
    now += c.landmark_id == 7 ? 1 : 0;
    if (old_places.count(c.id) == 0) continue;
    ++kept;
    EXPECT_EQ(c.landmark_id, 7);
    EXPECT_LT((0.5 * (c.start + c.end) - old_places[c.id]).norm(), 0.5);
  }
  EXPECT_GE(kept + 1, std::min(now, old_places.size()));
  // The state alone brings the ids back.
  TreeTopology other{TopologyConfig()};
  other.Restore(topology.state());
  const TreeModel again = other.Build(known, 11);
  ASSERT_EQ(again.cylinders.size(), after.cylinders.size());
  for (std::size_t i = 0; i < after.cylinders.size(); ++i) {
    EXPECT_EQ(again.cylinders[i].id, after.cylinders[i].id);
    EXPECT_EQ(again.cylinders[i].start, after.cylinders[i].start);
  }
}

// Id and middle of every cylinder of a landmark.
std::map<int, Vector3d> Places(const TreeModel& model, int landmark_id) {
  std::map<int, Vector3d> places;
  for (const MapCylinder& c : model.cylinders) {
    if (c.landmark_id == landmark_id) places[c.id] = 0.5 * (c.start + c.end);
  }
  return places;
}

TEST(TreeTopology, CylindersKeepTheirPlacesAndIdsWhenKnotsMoveAndEndsGrow) {
  TreeTopology topology{TopologyConfig()};
  const auto trunk = [](double z0, double z1, double knot_m, bool flipped = false) {
    Landmark landmark = flipped ? MakeLandmark(3, {0, 0, z1}, {0, 0, z0}, 0.1, 0.15, 0.002, knot_m)
                                : MakeLandmark(3, {0, 0, z0}, {0, 0, z1}, 0.15, 0.1, 0.002, knot_m);
    return std::vector<Landmark>{landmark};
  };
  const std::map<int, Vector3d> first = Places(topology.Build(trunk(0.4, 3.15, 0.25), 0), 3);
  ASSERT_EQ(first.size(), 11U);  // every 25 cm
  // Other knots, and the axis the other way round: nothing moves.
  for (const double knot_m : {0.19, 0.31, 0.5, 0.11}) {
    for (const bool flipped : {false, true}) {
      const auto places = Places(topology.Build(trunk(0.4, 3.15, knot_m, flipped), 1), 3);
      ASSERT_EQ(places.size(), first.size());
      for (const auto& [id, middle] : first) {
        ASSERT_EQ(places.count(id), 1U);
        EXPECT_LT((places.at(id) - middle).norm(), 1e-9);
      }
    }
  }
  // Ends that grow, by less than a cell and by more: the inner cylinders stay where they are.
  for (const auto& [z0, z1] : {std::pair{0.37, 3.2}, {0.1, 3.9}, {-0.9, 4.3}}) {
    const auto places = Places(topology.Build(trunk(z0, z1, 0.25), 2), 3);
    EXPECT_GE(places.size(), first.size());
    for (const auto& [id, middle] : first) {
      ASSERT_EQ(places.count(id), 1U) << z0;
      EXPECT_LT((places.at(id) - middle).norm(), 0.1) << z0;
    }
  }
  // An end that comes back finds its ids again.
  const auto grown = Places(topology.Build(trunk(-0.9, 4.3, 0.25), 3), 3);
  topology.Build(trunk(0.4, 3.15, 0.25), 4);
  EXPECT_EQ(Places(topology.Build(trunk(-0.9, 4.3, 0.25), 5), 3), grown);
}

TEST(TreeTopology, ALandmarkThatTakesAPlaceOverTakesItsIdsOver) {
  TreeTopology topology{TopologyConfig()};
  const Landmark low = MakeLandmark(1, {0, 0, 0}, {0, 0, 2}, 0.15, 0.12);
  const Landmark high = MakeLandmark(2, {0, 0, 2.3}, {0, 0, 4.3}, 0.12, 0.1);
  const TreeModel before = topology.Build({low, high}, 0);
  ASSERT_EQ(before.branches.size(), 1U);
  // The two turn out to be one; the gap between them was seen meanwhile.
  const TreeModel after = topology.Build({MakeLandmark(1, {0, 0, 0}, {0, 0, 4.3}, 0.15, 0.1)}, 1);
  ASSERT_EQ(after.branches.size(), 1U);
  int kept = 0;
  for (const MapCylinder& c : after.cylinders) {
    for (const MapCylinder& old : before.cylinders) {
      if (old.id != c.id) continue;
      ++kept;
      EXPECT_LT((0.5 * (old.start + old.end - c.start - c.end)).norm(), 0.25);
    }
  }
  EXPECT_GE(kept, static_cast<int>(before.cylinders.size()) - 1);
  std::set<int> ids;
  for (const MapCylinder& c : after.cylinders) EXPECT_TRUE(ids.insert(c.id).second);
}

TEST(TreeTopology, OneBranchSeenTwiceIsOne) {
  const Landmark trunk = MakeLandmark(0, {0, 0, 0}, {0, 0, 5}, 0.15, 0.12);
  const Landmark branch = MakeLandmark(1, {0.2, 0, 3}, {2.0, 0, 3.4}, 0.04, 0.03);
  // The same again, 3 cm and 3 degrees off, shorter and seen less; and the trunk's upper half.
  Landmark again = MakeLandmark(2, {0.5, 0.03, 3.05}, {1.9, 0.05, 3.4}, 0.045, 0.035);
  again.num_scans = 3;
  Landmark top = MakeLandmark(3, {0.04, 0, 2.4}, {0.02, 0, 4.9}, 0.1, 0.09);
  top.num_scans = 4;
  // A neighbour that runs beside the branch without touching it.
  const Landmark beside = MakeLandmark(4, {0.2, 0.09, 3}, {2.0, 0.1, 3.4}, 0.04, 0.03);
  TreeTopology topology{TopologyConfig()};
  const TreeModel model = topology.Build({again, top, branch, trunk, beside}, 0);
  ExpectConsistent(model);
  std::set<int> landmarks;
  for (const MapCylinder& c : model.cylinders) landmarks.insert(c.landmark_id);
  landmarks.erase(-1);
  EXPECT_EQ(landmarks, (std::set<int>{0, 1, 4}));
  EXPECT_EQ(model.branches.size(), 3U);
  // When the one that stood in its place is gone, the other comes back.
  const TreeModel later = topology.Build({again, trunk}, 1);
  EXPECT_EQ(later.branches.size(), 2U);
}

TEST(TreeTopology, OppositeBranchesOfATrunkAreTwo) {
  // Horizontal, at the same height: each looks like the continuation of the other.
  const std::vector<Landmark> landmarks = {MakeLandmark(0, {0, 0, 0}, {0, 0, 4}, 0.15, 0.12),
                                           MakeLandmark(1, {0.2, 0, 2}, {1.5, 0, 2}, 0.05, 0.04),
                                           MakeLandmark(2, {-0.2, 0, 2}, {-1.5, 0, 2}, 0.05, 0.04)};
  TreeTopology topology{TopologyConfig()};
  const TreeModel model = topology.Build(landmarks, 0);
  ASSERT_EQ(model.branches.size(), 3u);
  EXPECT_EQ(BranchOf(model, 1).parent_id, BranchOf(model, 0).id);
  EXPECT_EQ(BranchOf(model, 2).parent_id, BranchOf(model, 0).id);
}

TEST(TreeTopology, ForkContinuesIntoTheThickerArm) {
  const std::vector<Landmark> landmarks = {
      MakeLandmark(0, {0, 0, 0}, {0, 0, 3}, 0.15, 0.13),
      MakeLandmark(1, {0.02, 0, 3.1}, {0.4, 0, 5}, 0.12, 0.10),
      MakeLandmark(2, {-0.06, 0, 3.1}, {-0.9, 0, 5}, 0.08, 0.06)};
  TreeTopology topology{TopologyConfig()};
  const TreeModel model = topology.Build(landmarks, 0);
  ASSERT_EQ(model.branches.size(), 2u);
  EXPECT_EQ(BranchOf(model, 1).id, BranchOf(model, 0).id);
  EXPECT_EQ(BranchOf(model, 2).parent_id, BranchOf(model, 0).id);
}

TEST(TreeTopology, ArmsThatWereFittedFromInsideTheForkAreBranchesOfTheirOwn) {
  // The palo verde's trunk and its two arms as they were mapped: one begins 15 cm and the other 30 cm
  // below the trunk's end, within it.
  const auto arm = [](int id, double depth, const Vector3d& direction, double radius) {
    const Vector3d from = Vector3d(0, 0, 1.0 - depth) - 0.3 * depth * Vector3d(direction.x(), 0, 0);
    return MakeLandmark(id, from, from + 1.5 * direction.normalized(), radius, 0.95 * radius);
  };
  const std::vector<Landmark> landmarks = {MakeLandmark(0, {0, 0, 0}, {0, 0, 1}, 0.16, 0.15),
                                           arm(1, 0.15, {0.45, 0.1, 0.9}, 0.113),
                                           arm(2, 0.3, {-0.5, -0.1, 0.85}, 0.083)};
  TreeTopology topology{TopologyConfig()};
  const TreeModel model = topology.Build(landmarks, 0);
  ASSERT_EQ(model.branches.size(), 3u);
  for (const int id : {1, 2}) {
    EXPECT_EQ(BranchOf(model, id).order, 1);
    EXPECT_EQ(BranchOf(model, id).parent_id, BranchOf(model, 0).id);
  }
}

TEST(TreeTopology, AThinArmThatBendsLessIsNotTheStemIfMostOfTheWoodTurnsOff) {
  // The palo verde's right stem and its arms as they were mapped: 11 cm goes on as 9.6 cm, 38 degrees off,
  // and as 6.2 cm, 18 degrees off.
  const std::vector<Landmark> landmarks = {
      MakeLandmark(0, {5.42, -0.02, -0.80}, {4.82, -0.21, 0.45}, 0.117, 0.111),
      MakeLandmark(1, {4.89, -0.19, 0.39}, {3.93, -0.37, 1.39}, 0.063, 0.062),
      MakeLandmark(2, {4.81, -0.18, 0.37}, {5.04, -0.59, 1.47}, 0.107, 0.095)};
  TreeTopology topology{TopologyConfig()};
  const TreeModel model = topology.Build(landmarks, 0);
  ASSERT_EQ(model.branches.size(), 3u);
  for (const int id : {1, 2}) {
    EXPECT_EQ(BranchOf(model, id).parent_id, BranchOf(model, 0).id);
    EXPECT_EQ(BranchOf(model, id).order, 1);
  }
}

TEST(TreeTopology, ArmsOfAForkWhoseStemEndIsHiddenAreSiblings) {
  // 35 cm of the stem below the fork were not seen: each arm is nearer to the other than to the stem.
  const std::vector<Landmark> landmarks = {
      MakeLandmark(0, {0, 0, 0}, {0, 0, 2}, 0.14, 0.11),
      MakeLandmark(1, {0.06, -0.04, 2.35}, {1.2, -0.8, 4.5}, 0.07, 0.05),
      MakeLandmark(2, {-0.03, 0.02, 2.4}, {-1.2, 0.9, 4.6}, 0.07, 0.05),
      // A true child, a little farther up one of the arms.
      MakeLandmark(3, {0.32, -0.1, 2.75}, {1.2, 0.9, 3.4}, 0.02, 0.01)};
  TreeTopology topology{TopologyConfig()};
  const TreeModel model = topology.Build(landmarks, 0);
  ASSERT_EQ(model.branches.size(), 4u);
  EXPECT_EQ(BranchOf(model, 1).parent_id, BranchOf(model, 0).id);
  EXPECT_EQ(BranchOf(model, 2).parent_id, BranchOf(model, 0).id);
  EXPECT_EQ(BranchOf(model, 3).parent_id, BranchOf(model, 1).id);
}

TEST(TreeTopology, CurvedBranchIsOneBranch) {
  std::vector<Landmark> landmarks = {MakeLandmark(0, {0, 0, 0}, {0, 0, 4}, 0.15, 0.12)};
  // A quarter circle of radius 2 m in pieces of 15 degrees, each with its chord.
  const auto at = [](double degrees) {
    const double a = degrees * kDeg;
    return Vector3d(0.1 + 2.0 * std::sin(a), 0.0, 2.0 + 2.0 * (1.0 - std::cos(a)));
  };
  for (int i = 0; i < 6; ++i) {
    const double r = 0.06 - 0.005 * i;
    landmarks.push_back(MakeLandmark(1 + i, at(15.0 * i), at(15.0 * (i + 1)), r, r - 0.005));
  }
  TreeTopology topology{TopologyConfig()};
  const TreeModel model = topology.Build(landmarks, 0);
  ExpectConsistent(model);
  ASSERT_EQ(model.branches.size(), 2u);
  const MapBranch& branch = BranchOf(model, 1);
  EXPECT_EQ(BranchOf(model, 6).id, branch.id);
  EXPECT_NEAR(branch.length_m, M_PI, 0.1);
  EXPECT_LT(branch.base.z(), branch.tip.z());
}

TEST(TreeTopology, AnElbowIsOneBranch) {
  // A saguaro's arms as they were mapped: out of the trunk at 55 degrees, up within a metre, in pieces
  // that run into each other; each as thick as it began.
  const std::vector<Landmark> landmarks = {
      MakeLandmark(0, {0, 0, 0}, {0, 0, 2.7}, 0.25, 0.246),
      MakeLandmark(1, {0, 0, 2.7}, {0, 0, 3.9}, 0.246, 0.225),
      MakeLandmark(2, {0, 0, 4.1}, {0, 0, 6.0}, 0.195, 0.165),
      MakeLandmark(3, {0.02, 0, 3.2}, {-0.75, -0.15, 3.75}, 0.18, 0.175),
      MakeLandmark(4, {-0.49, -0.1, 3.42}, {-0.65, -0.12, 3.94}, 0.17, 0.17),
      MakeLandmark(5, {-0.65, -0.12, 3.94}, {-0.65, -0.12, 5.4}, 0.167, 0.163),
      MakeLandmark(6, {0.09, 0, 2.85}, {0.83, 0.02, 3.44}, 0.2, 0.212),
      MakeLandmark(7, {0.59, 0.01, 3.07}, {0.74, 0.03, 3.69}, 0.228, 0.21),
      MakeLandmark(8, {0.72, 0.03, 3.69}, {0.73, 0.03, 5.5}, 0.214, 0.213)};
  TreeTopology topology{TopologyConfig()};
  const TreeModel model = topology.Build(landmarks, 0);
  ExpectConsistent(model);
  ASSERT_EQ(model.branches.size(), 3u);
  for (const auto& [first, last] : {std::pair(0, 2), std::pair(3, 5), std::pair(6, 8)}) {
    for (int id = first; id <= last; ++id) {
      EXPECT_EQ(BranchOf(model, id).id, BranchOf(model, first).id) << "landmark " << id;
      EXPECT_EQ(BranchOf(model, id).order, first == 0 ? 0 : 1) << "landmark " << id;
    }
  }
}

TEST(TreeTopology, SeveralTreesAndAPieceOnItsOwn) {
  std::vector<Landmark> landmarks = SmallTree();
  for (const Landmark& landmark : SmallTree()) {
    landmarks.push_back(landmark);
    landmarks.back().id += 100;
    landmarks.back().cylinder.point += Vector3d(6, 1, 0.3);
  }
  landmarks.push_back(MakeLandmark(50, {3, -3, 5}, {4, -3, 5}, 0.03, 0.02));
  TreeTopology topology{TopologyConfig()};
  const TreeModel model = topology.Build(landmarks, 0);
  ExpectConsistent(model);
  ASSERT_EQ(model.trees.size(), 2u);
  EXPECT_EQ(model.trees[0].branch_ids.size(), 4u);
  EXPECT_EQ(model.trees[1].branch_ids.size(), 4u);
  EXPECT_NE(BranchOf(model, 3).tree_id, BranchOf(model, 103).tree_id);
  EXPECT_EQ(BranchOf(model, 50).tree_id, -1);
  EXPECT_EQ(BranchOf(model, 50).parent_id, -1);
}

TEST(TreeTopology, GroundGivesTheTreeItsFoot) {
  std::vector<Landmark> landmarks = {MakeLandmark(0, {0, 0, 0.6}, {0, 0, 4.0}, 0.2, 0.166)};
  TreeTopology topology{TopologyConfig()};
  const TreeModel model =
      topology.Build(landmarks, 0, [](const auto&) { return GroundLevel{0.1, 0.0}; });
  ASSERT_EQ(model.trees.size(), 1u);
  EXPECT_NEAR(model.trees[0].base.z(), 0.1, 1e-9);
  EXPECT_NEAR(model.trees[0].height_m, 3.9, 1e-9);
  ASSERT_TRUE(model.trees[0].dbh_m.has_value());
  EXPECT_NEAR(*model.trees[0].dbh_m, 2.0 * (0.2 - 0.01 * (1.4 - 0.6)), 1e-6);
}

TEST(TreeTopology, TreesOnASlopeStandOnTheirOwnGround) {
  // The ground rises by 0.3 m per metre of x; of every stem the lowest 50 cm were not seen.
  std::vector<Landmark> landmarks;
  for (int i = 0; i < 3; ++i) {
    const double x = 5.0 * i, z = 0.3 * x;
    landmarks.push_back(MakeLandmark(i, {x, 0, z + 0.5}, {x, 0, z + 4.5}, 0.2, 0.16));
  }
  TreeTopology topology{TopologyConfig()};
  const TreeModel model = topology.Build(landmarks, 0, [](const Vector2d& place) {
    return GroundLevel{0.3 * place.x(), 0.05};
  });
  ASSERT_EQ(model.trees.size(), 3u);
  for (int i = 0; i < 3; ++i) {
    const MapTree& tree = model.trees[static_cast<std::size_t>(i)];
    EXPECT_NEAR(tree.base.z(), 0.3 * tree.base.x(), 1e-9);
    EXPECT_NEAR(tree.height_m, 4.5, 1e-9);
    ASSERT_TRUE(tree.dbh_m.has_value());
    // Radius 0.2 - 0.01 (h - 0.5) at h = 1.3 m; 5 cm of height are 1 mm of diameter.
    EXPECT_NEAR(*tree.dbh_m, 2.0 * (0.2 - 0.01 * 0.8), 1e-6);
    EXPECT_NEAR(tree.dbh_sigma_m, std::hypot(2.0 * 0.002, 0.001), 1e-6);
  }
  // Where the ground was not seen, the base is the lowest wood.
  TreeTopology blind{TopologyConfig()};
  const TreeModel none = blind.Build(landmarks, 0, [](const Vector2d&) -> std::optional<GroundLevel> {
    return std::nullopt;
  });
  ASSERT_EQ(none.trees.size(), 3u);
  EXPECT_NEAR(none.trees[0].base.z(), 0.5, 1e-9);
}

TEST(TreeTopology, CandidatesAndEmptyInput) {
  TreeTopology topology{TopologyConfig()};
  EXPECT_TRUE(topology.Build({}, 5).cylinders.empty());
  std::vector<Landmark> landmarks = SmallTree();
  for (Landmark& landmark : landmarks) landmark.confirmed = false;
  EXPECT_TRUE(topology.Build(landmarks, 5).branches.empty());
  EXPECT_EQ(topology.state().next_branch_id, 0);
  const TreeModel one = topology.Build({MakeLandmark(0, {0, 0, 0}, {0, 0, 1}, 0.1, 0.1)}, 0);
  ASSERT_EQ(one.branches.size(), 1u);
  EXPECT_EQ(one.trees.size(), 1u);
}

TEST(TreeTopology, RefusesBadInput) {
  TreeTopology topology{TopologyConfig()};
  std::vector<Landmark> landmarks = SmallTree();
  landmarks[1].cylinder.point.x() = std::numeric_limits<double>::quiet_NaN();
  try {
    topology.Build(landmarks, 0);
    FAIL();
  } catch (const std::invalid_argument& error) {
    EXPECT_THAT(error.what(), HasSubstr("landmark 1"));
  }
  landmarks = SmallTree();
  landmarks[1].id = 3;
  EXPECT_THROW(topology.Build(landmarks, 0), std::invalid_argument);
  TopologyConfig config;
  config.max_section_length_m = 0.0;
  EXPECT_THROW(TreeTopology{config}, std::invalid_argument);
  config = TopologyConfig();
  config.join_angle_deg = 90.0;
  EXPECT_THROW(TreeTopology{config}, std::invalid_argument);
}

}  // namespace
}  // namespace dendro
