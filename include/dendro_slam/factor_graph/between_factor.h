#pragma once

#include "dendro_slam/factor_graph/factor.h"
#include "dendro_slam/geometry/se3.h"

namespace dendro {

/// `Log(T_from_to_measured^-1 * T_from^-1 * T_to)`, shape (6), rotation first, and its Jacobians for the
/// right tangents of the poses.
/// @param J_from, J_to  Out, shape (6, 6), both or neither null.
Vector6d BetweenResidual(const Eigen::Isometry3d& T_from_to_measured,
                         const Eigen::Isometry3d& T_from,
                         const Eigen::Isometry3d& T_to,
                         Matrix6d* J_from,
                         Matrix6d* J_to);

/// Relative motion between two poses: `r = Log(T_from_to_measured^-1 * T_from^-1 * T_to)`, shape (6),
/// rotation first (GTSAM's BetweenFactor<Pose3>).
class BetweenFactor final : public TypedFactor<Eigen::Isometry3d, Eigen::Isometry3d> {
 public:
  /// @param T_from_to  Measured motion.
  /// @param noise      Of the right tangent [omega; rho] at T_from_to, dimension 6.
  /// @throws std::invalid_argument if the motion is not finite or the dimension is not 6.
  BetweenFactor(Key from, Key to, const Eigen::Isometry3d& T_from_to, const NoiseModel& noise);

  const Eigen::Isometry3d& T_from_to() const { return T_from_to_; }
  void Evaluate(const Value* const* values, double* residual, double* jacobian) const override;

 private:
  const char* Kind() const override { return "between"; }

  Eigen::Isometry3d T_from_to_;
};

}  // namespace dendro
