#pragma once

#include <optional>

#include <Eigen/Core>

#include "dendro_slam/range_image/range_image.h"

namespace dendro {

/// The ground as a plane in the lidar frame: height of p is `normal . p + offset`.
struct GroundPlane {
  Eigen::Vector3f normal = Eigen::Vector3f::UnitZ();  ///< Unit, pointing up.
  float offset = 0.0F;                                ///< Height of the lidar's origin [m].

  float Height(const Eigen::Vector3f& p) const { return normal.dot(p) + offset; }
};

/// What EstimateGroundPlane looks for.
struct GroundPlaneConfig {
  int hypotheses = 192;            ///< Sampled planes. >= 1.
  double inlier_distance_m = 0.12;  ///< Half thickness of the plane [m]. > 0.
  double max_range_m = 25.0;       ///< Returns considered [m]. > 0.
  double far_range_m = 80.0;        ///< Second try where the nearer returns show no ground: high above
                                    ///< it all of it is far away [m]. 0 to leave it out.
  double min_inlier_ratio = 0.08;  ///< Of the returns considered. In (0, 1).
  double min_column_ratio = 0.3;    ///< Of the columns, with the plane in sight. In [0, 1).
  double max_below_ratio = 0.04;   ///< Returns that may lie under the plane. In [0, 1).

  void Validate() const;
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("hypotheses", hypotheses);
    v("inlier_distance_m", inlier_distance_m);
    v("max_range_m", max_range_m);
    v("far_range_m", far_range_m);
    v("min_inlier_ratio", min_inlier_ratio);
    v("min_column_ratio", min_column_ratio);
    v("max_below_ratio", max_below_ratio);
  }
};

/// The plane with the most returns on it that has hardly any below it, whatever the attitude of the
/// sensor: nothing assumes that its axis is vertical. Sampled with a fixed seed, then refined by
/// least squares; each return is weighted by the area it stands for, so that a near wall does not
/// outvote the ground.
/// @return nothing if no plane is convincing (no ground in sight, fewer than 30 returns).
std::optional<GroundPlane> EstimateGroundPlane(const RangeImage& image,
                                               const GroundPlaneConfig& config);

/// Least-squares plane through the returns that stage 1 labelled ground, near the sensor: sharper
/// than EstimateGroundPlane, and without the trees.
/// @param max_range_m  Farther returns are left out: the ground there may have another height [m].
///                     High above the ground, where none is nearer, the reach is four times as far.
/// @return nothing with fewer than 100 such returns, where they lie on a line, or where they are no
///         plane below the sensor (scatter over 15 cm).
std::optional<GroundPlane> FitGroundPlane(const LabelledScan& scan, double max_range_m = 15.0);

}  // namespace dendro
