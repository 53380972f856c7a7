#include "dendro_slam/sensors/vlp16_decoder.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>

namespace dendro {

namespace {

constexpr std::size_t kBlockBytes = 100;
constexpr std::size_t kBlockHeaderBytes = 4;
constexpr std::size_t kFiringBytes = 48;
constexpr std::uint8_t kHiResFactoryByte = 0x24;
constexpr std::int64_t kHourUs = vlp16::kHourNs / 1000;
constexpr std::size_t kRecentPackets = 16;
constexpr std::int64_t kReorderedUs = 500000;    // Older than this, the clock jumped instead.
constexpr std::int64_t kLongestLossUs = 10000000;
constexpr std::int64_t kTimingToleranceUs = 3;
constexpr int kJudgedPeriods = 3;  // Packets that may be lost while judging, plus one.
// 1200 rpm turn 0.80 degrees between two blocks; a margin for a head that is still settling.
constexpr double kMaxBlockStepDeg = 1.1;
constexpr int kFullCircle = 36000;

std::uint32_t GetU16(const std::uint8_t* p) {
  return static_cast<std::uint32_t>(p[0]) | static_cast<std::uint32_t>(p[1]) << 8;
}

std::uint32_t GetU32(const std::uint8_t* p) { return GetU16(p) | GetU16(p + 2) << 16; }

bool KnownMode(std::uint8_t mode) { return mode >= 0x37 && mode <= 0x39; }

// Real sensors round up to 360.00 degrees now and then.
bool BlockIsSound(const std::uint8_t* block) {
  return block[0] == 0xFF && block[1] == 0xEE && GetU16(block + 2) <= kFullCircle;
}

// From one block to the next, in [0, 360) [deg].
double StepDeg(const std::uint8_t* from, const std::uint8_t* to) {
  const int step = static_cast<int>(GetU16(to + 2)) - static_cast<int>(GetU16(from + 2));
  return 0.01 * ((step + kFullCircle) % kFullCircle);
}

// Difference of two times of the hour, in (-half, half] an hour.
std::int64_t HourDifferenceUs(std::uint32_t later, std::uint32_t earlier) {
  std::int64_t d = (static_cast<std::int64_t>(later) - static_cast<std::int64_t>(earlier)) % kHourUs;
  if (d <= -kHourUs / 2) d += kHourUs;
  if (d > kHourUs / 2) d -= kHourUs;
  return d;
}

double PeriodUs(ReturnMode mode) { return vlp16::PacketPeriodS(mode) * 1e6; }

// Two packets of a VLP-16 are whole packet periods apart, and the head turns as far between them
// as their blocks say. Both together tell it from the other models.
bool TimingOfVlp16(const std::uint8_t* a, const std::uint8_t* b, ReturnMode mode) {
  const std::int64_t dt = HourDifferenceUs(GetU32(b + 1200), GetU32(a + 1200));
  const double period = PeriodUs(mode);
  const int n = static_cast<int>(std::lround(static_cast<double>(dt) / period));
  if (n < 1 || n > kJudgedPeriods) return false;
  if (std::abs(static_cast<double>(dt) - n * period) > kTimingToleranceUs) return false;
  const std::size_t last = mode == ReturnMode::kDual ? 10 : 11;
  const int steps = mode == ReturnMode::kDual ? 5 : 11;
  if (!BlockIsSound(a) || !BlockIsSound(a + last * kBlockBytes) || !BlockIsSound(b)) return false;
  const double within = StepDeg(a, a + last * kBlockBytes);
  const double expected = within * n * (steps + 1) / steps;
  double off = std::fmod(StepDeg(a, b) - expected, 360.0);
  if (off > 180.0) off -= 360.0;
  if (off < -180.0) off += 360.0;
  return std::abs(off) < 0.1 + 0.05 * expected;
}

RawReturn ReadReturn(const std::uint8_t* p) {
  RawReturn value;
  value.range_m = static_cast<float>(GetU16(p) * vlp16::kRangeResolutionM);
  if (value.range_m > 0.0F) value.reflectivity = p[2];
  return value;
}

}  // namespace

Vlp16Decoder::Vlp16Decoder(const Vlp16ClockConfig& clock) : clock_(clock) {}

void Vlp16Decoder::Reset() {
  clock_.Reset();
  recent_us_.clear();
  if (!held_.empty()) {
    held_.clear();
    --counters_.held;
    ++counters_.foreign;
  }
}

Vlp16Decoder::Status Vlp16Decoder::CheckOrder(const Header& header) {
  if (recent_us_.empty()) return Status::kDecoded;
  if (std::find(recent_us_.begin(), recent_us_.end(), header.time_of_hour_us) !=
      recent_us_.end()) {
    return Status::kDuplicated;
  }
  const std::int64_t dt = HourDifferenceUs(header.time_of_hour_us, recent_us_.back());
  if (dt < 0 && dt > -kReorderedUs) return Status::kReordered;
  if (dt < 0 || dt > kLongestLossUs) {
    ++counters_.clock_jumps;
    clock_.Reset();
    recent_us_.clear();
    return Status::kDecoded;
  }
  const auto periods = std::llround(static_cast<double>(dt) / PeriodUs(header.mode));
  if (periods > 1) counters_.lost += static_cast<std::uint64_t>(periods - 1);
  return Status::kDecoded;
}

Vlp16Decoder::Status Vlp16Decoder::DecodeData(const std::uint8_t* data,
                                              std::size_t size,
                                              std::int64_t host_ns,
                                              std::vector<Vlp16Firing>& firings) {
  ++counters_.packets;
  if (data == nullptr || size < vlp16::kDataPacketBytes) {
    ++counters_.truncated;
    return Status::kTruncated;
  }
  const auto foreign = [this] {
    ++counters_.foreign;
    return Status::kForeign;
  };
  if (size != vlp16::kDataPacketBytes || !KnownMode(data[1204])) return foreign();
  const Header header{GetU32(data + 1200), static_cast<ReturnMode>(data[1204]), data[1205]};
  if (header.time_of_hour_us >= kHourUs || header.factory == kHiResFactoryByte) return foreign();
  bool any_block = false;
  for (int block = 0; block < vlp16::kBlocks; ++block) {
    any_block = any_block || BlockIsSound(data + static_cast<std::size_t>(block) * kBlockBytes);
  }
  if (!any_block) return foreign();

  if (header.factory != vlp16::kFactoryByte && odd_factory_byte_ != header.factory) {
    const bool same_source = !held_.empty() && held_[1205] == header.factory &&
                             held_[1204] == data[1204];
    if (same_source && GetU32(&held_[1200]) == header.time_of_hour_us) {
      ++counters_.duplicated;
      return Status::kDuplicated;
    }
    if (!same_source || !TimingOfVlp16(held_.data(), data, header.mode)) {
      if (!held_.empty()) {
        ++counters_.foreign;
      } else {
        ++counters_.held;
      }
      held_.assign(data, data + size);
      held_host_ns_ = host_ns;
      return Status::kHeld;
    }
    odd_factory_byte_ = header.factory;
    const std::vector<std::uint8_t> first = std::move(held_);
    held_.clear();
    --counters_.held;
    --counters_.packets;  // It comes again.
    DecodeData(first.data(), first.size(), held_host_ns_, firings);
  }

  const Status order = CheckOrder(header);
  if (order == Status::kDuplicated) ++counters_.duplicated;
  if (order == Status::kReordered) ++counters_.reordered;
  if (order != Status::kDecoded) return order;
  recent_us_.push_back(header.time_of_hour_us);
  if (recent_us_.size() > kRecentPackets) recent_us_.pop_front();
  ++counters_.decoded;
  Unpack(data, header, host_ns, firings);
  return Status::kDecoded;
}

void Vlp16Decoder::Unpack(const std::uint8_t* data,
                          const Header& header,
                          std::int64_t host_ns,
                          std::vector<Vlp16Firing>& firings) {
  const bool dual = header.mode == ReturnMode::kDual;
  const std::size_t stride = dual ? 2 : 1;  // Blocks per pair of firings.
  const std::size_t pairs = vlp16::kBlocks / stride;
  const double block_time_s = 2.0 * vlp16::kFiringPeriodS;
  const auto block_at = [&](std::size_t pair) { return data + pair * stride * kBlockBytes; };

  const std::int64_t sensor_ns = clock_.Unwrap(header.time_of_hour_us);
  const std::int64_t stamp_ns = clock_.StampNs(
      sensor_ns, host_ns,
      static_cast<std::int64_t>(std::llround(vlp16::PacketPeriodS(header.mode) * 1e9)));

  // Mean step over the packet, for a block whose own step to the next is not known.
  double mean_step = 0.0;
  {
    double sum = 0.0;
    int steps = 0;
    for (std::size_t pair = 0; pair + 1 < pairs; ++pair) {
      if (!BlockIsSound(block_at(pair)) || !BlockIsSound(block_at(pair + 1))) continue;
      const double step = StepDeg(block_at(pair), block_at(pair + 1));
      if (step > kMaxBlockStepDeg) continue;
      sum += step;
      ++steps;
    }
    if (steps > 0) mean_step = sum / steps;
  }

  for (std::size_t pair = 0; pair < pairs; ++pair) {
    const std::uint8_t* block = block_at(pair);
    const std::uint8_t* strongest_block = dual ? block + kBlockBytes : block;
    if (!BlockIsSound(block) ||
        (dual && (!BlockIsSound(strongest_block) ||
                  GetU16(block + 2) != GetU16(strongest_block + 2)))) {
      counters_.bad_blocks += dual ? 2 : 1;
      continue;
    }
    double step = mean_step;
    if (pair + 1 < pairs && BlockIsSound(block_at(pair + 1))) {
      const double own = StepDeg(block, block_at(pair + 1));
      if (own <= kMaxBlockStepDeg) step = own;
    }
    for (std::size_t half = 0; half < 2; ++half) {
      Vlp16Firing firing;
      const double after_s =
          (2.0 * static_cast<double>(pair) + static_cast<double>(half)) * vlp16::kFiringPeriodS;
      const std::int64_t after_ns = static_cast<std::int64_t>(std::llround(after_s * 1e9));
      firing.sensor_ns = sensor_ns + after_ns;
      firing.raw.stamp_ns = stamp_ns + after_ns;
      firing.mode = header.mode;
      firing.starts_block = half == 0;
      firing.rate_deg_per_s = step / block_time_s;
      firing.raw.azimuth_deg = vlp16::WrapAzimuthDeg(0.01 * GetU16(block + 2) +
                                                     0.5 * step * static_cast<double>(half));
      const std::size_t offset = kBlockHeaderBytes + half * kFiringBytes;
      for (std::size_t laser = 0; laser < vlp16::kLasers; ++laser) {
        if (header.mode != ReturnMode::kLast) {
          firing.raw.strongest[laser] = ReadReturn(strongest_block + offset + 3 * laser);
        }
        if (header.mode != ReturnMode::kStrongest) {
          firing.raw.last[laser] = ReadReturn(block + offset + 3 * laser);
        }
      }
      firings.push_back(firing);
    }
  }
}

std::optional<GnssFix> Vlp16Decoder::DecodePosition(const std::uint8_t* data,
                                                    std::size_t size,
                                                    std::int64_t host_ns) {
  const std::optional<PositionPacket> packet = ParsePositionPacket(data, size);
  if (!packet) {
    ++counters_.bad_positions;
    return std::nullopt;
  }
  const std::int64_t stamp_ns = clock_.OnPosition(*packet, host_ns);
  if (!packet->fix) {
    ++counters_.bad_positions;
    return std::nullopt;
  }
  ++counters_.positions;
  GnssFix fix = *packet->fix;
  fix.stamp_ns = stamp_ns;
  return fix;
}

}  // namespace dendro
