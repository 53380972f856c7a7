#pragma once

#include <bitset>
#include <cstdint>
#include <vector>

#include "dendro_slam/geometry/cylinder.h"

namespace dendro {

/// Radius of a landmark at one place along its axis, fed by the observations that cover it.
struct RadiusKnot {
  double s_m = 0.0;             ///< Along the landmark's axis from its anchor [m].
  double radius_m = 0.0;
  double radius_sigma_m = 0.0;  ///< Honest: errors common to scans from one side are kept.
  int num_scans = 0;            ///< Observations that covered this place.
  /// The bent axis beside the straight one, across it, in the landmark's frame [m].
  Eigen::Vector3d offset_m = Eigen::Vector3d::Zero();
};

/// One cylinder of the map: a line with an extent and a radius profile along it.
///
/// Curvature does not involve poses, so a taper costs nothing: the line is one variable of the
/// factor graph, the radius is a function along it. So is the course of a bent axis beside the line.
struct Landmark {
  static constexpr int kArcBins = 36;  ///< 10 degrees each around the axis.

  int id = 0;                           ///< Stable over the life of the map, never reused.
  Cylinder cylinder;                    ///< In the map frame; anchor near the middle of the extent.
  Matrix5d covariance = Matrix5d::Identity();  ///< Marginal, in the cylinder's tangent coordinates.
  double s_min_m = 0.0;                 ///< Lower end along the axis from the anchor [m].
  double s_max_m = 0.0;                 ///< Upper end along the axis from the anchor [m].
  double s_min_sigma_m = 0.0;
  double s_max_sigma_m = 0.0;
  std::vector<RadiusKnot> profile;      ///< Ascending in s; at least one knot.
  int num_scans = 0;                    ///< Scans that observed it.
  int num_points = 0;                   ///< Returns over all scans.
  std::bitset<kArcBins> arc_seen;       ///< Directions around the axis from which it was seen.
  double mean_abs_deviation_m = 0.0;    ///< Mean over its observations.
  bool confirmed = false;               ///< False: a candidate, not yet map.

  /// Radius at s by linear interpolation of the profile, constant beyond its ends [m].
  double RadiusAt(double s_m) const;
  /// Sigma of RadiusAt [m].
  double RadiusSigmaAt(double s_m) const;
  /// The axis at s, bends included [m].
  Eigen::Vector3d PointAt(double s_m) const;
  /// Its unit direction there, towards larger s.
  Eigen::Vector3d AxisAt(double s_m) const;
  /// The straight line with the least mean square distance from the axis between two places, its
  /// anchor in the middle between them. Curvature as `cylinder`.
  Cylinder LineOver(double s_begin_m, double s_end_m) const;
};

/// A landmark in another frame: `T_a_b * landmark_b`.
Landmark TransformLandmark(const Eigen::Isometry3d& T_a_b, const Landmark& landmark_b);

}  // namespace dendro
