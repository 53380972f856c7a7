#include "dendro_slam/sensors/replay.h"

#include <algorithm>
#include <cmath>
#include <fstream>
#include <stdexcept>
#include <utility>

#include "dendro_slam/geometry/se3.h"

namespace dendro {

namespace {

constexpr std::size_t kDataTimeAt = 1200;     ///< Offset of the time of the hour in a data packet.
constexpr std::size_t kPositionTimeAt = 198;  ///< And in a position packet.
constexpr int kTurn = 36000;                  ///< [0.01 deg].

constexpr std::int64_t kHourUs = vlp16::kHourNs / 1000;

// The sensor's time of the hour [us].
std::int64_t TimeOfHour(const std::vector<std::uint8_t>& payload, std::size_t at) {
  std::int64_t us = 0;
  for (std::size_t i = 0; i < 4; ++i) us |= static_cast<std::int64_t>(payload[at + i]) << (8 * i);
  return us;
}

// It goes on by `shift_ns`, around the hour.
void ShiftTimeOfHour(std::vector<std::uint8_t>& payload, std::size_t at, std::int64_t shift_ns) {
  if (payload.size() < at + 4) return;
  const std::int64_t us = (TimeOfHour(payload, at) + shift_ns / 1000) % kHourUs;
  for (std::size_t i = 0; i < 4; ++i) payload[at + i] = static_cast<std::uint8_t>(us >> (8 * i));
}

}  // namespace

double ReplayTiming::DueS(std::int64_t recorded_ns) const {
  return static_cast<double>(recorded_ns - origin_ns) * 1e-9 / rate;
}

std::int64_t ReplayTiming::StampNs(std::int64_t recorded_ns) const {
  return stamps_now ? recorded_ns - origin_ns + started_ns : recorded_ns;
}

CaptureReplay::CaptureReplay(const std::string& path, int data_port, int position_port, bool repeat)
    : path_(path),
      pcap_(path),
      data_port_(static_cast<std::uint16_t>(data_port)),
      position_port_(static_cast<std::uint16_t>(position_port)),
      repeat_(repeat) {}

bool CaptureReplay::Next(UdpPacket& packet) {
  if (ahead_) {
    packet = std::move(*ahead_);
    ahead_.reset();
    return true;
  }
  for (;;) {
    if (!pcap_.Next(packet)) {
      if (data_packets_ == 0) {
        throw PcapError(path_ + ": no datagram on port " + std::to_string(data_port_));
      }
      if (!repeat_) return false;
      if (lap_ns_ == 0) {
        const auto gaps = static_cast<std::int64_t>(std::max<std::size_t>(data_packets_, 2) - 1);
        lap_ns_ = 1000 * std::max<std::int64_t>(sensor_us_ + sensor_us_ / gaps, 1000);
      }
      shift_ns_ += lap_ns_;
      pcap_.Rewind();
      continue;
    }
    const bool is_data = packet.port == data_port_;
    if (!is_data && packet.port != position_port_) continue;
    if (lap_ns_ == 0 && is_data && packet.payload.size() >= kDataTimeAt + 4) {
      const std::int64_t us = TimeOfHour(packet.payload, kDataTimeAt);
      std::int64_t step_us = data_packets_ == 0 ? 0 : us - last_us_;
      if (step_us < -kHourUs / 2) step_us += kHourUs;
      sensor_us_ += step_us;
      last_us_ = us;
      ++data_packets_;
    }
    packet.stamp_ns += shift_ns_;
    if (shift_ns_ != 0) {
      ShiftTimeOfHour(packet.payload, is_data ? kDataTimeAt : kPositionTimeAt, shift_ns_);
    }
    return true;
  }
}

void CaptureReplay::SkipTo(std::int64_t stamp_ns) {
  UdpPacket packet;
  while (Next(packet)) {
    if (packet.stamp_ns > stamp_ns) {
      ahead_ = std::move(packet);
      return;
    }
    // In the second lap the length is known: the laps in between need not be read.
    if (lap_ns_ > 0 && stamp_ns - packet.stamp_ns > 2 * lap_ns_) {
      shift_ns_ += (stamp_ns - packet.stamp_ns) / lap_ns_ * lap_ns_ - lap_ns_;
    }
  }
}

RecordingSpan CaptureSpan(const std::string& path, int data_port, int position_port) {
  CaptureReplay replay(path, data_port, position_port, false);
  RecordingSpan span;
  UdpPacket packet;
  while (replay.Next(packet)) {
    if (span.count++ == 0) span.first_ns = packet.stamp_ns;
    span.last_ns = std::max(span.last_ns, packet.stamp_ns);
  }
  return span;
}

PoseReplay::PoseReplay(std::vector<StreamedPose> poses, bool repeat)
    : poses_(std::move(poses)), repeat_(repeat) {
  if (poses_.empty()) throw std::invalid_argument("no poses");
  const std::int64_t span_ns = poses_.back().stamp_ns - poses_.front().stamp_ns;
  const auto gaps = static_cast<std::int64_t>(std::max<std::size_t>(poses_.size(), 2) - 1);
  lap_ns_ = std::max<std::int64_t>(span_ns + span_ns / gaps, 1000000);
  T_lap_ = poses_.back().T_odom_camera * poses_.front().T_odom_camera.inverse();
}

bool PoseReplay::EndLap() {
  if (!repeat_) return false;
  at_ = 0;
  shift_ns_ += lap_ns_;
  T_start_ = NormalizedSe3(T_start_ * T_lap_);
  return true;
}

std::optional<StreamedPose> PoseReplay::Next() {
  if (at_ >= poses_.size() && !EndLap()) return std::nullopt;
  StreamedPose pose = poses_[at_++];
  pose.stamp_ns += shift_ns_;
  pose.T_odom_camera = T_start_ * pose.T_odom_camera;
  return pose;
}

void PoseReplay::SkipTo(std::int64_t stamp_ns) {
  while (poses_.back().stamp_ns + shift_ns_ <= stamp_ns) {
    at_ = poses_.size();
    if (!EndLap()) return;
  }
  while (at_ < poses_.size() && poses_[at_].stamp_ns + shift_ns_ <= stamp_ns) ++at_;
}

std::vector<StreamedPose> ReadPoseFile(const std::string& path, const std::string& format) {
  if (format != "auto" && format != "tum" && format != "realsense") {
    throw std::invalid_argument("format must be auto, tum or realsense, not '" + format + "'");
  }
  std::ifstream file(path);
  if (!file) throw PoseStreamError(path + ": cannot be opened");
  bool realsense = format == "realsense";
  if (format == "auto") {
    std::string line;
    while (std::getline(file, line)) {
      const std::size_t begin = line.find_first_not_of(" \t\r");
      if (begin == std::string::npos || line[begin] == '#') continue;
      realsense = line.find(',') != std::string::npos;
      break;
    }
    file.clear();
    file.seekg(0);
  }
  try {
    std::vector<StreamedPose> poses = realsense ? ReadRealSensePoses(file) : ReadTumPoses(file);
    if (poses.empty()) throw PoseStreamError("no poses in it");
    return poses;
  } catch (const PoseStreamError& error) {
    throw PoseStreamError(path + ": " + error.what());
  }
}

RevolutionCutter::RevolutionCutter(double cut_azimuth_deg)
    : cut_(static_cast<int>(std::lround(cut_azimuth_deg * 100.0))) {}

bool RevolutionCutter::Add(const std::uint8_t* data) {
  constexpr std::size_t kBlockBytes = 100;
  bool wrapped = false;
  for (std::size_t block = 0; block < vlp16::kBlocks; ++block) {
    const std::uint8_t* at = data + block * kBlockBytes;
    if (at[0] != 0xff || at[1] != 0xee) continue;
    const int azimuth = at[2] | at[3] << 8;
    if (azimuth >= kTurn) continue;
    const int past_cut = (azimuth - cut_ + kTurn) % kTurn;
    // More than half a turn back is a new revolution; less is a packet out of order.
    if (last_ && *last_ - past_cut > kTurn / 2) wrapped = true;
    last_ = past_cut;
  }
  return wrapped;
}

}  // namespace dendro
