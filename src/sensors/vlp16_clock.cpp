#include "dendro_slam/sensors/vlp16_clock.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

namespace dendro {

namespace {

// A larger difference between prediction and arrival is a step of one of the clocks.
constexpr std::int64_t kStepNs = 1000000000LL;

// Division rounded to nearest, for any sign.
std::int64_t RoundDiv(std::int64_t value, std::int64_t unit) {
  const std::int64_t half = unit / 2;
  const std::int64_t shifted = value + half;
  std::int64_t quotient = shifted / unit;
  if (shifted % unit < 0) --quotient;
  return quotient;
}

}  // namespace

void Vlp16ClockConfig::Validate() const {
  if (clock != "host" && clock != "gps") {
    throw std::invalid_argument("clock must be host or gps, not '" + clock + "'");
  }
  if (!(max_drift_ppm >= 0.0 && max_drift_ppm <= 1e5)) {
    throw std::invalid_argument("max_drift_ppm must be in [0, 1e5]");
  }
}

Vlp16Clock::Vlp16Clock(const Vlp16ClockConfig& config) : config_(config) {
  config_.Validate();
  gps_ = config_.clock == "gps";
}

std::int64_t Vlp16Clock::Nearest(std::uint32_t time_of_hour_us) const {
  const std::int64_t time = static_cast<std::int64_t>(time_of_hour_us) * 1000;
  if (!last_sensor_ns_) return time;
  return time + vlp16::kHourNs * RoundDiv(*last_sensor_ns_ - time, vlp16::kHourNs);
}

std::int64_t Vlp16Clock::Unwrap(std::uint32_t time_of_hour_us) {
  last_sensor_ns_ = Nearest(time_of_hour_us);
  return *last_sensor_ns_;
}

std::int64_t Vlp16Clock::StampNs(std::int64_t sensor_ns,
                                 std::int64_t host_ns,
                                 std::int64_t duration_ns) {
  const std::int64_t candidate = host_ns - duration_ns - sensor_ns;
  if (gps_) {
    if (!offset_ns_) offset_ns_ = vlp16::kHourNs * RoundDiv(candidate, vlp16::kHourNs);
    return sensor_ns + *offset_ns_;
  }
  if (!offset_ns_) {
    offset_ns_ = candidate;
  } else {
    const double elapsed = static_cast<double>(std::max<std::int64_t>(0, host_ns - offset_host_ns_));
    const std::int64_t grown =
        *offset_ns_ + static_cast<std::int64_t>(elapsed * config_.max_drift_ppm * 1e-6);
    offset_ns_ = candidate - grown > kStepNs ? candidate : std::min(candidate, grown);
  }
  offset_host_ns_ = host_ns;
  return sensor_ns + *offset_ns_;
}

std::int64_t Vlp16Clock::OnPosition(const PositionPacket& packet, std::int64_t host_ns) {
  const std::int64_t sensor_ns = Nearest(packet.time_of_hour_us);
  if (gps_ && packet.pps == PpsStatus::kLocked && packet.fix && packet.fix->valid) {
    offset_ns_ = vlp16::kHourNs * RoundDiv(packet.fix->utc_ns - sensor_ns, vlp16::kHourNs);
    gps_locked_ = true;
    // Without data packets so far, the first of them must find this hour.
    if (!last_sensor_ns_) last_sensor_ns_ = sensor_ns;
  }
  if (offset_ns_ && (gps_ || last_sensor_ns_)) return sensor_ns + *offset_ns_;
  return host_ns;
}

void Vlp16Clock::Reset() {
  last_sensor_ns_.reset();
  offset_ns_.reset();
  offset_host_ns_ = 0;
  gps_locked_ = false;
}

}  // namespace dendro
