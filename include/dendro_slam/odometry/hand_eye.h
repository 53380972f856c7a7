#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "dendro_slam/geometry/se3.h"
#include "dendro_slam/sensors/pose_buffer.h"

namespace dendro {

/// Settings of SolveHandEye. The sigmas of the odometry are those of a motion over one of the windows.
struct HandEyeConfig {
  std::vector<double> windows_s = {0.4, 1.0, 2.0};  ///< Motions over these times are compared [s].
  double max_time_offset_s = 0.3;   ///< Time offsets are looked for up to this, either way [s]. > 0.
  double odometry_sigma_rad = 0.001;     ///< Noise of the odometry's rotation [rad]. > 0.
  double odometry_sigma_m = 0.001;       ///< Noise of the odometry's position [m]. > 0.
  double odometry_walk_rad = 0.002;      ///< Drift of its rotation per root metre [rad]. >= 0.
  double odometry_walk_m = 0.01;         ///< Drift of its position per root metre [m]. >= 0.
  double scale_sigma = 0.02;             ///< Its error of scale, estimated along. >= 0.
  double max_rotation_sigma_deg = 0.2;   ///< A rotation less sure than this is not given [deg]. > 0.
  double max_position_sigma_m = 0.005;   ///< A position less sure than this is not given [m]. > 0.
  double max_time_sigma_s = 0.0008;      ///< A time offset less sure than this is not given [s]. > 0.
  double min_turn_deg = 4.0;  ///< Least turning, RMS over the windows, about the second most turned
                              ///< axis: less shows nothing but noise [deg]. > 0.
  int jackknife_blocks = 10;  ///< Stretches of the recording that are left out one by one to see how
                              ///< much the result hangs on each. >= 3.

  /// @throws std::invalid_argument naming the field.
  void Validate() const;
};

/// A pose of the lidar in a frame of its own.
struct LidarPose {
  std::int64_t stamp_ns = 0;
  Eigen::Isometry3d T_map_lidar = Eigen::Isometry3d::Identity();
  Matrix6d information = Matrix6d::Identity();  ///< Of the right tangent; may be singular.
};

/// What the two trajectories say of the rig.
struct HandEyeResult {
  Eigen::Isometry3d T_body_lidar = Eigen::Isometry3d::Identity();  ///< Lidar in the odometry's body.
  double time_offset_s = 0.0;   ///< To add to the odometry's stamps to get the lidar's clock [s].
  double scale = 1.0;           ///< Lengths in the odometry over those of the lidar.
  Matrix6d covariance = Matrix6d::Zero();  ///< Of the right tangent at T_body_lidar.
  double rotation_sigma_deg = 0.0;  ///< Along the least sure axis [deg].
  double position_sigma_m = 0.0;    ///< Along the least sure direction [m].
  Eigen::Vector3d least_sure_direction = Eigen::Vector3d::UnitZ();  ///< That direction, lidar frame.
  double time_sigma_s = 0.0;
  bool rotation_known = false;  ///< Sure enough to be used; so are the next two.
  bool position_known = false;
  bool time_known = false;

  int num_motions = 0;              ///< Pairs of motions compared.
  double residual_rotation_deg = 0.0;  ///< RMS over them, robust [deg].
  double residual_position_m = 0.0;    ///< The same [m].
  Eigen::Vector3d turn_rms_deg = Eigen::Vector3d::Zero();  ///< Turning over the windows about the
                                                           ///< lidar's x, y, z, RMS [deg].
  double second_turn_deg = 0.0;     ///< RMS about the second most turned axis of all [deg].
  double distance_m = 0.0;          ///< Way of the lidar [m].
  std::vector<std::string> missing;  ///< What the motion does not show and how to move, in words.

  bool known() const { return rotation_known && position_known && time_known; }
};

/// Extrinsic and temporal calibration from two trajectories of one rigid rig ("hand-eye", Tsai and
/// Lenz 1989): for every pair of stamps i, j the motion of the odometry's body A_ij and of the lidar
/// B_ij obey `A_ij(t + time offset) X = X B_ij`, with X = T_body_lidar. Solved over rotation,
/// translation, time offset and the odometry's scale by robust Gauss-Newton on
/// `Log((A_ij X)^-1 X B_ij)`, weighted by the lidar's own information (directions that the scans did
/// not tell have no say) and by the odometry's drift. Started from the time offset at which the two
/// speeds of turning agree best and the rotation that turns one's axes into the other's.
///
/// The covariance is the sum of that of the least-squares problem and of the jackknife over
/// stretches of the recording, because errors of neighbouring motions go together. A quantity whose
/// sigma is beyond its limit is not known, and `missing` says which motion would show it: translation
/// along an axis needs turning about another one, the time offset needs changes of the turning.
/// @param lidar     Ascending stamps.
/// @param odometry  T_odom_body in its own clock.
HandEyeResult SolveHandEye(const std::vector<LidarPose>& lidar,
                           const PoseBuffer& odometry,
                           const HandEyeConfig& config = HandEyeConfig());

}  // namespace dendro
