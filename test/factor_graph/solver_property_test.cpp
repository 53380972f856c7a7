// Random sequences of updates against batch solutions of what is left of the graph.
#include <algorithm>
#include <cmath>
#include <iterator>
#include <map>
#include <memory>
#include <random>
#include <set>
#include <vector>

#include <Eigen/LU>
#include <gmock/gmock.h>

#include "dendro_slam/factor_graph/between_factor.h"
#include "dendro_slam/factor_graph/cylinder_factor.h"
#include "dendro_slam/factor_graph/incremental_solver.h"
#include "dendro_slam/factor_graph/linear_factor.h"
#include "dendro_slam/factor_graph/prior_factor.h"
#include "graph_test_util.h"

namespace dendro {
namespace {

using namespace test;

Key X(int i) { return MakeKey('x', static_cast<std::uint64_t>(i)); }
Key L(int i) { return MakeKey('l', static_cast<std::uint64_t>(i)); }

// A graph of points in the plane with linear factors: everything about it is exact.
struct LinearWorld {
  std::mt19937 rng;
  IncrementalSolver solver;
  int next = 0;

  explicit LinearWorld(unsigned seed, const SolverConfig& config) : rng(seed), solver(config) {}

  int Pick(int n) { return static_cast<int>(rng() % static_cast<unsigned>(n)); }

