#pragma once

#include <chrono>
#include <cstdint>
#include <deque>
#include <map>
#include <mutex>
#include <string>

#include <diagnostic_msgs/DiagnosticArray.h>
#include <ros/node_handle.h>

namespace dendro_ros {

/// What a stage tells about itself: once a second on /diagnostics its latency, drops and counts, and
/// per scan its latency on `stage_latency`. Thread-safe.
class StageDiagnostics {
 public:
  /// @param nh     The nodelet's public node handle.
  /// @param name   Name of the status, e.g. the nodelet's name.
  /// @param stage  Name of the stage in timing.json; empty: no latency is published.
  StageDiagnostics(ros::NodeHandle nh, std::string name, std::string stage);

  /// A scan is done.
  void Processed(std::int64_t stamp_ns, double latency_s);
  /// Scans were lost. @param why  Short, e.g. "queue full".
  void Dropped(const std::string& why, std::size_t count = 1);
  /// A number to show, e.g. ("segments", 4).
  void Show(const std::string& key, double value);
  /// Something is wrong until the next scan is done.
  void Problem(const std::string& line);

  std::uint64_t processed() const;
  std::uint64_t dropped() const;
  /// Counts start anew (the pipeline was reset).
  void ResetCounts();

  /// The status as it is published.
  diagnostic_msgs::DiagnosticStatus Status() const;

 private:
  void Publish();

  const std::string name_;
  const std::string stage_;
  ros::Publisher diagnostics_;
  ros::Publisher latency_;
  mutable std::mutex mutex_;
  std::deque<double> latencies_s_;
  std::uint64_t processed_ = 0;
  std::map<std::string, std::uint64_t> dropped_;
  std::map<std::string, double> shown_;
  std::string problem_;
  ros::WallTimer timer_;  // Last: it calls back into the members above.
};

/// Seconds since its construction.
class Stopwatch {
 public:
  double Seconds() const {
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count();
  }

 private:
  std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
};

}  // namespace dendro_ros
