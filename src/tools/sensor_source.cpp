// One sensor of the rig, live or recorded, as driver_bridge starts it.

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <ros/ros.h>

#include <string>

#include "dendro_slam/ros/params.h"
#include "dendro_slam/ros/sensor_source.h"
#include "dendro_slam/sensors/replay.h"

namespace {

/// First and last stamp of a recording, for the script's common time.
void Describe(const dendro_ros::SensorSourceConfig& config) {
  dendro::RecordingSpan span;
  if (config.type == "vlp16_pcap") {
    span = dendro::CaptureSpan(config.file, config.data_port, config.position_port);
  } else {
    const auto poses = dendro::ReadPoseFile(config.file, config.format);
    span = {poses.front().stamp_ns, poses.back().stamp_ns, poses.size()};
  }
  fmt::print("{{\"first_ns\": {}, \"last_ns\": {}, \"count\": {}}}\n",
             span.first_ns,
             span.last_ns,
             span.count);
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Publishes one sensor of the rig: a VLP-16 on UDP, a capture, a pose file or a topic. "
               "driver_bridge starts one per source of its script");
  std::string text;
  bool describe = false;
  app.add_option("CONFIG", text, "configuration as YAML or JSON text, see doc/parameters.md")
      ->required();
  app.add_flag("--describe", describe, "print first and last stamp of the recording and end");
  app.allow_extras();  // ROS' remappings.
  CLI11_PARSE(app, argc, argv);
  try {
    const auto config = dendro_ros::ReadConfig<dendro_ros::SensorSourceConfig>(
        dendro_ros::ParseYaml(text, "sensor_source"), "sensor_source");
    if (describe) {
      Describe(config);
      return 0;
    }
    ros::init(argc, argv, "sensor_source");
    ros::NodeHandle nh;
    dendro_ros::SensorSource source(nh, ros::this_node::getName(), config);
    ros::AsyncSpinner spinner(4);  // One may wait for a reader to settle.
    spinner.start();
    source.Run();
    if (!ros::ok()) return 130;  // Interrupted, not at its end.
  } catch (const std::exception& error) {
    fmt::print(stderr, "{}\n", error.what());
    return 1;
  }
  return 0;
}
