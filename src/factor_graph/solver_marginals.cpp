// Marginalisation, and marginal covariances.
#include <algorithm>
#include <memory>
#include <string>

#include <Eigen/Cholesky>
#include <Eigen/LU>

#include "dendro_slam/factor_graph/linear_factor.h"
#include "solver_impl.h"

namespace dendro {

using internal::FactorRecord;
using internal::MakeFactorId;
using internal::VariableRecord;

namespace {

// A diagonal entry of which marginalisation leaves less than this part is zero.
constexpr double kNoInformation = 1e-12;

}  // namespace

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
      throw UnderconstrainedError(graph_.variables[removed.front()].key,
                                  "variable " + KeyName(graph_.variables[removed.front()].key) +
                                      " cannot be marginalised: its factors leave a direction of "
                                      "the removed variables free; "
                                      "add a prior or keep the variable");
    }
    const Eigen::MatrixXd X = ldlt.solve(H.topRightCorner(eliminated, kept));
    Eigen::MatrixXd H_kept =
        H.bottomRightCorner(kept, kept) - H.bottomLeftCorner(kept, eliminated) * X;
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
      throw UnknownVariableError(key,
                                 factor->Describe() + ": variable " + KeyName(key) +
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

Eigen::MatrixXd IncrementalSolver::Impl::JointMarginalCovariance(
    const std::vector<Key>& keys) const {
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
    Key first,
    const std::vector<Key>& others) const {
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
    const Eigen::MatrixXd other =
        Y.middleCols(column, d) * TangentAtEstimate(selected[i]).transpose();
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

}  // namespace dendro
