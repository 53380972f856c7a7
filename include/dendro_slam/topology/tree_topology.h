#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <optional>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "dendro_slam/mapping/ground_surface.h"
#include "dendro_slam/mapping/landmark.h"
#include "dendro_slam/mapping/tree_model.h"
#include "dendro_slam/topology/dendrometry.h"

namespace dendro {

/// Parameters of the step from landmarks to branches and trees.
struct TopologyConfig {
  double max_section_length_m = 0.25;  ///< Length of the map's cylinders [m]. > 0.
  double min_section_length_m = 0.1;   ///< A shorter rest at an end joins its neighbour [m]. >= 0.
  double join_gap_m = 1.0;            ///< Longest unseen gap that one branch may bridge [m]. >= 0.
  double join_angle_deg = 30.0;       ///< Largest bend between two pieces of one branch [deg].
  double join_elbow_deg = 60.0;       ///< The same where they meet and are equally thick [deg].
  double join_offset_m = 0.09;        ///< Sideways miss allowed beside radius and bend [m]. >= 0.
  double join_radius_ratio = 1.8;     ///< Largest step of the radius at a joint. > 1.
  double attach_reach_m = 1.0;       ///< Farthest from a parent's surface a base may end [m]. >= 0.
  double attach_offset_m = 0.08;     ///< Sideways miss of the parent's surface allowed [m]. >= 0.
  double min_gap_m = 0.05;           ///< Shorter gaps are closed without a cylinder [m]. >= 0.
  double max_trunk_lean_deg = 50.0;  ///< A root that leans more is no trunk [deg].
  double min_trunk_radius_m = 0.03;  ///< A thinner root is no trunk [m]. > 0.
  double max_trunk_base_m =
      2.5;                       ///< A root that begins this much above the lowest is no trunk [m].
  double breast_height_m = 1.3;  ///< Above the tree's base [m]. > 0.
  double min_volume_radius_m = 0.025;  ///< Thinner wood is left out of the volumes [m]. >= 0.

  /// @throws std::invalid_argument naming the field that is out of range.
  void Validate() const;

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("max_section_length_m", max_section_length_m);
    v("min_section_length_m", min_section_length_m);
    v("join_gap_m", join_gap_m);
    v("join_angle_deg", join_angle_deg);
    v("join_elbow_deg", join_elbow_deg);
    v("join_offset_m", join_offset_m);
    v("join_radius_ratio", join_radius_ratio);
    v("attach_reach_m", attach_reach_m);
    v("attach_offset_m", attach_offset_m);
    v("min_gap_m", min_gap_m);
    v("max_trunk_lean_deg", max_trunk_lean_deg);
    v("min_trunk_radius_m", min_trunk_radius_m);
    v("max_trunk_base_m", max_trunk_base_m);
    v("breast_height_m", breast_height_m);
    v("min_volume_radius_m", min_volume_radius_m);
  }
};

/// What keeps the ids of a map in place from one update to the next and over save and load.
struct TopologyState {
  /// A cylinder's place and its id.
  struct Section {
    int id = 0;
    int index = 0;       ///< Cell along the landmark from its origin, or part of the bridge.
    int branch_id = -1;  ///< Branch it was on when last seen.
    Eigen::Vector3d middle = Eigen::Vector3d::Zero();  ///< Where it was last seen [m], map frame.
  };
  /// Where the cells of a landmark are counted from, and which way.
  struct Origin {
    Eigen::Vector3d point = Eigen::Vector3d::Zero();      ///< [m], map frame.
    Eigen::Vector3d direction = Eigen::Vector3d::UnitZ();
  };
  std::map<int, int> branch_of_landmark;  ///< Landmark id to branch id.
  std::map<int, int> tree_of_branch;      ///< Trunk's branch id to tree id.
  /// Sections of a landmark (id, id), of the gap between two (lower id, higher id), or of the
  /// stretch between a landmark and its parent's axis (id, -1).
  std::map<std::pair<int, int>, std::vector<Section>> sections;
  std::map<int, Origin> origins;  ///< By landmark id.
  int next_branch_id = 0;
  int next_tree_id = 0;
  int next_cylinder_id = 0;
};

/// Height of the ground at a place (x, y) of the map [m], as GroundSurface::At gives it.
using GroundLookup = std::function<std::optional<GroundLevel>(const Eigen::Vector2d&)>;

/// From landmarks to branches to trees.
///
/// Landmarks that continue each other become one branch (a gap between them is bridged by INFERRED
/// cylinders); every branch looks for the branch it leaves by running its own axis backwards onto
/// the other's surface; the cheapest consistent set of such attachments, with a cost for every
/// branch that stays a root, is the minimum spanning arborescence (Chu and Liu 1965, Edmonds 1967).
/// The trunk of a tree is the root that this leaves: steep, thick and low wood is cheap as a root,
/// anything else is dear. Pieces that reach nothing keep tree_id -1.
///
/// Ids are stable: a landmark stays with its branch, a branch with its tree. Cylinders are cut at
/// places that do not move: every `max_section_length_m` along a landmark from where it was first
/// seen, whatever its ends and its radius profile do later; a cylinder's id belongs to that place,
/// and another landmark that takes the place over on the same branch takes the id over. Cost: quadratic in the number of landmarks with a small constant; not thread-safe.
///
/// @note Deviates: the thesis stops at single cylinders and has no topology.
class TreeTopology {
 public:
  /// @throws std::invalid_argument naming a field that is out of range.
  explicit TreeTopology(const TopologyConfig& config);

  /// Builds the model of the confirmed landmarks; the others are left out.
  /// @param landmarks  In the map frame (z up); in any order, ids unique.
  /// @param stamp_ns   Copied to the model.
  /// @param ground     Height of the ground at a place (x, y) of the map, where it is known: trees then
  ///                   stand on it instead of on the lowest wood seen. May be empty.
  /// @return Cylinders, branches and trees, each sorted by id; branches from base to tip.
  /// @throws std::invalid_argument for landmarks with numbers that are not finite or ids that
  /// repeat.
  TreeModel Build(const std::vector<Landmark>& landmarks,
                  std::int64_t stamp_ns,
                  const GroundLookup& ground = nullptr);

  const TopologyConfig& config() const { return config_; }
  const TopologyState& state() const { return state_; }
  /// Takes up the ids of a saved map.
  void Restore(const TopologyState& state) { state_ = state; }
  /// Forgets all ids.
  void Reset() { state_ = TopologyState(); }

 private:
  TopologyConfig config_;
  TopologyState state_;
};

}  // namespace dendro
