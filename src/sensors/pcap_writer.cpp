#include "dendro_slam/sensors/pcap_writer.h"

#include <array>
#include <cerrno>
#include <cstdio>
#include <cstring>
#include <vector>

#include <pcap/pcap.h>

namespace dendro {

namespace {

constexpr std::size_t kUdpHeader = 8;
constexpr std::uint8_t kUdp = 17;

}  // namespace

struct PcapWriter::State {
  std::string path;
  pcap_t* pcap = nullptr;
  pcap_dumper_t* dumper = nullptr;
  std::vector<std::uint8_t> frame;
  std::uint16_t id = 0;

  ~State() {
    if (dumper != nullptr) pcap_dump_close(dumper);
    if (pcap != nullptr) pcap_close(pcap);
  }
};

PcapWriter::PcapWriter(const std::string& path) : state_(std::make_unique<State>()) {
  state_->path = path;
  state_->pcap =
      pcap_open_dead_with_tstamp_precision(DLT_EN10MB, 262144, PCAP_TSTAMP_PRECISION_NANO);
  if (state_->pcap == nullptr) throw PcapError(path + ": out of memory");
  state_->dumper = pcap_dump_open(state_->pcap, path.c_str());
  if (state_->dumper == nullptr) {
    const std::string reason = pcap_geterr(state_->pcap);
    throw PcapError(reason.find(path) != std::string::npos ? reason : path + ": " + reason);
  }
}

PcapWriter::~PcapWriter() = default;
PcapWriter::PcapWriter(PcapWriter&&) noexcept = default;
PcapWriter& PcapWriter::operator=(PcapWriter&&) noexcept = default;

void PcapWriter::Write(std::int64_t stamp_ns,
                       std::uint16_t port,
                       const std::uint8_t* data,
                       std::size_t size) {
  State& s = *state_;
  if (s.dumper == nullptr) throw PcapError(s.path + ": is closed");
  if (size > 65507) throw PcapError(s.path + ": a datagram holds at most 65507 bytes");
  if (stamp_ns < 0) throw PcapError(s.path + ": negative stamp");
  const auto put16 = [&s](std::size_t at, std::size_t value) {
    s.frame[at] = static_cast<std::uint8_t>(value >> 8 & 0xFF);
    s.frame[at + 1] = static_cast<std::uint8_t>(value & 0xFF);
  };
  // Broadcast from the sensor's factory address; no UDP checksum, as the sensor sends none.
  static constexpr std::array<std::uint8_t, 42> kHeader = {
      0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0x60, 0x76, 0x88, 0x00, 0x00, 0x00, 0x08, 0x00,
      0x45, 0x00, 0,    0,    0,    0,    0x40, 0x00, 0xFF, kUdp, 0,    0,    192,  168,
      1,    201,  255,  255,  255,  255,  0,    0,    0,    0,    0,    0,    0,    0};
  s.frame.resize(kHeader.size() + size);
  std::memcpy(s.frame.data(), kHeader.data(), kHeader.size());
  if (size > 0) std::memcpy(s.frame.data() + kHeader.size(), data, size);
  put16(16, 20 + kUdpHeader + size);
  put16(18, s.id++);
  put16(34, port);
  put16(36, port);
  put16(38, kUdpHeader + size);
  std::uint32_t sum = 0;
  for (std::size_t i = 14; i < 34; i += 2) {
    sum += static_cast<std::uint32_t>(s.frame[i]) << 8 | s.frame[i + 1];
  }
  while (sum >> 16 != 0) sum = (sum & 0xFFFF) + (sum >> 16);
  put16(24, ~sum & 0xFFFF);

  pcap_pkthdr header{};
  header.ts.tv_sec = static_cast<time_t>(stamp_ns / 1000000000LL);
  header.ts.tv_usec = static_cast<suseconds_t>(stamp_ns % 1000000000LL);
  header.caplen = static_cast<bpf_u_int32>(s.frame.size());
  header.len = header.caplen;
  pcap_dump(reinterpret_cast<u_char*>(s.dumper), &header, s.frame.data());
  if (std::ferror(pcap_dump_file(s.dumper)) != 0) {
    throw PcapError(s.path + ": " + std::strerror(errno));
  }
}

void PcapWriter::Close() {
  State& s = *state_;
  if (s.dumper == nullptr) return;
  const bool failed =
      pcap_dump_flush(s.dumper) != 0 || std::ferror(pcap_dump_file(s.dumper)) != 0;
  const int error = errno;
  pcap_dump_close(s.dumper);
  s.dumper = nullptr;
  if (failed) throw PcapError(s.path + ": " + std::strerror(error));
}

}  // namespace dendro
