#include "dendro_slam/sensors/capture_reader.h"

#include <stdexcept>
#include <utility>

namespace dendro {

void CaptureReaderConfig::Validate() const {
  if (data_port < 1 || data_port > 65535) {
    throw std::invalid_argument("data_port must be in [1, 65535]");
  }
  if (position_port < 1 || position_port > 65535) {
    throw std::invalid_argument("position_port must be in [1, 65535]");
  }
  if (position_port == data_port) {
    throw std::invalid_argument("position_port must differ from data_port");
  }
}

CaptureReader::CaptureReader(const std::string& path,
                             const CaptureReaderConfig& config,
                             const Vlp16ClockConfig& clock,
                             const ScanAssemblerConfig& assembler)
    : config_((config.Validate(), config)), pcap_(path), decoder_(clock), assembler_(assembler) {}

bool CaptureReader::Next(CaptureStep& step) {
  step.is_data = false;
  step.is_position = false;
  step.scans.clear();
  step.fix.reset();
  if (ended_) return false;
  if (!pcap_.Next(step.packet)) {
    ended_ = true;
    step.packet = UdpPacket();
    std::optional<LidarScan> last = assembler_.Flush();
    if (!last) return false;
    step.scans.push_back(std::move(*last));
    return true;
  }
  const UdpPacket& packet = step.packet;
  if (packet.port == config_.data_port) {
    step.is_data = true;
    firings_.clear();
    decoder_.DecodeData(packet.payload.data(), packet.payload.size(), packet.stamp_ns, firings_);
    for (const Vlp16Firing& firing : firings_) {
      if (std::optional<LidarScan> scan = assembler_.Add(firing)) {
        step.scans.push_back(std::move(*scan));
      }
    }
  } else if (packet.port == config_.position_port) {
    step.is_position = true;
    step.fix =
        decoder_.DecodePosition(packet.payload.data(), packet.payload.size(), packet.stamp_ns);
  }
  return true;
}

std::optional<LidarScan> CaptureReader::NextScan() {
  while (served_ >= step_.scans.size()) {
    served_ = 0;
    if (!Next(step_)) return std::nullopt;
  }
  return std::move(step_.scans[served_++]);
}

void CaptureReader::Rewind() {
  pcap_.Rewind();
  decoder_.Reset();
  assembler_.Flush();
  step_ = CaptureStep();
  served_ = 0;
  ended_ = false;
}

}  // namespace dendro
