#pragma once

#include <memory>
#include <optional>
#include <vector>

#include "dendro_slam/geometry/se3.h"

namespace dendro {

/// Settings of ScanToMap.
struct ScanToMapConfig {
  double voxel_m = 0.35;          ///< Cell of the local map; a neighbourhood reaches as far, or twice
                                  ///< as far where the map is sparse [m]. > 0.
  double point_spacing_m = 0.03;  ///< Points of the map in one cell are no closer than this [m]. > 0.
  int max_points_per_voxel = 40;  ///< Further points in a cell are left out. >= neighbours.
  int neighbours = 10;            ///< Points of the map that give a return its surface. >= 5.
  double max_surface_rms_m = 0.02;  ///< Neighbours scattered more than this about their plane are
                                    ///< foliage or an edge: not used [m]. > 0.
  double noise_sigma_m = 0.015;   ///< Standard deviation of a return across its surface [m]. > 0.
  double max_distance_m = 0.4;    ///< A return farther from its surface is no match [m]. > 0.
  double correlation_points = 4.0;  ///< Neighbouring returns whose errors act as one. >= 1.
  int min_matches = 100;          ///< Fewer matched returns: no pose. >= 10.
  int max_iterations = 20;        ///< Gauss-Newton iterations. > 0.
  double converged_rad = 2e-5;    ///< Step below which the pose has settled [rad]. > 0.
  double converged_m = 1e-4;      ///< Step below which the pose has settled [m]. > 0.
  double max_range_m = 60.0;      ///< The map forgets what is farther from the sensor [m]. > 0.

  /// @throws std::invalid_argument naming the field.
  void Validate() const;
};

/// Pose of a scan in the local map.
struct MapRegistration {
  Eigen::Isometry3d T_map_scan = Eigen::Isometry3d::Identity();
  Matrix6d information = Matrix6d::Zero();  ///< Of the right tangent [omega; rho]; singular along
                                            ///< motions that the surfaces do not tell.
  int matches = 0;        ///< Returns on a known surface.
  double rms_m = 0.0;     ///< Their distances from it.
};

/// Registers scans against the local map that the scans before them have left: point to plane, the
/// plane from a return's nearest neighbours in the map.
///
/// Used where the trajectory itself is wanted as well as the data allow and time is at hand (rig
/// calibration). WoodIcp serves the live pipeline: it compares two scans only, on wood, in a few
/// milliseconds, and so its steps add up their errors like a random walk of half a centimetre; a map
/// of many scans gives surfaces on which the VLP-16's rings lie close together, and poses that do not
/// drift while the surroundings stay in sight. A scan costs some 20 ms. Deterministic; not thread-safe.
class ScanToMap {
 public:
  /// @throws std::invalid_argument for a bad configuration.
  explicit ScanToMap(const ScanToMapConfig& config = ScanToMapConfig());
  ~ScanToMap();
  ScanToMap(ScanToMap&&) noexcept;
  ScanToMap& operator=(ScanToMap&&) noexcept;

  /// True before the first scan was added.
  bool empty() const;

  /// Finds the pose of a scan; the map stays as it is.
  /// @param points            Returns free of the sweep's motion, in one lidar frame [m].
  /// @param T_map_scan_guess  From a few degrees and decimetres away.
  /// @return  Nothing when too few returns lie on surfaces of the map.
  std::optional<MapRegistration> Register(const std::vector<Eigen::Vector3f>& points,
                                          const Eigen::Isometry3d& T_map_scan_guess) const;

  /// Adds a scan's returns to the map.
  void Add(const std::vector<Eigen::Vector3f>& points, const Eigen::Isometry3d& T_map_scan);

 private:
  struct State;
  std::unique_ptr<State> state_;
};

}  // namespace dendro
