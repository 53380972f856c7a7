#pragma once

#include <Eigen/Core>

#include "dendro_slam/geometry/se3.h"

/// What a lidar beam of finite width reports of a cone: the residuals of stage 3's final estimator.
namespace dendro {

/// A cone, `radius(s) = radius + slope * s` at arc length s along the axis from the anchor.
///
/// Tangent space (6): `[alpha (2, rad); beta (2, m); radius (m); slope (m/m)]`, alpha and beta as in
/// Cylinder.
struct Cone {
  Eigen::Vector3d axis = Eigen::Vector3d::UnitZ();  ///< Unit direction.
  Eigen::Vector3d point = Eigen::Vector3d::Zero();  ///< Anchor on the axis [m].
  double radius = 0.1;                              ///< At the anchor [m], > 0.
  double slope = 0.0;                               ///< dr/ds [m/m].

  /// The cone moved by a tangent vector.
  Cone Retract(const Vector6d& delta) const;
};

/// A cone whose axis is a parabola: at arc length s from the anchor it runs through
/// `point + s axis + s^2/2 bend` along `axis + s bend`.
///
/// Tangent space (8): that of Cone, then `[bend (2, 1/m)]` in the same basis across the axis.
struct BentCone {
  Cone middle;                                     ///< The cone that touches it at the anchor.
  Eigen::Vector3d bend = Eigen::Vector3d::Zero();  ///< Second derivative of the axis [1/m].

  using Tangent = Eigen::Matrix<double, 8, 1>;
  /// Derivative of a touching cone's tangent vector by the bent cone's.
  using TouchJacobian = Eigen::Matrix<double, 6, 8>;

  /// The straight cone that touches it at station s [m].
  Cone Touching(double s, TouchJacobian* jacobian = nullptr) const;
  /// Station where a beam passes the axis of the middle [m]; 0 for a beam along it.
  double StationOf(const Eigen::Vector3d& origin, const Eigen::Vector3d& direction) const;
  BentCone Retract(const Tangent& delta) const;
};

/// A beam's cross-section as one cone sees it: the beam is a rectangle of even energy, of which only
/// the projection on the direction across the axis matters to first order. That projection is a
/// trapezoid: flat to |half_width - half_slope|, zero beyond half_width + half_slope.
struct Footprint {
  double half_width_m = 0.0;  ///< Half-extent across the axis of the longer projected side [m].
  double half_slope_m = 0.0;  ///< The same of the shorter one [m]; both 0 is a thin ray.
  double skew = 0.0;          ///< Range gained per metre across, from a rectangle that is oblique to
                              ///< an axis that is oblique to the beam.
  double reach() const { return half_width_m + half_slope_m; }
};

/// Footprint of a rectangular beam on a cone.
/// @param axis, direction    Unit vectors of the cone and of the beam.
/// @param spin_axis          Unit vector the lidar turns about: "horizontal" is across it.
/// @param half_horizontal_m  Half-width of the beam at the surface [m].
/// @param half_vertical_m    Half-height of the beam at the surface [m].
Footprint FootprintOnCone(const Eigen::Vector3d& axis,
                          const Eigen::Vector3d& direction,
                          const Eigen::Vector3d& spin_axis,
                          double half_horizontal_m,
                          double half_vertical_m);

/// A beam in the coordinates of a cone, with derivatives in its tangent space.
struct BeamOnCone {
  bool valid = false;      ///< False when parallel to the axis or beyond the apex.
  double offset = 0.0;     ///< Impact parameter y: signed distance of the beam's line from the axis [m].
  double silhouette = 0.0; ///< |y| at which a ray grazes the cone, at this beam's station [m].
  double mid_range = 0.0;  ///< Range of the grazing ray [m].
  double sin_angle = 1.0;  ///< sqrt(A) of the ray-cone quadratic; the sine of beam and axis if slope 0.
  Vector6d d_offset = Vector6d::Zero();
  Vector6d d_silhouette = Vector6d::Zero();
  Vector6d d_mid_range = Vector6d::Zero();
  Vector6d d_sin_angle = Vector6d::Zero();
};

/// Solves the ray-cone quadratic `A t^2 + 2 B t + C = 0` symbolically in the impact parameter: a ray
/// of the beam at offset y is met at `mid_range - sqrt(silhouette^2 - y^2) / sin_angle`.
BeamOnCone LocateBeam(const Cone& cone,
                      const Eigen::Vector3d& origin,
                      const Eigen::Vector3d& direction);

/// Mean range over the part of the footprint that meets the cone, each part weighted by the energy
/// that it sends back: a diffuse surface returns the cosine of its incidence. So the limb, which is
/// met at a grazing angle, counts little.
struct RangePrediction {
  double range = 0.0;   ///< [m]
  double energy = 0.0;  ///< Relative to the whole beam on the same surface head-on, in [0, 1].
  Vector6d jacobian = Vector6d::Zero();  ///< d range / d tangent.
};
RangePrediction PredictRange(const BeamOnCone& beam, const Footprint& footprint);

/// Largest |offset| at which a beam still reports a cone: at least `share` of the footprint meets it,
/// and it sends back more than a surface behind it that gets the rest of the beam.
/// @param sin_angle     Of beam and axis (BeamOnCone::sin_angle).
/// @param competing     Energy of the whole beam on the surface behind, relative to the whole beam
///                      on the cone head-on; 0 where there is nothing behind.
/// @param d_silhouette  Receives the derivative by the silhouette when not null.
/// @return [m]; 0 when even a centred beam does not report it.
double DetectionOffset(double silhouette,
                       double sin_angle,
                       const Footprint& footprint,
                       double share,
                       double competing,
                       double* d_silhouette = nullptr);

}  // namespace dendro
