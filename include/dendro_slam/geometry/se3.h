#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

/// Rigid motions: exponential map, logarithm, adjoint and right Jacobians of SE(3).
///
/// A pose `T_a_b` is an Eigen::Isometry3d that maps points of frame b to frame a. Tangent vectors
/// are `xi = [omega; rho]`, rotation first [rad, m]; perturbations act from the right,
/// `T * Exp(xi)`. This is GTSAM's Pose3 convention.
namespace dendro {

using Vector6d = Eigen::Matrix<double, 6, 1>;
using Matrix6d = Eigen::Matrix<double, 6, 6>;

/// Exponential map of SE(3).
/// @param xi  Twist [omega (rad); rho (m)], shape (6).
Eigen::Isometry3d ExpSe3(const Vector6d& xi);

/// Logarithm of SE(3), the inverse of ExpSe3 for rotations below pi.
/// @return  Twist [omega (rad); rho (m)], shape (6).
Vector6d LogSe3(const Eigen::Isometry3d& T);
/// The same for the motion with rotation R and translation t [m].
Vector6d LogSe3(const Eigen::Matrix3d& R, const Eigen::Vector3d& t);

/// Adjoint matrix: `T Exp(xi) T^-1 = Exp(Adjoint(T) xi)`, rotation first.
Matrix6d AdjointSe3(const Eigen::Isometry3d& T);

/// Right Jacobian: `Exp(xi + d) ~= Exp(xi) Exp(Jr(xi) d)`.
Matrix6d RightJacobianSe3(const Vector6d& xi);

/// Inverse of the right Jacobian: `Log(T Exp(d)) ~= Log(T) + JrInv(Log(T)) d`.
Matrix6d RightJacobianInverseSe3(const Vector6d& xi);

/// The same motion with its rotation made orthonormal again (through the unit quaternion).
Eigen::Isometry3d NormalizedSe3(const Eigen::Isometry3d& T);

/// Motion at a fraction of the way from `a` to `b`: rotation by slerp, translation linear.
/// @param fraction  0 gives a, 1 gives b; values outside extrapolate.
Eigen::Isometry3d InterpolateSe3(const Eigen::Isometry3d& a,
                                 const Eigen::Isometry3d& b,
                                 double fraction);

}  // namespace dendro
