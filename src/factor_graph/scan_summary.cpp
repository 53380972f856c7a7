#include "dendro_slam/factor_graph/scan_summary.h"

#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "dendro_slam/factor_graph/between_factor.h"
#include "dendro_slam/factor_graph/incremental_solver.h"
#include "dendro_slam/factor_graph/prior_factor.h"

namespace dendro {

namespace {

// Of the prior that makes `to` the origin [rad, m]: far below any measurement.
constexpr double kOriginSigma = 1e-6;

// Relative decrease of the error below which it is at the optimum: what a further step would move
// is a thousandth of the sigmas.
constexpr double kTolerance = 1e-6;

}  // namespace

ScanSummary SummarizeScans(Key from,
                           Key to,
                           const FactorList& factors,
                           const Values& poses,
                           const RobustKernel& kernel) {
  const Eigen::Isometry3d T_to_frame = poses.At<Eigen::Isometry3d>(to).inverse();
  Values start;
  for (const auto& entry : poses) {
    start.Insert(entry.first,
                 Eigen::Isometry3d(T_to_frame * poses.At<Eigen::Isometry3d>(entry.first)));
  }
  std::vector<Key> kept = {from};
  for (const FactorPtr& factor : factors) {
    const auto* seen = dynamic_cast<const CylinderFactor*>(factor.get());
    if (seen == nullptr || start.Contains(seen->keys()[1])) continue;
    // Its anchor is the middle of what was seen, and so will be that of the summary.
    start.Insert(seen->keys()[1],
                 TransformCylinder(start.At<Eigen::Isometry3d>(seen->keys()[0]), seen->measured()));
  }
  for (const auto& [key, value] : start) {
    if (std::holds_alternative<Cylinder>(value)) kept.push_back(key);
  }
  FactorList all = factors;
  all.push_back(std::make_shared<PosePrior>(
      to, Eigen::Isometry3d::Identity(), NoiseModel::Isotropic(6, kOriginSigma)));
  SolverConfig config;
  config.relative_tolerance = kTolerance;
  IncrementalSolver solver(config);
  if (!solver.OptimizeBatch(all, start).converged) {
    throw std::runtime_error("the scans from " + KeyName(from) + " to " + KeyName(to) +
                             " do not come to agree; keep them as poses of their own");
  }

  const Eigen::MatrixXd covariance = solver.JointMarginalCovariance(kept);
  ScanSummary summary;
  // The right tangent of `from` in the frame of `to` is that of this factor's residual.
  summary.factors.push_back(
      std::make_shared<BetweenFactor>(to,
                                      from,
                                      solver.Estimate<Eigen::Isometry3d>(from),
                                      NoiseModel::Covariance(covariance.topLeftCorner<6, 6>())));
  Eigen::Index at = 6;
  for (std::size_t i = 1; i < kept.size(); ++i, at += 5) {
    summary.factors.push_back(std::make_shared<CylinderFactor>(to,
                                                               kept[i],
                                                               solver.Estimate<Cylinder>(kept[i]),
                                                               covariance.block<5, 5>(at, at),
                                                               CylinderParts{},
                                                               kernel));
  }
  for (const auto& entry : poses) {
    summary.scans.emplace(entry.first, solver.Estimate<Eigen::Isometry3d>(entry.first));
  }
  return summary;
}

}  // namespace dendro
