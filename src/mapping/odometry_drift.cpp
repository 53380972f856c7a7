#include "dendro_slam/mapping/odometry_drift.h"

#include <stdexcept>
#include <string>

#include "dendro_slam/factor_graph/between_factor.h"

namespace dendro {

Eigen::Matrix<double, 3, kDriftDimension> DriftJacobian(const Eigen::Isometry3d& T_from_to_measured,
                                                        const Eigen::Matrix3d& R_odom_from) {
  const Eigen::Vector3d way = T_from_to_measured.translation() / kDriftWayM;
  Eigen::Matrix<double, 3, kDriftDimension> J;
  J.col(0) = way;
  J.rightCols<3>() = way.norm() * R_odom_from.transpose();
  return J;
}

DriftingMotionFactor::DriftingMotionFactor(Key from,
                                           Key to,
                                           Key drift,
                                           const Eigen::Isometry3d& T_from_to,
                                           const Eigen::Matrix3d& R_odom_from,
                                           const NoiseModel& noise)
    : TypedFactor(noise, from, to, drift),
      T_from_to_(T_from_to),
      J_drift_(DriftJacobian(T_from_to, R_odom_from)) {
  const std::string name = "drifting motion " + KeyName(from) + " " + KeyName(to);
  if (!IsValid(Value(T_from_to)) || !R_odom_from.allFinite()) {
    throw std::invalid_argument(name + ": the motion is not a valid pose");
  }
  if (noise.dimension() != 6) throw std::invalid_argument(name + ": the noise must have dimension 6");
  if (from == to) throw std::invalid_argument(name + ": both ends are the same pose");
}

Eigen::Isometry3d DriftingMotionFactor::Without(const PointN& drift) const {
  Eigen::Isometry3d T = T_from_to_;
  T.translation() -= J_drift_ * drift;
  return T;
}

void DriftingMotionFactor::Evaluate(const Value* const* values,
                                    double* residual,
                                    double* jacobian) const {
  const auto& T_from = *std::get_if<Eigen::Isometry3d>(values[0]);
  const auto& T_to = *std::get_if<Eigen::Isometry3d>(values[1]);
  const Eigen::Isometry3d T_measured = Without(*std::get_if<PointN>(values[2]));
  Eigen::Map<Vector6d> r(residual);
  if (jacobian == nullptr) {
    r = BetweenResidual(T_measured, T_from, T_to, nullptr, nullptr);
    return;
  }
  Matrix6d J_from, J_to;
  r = BetweenResidual(T_measured, T_from, T_to, &J_from, &J_to);
  Eigen::Map<Eigen::Matrix<double, 6, 12 + kDriftDimension>> J(jacobian);
  J.leftCols<6>() = J_from;
  J.middleCols<6>(6) = J_to;
  // A measured motion shorter by d is a pose `to` farther by d, in the axes of `from`.
  const Eigen::Matrix3d R_to_from = T_to.linear().transpose() * T_from.linear();
  J.rightCols<kDriftDimension>() = J_to.rightCols<3>() * (R_to_from * J_drift_);
}

DriftChangeFactor::DriftChangeFactor(Key earlier,
                                     Key later,
                                     const Eigen::Vector4d& keep,
                                     const NoiseModel& noise)
    : TypedFactor(noise, earlier, later), keep_(keep) {
  const std::string name = "change of drift " + KeyName(earlier) + " " + KeyName(later);
  if (!(keep.minCoeff() >= 0.0 && keep.maxCoeff() <= 1.0)) {
    throw std::invalid_argument(name + ": what is kept must be in [0, 1]");
  }
  if (noise.dimension() != kDriftDimension) {
    throw std::invalid_argument(name + ": the noise must have dimension 4");
  }
}

void DriftChangeFactor::Evaluate(const Value* const* values,
                                 double* residual,
                                 double* jacobian) const {
  const Eigen::Vector4d earlier = *std::get_if<PointN>(values[0]);
  const Eigen::Vector4d later = *std::get_if<PointN>(values[1]);
  Eigen::Map<Eigen::Vector4d> r(residual);
  r = later - keep_.cwiseProduct(earlier);
  if (jacobian == nullptr) return;
  Eigen::Map<Eigen::Matrix<double, 4, 8>> J(jacobian);
  J.setZero();
  J.leftCols<4>().diagonal() = -keep_;
  J.rightCols<4>().diagonal().setOnes();
}

}  // namespace dendro
