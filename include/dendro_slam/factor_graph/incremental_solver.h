#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include <Eigen/Core>

#include "dendro_slam/factor_graph/factor.h"
#include "dendro_slam/factor_graph/values.h"

namespace dendro {

struct SolverConfig {
  double relinearize_rotation_rad = 0.1;     ///< A pose is re-linearised beyond this rotation [rad]. >= 0.
  double relinearize_translation_m = 0.1;    ///< A pose is re-linearised beyond this translation [m]. >= 0.
  double relinearize_axis_rad = 0.05;        ///< A cylinder is re-linearised beyond this turn of its axis [rad]. >= 0.
  double relinearize_offset_m = 0.1;         ///< A cylinder or point is re-linearised beyond this displacement [m]. >= 0.
  int relinearize_skip = 1;                  ///< Look for variables to re-linearise every n-th update. >= 1.
  double wildfire_threshold = 1e-3;          ///< Back-substitution stops where nothing changed by more [rad, m; a curvature by its radius]. >= 0.
  double still_threshold = 2e-5;             ///< A variable stays where it is when it would change by less [rad, m; likewise]. >= 0.
  int max_iterations = 5;                    ///< Levenberg-Marquardt steps of one update, refused ones included. >= 1.
  double lambda_initial = 1e-4;              ///< Damping after the first refused step, relative to the Hessian's diagonal. > 0.
  double lambda_up = 10.0;                   ///< Factor of the damping after a refused step. > 1.
  double lambda_down = 0.1;                  ///< Factor of the damping after an accepted step. In (0, 1).
  double lambda_min = 1e-7;                  ///< Smaller damping is none. > 0.
  double lambda_max = 1e10;                  ///< A step refused beyond this damping leaves the estimate as it is. > lambda_initial.
  int batch_max_iterations = 100;            ///< Steps of Optimize(). >= 1.
  double relative_tolerance = 1e-10;         ///< Optimize() ends when a step lowers the error by less than this part of it. >= 0.
  int reorder_interval = 128;                ///< Updates between new eliminations orders of the recent part of the graph. >= 1.

  /// @throws std::invalid_argument naming the field.
  void Validate() const;

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("relinearize_rotation_rad", relinearize_rotation_rad);
    v("relinearize_translation_m", relinearize_translation_m);
    v("relinearize_axis_rad", relinearize_axis_rad);
    v("relinearize_offset_m", relinearize_offset_m);
    v("relinearize_skip", relinearize_skip);
    v("wildfire_threshold", wildfire_threshold);
    v("still_threshold", still_threshold);
    v("max_iterations", max_iterations);
    v("lambda_initial", lambda_initial);
    v("lambda_up", lambda_up);
    v("lambda_down", lambda_down);
    v("lambda_min", lambda_min);
    v("lambda_max", lambda_max);
    v("batch_max_iterations", batch_max_iterations);
    v("relative_tolerance", relative_tolerance);
    v("reorder_interval", reorder_interval);
  }
};

/// Names a factor of one solver; never reused for another.
using FactorId = std::uint64_t;

struct UpdateOptions {
  std::vector<FactorId> remove_factors;   ///< Taken out before the new ones go in.
  std::vector<Key> constrained_last;      ///< Kept at the root besides the variables of the new factors.
  std::vector<Key> marginalize;           ///< As Marginalize does, before the new factors go in (which must
                                          ///< not name them), but in one elimination with them. Their
                                          ///< linear factor's id comes after those of the new factors.
  bool converge = false;                  ///< Iterate to the batch optimum, thresholds off.
};

struct UpdateResult {
  double error_before = 0.0;        ///< 1/2 chi2 of the new graph at the old estimate and the new values.
  double error_after = 0.0;         ///< 1/2 chi2 of the new graph at the new estimate; above error_before
                                    ///< by rounding at most (1e-13 relative plus 1e-12).
  double damping = 0.0;             ///< Levenberg-Marquardt lambda of the last accepted step; 0 is Gauss-Newton.
  int variables_relinearized = 0;
  int variables_reeliminated = 0;
  int iterations = 0;               ///< Steps tried.
  int steps_refused = 0;            ///< Of those, refused because they raised the error.
  bool converged = false;           ///< Of Optimize() and `converge`: the tolerance was met.
  double seconds = 0.0;             ///< Wall time of the call.
  std::vector<FactorId> new_factor_ids;  ///< In the order of the new factors.
};

/// Incremental nonlinear least squares on a factor graph (stage 4): a Bayes tree in which new
/// factors touch few cliques, Levenberg-Marquardt steps that never raise the true error, and
/// re-linearisation where the estimate has moved away from its linearisation point.
///
/// The graph is eliminated by a multifrontal Cholesky factorisation along a CCOLAMD order (Kaess et
/// al., "iSAM2", IJRR 2012; Davis, "Direct Methods for Sparse Linear Systems"). Owns the factors'
/// linearisations and the estimate; shares the factors. Deterministic; no state outside the object.
///
/// A call that throws leaves the graph and the estimate as they were, but for two: Update with `converge`
/// keeps its change when a later iteration throws, OptimizeBatch the estimates of steps it had accepted.
class IncrementalSolver {
 public:
  explicit IncrementalSolver(const SolverConfig& config = {});
  ~IncrementalSolver();
  IncrementalSolver(IncrementalSolver&&) noexcept;
  IncrementalSolver& operator=(IncrementalSolver&&) noexcept;

