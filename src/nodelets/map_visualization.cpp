#include <map>
#include <memory>
#include <string>
#include <vector>

#include <nav_msgs/Path.h>
#include <nodelet/nodelet.h>
#include <pluginlib/class_list_macros.hpp>
#include <tf2_ros/static_transform_broadcaster.h>
#include <visualization_msgs/MarkerArray.h>

#include "dendro_slam/GraphStatus.h"
#include "dendro_slam/TreeMap.h"
#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/ros/markers.h"
#include "dendro_slam/ros/node_config.h"

namespace dendro_ros {

/// The map in, rviz markers out. What they show may be changed while it runs:
///   rosparam set /map_visualization/color sigma
class MapVisualization : public nodelet::Nodelet {
 private:
  static constexpr double kLookEveryS = 0.5;

  void onInit() override {
    try {
      ros::NodeHandle& nh = getNodeHandle();
      config_ = ReadConfig<MapVisualizationNodeConfig>(ReadRosParams(getPrivateNodeHandle()),
                                                       getName());
      // A viewer that comes late gets the whole map through its own first subscription.
      markers_ = nh.advertise<visualization_msgs::MarkerArray>(
          "map_markers", 10, [this](const ros::SingleSubscriberPublisher&) {
            changes_.Forget();
            Publish();
          });
      map_subscriber_ = nh.subscribe<dendro_slam::TreeMap>(
          "tree_map", 2, [this](const dendro_slam::TreeMapConstPtr& map) {
            map_ = map;
            model_ = FromMsg(*map);
            if (!model_.trees.empty()) {
              const dendro::MapTree& tree = model_.trees.front();
              const Eigen::Vector3d middle =
                  tree.base + Eigen::Vector3d::UnitZ() * (0.5 * tree.height_m);
              SendFrame(config_.tree_frame, middle, Eigen::Quaterniond::Identity());
            }
            Publish();
          });
      // The chain of ICP motions begins where the lidar was at first.
      path_subscriber_ = nh.subscribe<nav_msgs::Path>(
          "path", 2, [this](const nav_msgs::PathConstPtr& path) {
            if (path->poses.empty() || !map_) return;
            const Eigen::Isometry3d first = FromMsg(path->poses.front().pose);
            SendFrame(config_.icp_frame, first.translation(), Eigen::Quaterniond(first.linear()));
          });
      status_subscriber_ = nh.subscribe<dendro_slam::GraphStatus>(
          "tree_mapping/graph_status", 10, [this](const dendro_slam::GraphStatusConstPtr& status) {
            Flash(*status);
          });
      // Wall time: the clock of a paused bag must not stop a person from changing the view.
      timer_ = nh.createWallTimer(ros::WallDuration(kLookEveryS),
                                  [this](const ros::WallTimerEvent&) { LookForChanges(); });
    } catch (const std::exception& error) {
      NODELET_FATAL("%s", error.what());
      throw;
    }
  }

  void LookForChanges() {
    const ros::NodeHandle& nh = getPrivateNodeHandle();
    MapVisualizationNodeConfig config = config_;
    nh.getParamCached("color", config.color);
    nh.getParamCached("labels", config.labels);
    nh.getParamCached("skeleton", config.skeleton);
    nh.getParamCached("updates", config.updates);
    nh.getParamCached("alpha", config.alpha);
    nh.getParamCached("label_height_m", config.label_height_m);
    nh.getParamCached("label_min_radius_m", config.label_min_radius_m);
    if (config == config_) return;
    try {
      config.Validate();
    } catch (const std::exception& error) {
      NODELET_WARN_THROTTLE(10.0, "parameter not taken: %s", error.what());
      return;
    }
    config_ = config;
    Publish();
  }

  /// A frame in the map for the viewer alone; sent again when it has moved.
  void SendFrame(const std::string& frame,
                 const Eigen::Vector3d& position,
                 const Eigen::Quaterniond& rotation) {
    constexpr double kMovedM = 0.05;
    if (frame.empty()) return;
    const auto it = frames_.find(frame);
    if (it != frames_.end() && (it->second - position).norm() < kMovedM) return;
    frames_[frame] = position;
    geometry_msgs::TransformStamped transform;
    transform.header = map_->header;
    transform.child_frame_id = frame;
    transform.transform.translation.x = position.x();
    transform.transform.translation.y = position.y();
    transform.transform.translation.z = position.z();
    transform.transform.rotation.x = rotation.x();
    transform.transform.rotation.y = rotation.y();
    transform.transform.rotation.z = rotation.z();
    transform.transform.rotation.w = rotation.w();
    broadcaster_.sendTransform(transform);
  }

  MapMarkerStyle Style() const {
    MapMarkerStyle style;
    style.color = config_.color == "order"   ? dendro::MeshColor::kByOrder
                  : config_.color == "sigma" ? dendro::MeshColor::kBySigma
                                             : dendro::MeshColor::kByBranch;
    style.labels = config_.labels;
    style.skeleton = config_.skeleton;
    style.alpha = config_.alpha;
    style.label_height_m = config_.label_height_m;
    style.label_min_radius_m = config_.label_min_radius_m;
    style.max_triangles = config_.max_triangles;
    return style;
  }

  void Publish() {
    if (!map_ || markers_.getNumSubscribers() == 0) return;
    Send(changes_.Next(MapMarkers(model_, Style(), map_->header.frame_id)));
  }

  void Flash(const dendro_slam::GraphStatus& status) {
    if (!map_ || !config_.updates || markers_.getNumSubscribers() == 0) return;
    std::vector<int> landmarks;
    for (const auto& observation : status.observations) {
      if (observation.landmark_id >= 0) landmarks.push_back(observation.landmark_id);
    }
    Send(UpdateMarkers(model_, landmarks, ToNs(status.header.stamp), map_->header.frame_id));
  }

  void Send(const visualization_msgs::MarkerArray& markers) {
    if (!markers.markers.empty()) markers_.publish(markers);
  }

  MapVisualizationNodeConfig config_;
  dendro_slam::TreeMapConstPtr map_;
  dendro::TreeModel model_;
  MarkerChanges changes_;
  ros::Publisher markers_;
  ros::Subscriber map_subscriber_;
  ros::Subscriber path_subscriber_;
  ros::Subscriber status_subscriber_;
  tf2_ros::StaticTransformBroadcaster broadcaster_;
  std::map<std::string, Eigen::Vector3d> frames_;
  ros::WallTimer timer_;
};

}  // namespace dendro_ros

PLUGINLIB_EXPORT_CLASS(dendro_ros::MapVisualization, nodelet::Nodelet)
