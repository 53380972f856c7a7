#include "dendro_slam/factor_graph/incremental_solver.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <numeric>
#include <stdexcept>
#include <unordered_map>

#include <Eigen/Cholesky>

#include "bayes_tree.h"
#include "dendro_slam/factor_graph/linear_factor.h"
#include "graph_store.h"

namespace dendro {

using internal::BayesTree;
using internal::Clique;
using internal::Damping;
using internal::FactorRecord;
using internal::GraphStore;
using internal::PrefetchLines;
using internal::VariableRecord;
using internal::VariableState;

namespace {

constexpr int kGenerationShift = 32;

FactorId MakeFactorId(std::uint32_t generation, int slot) {
  return (static_cast<FactorId>(generation) << kGenerationShift) | static_cast<FactorId>(slot);
}

void Require(bool ok, const char* field, const char* rule) {
  if (!ok) throw std::invalid_argument(std::string("SolverConfig.") + field + " must be " + rule);
}

// The error is a sum of rounded terms: a rise within this part of it, or within a part of a
// billionth of one measurement's expected error, is no rise.
constexpr double kRelativeRounding = 1e-13;
constexpr double kAbsoluteRounding = 1e-12;

// A step that raises the error by less than this factor is shortened before it is damped.
constexpr double kSmallRise = 1.1;

// A step that raises the error by less than this part of it, and no part of which lowers it, is at
// the optimum as far as the linearisation can tell: the estimate stays, damping would find nothing.
constexpr double kNegligibleRise = 1e-4;

// A step of which too small a part was taken is taken again with thresholds smaller by this.
constexpr double kFinePart = 0.02;

// A diagonal entry of which marginalisation leaves less than this part is zero.
constexpr double kNoInformation = 1e-12;

// Errors are summed in blocks, so that a few changed factors do not cost a sum over all.
constexpr std::size_t kErrorBlock = 64;

// A change of a cylinder's curvature counts by the change of its radius, |dr| = |dkappa| / kappa^2.
double LastUnit(const Value& value) {
  const auto* cylinder = std::get_if<Cylinder>(&value);
  return cylinder == nullptr ? 1.0 : cylinder->curvature * cylinder->curvature;
}

bool Lowers(double after, double before) {
  return after <= before * (1.0 + kRelativeRounding) + kAbsoluteRounding;
}

}  // namespace

void SolverConfig::Validate() const {
  const auto not_negative = [](double x) { return std::isfinite(x) && x >= 0.0; };
  const auto positive = [](double x) { return std::isfinite(x) && x > 0.0; };
  Require(not_negative(relinearize_rotation_rad), "relinearize_rotation_rad", ">= 0");
  Require(not_negative(relinearize_translation_m), "relinearize_translation_m", ">= 0");
  Require(not_negative(relinearize_axis_rad), "relinearize_axis_rad", ">= 0");
  Require(not_negative(relinearize_offset_m), "relinearize_offset_m", ">= 0");
  Require(relinearize_skip >= 1, "relinearize_skip", ">= 1");
  Require(not_negative(wildfire_threshold), "wildfire_threshold", ">= 0");
  Require(not_negative(still_threshold), "still_threshold", ">= 0");
  Require(max_iterations >= 1, "max_iterations", ">= 1");
  Require(positive(lambda_initial), "lambda_initial", "> 0");
  Require(std::isfinite(lambda_up) && lambda_up > 1.0, "lambda_up", "> 1");
  Require(positive(lambda_down) && lambda_down < 1.0, "lambda_down", "in (0, 1)");
  Require(positive(lambda_min), "lambda_min", "> 0");
  Require(std::isfinite(lambda_max) && lambda_max > lambda_initial, "lambda_max", "> lambda_initial");
  Require(batch_max_iterations >= 1, "batch_max_iterations", ">= 1");
  Require(not_negative(relative_tolerance), "relative_tolerance", ">= 0");
  Require(reorder_interval >= 1, "reorder_interval", ">= 1");
}

class IncrementalSolver::Impl {
 public:
  explicit Impl(const SolverConfig& config) : config_(config), tree_(&graph_) { config_.Validate(); }

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
  std::vector<Eigen::MatrixXd> PairMarginalCovariances(Key first, const std::vector<Key>& others) const;
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
    double after[kMaxTangentDimension];            // Of the whole step.
    double published_before[kMaxTangentDimension];
  };

  // One step of back-substitution that can be undone.
  struct Step {
    std::vector<Move> moves;
    std::vector<int> factors;       // With a variable that moved.
    std::vector<double> errors;     // Theirs, before.
    std::vector<int> cliques;       // Solved.

    void Clear();  // Keeps the memory.
  };

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
  void Solve(double publish_threshold, double still_threshold, Step* step);
  void Undo(const Step& step);
  void MoveEstimate(int slot);
  void Shorten(const Step& step, double fraction);
  void RebuildTree();
  void TakeBack(const std::vector<int>& factors, const std::vector<int>& variables);
  void RestoreTree();
  [[noreturn]] void ThrowUnderconstrained(int slot) const;
  UpdateResult Iterate(double tolerance, int max_iterations, UpdateResult result);
  Eigen::MatrixXd TangentAtEstimate(int slot) const;
  void TakeOutDamping() const;
  FactorList Absorb(const std::vector<Key>& keys, std::vector<FactorId>* removed_factors);

  SolverConfig config_;
  GraphStore graph_;
  mutable BayesTree tree_;  // Marginals take damping out of it.
  std::vector<double> errors_;  // Per factor slot, at the estimate; 0 in free slots.
  std::vector<double> error_sums_;       // Per block of kErrorBlock factor slots.
  std::vector<char> error_block_stale_;  // Its sum is to be taken again, by TotalError.
  std::vector<int> stale_error_blocks_;
  std::vector<int> moved_;               // Moved since they were last looked at for re-linearisation.
  std::vector<char> has_moved_;          // Per variable slot: is in moved_.
  std::unordered_map<Key, int> slots_;
  std::vector<int> free_variables_;
  std::vector<int> free_factors_;
  int num_factors_ = 0;
  int epoch_ = 0;
  int last_reorder_ = 0;
  double lambda_ = 0.0;
  // Eliminated with damping: again at the next update, or for the next marginal.
  mutable std::vector<int> damped_variables_;
  Damping damping_;  // What they were eliminated with.
  // Work space.
  std::vector<double> weights_;
  std::vector<int> groups_;
  std::vector<double> jacobian_;
  std::vector<double> residual_;
  std::vector<double> x_;
  std::vector<const Value*> values_;
  std::vector<int> queue_;
  Step step_;
  std::vector<int> variable_stamp_;
  std::vector<int> factor_stamp_;
  int stamp_ = 0;
};

// -------------------------------------------------------------------------------------------------
// Bookkeeping
// -------------------------------------------------------------------------------------------------

