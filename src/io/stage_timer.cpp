#include "dendro_slam/io/stage_timer.h"

#include <algorithm>
#include <cmath>

namespace dendro {

namespace {

// Nearest-rank percentile of a sorted sample.
double Percentile(const std::vector<double>& sorted, double fraction) {
  const double rank = std::ceil(fraction * static_cast<double>(sorted.size()));
  const auto index = static_cast<std::size_t>(std::max(rank, 1.0)) - 1;
  return sorted[std::min(index, sorted.size() - 1)];
}

}  // namespace

void StageTimer::Add(const std::string& stage, double duration_ms) {
  durations_ms_[stage].push_back(duration_ms);
}

const std::vector<double>& StageTimer::Durations(const std::string& stage) const {
  static const std::vector<double> none;
  const auto it = durations_ms_.find(stage);
  return it == durations_ms_.end() ? none : it->second;
}

std::map<std::string, StageTimer::Summary> StageTimer::Summaries() const {
  std::map<std::string, Summary> summaries;
  for (const auto& [stage, durations] : durations_ms_) {
    std::vector<double> sorted = durations;
    std::sort(sorted.begin(), sorted.end());
    Summary& summary = summaries[stage];
    summary.count = static_cast<int>(sorted.size());
    summary.p50_ms = Percentile(sorted, 0.50);
    summary.p99_ms = Percentile(sorted, 0.99);
    summary.max_ms = sorted.back();
    for (const double duration : sorted) summary.total_ms += duration;
  }
  return summaries;
}

}  // namespace dendro
