#include <memory>
#include <optional>

#include <nodelet/nodelet.h>
#include <pluginlib/class_list_macros.hpp>
#include <sensor_msgs/PointCloud2.h>

#include "dendro_slam/branch_separation/branch_separator.h"
#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/ros/markers.h"
#include "dendro_slam/ros/node_config.h"
#include "dendro_slam/ros/stage_diagnostics.h"
#include "dendro_slam/ros/worker.h"

namespace dendro_ros {

/// Labelled scans in, trunk and branch instances out (stage 2).
class BranchSeparation : public nodelet::Nodelet {
 private:
  using Input = sensor_msgs::PointCloud2ConstPtr;

  void onInit() override {
    try {
      ros::NodeHandle& nh = getNodeHandle();
      const auto config = ReadConfig<BranchSeparationNodeConfig>(
          ReadRosParams(getPrivateNodeHandle()), getName());
      diagnostics_ = std::make_unique<StageDiagnostics>(nh, getName(), "branch_separation");
      separator_.emplace(config.stage);
      segments_ = nh.advertise<dendro_slam::Segments>("segments", 5);
      segment_cloud_ = nh.advertise<sensor_msgs::PointCloud2>("segment_cloud", 2);
      worker_ = std::make_unique<Worker<Input>>(static_cast<std::size_t>(config.queue_size),
                                                [this](Input& scan) { Work(*scan); });
      subscriber_ = nh.subscribe<sensor_msgs::PointCloud2>(
          "wood_scan", 100, [this](const sensor_msgs::PointCloud2ConstPtr& scan) {
            diagnostics_->Dropped("queue full", worker_->Push(scan, true));
          });
    } catch (const std::exception& error) {
      NODELET_FATAL("%s", error.what());
      throw;
    }
  }

  void Work(const sensor_msgs::PointCloud2& msg) {
    if (segments_.getNumSubscribers() + segment_cloud_.getNumSubscribers() == 0) return;
    try {
      const Stopwatch watch;
      const dendro::LabelledScan scan = FromWoodScan(msg, subscriber_.getTopic());
      const std::vector<dendro::Segment> segments = separator_->Separate(scan);
      segments_.publish(ToMsg(segments, scan.image.stamp_ns, msg.header.frame_id));
      diagnostics_->Show("segments", static_cast<double>(segments.size()));
      diagnostics_->Processed(scan.image.stamp_ns, watch.Seconds());
      if (segment_cloud_.getNumSubscribers() > 0) {
        segment_cloud_.publish(SegmentCloud(scan, segments, msg.header.frame_id));
      }
    } catch (const std::exception& error) {
      diagnostics_->Dropped("unusable");
      diagnostics_->Problem(error.what());
      NODELET_ERROR_THROTTLE(5.0, "scan dropped: %s", error.what());
    }
  }

  std::unique_ptr<StageDiagnostics> diagnostics_;
  std::optional<dendro::BranchSeparator> separator_;
  ros::Publisher segments_;
  ros::Publisher segment_cloud_;
  ros::Subscriber subscriber_;
  std::unique_ptr<Worker<Input>> worker_;  // Last: its thread uses everything above.
};

}  // namespace dendro_ros

PLUGINLIB_EXPORT_CLASS(dendro_ros::BranchSeparation, nodelet::Nodelet)