int IncrementalSolver::Impl::SlotOf(Key key) const {
  const auto it = slots_.find(key);
  if (it == slots_.end()) {
    throw UnknownVariableError(key, "variable " + KeyName(key) +
                                        " is not in the graph; add it with an update before it is "
                                        "used, or correct the key");
  }
  return it->second;
}

int IncrementalSolver::Impl::FindFactor(FactorId id) const {
  const FactorId slot = id & ((FactorId{1} << kGenerationShift) - 1);
  if (slot >= graph_.factors.size()) return -1;
  const FactorRecord& record = graph_.factors[slot];
  const auto generation = static_cast<std::uint32_t>(id >> kGenerationShift);
  return record.factor && record.generation == generation ? static_cast<int>(slot) : -1;
}

int IncrementalSolver::Impl::FactorSlot(FactorId id) const {
  const int slot = FindFactor(id);
  if (slot < 0) {
    throw UnknownFactorError("factor " + std::to_string(id) +
                             " is not in the graph; it was never added or is already removed");
  }
  return slot;
}

void IncrementalSolver::Impl::CheckInput(const FactorList& new_factors,
                                         const Values& new_values,
                                         const UpdateOptions& options) const {
  for (const auto& [key, value] : new_values) {
    if (Contains(key)) {
      throw DuplicateVariableError(key, "variable " + KeyName(key) +
                                            " is already in the graph; give new values only for new "
                                            "variables");
    }
    if (!IsValid(value)) {
      throw NonFiniteError(key, "the initial value of variable " + KeyName(key) +
                                    " is not a valid " + TypeName(value) +
                                    " (NaN, infinite or off its manifold); correct it before adding it");
    }
  }
  std::unordered_map<Key, int> uses;
  std::vector<const Value*> pointers;
  for (const FactorPtr& factor : new_factors) {
    if (!factor) throw std::invalid_argument("Update: a new factor is null");
    pointers.clear();
    const KeySpan keys = factor->keys();
    for (int i = 0; i < keys.size(); ++i) {
      const Key key = keys[i];
      for (int j = 0; j < i; ++j) {
        if (keys[j] == key) {
          throw DuplicateVariableError(key, factor->Describe() + ": variable " + KeyName(key) +
                                                " appears twice in one factor");
        }
      }
      if (new_values.Contains(key)) {
        pointers.push_back(&new_values.Get(key));
        ++uses[key];
      } else if (Contains(key)) {
        pointers.push_back(&EstimateValue(key));
      } else {
        throw UnknownVariableError(key, factor->Describe() + ": variable " + KeyName(key) +
                                            " has no value; add its initial value with this update");
      }
    }
    factor->CheckTypes(pointers.data());
    if (!std::isfinite(factor->Error(pointers.data()))) {
      throw NonFiniteError(keys[0], factor->Describe() + ": the error at " + KeyName(keys[0]) +
                                        " is not finite; check the measurement and the initial values");
    }
  }
  for (const auto& [key, value] : new_values) {
    if (uses.count(key) == 0) {
      throw UnderconstrainedError(key, "variable " + KeyName(key) +
                                           " has no factor; add one in the same update or leave the "
                                           "variable out");
    }
  }
  std::vector<FactorId> removed = options.remove_factors;
  std::sort(removed.begin(), removed.end());
  for (std::size_t i = 0; i < removed.size(); ++i) {
    FactorSlot(removed[i]);
    if (i > 0 && removed[i] == removed[i - 1]) {
      throw UnknownFactorError("factor " + std::to_string(removed[i]) + " is to be removed twice");
    }
  }
  for (const Key key : options.constrained_last) {
    if (!new_values.Contains(key)) SlotOf(key);
  }
}

int IncrementalSolver::Impl::AddVariable(Key key, const Value& value) {
  int slot = 0;
  if (free_variables_.empty()) {
    slot = static_cast<int>(graph_.variables.size());
    graph_.variables.emplace_back();
    graph_.states.emplace_back();
    groups_.push_back(0);
    variable_stamp_.push_back(0);
    has_moved_.push_back(0);
  } else {
    slot = free_variables_.back();
    free_variables_.pop_back();
  }
  VariableRecord& v = graph_.variables[slot];
  v = VariableRecord();
  v.key = key;
  v.alive = true;
  v.theta = value;
  v.estimate = value;
  graph_.states[slot] = VariableState();
  graph_.states[slot].dimension = TangentDimension(value);
  graph_.states[slot].last_unit = LastUnit(value);
  slots_[key] = slot;
  return slot;
}

int IncrementalSolver::Impl::AddFactor(const FactorPtr& factor) {
  int slot = 0;
  if (free_factors_.empty()) {
    slot = static_cast<int>(graph_.factors.size());
    graph_.factors.emplace_back();
    errors_.push_back(0.0);
    if (errors_.size() > error_sums_.size() * kErrorBlock) {
      error_sums_.push_back(0.0);
      error_block_stale_.push_back(0);
    }
    factor_stamp_.push_back(0);
  } else {
    slot = free_factors_.back();
    free_factors_.pop_back();
  }
  FactorRecord& record = graph_.factors[slot];
  record.factor = factor;
  ++record.generation;
  record.variables.clear();
  record.columns = 0;
  record.clique = -1;
  for (const Key key : factor->keys()) {
    const int v = slots_.at(key);
    record.variables.push_back(v);
    record.columns += graph_.states[v].dimension;
    graph_.variables[v].factors.push_back(slot);
  }
  SetError(slot, EvaluateError(slot));
  ++num_factors_;
  return slot;
}

void IncrementalSolver::Impl::DropFactor(int slot) {
  FactorRecord& record = graph_.factors[slot];
  const int alone_on = record.variables.size() == 1 ? record.variables.front() : -1;
  for (const int v : record.variables) {
    std::vector<int>& list = graph_.variables[v].factors;
    list.erase(std::find(list.begin(), list.end(), slot));
  }
  record.factor.reset();
  record.variables.clear();
  record.hessian = std::vector<double>();
  if (alone_on >= 0) SumUnary(alone_on);
  SetError(slot, 0.0);
  --num_factors_;
}

void IncrementalSolver::Impl::DropVariable(int slot) {
  VariableRecord& v = graph_.variables[slot];
  slots_.erase(v.key);
  v.alive = false;
  graph_.states[slot].clique = -1;
}

double IncrementalSolver::Impl::EvaluateError(int slot) {
  const FactorRecord& record = graph_.factors[slot];
  values_.clear();
  for (const int v : record.variables) values_.push_back(&graph_.variables[v].estimate);
  const double error = record.factor->Error(values_.data());
  return std::isfinite(error) ? error : std::numeric_limits<double>::infinity();
}

