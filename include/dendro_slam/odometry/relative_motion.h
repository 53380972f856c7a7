#pragma once

#include <cstdint>

#include "dendro_slam/geometry/se3.h"

namespace dendro {

/// A pose of the trajectory.
struct StampedPose {
  std::int64_t stamp_ns = 0;
  Eigen::Isometry3d T_map_lidar = Eigen::Isometry3d::Identity();
};

/// Motion of the lidar between two stamps, with its uncertainty.
struct RelativeMotion {
  std::int64_t from_stamp_ns = 0;
  std::int64_t to_stamp_ns = 0;
  Eigen::Isometry3d T_from_to = Eigen::Isometry3d::Identity();
  Matrix6d covariance = Matrix6d::Identity();  ///< Of the right tangent [omega; rho] at T_from_to.
};

}  // namespace dendro
