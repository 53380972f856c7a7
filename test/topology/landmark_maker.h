#pragma once

#include <cmath>
#include <vector>

#include "dendro_slam/mapping/landmark.h"

namespace dendro::test {

/// A confirmed landmark that describes the frustum from p0 to p1, with radius knots every `knot_m`.
inline Landmark MakeLandmark(int id,
                             const Eigen::Vector3d& p0,
                             const Eigen::Vector3d& p1,
                             double r0,
                             double r1,
                             double sigma = 0.002,
                             double knot_m = 0.25) {
  Landmark landmark;
  landmark.id = id;
  const double length = (p1 - p0).norm();
  landmark.cylinder.axis = (p1 - p0) / length;
  landmark.cylinder.point = 0.5 * (p0 + p1);
  landmark.cylinder.curvature = 2.0 / (r0 + r1);
  landmark.covariance = Matrix5d::Identity() * 1e-4;
  landmark.s_min_m = -0.5 * length;
  landmark.s_max_m = 0.5 * length;
  const int knots = std::max(2, static_cast<int>(std::lround(length / knot_m)) + 1);
  for (int i = 0; i < knots; ++i) {
    const double f = static_cast<double>(i) / (knots - 1);
    landmark.profile.push_back({(f - 0.5) * length, (1.0 - f) * r0 + f * r1, sigma, 10});
  }
  landmark.num_scans = 10;
  landmark.num_points = 1000;
  for (int i = 0; i < 18; ++i) landmark.arc_seen.set(static_cast<std::size_t>(i));
  landmark.confirmed = true;
  return landmark;
}

}  // namespace dendro::test
