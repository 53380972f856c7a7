#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "dendro_slam/cylinder_fitting/fitted_cylinder.h"
#include "dendro_slam/odometry/relative_motion.h"
#include "dendro_slam/segmentation/ground_plane.h"

namespace dendro {

/// One synchronised scan, as stage 4 takes it.
struct MapperInput {
  std::int64_t stamp_ns = 0;
  std::vector<FittedCylinder> cylinders;             ///< Stage 3, lidar frame at the stamp.
  std::optional<Eigen::Isometry3d> T_odom_lidar;     ///< VIO (or MAVROS) pose at the stamp.
  std::optional<RelativeMotion> icp;                 ///< ICP motion from the previous scan to this.
  std::optional<GroundPlane> ground;                 ///< The ground in the lidar frame, if in sight.
};

/// What became of one fitted cylinder.
struct ObservationVerdict {
  int segment_id = 0;
  int landmark_id = -1;      ///< Landmark or candidate it was associated with or started; -1 dropped.
  bool is_new = false;
};

/// Result of one scan.
struct MapperResult {
  std::int64_t stamp_ns = 0;
  Eigen::Isometry3d T_map_lidar = Eigen::Isometry3d::Identity();
  Matrix6d pose_covariance = Matrix6d::Zero();       ///< Marginal, right tangent.
  bool is_key_frame = false;
  std::vector<ObservationVerdict> observations;
  double error_before = 0.0;                         ///< 1/2 chi2 of the graph before the update.
  double error_after = 0.0;
  double damping = 0.0;                              ///< Levenberg-Marquardt lambda after the update.
  int variables_relinearized = 0;
  int variables_reeliminated = 0;
  bool odometry_rejected = false;                    ///< VIO disagreed with ICP and the map: a jump.
  std::string warning;                               ///< Empty when all is well; one line otherwise.
};

}  // namespace dendro
