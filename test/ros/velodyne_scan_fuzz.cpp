#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <vector>

#include <ros/serialization.h>

#include "dendro_slam/ros/velodyne_msgs.h"
#include "dendro_slam/sensors/scan_assembler.h"
#include "dendro_slam/sensors/vlp16_decoder.h"

// Fuzz target: the input is a serialised velodyne_msgs/VelodyneScan as it comes from a topic or a
// bag, decoded to points. What can be read must come out again byte for byte.

namespace {

void Require(bool condition) {
  if (!condition) std::abort();
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  // A copy of the exact size, so that the address sanitizer guards both ends.
  const std::unique_ptr<std::uint8_t[]> bytes(new std::uint8_t[size]);
  std::copy(data, data + size, bytes.get());
  dendro_ros::VelodyneScan message;
  try {
    ros::serialization::IStream in(bytes.get(), static_cast<std::uint32_t>(size));
    ros::serialization::deserialize(in, message);
  } catch (const ros::serialization::StreamOverrunException&) {
    return 0;
  }
  const std::uint32_t length = ros::serialization::serializationLength(message);
  Require(length <= size);
  std::vector<std::uint8_t> again(length);
  ros::serialization::OStream out(again.data(), length);
  ros::serialization::serialize(out, message);
  Require(std::equal(again.begin(), again.end(), bytes.get()));

  dendro::Vlp16Decoder decoder;
  dendro::ScanAssembler assembler;
  std::vector<dendro::Vlp16Firing> firings;
  const auto check = [](const dendro::LidarScan& scan) {
    for (const dendro::LidarPoint& p : scan.points) {
      Require(std::isfinite(p.position.x()) && std::isfinite(p.position.y()) &&
              std::isfinite(p.position.z()) && p.ring < dendro::vlp16::kLasers);
    }
  };
  for (const dendro_ros::VelodynePacket& packet : message.packets) {
    const std::int64_t stamp_ns =
        static_cast<std::int64_t>(packet.stamp.sec) * 1000000000LL + packet.stamp.nsec;
    firings.clear();
    decoder.DecodeData(packet.data.data(), packet.data.size(), stamp_ns, firings);
    for (const dendro::Vlp16Firing& firing : firings) {
      if (const auto scan = assembler.Add(firing)) check(*scan);
    }
  }
  if (const auto scan = assembler.Flush()) check(*scan);
  return 0;
}
