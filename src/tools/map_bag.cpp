// Runs the whole pipeline over a bag, without a ROS master. Same bag and same settings, same bytes.

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <nav_msgs/Odometry.h>
#include <sensor_msgs/NavSatFix.h>
#include <sensor_msgs/PointCloud2.h>
#include <tf2/buffer_core.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <chrono>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "dendro_slam/io/map_directory.h"
#include "dendro_slam/mapping/pipeline.h"
#include "dendro_slam/ros/bag.h"
#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/ros/node_config.h"
#include "dendro_slam/ros/point_cloud2.h"
#include "dendro_slam/ros/progress.h"
#include "dendro_slam/ros/scan_gate.h"

namespace {

struct Options {
  std::string bag;
  std::string output;
  std::vector<std::string> configs;
  std::string load;
  bool per_scan = false;
  std::string points_topic;
  std::string odometry_topic;
  std::string fix_topic;
};

void Say(const std::string& line) { fmt::print(stderr, "map_bag: {}\n", line); }

/// Every file (or every file of a folder) may hold any of the nodelets' sections; a section must not
/// come twice.
dendro_ros::NodesConfig ReadConfigs(const std::vector<std::string>& paths) {
  dendro_ros::ParamTree::Map sections;
  std::string where;
  for (const std::string& path : paths) {
    std::vector<std::string> files;
    const bool folder = std::filesystem::is_directory(path);
    if (folder) {
      for (const auto& entry : std::filesystem::directory_iterator(path)) {
        if (entry.path().extension() == ".yaml") files.push_back(entry.path().string());
      }
      std::sort(files.begin(), files.end());
    } else {
      files.push_back(path);
    }
    for (const std::string& file : files) {
      where += (where.empty() ? "" : ", ") + file;
      const dendro_ros::ParamTree tree = dendro_ros::ReadYamlFile(file);
      for (const auto& section : tree.AsMap(file)) {
        // The package's config folder also holds what driver_bridge reads.
        if (folder && section.first == "rig") continue;
        if (!sections.insert(section).second) {
          throw dendro_ros::ParamError(
              fmt::format("{}: section '{}' was given before", file, section.first));
        }
      }
    }
  }
  dendro_ros::ParamTree merged;
  merged.value = std::move(sections);
  return dendro_ros::ReadConfig<dendro_ros::NodesConfig>(merged, where.empty() ? "defaults" : where);
}

/// All transforms of the bag, so that a mounting is known from the first scan on.
void ReadTransforms(const dendro_ros::BagReader& bag, tf2::BufferCore* tf) {
  bag.ForEach({"/tf_static", "/tf"}, [&](const rosbag::MessageInstance& message) {
    const auto transforms = message.instantiate<tf2_msgs::TFMessage>();
    if (!transforms) return;
    for (const geometry_msgs::TransformStamped& transform : transforms->transforms) {
      tf->setTransform(transform, bag.path(), message.getTopic() == "/tf_static");
    }
  });
}

struct Counts {
  std::size_t scans = 0;
  std::size_t mapped = 0;
  std::size_t empty = 0;
  std::size_t unusable = 0;
  std::size_t with_odometry = 0;
  std::size_t deskewed = 0;
  std::size_t resets = 0;
};

class Run {
 public:
  explicit Run(const Options& options)
      : options_(options),
        bag_(options.bag),
        nodes_(ReadConfigs(options.configs)),
        pipeline_(nodes_.Pipeline()),
        gate_(nodes_.wood_segmentation.stage.odometry_timeout_s,
              kGateCapacity,
              nodes_.wood_segmentation.stage.pose_buffer,
              dendro_ros::LidarMount(nodes_.wood_segmentation.lidar_mount, &tf_)) {}