// The factors lie scattered in memory, so the next ones are fetched while one is evaluated.
void IncrementalSolver::Impl::EvaluateErrors(const std::vector<int>& slots) {
  constexpr std::size_t kAhead = 4;
  constexpr std::size_t kFactorBytes = 9 * 64;  // What a factor between two poses holds.
  for (std::size_t i = 0; i < slots.size(); ++i) {
    if (i + 3 * kAhead < slots.size()) {
      PrefetchLines(&graph_.factors[slots[i + 3 * kAhead]], sizeof(FactorRecord));
    }
    if (i + 2 * kAhead < slots.size()) {
      PrefetchLines(graph_.factors[slots[i + 2 * kAhead]].variables.data(), 1);
    }
    if (i + kAhead < slots.size()) {
      const FactorRecord& next = graph_.factors[slots[i + kAhead]];
      PrefetchLines(next.factor.get(), kFactorBytes);
      for (const int v : next.variables) PrefetchLines(&graph_.variables[v].estimate, sizeof(Value));
    }
    SetError(slots[i], EvaluateError(slots[i]));
  }
}

// Fetches what back-substitution reads of the cliques after the one at `at`.
void IncrementalSolver::Impl::Prefetch(const std::vector<int>& queue, std::size_t at) const {
  constexpr std::size_t kAhead = 2;
  constexpr std::size_t kMaxDoubles = 512;  // Beyond this the hardware has seen the stream.
  if (at + 3 * kAhead < queue.size()) {
    PrefetchLines(&tree_.clique(queue[at + 3 * kAhead]), sizeof(Clique));
  }
  if (at + 2 * kAhead < queue.size()) {
    const std::vector<int>& variables = tree_.clique(queue[at + 2 * kAhead]).variables;
    PrefetchLines(variables.data(), variables.size() * sizeof(int));
  }
  if (at + kAhead < queue.size()) {
    const Clique& clique = tree_.clique(queue[at + kAhead]);
    PrefetchLines(clique.conditional.data(), std::min(clique.conditional.size(), kMaxDoubles) * sizeof(double));
    for (int i = 0; i < clique.num_frontal; ++i) {
      PrefetchLines(&graph_.states[clique.variables[i]], sizeof(VariableState));
      PrefetchLines(&graph_.variables[clique.variables[i]], sizeof(VariableRecord));
    }
  }
}

void IncrementalSolver::Impl::SetError(int slot, double error) {
  errors_[slot] = error;
  const std::size_t block = static_cast<std::size_t>(slot) / kErrorBlock;
  if (!error_block_stale_[block]) {
    error_block_stale_[block] = 1;
    stale_error_blocks_.push_back(static_cast<int>(block));
  }
}

// The sum of the errors. To be called before a public call returns: Error() only adds the blocks.
double IncrementalSolver::Impl::TotalError() {
  for (const int block : stale_error_blocks_) {
    const std::size_t begin = static_cast<std::size_t>(block) * kErrorBlock;
    const std::size_t end = std::min(begin + kErrorBlock, errors_.size());
    double sum = 0.0;
    for (std::size_t i = begin; i < end; ++i) sum += errors_[i];
    error_sums_[block] = sum;
    error_block_stale_[block] = 0;
  }
  stale_error_blocks_.clear();
  return Error();
}

namespace {

// Packed lower triangle of `M^T M` for M of Rows rows (or `rows`, if Rows is 0) and `size` columns.
template <int Rows>
void PackedGram(const double* M, int rows, int size, double* out) {
  const int n = Rows > 0 ? Rows : rows;
  for (int c = 0; c < size; ++c) {
    const double* a = M + static_cast<std::size_t>(c) * n;
    const double* b = a;
    for (int k = c; k < size; ++k, b += n) {
      double sum = 0.0;
      for (int i = 0; i < n; ++i) sum += a[i] * b[i];
      *out++ = sum;
    }
  }
}

}  // namespace

// Adds a factor on one variable to the variable's sum.
void IncrementalSolver::Impl::AddUnary(int slot) {
  const FactorRecord& record = graph_.factors[slot];
  std::vector<double>& sum = graph_.variables[record.variables.front()].unary;
  sum.resize(record.hessian.size(), 0.0);
  for (std::size_t i = 0; i < sum.size(); ++i) sum[i] += record.hessian[i];
}

void IncrementalSolver::Impl::SumUnary(int variable) {
  graph_.variables[variable].unary.clear();
  for (const int f : graph_.variables[variable].factors) {
    const FactorRecord& record = graph_.factors[f];
    if (record.variables.size() == 1 && !record.hessian.empty()) AddUnary(f);
  }
}

void IncrementalSolver::Impl::LinearizeFactor(int slot) {
  FactorRecord& record = graph_.factors[slot];
  const bool first_time = record.hessian.empty();
  values_.clear();
  for (const int v : record.variables) values_.push_back(&graph_.variables[v].theta);
  const int rows = record.factor->dimension();
  const int columns = record.columns;
  jacobian_.resize(std::max(jacobian_.size(), static_cast<std::size_t>(rows) * (columns + 1)));
  double* A = jacobian_.data();
  double* r = A + static_cast<std::size_t>(rows) * columns;  // The residual is the last column.
  record.factor->Linearize(values_.data(), A, r);
  for (int i = 0; i < rows; ++i) r[i] = -r[i];
  const int size = columns + 1;
  record.hessian.resize(static_cast<std::size_t>(size) * (size + 1) / 2);
  double* out = record.hessian.data();
  switch (rows) {
    case 1:
      PackedGram<1>(A, rows, size, out);
      break;
    case 2:
      PackedGram<2>(A, rows, size, out);
      break;
    case 3:
      PackedGram<3>(A, rows, size, out);
      break;
    case 5:
      PackedGram<5>(A, rows, size, out);
      break;
    case 6:
      PackedGram<6>(A, rows, size, out);
      break;
    default:
      PackedGram<0>(A, rows, size, out);
  }
  // Later ones are part of a new sum over all, in Relinearize.
  if (first_time && record.variables.size() == 1) AddUnary(slot);
}

bool IncrementalSolver::Impl::NeedsRelinearization(int slot) const {
  const VariableState& v = graph_.states[slot];
  const auto norm = [&v](int start, int count) {
    double sum = 0.0;
    for (int i = start; i < start + count; ++i) sum += v.delta[i] * v.delta[i];
    return std::sqrt(sum);
  };
  switch (graph_.variables[slot].theta.index()) {
    case 0:
      return norm(0, 3) > config_.relinearize_rotation_rad ||
             norm(3, 3) > config_.relinearize_translation_m;
    case 1:
      return norm(0, 2) > config_.relinearize_axis_rad ||
             norm(2, 2) > config_.relinearize_offset_m;
    default:
      return norm(0, v.dimension) > config_.relinearize_offset_m;
  }
}

