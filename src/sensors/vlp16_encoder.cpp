#include "dendro_slam/sensors/vlp16_encoder.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <stdexcept>
#include <string>

#include <fmt/format.h>

namespace dendro {

namespace {

constexpr std::size_t kBlockBytes = 100;

void PutU16(std::uint8_t* out, std::uint32_t value) {
  out[0] = static_cast<std::uint8_t>(value & 0xFF);
  out[1] = static_cast<std::uint8_t>((value >> 8) & 0xFF);
}

void PutU32(std::uint8_t* out, std::uint32_t value) {
  PutU16(out, value & 0xFFFF);
  PutU16(out + 2, value >> 16);
}

std::uint32_t TimeOfHourUs(std::int64_t stamp_ns) {
  return static_cast<std::uint32_t>(((stamp_ns + 500) / 1000) % (vlp16::kHourNs / 1000));
}

void PutReturns(const std::array<RawReturn, vlp16::kLasers>& returns, std::uint8_t* out) {
  for (const RawReturn& value : returns) {
    // A range that does not fit was not measured.
    const double units = std::round(value.range_m / vlp16::kRangeResolutionM);
    const bool fits = units >= 1.0 && units <= 65535.0;
    PutU16(out, fits ? static_cast<std::uint32_t>(units) : 0U);
    out[2] = fits ? value.reflectivity : std::uint8_t{0};
    out += 3;
  }
}

// Days since 1970-01-01 to year, month, day (H. Hinnant, "chrono-compatible low-level date
// algorithms").
struct Date {
  int year;
  int month;
  int day;
};
Date DateOfDays(std::int64_t days) {
  days += 719468;
  const std::int64_t era = (days >= 0 ? days : days - 146096) / 146097;
  const std::int64_t doe = days - era * 146097;
  const std::int64_t yoe = (doe - doe / 1460 + doe / 36524 - doe / 146096) / 365;
  const std::int64_t doy = doe - (365 * yoe + yoe / 4 - yoe / 100);
  const std::int64_t mp = (5 * doy + 2) / 153;
  const int month = static_cast<int>(mp < 10 ? mp + 3 : mp - 9);
  return {static_cast<int>(yoe + era * 400) + (month <= 2 ? 1 : 0), month,
          static_cast<int>(doy - (153 * mp + 2) / 5 + 1)};
}

// ddmm.mmmmm, without ever printing 60 minutes.
std::string DegreesMinutes(double degrees, int degree_digits) {
  const std::int64_t units = std::llround(std::abs(degrees) * 60.0 * 1e7);
  constexpr std::int64_t kPerDegree = 60LL * 10000000LL;
  const std::int64_t minutes = units % kPerDegree;
  return fmt::format("{:0{}d}{:02d}.{:07d}", units / kPerDegree, degree_digits,
                     minutes / 10000000, minutes % 10000000);
}

}  // namespace

Vlp16Encoder::Vlp16Encoder(ReturnMode mode, std::uint8_t factory_byte) : mode_(mode) {
  packet_.data[1204] = static_cast<std::uint8_t>(mode);
  packet_.data[1205] = factory_byte;
}

std::optional<Vlp16Encoder::Packet> Vlp16Encoder::Add(const RawFiring& firing) {
  if (!std::isfinite(firing.azimuth_deg)) {
    throw std::invalid_argument("azimuth_deg must be finite");
  }
  if (firing.stamp_ns < 0) throw std::invalid_argument("stamp_ns must not be negative");
  const bool dual = mode_ == ReturnMode::kDual;
  const std::size_t pair = static_cast<std::size_t>(firings_ / 2);
  const bool first_of_block = firings_ % 2 == 0;
  const auto put_block = [&](std::size_t block, const auto& returns) {
    std::uint8_t* out = packet_.data.data() + block * kBlockBytes;
    if (first_of_block) {
      PutU16(out, 0xEEFF);  // FF EE on the wire.
      const double wrapped = vlp16::WrapAzimuthDeg(firing.azimuth_deg);
      PutU16(out + 2, static_cast<std::uint32_t>(std::lround(wrapped * 100.0)) % 36000U);
    }
    PutReturns(returns, out + 4 + (first_of_block ? 0 : 48));
  };
  if (firings_ == 0) PutU32(packet_.data.data() + 1200, TimeOfHourUs(firing.stamp_ns));
  if (dual) {
    put_block(2 * pair, firing.last);
    put_block(2 * pair + 1, firing.strongest);
  } else {
    put_block(pair, mode_ == ReturnMode::kLast ? firing.last : firing.strongest);
  }
  if (++firings_ < vlp16::FiringsPerPacket(mode_)) return std::nullopt;
  firings_ = 0;
  packet_.stamp_ns =
      firing.stamp_ns + static_cast<std::int64_t>(std::llround(vlp16::kFiringPeriodS * 1e9));
  return packet_;
}

void Vlp16Encoder::Clear() { firings_ = 0; }

std::array<std::uint8_t, vlp16::kPositionPacketBytes> EncodePositionPacket(const GnssFix& fix,
                                                                           std::int64_t stamp_ns,
                                                                           PpsStatus pps) {
  if (!std::isfinite(fix.latitude_deg) || std::abs(fix.latitude_deg) > 90.0) {
    throw std::invalid_argument("latitude_deg must be in [-90, 90]");
  }
  if (!std::isfinite(fix.longitude_deg) || std::abs(fix.longitude_deg) > 180.0) {
    throw std::invalid_argument("longitude_deg must be in [-180, 180]");
  }
  if (!std::isfinite(fix.speed_mps) || fix.speed_mps < 0.0 || fix.speed_mps > 1e4) {
    throw std::invalid_argument("speed_mps must be in [0, 10000]");
  }
  if (!std::isfinite(fix.course_deg)) throw std::invalid_argument("course_deg must be finite");
  if (stamp_ns < 0 || fix.utc_ns < 0) {
    throw std::invalid_argument("stamp_ns and utc_ns must not be negative");
  }
  constexpr std::int64_t kDayCs = 8640000;  // Hundredths of a second.
  const std::int64_t cs = (fix.utc_ns + 5000000) / 10000000;
  const std::int64_t of_day = cs % kDayCs;
  const Date date = DateOfDays(cs / kDayCs);
  const std::string body = fmt::format(
      "GPRMC,{:02d}{:02d}{:02d}.{:02d},{},{},{},{},{},{:.3f},{:.1f},{:02d}{:02d}{:02d},,,{}",
      of_day / 360000, of_day / 6000 % 60, of_day / 100 % 60, of_day % 100,
      fix.valid ? 'A' : 'V', DegreesMinutes(fix.latitude_deg, 2),
      fix.latitude_deg < 0.0 ? 'S' : 'N', DegreesMinutes(fix.longitude_deg, 3),
      fix.longitude_deg < 0.0 ? 'W' : 'E', fix.speed_mps * 3600.0 / 1852.0,
      vlp16::WrapAzimuthDeg(fix.course_deg), date.day, date.month, date.year % 100,
      fix.valid ? 'A' : 'N');
  unsigned checksum = 0;
  for (const char c : body) checksum ^= static_cast<unsigned char>(c);
  const std::string sentence = fmt::format("${}*{:02X}\r\n", body, checksum);

  std::array<std::uint8_t, vlp16::kPositionPacketBytes> packet{};
  PutU32(packet.data() + 198, TimeOfHourUs(stamp_ns));
  packet[202] = static_cast<std::uint8_t>(pps);
  std::memcpy(packet.data() + 206, sentence.data(), std::min<std::size_t>(sentence.size(), 128));
  return packet;
}

}  // namespace dendro
