#include "dendro_slam/ros/map_frames.h"

#include <boost/make_shared.hpp>
#include <fmt/format.h>
#include <tf2/exceptions.h>

#include "dendro_slam/ros/conversions.h"

namespace dendro_ros {
namespace {

geometry_msgs::TransformStamped Make(const ros::Time& stamp,
                                     const std::string& parent,
                                     const std::string& child,
                                     const Eigen::Isometry3d& T_parent_child) {
  geometry_msgs::TransformStamped msg;
  msg.header.stamp = stamp;
  msg.header.frame_id = parent;
  msg.child_frame_id = child;
  msg.transform = ToTransformMsg(T_parent_child);
  return msg;
}

}  // namespace

std::string MapFrames::Trouble(bool has_odometry) const {
  if (has_odometry && (odom == map || odom.empty())) {
    return fmt::format(
        "the odometry's frame_id is '{}', the map's frame is '{}': map -> odom is not published; "
        "set map_frame to another name (e.g. tree_map) to see map and scan together",
        odom,
        map);
  }
  return "";
}

std::vector<geometry_msgs::TransformStamped> MapFrames::Transforms(
    const ros::Time& stamp,
    const Eigen::Isometry3d& T_map_lidar,
    const Eigen::Isometry3d& T_map_odom,
    const std::optional<Eigen::Isometry3d>& T_odom_body,
    bool with_odometry,
    const tf2::BufferCore& tf) const {
  std::vector<geometry_msgs::TransformStamped> transforms;
  if (T_odom_body) {
    if (!Trouble(true).empty()) return transforms;
    transforms.push_back(Make(stamp, map, odom, T_map_odom));
    if (with_odometry && !body.empty()) {
      transforms.push_back(Make(stamp, odom, body, *T_odom_body));
    }
    return transforms;
  }
  // The odometry's own branch of the tree goes on being tied to the map as it was.
  if (!odom.empty()) return transforms;
  std::string root = lidar;
  std::string parent;
  for (int depth = 0; depth < 100 && tf._getParent(root, ros::Time(0), parent) && parent != map;
       ++depth) {
    root = parent;
  }
  Eigen::Isometry3d T_lidar_root = Eigen::Isometry3d::Identity();
  if (root != lidar) {
    try {
      T_lidar_root = FromMsg(tf.lookupTransform(lidar, root, ros::Time(0)).transform);
    } catch (const tf2::TransformException&) {
      root = lidar;
    }
  }
  if (root != map) transforms.push_back(Make(stamp, map, root, T_map_lidar * T_lidar_root));
  return transforms;
}

nav_msgs::PathPtr ToPathMsg(const std::vector<dendro::StampedPose>& trajectory,
                            const std::string& frame_id) {
  auto path = boost::make_shared<nav_msgs::Path>();
  path->header.frame_id = frame_id;
  path->poses.reserve(trajectory.size());
  for (const dendro::StampedPose& in : trajectory) {
    geometry_msgs::PoseStamped pose;
    pose.header.frame_id = frame_id;
    pose.header.stamp = ToRosTime(in.stamp_ns);
    pose.pose = ToMsg(in.T_map_lidar);
    path->poses.push_back(pose);
  }
  if (!trajectory.empty()) path->header.stamp = ToRosTime(trajectory.back().stamp_ns);
  return path;
}

}  // namespace dendro_ros
