#pragma once

#include <string>

#include "dendro_slam/ros/velodyne_msgs.h"
#include "dendro_slam/sensors/pcap_writer.h"
#include "dendro_slam/sensors/vlp16_encoder.h"
#include "dendro_slam/sim/lidar_simulator.h"

namespace dendro_ros {

/// Simulated revolutions as packet messages. Packets hold 24 firings (12 in dual mode) whatever the
/// revolution, so the last firings of one travel with the next.
class PacketScans {
 public:
  /// @param return_mode  strongest, last or dual.
  PacketScans(const std::string& return_mode, std::string frame_id);

  /// The packets that this revolution completes, stamped with the revolution's stamp.
  VelodyneScan Add(const dendro::SimulatedScan& scan);

 private:
  dendro::Vlp16Encoder encoder_;
  std::string frame_id_;
};

/// Appends the packets of a message to a capture.
/// @throws dendro::PcapError
void WritePackets(const VelodyneScan& scan, dendro::PcapWriter* pcap);

}  // namespace dendro_ros
