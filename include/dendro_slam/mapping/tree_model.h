#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "dendro_slam/cylinder_fitting/fitted_cylinder.h"

/// The map as people and files see it: cylinders joined into branches and trees. Units are SI, the
/// frame is `map`. One id names a branch (and a cylinder) in every file, topic and picture.
namespace dendro {

/// One cylinder (frustum) of the map, base to tip.
struct MapCylinder {
  int id = 0;                          ///< From 0, stable over the life of the map.
  int landmark_id = -1;                ///< Landmark of the factor graph it was cut from; -1 inferred.
  int tree_id = -1;                    ///< -1: could not be attached to a tree.
  int branch_id = -1;
  int parent_id = -1;                  ///< Cylinder below it; -1 for a root.
  int branch_order = 0;                ///< 0 trunk.
  int position_in_branch = 0;          ///< From 0 at the branch's base.
  Eigen::Vector3d start = Eigen::Vector3d::Zero();  ///< Base end of the axis [m].
  Eigen::Vector3d end = Eigen::Vector3d::Zero();    ///< Tip end of the axis [m].
  double radius_m = 0.0;               ///< At the middle.
  double radius_sigma_m = 0.0;
  double taper_m_per_m = 0.0;          ///< dr/ds from base to tip (usually negative).
  double axis_sigma_rad = 0.0;
  double position_sigma_m = 0.0;       ///< Of the axis line at the middle, perpendicular to it.
  int num_scans = 0;
  int num_points = 0;
  double visible_arc_rad = 0.0;        ///< Angle around the axis seen over all scans.
  double mean_abs_deviation_m = 0.0;
  FitStatus status = FitStatus::kMeasured;

  Eigen::Vector3d Axis() const { return (end - start).normalized(); }
  double Length() const { return (end - start).norm(); }
};

/// A branch: a chain of cylinders from base to tip.
struct MapBranch {
  int id = 0;                          ///< Stable; 0 need not be the trunk.
  int tree_id = -1;
  int parent_id = -1;                  ///< Branch it leaves; -1 for a trunk or an unattached piece.
  int order = 0;                       ///< 0 trunk.
  std::vector<int> cylinder_ids;       ///< Base to tip.
  Eigen::Vector3d base = Eigen::Vector3d::Zero();
  Eigen::Vector3d tip = Eigen::Vector3d::Zero();
  double length_m = 0.0;
  double base_radius_m = 0.0, middle_radius_m = 0.0, tip_radius_m = 0.0;
  double base_radius_sigma_m = 0.0;
  double angle_rad = 0.0;              ///< To the parent's axis at the junction.
  double azimuth_rad = 0.0;            ///< Of the base direction, counter-clockwise from +x.
  double zenith_rad = 0.0;
  double height_m = 0.0;               ///< Of the base above the tree's base.
};

/// A crown as its leaf returns show it (MeasureCrown).
struct MapCrown {
  double volume_m3 = 0.0;              ///< Of the alpha shape.
  double projected_area_m2 = 0.0;      ///< Of the alpha shape seen from above.
  double hull_volume_m3 = 0.0;         ///< Of the convex hull.
  double hull_area_m2 = 0.0;           ///< Of the convex hull seen from above.
  double base_height_m = 0.0;          ///< Lowest leaves above the tree's base.
  double top_height_m = 0.0;           ///< Highest leaves above the tree's base.
  double alpha_m = 0.0;                ///< Radius of the alpha shape.
  int num_points = 0;                  ///< Leaf points, one per voxel.
};

/// A tree: a trunk and what is attached to it.
struct MapTree {
  int id = 0;
  int trunk_branch_id = -1;
  std::vector<int> branch_ids;
  Eigen::Vector3d base = Eigen::Vector3d::Zero();  ///< Trunk axis at the lowest point seen (or ground).
  double base_sigma_m = 0.0;           ///< Of the ground's height below it; 0 where the ground was not seen.
  double dbh_height_m = 1.3;
  std::optional<double> dbh_m;         ///< Diameter at breast height; absent when not seen.
  double dbh_sigma_m = 0.0;
  FitStatus dbh_status = FitStatus::kUnresolved;  ///< kInferred: between places that were seen.
  double height_m = 0.0;               ///< Highest wood seen above the base.
  int max_branch_order = 0;
  double stem_volume_m3 = 0.0;
  double wood_volume_m3 = 0.0;         ///< Above min_radius_m.
  double min_radius_m = 0.0;
  double volume_sigma_m3 = 0.0;
  double lean_rad = 0.0;
  double arc_coverage_rad = 0.0;
  int num_scans = 0;
  std::optional<MapCrown> crown;       ///< Absent without leaf returns (map_cloud/enabled).
};

/// Everything the map says at one time.
struct TreeModel {
  std::int64_t stamp_ns = 0;
  std::vector<MapCylinder> cylinders;
  std::vector<MapBranch> branches;
  std::vector<MapTree> trees;
};

}  // namespace dendro
