#pragma once

#include <array>
#include <optional>

#include <Eigen/Core>

#include "dendro_slam/sim/scene.h"

namespace dendro {

/// A rough ground: a sum of plane waves with seeded directions and phases, from the longest
/// wavelength down by factors of 0.62, amplitudes in proportion to wavelength. The height stays
/// within the amplitude and its slope below a known bound, so a ray can be marched safely.
class RoughGround {
 public:
  explicit RoughGround(const SceneGround& ground);

  double Height(double x, double y) const;
  Eigen::Vector3d Normal(double x, double y) const;

  /// Range of the first point of the ray at or below the surface, within [min, max].
  std::optional<double> Intersect(const Eigen::Vector3d& origin,
                                  const Eigen::Vector3d& direction,
                                  double min_range_m,
                                  double max_range_m) const;

 private:
  static constexpr int kWaves = 7;
  struct Wave {
    double kx, ky, phase, amplitude;
  };
  double z_m_;
  double amplitude_m_;
  double slope_bound_ = 0.0;
  std::array<Wave, kWaves> waves_;
};

}  // namespace dendro
