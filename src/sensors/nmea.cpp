#include <charconv>
#include <cmath>
#include <cstring>
#include <string_view>
#include <vector>

#include "dendro_slam/sensors/vlp16_decoder.h"

namespace dendro {

namespace {

constexpr std::size_t kTimeOffset = 198;
constexpr std::size_t kPpsOffset = 202;
constexpr std::size_t kSentenceOffset = 206;
constexpr std::size_t kSentenceBytes = 128;
constexpr double kKnotsToMps = 1852.0 / 3600.0;
constexpr double kNoSecond = -1.0;

// Digits with an optional fraction, nothing else: no sign, exponent, hex, inf or nan.
std::optional<double> Decimal(std::string_view text) {
  if (text.empty() || text.size() > 20) return std::nullopt;
  double value = 0.0;
  double scale = 1.0;
  bool fraction = false;
  bool digit = false;
  for (const char c : text) {
    if (c == '.' && !fraction) {
      fraction = true;
    } else if (c >= '0' && c <= '9') {
      digit = true;
      value = value * 10.0 + (c - '0');
      if (fraction) scale *= 10.0;
    } else {
      return std::nullopt;
    }
  }
  if (!digit) return std::nullopt;
  return value / scale;
}

std::optional<int> TwoDigits(std::string_view text, std::size_t at) {
  if (text.size() < at + 2) return std::nullopt;
  const char a = text[at];
  const char b = text[at + 1];
  if (a < '0' || a > '9' || b < '0' || b > '9') return std::nullopt;
  return (a - '0') * 10 + (b - '0');
}

// ddmm.mmm or dddmm.mmm with its hemisphere, to signed degrees.
std::optional<double> Angle(std::string_view text,
                            std::string_view hemisphere,
                            char positive,
                            char negative,
                            double limit) {
  const std::optional<double> value = Decimal(text);
  if (!value || hemisphere.size() != 1 ||
      (hemisphere[0] != positive && hemisphere[0] != negative)) {
    return std::nullopt;
  }
  const double degrees = std::floor(*value / 100.0);
  const double minutes = *value - 100.0 * degrees;
  const double angle = degrees + minutes / 60.0;
  if (minutes >= 60.0 || angle > limit) return std::nullopt;
  return hemisphere[0] == positive ? angle : -angle;
}

// Days since 1970-01-01 of a date (H. Hinnant, "chrono-compatible low-level date algorithms").
std::int64_t DaysOfDate(int year, int month, int day) {
  const int y = month <= 2 ? year - 1 : year;
  const int era = y / 400;
  const int yoe = y - era * 400;
  const int doy = (153 * (month > 2 ? month - 3 : month + 9) + 2) / 5 + day - 1;
  const int doe = yoe * 365 + yoe / 4 - yoe / 100 + doy;
  return static_cast<std::int64_t>(era) * 146097 + doe - 719468;
}

}  // namespace

std::optional<GnssFix> ParseRmc(const std::string& sentence) {
  const std::string_view text(sentence);
  const std::size_t star = text.find('*');
  if (text.size() < 10 || text[0] != '$' || star == std::string_view::npos ||
      text.size() < star + 3 || text.substr(3, 4) != "RMC,") {
    return std::nullopt;
  }
  unsigned sum = 0;
  for (const char c : text.substr(1, star - 1)) sum ^= static_cast<unsigned char>(c);
  unsigned stated = 0;
  const char* begin = text.data() + star + 1;
  const auto parsed = std::from_chars(begin, begin + 2, stated, 16);
  if (parsed.ec != std::errc() || parsed.ptr != begin + 2 || stated != sum) return std::nullopt;

  std::vector<std::string_view> fields;
  std::string_view rest = text.substr(7, star - 7);
  for (;;) {
    const std::size_t comma = rest.find(',');
    fields.push_back(rest.substr(0, comma));
    if (comma == std::string_view::npos) break;
    rest.remove_prefix(comma + 1);
  }
  if (fields.size() < 9) return std::nullopt;

  GnssFix fix;
  const std::optional<int> hour = TwoDigits(fields[0], 0);
  const std::optional<int> minute = TwoDigits(fields[0], 2);
  const double second =
      fields[0].size() > 4 ? Decimal(fields[0].substr(4)).value_or(kNoSecond) : kNoSecond;
  const std::optional<int> day = TwoDigits(fields[8], 0);
  const std::optional<int> month = TwoDigits(fields[8], 2);
  const std::optional<int> year = TwoDigits(fields[8], 4);
  if (!hour || !minute || second == kNoSecond || !day || !month || !year || fields[8].size() != 6) {
    return std::nullopt;
  }
  if (*hour > 23 || *minute > 59 || second >= 61.0 || *day < 1 || *day > 31 || *month < 1 ||
      *month > 12) {
    return std::nullopt;
  }
  const std::int64_t days = DaysOfDate(*year < 80 ? 2000 + *year : 1900 + *year, *month, *day);
  fix.utc_ns = (days * 86400 + *hour * 3600 + *minute * 60) * 1000000000LL +
               static_cast<std::int64_t>(std::llround(second * 1e9));
  fix.valid = fields[1] == "A";
  const auto latitude = Angle(fields[2], fields[3], 'N', 'S', 90.0);
  const auto longitude = Angle(fields[4], fields[5], 'E', 'W', 180.0);
  if (latitude && longitude) {
    fix.latitude_deg = *latitude;
    fix.longitude_deg = *longitude;
  } else if (fix.valid) {
    return std::nullopt;
  }
  fix.speed_mps = Decimal(fields[6]).value_or(0.0) * kKnotsToMps;
  fix.course_deg = Decimal(fields[7]).value_or(0.0);
  return fix;
}

std::optional<PositionPacket> ParsePositionPacket(const std::uint8_t* data, std::size_t size) {
  if (data == nullptr || size != vlp16::kPositionPacketBytes) return std::nullopt;
  PositionPacket packet;
  for (std::size_t i = 0; i < 4; ++i) {
    packet.time_of_hour_us |= static_cast<std::uint32_t>(data[kTimeOffset + i]) << (8 * i);
  }
  if (packet.time_of_hour_us >= vlp16::kHourNs / 1000) return std::nullopt;
  packet.pps = data[kPpsOffset] <= 3 ? static_cast<PpsStatus>(data[kPpsOffset]) : PpsStatus::kError;
  const char* text = reinterpret_cast<const char*>(data + kSentenceOffset);
  std::size_t length = 0;
  while (length < kSentenceBytes && text[length] != '\0' && text[length] != '\r' &&
         text[length] != '\n') {
    ++length;
  }
  packet.sentence.assign(text, length);
  packet.fix = ParseRmc(packet.sentence);
  return packet;
}

}  // namespace dendro
