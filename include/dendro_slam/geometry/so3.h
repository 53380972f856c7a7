#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

/// Rotations: exponential map, logarithm and right Jacobians of SO(3).
///
/// Conventions of the whole project: right perturbation `R * Exp(omega)`, Hamilton quaternions.
/// Reference: Sola et al., "A micro Lie theory for state estimation in robotics", 2018.
namespace dendro {

/// The 3x3 matrix `[w]x` with `[w]x v = w.cross(v)`.
Eigen::Matrix3d Skew(const Eigen::Vector3d& w);

/// Exponential map of SO(3) (Rodrigues).
/// @param omega  Rotation vector [rad], shape (3).
/// @return       Rotation matrix; the identity for omega = 0.
Eigen::Matrix3d ExpSo3(const Eigen::Vector3d& omega);

/// Logarithm of SO(3), the inverse of ExpSo3 on |omega| <= pi.
/// @param R  Rotation matrix.
/// @return   Rotation vector [rad], norm at most pi. Accurate near 0 and near pi.
Eigen::Vector3d LogSo3(const Eigen::Matrix3d& R);

/// Right Jacobian: `Exp(omega + d) ~= Exp(omega) Exp(Jr(omega) d)` (Sola et al., eq. 143).
Eigen::Matrix3d RightJacobianSo3(const Eigen::Vector3d& omega);

/// Inverse of the right Jacobian (Sola et al., eq. 144).
Eigen::Matrix3d RightJacobianInverseSo3(const Eigen::Vector3d& omega);

}  // namespace dendro