  FactorPtr Relative(Key a, Key b) {
    Eigen::MatrixXd A(2, 4);
    const Eigen::Matrix2d scale = Eigen::Matrix2d::Identity() + 0.2 * RandomMatrix();
    A << -scale, scale;
    const PointN zero = PointN::Zero(2);
    return LinearFactor::FromSquareRoot({a, b}, {zero, zero}, A, RandomVector<2>(rng));
  }
  Eigen::Matrix2d RandomMatrix() {
    Eigen::Matrix2d m;
    m << RandomVector<2>(rng), RandomVector<2>(rng);
    return m;
  }
  std::vector<Key> Keys() const {
    std::vector<Key> keys;
    for (const auto& entry : solver.Estimates()) keys.push_back(entry.first);
    return keys;
  }
};

// Mean and covariance of all variables by dense algebra from the factors the solver holds.
void ExpectDenseSolution(const IncrementalSolver& solver, const std::vector<Key>& keys) {
  std::set<FactorId> ids;
  for (const Key key : keys) {
    for (const FactorId id : solver.FactorsOf(key)) ids.insert(id);
  }
  std::map<Key, int> offset;
  Values zero;
  for (const Key key : keys) {
    offset.emplace(key, 2 * static_cast<int>(offset.size()));
    zero.Insert(key, PointN(PointN::Zero(2)));
  }
  const int n = 2 * static_cast<int>(keys.size());
  Eigen::MatrixXd H = Eigen::MatrixXd::Zero(n, n);
  Eigen::VectorXd g = Eigen::VectorXd::Zero(n);
  for (const FactorId id : ids) {
    Eigen::MatrixXd J;
    Eigen::VectorXd r;
    const Factor& factor = *solver.GetFactor(id);
    factor.Linearize(zero, &J, &r);
    Eigen::MatrixXd wide = Eigen::MatrixXd::Zero(J.rows(), n);
    int column = 0;
    for (const Key key : factor.keys()) {
      wide.middleCols(offset.at(key), 2) = J.middleCols(column, 2);
      column += 2;
    }
    H += wide.transpose() * wide;
    g -= wide.transpose() * r;
  }
  const Eigen::MatrixXd covariance = H.inverse();
  const Eigen::VectorXd mean = covariance * g;
  for (const Key key : keys) {
    const int at = offset.at(key);
    EXPECT_LT((solver.Estimate<PointN>(key) - mean.segment(at, 2)).norm(), 1e-8 * (1.0 + mean.norm())) << KeyName(key);
    EXPECT_LT((solver.MarginalCovariance(key) - covariance.block(at, at, 2, 2)).norm(), 1e-8 * covariance.norm());
  }
}

class RandomSequence : public testing::TestWithParam<int> {};

TEST_P(RandomSequence, AddRemoveMarginalizeOfALinearGraphIsExact) {
  SolverConfig config;
  config.wildfire_threshold = 0.0;
  config.still_threshold = 0.0;
  config.reorder_interval = 7;
  LinearWorld world(static_cast<unsigned>(GetParam()), config);
  IncrementalSolver& solver = world.solver;
  const PointN zero = PointN::Zero(2);
  std::set<FactorId> loops;  // Factors whose removal leaves every variable fixed.
  // The same graph, from which nothing is marginalised.
  IncrementalSolver full(config);
  std::map<FactorId, FactorId> full_id;
  for (int step = 0; step < 120; ++step) {
    const std::vector<Key> keys = world.Keys();
    const int what = world.Pick(10);
    if (keys.size() < 4 || what < 6) {
      FactorList factors;
      Values values;
      const Key key = X(world.next++);
      values.Insert(key, PointN(RandomVector<2>(world.rng)));
      factors.push_back(keys.empty() || world.Pick(8) == 0
                            ? FactorPtr(std::make_shared<VectorPrior>(key, zero, NoiseModel::Isotropic(2, 2.0)))
                            : world.Relative(keys[world.Pick(static_cast<int>(keys.size()))], key));
      if (keys.size() > 2) {
        const Key other = keys[world.Pick(static_cast<int>(keys.size()))];
        factors.push_back(world.Relative(other, key));
      }
      const UpdateResult result = solver.Update(factors, values);
      const UpdateResult mirrored = full.Update(factors, values);
      EXPECT_EQ(result.steps_refused, 0);
      EXPECT_EQ(mirrored.steps_refused, 0);
      for (std::size_t i = 0; i < factors.size(); ++i) full_id[result.new_factor_ids[i]] = mirrored.new_factor_ids[i];
      if (result.new_factor_ids.size() > 1) loops.insert(result.new_factor_ids[1]);
    } else if (what < 8 && !loops.empty()) {
      auto it = loops.begin();
      std::advance(it, world.Pick(static_cast<int>(loops.size())));
      solver.RemoveFactors({*it});
      full.RemoveFactors({full_id.at(*it)});
      loops.erase(it);
    } else {
      const Key first = keys[world.Pick(static_cast<int>(keys.size()))];
      const Key second = keys[world.Pick(static_cast<int>(keys.size()))];
      solver.Marginalize({first, second});
      for (auto it = loops.begin(); it != loops.end();) {
        it = solver.ContainsFactor(*it) ? std::next(it) : loops.erase(it);
      }
      EXPECT_FALSE(solver.Contains(first));
    }
    const std::vector<Key> left = world.Keys();
    if (left.empty()) continue;
    ExpectDenseSolution(solver, left);
    std::vector<Key> all;
    for (const auto& entry : full.Estimates()) all.push_back(entry.first);
    ExpectDenseSolution(full, all);
    // What is left knows as much as if nothing had gone.
    for (const Key key : left) {
      EXPECT_LT((solver.Estimate<PointN>(key) - full.Estimate<PointN>(key)).norm(), 1e-7) << KeyName(key);
      const Eigen::MatrixXd covariance = full.MarginalCovariance(key);
      EXPECT_LT((solver.MarginalCovariance(key) - covariance).norm(), 1e-7 * covariance.norm()) << KeyName(key);
    }
    if (testing::Test::HasFailure()) FAIL() << "at step " << step;
  }
}

// Poses among cylinders with loop closures; after random insertions, removals and marginalisations
// the converged estimate is the batch optimum of the factors that are left.
TEST_P(RandomSequence, NonlinearSequenceEqualsBatch) {
  std::mt19937 rng(static_cast<unsigned>(100 + GetParam()));
  const auto pick = [&rng](int n) { return static_cast<int>(rng() % static_cast<unsigned>(n)); };
  constexpr int kCylinders = 6;
  Vector6d sigma;
  sigma << 0.01, 0.01, 0.01, 0.03, 0.03, 0.03;
  Vector5d cylinder_sigma;
  cylinder_sigma << 0.02, 0.02, 0.02, 0.02, 0.2;
  const Matrix5d covariance = cylinder_sigma.cwiseAbs2().asDiagonal();
  std::vector<Cylinder> trees;
  for (int i = 0; i < kCylinders; ++i) trees.push_back(RandomCylinder(rng));
  SolverConfig config;
  config.reorder_interval = 9;
  config.relinearize_rotation_rad = 0.02;
  config.relinearize_translation_m = 0.02;
  IncrementalSolver solver(config);
  std::vector<FactorId> removable;
  std::vector<Eigen::Isometry3d> truth = {Eigen::Isometry3d::Identity()};
  std::vector<int> alive = {0};
  int marginalizations = 0;
  for (int i = 0; i < 45; ++i) {
    FactorList factors;
    Values values;
    if (i == 0) {
      factors.push_back(std::make_shared<PosePrior>(X(0), truth[0], NoiseModel::Isotropic(6, 1e-2)));
      values.Insert(X(0), truth[0]);
    } else {
      Vector6d motion;
      motion << 0, 0, 0.3, 0.8, 0, 0.05;
      truth.push_back(truth.back() * ExpSe3(motion));
      const Eigen::Isometry3d Z = ExpSe3(motion) * ExpSe3(sigma.cwiseProduct(RandomVector<6>(rng)));
      values.Insert(X(i), Eigen::Isometry3d(solver.Estimate<Eigen::Isometry3d>(X(i - 1)) * Z));
      factors.push_back(std::make_shared<BetweenFactor>(X(i - 1), X(i), Z, NoiseModel::Sigmas(sigma)));
      alive.push_back(i);
    }
    const std::size_t fixed = factors.size();
    for (int l = 0; l < kCylinders; ++l) {
      if (pick(2) == 0) continue;
      const Cylinder measured = TransformCylinder(truth[i].inverse(), trees[l])
                                    .Retract(cylinder_sigma.cwiseProduct(RandomVector<5>(rng)));
      factors.push_back(std::make_shared<CylinderFactor>(X(i), L(l), measured, covariance));
      if (!solver.Contains(L(l)) && !values.Contains(L(l))) {
        values.Insert(L(l), TransformCylinder(values.At<Eigen::Isometry3d>(X(i)), measured));
        // Without this an observation taken out could leave the landmark free.
        factors.push_back(std::make_shared<CylinderPrior>(
            L(l), values.At<Cylinder>(L(l)), NoiseModel::Sigmas(50.0 * cylinder_sigma)));
      }
    }
    if (i > 6 && pick(4) == 0) {
      const int other = alive[pick(static_cast<int>(alive.size()) - 1)];
      const Eigen::Isometry3d Z =
          truth[other].inverse() * truth[i] * ExpSe3(sigma.cwiseProduct(RandomVector<6>(rng)));
      factors.push_back(std::make_shared<BetweenFactor>(X(other), X(i), Z, NoiseModel::Sigmas(sigma)));
    }
    const UpdateResult result = solver.Update(factors, values);
    EXPECT_LE(result.error_after, result.error_before * (1 + 1e-12));
    for (std::size_t k = fixed; k < factors.size(); ++k) {
      if (dynamic_cast<const CylinderPrior*>(factors[k].get()) == nullptr) removable.push_back(result.new_factor_ids[k]);
    }
    removable.erase(std::remove_if(removable.begin(), removable.end(),
                                   [&](FactorId id) { return !solver.ContainsFactor(id); }),
                    removable.end());
    if (removable.size() > 10 && pick(3) == 0) {
      const int at = pick(static_cast<int>(removable.size()));
      solver.RemoveFactors({removable[at]});
      removable.erase(removable.begin() + at);
    }
    if (alive.size() > 8 && pick(4) == 0) {
      const int at = pick(static_cast<int>(alive.size()) - 1);
      solver.Marginalize({X(alive[at])});
      alive.erase(alive.begin() + at);
      ++marginalizations;
    }
    if (i % 15 != 14) continue;
    UpdateOptions converge;
    converge.converge = true;
    const double error = solver.Update({}, {}, converge).error_after;
    std::set<FactorId> ids;
    Values start;
    for (const auto& [key, value] : solver.Estimates()) {
      for (const FactorId id : solver.FactorsOf(key)) ids.insert(id);
      double delta[kMaxTangentDimension];
      for (double& d : delta) d = 0.01 * Normal(rng);
      start.Insert(key, Retract(value, delta));
    }
    FactorList left;
    for (const FactorId id : ids) left.push_back(solver.GetFactor(id));
    EXPECT_EQ(static_cast<int>(left.size()), solver.num_factors());
    IncrementalSolver batch;
    EXPECT_NEAR(error, batch.OptimizeBatch(left, start).error_after, 1e-6 * error);
    for (const auto& [key, value] : batch.Estimates()) {
      double delta[kMaxTangentDimension];
      LocalCoordinates(value, solver.EstimateValue(key), delta);
      for (int k = 0; k < TangentDimension(value); ++k) EXPECT_NEAR(delta[k], 0.0, 1e-4) << KeyName(key);
      const Eigen::MatrixXd expected = batch.MarginalCovariance(key);
      EXPECT_LT((solver.MarginalCovariance(key) - expected).norm(), 1e-4 * expected.norm()) << KeyName(key);
    }
  }
  EXPECT_GT(marginalizations, 2);
}

// The only prior cannot be taken out; the refusal leaves the graph, its estimate and what it knows.
TEST(Solver, RefusedRemovalOfThePriorLeavesTheGraph) {
  IncrementalSolver solver;
  Values values;
  values.Insert(X(0), Eigen::Isometry3d(Eigen::Isometry3d::Identity()));
  values.Insert(X(1), Eigen::Isometry3d(Eigen::Isometry3d::Identity()));
  const Eigen::Isometry3d I = Eigen::Isometry3d::Identity();
  const UpdateResult result = solver.Update(
      {std::make_shared<PosePrior>(X(0), I, NoiseModel::Isotropic(6, 0.1)),
       std::make_shared<BetweenFactor>(X(0), X(1), I, NoiseModel::Isotropic(6, 0.2))},
      values);
  try {
    solver.RemoveFactors({result.new_factor_ids[0]});
    FAIL();
  } catch (const UnderconstrainedError& e) {
    EXPECT_THAT(e.what(), testing::HasSubstr("add a prior"));
  }
  EXPECT_TRUE(solver.ContainsFactor(result.new_factor_ids[0]));
  const Matrix6d first = 0.01 * Matrix6d::Identity();
  const Matrix6d second = 0.05 * Matrix6d::Identity();
  EXPECT_LT((solver.MarginalCovariance(X(0)) - first).norm(), 1e-12);
  EXPECT_LT((solver.MarginalCovariance(X(1)) - second).norm(), 1e-12);
}

INSTANTIATE_TEST_SUITE_P(Seeds, RandomSequence, testing::Range(1, 6));

}  // namespace
}  // namespace dendro
