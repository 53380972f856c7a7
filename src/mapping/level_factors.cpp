#include "dendro_slam/mapping/level_factors.h"

#include <cmath>
#include <stdexcept>

#include "dendro_slam/geometry/so3.h"

namespace dendro {

namespace {

bool IsUnit(const Eigen::Vector3d& v) { return v.allFinite() && std::abs(v.norm() - 1.0) < 1e-3; }

}  // namespace

GravityFactor::GravityFactor(Key pose, const Eigen::Vector3d& up_sensor, const NoiseModel& noise)
    : TypedFactor(noise, pose), up_sensor_(up_sensor) {
  if (!IsUnit(up_sensor)) {
    throw std::invalid_argument("gravity factor of " + KeyName(pose) +
                                ": the direction is not a unit vector");
  }
  if (noise.dimension() != 2) {
    throw std::invalid_argument("gravity factor of " + KeyName(pose) +
                                ": the noise must have dimension 2");
  }
  up_sensor_.normalize();
  basis_ = PerpendicularBasis(up_sensor_);
}

void GravityFactor::Evaluate(const Value* const* values, double* residual, double* jacobian) const {
  const auto& T_map_sensor = *std::get_if<Eigen::Isometry3d>(values[0]);
  const Eigen::Vector3d up = T_map_sensor.linear().transpose() * Eigen::Vector3d::UnitZ();
  Eigen::Map<Eigen::Vector2d> r(residual);
  r = basis_.transpose() * up;
  if (jacobian == nullptr) return;
  Eigen::Map<Eigen::Matrix<double, 2, 6>> J(jacobian);
  J.leftCols<3>() = basis_.transpose() * Skew(up);
  J.rightCols<3>().setZero();
}

GroundFactor::GroundFactor(Key pose,
                           Key ground,
                           const Eigen::Vector3d& normal_sensor,
                           double height_m,
                           const NoiseModel& noise)
    : TypedFactor(noise, pose, ground), normal_sensor_(normal_sensor), height_m_(height_m) {
  if (!IsUnit(normal_sensor) || !std::isfinite(height_m)) {
    throw std::invalid_argument("ground factor of " + KeyName(pose) +
                                ": the normal is not a unit vector or the height is not finite");
  }
  if (noise.dimension() != 3) {
    throw std::invalid_argument("ground factor of " + KeyName(pose) +
                                ": the noise must have dimension 3");
  }
  normal_sensor_.normalize();
  basis_ = PerpendicularBasis(normal_sensor_);
}

void GroundFactor::Evaluate(const Value* const* values, double* residual, double* jacobian) const {
  const auto& T_map_sensor = *std::get_if<Eigen::Isometry3d>(values[0]);
  const auto& plane = *std::get_if<PointN>(values[1]);
  const Eigen::Matrix3d R = T_map_sensor.linear();
  const Eigen::Vector3d u(-plane[1], -plane[2], 1.0);
  const double length = u.norm();
  const Eigen::Vector3d n = u / length;
  const Eigen::Vector3d above = T_map_sensor.translation() - plane[0] * Eigen::Vector3d::UnitZ();
  const Eigen::Vector3d n_sensor = R.transpose() * n;
  Eigen::Map<Eigen::Vector3d> r(residual);
  r[0] = n.dot(above) - height_m_;
  r.tail<2>() = basis_.transpose() * n_sensor;
  if (jacobian == nullptr) return;
  Eigen::Map<Eigen::Matrix<double, 3, 9>> J(jacobian);
  J.setZero();
  J.block<1, 3>(0, 3) = n_sensor.transpose();
  J.block<2, 3>(1, 0) = basis_.transpose() * Skew(n_sensor);
  // dn = (I - n n^T) du / |u|.
  const Eigen::Matrix3d dn = (Eigen::Matrix3d::Identity() - n * n.transpose()) / length;
  J(0, 6) = -n.z();
  J.block<1, 2>(0, 7) = -above.transpose() * dn.leftCols<2>();
  J.block<2, 2>(1, 7) = -basis_.transpose() * R.transpose() * dn.leftCols<2>();
}

}  // namespace dendro
