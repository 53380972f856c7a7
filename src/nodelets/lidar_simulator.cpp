#include <atomic>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <thread>

#include <geometry_msgs/PoseStamped.h>
#include <nav_msgs/Odometry.h>
#include <nodelet/nodelet.h>
#include <pluginlib/class_list_macros.hpp>
#include <rosgraph_msgs/Clock.h>
#include <sensor_msgs/Imu.h>
#include <sensor_msgs/PointCloud2.h>
#include <tf2_ros/static_transform_broadcaster.h>
#include <tf2_ros/transform_broadcaster.h>

#include "dendro_slam/TreeMap.h"
#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/ros/node_config.h"
#include "dendro_slam/ros/point_cloud2.h"
#include "dendro_slam/ros/rig_messages.h"

namespace dendro_ros {

/// A scene and a path (or poses from a pilot) in, what the rig publishes out, paced.
class LidarSimulator : public nodelet::Nodelet {
 public:
  ~LidarSimulator() override {
    stopping_ = true;
    if (thread_.joinable()) thread_.join();
  }

 private:
  void onInit() override {
    try {
      ros::NodeHandle& nh = getNodeHandle();
      config_ =
          ReadConfig<LidarSimulatorNodeConfig>(ReadRosParams(getPrivateNodeHandle()), getName());
      if (!config_.scene.empty()) Load();
      points_ = nh.advertise<sensor_msgs::PointCloud2>("velodyne_points", 10);
      odometry_ = nh.advertise<nav_msgs::Odometry>("odometry", 1000);
      truth_pose_ = nh.advertise<geometry_msgs::PoseStamped>("ground_truth/lidar_pose", 10);
      truth_labels_ = nh.advertise<sensor_msgs::PointCloud2>("ground_truth/labels", 10);
      truth_hits_ = nh.advertise<sensor_msgs::PointCloud2>("ground_truth/hits", 10);
      truth_trees_ = nh.advertise<dendro_slam::TreeMap>("ground_truth/tree_map", 1, true);
      if (config_.publish_imu) imu_ = nh.advertise<sensor_msgs::Imu>("imu/data_raw", 1000);
      if (config_.publish_clock) clock_ = nh.advertise<rosgraph_msgs::Clock>("/clock", 10);
      if (followed_) {
        pose_ = nh.subscribe<geometry_msgs::PoseStamped>(
            "pose", 10, [this](const geometry_msgs::PoseStamped::ConstPtr& pose) { SteerTo(*pose); });
      }
      if (simulator_) {
        thread_ = std::thread([this] { Fly(); });
      } else {
        NODELET_WARN("no scene: nothing is simulated; set ~scene and ~path");
      }
    } catch (const std::exception& error) {
      NODELET_FATAL("%s", error.what());
      throw;
    }
  }

  void Load() {
    scene_ = dendro::LoadScene(config_.scene);
    path_.emplace(dendro::LoadFlightPath(config_.path));
    path_->odometry.seed = config_.seed;
    if (!config_.odometry.empty()) path_->odometry.model = config_.odometry;
    dendro::LidarSimulatorConfig lidar = config_.lidar;
    lidar.seed = config_.seed;
    raycaster_.emplace(scene_);
    simulator_.emplace(*raycaster_, lidar, path_->start_stamp_ns);
    rig_.emplace(*path_);
    motion_ = [this](double time_s) { return path_->trajectory.Pose(time_s); };
    if (config_.pose_source == "topic") {
      followed_.emplace(path_->trajectory.Pose(0.0), config_.follower);
      motion_ = [this](double time_s) { return followed_->Pose(time_s); };
    }
  }

  void SteerTo(const geometry_msgs::PoseStamped& pose) {
    const std::string& frame = pose.header.frame_id;
    if (!frame.empty() && frame != RigMessages::kMapFrame) {
      NODELET_ERROR_THROTTLE(5.0, "%s: frame '%s', expected 'map'; ignored", pose_.getTopic().c_str(), frame.c_str());
      return;
    }
    try {
      followed_->SetTarget(FromMsg(pose.pose));
    } catch (const std::exception& error) {
      NODELET_ERROR_THROTTLE(5.0, "%s: %s; ignored", pose_.getTopic().c_str(), error.what());
    }
  }

