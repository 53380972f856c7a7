#include <memory>
#include <optional>
#include <utility>
#include <variant>

#include <nav_msgs/Odometry.h>
#include <nodelet/nodelet.h>
#include <pluginlib/class_list_macros.hpp>
#include <sensor_msgs/Image.h>
#include <sensor_msgs/PointCloud2.h>
#include <tf2_ros/buffer.h>
#include <tf2_ros/transform_listener.h>

#include "dendro_slam/mapping/pipeline.h"
#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/ros/markers.h"
#include "dendro_slam/ros/node_config.h"
#include "dendro_slam/ros/point_cloud2.h"
#include "dendro_slam/ros/scan_gate.h"
#include "dendro_slam/ros/stage_diagnostics.h"
#include "dendro_slam/ros/worker.h"

namespace dendro_ros {

/// Scans and odometry in, labelled range images out (stage 1).
class WoodSegmentation : public nodelet::Nodelet {
 private:
  struct WaitingScan {
    dendro::LidarScan scan;
    std::string frame_id;
  };
  using Input = std::variant<sensor_msgs::PointCloud2ConstPtr, nav_msgs::OdometryConstPtr>;

  void onInit() override {
    try {
      ros::NodeHandle& nh = getNodeHandle();
      config_ = ReadConfig<WoodSegmentationNodeConfig>(ReadRosParams(getPrivateNodeHandle()),
                                                       getName());
      diagnostics_ = std::make_unique<StageDiagnostics>(nh, getName(), "segmentation");
      stage_ = std::make_unique<dendro::WoodSegmentationStage>(config_.stage);
      tf_listener_ = std::make_unique<tf2_ros::TransformListener>(tf_, nh, false);
      gate_.emplace(config_.stage.odometry_timeout_s,
                    static_cast<std::size_t>(config_.queue_size),
                    config_.stage.pose_buffer,
                    LidarMount(config_.lidar_mount, &tf_));
      wood_scan_ = nh.advertise<sensor_msgs::PointCloud2>("wood_scan", 5);
      label_cloud_ = nh.advertise<sensor_msgs::PointCloud2>("label_cloud", 2);
      range_image_ = nh.advertise<sensor_msgs::Image>("range_image", 2);
      label_image_ = nh.advertise<sensor_msgs::Image>("label_image", 2);
      worker_ = std::make_unique<Worker<Input>>(static_cast<std::size_t>(config_.queue_size),
                                                [this](Input& input) { Work(input); });
      if (config_.use_odometry) {
        odometry_subscriber_ = nh.subscribe<nav_msgs::Odometry>(
            "odometry", 1000, [this](const nav_msgs::OdometryConstPtr& odometry) {
              worker_->Push(odometry, false);
            });
      }
      points_subscriber_ = nh.subscribe<sensor_msgs::PointCloud2>(
          "velodyne_points", 100, [this](const sensor_msgs::PointCloud2ConstPtr& cloud) {
            diagnostics_->Dropped("queue full", worker_->Push(cloud, true));
          });
    } catch (const std::exception& error) {
      NODELET_FATAL("%s", error.what());
      throw;
    }
  }

  void Work(Input& input) {
    try {
      if (const auto* odometry = std::get_if<nav_msgs::OdometryConstPtr>(&input)) {
        OnOdometry(**odometry);
      } else {
        OnCloud(*std::get<sensor_msgs::PointCloud2ConstPtr>(input));
      }
      while (std::optional<WaitingScan> waiting = gate_->Pop()) Process(*waiting);
    } catch (const std::exception& error) {
      diagnostics_->Dropped("unusable");
      diagnostics_->Problem(error.what());
      NODELET_ERROR_THROTTLE(5.0, "scan dropped: %s", error.what());
    }
  }

  void OnOdometry(const nav_msgs::Odometry& odometry) {
    switch (gate_->AddOdometry(odometry)) {
      case GateEvent::kTimeJumpedBack:
        NODELET_WARN("%s: time jumped back; the waiting scans and poses are forgotten",
                     odometry_subscriber_.getTopic().c_str());
        break;
      case GateEvent::kInvalid:
        NODELET_WARN_THROTTLE(5.0,
                              "%s: a pose is not finite or its quaternion is not one; ignored",
                              odometry_subscriber_.getTopic().c_str());
        break;
      default:
        break;
    }
  }

