// Errors of the factors at the estimate, and their linearisations.
#include <algorithm>
#include <cmath>
#include <limits>

#include "solver_impl.h"

namespace dendro {

using internal::Clique;
using internal::FactorRecord;
using internal::kErrorBlock;
using internal::LastUnit;
using internal::PrefetchLines;
using internal::VariableRecord;
using internal::VariableState;

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
      for (const int v : next.variables)
        PrefetchLines(&graph_.variables[v].estimate, sizeof(Value));
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
    PrefetchLines(clique.conditional.data(),
                  std::min(clique.conditional.size(), kMaxDoubles) * sizeof(double));
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
      return norm(0, 2) > config_.relinearize_axis_rad || norm(2, 2) > config_.relinearize_offset_m;
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

}  // namespace dendro
