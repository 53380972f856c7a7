#include <map>
#include <memory>
#include <optional>
#include <string>

#include <nav_msgs/Odometry.h>
#include <nodelet/nodelet.h>
#include <pluginlib/class_list_macros.hpp>
#include <sensor_msgs/PointCloud2.h>

#include "dendro_slam/odometry/wood_icp.h"
#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/ros/node_config.h"
#include "dendro_slam/ros/stage_diagnostics.h"
#include "dendro_slam/ros/worker.h"

namespace dendro_ros {

/// Labelled scans in, odometry from ICP on the wood out: one message per scan.
class WoodIcp : public nodelet::Nodelet {
 private:
  using Input = sensor_msgs::PointCloud2ConstPtr;

  void onInit() override {
    try {
      ros::NodeHandle& nh = getNodeHandle();
      const auto config =
          ReadConfig<WoodIcpNodeConfig>(ReadRosParams(getPrivateNodeHandle()), getName());
      odom_frame_ = config.odom_frame;
      diagnostics_ = std::make_unique<StageDiagnostics>(nh, getName(), "icp");
      icp_.emplace(config.stage);
      odometry_ = nh.advertise<nav_msgs::Odometry>("icp_odometry", 100);
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
    if (odometry_.getNumSubscribers() == 0) return;
    try {
      const Stopwatch watch;
      const dendro::LabelledScan scan = FromWoodScan(msg, subscriber_.getTopic());
      const auto motion = icp_->AddScan(scan, std::nullopt);
      if (icp_->status() == dendro::WoodIcpStatus::kTimeNotAhead) {
        NODELET_WARN("%s: time jumped back; ICP starts anew", subscriber_.getTopic().c_str());
      }
      const std::int64_t stamp_ns = scan.image.stamp_ns;
      if (motion) {
        T_icp_lidar_ = dendro::NormalizedSe3(T_icp_lidar_ * motion->T_from_to);
        odometry_.publish(ToIcpOdometry(*motion, T_icp_lidar_, odom_frame_, msg.header.frame_id));
      } else {
        diagnostics_->Show(std::string("without motion, ") + ToString(icp_->status()),
                           ++without_motion_[icp_->status()]);
        odometry_.publish(ToIcpOdometryWithoutMotion(
            stamp_ns, T_icp_lidar_, odom_frame_, msg.header.frame_id));
      }
      diagnostics_->Show("iterations", icp_->iterations());
      diagnostics_->Show("correspondences", icp_->num_correspondences());
      diagnostics_->Processed(stamp_ns, watch.Seconds());
    } catch (const std::exception& error) {
      diagnostics_->Dropped("unusable");
      diagnostics_->Problem(error.what());
      NODELET_ERROR_THROTTLE(5.0, "scan dropped: %s", error.what());
    }
  }

  std::unique_ptr<StageDiagnostics> diagnostics_;
  std::string odom_frame_;
  std::optional<dendro::WoodIcp> icp_;
  std::map<dendro::WoodIcpStatus, int> without_motion_;
  Eigen::Isometry3d T_icp_lidar_ = Eigen::Isometry3d::Identity();
  ros::Publisher odometry_;
  ros::Subscriber subscriber_;
  std::unique_ptr<Worker<Input>> worker_;  // Last: its thread uses everything above.
};

}  // namespace dendro_ros

PLUGINLIB_EXPORT_CLASS(dendro_ros::WoodIcp, nodelet::Nodelet)
