#pragma once

#include <cstdint>
#include <optional>
#include <unordered_map>
#include <vector>

#include "dendro_slam/mapping/bend_profile.h"
#include "dendro_slam/mapping/data_association.h"
#include "dendro_slam/mapping/landmark.h"
#include "dendro_slam/mapping/radius_profile.h"

namespace dendro {

/// Settings of TreeMap.
struct TreeMapConfig {
  int confirm_scans = 8;             ///< A candidate becomes map when this many scans saw it. >= 1.
  double confirm_ratio = 0.3;        ///< And this share of the scans from its first to its last. In [0, 1].
  int confirm_scans_around = 20;     ///< Or it was seen by this many scans, however many did not, >= 1,
  double confirm_arc_deg = 240.0;    ///< and from so many sides: a thin branch is measured by few of the
                                     ///< scans, a clump of twigs looks different from each side [deg]. >= 0.
  double confirm_radius_sigma_rel = 0.35;  ///< And its radius is known to this part of it. > 0.
  double confirm_radius_sigma_m = 0.004;   ///< Or to this: a twig is known by where it is [m]. >= 0.
  int candidate_max_gap_scans = 300; ///< A candidate not seen for longer is dropped. >= 1.
  int candidate_gap_per_scan = 100;  ///< And one not seen for longer than this for every scan that saw it:
                                     ///< most are fits that never come again. >= 1.
  double max_length_m = 2.0;         ///< A landmark is not extended beyond this: trunks and branches bend,
                                     ///< and are mapped as a chain of straight pieces [m]. > 0.
  double bend_sigma_per_m = 0.15;    ///< Prior of a landmark's bend (second derivative of its axis), in
                                     ///< each direction [1/m]. > 0.
  double coverage_cell_m = 0.05;     ///< Resolution of the extents [m]. > 0.
  double end_support = 0.15;         ///< An end lies where the coverage falls below this share of
                                     ///< the scans that cover the densest part. In (0, 1].
  double min_gap_m = 0.15;           ///< A gap shorter than this does not split a landmark [m]. > 0.
  double gap_support = 0.05;         ///< A gap is where fewer than this share of the scans on both of its
                                     ///< sides saw wood. In [0, 1).
  int gap_min_scans = 20;            ///< And both sides were covered by this many scans. >= 1.
  double merge_gate_sigma = 3.0;     ///< Duplicates: gate on the lines' difference. > 0.
  double merge_min_overlap = -0.1;   ///< Duplicates overlap by at least this [m]; below 0 a gap.
  double merge_reach_m = 1.0;        ///< Middles farther apart along the axis are two pieces of one bent
                                     ///< branch, not duplicates [m]. > 0.
  double merge_inside_overlap = 0.4; ///< Branches that run inside each other over this share of the
                                     ///< shorter one are one, whatever their sigmas say. > 0.
  double merge_inside_angle_deg = 12.0;  ///< With axes at most this far apart [deg]. In [0, 90).
  double merge_inside_radii = 0.8;   ///< And lines at most this many radii of the thicker one apart. >= 0.
  double merge_inside_m = 0.025;     ///< Or this far: the map is not better than that, and twigs do not run
                                     ///< side by side so closely [m]. >= 0.

  /// @throws std::invalid_argument naming the field.
  void Validate() const;

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("confirm_scans", confirm_scans);
    v("confirm_ratio", confirm_ratio);
    v("confirm_scans_around", confirm_scans_around);
    v("confirm_arc_deg", confirm_arc_deg);
    v("confirm_radius_sigma_rel", confirm_radius_sigma_rel);
    v("confirm_radius_sigma_m", confirm_radius_sigma_m);
    v("candidate_max_gap_scans", candidate_max_gap_scans);
    v("candidate_gap_per_scan", candidate_gap_per_scan);
    v("max_length_m", max_length_m);
    v("bend_sigma_per_m", bend_sigma_per_m);
    v("coverage_cell_m", coverage_cell_m);
    v("end_support", end_support);
    v("min_gap_m", min_gap_m);
    v("gap_support", gap_support);
    v("gap_min_scans", gap_min_scans);
    v("merge_gate_sigma", merge_gate_sigma);
    v("merge_min_overlap", merge_min_overlap);
    v("merge_reach_m", merge_reach_m);
    v("merge_inside_overlap", merge_inside_overlap);
    v("merge_inside_angle_deg", merge_inside_angle_deg);
    v("merge_inside_radii", merge_inside_radii);
    v("merge_inside_m", merge_inside_m);
  }
};

