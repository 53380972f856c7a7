#include "cylinder_jacobians.h"

#include <cmath>

#include "dendro_slam/geometry/so3.h"

namespace dendro::internal {

CylinderLocal LocalWithDerivatives(const Cylinder& reference, const Cylinder& other) {
  CylinderLocal out;
  const Eigen::Matrix<double, 3, 2> B = PerpendicularBasis(reference.axis);
  const double sign = reference.axis.dot(other.axis) < 0.0 ? -1.0 : 1.0;
  out.axis = sign * other.axis;

  // Axis part: g(c) B^T (m x a), g = theta / sin(theta), c = m . a.
  const Eigen::Vector3d cross = reference.axis.cross(out.axis);
  const double c = reference.axis.dot(out.axis);
  const double s2 = cross.squaredNorm();
  double g = 1.0;
  double dg = -1.0 / 3.0;
  if (s2 < 1e-8) {
    const double x = 1.0 - c;
    g = 1.0 + x / 3.0 + 2.0 * x * x / 15.0;
    dg = -1.0 / 3.0 - 4.0 * x / 15.0;
  } else {
    const double s = std::sqrt(s2);
    g = std::atan2(s, c) / s;
    dg = (c * g - 1.0) / s2;
  }
  const Eigen::Matrix<double, 2, 3> Bt = B.transpose();
  out.delta.head<2>() = g * (Bt * cross);
  out.J_axis.topRows<2>() =
      Bt * (g * Skew(reference.axis) + dg * cross * reference.axis.transpose());

  // Normal part: where the other line pierces the plane through the reference's anchor. The same
  // fallback as Cylinder::LocalCoordinates for lines nearly in that plane.
  Eigen::Vector3d pierce = other.point;
  out.J_point = Bt;
  out.J_axis.bottomRows<2>().setZero();
  if (c > 1e-3) {
    const double slide = (reference.point - other.point).dot(reference.axis) / c;
    pierce += slide * out.axis;
    out.J_point -= (Bt * out.axis) * (reference.axis.transpose() / c);
    out.J_axis.bottomRows<2>() = slide * out.J_point;
  }
  out.delta.segment<2>(2) = Bt * (pierce - reference.point);
  out.delta[4] = other.curvature - reference.curvature;
  return out;
}

}  // namespace dendro::internal
