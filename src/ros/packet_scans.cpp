#include "dendro_slam/ros/packet_scans.h"

#include <algorithm>
#include <utility>

#include "dendro_slam/ros/conversions.h"

namespace dendro_ros {
namespace {

dendro::ReturnMode ReturnModeOf(const std::string& name) {
  if (name == "last") return dendro::ReturnMode::kLast;
  if (name == "dual") return dendro::ReturnMode::kDual;
  return dendro::ReturnMode::kStrongest;
}

}  // namespace

PacketScans::PacketScans(const std::string& return_mode, std::string frame_id)
    : encoder_(ReturnModeOf(return_mode)), frame_id_(std::move(frame_id)) {}

VelodyneScan PacketScans::Add(const dendro::SimulatedScan& scan) {
  VelodyneScan message;
  message.header.stamp = ToRosTime(scan.scan.stamp_ns);
  message.header.frame_id = frame_id_;
  for (const dendro::RawFiring& firing : scan.firings) {
    const auto packet = encoder_.Add(firing);
    if (!packet) continue;
    VelodynePacket out;
    out.stamp = ToRosTime(packet->stamp_ns);
    std::copy(packet->data.begin(), packet->data.end(), out.data.begin());
    message.packets.push_back(out);
  }
  return message;
}

void WritePackets(const VelodyneScan& scan, dendro::PcapWriter* pcap) {
  for (const VelodynePacket& packet : scan.packets) {
    pcap->Write(ToNs(packet.stamp), dendro::vlp16::kDataPort, packet.data.data(), packet.data.size());
  }
}

}  // namespace dendro_ros