  void Fly() {
    try {
      tf2_ros::StaticTransformBroadcaster static_transforms;
      static_transforms.sendTransform(rig_->StaticTransforms().transforms);
      truth_trees_.publish(RigMessages::TruthTrees(scene_, path_->start_stamp_ns));
      dendro::OdometrySimulator odometry(motion_, path_->start_stamp_ns, path_->odometry);
      dendro::ImuSimulatorConfig imu_config = config_.imu;
      imu_config.seed = config_.seed;
      dendro::ImuSimulator imu(motion_, path_->start_stamp_ns, imu_config);
      const auto pose = [this](std::int64_t stamp_ns) {
        return motion_(dendro::NsToSeconds(stamp_ns - path_->start_stamp_ns)) * path_->T_base_lidar;
      };
      // A pilot may fly as long as they like.
      const int num_scans = followed_ ? std::numeric_limits<int>::max() : simulator_->NumScans(path_->duration_s);
      const ros::SteadyTime started = ros::SteadyTime::now();
      for (int index = 0; index < num_scans && !stopping_; ++index) {
        const std::int64_t end_ns = simulator_->ScanStamp(index + 1);
        const double end_s = dendro::NsToSeconds(end_ns - path_->start_stamp_ns);
        if (followed_) {
          // The revolution's time must pass before the pilot's poses of it are known.
          Pace(started, end_s);
          followed_->AdvanceTo(end_s + 1.0 / imu_config.rate_hz);
        }
        const dendro::SimulatedScan scan = simulator_->SimulateScan(index, pose);
        Pace(started, end_s);
        PublishOdometry(odometry, end_s);
        if (config_.publish_imu) {
          for (const dendro::ImuSample& sample : imu.AdvanceTo(end_s)) {
            imu_.publish(RigMessages::Imu(sample, imu_config));
          }
        }
        PublishClock(end_ns);
        points_.publish(ToVelodyneCloud(scan.scan, RigMessages::kLidarFrame));
        truth_pose_.publish(RigMessages::TruthLidarPose(scan));
        if (truth_labels_.getNumSubscribers() > 0) {
          truth_labels_.publish(RigMessages::TruthLabels(scan));
        }
        if (truth_hits_.getNumSubscribers() > 0) truth_hits_.publish(RigMessages::TruthHits(scan));
      }
      NODELET_INFO("the flight is over");
    } catch (const std::exception& error) {
      NODELET_ERROR("the simulation ended: %s", error.what());
    }
  }

  /// Waits until the simulated time may go on to `end_s`, in short steps, so that unloading is prompt.
  void Pace(const ros::SteadyTime& started, double end_s) {
    const ros::WallDuration step(0.01);
    while (!stopping_ && (ros::SteadyTime::now() - started).toSec() * config_.rate < end_s) {
      step.sleep();
    }
  }

  void PublishOdometry(dendro::OdometrySimulator& odometry, double until_s) {
    for (const dendro::OdometrySample& sample : odometry.AdvanceTo(until_s)) {
      PublishClock(sample.stamp_ns);
      odometry_.publish(rig_->Odometry(sample));
      broadcaster_.sendTransform(rig_->OdometryTransform(sample).transforms);
    }
  }

  void PublishClock(std::int64_t stamp_ns) {
    if (!config_.publish_clock) return;
    rosgraph_msgs::Clock clock;
    clock.clock = ToRosTime(stamp_ns);
    clock_.publish(clock);
  }

  LidarSimulatorNodeConfig config_;
  dendro::Scene scene_;
  std::optional<dendro::FlightPath> path_;
  std::optional<dendro::Raycaster> raycaster_;
  std::optional<dendro::LidarSimulator> simulator_;
  std::optional<RigMessages> rig_;
  std::optional<dendro::FollowedMotion> followed_;  ///< When a pilot steers.
  dendro::MotionFunction motion_;                   ///< T_map_base over time.
  tf2_ros::TransformBroadcaster broadcaster_;
  ros::Publisher points_;
  ros::Publisher odometry_;
  ros::Publisher truth_pose_;
  ros::Publisher truth_labels_;
  ros::Publisher truth_hits_;
  ros::Publisher truth_trees_;
  ros::Publisher imu_;
  ros::Publisher clock_;
  ros::Subscriber pose_;
  std::atomic<bool> stopping_{false};
  std::thread thread_;
};

}  // namespace dendro_ros

PLUGINLIB_EXPORT_CLASS(dendro_ros::LidarSimulator, nodelet::Nodelet)
