#include "dendro_slam/sensors/udp_source.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <ctime>

namespace dendro {

namespace {

constexpr std::size_t kLargestDatagram = 65536;

bool ParseAddress(const std::string& text, in_addr& out) {
  return inet_pton(AF_INET, text.c_str(), &out) == 1;
}

}  // namespace

void UdpSourceConfig::Validate() const {
  in_addr unused{};
  if (!ParseAddress(address, unused)) {
    throw std::invalid_argument("address must be an IPv4 address, not '" + address + "'");
  }
  if (port < 0 || port > 65535) throw std::invalid_argument("port must be in [0, 65535]");
  if (!sender.empty() && !ParseAddress(sender, unused)) {
    throw std::invalid_argument("sender must be empty or an IPv4 address, not '" + sender + "'");
  }
  if (receive_buffer_bytes < 1) {
    throw std::invalid_argument("receive_buffer_bytes must be positive");
  }
  if (inherited_fd < -1) throw std::invalid_argument("inherited_fd must be a descriptor or -1");
}

struct UdpSource::State {
  int fd = -1;
  int port = 0;
  int buffer_bytes = 0;
  bool filter = false;
  in_addr sender{};
  std::uint64_t received = 0;
  std::uint64_t dropped = 0;
  std::uint32_t last_dropped = 0;
  std::uint64_t other_senders = 0;
  std::array<std::uint8_t, kLargestDatagram> buffer{};

  ~State() {
    if (fd >= 0) close(fd);
  }
};

UdpSource::UdpSource(const UdpSourceConfig& config) : state_(std::make_unique<State>()) {
  config.Validate();
  State& s = *state_;
  const auto fail = [&config](const char* what) {
    throw UdpError("udp " + config.address + ":" + std::to_string(config.port) + ": " + what + ": " +
                   std::strerror(errno));
  };
  const bool inherited = config.inherited_fd >= 0;
  s.fd = inherited ? config.inherited_fd : socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0);
  if (s.fd < 0) fail("socket");
  // The forced size needs a privilege; without it the kernel's limit (net.core.rmem_max) applies.
  const int bytes = config.receive_buffer_bytes;
  if (setsockopt(s.fd, SOL_SOCKET, SO_RCVBUFFORCE, &bytes, sizeof(bytes)) != 0 &&
      setsockopt(s.fd, SOL_SOCKET, SO_RCVBUF, &bytes, sizeof(bytes)) != 0) {
    fail("receive buffer");
  }
  socklen_t length = sizeof(s.buffer_bytes);
  if (getsockopt(s.fd, SOL_SOCKET, SO_RCVBUF, &s.buffer_bytes, &length) != 0) fail("receive buffer");
  const int on = 1;
  if (setsockopt(s.fd, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof(on)) != 0) fail("time stamps");
  if (setsockopt(s.fd, SOL_SOCKET, SO_RXQ_OVFL, &on, sizeof(on)) != 0) fail("drop counter");

  sockaddr_in local{};
  local.sin_family = AF_INET;
  local.sin_port = htons(static_cast<std::uint16_t>(config.port));
  ParseAddress(config.address, local.sin_addr);
  if (!inherited && bind(s.fd, reinterpret_cast<const sockaddr*>(&local), sizeof(local)) != 0) {
    fail("bind");
  }
  length = sizeof(local);
  if (getsockname(s.fd, reinterpret_cast<sockaddr*>(&local), &length) != 0) fail("bind");
  s.port = ntohs(local.sin_port);
  s.filter = !config.sender.empty();
  if (s.filter) ParseAddress(config.sender, s.sender);
}

UdpSource::~UdpSource() = default;
UdpSource::UdpSource(UdpSource&&) noexcept = default;
UdpSource& UdpSource::operator=(UdpSource&&) noexcept = default;

bool UdpSource::Receive(UdpPacket& packet, double timeout_s) {
  State& s = *state_;
  const auto fail = [&s](const char* what) {
    throw UdpError("udp port " + std::to_string(s.port) + ": " + what + ": " +
                   std::strerror(errno));
  };
  const auto now_ms = [] {
    timespec now{};
    clock_gettime(CLOCK_MONOTONIC, &now);
    return static_cast<std::int64_t>(now.tv_sec) * 1000 + now.tv_nsec / 1000000;
  };
  const std::int64_t end_ms =
      now_ms() + static_cast<std::int64_t>(std::ceil(std::fmin(std::fmax(timeout_s, 0.0), 1e6) * 1e3));
  for (;;) {
    sockaddr_in from{};
    iovec io{s.buffer.data(), s.buffer.size()};
    alignas(cmsghdr) std::array<char, 256> control{};
    msghdr message{};
    message.msg_name = &from;
    message.msg_namelen = sizeof(from);
    message.msg_iov = &io;
    message.msg_iovlen = 1;
    message.msg_control = control.data();
    message.msg_controllen = control.size();
    const ssize_t size = recvmsg(s.fd, &message, MSG_DONTWAIT);
    if (size < 0) {
      if (errno == EINTR) return false;
      if (errno != EAGAIN && errno != EWOULDBLOCK && errno != ECONNREFUSED) fail("receive");
      const std::int64_t left_ms = end_ms - now_ms();
      if (left_ms <= 0) return false;
      pollfd poll_fd{s.fd, POLLIN, 0};
      const int ready = poll(&poll_fd, 1, static_cast<int>(left_ms));
      if (ready < 0 && errno != EINTR) fail("poll");
      if (ready <= 0) return false;
      continue;
    }
    std::int64_t stamp_ns = 0;
    for (cmsghdr* c = CMSG_FIRSTHDR(&message); c != nullptr; c = CMSG_NXTHDR(&message, c)) {
      if (c->cmsg_level != SOL_SOCKET) continue;
      if (c->cmsg_type == SCM_TIMESTAMPNS) {
        timespec stamp{};
        std::memcpy(&stamp, CMSG_DATA(c), sizeof(stamp));
        stamp_ns = static_cast<std::int64_t>(stamp.tv_sec) * 1000000000LL + stamp.tv_nsec;
      } else if (c->cmsg_type == SO_RXQ_OVFL) {
        std::uint32_t total = 0;  // Since the socket was opened; wraps.
        std::memcpy(&total, CMSG_DATA(c), sizeof(total));
        s.dropped += total - s.last_dropped;
        s.last_dropped = total;
      }
    }
    if (s.filter && from.sin_addr.s_addr != s.sender.s_addr) {
      ++s.other_senders;
      if (now_ms() > end_ms) return false;
      continue;
    }
    if (stamp_ns == 0) {
      timespec now{};
      clock_gettime(CLOCK_REALTIME, &now);
      stamp_ns = static_cast<std::int64_t>(now.tv_sec) * 1000000000LL + now.tv_nsec;
    }
    packet.stamp_ns = stamp_ns;
    packet.port = static_cast<std::uint16_t>(s.port);
    packet.payload.assign(s.buffer.data(), s.buffer.data() + size);
    ++s.received;
    return true;
  }
}

int UdpSource::port() const { return state_->port; }
int UdpSource::buffer_bytes() const { return state_->buffer_bytes; }
std::uint64_t UdpSource::received() const { return state_->received; }
std::uint64_t UdpSource::dropped() const { return state_->dropped; }
std::uint64_t UdpSource::other_senders() const { return state_->other_senders; }

}  // namespace dendro