  void OnCloud(const sensor_msgs::PointCloud2& cloud) {
    const std::string topic = points_subscriber_.getTopic();
    dendro::LidarScan scan = ReadPointCloud2(cloud, topic);
    if (scan.points.empty()) {
      diagnostics_->Dropped("empty");
      NODELET_WARN_THROTTLE(5.0, "%s: empty cloud; is the lidar's view covered?", topic.c_str());
      return;
    }
    if (!scan.has_ring && !std::exchange(said_no_ring_, true)) {
      NODELET_WARN("%s: no field 'ring'; rings are derived from the elevation", topic.c_str());
    }
    if (!scan.has_time && !std::exchange(said_no_time_, true)) {
      NODELET_WARN("%s: no field 'time'; firing times are derived from the azimuth (a driver that "
                   "publishes them is better)",
                   topic.c_str());
    }
    std::size_t dropped = 0;
    const std::int64_t stamp_ns = scan.stamp_ns;
    const std::int64_t need_ns = stage_->SweepEnd(scan);
    const GateEvent event = gate_->AddScan(stamp_ns,
                                           need_ns,
                                           cloud.header.frame_id,
                                           {std::move(scan), cloud.header.frame_id},
                                           &dropped);
    diagnostics_->Dropped("waiting for odometry", dropped);
    if (event == GateEvent::kRefused) {
      diagnostics_->Dropped("not in order");
      NODELET_WARN_THROTTLE(5.0, "%s: a scan is not later than the one before", topic.c_str());
    } else if (event == GateEvent::kTimeJumpedBack) {
      NODELET_WARN("%s: time jumped back; the waiting scans and poses are forgotten", topic.c_str());
    }
  }

  void Process(const WaitingScan& waiting) {
    if (wood_scan_.getNumSubscribers() + label_cloud_.getNumSubscribers() +
            range_image_.getNumSubscribers() + label_image_.getNumSubscribers() ==
        0) {
      return;
    }
    const Stopwatch watch;
    if (!gate_->mount_error().empty()) {
      NODELET_ERROR_THROTTLE(10.0, "%s", gate_->mount_error().c_str());
    }
    const dendro::LabelledScan scan =
        stage_->Process(waiting.scan, gate_->poses(), gate_->T_body_lidar());
    wood_scan_.publish(ToWoodScan(scan, waiting.frame_id));
    diagnostics_->Show("sweep motion removed", scan.image.deskewed ? 1 : 0);
    diagnostics_->Show("points not finite", stage_->report().nan_points);
    diagnostics_->Show("scans waiting", static_cast<double>(gate_->size()));
    diagnostics_->Processed(scan.image.stamp_ns, watch.Seconds());
    if (label_cloud_.getNumSubscribers() > 0) {
      label_cloud_.publish(LabelCloud(scan, waiting.frame_id));
    }
    if (range_image_.getNumSubscribers() > 0) {
      range_image_.publish(ToRangeImageMsg(scan.image, waiting.frame_id));
    }
    if (label_image_.getNumSubscribers() > 0) {
      label_image_.publish(ToLabelImageMsg(scan, waiting.frame_id));
    }
  }

  WoodSegmentationNodeConfig config_;
  std::unique_ptr<StageDiagnostics> diagnostics_;
  std::unique_ptr<dendro::WoodSegmentationStage> stage_;
  tf2_ros::Buffer tf_;
  std::unique_ptr<tf2_ros::TransformListener> tf_listener_;
  std::optional<ScanGate<WaitingScan>> gate_;
  bool said_no_ring_ = false;
  bool said_no_time_ = false;
  ros::Publisher wood_scan_;
  ros::Publisher label_cloud_;
  ros::Publisher range_image_;
  ros::Publisher label_image_;
  ros::Subscriber odometry_subscriber_;
  ros::Subscriber points_subscriber_;
  std::unique_ptr<Worker<Input>> worker_;  // Last: its thread uses everything above.
};

}  // namespace dendro_ros

PLUGINLIB_EXPORT_CLASS(dendro_ros::WoodSegmentation, nodelet::Nodelet)