  /// Adds variables and factors, removes factors, and takes as many steps as the error needs.
  /// @param new_factors  Each may name variables of the graph and of new_values.
  /// @param new_values   Initial values of the variables that the graph does not have yet.
  /// @throws UnknownVariableError, DuplicateVariableError, NonFiniteError, UnknownFactorError,
  ///         UnderconstrainedError; the graph is then as before the call.
  UpdateResult Update(const FactorList& new_factors,
                      const Values& new_values,
                      const UpdateOptions& options = {});

  /// Removes factors without adding any. A variable may be left under-constrained only if it has no
  /// factor at all: it is then removed too.
  UpdateResult RemoveFactors(const std::vector<FactorId>& factors);

  /// Batch mode: re-linearises everything in a new elimination order and iterates
  /// Levenberg-Marquardt to the optimum.
  UpdateResult Optimize();

  /// Adds variables and factors as Update does, but without a step of its own, then Optimize().
  UpdateResult OptimizeBatch(const FactorList& new_factors, const Values& new_values);

  /// Replaces variables by the linear factor that they leave on their neighbours (Schur complement
  /// at the present estimate) and removes them with all their factors, so that a long run stays
  /// bounded. What is left has the estimate and the marginal covariances it had (exactly where the
  /// removed factors were linear; otherwise to the error of linearising them at the estimate).
  ///
  /// The linear factor keeps its linearisation point for good: it is a quadratic in the tangent space
  /// of each neighbour there, and takes part in later steps, re-linearisation and damping as any other
  /// factor. A later call that removes one of its variables absorbs it, so a window that slides by one
  /// pose at a time has one such factor on the poses and landmarks at its edge. It joins all neighbours,
  /// so remove what has few of them: a pose between two others and the landmarks seen from it.
  /// Dense, cubic in the tangent dimensions of `keys` and their neighbours together: a few poses a
  /// call. The constant of the quadratic is dropped, so Error() falls by what the removed factors
  /// contribute at the optimum.
  /// @param keys  Duplicates count once.
  /// @throws UnknownVariableError for a key that is not in the graph; UnderconstrainedError, naming a
  ///         variable, if the factors leave a direction of the removed variables free. The graph is
  ///         then as before.
  /// @return  Id of the linear factor; 0 if the variables had no neighbours.
  FactorId Marginalize(const std::vector<Key>& keys);

  /// The present estimate. @throws UnknownVariableError if missing or of another type. The
  /// reference is valid until the next call that is not const.
  template <class T>
  const T& Estimate(Key key) const {
    const T* value = std::get_if<T>(&EstimateValue(key));
    if (value == nullptr) ThrowWrongType(key);
    return *value;
  }
  const Value& EstimateValue(Key key) const;
  Values Estimates() const;
  bool Contains(Key key) const;

  /// Marginal covariance of a variable in its tangent coordinates at the estimate (of the last
  /// linearisation; exact after convergence), of the measurements alone: damping of the last step is
  /// taken out of the factorisation first, so not even this may be called from two threads at once.
  /// @throws UnknownVariableError; UnderconstrainedError where only damping made the graph solvable.
  Eigen::MatrixXd MarginalCovariance(Key key) const;
  /// Joint marginal covariance, blocks in the order of `keys`.
  Eigen::MatrixXd JointMarginalCovariance(const std::vector<Key>& keys) const;

  /// Joint marginal covariance of `first` and each of `others` alone, in the order of `others`: much
  /// less work than all of them together.
  std::vector<Eigen::MatrixXd> PairMarginalCovariances(Key first, const std::vector<Key>& others) const;

  /// 1/2 chi2 of the graph at the estimate (robust kernels included).
  double Error() const;
  /// 1/2 chi2 of one factor. @throws UnknownFactorError.
  double FactorError(FactorId factor) const;
  /// @throws UnknownFactorError.
  const FactorPtr& GetFactor(FactorId factor) const;
  bool ContainsFactor(FactorId factor) const;
  /// Ids of the factors of a variable, ascending. @throws UnknownVariableError.
  std::vector<FactorId> FactorsOf(Key key) const;

  /// How many they are.
  int NumFactorsOf(Key key) const;

  int num_variables() const;
  int num_factors() const;
  const SolverConfig& config() const;

 private:
  class Impl;
  [[noreturn]] static void ThrowWrongType(Key key);

  std::unique_ptr<Impl> impl_;
};

}  // namespace dendro
