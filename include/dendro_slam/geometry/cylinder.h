#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

/// The landmark of the map: an infinite cylinder as (line manifold) x (curvature), 5 degrees of
/// freedom. Extents are kept beside it, never in it.
namespace dendro {

using Vector5d = Eigen::Matrix<double, 5, 1>;
using Matrix5d = Eigen::Matrix<double, 5, 5>;

/// Two unit vectors that complete `axis` to a right-handed orthonormal basis [b1 b2 axis].
/// @param axis  Unit vector.
/// @return      Shape (3, 2). A deterministic function of the axis.
Eigen::Matrix<double, 3, 2> PerpendicularBasis(const Eigen::Vector3d& axis);

/// A cylinder of unbounded length.
///
/// `point` is an anchor on the axis line, kept at the middle of what was observed: there the axis
/// and offset errors are nearly uncorrelated. Sliding it along the axis does not change the
/// cylinder, so it is a choice of gauge and not a sixth degree of freedom.
///
/// Tangent space (5): `[alpha (2, rad); beta (2, m); gamma (1, 1/m)]` with B = PerpendicularBasis(axis):
/// the axis turns by the rotation vector `B alpha`, the point moves by `B beta`, the curvature
/// grows by `gamma`. Every covariance of a cylinder in this project is in these coordinates.
///
/// @note Deviates: the thesis stores R^7 (axis, normal, curvature) with two dependent coordinates;
///       its normal n is Foot() of this type.
struct Cylinder {
  Eigen::Vector3d axis = Eigen::Vector3d::UnitZ();   ///< Unit direction; the sign has no meaning.
  Eigen::Vector3d point = Eigen::Vector3d::Zero();   ///< Anchor on the axis line [m].
  double curvature = 1.0;                            ///< kappa = 1 / radius [1/m], > 0.

  /// Radius at the anchor [m].
  double radius() const { return 1.0 / curvature; }

  /// Foot of the perpendicular from the frame's origin to the axis line [m] (the thesis' n).
  Eigen::Vector3d Foot() const { return point - point.dot(axis) * axis; }

  /// Signed distance from the surface [m] (thesis eq. 4.1): positive outside.
  double Distance(const Eigen::Vector3d& p) const {
    return (p - point).cross(axis).norm() - radius();
  }

  /// The cylinder moved by a tangent vector, see the class comment.
  Cylinder Retract(const Vector5d& delta) const;

  /// Inverse of Retract up to the gauge: `Retract(LocalCoordinates(other))` is the line of `other`
  /// whatever the sign of its axis and wherever its anchor lies; the displacement is measured in
  /// the plane through this anchor perpendicular to this axis.
  Vector5d LocalCoordinates(const Cylinder& other) const;

  /// The same cylinder with its anchor moved along the axis by `s` [m].
  Cylinder Slid(double s) const { return {axis, point + s * axis, curvature}; }
};

/// The cylinder expressed in frame a: `T_a_b * cylinder_b`.
Cylinder TransformCylinder(const Eigen::Isometry3d& T_a_b, const Cylinder& cylinder_b);

/// Jacobian of the tangent coordinates under a change of frame, `d_a = J d_b`: a rotation of the
/// two perpendicular bases into each other. A covariance transforms as `J C J^T`.
/// @return Shape (5, 5), orthonormal.
Matrix5d CylinderTangentTransform(const Eigen::Isometry3d& T_a_b, const Cylinder& cylinder_b);

/// Jacobian of sliding the anchor by `s` along the axis: `delta' = J delta` for Slid(s).
/// @return Shape (5, 5).
Matrix5d CylinderSlideJacobian(const Cylinder& cylinder, double s);

/// Jacobian of the tangent coordinates when the axis turns a little, or to its opposite: the
/// perpendicular basis of the one in that of the other. A covariance transforms as `J C J^T`.
/// @return Shape (5, 5).
Matrix5d CylinderTurnJacobian(const Eigen::Vector3d& from_axis, const Eigen::Vector3d& to_axis);

/// The axis with the thesis' sign convention, for display and files only (section 4.3): +Z when
/// possible, +Y for axes in the XY plane, +X for the X axis.
Eigen::Vector3d DisplayAxis(const Eigen::Vector3d& axis);

}  // namespace dendro
