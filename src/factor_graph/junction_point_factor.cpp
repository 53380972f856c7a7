#include "dendro_slam/factor_graph/junction_point_factor.h"

#include <stdexcept>

#include "dendro_slam/geometry/so3.h"

namespace dendro {

JunctionPointFactor::JunctionPointFactor(Key pose,
                                         Key point,
                                         const Eigen::Vector3d& p_sensor,
                                         const NoiseModel& noise)
    : TypedFactor(noise, pose, point), p_sensor_(p_sensor) {
  if (!p_sensor.allFinite()) {
    throw std::invalid_argument("junction factor of " + KeyName(point) + ": the point is not finite");
  }
  if (noise.dimension() != 3) {
    throw std::invalid_argument("junction factor of " + KeyName(point) +
                                ": the noise must have dimension 3");
  }
}

void JunctionPointFactor::Evaluate(const Value* const* values,
                                   double* residual,
                                   double* jacobian) const {
  const auto& T_map_sensor = *std::get_if<Eigen::Isometry3d>(values[0]);
  const auto& point = *std::get_if<Eigen::Vector3d>(values[1]);
  const Eigen::Matrix3d R_sensor_map = T_map_sensor.linear().transpose();
  const Eigen::Vector3d predicted = R_sensor_map * (point - T_map_sensor.translation());
  Eigen::Map<Eigen::Vector3d> r(residual);
  r = predicted - p_sensor_;
  if (jacobian == nullptr) return;
  Eigen::Map<Eigen::Matrix<double, 3, 9>> J(jacobian);
  J.leftCols<3>() = Skew(predicted);
  J.middleCols<3>(3) = -Eigen::Matrix3d::Identity();
  J.rightCols<3>() = R_sensor_map;
}

PointOnAxisFactor::PointOnAxisFactor(Key cylinder,
                                     Key point,
                                     double sigma_m,
                                     const RobustKernel& kernel)
    : TypedFactor(NoiseModel::Isotropic(3, sigma_m).WithKernel(kernel), cylinder, point) {}

void PointOnAxisFactor::Evaluate(const Value* const* values,
                                 double* residual,
                                 double* jacobian) const {
  const auto& cylinder = *std::get_if<Cylinder>(values[0]);
  const auto& point = *std::get_if<Eigen::Vector3d>(values[1]);
  const Eigen::Vector3d& a = cylinder.axis;
  const Eigen::Vector3d d = point - cylinder.point;
  const Eigen::Matrix3d projection = Eigen::Matrix3d::Identity() - a * a.transpose();
  Eigen::Map<Eigen::Vector3d> r(residual);
  r = projection * d;
  if (jacobian == nullptr) return;
  const Eigen::Matrix<double, 3, 2> B = PerpendicularBasis(a);
  const Eigen::Matrix<double, 3, 2> d_axis = -Skew(a) * B;
  Eigen::Map<Eigen::Matrix<double, 3, 8>> J(jacobian);
  J.leftCols<2>() = -(d_axis * a.dot(d) + a * (d.transpose() * d_axis));
  J.middleCols<2>(2) = -projection * B;
  J.col(4).setZero();
  J.rightCols<3>() = projection;
}

}  // namespace dendro
