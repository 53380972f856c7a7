#include "dendro_slam/factor_graph/linear_factor.h"

#include <stdexcept>

#include <Eigen/Eigenvalues>

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
  // H = U S U^T; A = S^1/2 U^T and A^T r0 = -g. Scaled to a unit diagonal first, so that radians,
  // metres and 1/metres are judged alike.
  const Eigen::VectorXd scale = H.diagonal().cwiseMax(1e-300).cwiseSqrt();
  const Eigen::MatrixXd scaled = scale.cwiseInverse().asDiagonal() * H * scale.cwiseInverse().asDiagonal();
  const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen(scaled);
  constexpr double kRelativeRank = 1e-11;
  const double threshold = kRelativeRank * std::max(eigen.eigenvalues().maxCoeff(), 0.0);
  const Eigen::Index n = H.rows();
  Eigen::Index first = 0;
  while (first < n && !(eigen.eigenvalues()[first] > threshold)) ++first;
  const Eigen::Index rank = n - first;
  const Eigen::VectorXd root = eigen.eigenvalues().tail(rank).cwiseSqrt();
  A_ = root.asDiagonal() * eigen.eigenvectors().rightCols(rank).transpose() * scale.asDiagonal();
  r0_ = -(root.cwiseInverse().asDiagonal() *
          (eigen.eigenvectors().rightCols(rank).transpose() * g.cwiseQuotient(scale)));
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
