#pragma once

#include <string>
#include <vector>

#include <geometry_msgs/PoseStamped.h>
#include <nav_msgs/Odometry.h>
#include <sensor_msgs/Imu.h>
#include <sensor_msgs/PointCloud2.h>
#include <tf2_msgs/TFMessage.h>

#include "dendro_slam/TreeMap.h"
#include "dendro_slam/sim/flight_path.h"
#include "dendro_slam/sim/imu_simulator.h"
#include "dendro_slam/sim/lidar_simulator.h"
#include "dendro_slam/sim/odometry_simulator.h"
#include "dendro_slam/sim/scene.h"

namespace dendro_ros {

/// What the simulated rig publishes, in the words of the drivers that a real one runs.
///
/// Frames: odom -> base_link -> velodyne with the mavros odometry; with the T265's
/// odom -> camera_pose_frame -> base_link -> velodyne, the odometry being the camera's.
class RigMessages {
 public:
  static constexpr const char* kPointsTopic = "/velodyne_points";
  static constexpr const char* kPacketsTopic = "/velodyne_packets";
  static constexpr const char* kPositionPacketsTopic = "/velodyne_position_packets";
  static constexpr const char* kFixTopic = "/fix";
  static constexpr const char* kImuTopic = "/imu/data_raw";
  static constexpr const char* kTruthLidarTopic = "/ground_truth/lidar_pose";
  static constexpr const char* kTruthLabelsTopic = "/ground_truth/labels";
  static constexpr const char* kTruthHitsTopic = "/ground_truth/hits";
  static constexpr const char* kTruthTreesTopic = "/ground_truth/tree_map";
  static constexpr const char* kLidarFrame = "velodyne";
  static constexpr const char* kBaseFrame = "base_link";
  static constexpr const char* kOdomFrame = "odom";
  static constexpr const char* kMapFrame = "map";

  /// @param path  Must outlive this object.
  explicit RigMessages(const dendro::FlightPath& path);

  /// /camera/odom/sample, /mavros/local_position/odom, or "" without odometry.
  const std::string& odometry_topic() const { return odometry_topic_; }
  /// The rig's fixed transforms.
  tf2_msgs::TFMessage StaticTransforms() const;
  nav_msgs::Odometry Odometry(const dendro::OdometrySample& sample) const;
  /// odom -> the odometry's child frame.
  tf2_msgs::TFMessage OdometryTransform(const dendro::OdometrySample& sample) const;
  /// In base_link, without orientation, as REP 145 asks of imu/data_raw. The covariances tell the white
  /// noise, not the biases.
  static sensor_msgs::Imu Imu(const dendro::ImuSample& sample, const dendro::ImuSimulatorConfig& config);
  /// True pose of the lidar at the scan's stamp, in the map.
  static geometry_msgs::PoseStamped TruthLidarPose(const dendro::SimulatedScan& scan);
  /// True label (uint8), branch and tree (int16, -1 none) of every return, in the cloud's order; the
  /// cloud has no coordinates of its own.
  static sensor_msgs::PointCloud2Ptr TruthLabels(const dendro::SimulatedScan& scan);
  /// Returns on each branch that the scan met: tree, branch (int16), hits (uint32) in rows as above.
  static sensor_msgs::PointCloud2Ptr TruthHits(const dendro::SimulatedScan& scan);
  /// The scene's trees as a map. Its branch ids are those of the scene, in the second and further trees
  /// after the largest id of the tree before, as ids must be unique in a map.
  static dendro_slam::TreeMapPtr TruthTrees(const dendro::Scene& scene, std::int64_t stamp_ns);

 private:
  Eigen::Isometry3d ChildPose(const dendro::OdometrySample& sample) const;

  const dendro::FlightPath& path_;
  bool t265_ = false;
  std::string odometry_topic_;
  std::string child_frame_;
};

}  // namespace dendro_ros
