#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

namespace dendro {

/// A capture that cannot be opened, read or written; the message names the file and the reason.
class PcapError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// A UDP datagram from a capture.
struct UdpPacket {
  std::int64_t stamp_ns = 0;  ///< When it was captured [ns since 1970].
  std::uint16_t port = 0;     ///< Destination port.
  std::vector<std::uint8_t> payload;
};

/// Reads the UDP datagrams of a capture (pcap or pcapng, any time resolution) in the file's order:
/// Ethernet with or without VLAN tags, Linux cooked, loopback and raw IPv4. Frames that hold no
/// whole UDP datagram are counted and skipped.
class PcapReader {
 public:
  /// @throws PcapError when the file cannot be opened or is no capture of a known link type.
  explicit PcapReader(const std::string& path);
  ~PcapReader();
  PcapReader(PcapReader&&) noexcept;
  PcapReader& operator=(PcapReader&&) noexcept;

  /// Reads the next datagram into `packet`, whose memory is used again.
  /// @return  False at the end of the file.
  /// @throws PcapError when the file is damaged. Files cut short by a power failure end there, with
  ///         `cut_short()` true.
  bool Next(UdpPacket& packet);

  /// Back to the first datagram.
  void Rewind();

  std::uint64_t skipped_frames() const;  ///< Not UDP over IPv4, a fragment, or cut short.
  bool cut_short() const;                ///< The file ended inside a record.

 private:
  struct State;
  std::unique_ptr<State> state_;
};

}  // namespace dendro
