#pragma once

#include <cstdint>
#include <map>
#include <mutex>
#include <string>

#include "dendro_slam/StageLatency.h"
#include "dendro_slam/io/stage_timer.h"

namespace dendro_ros {

/// Gathers the latencies of all stages for timing.json. Thread-safe.
class LatencyCollector {
 public:
  /// @param last_stage  The stage that ends the work on a scan: with its message the scan's total is
  ///                    known.
  explicit LatencyCollector(std::string last_stage) : last_stage_(std::move(last_stage)) {}

  void Add(const dendro_slam::StageLatency& latency);
  /// Scans lost by all stages since they started.
  std::uint64_t dropped() const;
  dendro::StageTimer Timer() const;
  void Reset();

 private:
  const std::string last_stage_;
  mutable std::mutex mutex_;
  dendro::StageTimer timer_;
  std::map<std::int64_t, double> total_ms_;  ///< By stamp, of scans still in work.
  std::map<std::string, std::uint64_t> dropped_;
  std::int64_t first_ns_ = -1;
  std::int64_t last_ns_ = -1;
};

}  // namespace dendro_ros
