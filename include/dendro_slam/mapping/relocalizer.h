#pragma once

#include <optional>
#include <utility>
#include <vector>

#include "dendro_slam/geometry/se3.h"
#include "dendro_slam/mapping/landmark.h"

namespace dendro {

/// Tolerances of Relocalize.
struct RelocalizerConfig {
  double axis_deg = 6.0;       ///< Between axes of one cylinder in the two maps [deg].
  double offset_m = 0.15;      ///< Between their lines [m].
  double radius_ratio = 1.35;  ///< Between their radii. > 1.
  int min_matches = 3;         ///< Cylinders that must agree.
  double min_share = 0.6;      ///< And this share of the local cylinders.
  bool upright = false;        ///< Both maps have z up ...
  double tilt_deg = 10.0;      ///< ... to within this [deg].
  /// The ground in both maps, as z over x and y (z, dz/dx, dz/dy), where both know it: it must agree
  /// below the cylinders to within `ground_m`.
  std::optional<Eigen::Vector3d> local_ground, loaded_ground;
  double ground_m = 0.25;      ///< [m].
  /// Two cylinders that agree are enough in an upright map on known ground, when they agree this many
  /// times better than the tolerances and nothing else agrees at all. 0: never.
  double two_matches_margin = 1.5;
};

/// Where a local map lies in a loaded one.
struct Relocalization {
  Eigen::Isometry3d T_map_local = Eigen::Isometry3d::Identity();
  std::vector<std::pair<int, int>> matches;  ///< Landmark ids (local, loaded).
  double cost = 0.0;           ///< Sum of squared differences in tolerances.
};

/// Finds a map in another one by its cylinders, from any start pose.
///
/// Every pair of local cylinders that are not parallel is laid on every pair of loaded ones with the
/// same angle, distance and radii: two lines fix a rigid motion up to their directions. The motion
/// under which most cylinders agree in line, extent and radius wins; it is then refined on all of
/// them by least squares. Nothing is returned when too few agree or when another place fits as well.
/// A trunk and one branch fix the motion too; gravity and the ground then have to confirm it.
std::optional<Relocalization> Relocalize(const std::vector<Landmark>& local,
                                         const std::vector<Landmark>& loaded,
                                         const RelocalizerConfig& config);

}  // namespace dendro
