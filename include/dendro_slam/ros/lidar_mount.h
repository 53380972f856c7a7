#pragma once

#include <optional>
#include <string>

#include <Eigen/Geometry>
#include <tf2/buffer_core.h>

namespace dendro_ros {

/// Where the lidar sits on the body whose pose the odometry gives.
struct LidarMountConfig {
  bool from_tf = true;     ///< Take it from /tf_static; false: from the numbers below.
  double x_m = 0.0;        ///< Lidar in the odometry's child frame [m].
  double y_m = 0.0;        ///< Lidar in the odometry's child frame [m].
  double z_m = 0.0;        ///< Lidar in the odometry's child frame [m].
  double roll_deg = 0.0;   ///< Turn about the fixed x axis, first [deg].
  double pitch_deg = 0.0;  ///< Turn about the fixed y axis, second [deg].
  double yaw_deg = 0.0;    ///< Turn about the fixed z axis, last [deg].

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("from_tf", from_tf);
    v("x_m", x_m);
    v("y_m", y_m);
    v("z_m", z_m);
    v("roll_deg", roll_deg);
    v("pitch_deg", pitch_deg);
    v("yaw_deg", yaw_deg);
  }
};

/// The mounting, once it is known.
class LidarMount {
 public:
  /// @param tf  Transforms to look in; must outlive this object. Null: only the numbers are used.
  LidarMount(const LidarMountConfig& config, const tf2::BufferCore* tf);

  /// Looks for the mounting until it is found; then keeps it for this pair of frames.
  /// @param body_frame   The odometry's child frame.
  /// @return  T_body_lidar, or nothing; then error() says what is missing and how to give it.
  std::optional<Eigen::Isometry3d> Find(const std::string& body_frame,
                                        const std::string& lidar_frame);
  const std::string& error() const { return error_; }

 private:
  LidarMountConfig config_;
  const tf2::BufferCore* tf_;
  std::string body_frame_;
  std::string lidar_frame_;
  std::optional<Eigen::Isometry3d> T_body_lidar_;
  std::string error_;
};

}  // namespace dendro_ros
