#include "dendro_slam/ros/latency_collector.h"

#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/sensors/lidar_scan.h"

namespace dendro_ros {

void LatencyCollector::Add(const dendro_slam::StageLatency& latency) {
  constexpr std::size_t kMaxScansInWork = 1000;
  const std::lock_guard<std::mutex> lock(mutex_);
  const double ms = 1e3 * latency.latency;
  const std::int64_t stamp_ns = ToNs(latency.header.stamp);
  timer_.Add(latency.stage, ms);
  dropped_[latency.stage] = latency.dropped;
  total_ms_[stamp_ns] += ms;
  if (latency.stage == last_stage_) {
    timer_.Add("total", total_ms_[stamp_ns]);
    total_ms_.erase(total_ms_.begin(), total_ms_.upper_bound(stamp_ns));
    if (first_ns_ < 0) first_ns_ = stamp_ns;
    last_ns_ = stamp_ns;
    timer_.set_data_duration_s(dendro::NsToSeconds(last_ns_ - first_ns_));
  }
  while (total_ms_.size() > kMaxScansInWork) total_ms_.erase(total_ms_.begin());
}

std::uint64_t LatencyCollector::dropped() const {
  const std::lock_guard<std::mutex> lock(mutex_);
  std::uint64_t total = 0;
  for (const auto& entry : dropped_) total += entry.second;
  return total;
}

dendro::StageTimer LatencyCollector::Timer() const {
  const std::lock_guard<std::mutex> lock(mutex_);
  return timer_;
}

void LatencyCollector::Reset() {
  const std::lock_guard<std::mutex> lock(mutex_);
  timer_ = dendro::StageTimer();
  total_ms_.clear();
  dropped_.clear();
  first_ns_ = last_ns_ = -1;
}

}  // namespace dendro_ros
