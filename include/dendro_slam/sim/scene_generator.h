#pragma once

#include <cstdint>
#include <string>

#include "dendro_slam/sim/scene.h"

namespace dendro {

/// Botanical parameters of a generated tree. Ratios and angles vary around the given values.
struct TreeGeneratorConfig {
  std::string form = "excurrent";  ///< excurrent (one leader), decurrent (forks), columnar (few stout arms).
  double height_m = 8.0;           ///< Of the tip of the leader [m].
  double dbh_m = 0.25;             ///< Diameter of the trunk at 1.3 m [m].
  double crown_base_ratio = 0.3;   ///< Height of the lowest branch / height.
  int num_branches = 8;            ///< First-order branches.
  int max_order = 2;               ///< 0 trunk only, up to 3.
  int children_per_branch = 3;     ///< Branches of the next order on each branch.
  double branch_angle_deg = 55.0;  ///< Mean angle to the parent's axis [deg].
  double branch_length_ratio = 0.4;  ///< Longest first-order branch / height.
  double taper = 0.8;              ///< Tip radius = (1 - taper) * base radius, in [0, 0.98].
  double sweep = 0.06;             ///< Sideways curve of the trunk / height.
  double lean_deg = 2.0;           ///< Lean of the trunk [deg].
  double gravitropism = 0.25;      ///< How much branches turn upwards (negative: hang) over their length.
  int num_forks = 1;               ///< Forks of the leader (decurrent only).
  double pipe_exponent = 2.3;      ///< r_parent^e = sum r_child^e (Leonardo's rule has 2).
  double min_radius_m = 0.004;     ///< Thinner wood is not made [m].
  double dead_twig_ratio = 0.1;    ///< Part of the branches of the highest order that are dead stubs.
  int leaf_count = 0;
  double leaf_size_m = 0.06;       ///< Diameter [m].
  double segment_length_m = 0.4;   ///< Mean distance between two points of a branch [m].

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("form", form);
    v("height_m", height_m);
    v("dbh_m", dbh_m);
    v("crown_base_ratio", crown_base_ratio);
    v("num_branches", num_branches);
    v("max_order", max_order);
    v("children_per_branch", children_per_branch);
    v("branch_angle_deg", branch_angle_deg);
    v("branch_length_ratio", branch_length_ratio);
    v("taper", taper);
    v("sweep", sweep);
    v("lean_deg", lean_deg);
    v("gravitropism", gravitropism);
    v("num_forks", num_forks);
    v("pipe_exponent", pipe_exponent);
    v("min_radius_m", min_radius_m);
    v("dead_twig_ratio", dead_twig_ratio);
    v("leaf_count", leaf_count);
    v("leaf_size_m", leaf_size_m);
    v("segment_length_m", segment_length_m);
  }

  /// @throws std::invalid_argument  Naming the field.
  void Validate() const;
};

/// A tree with its base at `base`, a deterministic function of the parameters and the seed. The trunk
/// is branch 0; parents come before their children.
/// @throws std::invalid_argument  From TreeGeneratorConfig::Validate.
SceneTree GenerateTree(const TreeGeneratorConfig& config,
                       const Eigen::Vector3d& base,
                       std::uint64_t seed);

/// Parameters drawn at random: forms, sizes, orders and leaves of a wide range of trees.
TreeGeneratorConfig RandomTreeConfig(std::uint64_t seed);

/// Parameters of a generated scene.
struct SceneGeneratorConfig {
  int num_trees = 1;
  double area_m = 12.0;            ///< Trees stand in a square of this side around the origin [m].
  double min_spacing_m = 3.0;      ///< Between two trunks [m].
  double leaf_probability = 0.5;   ///< Of a tree to be in leaf (random trees only).
  int num_obstacles = 3;           ///< Boxes: walls, posts, crates.
  int num_rocks = 4;               ///< Low boxes on the ground.
  int num_grass_tufts = 0;         ///< Tufts of blades, as leaves without wood.
  bool rough_ground = true;

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("num_trees", num_trees);
    v("area_m", area_m);
    v("min_spacing_m", min_spacing_m);
    v("leaf_probability", leaf_probability);
    v("num_obstacles", num_obstacles);
    v("num_rocks", num_rocks);
    v("num_grass_tufts", num_grass_tufts);
    v("rough_ground", rough_ground);
  }

  /// @throws std::invalid_argument  Naming the field.
  void Validate() const;
};

/// A scene with random trees (RandomTreeConfig), obstacles and ground: any number of different scenes
/// for training and tests.
Scene GenerateScene(const SceneGeneratorConfig& config, std::uint64_t seed);

}  // namespace dendro
