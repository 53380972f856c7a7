// Turns a VLP-16 capture into a bag with packets and points.

#include <CLI/CLI.hpp>
#include <fmt/format.h>

#include <algorithm>
#include <string>
#include <utility>

#include "dendro_slam/ros/bag.h"
#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/ros/packet_scans.h"
#include "dendro_slam/ros/point_cloud2.h"
#include "dendro_slam/ros/velodyne_msgs.h"
#include "dendro_slam/sensors/capture_reader.h"

namespace {

struct Options {
  std::string pcap;
  std::string bag;
  std::string frame = "velodyne";
  dendro::CaptureReaderConfig capture;
  dendro::ScanAssemblerConfig assembler;
};

void Run(const Options& options) {
  dendro::CaptureReader reader(
      options.pcap, options.capture, dendro::Vlp16ClockConfig(), options.assembler);
  dendro_ros::BagWriter bag(options.bag);
  dendro_ros::VelodyneScan packets;
  packets.header.frame_id = options.frame;
  // Stamps of the bag ascend although a scan is known only when the next has begun.
  std::int64_t bag_ns = 0;
  std::size_t num_scans = 0;
  std::size_t num_points = 0;
  std::size_t num_fixes = 0;
  std::int64_t first_ns = 0;
  std::int64_t last_ns = 0;
  dendro::CaptureStep step;
  while (reader.Next(step)) {
    bag_ns = std::max(bag_ns, step.packet.stamp_ns);
    if (step.is_data && step.packet.payload.size() == dendro::vlp16::kDataPacketBytes) {
      dendro_ros::VelodynePacket packet;
      packet.stamp = dendro_ros::ToRosTime(step.packet.stamp_ns);
      std::copy(step.packet.payload.begin(), step.packet.payload.end(), packet.data.begin());
      packets.packets.push_back(packet);
    }
    if (step.fix) {
      bag.Write("/fix", dendro_ros::ToRosTime(bag_ns), dendro_ros::ToFixMsg(*step.fix));
      ++num_fixes;
    }
    for (const dendro::LidarScan& scan : step.scans) {
      const ros::Time when = dendro_ros::ToRosTime(std::max(bag_ns, scan.stamp_ns));
      packets.header.stamp = dendro_ros::ToRosTime(scan.stamp_ns);
      bag.Write("/velodyne_packets", when, packets);
      packets.packets.clear();
      bag.Write("/velodyne_points", when, *dendro_ros::ToVelodyneCloud(scan, options.frame));
      if (num_scans++ == 0) first_ns = scan.stamp_ns;
      last_ns = scan.stamp_ns;
      num_points += scan.points.size();
    }
  }
  const dendro::Vlp16Counters& counters = reader.decoder().counters();
  if (num_scans == 0) {
    throw std::runtime_error(fmt::format(
        "{}: no VLP-16 scan in it ({} packets on port {}, {} of them foreign); is the port right "
        "(--data-port)?",
        options.pcap,
        counters.packets,
        options.capture.data_port,
        counters.foreign));
  }
  bag.Close();
  if (const auto model = reader.decoder().odd_factory_byte()) {
    fmt::print(stderr,
               "pcap_to_bag: {}: the packets name model {:#04x}, their timing is a VLP-16's: decoded as "
               "such\n",
               options.pcap,
               *model);
  }
  fmt::print("{}: {} scans in {:.2f} s, {} points, {} fixes; {} packets, {} lost, {} unusable\n",
             options.bag,
             num_scans,
             dendro::NsToSeconds(last_ns - first_ns),
             num_points,
             num_fixes,
             counters.packets,
             counters.lost,
             counters.packets - counters.decoded);
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Turns a VLP-16 capture (pcap, pcapng) into a bag: /velodyne_packets, "
               "/velodyne_points and, with a receiver, /fix");
  Options options;
  app.add_option("IN", options.pcap, "capture to read")->required();
  app.add_option("-o,--output", options.bag, "bag to write")->required();
  app.add_option("--frame", options.frame, "frame of the lidar")->capture_default_str();
  app.add_option("--data-port", options.capture.data_port, "UDP port of the data packets")
      ->capture_default_str();
  app.add_option("--position-port", options.capture.position_port, "UDP port of the fixes")
      ->capture_default_str();
  app.add_option("--cut-azimuth", options.assembler.cut_azimuth_deg, "where scans begin [deg]")
      ->capture_default_str();
  CLI11_PARSE(app, argc, argv);
  try {
    Run(options);
  } catch (const std::exception& error) {
    fmt::print(stderr, "pcap_to_bag: {}\n", error.what());
    return 1;
  }
  return 0;
}
