#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "dendro_slam/sensors/pcap_reader.h"
#include "dendro_slam/sensors/pose_stream.h"
#include "dendro_slam/sensors/vlp16_packet.h"

/// Recordings played as if their sensors were live: paced, repeated without a seam, and taken up
/// again where a player that died left off.
namespace dendro {

/// Where a recording lies in the script's time. "Recorded" stamps have the source's offset in them.
struct ReplayTiming {
  std::int64_t started_ns = 0;  ///< Script time 0 in the computer's clock [ns since 1970].
  std::int64_t origin_ns = 0;   ///< Recorded stamp that is played at script time 0 [ns].
  double rate = 1.0;            ///< Speed; 1 as recorded. > 0.
  bool stamps_now = true;       ///< Stamps are moved by `started_ns - origin_ns`; else they stay.

  /// Script time at which a recorded stamp is due [s].
  double DueS(std::int64_t recorded_ns) const;
  /// Stamp under which it is published [ns]. Motions keep their speed at any rate.
  std::int64_t StampNs(std::int64_t recorded_ns) const;
};

/// The datagrams of a capture on the two ports of a VLP-16, once or for ever.
///
/// Each lap follows the one before by the mean distance of two packets in the sensor's own clock, and
/// the time in the packets goes on too, so that a decoder sees one unbroken stream.
class CaptureReplay {
 public:
  /// @throws PcapError when the file cannot be read or has no datagram on the data port.
  CaptureReplay(const std::string& path, int data_port, int position_port, bool repeat);

  /// Reads the next datagram; its stamp grows from lap to lap.
  /// @return  False at the end.
  /// @throws PcapError
  bool Next(UdpPacket& packet);

  /// Skips everything up to and including this stamp; whole laps are not read.
  void SkipTo(std::int64_t stamp_ns);

 private:
  std::string path_;
  PcapReader pcap_;
  std::uint16_t data_port_;
  std::uint16_t position_port_;
  bool repeat_;
  std::size_t data_packets_ = 0;  ///< Of the first lap.
  std::int64_t last_us_ = 0;      ///< Time of the hour of the last of them.
  std::int64_t sensor_us_ = 0;    ///< How long they last in the sensor's own clock.
  std::int64_t lap_ns_ = 0;       ///< Length of a lap; 0 until the end has been seen.
  std::int64_t shift_ns_ = 0;
  std::optional<UdpPacket> ahead_;  ///< Read by SkipTo.
};

/// First and last stamp of what a capture holds on a VLP-16's ports.
struct RecordingSpan {
  std::int64_t first_ns = 0;
  std::int64_t last_ns = 0;
  std::size_t count = 0;
};
/// @throws PcapError when the file cannot be read or has no datagram on the data port.
RecordingSpan CaptureSpan(const std::string& path, int data_port, int position_port);

/// Poses of a file, once or for ever. A new lap begins where the last one ended: odometry does not
/// jump by itself.
class PoseReplay {
 public:
  /// @param poses  At least one, ascending stamps.
  /// @throws std::invalid_argument
  PoseReplay(std::vector<StreamedPose> poses, bool repeat);

  std::optional<StreamedPose> Next();
  void SkipTo(std::int64_t stamp_ns);

 private:
  bool EndLap();

  std::vector<StreamedPose> poses_;
  bool repeat_;
  std::size_t at_ = 0;
  std::int64_t lap_ns_ = 0;
  std::int64_t shift_ns_ = 0;
  Eigen::Isometry3d T_start_ = Eigen::Isometry3d::Identity();  ///< Of this lap's frame.
  Eigen::Isometry3d T_lap_ = Eigen::Isometry3d::Identity();
};

/// Reads a pose file of either kind: `tum`, `realsense`, or `auto` (realsense when the first line
/// that is no comment holds a comma).
/// @throws PoseStreamError  The message names the file and the line.
/// @throws std::invalid_argument  An unknown format.
std::vector<StreamedPose> ReadPoseFile(const std::string& path, const std::string& format);

/// Tells when a revolution is complete, from the bytes of the packets.
class RevolutionCutter {
 public:
  /// @param cut_azimuth_deg  As ScanAssembler cuts.
  explicit RevolutionCutter(double cut_azimuth_deg = 0.0);

  /// Takes a data packet of 1206 bytes.
  /// @return  True when a revolution ended inside it or before it: then its first blocks complete the
  ///          scan, and what follows belongs to the next.
  bool Add(const std::uint8_t* data);

 private:
  int cut_;                ///< [0.01 deg].
  std::optional<int> last_;  ///< Azimuth past the cut of the last block seen [0.01 deg].
};

}  // namespace dendro
