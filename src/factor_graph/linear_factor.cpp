#include "dendro_slam/factor_graph/linear_factor.h"

#include <cmath>
#include <cstddef>
#include <stdexcept>
#include <utility>

namespace dendro {

namespace {

void CheckShapes(const std::vector<Key>& keys, const std::vector<Value>& origins, Eigen::Index columns) {
  if (keys.empty() || keys.size() != origins.size()) {
    throw std::invalid_argument("linear factor: one origin per key is needed");
  }
  Eigen::Index total = 0;
  for (std::size_t i = 0; i < origins.size(); ++i) {
    if (!IsValid(origins[i])) {
      throw std::invalid_argument("linear factor: the origin of " + KeyName(keys[i]) +
                                  " is not a valid value");
    }
    total += TangentDimension(origins[i]);
  }
  if (total != columns) {
    throw std::invalid_argument("linear factor: " + std::to_string(columns) + " columns for " +
                                std::to_string(total) + " tangent coordinates");
  }
}

}  // namespace

LinearFactor::LinearFactor(const std::vector<Key>& keys,
                           const std::vector<Value>& origins,
                           const Eigen::MatrixXd& H,
                           const Eigen::VectorXd& g)
    : keys_(keys), origins_(origins) {
  CheckShapes(keys, origins, H.cols());
  if (H.rows() != H.cols() || g.size() != H.rows() || !H.allFinite() || !g.allFinite()) {
    throw std::invalid_argument("linear factor: the quadratic must be square, matching and finite");
  }
  // Cholesky factorisation with diagonal pivoting until nothing but rounding is left: P H P^T = L L^T
  // with L of as many columns as H has ranks; A = L^T P and A^T r0 = -g. (Eigen's LDLT does not update
  // the diagonal before it picks the pivot, so it does not tell the rank.) Scaled to a unit diagonal
  // first, so that radians, metres and 1/metres are judged alike.
  // A coordinate whose diagonal is not positive has no information: its row is dropped.
  Eigen::VectorXd scale(H.rows()), inverse(H.rows());
  for (Eigen::Index i = 0; i < H.rows(); ++i) {
    scale[i] = H(i, i) > 0.0 ? std::sqrt(H(i, i)) : 0.0;
    inverse[i] = scale[i] > 0.0 ? 1.0 / scale[i] : 0.0;
  }
  constexpr double kRank = 1e-11;
  const Eigen::Index n = H.rows();
  Eigen::MatrixXd rest = inverse.asDiagonal() * H * inverse.asDiagonal();
  Eigen::MatrixXd L = Eigen::MatrixXd::Zero(n, n);
  Eigen::VectorXd y = -g.cwiseProduct(inverse);
  std::vector<Eigen::Index> order(static_cast<std::size_t>(n));
  for (Eigen::Index i = 0; i < n; ++i) order[static_cast<std::size_t>(i)] = i;
  Eigen::Index rank = 0;
  for (; rank < n; ++rank) {
    Eigen::Index pivot = 0;
    if (!(rest.diagonal().tail(n - rank).maxCoeff(&pivot) > kRank)) break;
    pivot += rank;
    std::swap(order[static_cast<std::size_t>(rank)], order[static_cast<std::size_t>(pivot)]);
    std::swap(y[rank], y[pivot]);
    L.row(rank).swap(L.row(pivot));
    rest.row(rank).swap(rest.row(pivot));
    rest.col(rank).swap(rest.col(pivot));
    const Eigen::Index below = n - rank - 1;
    L(rank, rank) = std::sqrt(rest(rank, rank));
    L.col(rank).tail(below) = rest.col(rank).tail(below) / L(rank, rank);
    y[rank] /= L(rank, rank);
    y.tail(below) -= y[rank] * L.col(rank).tail(below);
    rest.bottomRightCorner(below, below).noalias() -=
        L.col(rank).tail(below) * L.col(rank).tail(below).transpose();
  }
  A_.resize(rank, n);
  for (Eigen::Index j = 0; j < n; ++j) {
    const Eigen::Index column = order[static_cast<std::size_t>(j)];
    A_.col(column) = scale[column] * L.row(j).head(rank).transpose();
  }
  r0_ = y.head(rank);
}

std::shared_ptr<const LinearFactor> LinearFactor::FromSquareRoot(const std::vector<Key>& keys,
                                                                 const std::vector<Value>& origins,
                                                                 const Eigen::MatrixXd& A,
                                                                 const Eigen::VectorXd& r0) {
  CheckShapes(keys, origins, A.cols());
  if (A.rows() != r0.size() || !A.allFinite() || !r0.allFinite()) {
    throw std::invalid_argument("linear factor: A and r0 must have the same rows and be finite");
  }
  std::shared_ptr<LinearFactor> out(new LinearFactor);
  out->keys_ = keys;
  out->origins_ = origins;
  out->A_ = A;
  out->r0_ = r0;
  return out;
}

void LinearFactor::Displacement(const Value* const* values, double* delta) const {
  for (std::size_t i = 0; i < origins_.size(); ++i) {
    LocalCoordinates(origins_[i], *values[i], delta);
    delta += TangentDimension(origins_[i]);
  }
}

double LinearFactor::Error(const Value* const* values) const {
  Eigen::VectorXd delta(A_.cols());
  Displacement(values, delta.data());
  return 0.5 * (A_ * delta + r0_).squaredNorm();
}

double LinearFactor::Linearize(const Value* const* values, double* jacobian, double* residual) const {
  Eigen::VectorXd delta(A_.cols());
  Displacement(values, delta.data());
  Eigen::Map<Eigen::VectorXd> r(residual, A_.rows());
  r = A_ * delta + r0_;
  Eigen::Map<Eigen::MatrixXd> J(jacobian, A_.rows(), A_.cols());
  int column = 0;
  double local[kMaxTangentDimension * kMaxTangentDimension];
  for (std::size_t i = 0; i < origins_.size(); ++i) {
    const int n = TangentDimension(origins_[i]);
    LocalCoordinatesJacobian(origins_[i], *values[i], local);
    J.middleCols(column, n).noalias() =
        A_.middleCols(column, n) * Eigen::Map<const Eigen::MatrixXd>(local, n, n);
    column += n;
  }
  return 0.5 * r.squaredNorm();
}

void LinearFactor::CheckTypes(const Value* const* values) const {
  for (std::size_t i = 0; i < origins_.size(); ++i) {
    if (values[i]->index() != origins_[i].index() ||
        TangentDimension(*values[i]) != TangentDimension(origins_[i])) {
      throw UnknownVariableError(keys_[i], Describe() + ": variable " + KeyName(keys_[i]) + " is a " +
                                               TypeName(*values[i]) + ", the factor was made for a " +
                                               TypeName(origins_[i]));
    }
  }
}

}  // namespace dendro
