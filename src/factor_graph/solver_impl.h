#pragma once

#include <cstdint>
#include <numeric>
#include <unordered_map>
#include <vector>

#include "bayes_tree.h"
#include "dendro_slam/factor_graph/incremental_solver.h"
#include "graph_store.h"

namespace dendro {

namespace internal {

/// A factor's id holds its slot below this bit, and the slot's generation from it on.
constexpr int kGenerationShift = 32;

inline FactorId MakeFactorId(std::uint32_t generation, int slot) {
  return (static_cast<FactorId>(generation) << kGenerationShift) | static_cast<FactorId>(slot);
}

/// Errors are summed in blocks, so that a few changed factors do not cost a sum over all.
constexpr std::size_t kErrorBlock = 64;

/// What a change of 1 m is in a value's last tangent coordinate: a cylinder's curvature counts by
/// the change of its radius, `|dr| = |dkappa| / kappa^2`.
inline double LastUnit(const Value& value) {
  const auto* cylinder = std::get_if<Cylinder>(&value);
  return cylinder == nullptr ? 1.0 : cylinder->curvature * cylinder->curvature;
}

}  // namespace internal

/// The solver behind IncrementalSolver.
///
/// Variables and factors live in slots of a GraphStore; the Bayes tree, the errors and the work
/// space refer to them by slot. An update applies a Change, eliminates what it touches, and takes
/// steps; a call that throws reverts its Change.
class IncrementalSolver::Impl {
 public:
  explicit Impl(const SolverConfig& config) : config_(config), tree_(&graph_) {
    config_.Validate();
  }

  UpdateResult Update(const FactorList& new_factors,
                      const Values& new_values,
                      const UpdateOptions& options);
  UpdateResult OptimizeBatch(const FactorList& new_factors, const Values& new_values);
  FactorId Marginalize(const std::vector<Key>& keys);
  UpdateResult UpdateMarginalizing(const FactorList& new_factors,
                                   const Values& new_values,
                                   const UpdateOptions& options);

  const Value& EstimateValue(Key key) const { return graph_.variables[SlotOf(key)].estimate; }
  Values Estimates() const;
  bool Contains(Key key) const { return slots_.count(key) != 0; }
  Eigen::MatrixXd JointMarginalCovariance(const std::vector<Key>& keys) const;
  std::vector<Eigen::MatrixXd> PairMarginalCovariances(Key first,
                                                       const std::vector<Key>& others) const;
  double Error() const { return std::accumulate(error_sums_.begin(), error_sums_.end(), 0.0); }
  double FactorError(FactorId id) const { return errors_[FactorSlot(id)]; }
  const FactorPtr& GetFactor(FactorId id) const { return graph_.factors[FactorSlot(id)].factor; }
  bool ContainsFactor(FactorId id) const { return FindFactor(id) >= 0; }
  std::vector<FactorId> FactorsOf(Key key) const;
  int NumFactorsOf(Key key) const {
    return static_cast<int>(graph_.variables[SlotOf(key)].factors.size());
  }
  int num_variables() const { return static_cast<int>(slots_.size()); }
  int num_factors() const { return num_factors_; }
  const SolverConfig& config() const { return config_; }

 private:
  // A variable that a step moves, in tangent coordinates at its linearisation point.
  struct Move {
    int variable;
    double before[kMaxTangentDimension];
    double after[kMaxTangentDimension];  // Of the whole step.
    double published_before[kMaxTangentDimension];
  };

  // One step of back-substitution that can be undone.
  struct Step {
    std::vector<Move> moves;
    std::vector<int> factors;    // With a variable that moved.
    std::vector<double> errors;  // Theirs, before.
    std::vector<int> cliques;    // Solved.

    void Clear();  // Keeps the memory.
  };

