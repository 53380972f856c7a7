#pragma once

#include <map>
#include <string>
#include <vector>

namespace dendro {

/// Durations of the pipeline's stages. Holds one number per stage and scan; not thread-safe.
class StageTimer {
 public:
  struct Summary {
    int count = 0;
    double p50_ms = 0.0;  ///< Nearest-rank percentiles [ms].
    double p99_ms = 0.0;
    double max_ms = 0.0;
    double total_ms = 0.0;
  };

  /// @param stage        Name as in timing.json, e.g. "segmentation".
  /// @param duration_ms  Time spent [ms], >= 0.
  void Add(const std::string& stage, double duration_ms);

  /// Durations of a stage so far [ms], in the order they came; empty for a stage that is not known.
  const std::vector<double>& Durations(const std::string& stage) const;

  /// Seconds of data that the durations belong to, for the real-time factor.
  void set_data_duration_s(double seconds) { data_duration_s_ = seconds; }
  double data_duration_s() const { return data_duration_s_; }
  /// Wall-clock seconds of the whole run, 0 if not set.
  void set_wall_duration_s(double seconds) { wall_duration_s_ = seconds; }
  double wall_duration_s() const { return wall_duration_s_; }

  /// Summary by stage, sorted by name.
  std::map<std::string, Summary> Summaries() const;

 private:
  std::map<std::string, std::vector<double>> durations_ms_;
  double data_duration_s_ = 0.0;
  double wall_duration_s_ = 0.0;
};

}  // namespace dendro
