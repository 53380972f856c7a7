#pragma once

#include <cstdint>
#include <memory>
#include <stdexcept>
#include <string>

#include "dendro_slam/sensors/pcap_reader.h"

namespace dendro {

/// A socket that cannot be opened or read; the message names address, port and reason.
class UdpError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

struct UdpSourceConfig {
  std::string address = "0.0.0.0";  ///< Local IPv4 address to listen on.
  int port = 2368;                  ///< UDP port, [0, 65535]; 0 takes any free one.
  std::string sender;               ///< Only datagrams from this IPv4 address; empty: from any.
  int receive_buffer_bytes = 8388608;  ///< Asked of the kernel; see buffer_bytes(). > 0.
  int inherited_fd = -1;  ///< A socket that is bound already, handed down by a parent process that
                          ///< keeps it open, so that datagrams wait in it while a reader that died
                          ///< is started again; -1: bind one.

  void Validate() const;
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("address", address);
    v("port", port);
    v("sender", sender);
    v("receive_buffer_bytes", receive_buffer_bytes);
    v("inherited_fd", inherited_fd);
  }
};

/// Receives datagrams from a live sensor, stamped by the kernel when they arrived (realtime clock).
/// What the socket's buffer could not hold is counted. For one thread; reads have a timeout, so
/// that a loop around them can end.
class UdpSource {
 public:
  /// @throws std::invalid_argument naming the field, UdpError when the port cannot be bound.
  explicit UdpSource(const UdpSourceConfig& config = UdpSourceConfig());
  ~UdpSource();
  UdpSource(UdpSource&&) noexcept;
  UdpSource& operator=(UdpSource&&) noexcept;

  /// Waits for the next datagram; the memory of `packet` is used again, its port is the local one.
  /// @param timeout_s  At most this long; 0 only looks [s].
  /// @return  False when nothing came in time or a signal interrupted the wait.
  /// @throws UdpError when the socket fails.
  bool Receive(UdpPacket& packet, double timeout_s);

  int port() const;                   ///< The port that was bound.
  int buffer_bytes() const;           ///< Receive buffer that the kernel granted.
  std::uint64_t received() const;     ///< Datagrams returned.
  std::uint64_t dropped() const;      ///< Datagrams that the kernel dropped, as of the last one read.
  std::uint64_t other_senders() const;  ///< Datagrams from other addresses, ignored.

 private:
  struct State;
  std::unique_ptr<State> state_;
};

}  // namespace dendro
