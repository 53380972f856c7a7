// What stages 1 to 3 make of one scan of a bag, as JSON: every return with its label and segment, every
// segment with where its fit started and where it ended. scripts/draw_scan.py draws it.

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <nav_msgs/Odometry.h>
#include <nlohmann/json.hpp>
#include <sensor_msgs/PointCloud2.h>
#include <tf2/buffer_core.h>
#include <tf2_msgs/TFMessage.h>

#include <cmath>
#include <cstdlib>
#include <optional>
#include <string>
#include <vector>

#include "dendro_slam/io/map_directory.h"
#include "dendro_slam/mapping/pipeline.h"
#include "dendro_slam/ros/bag.h"
#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/ros/lidar_mount.h"
#include "dendro_slam/ros/node_config.h"
#include "dendro_slam/ros/point_cloud2.h"

namespace {

using Json = nlohmann::ordered_json;

constexpr std::int64_t kOdometryWindowNs = 2000000000;

struct Options {
  std::string bag, output, points_topic, odometry_topic, config;
  int index = -1;
  double stamp_s = 0.0;  // of the data, or from the bag's first scan when small
  bool by_stamp = false;
};

struct Found {
  dendro::LidarScan scan;
  std::string frame;
  int index = -1;
};

double Rounded(double value, double scale = 1e6) { return std::round(value * scale) / scale; }

Json Vec(const Eigen::Vector3d& v) { return {Rounded(v.x()), Rounded(v.y()), Rounded(v.z())}; }

/// The scan by its number, or the one nearest to the stamp.
Found FindScan(const dendro_ros::BagReader& bag, const std::string& topic, const Options& options) {
  std::vector<std::int64_t> stamps;
  bag.ForEach({topic}, [&](const rosbag::MessageInstance& message) {
    // The time of recording is near the stamp of the data: near enough to know which few to decode.
    stamps.push_back(dendro_ros::ToNs(message.getTime()));
  });
  if (stamps.empty()) {
    throw dendro_ros::BagError(fmt::format("{}: no scan on {}", bag.path(), topic));
  }
  int wanted = options.index;
  if (options.by_stamp) {
    // Stamps below a day are counted from the first scan.
    const double offset = options.stamp_s < 86400.0 ? 1e-9 * static_cast<double>(stamps[0]) : 0.0;
    double least = 1e300;
    for (std::size_t i = 0; i < stamps.size(); ++i) {
      const double off = std::abs(1e-9 * static_cast<double>(stamps[i]) - offset - options.stamp_s);
      if (off >= least) continue;
      least = off;
      wanted = static_cast<int>(i);
    }
    if (least > 1.0) {
      throw dendro_ros::BagError(fmt::format(
          "{}: no scan within a second of {}; the scans span {:.3f} to {:.3f} ({:.1f} s)",
          bag.path(),
          options.stamp_s,
          1e-9 * static_cast<double>(stamps.front()),
          1e-9 * static_cast<double>(stamps.back()),
          1e-9 * static_cast<double>(stamps.back() - stamps.front())));
    }
  }
  if (wanted < 0 || wanted >= static_cast<int>(stamps.size())) {
    throw dendro_ros::BagError(fmt::format(
        "{}: no scan {}; there are 0 to {}", bag.path(), wanted, stamps.size() - 1));
  }
  Found found;
  int at = 0;
  bag.ForEach({topic}, [&](const rosbag::MessageInstance& message) {
    if (at++ != wanted) return;
    const auto cloud = message.instantiate<sensor_msgs::PointCloud2>();
    if (!cloud) return;
    found.scan = dendro_ros::ReadPointCloud2(*cloud, topic);
    found.frame = cloud->header.frame_id;
    found.index = wanted;
  });
  if (found.index < 0) {
    throw dendro_ros::BagError(fmt::format("{}: scan {} cannot be read", bag.path(), wanted));
  }
  return found;
}

Json Describe(const Found& found,
              const dendro::LabelledScan& scan,
              const std::vector<dendro::Segment>& segments,
              const dendro::CylinderFitter& fitter) {
  Json j;
  j["stamp_ns"] = scan.image.stamp_ns;
  j["index"] = found.index;
  j["frame"] = found.frame;
  j["deskewed"] = scan.image.deskewed;
  std::vector<int> segment_of(scan.image.size(), -1);
  for (const dendro::Segment& segment : segments) {
    for (const std::int32_t pixel : segment.pixels) {
      segment_of[static_cast<std::size_t>(pixel)] = segment.id;
    }
  }
  // x y z [m], label (0 none, 1 ground, 2 wood, 3 leaf, 4 other), segment (-1 none), ring
  Json& points = j["points"] = Json::array();
  for (std::size_t i = 0; i < scan.image.size(); ++i) {
    if (!scan.image.HasReturn(i)) continue;
    const Eigen::Vector3d p = scan.image.point[i].cast<double>();
    points.push_back({Rounded(p.x(), 1e4),
                      Rounded(p.y(), 1e4),
                      Rounded(p.z(), 1e4),
                      static_cast<int>(scan.label[i]),
                      segment_of[i],
                      static_cast<int>(i) / scan.image.cols});
  }
  Json& list = j["segments"] = Json::array();
  for (const dendro::Segment& segment : segments) {
    const dendro::FittedCylinder fit = fitter.FitSegment(scan, segment);
    Json s;
    s["id"] = segment.id;
    s["num_pixels"] = segment.pixels.size();
    s["status"] = dendro::ToString(fit.status);
    s["reason"] = dendro::ToString(fit.reason);
    s["initial"] = nullptr;
    if (const auto initial = fitter.Initial(scan, segment)) {
      s["initial"] = {{"axis", Vec(initial->axis)},
                      {"point", Vec(initial->point)},
                      {"foot", Vec(initial->Foot())},
                      {"radius_m", Rounded(initial->radius())}};
    }
    s["final"] = nullptr;
    if (fit.status == dendro::FitStatus::kMeasured) {
      s["final"] = {{"axis", Vec(fit.cylinder.axis)},
                    {"point", Vec(fit.cylinder.point)},
                    {"foot", Vec(fit.cylinder.Foot())},
                    {"radius_m", Rounded(fit.cylinder.radius())},
                    {"radius_sigma_m", Rounded(fit.radius_sigma_m())},
                    {"taper_m_per_m", Rounded(fit.taper_m_per_m)},
                    {"start_s_m", Rounded(fit.start_s_m)},
                    {"end_s_m", Rounded(fit.end_s_m)},
                    {"visible_arc_rad", Rounded(fit.visible_arc_rad)},
                    {"num_rings", fit.num_rings}};
    }
    list.push_back(std::move(s));
  }
  return j;
}

void Run(const Options& options) {
  const dendro_ros::BagReader bag(options.bag);
  dendro_ros::NodesConfig nodes;
  if (!options.config.empty()) {
    nodes = dendro_ros::ReadConfig<dendro_ros::NodesConfig>(
        dendro_ros::ReadYamlFile(options.config), options.config);
  }
  const std::string points_topic = bag.ChooseTopic(options.points_topic,
                                                   {"/velodyne_points"},
                                                   "sensor_msgs/PointCloud2",
                                                   "scans (--points)",
                                                   true);
  const std::string odometry_topic =
      bag.ChooseTopic(options.odometry_topic,
                      {"/camera/odom/sample", "/mavros/local_position/odom"},
                      "nav_msgs/Odometry",
                      "odometry (--odometry)",
                      false);
  const Found found = FindScan(bag, points_topic, options);
  tf2::BufferCore tf;
  bag.ForEach({"/tf_static", "/tf"}, [&](const rosbag::MessageInstance& message) {
    const auto transforms = message.instantiate<tf2_msgs::TFMessage>();
    if (!transforms) return;
    for (const auto& transform : transforms->transforms) {
      tf.setTransform(transform, bag.path(), message.getTopic() == "/tf_static");
    }
  });
  dendro::PoseBuffer poses(nodes.wood_segmentation.stage.pose_buffer);
  std::string body_frame;
  if (!odometry_topic.empty()) {
    bag.ForEach({odometry_topic}, [&](const rosbag::MessageInstance& message) {
      const auto odometry = message.instantiate<nav_msgs::Odometry>();
      if (!odometry) return;
      const std::int64_t stamp_ns = dendro_ros::ToNs(odometry->header.stamp);
      if (std::abs(stamp_ns - found.scan.stamp_ns) > kOdometryWindowNs) return;
      poses.Add(stamp_ns, dendro_ros::FromMsg(odometry->pose.pose));
      body_frame = odometry->child_frame_id;
    });
  }
  dendro_ros::LidarMount mount(nodes.wood_segmentation.lidar_mount, &tf);
  const auto T_body_lidar = poses.empty() ? std::nullopt : mount.Find(body_frame, found.frame);
  dendro::WoodSegmentationStage stage(nodes.wood_segmentation.stage);
  const dendro::LabelledScan scan =
      stage.Process(found.scan,
                    T_body_lidar ? &poses : nullptr,
                    T_body_lidar.value_or(Eigen::Isometry3d::Identity()));
  const dendro::BranchSeparator separator(nodes.branch_separation.stage);
  const dendro::CylinderFitter fitter(nodes.cylinder_fitting.stage);
  const std::vector<dendro::Segment> segments = separator.Separate(scan);
  const std::string text = Describe(found, scan, segments, fitter).dump() + "\n";
  if (options.output.empty()) {
    fmt::print("{}", text);
  } else {
    dendro::WriteFileAtomically(options.output, text);
  }
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("What stages 1 to 3 make of one scan of a bag, as JSON");
  Options options;
  app.add_option("BAG", options.bag, "bag to read")->required();
  auto* index = app.add_option("--index", options.index, "number of the scan, from 0");
  auto* stamp =
      app.add_option("--stamp",
                     options.stamp_s,
                     "stamp of the scan [s]; below 86400 counted from the first scan")
          ->excludes(index);
  app.add_option("-o,--output", options.output, "file to write; default standard output");
  app.add_option("--config", options.config, "YAML file with sections of the nodelets");
  app.add_option("--points", options.points_topic, "topic of the scans");
  app.add_option("--odometry", options.odometry_topic, "topic of the odometry");
  CLI11_PARSE(app, argc, argv);
  options.by_stamp = stamp->count() > 0;
  if (!options.by_stamp && index->count() == 0) {
    fmt::print(stderr, "describe_scan: give --stamp or --index\n");
    return 2;
  }
  try {
    Run(options);
  } catch (const std::exception& error) {
    fmt::print(stderr, "describe_scan: {}\n", error.what());
    return 1;
  }
  return 0;
}
