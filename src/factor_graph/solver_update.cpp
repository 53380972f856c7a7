// Steps of the solver: incremental updates and batch optimisation.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <string>
#include <utility>

#include "dendro_slam/factor_graph/linear_factor.h"
#include "solver_impl.h"

namespace dendro {

using internal::Clique;
using internal::FactorRecord;
using internal::MakeFactorId;
using internal::VariableRecord;
using internal::VariableState;

namespace {

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

bool Lowers(double after, double before) {
  return after <= before * (1.0 + kRelativeRounding) + kAbsoluteRounding;
}

}  // namespace

void IncrementalSolver::Impl::Step::Clear() {
  moves.clear();
  factors.clear();
  errors.clear();
  cliques.clear();
}

// Back-substitution from the roots through every clique that was factorised or whose separator has
// moved by more than the threshold (Kaess et al. 2012, "wildfire"); then the estimates and the
// errors of what has moved.
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
    x_.resize(
        std::max(x_.size(),
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
    if (std::all_of(record.hessian.begin(), record.hessian.end(), [](double x) {
          return std::isfinite(x);
        })) {
      continue;
    }
    throw NonFiniteError(key,
                         record.factor->Describe() + ": its derivative at " + KeyName(key) +
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
        key,
        name + " is under-constrained: nothing fixes the part of the graph that holds it (" +
            std::to_string(part.size()) +
            " variables) in space; add a prior on one of its "
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
  throw UnderconstrainedError(key,
                              name + " is under-constrained: its factors (" + factors +
                                  ") leave a direction of it free; add a prior on " + KeyName(key) +
                                  " or a factor that sees that direction");
}

// What the update does to the variables and factors; nothing is linearised or eliminated yet.
// Removed factors are kept aside for the case that the new graph cannot be solved.
IncrementalSolver::Impl::Change IncrementalSolver::Impl::ApplyChange(const FactorList& new_factors,
                                                                     const Values& new_values,
                                                                     const UpdateOptions& options) {
  Change change;
  for (const FactorId id : options.remove_factors) {
    const int slot = FactorSlot(id);
    const FactorRecord& record = graph_.factors[slot];
    change.touched.insert(change.touched.end(), record.variables.begin(), record.variables.end());
    change.removed_records.push_back(record);
    change.removed_slots.push_back(slot);
    DropFactor(slot);
  }
  for (const auto& [key, value] : new_values)
    change.new_variables.push_back(AddVariable(key, value));
  for (const FactorPtr& factor : new_factors) {
    const int slot = AddFactor(factor);
    change.new_factors.push_back(slot);
    for (const int v : graph_.factors[slot].variables) {
      if (graph_.states[v].clique >= 0) change.touched.push_back(v);
    }
  }
  // A variable that lost its last factor goes with it.
  for (const int v : change.touched) {
    if (graph_.variables[v].alive && graph_.variables[v].factors.empty()) {
      tree_.MarkStructural(v);
      change.dropped_variables.push_back(v);
      DropVariable(v);
    }
  }
  return change;
}

// The graph and the tree as they were before a change that cannot be solved.
void IncrementalSolver::Impl::Revert(const Change& change) {
  TakeBack(change.new_factors, change.new_variables);
  for (const int v : change.dropped_variables) {
    graph_.variables[v].alive = true;
    slots_[graph_.variables[v].key] = v;
  }
  for (std::size_t i = 0; i < change.removed_slots.size(); ++i) {
    const int slot = change.removed_slots[i];
    const FactorRecord& record = change.removed_records[i];
    graph_.factors[slot] = record;
    for (const int v : record.variables) graph_.variables[v].factors.push_back(slot);
    SetError(slot, EvaluateError(slot));
    LinearizeFactor(slot);
    if (record.variables.size() == 1) SumUnary(record.variables.front());
    ++num_factors_;
  }
  TotalError();
  RestoreTree();
}

// The variables that have moved so far that they are to be linearised anew, ascending; the others
// are looked at again when they have moved again.
std::vector<int> IncrementalSolver::Impl::TakeMovedFar() {
  std::vector<int> far;
  std::sort(moved_.begin(), moved_.end());
  for (const int v : moved_) {
    has_moved_[v] = 0;
    if (graph_.variables[v].alive && NeedsRelinearization(v)) far.push_back(v);
  }
  moved_.clear();
  return far;
}

// Marks the cliques that hold what depends on a linearisation point.
void IncrementalSolver::Impl::MarkRelinearized(const std::vector<int>& variables) {
  for (const int slot : variables) {
    tree_.MarkDirty(graph_.states[slot].clique);
    for (const int f : graph_.variables[slot].factors) tree_.MarkDirty(graph_.factors[f].clique);
  }
}

// Linearises what is new or has moved far, and finds the new variables a place in the tree: in a
// new order around the new factors, in the old one elsewhere.
void IncrementalSolver::Impl::Eliminate(const Change& change,
                                        const UpdateOptions& options,
                                        UpdateResult* result) {
  std::vector<int> relinearized;
  if (epoch_ % config_.relinearize_skip == 0) relinearized = TakeMovedFar();
  Relinearize(relinearized);
  result->variables_relinearized = static_cast<int>(relinearized.size());
  std::vector<int> joining;  // New factors that join variables, and so shape the tree.
  for (const int f : change.new_factors) {
    LinearizeFactor(f);
    if (graph_.factors[f].variables.size() > 1) joining.push_back(f);
  }

  for (const int v : change.touched) {
    if (graph_.variables[v].alive) tree_.MarkStructural(v);
  }
  if (epoch_ - last_reorder_ >= config_.reorder_interval) {
    for (int c = 0; c < tree_.num_slots(); ++c) {
      if (tree_.clique(c).alive && tree_.clique(c).created > last_reorder_)
        tree_.MarkStructuralClique(c);
    }
    last_reorder_ = epoch_;
  }
  MarkRelinearized(relinearized);
  for (const int v : damped_variables_) {
    if (graph_.variables[v].alive && graph_.states[v].clique >= 0) {
      tree_.MarkDirty(graph_.states[v].clique);
    }
  }
  damped_variables_.clear();
  std::fill(groups_.begin(), groups_.end(), 0);
  for (const int f : change.new_factors) {
    for (const int v : graph_.factors[f].variables) groups_[v] = 1;
  }
  for (const Key key : options.constrained_last) groups_[SlotOf(key)] = 1;
  tree_.Restructure(change.new_variables, joining, groups_, epoch_);
}

// Takes a half, a quarter or an eighth of the step that was just undone, the first that does not
// raise the error.
bool IncrementalSolver::Impl::ShortenUntilLower(double error_before) {
  for (const double fraction : {0.5, 0.25, 0.125}) {
    Shorten(step_, fraction);
    if (TotalError() <= error_before) return true;
    Undo(step_);
  }
  return false;
}

// Levenberg-Marquardt on the marked part of the tree: a step, and others with damping as long as
// they raise the error.
void IncrementalSolver::Impl::TakeSteps(UpdateResult* result) {
  std::vector<int> touched;
  bool damped = lambda_ > 0.0;
  double factorized_with = lambda_;
  Step& step = step_;
  for (result->iterations = 1;; ++result->iterations) {
    if (lambda_ > 0.0) ComputeWeights();
    factorized_with = lambda_;
    const int failed = tree_.Factorize({lambda_, &weights_});
    if (failed >= 0) ThrowUnderconstrained(failed);
    if (result->iterations == 1) {
      touched = tree_.factorized();
      result->variables_reeliminated = tree_.CountFrontal(touched);
    }
    Solve(config_.wildfire_threshold, config_.still_threshold, &step);
    double error = TotalError();
    if (!Lowers(error, result->error_before) && config_.still_threshold > 0.0) {
      // What was left out may be what the step lacks.
      Undo(step);
      Solve(kFinePart * config_.wildfire_threshold, kFinePart * config_.still_threshold, &step);
      error = TotalError();
    }
    if (Lowers(error, result->error_before)) {
      result->damping = lambda_;
      lambda_ *= config_.lambda_down;
      if (lambda_ < config_.lambda_min) lambda_ = 0.0;
      break;
    }
    Undo(step);
    ++result->steps_refused;
    // A small rise: the linearisation is stale, the direction is good. A part of the step.
    if (error <= kSmallRise * result->error_before &&
        (ShortenUntilLower(result->error_before) ||
         error <= (1.0 + kNegligibleRise) * result->error_before)) {
      break;
    }
    if (result->iterations >= config_.max_iterations || lambda_ >= config_.lambda_max) break;
    // Once more from the present estimate, linearised there, with more damping.
    if (result->steps_refused == 1) {
      std::vector<int> stale;
      for (const Move& move : step.moves) {
        const VariableState& state = graph_.states[move.variable];
        const auto moved = [](double d) { return d != 0.0; };
        if (std::any_of(state.delta, state.delta + state.dimension, moved))
          stale.push_back(move.variable);
      }
      Relinearize(stale);
      MarkRelinearized(stale);
      result->variables_relinearized += static_cast<int>(stale.size());
    }
    lambda_ = std::max(config_.lambda_initial, lambda_ * config_.lambda_up);
    damped = true;
    for (const int c : touched) tree_.MarkDirty(c);
  }
  if (!damped) return;
  damping_ = {factorized_with, &weights_};
  for (const int c : tree_.factorized()) {
    const Clique& clique = tree_.clique(c);
    damped_variables_.insert(damped_variables_.end(),
                             clique.variables.begin(),
                             clique.variables.begin() + clique.num_frontal);
  }
}

UpdateResult IncrementalSolver::Impl::Update(const FactorList& new_factors,
                                             const Values& new_values,
                                             const UpdateOptions& options) {
  const auto start = std::chrono::steady_clock::now();
  CheckInput(new_factors, new_values, options);
  ++epoch_;
  UpdateResult result;
  const Change change = ApplyChange(new_factors, new_values, options);
  result.error_before = TotalError();
  try {
    Eliminate(change, options, &result);
    TakeSteps(&result);
  } catch (...) {
    Revert(change);
    throw;
  }
  free_factors_.insert(
      free_factors_.end(), change.removed_slots.begin(), change.removed_slots.end());
  free_variables_.insert(
      free_variables_.end(), change.dropped_variables.begin(), change.dropped_variables.end());
  for (const int f : change.new_factors) {
    result.new_factor_ids.push_back(MakeFactorId(graph_.factors[f].generation, f));
  }
  if (options.converge) {
    result = Iterate(config_.relative_tolerance, config_.batch_max_iterations, std::move(result));
  }
  result.error_after = TotalError();
  result.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  return result;
}

// Levenberg-Marquardt on the whole graph in the present elimination order.
UpdateResult IncrementalSolver::Impl::Iterate(double tolerance,
                                              int max_iterations,
                                              UpdateResult result) {
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
  result.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  return result;
}

}  // namespace dendro
