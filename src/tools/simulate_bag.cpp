// Flies a path through a scene and writes the bag that the rig would have recorded, with the truth.

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "dendro_slam/ros/bag.h"
#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/ros/packet_scans.h"
#include "dendro_slam/ros/params.h"
#include "dendro_slam/ros/point_cloud2.h"
#include "dendro_slam/ros/progress.h"
#include "dendro_slam/ros/rig_messages.h"
#include "dendro_slam/sensors/pcap_writer.h"
#include "dendro_slam/sim/truth_writer.h"

namespace {

struct Options {
  std::string scene;
  std::string path;
  std::string bag;
  std::optional<int> seed;
  std::string odometry;
  bool packets = false;
  bool imu = false;
  std::string pcap;
  double duration_s = 0.0;
  int threads = 0;
  std::vector<std::string> set;
};

std::string TruthFolder(const std::string& bag) {
  std::filesystem::path path(bag);
  path.replace_extension(".truth");
  return path.string();
}

/// Applies `--set SECTION.KEY=VALUE`, one at a time.
/// @throws ParamError  Names the option, what is unknown and what there is.
void ApplySettings(const std::vector<std::string>& settings,
                   dendro::LidarSimulatorConfig* lidar,
                   dendro::OdometrySimulatorConfig* odometry,
                   dendro::ImuSimulatorConfig* imu) {
  for (const std::string& text : settings) {
    const std::string where = "--set " + text;
    const std::size_t dot = text.find('.');
    const std::size_t equal = text.find('=');
    if (dot == std::string::npos || equal == std::string::npos || dot > equal) {
      throw dendro_ros::ParamError(where + ": expected SECTION.KEY=VALUE, e.g. odometry.jump_time_s=60");
    }
    const std::string section = text.substr(0, dot);
    const dendro_ros::ParamTree tree = dendro_ros::ParseYaml(
        text.substr(dot + 1, equal - dot - 1) + ": " + text.substr(equal + 1), where);
    if (section == "lidar") {
      dendro_ros::UpdateConfig(tree, where, lidar);
    } else if (section == "odometry") {
      dendro_ros::UpdateConfig(tree, where, odometry);
    } else if (section == "imu") {
      dendro_ros::UpdateConfig(tree, where, imu);
    } else {
      throw dendro_ros::ParamError(where + ": expected the section lidar, odometry or imu");
    }
  }
}

void Run(const Options& options) {
  using dendro_ros::RigMessages;
  const dendro::Scene scene = dendro::LoadScene(options.scene);
  dendro::FlightPath path = dendro::LoadFlightPath(options.path);
  if (!options.odometry.empty()) path.odometry.model = options.odometry;
  dendro::LidarSimulatorConfig lidar;
  dendro::ImuSimulatorConfig imu_config;
  if (options.seed) {
    lidar.seed = *options.seed;
    imu_config.seed = *options.seed;
    path.odometry.seed = *options.seed;
  }
  ApplySettings(options.set, &lidar, &path.odometry, &imu_config);
  if (options.duration_s > 0.0) path.duration_s = std::min(path.duration_s, options.duration_s);

  const dendro::Raycaster raycaster(scene);
  const dendro::LidarSimulator simulator(raycaster, lidar, path.start_stamp_ns);
  const int num_scans = simulator.NumScans(path.duration_s);
  if (num_scans < 1) {
    throw std::runtime_error(fmt::format(
        "{}: the flight lasts {:.2f} s, less than one revolution", options.path, path.duration_s));
  }
  const RigMessages rig(path);
  dendro_ros::BagWriter bag(options.bag);
  dendro::TruthWriter truth(TruthFolder(options.bag), scene);
  std::optional<dendro_ros::PacketScans> packets;
  std::optional<dendro::PcapWriter> pcap;
  if (options.packets || !options.pcap.empty()) {
    packets.emplace(lidar.return_mode, RigMessages::kLidarFrame, path);
  }
  if (!options.pcap.empty()) pcap.emplace(options.pcap);

  const ros::Time start = dendro_ros::ToRosTime(path.start_stamp_ns);
  bag.Write("/tf_static", start, rig.StaticTransforms());
  bag.Write(RigMessages::kTruthTreesTopic, start, *RigMessages::TruthTrees(scene, path.start_stamp_ns));

  // A message lies in the bag where the driver would have published it: odometry at its stamp, a scan
  // when its revolution is over. The odometry runs one revolution ahead of the last scan's end.
  dendro::OdometrySimulator odometry(path.trajectory, path.start_stamp_ns, path.odometry);
  int odometry_count = 0;
  const auto write_odometry = [&](double until_s) {
    constexpr int kTransformEvery = 4;
    for (const dendro::OdometrySample& sample : odometry.AdvanceTo(until_s)) {
      const ros::Time stamp = dendro_ros::ToRosTime(sample.stamp_ns);
      bag.Write(rig.odometry_topic(), stamp, rig.Odometry(sample));
      if (odometry_count++ % kTransformEvery == 0) {
        bag.Write("/tf", stamp, rig.OdometryTransform(sample));
      }
    }
  };
  dendro::ImuSimulator imu(
      [&path](double time_s) { return path.trajectory.Pose(time_s); }, path.start_stamp_ns, imu_config);
  const auto write_imu = [&](double until_s) {
    for (const dendro::ImuSample& sample : imu.AdvanceTo(until_s)) {
      bag.Write(RigMessages::kImuTopic, dendro_ros::ToRosTime(sample.stamp_ns), RigMessages::Imu(sample, imu_config));
    }
  };
  const int threads = options.threads > 0
                          ? options.threads
                          : std::max(1, static_cast<int>(std::thread::hardware_concurrency()));
  std::size_t points = 0;
  std::int64_t last_fix_ns = -1;
  dendro_ros::Progress progress("simulating");
  dendro::SimulateFlight(
      simulator, path, threads, [&](int index, const dendro::SimulatedScan& scan) {
        const std::int64_t end_ns = simulator.ScanStamp(index + 1);
        if (!rig.odometry_topic().empty()) {
          write_odometry(dendro::NsToSeconds(end_ns - path.start_stamp_ns));
        }
        if (options.imu) write_imu(dendro::NsToSeconds(end_ns - path.start_stamp_ns));
        const ros::Time end = dendro_ros::ToRosTime(end_ns);
        if (packets) {
          const dendro_ros::RevolutionPackets message = packets->Add(scan);
          if (options.packets) {
            for (const dendro_ros::PositionPacketBytes& position : message.positions) {
              bag.Write(RigMessages::kPositionPacketsTopic, position.stamp, dendro_ros::ToMsg(position));
            }
            bag.Write(RigMessages::kPacketsTopic, end, message.scan);
            const dendro::GnssFix fix = path.Fix(end_ns);
            if (fix.stamp_ns > last_fix_ns) {
              bag.Write(RigMessages::kFixTopic, end, dendro_ros::ToFixMsg(fix));
              last_fix_ns = fix.stamp_ns;
            }
          }
          if (pcap) dendro_ros::WritePackets(message, &*pcap);
        }
        bag.Write(RigMessages::kPointsTopic,
                  end,
                  *dendro_ros::ToVelodyneCloud(scan.scan, RigMessages::kLidarFrame));
        bag.Write(RigMessages::kTruthLidarTopic, end, RigMessages::TruthLidarPose(scan));
        bag.Write(RigMessages::kTruthLabelsTopic, end, *RigMessages::TruthLabels(scan));
        bag.Write(RigMessages::kTruthHitsTopic, end, *RigMessages::TruthHits(scan));
        truth.AddScan(scan);
        points += scan.scan.points.size();
        progress.Show(static_cast<double>(index + 1) / num_scans);
        return true;
      });
  if (!rig.odometry_topic().empty()) {
    constexpr double kTailS = 0.2;
    write_odometry(dendro::NsToSeconds(simulator.ScanStamp(num_scans) - path.start_stamp_ns) + kTailS);
  }
  truth.Finish();
  if (pcap) pcap->Close();
  bag.Close();
  fmt::print("{}: {} scans, {} points, odometry {}, truth in {}\n",
             options.bag,
             num_scans,
             points,
             path.odometry.model,
             TruthFolder(options.bag));
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Simulates a flight of a VLP-16 through a scene: a bag as the rig records it, and the "
               "truth beside it in OUT.truth/");
  Options options;
  app.add_option("SCENE", options.scene, "scene file (YAML)")->required();
  app.add_option("PATH", options.path, "flight-path file (YAML)")->required();
  app.add_option("-o,--output", options.bag, "bag to write")->required();
  app.add_option("--seed", options.seed, "seed of every random effect");
  app.add_option("--odometry", options.odometry, "odometry model instead of the path's")
      ->check(CLI::IsMember({"mavros", "t265", "none"}));
  app.add_flag("--packets", options.packets, "also write /velodyne_packets, /velodyne_position_packets and /fix");
  app.add_flag("--imu", options.imu, "also write /imu/data_raw, the body's angular rate and specific force");
  app.add_option("--pcap", options.pcap, "also write the packets as a capture");
  app.add_option("--duration", options.duration_s, "end the flight after this time [s]")
      ->check(CLI::PositiveNumber);
  app.add_option("--threads", options.threads, "threads; the result does not depend on it")
      ->check(CLI::PositiveNumber);
  app.add_option("--set",
                 options.set,
                 "SECTION.KEY=VALUE: a parameter of the sensor (lidar), the odometry or the imu instead of "
                 "the path's or the default, e.g. lidar.return_mode=dual odometry.jump_time_s=60 "
                 "odometry.loss_time_s=60; all of them in doc/parameters.md: LidarSimulatorConfig, "
                 "OdometrySimulatorConfig, ImuSimulatorConfig");
  CLI11_PARSE(app, argc, argv);
  try {
    Run(options);
  } catch (const std::exception& error) {
    fmt::print(stderr, "simulate_bag: {}\n", error.what());
    return 1;
  }
  return 0;
}
