#pragma once

#include <optional>
#include <string>
#include <vector>

#include <Eigen/Geometry>
#include <geometry_msgs/TransformStamped.h>
#include <nav_msgs/Path.h>
#include <ros/time.h>
#include <tf2/buffer_core.h>

#include "dendro_slam/odometry/relative_motion.h"

namespace dendro_ros {

/// The frames that the mapping node ties together: map -> odom -> body -> lidar (REP 105).
struct MapFrames {
  std::string map;
  std::string odom;   ///< The odometry's frame_id.
  std::string body;   ///< The odometry's child_frame_id.
  std::string lidar;

  /// What keeps the transforms from being published as usual; empty when nothing does.
  std::string Trouble(bool has_odometry) const;

  /// The transforms to publish with one scan.
  ///
  /// With odometry: map -> odom, and odom -> body if asked for. Without: map -> the root of the tree
  /// that the lidar hangs on (the lidar itself where it hangs on nothing).
  /// @param T_odom_body  Odometry at the stamp, if there is any.
  std::vector<geometry_msgs::TransformStamped> Transforms(
      const ros::Time& stamp,
      const Eigen::Isometry3d& T_map_lidar,
      const Eigen::Isometry3d& T_map_odom,
      const std::optional<Eigen::Isometry3d>& T_odom_body,
      bool with_odometry,
      const tf2::BufferCore& tf) const;
};

/// A trajectory for rviz.
nav_msgs::PathPtr ToPathMsg(const std::vector<dendro::StampedPose>& trajectory,
                            const std::string& frame_id);

}  // namespace dendro_ros
