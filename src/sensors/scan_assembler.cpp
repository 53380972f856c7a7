#include "dendro_slam/sensors/scan_assembler.h"

#include <cmath>
#include <stdexcept>
#include <utility>

namespace dendro {

void ScanAssemblerConfig::Validate() const {
  if (!(cut_azimuth_deg >= 0.0 && cut_azimuth_deg < 360.0)) {
    throw std::invalid_argument("cut_azimuth_deg must be in [0, 360)");
  }
  if (returns != "all" && returns != "strongest" && returns != "last") {
    throw std::invalid_argument("returns must be all, strongest or last, not '" + returns + "'");
  }
  if (!(min_range_m >= 0.0)) throw std::invalid_argument("min_range_m must be at least 0");
  if (!(max_range_m > min_range_m) || !std::isfinite(max_range_m)) {
    throw std::invalid_argument("max_range_m must be finite and above min_range_m");
  }
  if (!(max_silence_s > 0.0 && max_silence_s < 1e3)) {
    throw std::invalid_argument("max_silence_s must be in (0, 1000)");
  }
}

ScanAssembler::ScanAssembler(const ScanAssemblerConfig& config) : config_(config) {
  config_.Validate();
}

std::optional<LidarScan> ScanAssembler::Flush() {
  if (!has_firing_) return std::nullopt;
  has_firing_ = false;
  if (config_.stamp_at_end) {
    const std::int64_t duration_ns = last_sensor_ns_ - first_sensor_ns_;
    scan_.stamp_ns += duration_ns;
    const double duration_s = NsToSeconds(duration_ns);
    for (LidarPoint& point : scan_.points) {
      point.time_s = static_cast<float>(static_cast<double>(point.time_s) - duration_s);
    }
  }
  const std::size_t size = scan_.points.size();
  LidarScan done = std::exchange(scan_, LidarScan());
  scan_.points.reserve(size + size / 16);
  return done;
}

void ScanAssembler::AddReturn(int laser, const RawReturn& value, const Vlp16Firing& firing) {
  if (!(value.range_m > 0.0F) || value.range_m < config_.min_range_m ||
      value.range_m > config_.max_range_m) {
    return;
  }
  const double delay_s = vlp16::LaserTimeS(laser);
  const double azimuth_deg = firing.raw.azimuth_deg + firing.rate_deg_per_s * delay_s;
  LidarPoint point;
  point.position =
      vlp16::PointAt(laser, azimuth_deg, static_cast<double>(value.range_m)).cast<float>();
  point.intensity = value.reflectivity;
  point.time_s =
      static_cast<float>(NsToSeconds(firing.sensor_ns - first_sensor_ns_) + delay_s);
  point.ring = static_cast<std::uint16_t>(vlp16::RingOfLaser(laser));
  scan_.points.push_back(point);
}

std::optional<LidarScan> ScanAssembler::Add(const Vlp16Firing& firing) {
  std::optional<LidarScan> done;
  const double azimuth = vlp16::WrapAzimuthDeg(firing.raw.azimuth_deg - config_.cut_azimuth_deg);
  if (has_firing_) {
    const double silence_s = NsToSeconds(firing.sensor_ns - last_sensor_ns_);
    // The azimuth from the cut only grows; a drop of a few hundredths is rounding, not a revolution.
    const bool cut = firing.starts_block && azimuth < last_azimuth_deg_ - 1.0;
    if (cut || silence_s > config_.max_silence_s || silence_s < 0.0) done = Flush();
  }
  if (!has_firing_) {
    has_firing_ = true;
    first_sensor_ns_ = firing.sensor_ns;
    scan_.stamp_ns = firing.raw.stamp_ns;
  }
  last_sensor_ns_ = firing.sensor_ns;
  if (firing.starts_block) last_azimuth_deg_ = azimuth;

  const bool strongest = firing.mode != ReturnMode::kLast &&
                         !(firing.mode == ReturnMode::kDual && config_.returns == "last");
  const bool last = firing.mode != ReturnMode::kStrongest &&
                    !(firing.mode == ReturnMode::kDual && config_.returns == "strongest");
  for (int laser = 0; laser < vlp16::kLasers; ++laser) {
    const RawReturn& a = firing.raw.strongest[static_cast<std::size_t>(laser)];
    const RawReturn& b = firing.raw.last[static_cast<std::size_t>(laser)];
    if (strongest) AddReturn(laser, a, firing);
    // A laser with a single return sends it twice.
    const bool same = strongest && a.range_m == b.range_m && a.reflectivity == b.reflectivity;
    if (last && !same) AddReturn(laser, b, firing);
  }
  return done;
}

}  // namespace dendro
