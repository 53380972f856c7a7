// Public pose graphs: the batch optimum from chordal initialisation, and the incremental estimate
// against it.
#include <algorithm>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <map>
#include <memory>
#include <ostream>
#include <string>
#include <vector>

#include <Eigen/Cholesky>
#include <gmock/gmock.h>

#include "dendro_slam/factor_graph/g2o.h"
#include "dendro_slam/factor_graph/incremental_solver.h"
#include "dendro_slam/factor_graph/prior_factor.h"

namespace dendro {
namespace {

struct Known {
  const char* file;
  double half_chi2;         // Best known.
  double incremental_part;  // By what part of it the last incremental estimate may lie above.
};

void PrintTo(const Known& known, std::ostream* out) { *out << known.file; }

class PublicGraph : public testing::TestWithParam<Known> {
 protected:
  void SetUp() override {
    const std::string path = std::string(DENDRO_SHARED_DATA) + "/posegraph/" + GetParam().file;
    if (!std::filesystem::exists(path)) GTEST_SKIP() << path << " is missing";
    std::ifstream in(path);
    graph_ = ReadG2o(in);
    factors_ = PoseGraphFactors(graph_);
    prior_ = std::make_shared<PosePrior>(PoseGraphKey(graph_.poses.begin()->first),
                                         graph_.poses.begin()->second, NoiseModel::Isotropic(6, 1e-4));
  }

  PoseGraph graph_;
  FactorList factors_;
  FactorPtr prior_;
};

TEST_P(PublicGraph, BatchFromChordalReachesTheBestKnown) {
  Values values;
  for (const auto& [id, pose] : ChordalInitialization(graph_)) values.Insert(PoseGraphKey(id), pose);
  FactorList all = factors_;
  all.push_back(prior_);
  IncrementalSolver solver;
  const UpdateResult result = solver.OptimizeBatch(all, values);
  EXPECT_TRUE(result.converged);
  EXPECT_NEAR(result.error_after, GetParam().half_chi2, 1e-5 * GetParam().half_chi2);

  // Marginals against the inverse of the dense Hessian, where that is quick.
  constexpr std::size_t kMostPoses = 200;
  if (graph_.poses.size() > kMostPoses) return;
  const Values estimates = solver.Estimates();
  std::map<Key, int> offset;
  for (const auto& entry : estimates) offset.emplace(entry.first, 6 * static_cast<int>(offset.size()));
  const int size = 6 * static_cast<int>(offset.size());
  Eigen::MatrixXd H = Eigen::MatrixXd::Zero(size, size);
  for (const FactorPtr& factor : all) {
    Eigen::MatrixXd J;
    Eigen::VectorXd r;
    factor->Linearize(estimates, &J, &r);
    for (int a = 0; a < factor->keys().size(); ++a) {
      for (int b = 0; b < factor->keys().size(); ++b) {
        H.block<6, 6>(offset.at(factor->keys()[a]), offset.at(factor->keys()[b])) +=
            J.middleCols<6>(6 * a).transpose() * J.middleCols<6>(6 * b);
      }
    }
  }
  const Eigen::LLT<Eigen::MatrixXd> llt(H);
  ASSERT_EQ(llt.info(), Eigen::Success);
  const Eigen::MatrixXd covariance = llt.solve(Eigen::MatrixXd::Identity(size, size));
  for (const auto& [key, at] : offset) {
    const Matrix6d expected = covariance.block<6, 6>(at, at);
    EXPECT_LT((solver.MarginalCovariance(key) - expected).norm(), 1e-5 * expected.norm()) << KeyName(key);
  }
}

// Pose by pose with the settings of solve_g2o: no update raises the error, the last estimate is near
// the best known, and once converged it is the batch optimum.
TEST_P(PublicGraph, IncrementalEqualsBatch) {
  SolverConfig config;
  config.relinearize_skip = 10;
  config.still_threshold = config.wildfire_threshold;
  IncrementalSolver solver(config);
  std::map<std::int64_t, std::vector<std::size_t>> edges_of;
  for (std::size_t i = 0; i < graph_.edges.size(); ++i) {
    edges_of[std::max(graph_.edges[i].from, graph_.edges[i].to)].push_back(i);
  }
  for (const auto& [id, file_pose] : graph_.poses) {
    FactorList factors;
    Eigen::Isometry3d pose = file_pose;
    std::int64_t latest = -1;
    for (const std::size_t i : edges_of[id]) {
      const PoseGraphEdge& edge = graph_.edges[i];
      factors.push_back(factors_[i]);
      const std::int64_t other = edge.from == id ? edge.to : edge.from;
      if (other <= latest) continue;
      latest = other;
      pose = solver.Estimate<Eigen::Isometry3d>(PoseGraphKey(other)) *
             (edge.from == id ? edge.T_from_to.inverse() : edge.T_from_to);
    }
    if (id == graph_.poses.begin()->first) factors.push_back(prior_);
    Values values;
    values.Insert(PoseGraphKey(id), pose);
    const UpdateResult result = solver.Update(factors, values);
    ASSERT_LE(result.error_after, result.error_before * (1 + 1e-12) + 1e-11) << "pose " << id;
  }
  const double best = GetParam().half_chi2;
  EXPECT_LT(solver.Error(), best * (1 + GetParam().incremental_part));
  UpdateOptions converge;
  converge.converge = true;
  const double converged = solver.Update({}, {}, converge).error_after;
  const Values estimates = solver.Estimates();
  EXPECT_NEAR(converged, best, 1e-5 * best);
  IncrementalSolver batch;
  Values chordal;
  for (const auto& [id, pose] : ChordalInitialization(graph_)) chordal.Insert(PoseGraphKey(id), pose);
  FactorList all = factors_;
  all.push_back(prior_);
  EXPECT_NEAR(converged, batch.OptimizeBatch(all, chordal).error_after, 1e-6 * best);
}

INSTANTIATE_TEST_SUITE_P(Shared,
                         PublicGraph,
                         testing::Values(Known{"smallGrid3D.g2o", 517.925, 5e-3},
                                         Known{"sphere2500.g2o", 675.701, 5e-4},
                                         Known{"parking-garage.g2o", 0.634192, 5e-4}),
                         [](const testing::TestParamInfo<Known>& info) {
                           std::string name = info.param.file;
                           name = name.substr(0, name.find('.'));
                           name.erase(std::remove(name.begin(), name.end(), '-'), name.end());
                           return name;
                         });

}  // namespace
}  // namespace dendro