// Moves the linearisation points to the estimate and marks what has to be computed again.
void IncrementalSolver::Impl::Relinearize(const std::vector<int>& variables) {
  ++stamp_;
  for (const int slot : variables) {
    VariableRecord& v = graph_.variables[slot];
    v.theta = v.estimate;
    VariableState& state = graph_.states[slot];
    state.last_unit = LastUnit(v.theta);
    std::fill(std::begin(state.delta), std::end(state.delta), 0.0);
    std::fill(std::begin(state.published), std::end(state.published), 0.0);
  }
  for (const int slot : variables) {
    for (const int f : graph_.variables[slot].factors) {
      if (factor_stamp_[f] == stamp_) continue;
      factor_stamp_[f] = stamp_;
      LinearizeFactor(f);
    }
  }
  for (const int slot : variables) SumUnary(slot);
}

void IncrementalSolver::Impl::ComputeWeights() {
  weights_.assign(graph_.variables.size() * kMaxTangentDimension, 0.0);
  for (const FactorRecord& record : graph_.factors) {
    if (!record.factor) continue;
    int column = 0;
    const int size = record.columns + 1;
    for (const int v : record.variables) {
      for (int k = 0; k < graph_.states[v].dimension; ++k, ++column) {
        weights_[static_cast<std::size_t>(v) * kMaxTangentDimension + k] +=
            record.hessian[internal::PackedIndex(column, column, size)];
      }
    }
  }
}

// -------------------------------------------------------------------------------------------------
// Steps
// -------------------------------------------------------------------------------------------------

void IncrementalSolver::Impl::Step::Clear() {
  moves.clear();
  factors.clear();
  errors.clear();
  cliques.clear();
}

// Back-substitution from the roots through every clique that was factorised or whose separator has
// moved by more than the threshold (Kaess et al. 2012, "wildfire"); then the estimates and the errors of what has moved.
void IncrementalSolver::Impl::Solve(double publish_threshold, double still_threshold, Step* step) {
  step->Clear();
  ++stamp_;
  std::vector<VariableRecord>& variables = graph_.variables;
  // Breadth first, so that what comes next is known and can be fetched.
  std::vector<int>& queue = queue_;
  queue = tree_.roots();
  for (std::size_t next = 0; next < queue.size(); ++next) {
    const int c = queue[next];
    Clique& clique = tree_.clique(c);
    bool needed = clique.unsolved;
    for (std::size_t i = clique.num_frontal; !needed && i < clique.variables.size(); ++i) {
      needed = variable_stamp_[clique.variables[i]] == stamp_;
    }
    if (!needed) {
      Prefetch(queue, next);
      continue;
    }
    queue.insert(queue.end(), clique.children.begin(), clique.children.end());
    Prefetch(queue, next);
    x_.resize(std::max(x_.size(),
                       static_cast<std::size_t>(clique.frontal_dimension + clique.separator_dimension)));
    tree_.SolveClique(clique, x_.data());
    const double* x = x_.data();
    for (int i = 0; i < clique.num_frontal; ++i) {
      const int slot = clique.variables[i];
      VariableState& v = graph_.states[slot];
      bool moved = false;
      bool publish = false;
      for (int k = 0; k < v.dimension; ++k) {
        const double unit = k + 1 == v.dimension ? v.last_unit : 1.0;
        moved = moved || std::abs(x[k] - v.delta[k]) > still_threshold * unit;
        publish = publish || std::abs(x[k] - v.published[k]) > publish_threshold * unit;
      }
      if (moved) {
        step->moves.emplace_back();
        Move& move = step->moves.back();
        move.variable = slot;
        std::copy_n(v.delta, kMaxTangentDimension, move.before);
        std::copy_n(v.published, kMaxTangentDimension, move.published_before);
        std::copy_n(x, v.dimension, v.delta);
        std::copy_n(v.delta, kMaxTangentDimension, move.after);
        VariableRecord& record = variables[slot];
        Retract(record.theta, v.delta, &record.estimate);
        if (!has_moved_[slot]) {
          has_moved_[slot] = 1;
          moved_.push_back(slot);
        }
        if (publish) {
          std::copy_n(x, v.dimension, v.published);
          variable_stamp_[slot] = stamp_;
        }
      }
      x += v.dimension;
    }
    clique.unsolved = false;
    step->cliques.push_back(c);
  }
  for (const Move& move : step->moves) {
    for (const int f : variables[move.variable].factors) {
      if (factor_stamp_[f] == stamp_) continue;
      factor_stamp_[f] = stamp_;
      step->factors.push_back(f);
      step->errors.push_back(errors_[f]);
    }
  }
  EvaluateErrors(step->factors);
}

void IncrementalSolver::Impl::Undo(const Step& step) {
  for (const Move& move : step.moves) {
    VariableState& v = graph_.states[move.variable];
    std::copy_n(move.before, kMaxTangentDimension, v.delta);
    std::copy_n(move.published_before, kMaxTangentDimension, v.published);
    MoveEstimate(move.variable);
  }
  for (std::size_t i = 0; i < step.factors.size(); ++i) SetError(step.factors[i], step.errors[i]);
  for (const int c : step.cliques) tree_.clique(c).unsolved = true;
}

// Takes only a part of an undone step. Its cliques stay unsolved: the next step starts from here.
void IncrementalSolver::Impl::Shorten(const Step& step, double fraction) {
  for (const Move& move : step.moves) {
    VariableState& v = graph_.states[move.variable];
    for (int k = 0; k < v.dimension; ++k) {
      v.delta[k] = move.before[k] + fraction * (move.after[k] - move.before[k]);
    }
    MoveEstimate(move.variable);
  }
  EvaluateErrors(step.factors);
}

// The estimate to its tangent coordinates; exactly to the linearisation point for none.
void IncrementalSolver::Impl::MoveEstimate(int slot) {
  VariableRecord& record = graph_.variables[slot];
  const double* delta = graph_.states[slot].delta;
  if (std::all_of(delta, delta + kMaxTangentDimension, [](double d) { return d == 0.0; })) {
    record.estimate = record.theta;
  } else {
    Retract(record.theta, delta, &record.estimate);
  }
}

// A new tree over the whole graph at the present linearisation points, without damping.
void IncrementalSolver::Impl::RebuildTree() {
  tree_.Clear();
  std::vector<int> variables;
  std::vector<int> factors;
  for (std::size_t v = 0; v < graph_.variables.size(); ++v) {
    groups_[v] = 0;
    if (graph_.variables[v].alive) variables.push_back(static_cast<int>(v));
  }
  for (std::size_t f = 0; f < graph_.factors.size(); ++f) {
    const FactorRecord& record = graph_.factors[f];
    if (record.factor && record.variables.size() > 1) factors.push_back(static_cast<int>(f));
  }
  tree_.Restructure(variables, factors, groups_, epoch_);
}

