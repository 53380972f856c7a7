#pragma once

#include <cstdint>
#include <ostream>
#include <string>
#include <vector>

#include <boost/array.hpp>
#include <ros/message_traits.h>
#include <ros/serialization.h>
#include <std_msgs/Header.h>

/// velodyne_msgs/VelodyneScan without that package (Debian has none): the same type name, MD5 sum and
/// bytes, so that topics and bags of velodyne_driver are read and written as they are.
namespace dendro_ros {

/// velodyne_msgs/VelodynePacket.
struct VelodynePacket {
  ros::Time stamp;                      ///< When the packet was received.
  boost::array<std::uint8_t, 1206> data;  ///< UDP payload.
};

/// velodyne_msgs/VelodyneScan: the packets of about one revolution.
struct VelodyneScan {
  std_msgs::Header header;
  std::vector<VelodynePacket> packets;

  using Ptr = boost::shared_ptr<VelodyneScan>;
  using ConstPtr = boost::shared_ptr<const VelodyneScan>;
};

/// For rostopic-like printing.
inline std::ostream& operator<<(std::ostream& stream, const VelodyneScan& scan) {
  return stream << scan.header << "packets: " << scan.packets.size() << "\n";
}

}  // namespace dendro_ros

namespace ros {
namespace message_traits {

template <>
struct IsMessage<dendro_ros::VelodyneScan> : TrueType {};
template <>
struct IsMessage<const dendro_ros::VelodyneScan> : TrueType {};
template <>
struct HasHeader<dendro_ros::VelodyneScan> : TrueType {};
template <>
struct HasHeader<const dendro_ros::VelodyneScan> : TrueType {};
template <>
struct IsFixedSize<dendro_ros::VelodynePacket> : TrueType {};

template <>
struct MD5Sum<dendro_ros::VelodyneScan> {
  static const char* value() { return "50804fc9533a0e579e6322c04ae70566"; }
  static const char* value(const dendro_ros::VelodyneScan&) { return value(); }
  static const uint64_t static_value1 = 0x50804fc9533a0e57ULL;
  static const uint64_t static_value2 = 0x9e6322c04ae70566ULL;
};

template <>
struct DataType<dendro_ros::VelodyneScan> {
  static const char* value() { return "velodyne_msgs/VelodyneScan"; }
  static const char* value(const dendro_ros::VelodyneScan&) { return value(); }
};

template <>
struct Definition<dendro_ros::VelodyneScan> {
  static const char* value() {
    return "# Velodyne LIDAR scan packets.\n"
           "\n"
           "Header           header         # standard ROS message header\n"
           "VelodynePacket[] packets        # vector of raw packets\n"
           "\n"
           "================================================================================\n"
           "MSG: std_msgs/Header\n"
           "uint32 seq\n"
           "time stamp\n"
           "string frame_id\n"
           "\n"
           "================================================================================\n"
           "MSG: velodyne_msgs/VelodynePacket\n"
           "# Raw Velodyne LIDAR packet.\n"
           "\n"
           "time stamp              # packet timestamp\n"
           "uint8[1206] data        # packet contents\n";
  }
  static const char* value(const dendro_ros::VelodyneScan&) { return value(); }
};

}  // namespace message_traits

namespace serialization {

template <>
struct Serializer<dendro_ros::VelodynePacket> {
  template <typename Stream, typename T>
  static void allInOne(Stream& stream, T packet) {
    stream.next(packet.stamp);
    stream.next(packet.data);
  }
  ROS_DECLARE_ALLINONE_SERIALIZER
};

template <>
struct Serializer<dendro_ros::VelodyneScan> {
  /// @throws StreamOverrunException when the message is shorter than it says, before the memory of
  ///         packets that cannot be there is asked for.
  template <typename Stream>
  static void read(Stream& stream, dendro_ros::VelodyneScan& scan) {
    stream.next(scan.header);
    std::uint32_t count = 0;
    stream.next(count);
    constexpr std::uint32_t kPacketBytes = 8 + 1206;
    if (count > stream.getLength() / kPacketBytes) throwStreamOverrun();
    scan.packets.resize(count);
    for (dendro_ros::VelodynePacket& packet : scan.packets) stream.next(packet);
  }
  template <typename Stream>
  static void write(Stream& stream, const dendro_ros::VelodyneScan& scan) {
    stream.next(scan.header);
    stream.next(scan.packets);
  }
  static std::uint32_t serializedLength(const dendro_ros::VelodyneScan& scan) {
    LStream stream;
    stream.next(scan.header);
    stream.next(scan.packets);
    return stream.getLength();
  }
};

}  // namespace serialization
}  // namespace ros
