#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <vector>

#include "dendro_slam/sensors/scan_assembler.h"
#include "dendro_slam/sensors/vlp16_decoder.h"

// Fuzz target in libFuzzer's form (AFL++ takes it too): a stream of datagrams into one decoder and
// one assembler. Build with -DDENDRO_FUZZ=ON and clang; the ordinary build links it to a driver that
// replays the corpus.
//
// Input: records of one byte of flags (bit 0: position packet, bit 1: the packet's bytes follow in
// full, else the previous packet comes again with some bytes changed), then
//   full: two bytes of length, that many bytes;
//   changed: one byte n, then n times (two bytes of position, one byte of value).
// At most kMostPackets of them are used: enough for a whole revolution at 1200 rpm with its cut, and
// few enough that no input is slow.

namespace {

constexpr int kMostPackets = 48;

void Require(bool condition) {
  if (!condition) std::abort();
}

class Input {
 public:
  Input(const std::uint8_t* data, std::size_t size) : data_(data), left_(size) {}
  bool empty() const { return left_ == 0; }
  std::uint8_t Byte() {
    if (left_ == 0) return 0;
    --left_;
    return *data_++;
  }
  std::size_t Word() {
    const std::size_t low = Byte();
    return low | static_cast<std::size_t>(Byte()) << 8;
  }
  void Bytes(std::size_t n, std::vector<std::uint8_t>& out) {
    n = n < left_ ? n : left_;
    out.assign(data_, data_ + n);
    data_ += n;
    left_ -= n;
  }

 private:
  const std::uint8_t* data_;
  std::size_t left_;
};

void CheckScan(const dendro::LidarScan& scan) {
  for (const dendro::LidarPoint& p : scan.points) {
    // By hand: Eigen's own check costs a third of the whole run under the sanitizers.
    Require(std::isfinite(p.position.x()) && std::isfinite(p.position.y()) &&
            std::isfinite(p.position.z()) && std::isfinite(p.time_s));
    Require(p.ring < dendro::vlp16::kLasers);
    Require(p.intensity >= 0.0F && p.intensity <= 255.0F);
  }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  Input input(data, size);
  dendro::Vlp16ClockConfig clock;
  dendro::ScanAssemblerConfig assembler_config;
  const std::uint8_t setup = input.Byte();
  if ((setup & 1) != 0) clock.clock = "gps";
  assembler_config.stamp_at_end = (setup & 2) != 0;
  assembler_config.cut_azimuth_deg = setup >> 2;
  dendro::Vlp16Decoder decoder(clock);
  dendro::ScanAssembler assembler(assembler_config);
  std::vector<dendro::Vlp16Firing> firings;
  std::vector<std::uint8_t> packet;
  std::int64_t host_ns = 1500000000000000000LL;
  for (int packets = 0; packets < kMostPackets && !input.empty(); ++packets) {
    const std::uint8_t flags = input.Byte();
    if ((flags & 2) != 0) {
      input.Bytes(input.Word(), packet);
    } else {
      const std::uint8_t changes = input.Byte();
      for (int i = 0; i < changes && !input.empty(); ++i) {
        const std::size_t at = input.Word();
        const std::uint8_t value = input.Byte();
        if (!packet.empty()) packet[at % packet.size()] = value;
      }
    }
    host_ns += (flags & 0xFC) * 100000LL - 1000000LL;
    // A copy of the exact size, so that the address sanitizer guards both ends.
    const std::vector<std::uint8_t> exact(packet);
    if ((flags & 1) != 0) {
      const auto fix = decoder.DecodePosition(exact.data(), exact.size(), host_ns);
      if (fix) {
        Require(std::abs(fix->latitude_deg) <= 90.0 && std::abs(fix->longitude_deg) <= 180.0);
        Require(std::isfinite(fix->speed_mps) && std::isfinite(fix->course_deg));
      }
      continue;
    }
    firings.clear();
    decoder.DecodeData(exact.data(), exact.size(), host_ns, firings);
    for (const dendro::Vlp16Firing& f : firings) {
      Require(f.raw.azimuth_deg >= 0.0 && f.raw.azimuth_deg < 360.0);
      Require(f.rate_deg_per_s >= 0.0 && f.rate_deg_per_s < 1e4);
      if (const auto scan = assembler.Add(f)) CheckScan(*scan);
    }
  }
  if (const auto scan = assembler.Flush()) CheckScan(*scan);
  const dendro::Vlp16Counters& c = decoder.counters();
  Require(c.decoded + c.truncated + c.foreign + c.duplicated + c.reordered + c.held == c.packets);
  return 0;
}
