#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <random>
#include <vector>

#include "dendro_slam/geometry/se3.h"
#include "dendro_slam/range_image/range_image.h"

/// A VLP-16 (thin beams) among finite cylinders, by closed-form intersection: truth for tests.
namespace dendro_test {

struct Rod {
  Eigen::Vector3d from, to;
  double radius;
};

/// A trunk and three branches.
inline std::vector<Rod> ThesisLikeTree() {
  return {{{0, 0, -2}, {0.05, 0, 4}, 0.15},
          {{0, 0, 0.3}, {1.6, 0.4, 1.5}, 0.06},
          {{0, 0, 1.0}, {-1.2, 1.1, 2.0}, 0.05},
          {{0, 0, 0.0}, {-0.4, -1.7, 0.6}, 0.045}};
}

inline dendro::LabelledScan SimulateRods(const std::vector<Rod>& rods,
                                         const Eigen::Isometry3d& T_map_lidar,
                                         std::int64_t stamp_ns,
                                         double noise_m,
                                         unsigned seed,
                                         int cols = 1800) {
  std::mt19937 rng(seed);
  std::normal_distribution<double> noise(0.0, 1.0);
  dendro::LabelledScan scan;
  dendro::RangeImage& image = scan.image;
  image.stamp_ns = stamp_ns;
  image.rows = 16;
  image.cols = cols;
  const std::size_t n = static_cast<std::size_t>(16 * cols);
  const float nan = std::numeric_limits<float>::quiet_NaN();
  image.point.assign(n, Eigen::Vector3f::Constant(nan));
  image.range.assign(n, nan);
  image.intensity.assign(n, 0.0F);
  image.time_s.assign(n, 0.0F);
  image.beam_origin.assign(n, Eigen::Vector3f::Zero());
  image.beam_direction.assign(n, Eigen::Vector3f::UnitX());
  image.point_index.assign(n, -1);
  scan.wood_probability.assign(n, 0.0F);
  scan.label.assign(n, dendro::Label::kNone);
  int count = 0;
  for (int r = 0; r < 16; ++r) {
    const double elevation = (-15.0 + 2.0 * r) * M_PI / 180.0;
    for (int c = 0; c < cols; ++c) {
      const double azimuth = -2.0 * M_PI * (c + 0.5) / cols;  // clockwise seen from above
      const Eigen::Vector3d d_lidar(std::cos(elevation) * std::cos(azimuth),
                                    std::cos(elevation) * std::sin(azimuth),
                                    std::sin(elevation));
      const std::size_t pixel = image.Index(r, c);
      image.beam_direction[pixel] = d_lidar.cast<float>();
      const Eigen::Vector3d o = T_map_lidar.translation();
      const Eigen::Vector3d d = T_map_lidar.linear() * d_lidar;
      double best = 1e9;
      for (const Rod& rod : rods) {
        const Eigen::Vector3d a = (rod.to - rod.from).normalized();
        const double length = (rod.to - rod.from).norm();
        const Eigen::Vector3d m = o - rod.from;
        const Eigen::Vector3d dp = d - d.dot(a) * a, mp = m - m.dot(a) * a;
        const double A = dp.squaredNorm(), B = dp.dot(mp),
                     C = mp.squaredNorm() - rod.radius * rod.radius;
        const double disc = B * B - A * C;
        if (disc < 0.0 || A < 1e-12) continue;
        const double t = (-B - std::sqrt(disc)) / A;
        const double s = (m + t * d).dot(a);
        if (t > 0.3 && s >= 0.0 && s <= length && t < best) best = t;
      }
      if (best > 100.0) continue;
      best += noise_m * noise(rng);
      image.range[pixel] = static_cast<float>(best);
      image.point[pixel] = (best * d_lidar).cast<float>();
      image.point_index[pixel] = count++;
      scan.label[pixel] = dendro::Label::kWood;
      scan.wood_probability[pixel] = 1.0F;
    }
  }
  return scan;
}

}  // namespace dendro_test
