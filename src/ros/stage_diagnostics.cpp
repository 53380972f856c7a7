#include "dendro_slam/ros/stage_diagnostics.h"

#include <fmt/format.h>

#include <algorithm>
#include <utility>
#include <vector>

#include "dendro_slam/StageLatency.h"
#include "dendro_slam/ros/conversions.h"

namespace dendro_ros {
namespace {

constexpr std::size_t kWindow = 100;  ///< Scans that the percentiles are taken over.

double Percentile(std::vector<double> values, double fraction) {
  if (values.empty()) return 0.0;
  const auto at = static_cast<std::size_t>(fraction * static_cast<double>(values.size() - 1));
  std::nth_element(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(at), values.end());
  return values[at];
}

}  // namespace

StageDiagnostics::StageDiagnostics(ros::NodeHandle nh, std::string name, std::string stage)
    : name_(std::move(name)), stage_(std::move(stage)) {
  diagnostics_ = nh.advertise<diagnostic_msgs::DiagnosticArray>("/diagnostics", 10);
  if (!stage_.empty()) latency_ = nh.advertise<dendro_slam::StageLatency>("stage_latency", 100);
  timer_ = nh.createWallTimer(ros::WallDuration(1.0), [this](const ros::WallTimerEvent&) { Publish(); });
}

void StageDiagnostics::Processed(std::int64_t stamp_ns, double latency_s) {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    ++processed_;
    latencies_s_.push_back(latency_s);
    if (latencies_s_.size() > kWindow) latencies_s_.pop_front();
    problem_.clear();
  }
  if (stage_.empty()) return;
  dendro_slam::StageLatency msg;
  msg.header.stamp = ToRosTime(stamp_ns);
  msg.stage = stage_;
  msg.latency = latency_s;
  msg.dropped = dropped();
  latency_.publish(msg);
}

void StageDiagnostics::Dropped(const std::string& why, std::size_t count) {
  if (count == 0) return;
  const std::lock_guard<std::mutex> lock(mutex_);
  dropped_[why] += count;
}

void StageDiagnostics::Show(const std::string& key, double value) {
  const std::lock_guard<std::mutex> lock(mutex_);
  shown_[key] = value;
}

void StageDiagnostics::Problem(const std::string& line) {
  const std::lock_guard<std::mutex> lock(mutex_);
  problem_ = line;
}

std::uint64_t StageDiagnostics::processed() const {
  const std::lock_guard<std::mutex> lock(mutex_);
  return processed_;
}

std::uint64_t StageDiagnostics::dropped() const {
  const std::lock_guard<std::mutex> lock(mutex_);
  std::uint64_t total = 0;
  for (const auto& entry : dropped_) total += entry.second;
  return total;
}

void StageDiagnostics::ResetCounts() {
  const std::lock_guard<std::mutex> lock(mutex_);
  processed_ = 0;
  dropped_.clear();
}

diagnostic_msgs::DiagnosticStatus StageDiagnostics::Status() const {
  const std::lock_guard<std::mutex> lock(mutex_);
  diagnostic_msgs::DiagnosticStatus status;
  status.name = name_;
  status.hardware_id = "dendro_slam";
  const auto add = [&status](const std::string& key, const std::string& value) {
    diagnostic_msgs::KeyValue pair;
    pair.key = key;
    pair.value = value;
    status.values.push_back(pair);
  };
  const std::vector<double> window(latencies_s_.begin(), latencies_s_.end());
  add("scans processed", std::to_string(processed_));
  add("latency p50 [ms]", fmt::format("{:.2f}", 1e3 * Percentile(window, 0.5)));
  add("latency p99 [ms]", fmt::format("{:.2f}", 1e3 * Percentile(window, 0.99)));
  std::uint64_t dropped = 0;
  for (const auto& entry : dropped_) {
    add("dropped, " + entry.first, std::to_string(entry.second));
    dropped += entry.second;
  }
  for (const auto& entry : shown_) add(entry.first, fmt::format("{:.6g}", entry.second));
  status.level = diagnostic_msgs::DiagnosticStatus::OK;
  status.message = processed_ == 0 ? "no scan yet" : "running";
  if (dropped > 0) {
    status.level = diagnostic_msgs::DiagnosticStatus::WARN;
    status.message = fmt::format("{} scans dropped", dropped);
  }
  if (!problem_.empty()) {
    status.level = diagnostic_msgs::DiagnosticStatus::ERROR;
    status.message = problem_;
  }
  return status;
}

void StageDiagnostics::Publish() {
  if (diagnostics_.getNumSubscribers() == 0) return;
  diagnostic_msgs::DiagnosticArray array;
  array.header.stamp = ros::Time::now();
  array.status.push_back(Status());
  diagnostics_.publish(array);
}

}  // namespace dendro_ros
