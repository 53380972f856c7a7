#pragma once

#include <optional>
#include <vector>

#include <Eigen/Core>

#include "dendro_slam/geometry/cylinder.h"

/// The thesis' cylinder fit (section 4.3, after Marshall, Lukacs and Martin, "Robust segmentation of
/// primitives from range data in the presence of geometric degeneracy", 2001).
namespace dendro {

/// Marshall's approximate distance of a point (thesis eq. 4.2):
/// `kappa/2 (|p|^2 - 2 rho <p,n> - <p,a>^2 + rho^2) + rho - <p,n>`.
///
/// It equals `d + d^2 kappa / 2` for the exact distance d, so it is finite for kappa -> 0.
/// @param q  `[rho (m), phi, psi (rad), kappa (1/m), alpha (rad)]`: n = (cos phi cos psi, sin phi cos
///           psi, sin psi), and a turned by alpha about n from the direction of growing psi. The five
///           are free, n and a always orthonormal; at phi = psi = alpha = 0, n is x and a is z.
/// @param p  Point [m], in a frame whose origin is outside the cylinder.
/// @param jacobian  Receives d residual / d q when not null.
/// @note Deviates: the thesis' equation lacks `+ rho`, without which a perfect cylinder 4 m away has a
///       residual of 4 m.
double MarshallResidual(const Vector5d& q, const Eigen::Vector3d& p, Vector5d* jacobian);

/// Least squares of MarshallResidual with Ceres' Levenberg-Marquardt.
/// @param points   At least 5, finite [m].
/// @param origin   A place that sees the cylinder from outside, the sensor [m].
/// @param initial  Start; its axis line must not pass through the origin.
/// @return Nothing when it does not converge to a finite cylinder of positive curvature.
std::optional<Cylinder> FitMarshall(const std::vector<Eigen::Vector3d>& points,
                                    const Eigen::Vector3d& origin,
                                    const Cylinder& initial);

}  // namespace dendro
