// The topology of generated trees whose branches were turned into landmarks, perfect and perturbed.

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <map>
#include <random>
#include <set>

#include <gtest/gtest.h>

#include "dendro_slam/sim/scene_generator.h"
#include "dendro_slam/topology/tree_topology.h"
#include "landmark_maker.h"

namespace dendro {
namespace {

using Eigen::Vector3d;

struct Perturbation {
  double axis_deg = 0.0;         // sigma of either component
  double position_m = 0.0;       // sigma of either component
  double radius_relative = 0.0;  // sigma
  double hidden_ratio = 0.0;     // pieces that are not there
  double base_gap_m = 0.03;  // branches are seen from this far outside their parent's surface on
  double end_gap_m = 0.01;   // taken off either end of every piece, up to twice
};

struct TruthOfLandmark {
  int tree, branch;
};

double DistanceInside(const SceneBranch& parent, const Vector3d& p) {
  double inside = -1e9;
  for (std::size_t i = 0; i + 1 < parent.points.size(); ++i) {
    const Vector3d a = parent.points[i].position, b = parent.points[i + 1].position;
    const double f = std::clamp((p - a).dot(b - a) / (b - a).squaredNorm(), 0.0, 1.0);
    const double radius = (1.0 - f) * parent.points[i].radius_m + f * parent.points[i + 1].radius_m;
    inside = std::max(inside, radius - (p - a - f * (b - a)).norm());
  }
  return inside;
}

// Cuts every branch thicker than min_radius into straight pieces of at most 2 m and 8 degrees of
// bend.
std::vector<Landmark> LandmarksOf(const SceneTree& tree,
                                  int tree_index,
                                  const Perturbation& perturbation,
                                  std::uint64_t seed,
                                  std::map<int, TruthOfLandmark>* truth) {
  std::mt19937_64 rng(seed);
  std::normal_distribution<double> normal;
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  std::vector<Landmark> landmarks;
  for (const SceneBranch& branch : tree.branches) {
    // Points 5 cm apart from outside of the parent to where the wood gets thin.
    std::vector<BranchPoint> points;
    const SceneBranch* parent = branch.parent >= 0 ? tree.FindBranch(branch.parent) : nullptr;
    for (std::size_t i = 0; i + 1 < branch.points.size(); ++i) {
      const BranchPoint &a = branch.points[i], &b = branch.points[i + 1];
      const int n = std::max(1, static_cast<int>((b.position - a.position).norm() / 0.05));
      for (int k = 0; k < n; ++k) {
        const double f = static_cast<double>(k) / n;
        BranchPoint p;
        p.position = (1.0 - f) * a.position + f * b.position;
        p.radius_m = (1.0 - f) * a.radius_m + f * b.radius_m;
        if (p.radius_m < 0.015) continue;
        if (parent != nullptr && DistanceInside(*parent, p.position) > -perturbation.base_gap_m)
          continue;
        points.push_back(p);
      }
    }
    std::size_t first = 0;
    while (first + 4 < points.size()) {
      std::size_t last = first + 4;
      const Vector3d start = points[first].position;
      const Vector3d direction = (points[first + 4].position - start).normalized();
      while (last + 1 < points.size() && (points[last + 1].position - start).norm() < 2.0) {
        const Vector3d end_direction =
            (points[last + 1].position - points[last - 3].position).normalized();
        if (std::acos(std::clamp(direction.dot(end_direction), -1.0, 1.0)) > 8.0 * M_PI / 180.0)
          break;
        ++last;
      }
      Vector3d p0 = points[first].position, p1 = points[last].position;
      const Vector3d axis = (p1 - p0).normalized();
      const Eigen::Matrix<double, 3, 2> basis = PerpendicularBasis(axis);
      const Vector3d shift =
          perturbation.position_m * (normal(rng) * basis.col(0) + normal(rng) * basis.col(1));
      const Vector3d tilt = perturbation.axis_deg * M_PI / 180.0 * 0.5 * (p1 - p0).norm() *
                            (normal(rng) * basis.col(0) + normal(rng) * basis.col(1));
      p0 += shift - tilt + (first == 0 ? 0.0 : 2.0 * uniform(rng) * perturbation.end_gap_m) * axis;
      p1 += shift + tilt - 2.0 * uniform(rng) * perturbation.end_gap_m * axis;
      const double scale = 1.0 + perturbation.radius_relative * normal(rng);
      const double r0 = points[first].radius_m * scale, r1 = points[last].radius_m * scale;
      const double sigma = std::max(perturbation.radius_relative * 0.5 * (r0 + r1), 0.001);
      const int id = tree_index * 10000 + static_cast<int>(landmarks.size());
      // The axis of a landmark may point either way.
      landmarks.push_back(uniform(rng) < 0.5 ? test::MakeLandmark(id, p0, p1, r0, r1, sigma)
                                             : test::MakeLandmark(id, p1, p0, r1, r0, sigma));
      (*truth)[id] = {tree_index, branch.id};
      if (uniform(rng) < perturbation.hidden_ratio) {
        landmarks.pop_back();
        truth->erase(id);
        // The next piece takes the id; that is as good as a gap.
      }
      first = last;
    }
  }
  return landmarks;
}

struct Score {
  int branches = 0;  // true branches with a landmark
  int parents = 0;   // of them with a parent that has landmarks
  int parent_right = 0;
  int order_right = 0;
  int whole = 0;                     // all landmarks in one branch of the model
  int pure = 0, model_branches = 0;  // branches of the model of one true branch only
  int trunks = 0, trees = 0;
};

void AddScore(const std::vector<SceneTree>& trees,
              const TreeModel& model,
              const std::map<int, TruthOfLandmark>& truth,
              Score* score) {
  std::map<int, int> branch_of_landmark;
  std::map<int, const MapBranch*> branches;
  for (const MapBranch& b : model.branches) branches[b.id] = &b;
  for (const MapCylinder& c : model.cylinders) {
    if (c.landmark_id >= 0) branch_of_landmark[c.landmark_id] = c.branch_id;
  }
  using Key = std::pair<int, int>;
  std::map<int, std::map<Key, int>> truths_of_branch;
  std::map<Key, std::map<int, int>> branches_of_truth;
  for (const auto& [landmark, key] : truth) {
    const int branch = branch_of_landmark.at(landmark);
    ++truths_of_branch[branch][{key.tree, key.branch}];
    ++branches_of_truth[{key.tree, key.branch}][branch];
  }
  const auto main_truth = [&](int branch) {
    Key best{-1, -1};
    int count = 0;
    for (const auto& [key, n] : truths_of_branch[branch]) {
      if (n > count) best = key, count = n;
    }
    return best;
  };
  for (const auto& [branch, counts] : truths_of_branch) {
    ++score->model_branches;
    score->pure += counts.size() == 1 ? 1 : 0;
  }
  std::map<Key, int> order;
  for (std::size_t t = 0; t < trees.size(); ++t) {
    for (const SceneBranch& b : trees[t].branches) {
      order[{static_cast<int>(t), b.id}] =
          b.parent < 0 ? 0 : order[{static_cast<int>(t), b.parent}] + 1;
    }
  }
  for (const auto& [key, found] : branches_of_truth) {
    ++score->branches;
    score->whole += found.size() == 1 ? 1 : 0;
    // The branch of the model with most of this true branch's landmarks.
    const int branch =
        std::max_element(found.begin(), found.end(), [](const auto& a, const auto& b) {
          return a.second < b.second;
        })->first;
    const MapBranch& b = *branches.at(branch);
    score->order_right += b.tree_id >= 0 && b.order == order[key] ? 1 : 0;
    const int parent = trees[static_cast<std::size_t>(key.first)].FindBranch(key.second)->parent;
    if (parent < 0) {
      ++score->trees;
      score->trunks += b.tree_id >= 0 && b.order == 0 ? 1 : 0;
    } else if (branches_of_truth.count({key.first, parent}) > 0) {
      ++score->parents;
      score->parent_right +=
          b.parent_id >= 0 && main_truth(b.parent_id) == Key{key.first, parent} ? 1 : 0;
    }
  }
}

Score ScoreForm(const char* form, const Perturbation& perturbation, int num_trees) {
  Score score;
  for (int seed = 0; seed < num_trees; ++seed) {
    TreeGeneratorConfig config;
    config.form = form;
    config.height_m = 6.0 + seed % 5;
    config.dbh_m = 0.18 + 0.03 * (seed % 4);
    config.max_order = 2;
    config.num_branches = 6 + seed % 6;
    const std::vector<SceneTree> trees = {
        GenerateTree(config, Vector3d(1.0, -2.0, 0.3), 1000 + static_cast<std::uint64_t>(seed))};
    std::map<int, TruthOfLandmark> truth;
    const std::vector<Landmark> landmarks =
        LandmarksOf(trees[0], 0, perturbation, 77 + static_cast<std::uint64_t>(seed), &truth);
    TreeTopology topology{TopologyConfig()};
    AddScore(trees, topology.Build(landmarks, 0), truth, &score);
  }
  std::printf(
      "%-10s branches %d, parent right %d/%d, order right %d/%d, whole %d/%d, pure %d/%d, trunks "
      "%d/%d\n",
      form,
      score.branches,
      score.parent_right,
      score.parents,
      score.order_right,
      score.branches,
      score.whole,
      score.branches,
      score.pure,
      score.model_branches,
      score.trunks,
      score.trees);
  return score;
}

class GeneratedTrees : public testing::TestWithParam<const char*> {};

TEST_P(GeneratedTrees, PerfectLandmarks) {
  const Score score = ScoreForm(GetParam(), Perturbation(), 12);
  ASSERT_GT(score.parents, 50);
  EXPECT_GE(score.parent_right, 0.98 * score.parents);
  EXPECT_GE(score.order_right, 0.95 * score.branches);
  EXPECT_GE(score.whole, 0.95 * score.branches);
  EXPECT_EQ(score.trunks, score.trees);
}

TEST_P(GeneratedTrees, PerturbedLandmarks) {
  Perturbation perturbation;
  perturbation.axis_deg = 1.5;
  perturbation.position_m = 0.01;
  perturbation.radius_relative = 0.05;
  perturbation.base_gap_m = 0.15;
  perturbation.end_gap_m = 0.08;
  const Score score = ScoreForm(GetParam(), perturbation, 12);
  ASSERT_GT(score.parents, 40);
  EXPECT_GE(score.parent_right, 0.95 * score.parents);
  EXPECT_GE(score.order_right, 0.95 * score.branches);
  EXPECT_EQ(score.trunks, score.trees);
}

TEST_P(GeneratedTrees, PiecesHidden) {
  Perturbation perturbation;
  perturbation.axis_deg = 1.0;
  perturbation.position_m = 0.005;
  perturbation.radius_relative = 0.03;
  perturbation.base_gap_m = 0.08;
  perturbation.end_gap_m = 0.05;
  perturbation.hidden_ratio = 0.1;
  const Score score = ScoreForm(GetParam(), perturbation, 12);
  EXPECT_GE(score.parent_right, 0.85 * score.parents);
}

INSTANTIATE_TEST_SUITE_P(Forms,
                         GeneratedTrees,
                         testing::Values("excurrent", "decurrent", "columnar"));

}  // namespace
}  // namespace dendro
