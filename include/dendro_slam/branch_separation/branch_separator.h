#pragma once

#include <vector>

#include "dendro_slam/branch_separation/segment.h"
#include "dendro_slam/range_image/range_image.h"

namespace dendro {

/// Settings of stage 2.
struct BranchSeparatorConfig {
  bool thesis_mode = false;       ///< Run Algorithms 1 and 2 of the thesis as printed.
  bool adaptive_threshold = true; ///< d_thresh from range, spacing and incidence; else constant.
  double constant_threshold_m = 0.28;  ///< d_thresh of the thesis, used when not adaptive [m]. > 0.

  double range_sigma_m = 0.015;       ///< Noise of one range [m]. >= 0.
  double max_incidence_deg = 80.0;    ///< Most oblique surface still followed in a row [deg]. (0, 90).
  double max_row_tilt_deg = 60.0;     ///< Most a branch leans from the direction across rows [deg].
  int max_missing_pixels = 1;         ///< Pixels without wood bridged within a row. >= 0.
  int max_missing_rows = 1;           ///< Rows without a run bridged between rows. >= 0.

  double fork_width_ratio = 1.4;      ///< A run wider than this times its trunk is cut. > 1.
  int fork_min_excess_pixels = 3;     ///< And by at least this many pixels. >= 1.
  double excess_width_ratio = 1.1;    ///< A run wider than this times its neighbours gives up the excess. > 1.
  int excess_min_pixels = 2;          ///< And at least this many pixels on a side. >= 1.

  double max_length_m = 3.0;          ///< Longer segments are cut [m]. > 0.
  double max_bow_m = 0.04;            ///< Sagitta at which a curved segment is cut [m]. > 0.
  int min_rows_per_piece = 3;         ///< A cut leaves at least this many rows on each side. >= 1.
  int min_points = 1;                 ///< Smaller segments are dropped. >= 1.

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("thesis_mode", thesis_mode);
    v("adaptive_threshold", adaptive_threshold);
    v("constant_threshold_m", constant_threshold_m);
    v("range_sigma_m", range_sigma_m);
    v("max_incidence_deg", max_incidence_deg);
    v("max_row_tilt_deg", max_row_tilt_deg);
    v("max_missing_pixels", max_missing_pixels);
    v("max_missing_rows", max_missing_rows);
    v("fork_width_ratio", fork_width_ratio);
    v("fork_min_excess_pixels", fork_min_excess_pixels);
    v("excess_width_ratio", excess_width_ratio);
    v("excess_min_pixels", excess_min_pixels);
    v("max_length_m", max_length_m);
    v("max_bow_m", max_bow_m);
    v("min_rows_per_piece", min_rows_per_piece);
    v("min_points", min_points);
  }

  /// @throws std::invalid_argument naming the field that is out of its range.
  void Validate() const;
};

/// Stage 2: splits the wood of a scan into trunk and branch instances.
///
/// The skeleton is the thesis' (section 4.2): two pointers run along each row from the lowest up,
/// a new instance starts where their distance in space exceeds d_thresh. Identity between rows
/// comes from adjacency in space, not from counting, so it survives a change of count; the image
/// wraps at 360 degrees; a fork ends in separate segments; pieces are straight enough for a cone.
///
/// @note Deviates: the thesis names instances by their count per row (see `thesis_mode`).
class BranchSeparator {
 public:
  explicit BranchSeparator(const BranchSeparatorConfig& config = {});

  /// Segments of the wood pixels of a scan.
  /// @param scan  Labelled range image; pixels with a non-finite point are skipped.
  /// @return      Disjoint segments, ids 0, 1, ... in order of their first pixel.
  /// @throws std::invalid_argument when the vectors of the scan do not match rows * cols.
  std::vector<Segment> Separate(const LabelledScan& scan) const;

  const BranchSeparatorConfig& config() const { return config_; }

 private:
  BranchSeparatorConfig config_;
};

}  // namespace dendro
