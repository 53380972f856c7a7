#pragma once

#include <array>
#include <optional>

#include <Eigen/Core>

#include "dendro_slam/sim/scene.h"

namespace dendro {

/// A rough ground: a sum of plane waves with seeded directions and phases, from the longest
/// wavelength down by factors of 0.55, amplitudes in proportion to wavelength. The height stays
/// within the amplitude, its slope and curvature below known bounds, so a ray can be marched safely.
class RoughGround {
 public:
  explicit RoughGround(const SceneGround& ground);

  double Height(double x, double y) const;
  Eigen::Vector3d Normal(double x, double y) const;

  /// Range of the first point of the ray at or below the surface, within [min, max].
  /// @param half_width_m, half_angle_rad  Every ray that starts within the half width of this one and
  ///                      whose unit direction differs by less than the half angle is still above the
  ///                      surface ...
  /// @param safe_m        ... up to this range; left as it is where this ray cannot tell.
  std::optional<double> Intersect(const Eigen::Vector3d& origin,
                                  const Eigen::Vector3d& direction,
                                  double min_range_m,
                                  double max_range_m,
                                  double half_width_m = 0.0,
                                  double half_angle_rad = 0.0,
                                  double* safe_m = nullptr) const;

 private:
  static constexpr int kWaves = 5;
  static constexpr int kLanes = 8;  ///< Waves, filled up with ones of no amplitude for vector loops.

  struct Surface {
    double height_m, slope_x, slope_y;
  };
  Surface Evaluate(double x, double y) const;

  alignas(16) std::array<double, kLanes> kx_{}, ky_{}, phase_{};
  alignas(16) std::array<float, kLanes> amplitude_f_{}, slope_x_f_{}, slope_y_f_{};
  double z_m_;
  double amplitude_m_;
  double slope_bound_ = 0.0;      ///< Of the height along any horizontal direction.
  double curvature_bound_ = 0.0;  ///< Of the height along any horizontal direction [1/m].
};

}  // namespace dendro
