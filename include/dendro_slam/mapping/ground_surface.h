#pragma once

#include <map>
#include <optional>
#include <utility>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "dendro_slam/segmentation/ground_plane.h"

namespace dendro {

/// Height of the ground at a place of the map.
struct GroundLevel {
  double z_m = 0.0;      ///< Map frame.
  double sigma_m = 0.0;  ///< Standard deviation: how much the walk's planes disagree there.
};

/// What the scans taken in one cell of the walk say of the ground, for files.
struct GroundPatch {
  int count = 0;                                    ///< Scans. >= 1.
  Eigen::Vector2d foot = Eigen::Vector2d::Zero();   ///< Mean place of the lidar, x, y in the map frame [m].
  double z_m = 0.0;                                 ///< Mean height of their planes below them.
  Eigen::Vector2d slope = Eigen::Vector2d::Zero();  ///< Mean of dz/dx, dz/dy.
};

/// The ground below the trees as the scans of a walk showed it, so that every tree of a map stands on
/// its own: a plane per square metre of the carrier's way, the mean of the planes that the scans
/// taken there saw (FitGroundPlane). The height at a place is the mean of what the planes around it
/// say, the near ones first: the ground is a plane for a few metres only.
///
/// Cost: a look-up per scan, memory of 60 bytes per square metre walked. Same input, same bytes.
class GroundSurface {
 public:
  /// Takes the ground of one scan. Left out: planes that lean by more than 26 degrees in the map (a
  /// bank, or the map is not upright), and those seen from more than 5 m above (only far ground is).
  /// @param ground  In the lidar frame.
  void Add(const GroundPlane& ground, const Eigen::Isometry3d& T_map_lidar);

  /// @param place  x, y in the map frame [m].
  /// @return Nothing where fewer than ten scans were taken within 10 m.
  std::optional<GroundLevel> At(const Eigen::Vector2d& place) const;

  void Clear() { patches_.clear(); }

  /// Everything, to go on in a later session; by cell, ascending.
  std::vector<GroundPatch> Patches() const;
  /// Takes up what Patches() gave in place of what is here.
  void Restore(const std::vector<GroundPatch>& patches);

 private:
  /// Sums over the scans taken in one cell.
  struct Patch {
    int count = 0;
    Eigen::Vector2d foot = Eigen::Vector2d::Zero();   ///< Below the lidar.
    double z_m = 0.0;                                 ///< Of the plane there.
    Eigen::Vector2d slope = Eigen::Vector2d::Zero();  ///< dz/dx, dz/dy.
  };
  std::map<std::pair<int, int>, Patch> patches_;
};

}  // namespace dendro
