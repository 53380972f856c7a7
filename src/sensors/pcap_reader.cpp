#include "dendro_slam/sensors/pcap_reader.h"

#include <array>
#include <cstddef>

#include <pcap/pcap.h>

namespace dendro {

namespace {

constexpr std::size_t kUdpHeader = 8;
constexpr std::uint16_t kIpv4 = 0x0800;
constexpr std::uint8_t kUdp = 17;

std::uint16_t Be16(const std::uint8_t* p) { return static_cast<std::uint16_t>(p[0] << 8 | p[1]); }

// Where the network layer begins, and its ethertype.
struct Network {
  std::size_t offset;
  std::uint16_t type;
};

std::optional<Network> SkipLink(int link, const std::uint8_t* frame, std::size_t size) {
  const auto ethertype = [&](std::size_t at) -> std::optional<Network> {
    while (size >= at + 2) {
      const std::uint16_t type = Be16(frame + at);
      if (type != 0x8100 && type != 0x88A8) return Network{at + 2, type};
      at += 4;  // VLAN tag.
    }
    return std::nullopt;
  };
  switch (link) {
    case DLT_EN10MB:
      return ethertype(12);
    case DLT_LINUX_SLL:
      return ethertype(14);
#ifdef DLT_LINUX_SLL2
    case DLT_LINUX_SLL2:
      if (size < 20) return std::nullopt;
      return Network{20, Be16(frame)};
#endif
    case DLT_RAW:
    case DLT_IPV4:
      return Network{0, kIpv4};
    case DLT_NULL:
    case DLT_LOOP:
      return Network{4, kIpv4};  // The address family; IPv4 is checked again below.
    default:
      return std::nullopt;
  }
}

bool KnownLink(int link) {
  switch (link) {
    case DLT_EN10MB:
    case DLT_LINUX_SLL:
#ifdef DLT_LINUX_SLL2
    case DLT_LINUX_SLL2:
#endif
    case DLT_RAW:
    case DLT_IPV4:
    case DLT_NULL:
    case DLT_LOOP:
      return true;
    default:
      return false;
  }
}

struct Datagram {
  std::uint16_t port;
  const std::uint8_t* payload;
  std::size_t size;
};

std::optional<Datagram> FindDatagram(int link, const std::uint8_t* frame, std::size_t size) {
  const std::optional<Network> network = SkipLink(link, frame, size);
  if (!network || network->type != kIpv4 || size < network->offset + 20) return std::nullopt;
  const std::uint8_t* ip = frame + network->offset;
  const std::size_t ip_size = size - network->offset;
  const std::size_t header = static_cast<std::size_t>(ip[0] & 0x0F) * 4;
  if (ip[0] >> 4 != 4 || header < 20 || ip_size < header + kUdpHeader || ip[9] != kUdp) {
    return std::nullopt;
  }
  if ((Be16(ip + 6) & 0x3FFF) != 0) return std::nullopt;  // A fragment.
  const std::uint8_t* udp = ip + header;
  const std::size_t length = Be16(udp + 4);
  if (length < kUdpHeader || length > ip_size - header) return std::nullopt;
  return Datagram{Be16(udp + 2), udp + kUdpHeader, length - kUdpHeader};
}

}  // namespace

struct PcapReader::State {
  std::string path;
  pcap_t* pcap = nullptr;
  int link = 0;
  std::uint64_t skipped = 0;
  bool cut_short = false;

  ~State() { Close(); }
  void Close() {
    if (pcap != nullptr) pcap_close(pcap);
    pcap = nullptr;
  }
  void Open() {
    Close();
    skipped = 0;
    cut_short = false;
    std::array<char, PCAP_ERRBUF_SIZE> error{};
    pcap = pcap_open_offline_with_tstamp_precision(path.c_str(), PCAP_TSTAMP_PRECISION_NANO,
                                                   error.data());
    if (pcap == nullptr) {
      // libpcap names the file only when it cannot open it.
      const std::string reason = error.data();
      throw PcapError(reason.find(path) != std::string::npos ? reason : path + ": " + reason);
    }
    link = pcap_datalink(pcap);
    if (!KnownLink(link)) {
      const char* name = pcap_datalink_val_to_name(link);
      throw PcapError(path + ": link type " + (name != nullptr ? name : std::to_string(link)) +
                      " is not supported");
    }
  }
};

PcapReader::PcapReader(const std::string& path) : state_(std::make_unique<State>()) {
  state_->path = path;
  state_->Open();
}

PcapReader::~PcapReader() = default;
PcapReader::PcapReader(PcapReader&&) noexcept = default;
PcapReader& PcapReader::operator=(PcapReader&&) noexcept = default;

bool PcapReader::Next(UdpPacket& packet) {
  for (;;) {
    if (state_->cut_short) return false;
    pcap_pkthdr* header = nullptr;
    const u_char* frame = nullptr;
    const int result = pcap_next_ex(state_->pcap, &header, &frame);
    if (result == PCAP_ERROR_BREAK) return false;
    if (result != 1) {
      const std::string reason = pcap_geterr(state_->pcap);
      if (reason.find("truncated") != std::string::npos) {
        state_->cut_short = true;
        return false;
      }
      throw PcapError(state_->path + ": " + reason);
    }
    const std::optional<Datagram> datagram = FindDatagram(state_->link, frame, header->caplen);
    if (!datagram) {
      ++state_->skipped;
      continue;
    }
    // With nanosecond precision, tv_usec holds nanoseconds.
    packet.stamp_ns = static_cast<std::int64_t>(header->ts.tv_sec) * 1000000000LL +
                      static_cast<std::int64_t>(header->ts.tv_usec);
    packet.port = datagram->port;
    packet.payload.assign(datagram->payload, datagram->payload + datagram->size);
    return true;
  }
}

void PcapReader::Rewind() { state_->Open(); }

std::uint64_t PcapReader::skipped_frames() const { return state_->skipped; }
bool PcapReader::cut_short() const { return state_->cut_short; }

}  // namespace dendro
