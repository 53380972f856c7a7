#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "dendro_slam/sensors/lidar_scan.h"
#include "dendro_slam/sensors/pcap_reader.h"
#include "dendro_slam/sensors/scan_assembler.h"
#include "dendro_slam/sensors/vlp16_decoder.h"

namespace dendro {

struct CaptureReaderConfig {
  int data_port = vlp16::kDataPort;          ///< UDP port of the data packets, [1, 65535].
  int position_port = vlp16::kPositionPort;  ///< UDP port of the position packets, [1, 65535].

  void Validate() const;
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("data_port", data_port);
    v("position_port", position_port);
  }
};

/// What a step through a capture brought to light. A packet that completes a scan comes in the same
/// step as that scan; the packet's own first firings may belong to the next one.
struct CaptureStep {
  UdpPacket packet;                 ///< The datagram that was read, whatever its port.
  bool is_data = false;             ///< It came to the data port.
  bool is_position = false;         ///< It came to the position port.
  std::vector<LidarScan> scans;     ///< Scans that it completed, usually none.
  std::optional<GnssFix> fix;       ///< Fix that it held, valid or not.
};

/// Plays a VLP-16 capture: datagrams, scans and fixes with their stamps, in the file's order.
class CaptureReader {
 public:
  /// @throws std::invalid_argument naming the field, PcapError when the file cannot be read.
  explicit CaptureReader(const std::string& path,
                         const CaptureReaderConfig& config = CaptureReaderConfig(),
                         const Vlp16ClockConfig& clock = Vlp16ClockConfig(),
                         const ScanAssemblerConfig& assembler = ScanAssemblerConfig());

  /// Reads one datagram; the memory of `step` is used again. After the last one, one more step
  /// without a packet (empty payload, port 0) may bring the unfinished last scan.
  /// @return  False when there is nothing more.
  /// @throws PcapError when the file is damaged.
  bool Next(CaptureStep& step);

  /// The next scan, skipping everything else.
  std::optional<LidarScan> NextScan();

  /// Back to the beginning, with fresh clock and order.
  void Rewind();

  const Vlp16Decoder& decoder() const { return decoder_; }
  const PcapReader& pcap() const { return pcap_; }

 private:
  CaptureReaderConfig config_;
  PcapReader pcap_;
  Vlp16Decoder decoder_;
  ScanAssembler assembler_;
  std::vector<Vlp16Firing> firings_;
  CaptureStep step_;        ///< For NextScan.
  std::size_t served_ = 0;  ///< Scans of step_ already returned by NextScan.
  bool ended_ = false;
};

}  // namespace dendro
