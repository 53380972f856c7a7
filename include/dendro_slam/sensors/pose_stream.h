#pragma once

#include <cstdint>
#include <istream>
#include <stdexcept>
#include <string>
#include <vector>

#include <Eigen/Geometry>

#include "dendro_slam/geometry/se3.h"

/// Recorded pose streams of a tracking camera.
namespace dendro {

/// A pose with its stamp.
struct StreamedPose {
  std::int64_t stamp_ns = 0;
  Eigen::Isometry3d T_odom_camera = Eigen::Isometry3d::Identity();  ///< In ROS axes.
  int confidence = 3;  ///< The tracker's, 0 failed to 3 high; 3 where the stream has none.
};

/// A stream that cannot be read; the message holds the line's number and what is wrong with it.
class PoseStreamError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// RealSense's axes (x right, y up, z backwards, for the world and for the body) to those of ROS
/// (x forward, y left, z up): `p_ros = (-z, -x, y)`; rotations by the same change of axes on both
/// sides, as realsense2_camera does.
Eigen::Vector3d RosFromRealSense(const Eigen::Vector3d& p);
Eigen::Isometry3d RosFromRealSense(const Eigen::Isometry3d& T);

/// Reads a TUM trajectory: lines `time tx ty tz qx qy qz qw` [s, m], `#` begins a comment. The axes
/// are taken to be those of ROS already.
/// @throws PoseStreamError on a malformed line, a quaternion that is not near unit length, or time
///         that does not grow.
std::vector<StreamedPose> ReadTumPoses(std::istream& in);

/// Reads a RealSense pose CSV and converts it to the axes of ROS. Either
/// - the `..._imu_pose.csv` of rs-convert: sections with a header line `Stream Type,F#,HW Timestamp
///   (ms),...`; the rows of the pose stream are read by their column names (`t_x ... r_w`) and
///   everything else is skipped. Stamps are the host's where it has them, else the camera's; or
/// - any CSV whose header names a time column (`timestamp`, `time` or `stamp`, in s, ms, us or ns,
///   told apart by its size) and `tx ty tz qx qy qz qw` (or `x y z`, `t_x`, `r_x`, `q_x` ...), with
///   an optional `tracker_confidence`.
/// Poses with a confidence of 0 are kept: the caller decides.
/// @throws PoseStreamError as above, or when no pose column is found.
std::vector<StreamedPose> ReadRealSensePoses(std::istream& in);

/// Covariance of the pose in the tangent space (rotation first) for a tracker confidence, as
/// realsense2_camera publishes it: `sigma^2 * 10^(3 - confidence)` on the diagonal.
/// @param sigma_rotation_rad, sigma_translation_m  At high confidence.
Matrix6d PoseCovarianceFromConfidence(int confidence,
                                      double sigma_rotation_rad,
                                      double sigma_translation_m);

}  // namespace dendro