// Takes factors and variables out again that a failed call had added.
void IncrementalSolver::Impl::TakeBack(const std::vector<int>& factors,
                                       const std::vector<int>& variables) {
  for (const int f : factors) {
    DropFactor(f);
    free_factors_.push_back(f);
  }
  for (const int v : variables) {
    DropVariable(v);
    free_variables_.push_back(v);
  }
}

// The tree of the graph as it was before a failed call; that graph was solvable.
void IncrementalSolver::Impl::RestoreTree() {
  lambda_ = 0.0;
  damped_variables_.clear();
  RebuildTree();
  const int failed = tree_.Factorize({});
  if (failed >= 0) ThrowUnderconstrained(failed);
}

void IncrementalSolver::Impl::ThrowUnderconstrained(int slot) const {
  const Key key = graph_.variables[slot].key;
  for (const int f : graph_.variables[slot].factors) {
    const FactorRecord& record = graph_.factors[f];
    if (std::all_of(record.hessian.begin(), record.hessian.end(), [](double x) { return std::isfinite(x); })) {
      continue;
    }
    throw NonFiniteError(key, record.factor->Describe() + ": its derivative at " + KeyName(key) +
                                  " is not finite; check the measurement and the initial values");
  }
  // The part of the graph that hangs together with the variable.
  std::vector<char> seen(graph_.variables.size(), 0);
  std::vector<int> part = {slot};
  seen[slot] = 1;
  bool anchored = false;
  for (std::size_t i = 0; i < part.size(); ++i) {
    for (const int f : graph_.variables[part[i]].factors) {
      const FactorRecord& record = graph_.factors[f];
      const auto* linear = dynamic_cast<const LinearFactor*>(record.factor.get());
      anchored = anchored || linear != nullptr ||
                 (record.variables.size() == 1 && record.factor->dimension() >= 3);
      for (const int v : record.variables) {
        if (seen[v]) continue;
        seen[v] = 1;
        part.push_back(v);
      }
    }
  }
  const std::string name = "variable " + KeyName(key);
  if (!anchored) {
    throw UnderconstrainedError(
        key, name + " is under-constrained: nothing fixes the part of the graph that holds it (" +
                 std::to_string(part.size()) + " variables) in space; add a prior on one of its "
                 "poses, or a factor that joins it to the rest");
  }
  std::string factors;
  for (const int f : graph_.variables[slot].factors) {
    if (factors.size() > 120) {
      factors += ", ...";
      break;
    }
    factors += (factors.empty() ? "" : ", ") + graph_.factors[f].factor->Describe();
  }
  throw UnderconstrainedError(key, name + " is under-constrained: its factors (" + factors +
                                       ") leave a direction of it free; add a prior on " +
                                       KeyName(key) + " or a factor that sees that direction");
}

