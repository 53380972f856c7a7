#include "dendro_slam/ros/lidar_mount.h"

#include <fmt/format.h>

#include <geometry_msgs/TransformStamped.h>
#include <tf2/exceptions.h>

#include "dendro_slam/ros/conversions.h"

namespace dendro_ros {

LidarMount::LidarMount(const LidarMountConfig& config, const tf2::BufferCore* tf)
    : config_(config), tf_(tf) {}

std::optional<Eigen::Isometry3d> LidarMount::Find(const std::string& body_frame,
                                                  const std::string& lidar_frame) {
  if (T_body_lidar_ && body_frame == body_frame_ && lidar_frame == lidar_frame_) {
    return T_body_lidar_;
  }
  body_frame_ = body_frame;
  lidar_frame_ = lidar_frame;
  T_body_lidar_.reset();
  error_.clear();
  if (!config_.from_tf) {
    constexpr double kDegToRad = 0.017453292519943295;
    Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
    T.linear() = (Eigen::AngleAxisd(config_.yaw_deg * kDegToRad, Eigen::Vector3d::UnitZ()) *
                  Eigen::AngleAxisd(config_.pitch_deg * kDegToRad, Eigen::Vector3d::UnitY()) *
                  Eigen::AngleAxisd(config_.roll_deg * kDegToRad, Eigen::Vector3d::UnitX()))
                     .toRotationMatrix();
    T.translation() = Eigen::Vector3d(config_.x_m, config_.y_m, config_.z_m);
    T_body_lidar_ = T;
  } else if (body_frame.empty()) {
    error_ = "the odometry has no child_frame_id, so the lidar's mounting cannot be looked up; set "
             "child_frame_id in the odometry, or lidar_mount/from_tf: false with the numbers";
  } else if (body_frame == lidar_frame) {
    T_body_lidar_ = Eigen::Isometry3d::Identity();
  } else {
    try {
      if (tf_ == nullptr) throw tf2::LookupException("no transforms");
      T_body_lidar_ = FromMsg(tf_->lookupTransform(body_frame, lidar_frame, ros::Time(0)).transform);
    } catch (const tf2::TransformException&) {
      error_ = fmt::format(
          "no transform from '{0}' (odometry) to '{1}' (scan); publish it, e.g. `rosrun tf2_ros "
          "static_transform_publisher X Y Z YAW PITCH ROLL {0} {1}`, or set lidar_mount/from_tf: "
          "false with the numbers. Until then scans are mapped without odometry",
          body_frame,
          lidar_frame);
    }
  }
  return T_body_lidar_;
}

}  // namespace dendro_ros
