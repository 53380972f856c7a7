#include "dendro_slam/geometry/cylinder.h"

#include <cmath>

#include "dendro_slam/geometry/so3.h"

namespace dendro {

Eigen::Matrix<double, 3, 2> PerpendicularBasis(const Eigen::Vector3d& axis) {
  // Duff et al., "Building an orthonormal basis, revisited" (JCGT 2017): no branch but the sign.
  const double sign = std::copysign(1.0, axis.z());
  const double a = -1.0 / (sign + axis.z());
  const double b = axis.x() * axis.y() * a;
  Eigen::Matrix<double, 3, 2> basis;
  basis.col(0) << 1.0 + sign * axis.x() * axis.x() * a, sign * b, -sign * axis.x();
  basis.col(1) << b, sign + axis.y() * axis.y() * a, -axis.y();
  return basis;
}

Cylinder Cylinder::Retract(const Vector5d& delta) const {
  const Eigen::Matrix<double, 3, 2> B = PerpendicularBasis(axis);
  Cylinder out;
  out.axis = (ExpSo3(B * delta.head<2>()) * axis).normalized();
  out.point = point + B * delta.segment<2>(2);
  out.curvature = curvature + delta[4];
  return out;
}

Vector5d Cylinder::LocalCoordinates(const Cylinder& other) const {
  const Eigen::Matrix<double, 3, 2> B = PerpendicularBasis(axis);
  const Eigen::Vector3d other_axis = axis.dot(other.axis) < 0.0 ? Eigen::Vector3d(-other.axis) : other.axis;
  // Rotation vector that turns axis into other_axis; perpendicular to axis by construction.
  const Eigen::Vector3d cross = axis.cross(other_axis);
  const double sin_angle = cross.norm();
  const double cos_angle = axis.dot(other_axis);
  const double scale = sin_angle < 1e-12 ? 1.0 : std::atan2(sin_angle, cos_angle) / sin_angle;
  // Where the other line pierces the plane through this anchor; near-perpendicular lines (which no
  // caller associates) fall back to the other anchor's projection.
  Eigen::Vector3d pierce = other.point;
  if (cos_angle > 1e-3) pierce += other_axis * ((point - other.point).dot(axis) / cos_angle);
  Vector5d delta;
  delta.head<2>() = B.transpose() * (scale * cross);
  delta.segment<2>(2) = B.transpose() * (pierce - point);
  delta[4] = other.curvature - curvature;
  return delta;
}

Cylinder TransformCylinder(const Eigen::Isometry3d& T_a_b, const Cylinder& cylinder_b) {
  return {T_a_b.linear() * cylinder_b.axis, T_a_b * cylinder_b.point, cylinder_b.curvature};
}

Matrix5d CylinderTangentTransform(const Eigen::Isometry3d& T_a_b, const Cylinder& cylinder_b) {
  const Eigen::Matrix<double, 3, 2> B_a = PerpendicularBasis(T_a_b.linear() * cylinder_b.axis);
  const Eigen::Matrix2d M = B_a.transpose() * T_a_b.linear() * PerpendicularBasis(cylinder_b.axis);
  Matrix5d J = Matrix5d::Zero();
  J.topLeftCorner<2, 2>() = M;
  J.block<2, 2>(2, 2) = M;
  J(4, 4) = 1.0;
  return J;
}

Matrix5d CylinderSlideJacobian(const Cylinder& cylinder, double s) {
  // Turning the axis by B alpha moves the point at s by (B alpha) x (s axis).
  const Eigen::Matrix<double, 3, 2> B = PerpendicularBasis(cylinder.axis);
  Matrix5d J = Matrix5d::Identity();
  J.block<2, 2>(2, 0) = -s * B.transpose() * Skew(cylinder.axis) * B;
  return J;
}

Matrix5d CylinderTurnJacobian(const Eigen::Vector3d& from_axis, const Eigen::Vector3d& to_axis) {
  const Eigen::Matrix2d M =
      PerpendicularBasis(to_axis).transpose() * PerpendicularBasis(from_axis);
  Matrix5d J = Matrix5d::Identity();
  J.topLeftCorner<2, 2>() = M;
  J.block<2, 2>(2, 2) = M;
  return J;
}

Eigen::Vector3d DisplayAxis(const Eigen::Vector3d& axis) {
  constexpr double kInPlane = 1e-9;
  if (std::abs(axis.z()) > kInPlane) return axis.z() < 0.0 ? Eigen::Vector3d(-axis) : axis;
  if (std::abs(axis.y()) > kInPlane) return axis.y() < 0.0 ? Eigen::Vector3d(-axis) : axis;
  return axis.x() < 0.0 ? Eigen::Vector3d(-axis) : axis;
}

}  // namespace dendro
