#include "dendro_slam/ros/packet_scans.h"

#include <algorithm>
#include <limits>
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

PacketScans::PacketScans(const std::string& return_mode,
                         std::string frame_id,
                         const dendro::FlightPath& path)
    : encoder_(ReturnModeOf(return_mode)), frame_id_(std::move(frame_id)), path_(path) {}

RevolutionPackets PacketScans::Add(const dendro::SimulatedScan& scan) {
  constexpr std::uint64_t kDataPacketsPerPosition = 5;
  RevolutionPackets out;
  out.scan.header.stamp = ToRosTime(scan.scan.stamp_ns);
  out.scan.header.frame_id = frame_id_;
  for (const dendro::RawFiring& firing : scan.firings) {
    const auto packet = encoder_.Add(firing);
    if (!packet) continue;
    VelodynePacket data;
    data.stamp = ToRosTime(packet->stamp_ns);
    std::copy(packet->data.begin(), packet->data.end(), data.data.begin());
    out.scan.packets.push_back(data);
    if (data_packets_++ % kDataPacketsPerPosition == 0) {
      const auto bytes = dendro::EncodePositionPacket(
          path_.Fix(packet->stamp_ns), packet->stamp_ns, dendro::PpsStatus::kLocked);
      PositionPacketBytes position;
      position.stamp = data.stamp;
      std::copy(bytes.begin(), bytes.end(), position.data.begin());
      out.positions.push_back(position);
    }
  }
  return out;
}

void WritePackets(const RevolutionPackets& packets, dendro::PcapWriter* pcap) {
  auto position = packets.positions.begin();
  for (const VelodynePacket& packet : packets.scan.packets) {
    pcap->Write(ToNs(packet.stamp), dendro::vlp16::kDataPort, packet.data.data(), packet.data.size());
    for (; position != packets.positions.end() && position->stamp <= packet.stamp; ++position) {
      pcap->Write(ToNs(position->stamp), dendro::vlp16::kPositionPort, position->data.data(), position->data.size());
    }
  }
}

std_msgs::UInt8MultiArray ToMsg(const PositionPacketBytes& packet) {
  std_msgs::UInt8MultiArray msg;
  msg.data.assign(packet.data.begin(), packet.data.end());
  return msg;
}

sensor_msgs::NavSatFix ToFixMsg(const dendro::GnssFix& fix) {
  sensor_msgs::NavSatFix msg;
  msg.header.stamp = ToRosTime(fix.stamp_ns);
  msg.header.frame_id = "gps";
  msg.status.status =
      fix.valid ? sensor_msgs::NavSatStatus::STATUS_FIX : sensor_msgs::NavSatStatus::STATUS_NO_FIX;
  msg.status.service = sensor_msgs::NavSatStatus::SERVICE_GPS;
  msg.latitude = fix.latitude_deg;
  msg.longitude = fix.longitude_deg;
  msg.altitude = std::numeric_limits<double>::quiet_NaN();  // GPRMC has none.
  return msg;
}

}  // namespace dendro_ros
