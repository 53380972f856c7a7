#pragma once

#include <map>

#include "dendro_slam/factor_graph/cylinder_factor.h"

namespace dendro {

/// What the scans from one key frame to the next say, as factors on the two key frames alone.
struct ScanSummary {
  /// `BetweenFactor(to, from)`, then one `CylinderFactor(to, landmark)` per landmark, ascending in
  /// key.
  FactorList factors;
  /// Where the scans stand in the newer key frame, T_to_scan, with all that they saw.
  std::map<Key, Eigen::Isometry3d> scans;
};

/// Pre-integrates scans: a key frame then adds one factor per landmark, whatever the number of
/// scans since the one before.
///
/// The factors are solved on their own, with `to` as the origin and every landmark and scan as a
/// variable of that small graph. What is kept is the marginal of each landmark and of the older key
/// frame relative to `to`: of all Gaussians in which these are independent, the one closest (in
/// Kullback-Leibler divergence) to the joint marginal, because as many residuals as dimensions are
/// recovered (Mazuran, Burgard, Tipaldi, "Nonlinear Factor Recovery for Long-Term SLAM", IJRR 2016,
/// section 5). Curvatures that were measured independently of their lines lose nothing; what is lost is
/// that all landmarks of a scan share the error of its motion. IncrementalSolver::Marginalize keeps that too, as one dense factor over all
/// landmarks of the key frame, whose cost in every later step is the square of their number.
///
/// @param from, to  Older and newer key frame.
/// @param factors   All factors of the scans after `from` up to and including `to`: motions between
///                  poses and at least one CylinderFactor for each landmark. None may refer to the
///                  map frame (priors stay in the large graph).
/// @param poses     Estimates of `from`, `to` and the scans between in one frame, whichever.
/// @param kernel    Of the cylinder factors that come out; their covariances are those of the
///                  kernels' weights inside.
/// @throws UnknownVariableError for a pose without an estimate or a landmark without a CylinderFactor;
///         std::runtime_error where the scans do not come to agree; UnderconstrainedError where parts that are switched off, or a missing motion, leave a
///         variable free.
ScanSummary SummarizeScans(Key from,
                           Key to,
                           const FactorList& factors,
                           const Values& poses,
                           const RobustKernel& kernel = {});

}  // namespace dendro