UpdateResult IncrementalSolver::Impl::Update(const FactorList& new_factors,
                                             const Values& new_values,
                                             const UpdateOptions& options) {
  const auto start = std::chrono::steady_clock::now();
  UpdateResult result;
  CheckInput(new_factors, new_values, options);
  ++epoch_;

  // The graph. Removed factors are kept aside for the case that the new graph cannot be solved.
  std::vector<int> new_variable_slots;
  std::vector<int> new_factor_slots;
  std::vector<int> structural;  // Variables whose cliques are dissolved.
  std::vector<FactorPtr> removed_factors;
  std::vector<FactorRecord> removed_records;
  std::vector<int> removed_slots;
  for (const FactorId id : options.remove_factors) {
    const int slot = FactorSlot(id);
    FactorRecord& record = graph_.factors[slot];
    structural.insert(structural.end(), record.variables.begin(), record.variables.end());
    removed_records.push_back(record);
    removed_slots.push_back(slot);
    DropFactor(slot);
  }
  for (const auto& [key, value] : new_values) new_variable_slots.push_back(AddVariable(key, value));
  for (const FactorPtr& factor : new_factors) {
    const int slot = AddFactor(factor);
    new_factor_slots.push_back(slot);
    for (const int v : graph_.factors[slot].variables) {
      if (graph_.states[v].clique >= 0) structural.push_back(v);
    }
  }
  // A variable that lost its last factor goes with it.
  std::vector<int> dropped_variables;
  for (const int v : structural) {
    if (graph_.variables[v].alive && graph_.variables[v].factors.empty()) {
      tree_.MarkStructural(v);
      dropped_variables.push_back(v);
      DropVariable(v);
    }
  }
  result.error_before = TotalError();

  try {
    // What moves its linearisation point.
    std::vector<int> relinearized;
    if (epoch_ % config_.relinearize_skip == 0) {
      std::sort(moved_.begin(), moved_.end());
      for (const int v : moved_) {
        has_moved_[v] = 0;
        if (graph_.variables[v].alive && NeedsRelinearization(v)) {
          relinearized.push_back(v);
        }
      }
      moved_.clear();
      Relinearize(relinearized);
      result.variables_relinearized = static_cast<int>(relinearized.size());
    }
    std::vector<int> joining;  // New factors that join variables, and so shape the tree.
    for (const int f : new_factor_slots) {
      LinearizeFactor(f);
      if (graph_.factors[f].variables.size() > 1) joining.push_back(f);
    }

    // What is eliminated again: in a new order around the new factors, in the old one elsewhere.
    for (const int v : structural) {
      if (graph_.variables[v].alive) tree_.MarkStructural(v);
    }
    if (epoch_ - last_reorder_ >= config_.reorder_interval) {
      for (int c = 0; c < tree_.num_slots(); ++c) {
        if (tree_.clique(c).alive && tree_.clique(c).created > last_reorder_) {
          tree_.MarkStructuralClique(c);
        }
      }
      last_reorder_ = epoch_;
    }
    for (const int slot : relinearized) {
      tree_.MarkDirty(graph_.states[slot].clique);
      for (const int f : graph_.variables[slot].factors) tree_.MarkDirty(graph_.factors[f].clique);
    }
    for (const int v : damped_variables_) {
      if (graph_.variables[v].alive && graph_.states[v].clique >= 0) {
        tree_.MarkDirty(graph_.states[v].clique);
      }
    }
    damped_variables_.clear();
    std::fill(groups_.begin(), groups_.end(), 0);
    for (const int f : new_factor_slots) {
      for (const int v : graph_.factors[f].variables) groups_[v] = 1;
    }
    for (const Key key : options.constrained_last) groups_[SlotOf(key)] = 1;
    tree_.Restructure(new_variable_slots, joining, groups_, epoch_);

    // Steps, with damping once one was refused.
    std::vector<int> touched;
    bool damped = lambda_ > 0.0;
    double factorized_with = lambda_;
    Step& step = step_;
    for (result.iterations = 1;; ++result.iterations) {
      if (lambda_ > 0.0) ComputeWeights();
      factorized_with = lambda_;
      const int failed = tree_.Factorize({lambda_, &weights_});
      if (failed >= 0) ThrowUnderconstrained(failed);
      if (result.iterations == 1) {
        touched = tree_.factorized();
        result.variables_reeliminated = tree_.CountFrontal(touched);
      }
      Solve(config_.wildfire_threshold, config_.still_threshold, &step);
      double error = TotalError();
      if (!Lowers(error, result.error_before) && config_.still_threshold > 0.0) {
        // What was left out may be what the step lacks.
        Undo(step);
        Solve(kFinePart * config_.wildfire_threshold, kFinePart * config_.still_threshold, &step);
        error = TotalError();
      }
      if (Lowers(error, result.error_before)) {
        result.damping = lambda_;
        lambda_ *= config_.lambda_down;
        if (lambda_ < config_.lambda_min) lambda_ = 0.0;
        break;
      }
      Undo(step);
      ++result.steps_refused;
      // A small rise: the linearisation is stale, the direction is good. A part of the step.
      if (error <= kSmallRise * result.error_before) {
        double fraction = 0.5;
        bool accepted = false;
        for (; fraction > 0.1 && !accepted; fraction *= 0.5) {
          Shorten(step, fraction);
          accepted = TotalError() <= result.error_before;
          if (!accepted) Undo(step);
        }
        if (accepted || error <= (1.0 + kNegligibleRise) * result.error_before) break;
      }
      if (result.iterations >= config_.max_iterations || lambda_ >= config_.lambda_max) break;
      // Once more from the present estimate, linearised there, with more damping.
      if (result.steps_refused == 1) {
        std::vector<int> stale;
        for (const Move& move : step.moves) {
          const VariableState& state = graph_.states[move.variable];
          for (int k = 0; k < state.dimension; ++k) {
            if (state.delta[k] != 0.0) {
              stale.push_back(move.variable);
              break;
            }
          }
        }
        Relinearize(stale);
        result.variables_relinearized += static_cast<int>(stale.size());
        for (const int slot : stale) {
          tree_.MarkDirty(graph_.states[slot].clique);
          for (const int f : graph_.variables[slot].factors) {
            tree_.MarkDirty(graph_.factors[f].clique);
          }
        }
      }
      lambda_ = std::max(config_.lambda_initial, lambda_ * config_.lambda_up);
      damped = true;
      for (const int c : touched) tree_.MarkDirty(c);
    }
    if (damped) {
      damping_ = {factorized_with, &weights_};
      for (const int c : tree_.factorized()) {
        for (int i = 0; i < tree_.clique(c).num_frontal; ++i) {
          damped_variables_.push_back(tree_.clique(c).variables[i]);
        }
      }
    }
  } catch (...) {
    TakeBack(new_factor_slots, new_variable_slots);
    for (const int v : dropped_variables) {
      graph_.variables[v].alive = true;
      slots_[graph_.variables[v].key] = v;
    }
    for (std::size_t i = 0; i < removed_slots.size(); ++i) {
      const int slot = removed_slots[i];
      graph_.factors[slot] = removed_records[i];
      for (const int v : removed_records[i].variables) graph_.variables[v].factors.push_back(slot);
      SetError(slot, EvaluateError(slot));
      LinearizeFactor(slot);
      if (removed_records[i].variables.size() == 1) SumUnary(removed_records[i].variables.front());
      ++num_factors_;
    }
    TotalError();
    RestoreTree();
    throw;
  }

  free_factors_.insert(free_factors_.end(), removed_slots.begin(), removed_slots.end());
  free_variables_.insert(free_variables_.end(), dropped_variables.begin(), dropped_variables.end());
  for (const int f : new_factor_slots) {
    result.new_factor_ids.push_back(MakeFactorId(graph_.factors[f].generation, f));
  }
  if (options.converge) {
    result = Iterate(config_.relative_tolerance, config_.batch_max_iterations, std::move(result));
  }
  result.error_after = TotalError();
  result.seconds =
      std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  return result;
}

// Levenberg-Marquardt on the whole graph in the present elimination order.
UpdateResult IncrementalSolver::Impl::Iterate(double tolerance, int max_iterations, UpdateResult result) {
  std::vector<int> all;
  for (std::size_t v = 0; v < graph_.variables.size(); ++v) {
    if (graph_.variables[v].alive) all.push_back(static_cast<int>(v));
  }
  double lambda = 0.0;
  double error = TotalError();
  Step& step = step_;
  result.converged = false;
  Relinearize(all);
  for (int i = 0; i < max_iterations && !result.converged; ++i) {
    ++result.iterations;
    tree_.MarkAllDirty();
    if (lambda > 0.0) ComputeWeights();
    const int failed = tree_.Factorize({lambda, &weights_});
    if (failed >= 0) ThrowUnderconstrained(failed);
    result.variables_relinearized += static_cast<int>(all.size());
    result.variables_reeliminated += static_cast<int>(all.size());
    Solve(0.0, 0.0, &step);
    const double next = TotalError();
    if (Lowers(next, error)) {
      result.converged = error - next <= tolerance * error;
      result.damping = lambda;
      error = next;
      lambda *= config_.lambda_down;
      if (lambda < config_.lambda_min) lambda = 0.0;
      if (!result.converged) Relinearize(all);
    } else {
      Undo(step);
      ++result.steps_refused;
      lambda = std::max(config_.lambda_initial, lambda * config_.lambda_up);
      if (lambda > config_.lambda_max) result.converged = true;
    }
  }
  lambda_ = 0.0;
  damped_variables_.clear();
  if (lambda > 0.0) {
    tree_.MarkAllDirty();
    tree_.Factorize({});
  }
  return result;
}

UpdateResult IncrementalSolver::Impl::OptimizeBatch(const FactorList& new_factors,
                                                    const Values& new_values) {
  const auto start = std::chrono::steady_clock::now();
  CheckInput(new_factors, new_values, {});
  UpdateResult result;
  ++epoch_;
  last_reorder_ = epoch_;
  std::vector<int> variable_slots;
  std::vector<int> factor_slots;
  for (const auto& [key, value] : new_values) variable_slots.push_back(AddVariable(key, value));
  for (const FactorPtr& factor : new_factors) {
    factor_slots.push_back(AddFactor(factor));
    result.new_factor_ids.push_back(
        MakeFactorId(graph_.factors[factor_slots.back()].generation, factor_slots.back()));
  }
  result.error_before = TotalError();
  RebuildTree();
  try {
    result = Iterate(config_.relative_tolerance, config_.batch_max_iterations, std::move(result));
  } catch (...) {
    TakeBack(factor_slots, variable_slots);
    TotalError();
    RestoreTree();
    throw;
  }
  result.error_after = TotalError();
  result.seconds =
      std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  return result;
}

