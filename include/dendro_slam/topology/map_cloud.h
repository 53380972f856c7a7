#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "dendro_slam/mapping/tree_model.h"
#include "dendro_slam/odometry/relative_motion.h"
#include "dendro_slam/range_image/range_image.h"

namespace dendro {

/// Settings of MapCloud.
struct MapCloudConfig {
  bool enabled = false;         ///< Gather the wood and leaf returns of all scans. Costs memory.
  double wood_voxel_m = 0.02;   ///< One wood point is kept per cube of this edge [m]. > 0.
  double leaf_voxel_m = 0.1;    ///< One leaf point is kept per cube of this edge [m]. > 0.
  double max_range_m = 15.0;    ///< Returns from farther away are left out [m]. > 0.
  int max_points = 1000000;     ///< Of each class; beyond it the cubes' edges double. >= 1000.
  double wood_reach_m = 0.06;   ///< A wood point farther from every surface has no branch [m]. > 0.
  double leaf_reach_m = 1.0;    ///< A leaf point farther from all wood belongs to no tree [m]. > 0.
  double crown_alpha_m = 0.5;   ///< Radius of the alpha shape of a crown [m]. > 0.

  /// @throws std::invalid_argument naming the field that is out of range.
  void Validate() const;

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("enabled", enabled);
    v("wood_voxel_m", wood_voxel_m);
    v("leaf_voxel_m", leaf_voxel_m);
    v("max_range_m", max_range_m);
    v("max_points", max_points);
    v("wood_reach_m", wood_reach_m);
    v("leaf_reach_m", leaf_reach_m);
    v("crown_alpha_m", crown_alpha_m);
  }
};

/// A return that the map keeps.
struct CloudPoint {
  Eigen::Vector3d position = Eigen::Vector3d::Zero();  ///< [m], map frame.
  Label label = Label::kWood;                          ///< kWood or kLeaf.
  int tree_id = -1;                                    ///< -1: near no tree's wood.
  int branch_id = -1;                                  ///< -1: leaves, and wood on no branch.
};

/// The wood and leaf returns of all scans, thinned to one per voxel.
///
/// What is kept is the return in its own scan's frame with the scan's number: the cloud follows the
/// graph when poses are corrected later. The voxel is the one of the pose known when the scan came,
/// and keeps its first return. Memory is bounded by `max_points` per class (32 bytes each, hash
/// table included) and 8 bytes per scan: a full grid is thinned to twice the edge length.
///
/// Cost: one hash look-up per wood or leaf return. Same input, same points.
class MapCloud {
 public:
  /// @throws std::invalid_argument naming a field that is out of range.
  explicit MapCloud(const MapCloudConfig& config);

  /// Takes the wood and leaf returns of one scan.
  /// @param T_map_lidar  Pose of the scan as it is known now.
  void Add(const LabelledScan& scan, const Eigen::Isometry3d& T_map_lidar);

  /// The points in the map frame, wood first, each class in the order of its arrival.
  /// @param trajectory  Poses of the scans as they are known now, ascending stamps. A point whose
  ///                    scan is not among them is left out.
  std::vector<CloudPoint> Points(const std::vector<StampedPose>& trajectory) const;

  /// Starts with the points of a saved map; they stay where they are.
  void Restore(const std::vector<CloudPoint>& points);
  void Reset();

  std::size_t size() const { return wood_.entries.size() + leaf_.entries.size(); }

 private:
  struct Entry {
    std::uint64_t key;       ///< Voxel, 21 bits an axis.
    Eigen::Vector3f point;   ///< In the lidar frame of scan `scan`, or of the map for -1 [m].
    std::int32_t scan;       ///< Index into stamps_ns_, or -1.
  };
  struct Grid {
    double voxel_m = 0.0;
    std::vector<Entry> entries;
    std::vector<std::int32_t> slots;  ///< Open addressing: index into `entries`, or -1.
  };

  void Insert(const Eigen::Vector3d& p_map, const Eigen::Vector3f& point, int scan, Grid* grid);
  void Coarsen(Grid* grid) const;

  MapCloudConfig config_;
  Grid wood_, leaf_;
  std::vector<std::int64_t> stamps_ns_;
};

/// Gives every point the tree and branch that it lies on: wood the branch whose surface is nearest,
/// if it is within `wood_reach_m`; leaves the tree whose wood is nearest, within `leaf_reach_m`.
void AssignPoints(const TreeModel& model,
                  double wood_reach_m,
                  double leaf_reach_m,
                  std::vector<CloudPoint>* points);

}  // namespace dendro
