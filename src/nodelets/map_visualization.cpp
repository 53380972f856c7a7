#include <memory>

#include <nodelet/nodelet.h>
#include <pluginlib/class_list_macros.hpp>
#include <visualization_msgs/MarkerArray.h>

#include "dendro_slam/TreeMap.h"
#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/ros/markers.h"
#include "dendro_slam/ros/node_config.h"

namespace dendro_ros {

/// The map in, rviz markers out.
class MapVisualization : public nodelet::Nodelet {
 private:
  void onInit() override {
    try {
      ros::NodeHandle& nh = getNodeHandle();
      const auto config = ReadConfig<MapVisualizationNodeConfig>(
          ReadRosParams(getPrivateNodeHandle()), getName());
      style_.color = config.color == "order"   ? dendro::MeshColor::kByOrder
                     : config.color == "sigma" ? dendro::MeshColor::kBySigma
                                               : dendro::MeshColor::kByBranch;
      style_.labels = config.labels;
      style_.skeleton = config.skeleton;
      // A viewer that comes late gets the latched map through its own first subscription.
      markers_ = nh.advertise<visualization_msgs::MarkerArray>(
          "map_markers", 1, [this](const ros::SingleSubscriberPublisher&) { Publish(); });
      subscriber_ = nh.subscribe<dendro_slam::TreeMap>(
          "tree_map", 2, [this](const dendro_slam::TreeMapConstPtr& map) {
            map_ = map;
            Publish();
          });
    } catch (const std::exception& error) {
      NODELET_FATAL("%s", error.what());
      throw;
    }
  }

  void Publish() {
    if (!map_ || markers_.getNumSubscribers() == 0) return;
    try {
      markers_.publish(MapMarkers(FromMsg(*map_), style_, map_->header.frame_id));
    } catch (const std::exception& error) {
      NODELET_ERROR_THROTTLE(5.0, "map not shown: %s", error.what());
    }
  }

  MapMarkerStyle style_;
  dendro_slam::TreeMapConstPtr map_;
  ros::Publisher markers_;
  ros::Subscriber subscriber_;
};

}  // namespace dendro_ros

PLUGINLIB_EXPORT_CLASS(dendro_ros::MapVisualization, nodelet::Nodelet)