// -------------------------------------------------------------------------------------------------
// Marginals
// -------------------------------------------------------------------------------------------------

// What variables leave on their neighbours: a linear factor, or none without neighbours.
// @param removed_factors  In: factors that are to go without leaving anything; out: also all those of
//                         the variables.
FactorList IncrementalSolver::Impl::Absorb(const std::vector<Key>& keys,
                                           std::vector<FactorId>* removed_factors) {
  // The variables to remove, their factors and their neighbours.
  ++stamp_;
  const int removed_stamp = stamp_;
  std::vector<int> removed;
  for (const Key key : keys) {
    const int v = SlotOf(key);
    if (variable_stamp_[v] == removed_stamp) continue;
    variable_stamp_[v] = removed_stamp;
    removed.push_back(v);
  }
  if (removed.empty()) return {};
  std::vector<int> factors;
  std::vector<int> neighbours;
  ++stamp_;
  for (const FactorId id : *removed_factors) factor_stamp_[FactorSlot(id)] = stamp_;
  for (const int v : removed) {
    for (const int f : graph_.variables[v].factors) {
      if (factor_stamp_[f] == stamp_) continue;
      factor_stamp_[f] = stamp_;
      factors.push_back(f);
      for (const int u : graph_.factors[f].variables) {
        if (variable_stamp_[u] == removed_stamp || variable_stamp_[u] == stamp_) continue;
        variable_stamp_[u] = stamp_;
        neighbours.push_back(u);
      }
    }
  }
  std::sort(neighbours.begin(), neighbours.end(), [this](int a, int b) {
    return graph_.variables[a].key < graph_.variables[b].key;
  });

  // Their Hessian at the estimate, eliminated to the neighbours.
  std::vector<int> offset(graph_.variables.size(), 0);
  int eliminated = 0;
  for (const int v : removed) {
    offset[v] = eliminated;
    eliminated += graph_.states[v].dimension;
  }
  int size = eliminated;
  for (const int v : neighbours) {
    offset[v] = size;
    size += graph_.states[v].dimension;
  }
  Eigen::MatrixXd H = Eigen::MatrixXd::Zero(size, size);
  Eigen::VectorXd g = Eigen::VectorXd::Zero(size);
  for (const int f : factors) {
    const FactorRecord& record = graph_.factors[f];
    std::vector<const Value*> values;
    for (const int v : record.variables) values.push_back(&graph_.variables[v].estimate);
    Eigen::MatrixXd J(record.factor->dimension(), record.columns);
    Eigen::VectorXd r(record.factor->dimension());
    record.factor->Linearize(values.data(), J.data(), r.data());
    int ca = 0;
    for (const int a : record.variables) {
      const int da = graph_.states[a].dimension;
      g.segment(offset[a], da) -= J.middleCols(ca, da).transpose() * r;
      int cb = 0;
      for (const int b : record.variables) {
        const int db = graph_.states[b].dimension;
        H.block(offset[a], offset[b], da, db) +=
            J.middleCols(ca, da).transpose() * J.middleCols(cb, db);
        cb += db;
      }
      ca += da;
    }
  }
  const int kept = size - eliminated;
  FactorList linear;
  if (kept > 0) {
    const Eigen::LDLT<Eigen::MatrixXd> ldlt(H.topLeftCorner(eliminated, eliminated));
    const Eigen::VectorXd diagonal = H.diagonal().head(eliminated);
    if (ldlt.info() != Eigen::Success || !(ldlt.vectorD().minCoeff() > 0.0)) {
      throw UnderconstrainedError(
          graph_.variables[removed.front()].key,
          "variable " + KeyName(graph_.variables[removed.front()].key) +
              " cannot be marginalised: its factors leave a direction of the removed variables free; "
              "add a prior or keep the variable");
    }
    const Eigen::MatrixXd X = ldlt.solve(H.topRightCorner(eliminated, kept));
    Eigen::MatrixXd H_kept = H.bottomRightCorner(kept, kept) - H.bottomLeftCorner(kept, eliminated) * X;
    H_kept = (0.5 * (H_kept + H_kept.transpose())).eval();
    Eigen::VectorXd g_kept = g.tail(kept) - X.transpose() * g.head(eliminated);
    // Where the removed variables took all information with them (a pose that only hung on its
    // neighbour), what is left of it is rounding.
    for (Eigen::Index i = 0; i < kept; ++i) {
      if (H_kept(i, i) > kNoInformation * H(eliminated + i, eliminated + i)) continue;
      H_kept.row(i).setZero();
      H_kept.col(i).setZero();
      g_kept[i] = 0.0;
    }
    std::vector<Key> names;
    std::vector<Value> origins;
    for (const int v : neighbours) {
      names.push_back(graph_.variables[v].key);
      origins.push_back(graph_.variables[v].estimate);
    }
    linear.push_back(std::make_shared<LinearFactor>(names, origins, H_kept, g_kept));
  }
  for (const int f : factors) {
    removed_factors->push_back(MakeFactorId(graph_.factors[f].generation, f));
  }
  return linear;
}

FactorId IncrementalSolver::Impl::Marginalize(const std::vector<Key>& keys) {
  UpdateOptions options;
  const FactorList linear = Absorb(keys, &options.remove_factors);
  if (options.remove_factors.empty()) return 0;
  const UpdateResult result = Update(linear, {}, options);
  return result.new_factor_ids.empty() ? 0 : result.new_factor_ids.front();
}

UpdateResult IncrementalSolver::Impl::UpdateMarginalizing(const FactorList& new_factors,
                                                          const Values& new_values,
                                                          const UpdateOptions& options) {
  if (options.marginalize.empty()) return Update(new_factors, new_values, options);
  for (const FactorPtr& factor : new_factors) {
    if (!factor) continue;  // Update says so.
    for (const Key key : factor->keys()) {
      const auto& gone = options.marginalize;
      if (std::find(gone.begin(), gone.end(), key) == gone.end()) continue;
      throw UnknownVariableError(key, factor->Describe() + ": variable " + KeyName(key) +
                                          " is to be marginalised by the same update; leave one of "
                                          "the two out");
    }
  }
  UpdateOptions rest = options;
  FactorList all = new_factors;
  for (const FactorPtr& linear : Absorb(options.marginalize, &rest.remove_factors)) {
    all.push_back(linear);
  }
  return Update(all, new_values, rest);
}

