#pragma once

#include <string>
#include <vector>

#include <sensor_msgs/NavSatFix.h>
#include <std_msgs/UInt8MultiArray.h>

#include "dendro_slam/ros/velodyne_msgs.h"
#include "dendro_slam/sensors/pcap_writer.h"
#include "dendro_slam/sensors/vlp16_encoder.h"
#include "dendro_slam/sim/flight_path.h"
#include "dendro_slam/sim/lidar_simulator.h"

namespace dendro_ros {

/// A position packet: 512 bytes with the receiver's GPRMC sentence.
struct PositionPacketBytes {
  ros::Time stamp;  ///< When it is sent.
  boost::array<std::uint8_t, dendro::vlp16::kPositionPacketBytes> data;
};

/// What the sensor sends during one revolution.
struct RevolutionPackets {
  VelodyneScan scan;                           ///< Data packets.
  std::vector<PositionPacketBytes> positions;  ///< Position packets, ascending.
};

/// Simulated revolutions as the packets that a VLP-16 with a GNSS receiver sends. Data packets hold 24
/// firings (12 in dual mode) whatever the revolution, so the last firings of one travel with the next.
/// A position packet follows every fifth data packet, as in recorded captures; its sentence is the fix
/// of the last full second.
class PacketScans {
 public:
  /// @param return_mode  strongest, last or dual.
  /// @param path         Where the receiver is; must outlive this object.
  PacketScans(const std::string& return_mode,
              std::string frame_id,
              const dendro::FlightPath& path);

  /// The packets that this revolution completes, the message stamped with the revolution's stamp.
  RevolutionPackets Add(const dendro::SimulatedScan& scan);

 private:
  dendro::Vlp16Encoder encoder_;
  std::string frame_id_;
  const dendro::FlightPath& path_;
  std::uint64_t data_packets_ = 0;
};

/// Appends the packets of a revolution to a capture, in the order of their stamps.
/// @throws dendro::PcapError
void WritePackets(const RevolutionPackets& packets, dendro::PcapWriter* pcap);

/// The position packet as a message: its 512 bytes, for /velodyne_position_packets.
std_msgs::UInt8MultiArray ToMsg(const PositionPacketBytes& packet);

/// The fix as a message, in frame "gps".
sensor_msgs::NavSatFix ToFixMsg(const dendro::GnssFix& fix);

}  // namespace dendro_ros
