#pragma once

#include <vector>

#include <Eigen/Core>

#include "dendro_slam/factor_graph/factor.h"

namespace dendro {

/// A quadratic on the tangent space of any number of variables, as marginalisation leaves it:
/// `r = A [LocalCoordinates(origin_i, x_i)]_i + r0`, error `|r|^2 / 2`.
class LinearFactor final : public Factor {
 public:
  /// From the quadratic `d^T H d / 2 - g^T d` around the origins, H symmetric positive
  /// semi-definite; directions without information are dropped, and so is the constant.
  /// @param keys     One per variable.
  /// @param origins  Linearisation points in the order of the keys.
  /// @throws std::invalid_argument for wrong shapes or numbers that are not finite.
  LinearFactor(const std::vector<Key>& keys,
               const std::vector<Value>& origins,
               const Eigen::MatrixXd& H,
               const Eigen::VectorXd& g);

  /// From its square root, e.g. as it was saved: rows of A and r0.
  static std::shared_ptr<const LinearFactor> FromSquareRoot(const std::vector<Key>& keys,
                                                            const std::vector<Value>& origins,
                                                            const Eigen::MatrixXd& A,
                                                            const Eigen::VectorXd& r0);

  KeySpan keys() const override { return {keys_.data(), static_cast<int>(keys_.size())}; }
  int dimension() const override { return static_cast<int>(A_.rows()); }
  double Error(const Value* const* values) const override;
  double Linearize(const Value* const* values, double* jacobian, double* residual) const override;
  using Factor::Error;
  using Factor::Linearize;
  void CheckTypes(const Value* const* values) const override;

  const std::vector<Value>& origins() const { return origins_; }
  const Eigen::MatrixXd& A() const { return A_; }
  const Eigen::VectorXd& r0() const { return r0_; }

 private:
  LinearFactor() = default;
  const char* Kind() const override { return "linear"; }
  void Displacement(const Value* const* values, double* delta) const;

  std::vector<Key> keys_;
  std::vector<Value> origins_;
  Eigen::MatrixXd A_;
  Eigen::VectorXd r0_;
};

}  // namespace dendro
