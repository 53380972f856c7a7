#pragma once

#include <optional>
#include <vector>

#include "dendro_slam/range_image/range_image.h"
#include "dendro_slam/segmentation/ground_plane.h"

namespace dendro {

/// Parameters of the geometric fallback.
struct GeometricWoodConfig {
  double ground_tolerance_m = 0.15;   ///< Above the local ground, still ground [m]. > 0.
  double ground_cell_m = 1.0;         ///< Cell of the local ground height [m]. > 0.
  double jump_m = 0.12;               ///< Step in range that splits a run at 0 m [m]. > 0.
  double jump_per_m = 0.01;           ///< Growth of that step with range. >= 0.
  double max_width_m = 1.3;           ///< Thickest trunk across [m]. > 0.
  double max_roughness_m = 0.035;     ///< RMS about a smooth profile, above which it is leaf [m]. > 0.
  double min_elongation = 2.0;        ///< Length over width of a group of runs. >= 1.
  int min_group_points = 6;           ///< Returns of a group. >= 1.

  void Validate() const;
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("ground_tolerance_m", ground_tolerance_m);
    v("ground_cell_m", ground_cell_m);
    v("jump_m", jump_m);
    v("jump_per_m", jump_per_m);
    v("max_width_m", max_width_m);
    v("max_roughness_m", max_roughness_m);
    v("min_elongation", min_elongation);
    v("min_group_points", min_group_points);
  }
};

/// Labels a scan without weights: what lies on the ground is ground; the rest is cut into runs of
/// neighbouring columns without a step in range, runs are joined over rows where they overlap, and
/// a group is wood if its runs are smooth, no wider than a trunk, and it is longer than wide. Rough
/// groups are leaf, wide ones other.
/// @return one label per pixel, kNone where there is no return.
std::vector<Label> LabelGeometrically(const RangeImage& image,
                                      const std::optional<GroundPlane>& ground,
                                      const GeometricWoodConfig& config);

}  // namespace dendro
