// Estimates where the lidar sits on the odometry's body, and the offset of their clocks, from a bag.

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <nav_msgs/Odometry.h>
#include <nlohmann/json.hpp>
#include <sensor_msgs/PointCloud2.h>
#include <tf2/buffer_core.h>
#include <tf2/exceptions.h>
#include <tf2_msgs/TFMessage.h>

#include <limits>
#include <optional>
#include <string>
#include <vector>

#include "dendro_slam/odometry/rig_calibrator.h"
#include "dendro_slam/ros/bag.h"
#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/ros/point_cloud2.h"
#include "dendro_slam/ros/progress.h"

namespace {

struct Options {
  std::string bag;
  std::string points_topic;
  std::string odometry_topic;
  double start_s = 0.0;
  double duration_s = 0.0;
  dendro::RigCalibratorConfig config;
};

nlohmann::json Vector(const Eigen::Vector3d& v) { return {v.x(), v.y(), v.z()}; }

/// The mounting that the bag itself states, for comparison.
std::optional<Eigen::Isometry3d> MountingInBag(const dendro_ros::BagReader& bag,
                                               const std::string& body,
                                               const std::string& lidar) {
  tf2::BufferCore tf;
  bag.ForEach({"/tf_static"}, [&](const rosbag::MessageInstance& message) {
    if (const auto transforms = message.instantiate<tf2_msgs::TFMessage>()) {
      for (const auto& transform : transforms->transforms) {
        tf.setTransform(transform, bag.path(), true);
      }
    }
  });
  try {
    return dendro_ros::FromMsg(tf.lookupTransform(body, lidar, ros::Time(0)).transform);
  } catch (const tf2::TransformException&) {
    return std::nullopt;
  }
}

int Run(const Options& options) {
  const dendro_ros::BagReader bag(options.bag);
  const std::string points = bag.ChooseTopic(options.points_topic, {"/velodyne_points"},
                                             "sensor_msgs/PointCloud2", "scans (--points)", true);
  const std::string odom =
      bag.ChooseTopic(options.odometry_topic,
                      {"/camera/odom/sample", "/mavros/local_position/odom"},
                      "nav_msgs/Odometry", "odometry (--odometry)", true);
  dendro::RigCalibrator calibrator(options.config);
  dendro::PoseBufferConfig buffer;
  buffer.max_poses = std::numeric_limits<int>::max();
  dendro::PoseBuffer odometry(buffer);
  std::string body_frame;
  std::string lidar_frame;
  std::optional<std::int64_t> first_ns;
  std::size_t unusable = 0;
  bag.ForEach({points, odom}, [&](const rosbag::MessageInstance& message) {
    if (!first_ns) first_ns = dendro_ros::ToNs(message.getTime());
    const double since_s = dendro::NsToSeconds(dendro_ros::ToNs(message.getTime()) - *first_ns);
    if (since_s < options.start_s) return;
    if (options.duration_s > 0.0 && since_s > options.start_s + options.duration_s) return;
    if (message.getTopic() == odom) {
      const auto sample = message.instantiate<nav_msgs::Odometry>();
      if (!sample) return;
      body_frame = sample->child_frame_id;
      odometry.Add(dendro_ros::ToNs(sample->header.stamp), dendro_ros::FromMsg(sample->pose.pose));
    } else if (const auto cloud = message.instantiate<sensor_msgs::PointCloud2>()) {
      lidar_frame = cloud->header.frame_id;
      const dendro::LidarScan scan = dendro_ros::ReadPointCloud2(*cloud, points);
      if (!scan.has_time) {
        throw dendro_ros::BagError(
            bag.path() + ": the clouds on " + points +
            " have no firing times (field 'time'), which the calibration needs; record the packets "
            "or let the driver publish them");
      }
      if (!calibrator.AddScan(scan)) ++unusable;
    }
  });
  dendro_ros::Progress progress("calibrating");
  const dendro::RigCalibration result =
      calibrator.Calibrate(odometry, [&progress](double done) { progress.Show(done); });
  const dendro::HandEyeResult& rig = result.rig;

  const Eigen::Quaterniond q(rig.T_body_lidar.linear());
  nlohmann::json out = {
      {"bag", options.bag},
      {"points_topic", points},
      {"odometry_topic", odom},
      {"parent_frame", body_frame},
      {"child_frame", lidar_frame},
      {"known", rig.known()},
      {"translation_m", nullptr},
      {"quaternion_xyzw", nullptr},
      {"time_offset_s", nullptr},
      {"rotation_sigma_deg", rig.rotation_sigma_deg},
      {"position_sigma_m", rig.position_sigma_m},
      {"least_sure_direction", Vector(rig.least_sure_direction)},
      {"time_sigma_s", rig.time_sigma_s},
      {"odometry_scale", rig.scale},
      {"residual_rotation_deg", rig.residual_rotation_deg},
      {"residual_position_m", rig.residual_position_m},
      {"motions", rig.num_motions},
      {"turn_rms_deg", Vector(rig.turn_rms_deg)},
      {"second_turn_deg", rig.second_turn_deg},
      {"distance_m", rig.distance_m},
      {"scans", result.scans},
      {"scans_registered", result.registered},
      {"registration_rms_m", result.registration_rms_m},
      {"passes", result.passes},
      {"missing", rig.missing},
  };
  // A number that the motion does not show is not given.
  if (rig.position_known && rig.rotation_known) {
    out["translation_m"] = Vector(rig.T_body_lidar.translation());
  }
  if (rig.rotation_known) out["quaternion_xyzw"] = {q.x(), q.y(), q.z(), q.w()};
  if (rig.time_known) out["time_offset_s"] = rig.time_offset_s;
  if (const auto stated = MountingInBag(bag, body_frame, lidar_frame)) {
    const dendro::Vector6d off = dendro::LogSe3(stated->inverse() * rig.T_body_lidar);
    if (rig.rotation_known) {
      out["off_tf_static_deg"] = off.head<3>().norm() * 57.29577951308232;
    }
    if (rig.position_known && rig.rotation_known) {
      out["off_tf_static_m"] = (stated->translation() - rig.T_body_lidar.translation()).norm();
    }
  }
  fmt::print("{}\n", out.dump(2));
  return rig.known() ? 0 : 3;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Finds where the lidar sits on the body whose pose the odometry gives, and the offset of "
               "their clocks, from a bag with scans and odometry. Prints one JSON object; exits with 3 "
               "when the motion does not show all of it and says which motion is missing");
  Options options;
  app.add_option("IN", options.bag, "bag to read")->required();
  app.add_option("--points", options.points_topic, "topic of the scans");
  app.add_option("--odometry", options.odometry_topic, "topic of the odometry");
  app.add_option("--start", options.start_s, "leave out the bag's beginning [s]")
      ->check(CLI::NonNegativeNumber);
  app.add_option("--duration", options.duration_s, "use only this much of it [s]")
      ->check(CLI::PositiveNumber);
  app.add_option("--max-time-offset", options.config.hand_eye.max_time_offset_s,
                 "look for time offsets up to this, either way [s]")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  CLI11_PARSE(app, argc, argv);
  try {
    return Run(options);
  } catch (const std::exception& error) {
    fmt::print(stderr, "calibrate_rig: {}\n", error.what());
    return 1;
  }
}