  void operator()() {
    const auto started = std::chrono::steady_clock::now();
    points_topic_ = bag_.ChooseTopic(options_.points_topic,
                                     {"/velodyne_points"},
                                     "sensor_msgs/PointCloud2",
                                     "scans (--points)",
                                     true);
    if (nodes_.wood_segmentation.use_odometry) {
      odometry_topic_ = bag_.ChooseTopic(options_.odometry_topic,
                                         {"/camera/odom/sample", "/mavros/local_position/odom"},
                                         "nav_msgs/Odometry",
                                         "odometry (--odometry)",
                                         false);
    }
    if (odometry_topic_.empty()) Say("no odometry in the bag; ICP is the only odometry");
    try {
      fix_topic_ = bag_.ChooseTopic(options_.fix_topic,
                                    {"/fix", "/mavros/global_position/raw/fix"},
                                    "sensor_msgs/NavSatFix",
                                    "GNSS fixes (--fix)",
                                    false);
    } catch (const dendro_ros::BagError& error) {
      if (!options_.fix_topic.empty()) throw;
      Say(std::string(error.what()) + "; the map is not laid over them");
    }
    if (!options_.load.empty()) pipeline_.Load(dendro::LoadMap(options_.load));
    if (options_.per_scan) scan_writer_.emplace(options_.output);
    ReadTransforms(bag_, &tf_);

    std::vector<std::string> topics = {points_topic_};
    if (!odometry_topic_.empty()) topics.push_back(odometry_topic_);
    if (!fix_topic_.empty()) topics.push_back(fix_topic_);
    dendro_ros::Progress progress("mapping");
    bag_.ForEach(
        topics,
        [this](const rosbag::MessageInstance& message) { OnMessage(message); },
        [&progress](double fraction) { progress.Show(fraction); });

    if (counts_.mapped == 0) {
      throw dendro_ros::BagError(fmt::format(
          "{}: none of the {} clouds on {} could be mapped{}",
          bag_.path(),
          counts_.scans,
          points_topic_,
          last_error_.empty() ? "" : "; the last one: " + last_error_));
    }
    dendro::StageTimer& timer = pipeline_.timer();
    timer.set_data_duration_s(dendro::NsToSeconds(last_ns_ - first_ns_));
    timer.set_wall_duration_s(
        std::chrono::duration<double>(std::chrono::steady_clock::now() - started).count());
    dendro::MapFiles files = pipeline_.Files();
    files.frame = nodes_.tree_mapping.map_frame;
    dendro::SaveMap(options_.output, files, &timer);
    if (scan_writer_) scan_writer_->Finish();
    Report(files);
  }

 private:
  static constexpr std::size_t kGateCapacity = 1000;

  struct WaitingScan {
    dendro::LidarScan scan;
  };

  void OnMessage(const rosbag::MessageInstance& message) {
    if (message.getTopic() == points_topic_) {
      if (const auto cloud = message.instantiate<sensor_msgs::PointCloud2>()) OnCloud(*cloud);
    } else if (message.getTopic() == fix_topic_) {
      if (const auto msg = message.instantiate<sensor_msgs::NavSatFix>()) {
        if (const auto fix = dendro_ros::FromMsg(*msg)) pipeline_.AddFix(*fix);
      }
    } else if (const auto odometry = message.instantiate<nav_msgs::Odometry>()) {
      OnOdometry(*odometry);
    }
    while (const auto waiting = gate_.Pop()) Process(waiting->scan);
  }

  void OnOdometry(const nav_msgs::Odometry& odometry) {
    switch (gate_.AddOdometry(odometry)) {
      case dendro_ros::GateEvent::kTimeJumpedBack:
        StartAnew(odometry_topic_);
        [[fallthrough]];
      case dendro_ros::GateEvent::kAccepted:
        pipeline_.AddOdometry(dendro_ros::ToNs(odometry.header.stamp),
                              dendro_ros::FromMsg(odometry.pose.pose));
        break;
      case dendro_ros::GateEvent::kInvalid:
        SayOnce(&said_bad_pose_,
                odometry_topic_ + ": a pose is not finite or its quaternion is not one; ignored");
        break;
      case dendro_ros::GateEvent::kRefused:
        break;
    }
  }

  void OnCloud(const sensor_msgs::PointCloud2& cloud) {
    ++counts_.scans;
    dendro::LidarScan scan;
    try {
      scan = dendro_ros::ReadPointCloud2(cloud, points_topic_);
    } catch (const dendro_ros::PointCloud2Error& error) {
      ++counts_.unusable;
      last_error_ = error.what();
      SayOnce(&said_unusable_, last_error_);
      return;
    }
    if (scan.points.empty()) {
      ++counts_.empty;
      return;
    }
    if (!scan.has_ring) {
      SayOnce(&said_no_ring_,
              points_topic_ + ": no field 'ring'; rings are derived from the elevation");
    }
    if (!scan.has_time) {
      SayOnce(&said_no_time_,
              points_topic_ + ": no field 'time'; firing times are derived from the azimuth");
    }
    const std::int64_t stamp_ns = scan.stamp_ns;
    const std::int64_t need_ns = pipeline_.SweepEnd(scan);
    std::size_t dropped = 0;
    const auto event =
        gate_.AddScan(stamp_ns, need_ns, cloud.header.frame_id, {std::move(scan)}, &dropped);
    if (event == dendro_ros::GateEvent::kTimeJumpedBack) StartAnew(points_topic_);
    if (event == dendro_ros::GateEvent::kRefused) ++counts_.unusable;
  }