  // What an update does to the graph, with what is needed to take it back.
  struct Change {
    std::vector<int> new_variables;  // Slots.
    std::vector<int> new_factors;    // Slots.
    std::vector<int> touched;        // Variables of new and removed factors that are in the tree.
    std::vector<int> dropped_variables;  // They lost their last factor.
    std::vector<int> removed_slots;
    std::vector<internal::FactorRecord> removed_records;
  };

  // Bookkeeping (incremental_solver.cpp).
  int SlotOf(Key key) const;
  int FindFactor(FactorId id) const;
  int FactorSlot(FactorId id) const;
  void CheckInput(const FactorList& new_factors,
                  const Values& new_values,
                  const UpdateOptions& options) const;
  int AddVariable(Key key, const Value& value);
  int AddFactor(const FactorPtr& factor);
  void DropFactor(int slot);
  void DropVariable(int slot);

  // Errors and linearisation (solver_linearization.cpp).
  double EvaluateError(int slot);
  void EvaluateErrors(const std::vector<int>& slots);
  void Prefetch(const std::vector<int>& queue, std::size_t at) const;
  void SetError(int slot, double error);
  double TotalError();
  void LinearizeFactor(int slot);
  void AddUnary(int slot);
  void SumUnary(int variable);
  bool NeedsRelinearization(int slot) const;
  void Relinearize(const std::vector<int>& variables);
  void ComputeWeights();

  // Updates (solver_update.cpp).
  Change ApplyChange(const FactorList& new_factors,
                     const Values& new_values,
                     const UpdateOptions& options);
  void Revert(const Change& change);
  std::vector<int> TakeMovedFar();
  void MarkRelinearized(const std::vector<int>& variables);
  void Eliminate(const Change& change, const UpdateOptions& options, UpdateResult* result);
  void TakeSteps(UpdateResult* result);
  bool ShortenUntilLower(double error_before);
  void Solve(double publish_threshold, double still_threshold, Step* step);
  void Undo(const Step& step);
  void MoveEstimate(int slot);
  void Shorten(const Step& step, double fraction);
  void RebuildTree();
  void TakeBack(const std::vector<int>& factors, const std::vector<int>& variables);
  void RestoreTree();
  [[noreturn]] void ThrowUnderconstrained(int slot) const;
  UpdateResult Iterate(double tolerance, int max_iterations, UpdateResult result);

  // Marginals (solver_marginals.cpp).
  Eigen::MatrixXd TangentAtEstimate(int slot) const;
  void TakeOutDamping() const;
  FactorList Absorb(const std::vector<Key>& keys, std::vector<FactorId>* removed_factors);

  SolverConfig config_;
  internal::GraphStore graph_;
  mutable internal::BayesTree tree_;     // Marginals take damping out of it.
  std::vector<double> errors_;           // Per factor slot, at the estimate; 0 in free slots.
  std::vector<double> error_sums_;       // Per block of kErrorBlock factor slots.
  std::vector<char> error_block_stale_;  // Its sum is to be taken again, by TotalError.
  std::vector<int> stale_error_blocks_;
  std::vector<int> moved_;       // Moved since they were last looked at for re-linearisation.
  std::vector<char> has_moved_;  // Per variable slot: is in moved_.
  std::unordered_map<Key, int> slots_;
  std::vector<int> free_variables_;
  std::vector<int> free_factors_;
  int num_factors_ = 0;
  int epoch_ = 0;
  int last_reorder_ = 0;
  double lambda_ = 0.0;
  // Eliminated with damping: again at the next update, or for the next marginal.
  mutable std::vector<int> damped_variables_;
  internal::Damping damping_;  // What they were eliminated with.
  // Work space.
  std::vector<double> weights_;
  std::vector<int> groups_;
  std::vector<double> jacobian_;
  std::vector<double> x_;
  std::vector<const Value*> values_;
  std::vector<int> queue_;
  Step step_;
  std::vector<int> variable_stamp_;
  std::vector<int> factor_stamp_;
  int stamp_ = 0;
};

}  // namespace dendro
