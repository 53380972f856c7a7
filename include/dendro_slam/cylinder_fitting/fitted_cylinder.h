#pragma once

#include <cstdint>
#include <string>

#include "dendro_slam/geometry/cylinder.h"

namespace dendro {

enum class FitStatus : std::uint8_t { kMeasured = 0, kUnresolved = 1, kInferred = 2 };

/// Why a segment holds no radius. kNone for a measured cylinder.
enum class UnresolvedReason : std::uint8_t {
  kNone = 0,
  kTooFewPoints,
  kTooFewRings,
  kNonFinite,
  kArcTooSmall,        ///< Too little of the surface is seen, or neither of its sides.
  kNotACylinder,       ///< Residuals too large: a plane, a sphere, a clump of leaves.
  kRadiusOutOfRange,
  kUncertain,          ///< The covariance is too large to call it a measurement.
  kNotConverged,
};

/// "MEASURED", "UNRESOLVED", "INFERRED": the words of messages and tables.
const char* ToString(FitStatus status);
/// A short phrase for people, e.g. "too few rings".
const char* ToString(UnresolvedReason reason);

/// One cylinder of one scan: stage 3's result, in the lidar frame at the scan's stamp.
struct FittedCylinder {
  int segment_id = 0;
  FitStatus status = FitStatus::kUnresolved;
  UnresolvedReason reason = UnresolvedReason::kNone;
  Cylinder cylinder;               ///< Anchor at the middle of the observed stretch.
  Matrix5d covariance = Matrix5d::Zero();  ///< Of the cylinder's 5 tangent coordinates, calibrated.
  double taper_m_per_m = 0.0;      ///< dr/ds along `cylinder.axis`.
  double taper_sigma_m_per_m = 0.0;
  bool taper_estimated = false;    ///< False: the segment is too short to show it; taper is 0.
  /// What the returns say of the axis' second derivative b [1/m] in PerpendicularBasis(axis): a
  /// gaussian in natural parameters, N(J^-1 h, J^-1), without any prior; zero where they say nothing.
  /// `cylinder` is the straight line with the least mean square distance from the bent axis.
  Eigen::Matrix2d bend_information = Eigen::Matrix2d::Zero();  ///< J [m^2].
  Eigen::Vector2d bend_vector = Eigen::Vector2d::Zero();       ///< h [m].
  double start_s_m = 0.0;          ///< Lower end of the inliers along the axis from the anchor [m].
  double end_s_m = 0.0;            ///< Upper end of the inliers along the axis from the anchor [m].
  double end_sigma_m = 0.0;        ///< What the ring spacing leaves unknown of either end [m].
  int num_points = 0;              ///< Inlier returns.
  int num_rings = 0;               ///< Rings with an inlier.
  double distance_m = 0.0;         ///< Sensor to anchor.
  double visible_arc_rad = 0.0;    ///< Angle of surface around the axis that holds returns.
  double mean_abs_deviation_m = 0.0;  ///< Mean absolute range residual of the inliers.

  /// Standard deviation of the radius [m]: sigma_kappa * r^2.
  double radius_sigma_m() const;
};

}  // namespace dendro
