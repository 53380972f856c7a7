#include "dendro_slam/factor_graph/between_factor.h"

#include <stdexcept>

#include "dendro_slam/geometry/se3.h"
#include "dendro_slam/geometry/so3.h"

namespace dendro {

Vector6d BetweenResidual(const Eigen::Isometry3d& T_from_to_measured,
                         const Eigen::Isometry3d& T_from,
                         const Eigen::Isometry3d& T_to,
                         Matrix6d* J_from,
                         Matrix6d* J_to) {
  const Eigen::Matrix3d R_from_to = T_from.linear().transpose() * T_to.linear();
  const Eigen::Vector3d t_from_to =
      T_from.linear().transpose() * (T_to.translation() - T_from.translation());
  const auto R_measured = T_from_to_measured.linear();
  const Eigen::Matrix3d R = R_measured.transpose() * R_from_to;
  const Eigen::Vector3d t =
      R_measured.transpose() * (t_from_to - T_from_to_measured.translation());
  const Vector6d r = LogSe3(R, t);
  if (J_from == nullptr) return r;

  // d r / d to = JrInv(r); moving `from` by d moves `to` in its frame by -Ad(T_to_from) d.
  *J_to = RightJacobianInverseSe3(r);
  const auto J_w = J_to->topLeftCorner<3, 3>();
  const auto Q = J_to->bottomLeftCorner<3, 3>();
  // Blocks of Ad(T_to_from): rotation R^T, lower left Skew(-R^T t) R^T = -R^T Skew(t).
  const Eigen::Matrix3d Rt = R_from_to.transpose();
  const Eigen::Matrix3d lower = Rt * Skew(t_from_to);
  const Eigen::Matrix3d J_w_Rt = J_w * Rt;
  J_from->topLeftCorner<3, 3>() = -J_w_Rt;
  J_from->topRightCorner<3, 3>().setZero();
  J_from->bottomLeftCorner<3, 3>() = -(Q * Rt) + J_w * lower;
  J_from->bottomRightCorner<3, 3>() = -J_w_Rt;
  return r;
}

BetweenFactor::BetweenFactor(Key from,
                             Key to,
                             const Eigen::Isometry3d& T_from_to,
                             const NoiseModel& noise)
    : TypedFactor(noise, from, to), T_from_to_(T_from_to) {
  const std::string name = "between " + KeyName(from) + " " + KeyName(to);
  if (!IsValid(Value(T_from_to))) throw std::invalid_argument(name + ": the motion is not a valid pose");
  if (noise.dimension() != 6) throw std::invalid_argument(name + ": the noise must have dimension 6");
  if (from == to) throw std::invalid_argument(name + ": both ends are the same pose");
}

void BetweenFactor::Evaluate(const Value* const* values, double* residual, double* jacobian) const {
  const auto& T_from = *std::get_if<Eigen::Isometry3d>(values[0]);
  const auto& T_to = *std::get_if<Eigen::Isometry3d>(values[1]);
  Eigen::Map<Vector6d> r(residual);
  if (jacobian == nullptr) {
    r = BetweenResidual(T_from_to_, T_from, T_to, nullptr, nullptr);
    return;
  }
  Matrix6d J_from, J_to;
  r = BetweenResidual(T_from_to_, T_from, T_to, &J_from, &J_to);
  Eigen::Map<Eigen::Matrix<double, 6, 12>> J(jacobian);
  J << J_from, J_to;
}

}  // namespace dendro