// A covariance is that of the measurements: damping is none.
void IncrementalSolver::Impl::TakeOutDamping() const {
  if (damped_variables_.empty()) return;
  const auto mark = [this] {
    for (const int v : damped_variables_) {
      if (graph_.variables[v].alive && graph_.states[v].clique >= 0) {
        tree_.MarkDirty(graph_.states[v].clique);
      }
    }
  };
  mark();
  const int failed = tree_.Factorize({});
  if (failed >= 0) {
    // Only the damping made it solvable: there is no covariance.
    mark();
    tree_.Factorize(damping_);
    ThrowUnderconstrained(failed);
  }
  damped_variables_.clear();
}

// From the tangent space at the linearisation point to the one at the estimate.
Eigen::MatrixXd IncrementalSolver::Impl::TangentAtEstimate(int slot) const {
  const VariableRecord& v = graph_.variables[slot];
  const int d = graph_.states[slot].dimension;
  double buffer[kMaxTangentDimension * kMaxTangentDimension];
  LocalCoordinatesJacobian(v.theta, v.estimate, buffer);
  return Eigen::Map<const Eigen::MatrixXd>(buffer, d, d).inverse();
}

Eigen::MatrixXd IncrementalSolver::Impl::JointMarginalCovariance(const std::vector<Key>& keys) const {
  std::vector<int> selected;
  for (const Key key : keys) selected.push_back(SlotOf(key));
  TakeOutDamping();
  Eigen::MatrixXd Y = tree_.ForwardSolve(selected);
  int column = 0;
  for (const int slot : selected) {
    const int d = graph_.states[slot].dimension;
    Y.middleCols(column, d) *= TangentAtEstimate(slot).transpose();
    column += d;
  }
  const Eigen::MatrixXd covariance = Y.transpose() * Y;
  return 0.5 * (covariance + covariance.transpose());
}

std::vector<Eigen::MatrixXd> IncrementalSolver::Impl::PairMarginalCovariances(
    Key first, const std::vector<Key>& others) const {
  std::vector<int> selected{SlotOf(first)};
  for (const Key key : others) selected.push_back(SlotOf(key));
  TakeOutDamping();
  Eigen::MatrixXd Y = tree_.ForwardSolve(selected);
  const int d_first = graph_.states[selected.front()].dimension;
  Y.leftCols(d_first) *= TangentAtEstimate(selected.front()).transpose();
  const Eigen::MatrixXd own = Y.leftCols(d_first).transpose() * Y.leftCols(d_first);
  std::vector<Eigen::MatrixXd> out;
  int column = d_first;
  for (std::size_t i = 1; i < selected.size(); ++i) {
    const int d = graph_.states[selected[i]].dimension;
    const Eigen::MatrixXd other = Y.middleCols(column, d) * TangentAtEstimate(selected[i]).transpose();
    Eigen::MatrixXd joint(d_first + d, d_first + d);
    joint.topLeftCorner(d_first, d_first) = own;
    joint.topRightCorner(d_first, d).noalias() = Y.leftCols(d_first).transpose() * other;
    joint.bottomLeftCorner(d, d_first) = joint.topRightCorner(d_first, d).transpose();
    joint.bottomRightCorner(d, d).noalias() = other.transpose() * other;
    out.push_back(0.5 * (joint + joint.transpose()));
    column += d;
  }
  return out;
}

Values IncrementalSolver::Impl::Estimates() const {
  Values out;
  for (const VariableRecord& v : graph_.variables) {
    if (v.alive) out.Insert(v.key, v.estimate);
  }
  return out;
}

std::vector<FactorId> IncrementalSolver::Impl::FactorsOf(Key key) const {
  std::vector<FactorId> out;
  for (const int f : graph_.variables[SlotOf(key)].factors) {
    out.push_back(MakeFactorId(graph_.factors[f].generation, f));
  }
  std::sort(out.begin(), out.end());
  return out;
}

// -------------------------------------------------------------------------------------------------
// The public face
// -------------------------------------------------------------------------------------------------

IncrementalSolver::IncrementalSolver(const SolverConfig& config)
    : impl_(std::make_unique<Impl>(config)) {}
IncrementalSolver::~IncrementalSolver() = default;
IncrementalSolver::IncrementalSolver(IncrementalSolver&&) noexcept = default;
IncrementalSolver& IncrementalSolver::operator=(IncrementalSolver&&) noexcept = default;

UpdateResult IncrementalSolver::Update(const FactorList& new_factors,
                                       const Values& new_values,
                                       const UpdateOptions& options) {
  return impl_->UpdateMarginalizing(new_factors, new_values, options);
}

UpdateResult IncrementalSolver::RemoveFactors(const std::vector<FactorId>& factors) {
  UpdateOptions options;
  options.remove_factors = factors;
  return impl_->Update({}, {}, options);
}

UpdateResult IncrementalSolver::Optimize() { return impl_->OptimizeBatch({}, {}); }

UpdateResult IncrementalSolver::OptimizeBatch(const FactorList& new_factors,
                                              const Values& new_values) {
  return impl_->OptimizeBatch(new_factors, new_values);
}

FactorId IncrementalSolver::Marginalize(const std::vector<Key>& keys) {
  return impl_->Marginalize(keys);
}

const Value& IncrementalSolver::EstimateValue(Key key) const { return impl_->EstimateValue(key); }
Values IncrementalSolver::Estimates() const { return impl_->Estimates(); }
bool IncrementalSolver::Contains(Key key) const { return impl_->Contains(key); }

Eigen::MatrixXd IncrementalSolver::MarginalCovariance(Key key) const {
  return impl_->JointMarginalCovariance({key});
}
Eigen::MatrixXd IncrementalSolver::JointMarginalCovariance(const std::vector<Key>& keys) const {
  return impl_->JointMarginalCovariance(keys);
}

std::vector<Eigen::MatrixXd> IncrementalSolver::PairMarginalCovariances(
    Key first, const std::vector<Key>& others) const {
  return impl_->PairMarginalCovariances(first, others);
}

double IncrementalSolver::Error() const { return impl_->Error(); }
double IncrementalSolver::FactorError(FactorId factor) const { return impl_->FactorError(factor); }
const FactorPtr& IncrementalSolver::GetFactor(FactorId factor) const {
  return impl_->GetFactor(factor);
}
bool IncrementalSolver::ContainsFactor(FactorId factor) const {
  return impl_->ContainsFactor(factor);
}
std::vector<FactorId> IncrementalSolver::FactorsOf(Key key) const { return impl_->FactorsOf(key); }
int IncrementalSolver::NumFactorsOf(Key key) const { return impl_->NumFactorsOf(key); }
int IncrementalSolver::num_variables() const { return impl_->num_variables(); }
int IncrementalSolver::num_factors() const { return impl_->num_factors(); }
const SolverConfig& IncrementalSolver::config() const { return impl_->config(); }

void IncrementalSolver::ThrowWrongType(Key key) {
  throw UnknownVariableError(key, "variable " + KeyName(key) +
                                      " is of another type; ask for it with the type it was added with");
}

}  // namespace dendro