/// Everything the map keeps of one landmark beside its graph variable. Plain data, for files.
struct LandmarkState {
  int id = 0;
  /// The graph's variable: its anchor is the zero of every s. Where the axis is bent, the line that
  /// touches it there.
  Cylinder line;
  Matrix5d covariance = Matrix5d::Identity();  ///< Marginal of `line`.
  RadiusProfile profile;
  BendProfile bend;
  int first_cell = 0;                ///< Index of coverage.front(); a cell k spans [k, k+1) * cell size.
  std::vector<int> coverage;         ///< Scans that saw wood in the cell.
  double end_sigma_m = 0.05;         ///< Ring spacing leaves this unknown of an end; mean over the scans.
  int num_scans = 0;
  int num_points = 0;
  std::bitset<Landmark::kArcBins> arc_seen;
  double deviation_sum_m = 0.0;      ///< Sum of the fits' mean absolute deviations.
  std::int64_t first_scan = 0;       ///< Running number of the scan that started it.
  std::int64_t last_scan = 0;        ///< Running number of the scan that saw it last.
  bool confirmed = false;
};

/// A landmark cut in two: coverage shows two pieces with a gap.
struct LandmarkSplit {
  int landmark_id = 0;
  double gap_begin_m = 0.0;          ///< Along the axis from the anchor.
  double gap_end_m = 0.0;
};

/// Two landmarks that are one.
struct LandmarkMerge {
  int keep_id = 0;                   ///< The older one.
  int drop_id = 0;
};

/// Cuts landmarks that run inside each other (the pieces of one bent trunk or branch) in the middle of
/// their common stretch, and leaves out those that lie within another one, or close beside one that a
/// multitude of scans saw while hardly any saw them, or that cut the corner of an elbow.
/// @param landmarks  Ascending in id.
std::vector<Landmark> SeparatePieces(std::vector<Landmark> landmarks);

/// The landmarks of the map: candidates and confirmed, with extents, radius profiles and counters.
/// Geometry of the lines is owned by the factor graph and set from outside.
class TreeMap {
 public:
  /// @throws std::invalid_argument for a bad configuration.
  TreeMap(TreeMapConfig config, RadiusProfileConfig profile_config);

  /// Starts a candidate from an observation.
  /// @return Its id.
  int Add(const FittedCylinder& observation,
          const Eigen::Isometry3d& T_map_lidar,
          std::int64_t scan_number);

  /// Adds an observation's extent, radius and counters to a landmark.
  void Observe(int id,
               const FittedCylinder& observation,
               const Eigen::Isometry3d& T_map_lidar,
               std::int64_t scan_number);

  /// Sets the line of a landmark (the graph's estimate) and its marginal covariance.
  void SetLine(int id, const Cylinder& line, const Matrix5d& covariance);

  /// Confirms candidates that earned it; returns the ids of candidates to be dropped (not yet
  /// removed).
  std::vector<int> Promote(std::int64_t scan_number);

  void Remove(int id);

  /// The first pair of landmarks that are one, by line, extent and radius.
  std::optional<LandmarkMerge> FindDuplicate(const DataAssociationConfig& association) const;

  /// Joins a duplicate's extents, profile and counters to the one kept and removes it.
  void Merge(const LandmarkMerge& merge);

  /// The first landmark whose coverage shows a gap.
  std::optional<LandmarkSplit> FindSplit() const;

  /// Cuts a landmark; the longer-observed piece keeps the id.
  /// @return Id of the new piece, and whether it lies beyond the gap (at larger s).
  std::pair<int, bool> Split(const LandmarkSplit& split);

  bool Has(int id) const;
  const LandmarkState& State(int id) const;
  /// The landmark as the rest of the program sees it, anchor at the middle of its extent.
  Landmark Summary(int id) const;
  const std::vector<LandmarkState>& states() const { return states_; }  ///< Ascending in id.
  std::vector<Landmark> Landmarks(bool with_candidates) const;
  int next_id() const { return next_id_; }

  /// Replaces everything, for loading.
  void Restore(std::vector<LandmarkState> states, int next_id);

  const TreeMapConfig& config() const { return config_; }

 private:
  const Landmark& SummaryOf(const LandmarkState& state) const;
  LandmarkState* Find(int id);
  const LandmarkState* Find(int id) const;

  TreeMapConfig config_;
  RadiusProfileConfig profile_config_;
  std::vector<LandmarkState> states_;
  int next_id_ = 0;
  mutable std::unordered_map<int, Landmark> summaries_;  // By id, of landmarks that did not change since.
};

}  // namespace dendro
