#include "dendro_slam/factor_graph/incremental_solver.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "solver_impl.h"

namespace dendro {

using internal::FactorRecord;
using internal::kErrorBlock;
using internal::kGenerationShift;
using internal::LastUnit;
using internal::MakeFactorId;
using internal::VariableRecord;
using internal::VariableState;

namespace {

void Require(bool ok, const char* field, const char* rule) {
  if (!ok) throw std::invalid_argument(std::string("SolverConfig.") + field + " must be " + rule);
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
  Require(
      std::isfinite(lambda_max) && lambda_max > lambda_initial, "lambda_max", "> lambda_initial");
  Require(batch_max_iterations >= 1, "batch_max_iterations", ">= 1");
  Require(not_negative(relative_tolerance), "relative_tolerance", ">= 0");
  Require(reorder_interval >= 1, "reorder_interval", ">= 1");
}

// -------------------------------------------------------------------------------------------------
// Bookkeeping
// -------------------------------------------------------------------------------------------------

int IncrementalSolver::Impl::SlotOf(Key key) const {
  const auto it = slots_.find(key);
  if (it == slots_.end()) {
    throw UnknownVariableError(key,
                               "variable " + KeyName(key) +
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
      throw DuplicateVariableError(key,
                                   "variable " + KeyName(key) +
                                       " is already in the graph; give new values only for new "
                                       "variables");
    }
    if (!IsValid(value)) {
      throw NonFiniteError(key,
                           "the initial value of variable " + KeyName(key) + " is not a valid " +
                               TypeName(value) +
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
          throw DuplicateVariableError(
              key,
              factor->Describe() + ": variable " + KeyName(key) + " appears twice in one factor");
        }
      }
      if (new_values.Contains(key)) {
        pointers.push_back(&new_values.Get(key));
        ++uses[key];
      } else if (Contains(key)) {
        pointers.push_back(&EstimateValue(key));
      } else {
        throw UnknownVariableError(key,
                                   factor->Describe() + ": variable " + KeyName(key) +
                                       " has no value; add its initial value with this update");
      }
    }
    factor->CheckTypes(pointers.data());
    if (!std::isfinite(factor->Error(pointers.data()))) {
      throw NonFiniteError(keys[0],
                           factor->Describe() + ": the error at " + KeyName(keys[0]) +
                               " is not finite; check the measurement and the initial values");
    }
  }
  for (const auto& [key, value] : new_values) {
    if (uses.count(key) == 0) {
      throw UnderconstrainedError(key,
                                  "variable " + KeyName(key) +
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
    Key first,
    const std::vector<Key>& others) const {
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
  throw UnknownVariableError(key,
                             "variable " + KeyName(key) +
                                 " is of another type; ask for it with the type it was added with");
}

}  // namespace dendro