  void StartAnew(const std::string& topic) {
    Say(topic + ": time jumped back; the map starts anew");
    ++counts_.resets;
    pipeline_.Reset();
    last_ns_ = first_ns_ = -1;
  }

  void Process(const dendro::LidarScan& scan) {
    if (!gate_.mount_error().empty()) SayOnce(&said_no_mount_, gate_.mount_error());
    if (gate_.poses() != nullptr) pipeline_.SetMount(gate_.T_body_lidar());
    const dendro::PipelineResult result = pipeline_.Process(scan);
    ++counts_.mapped;
    counts_.with_odometry += result.had_odometry ? 1 : 0;
    counts_.deskewed += result.scan.image.deskewed ? 1 : 0;
    if (first_ns_ < 0) first_ns_ = scan.stamp_ns;
    last_ns_ = scan.stamp_ns;
    if (!result.mapping.warning.empty() && warnings_++ < kMaxWarnings) {
      Say(fmt::format("scan at {:.3f} s: {}",
                      dendro::NsToSeconds(scan.stamp_ns - first_ns_),
                      result.mapping.warning));
    }
    if (scan_writer_) scan_writer_->Add(result.scan, result.segments, result.cylinders);
  }

  void SayOnce(bool* said, const std::string& line) {
    if (!std::exchange(*said, true)) Say(line);
  }

  void Report(const dendro::MapFiles& files) const {
    fmt::print("{}: {} of {} scans mapped ({} with odometry, {} free of their motion)",
               options_.output,
               counts_.mapped,
               counts_.scans,
               counts_.with_odometry,
               counts_.deskewed);
    if (counts_.empty + counts_.unusable > 0) {
      fmt::print(", {} empty, {} unusable", counts_.empty, counts_.unusable);
    }
    if (gate_.size() > 0) {
      fmt::print(", the last {} not covered by the odometry", gate_.size());
    }
    fmt::print("; {} trees, {} branches, {} cylinders\n",
               files.model.trees.size(),
               files.model.branches.size(),
               files.model.cylinders.size());
    if (files.georeference) Report(*files.georeference);
  }

  static void Report(const dendro::Georeference& g) {
    fmt::print("{:.6f}, {:.6f} +- {:.1f} m ({} fixes, {} of them off)",
               g.origin.latitude_deg,
               g.origin.longitude_deg,
               g.horizontal_sigma_m,
               g.num_fixes,
               g.num_outliers);
    if (g.heading_deg) {
      fmt::print(", x axis {:.1f} +- {:.1f} degrees from north\n", *g.heading_deg, g.heading_sigma_deg);
    } else {
      fmt::print("; {}\n", g.note);
    }
  }

  static constexpr int kMaxWarnings = 10;

  Options options_;
  dendro_ros::BagReader bag_;
  dendro_ros::NodesConfig nodes_;
  tf2::BufferCore tf_;
  dendro::Pipeline pipeline_;
  dendro_ros::ScanGate<WaitingScan> gate_;
  std::optional<dendro::ScanWriter> scan_writer_;
  std::string points_topic_;
  std::string odometry_topic_;
  std::string fix_topic_;
  std::string last_error_;
  Counts counts_;
  std::int64_t first_ns_ = -1;
  std::int64_t last_ns_ = -1;
  int warnings_ = 0;
  bool said_no_ring_ = false;
  bool said_no_time_ = false;
  bool said_unusable_ = false;
  bool said_bad_pose_ = false;
  bool said_no_mount_ = false;
};

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Maps the trees of a bag: scans and odometry in, a map directory out. Needs no ROS "
               "master; the same bag and settings give the same bytes");
  Options options;
  app.add_option("IN", options.bag, "bag to read")->required();
  app.add_option("-o,--output", options.output, "map directory to write")->required();
  app.add_option("--config",
                 options.configs,
                 "YAML file with sections of the nodelets, or a folder of them; may be repeated");
  app.add_option("--load", options.load, "go on with the map of this directory");
  app.add_flag("--per-scan", options.per_scan, "also write what every single scan gave");
  app.add_option("--points", options.points_topic, "topic of the scans");
  app.add_option("--odometry", options.odometry_topic, "topic of the odometry");
  app.add_option("--fix", options.fix_topic, "topic of the GNSS fixes");
  CLI11_PARSE(app, argc, argv);
  try {
    Run run(options);
    run();
  } catch (const std::exception& error) {
    fmt::print(stderr, "map_bag: {}\n", error.what());
    return 1;
  }
  return 0;
}
