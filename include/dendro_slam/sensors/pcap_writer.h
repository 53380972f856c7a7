#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>

#include "dendro_slam/sensors/pcap_reader.h"

namespace dendro {

/// Writes UDP datagrams as Ethernet frames from 192.168.1.201, as a VLP-16 sends them, with
/// nanosecond stamps.
class PcapWriter {
 public:
  /// @throws PcapError when the file cannot be created.
  explicit PcapWriter(const std::string& path);
  ~PcapWriter();
  PcapWriter(PcapWriter&&) noexcept;
  PcapWriter& operator=(PcapWriter&&) noexcept;

  /// Appends a datagram.
  /// @param port  Source and destination port.
  /// @throws PcapError when the payload exceeds 65507 bytes, the stamp is negative, or the disk is
  ///         full.
  void Write(std::int64_t stamp_ns, std::uint16_t port, const std::uint8_t* data, std::size_t size);

  /// Writes everything out and closes; also done on destruction, but there without an error.
  void Close();

 private:
  struct State;
  std::unique_ptr<State> state_;
};

}  // namespace dendro
