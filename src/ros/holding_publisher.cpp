#include "dendro_slam/ros/holding_publisher.h"

#include <utility>

#include <ros/publisher.h>
#include <ros/single_subscriber_publisher.h>

namespace dendro_ros {

namespace {

// A reader that this publisher sees for the first time has usually been there for longer.
constexpr double kFirstSettle_s = 0.1;

}  // namespace

HoldingPublisher::HoldingPublisher(ros::NodeHandle nh,
                                   ros::AdvertiseOptions options,
                                   HoldingConfig config)
    : config_(std::move(config)) {
  for (const std::string& reader : config_.readers) readers_[reader] = Reader();
  options.connect_cb = [this](const ros::SingleSubscriberPublisher& link) {
    Changed(link.getSubscriberName(), true);
  };
  options.disconnect_cb = [this](const ros::SingleSubscriberPublisher& link) {
    Changed(link.getSubscriberName(), false);
  };
  publisher_ = nh.advertise(options);
}

void HoldingPublisher::Changed(const std::string& reader, bool connected) {
  const std::lock_guard<std::mutex> lock(mutex_);
  const auto it = readers_.find(reader);
  if (it == readers_.end()) return;
  it->second.connected = connected;
  it->second.since = Clock::now();
  if (connected) {
    it->second.settle_s = it->second.seen ? config_.settle_s : kFirstSettle_s;
    it->second.seen = true;
  }
}

bool HoldingPublisher::Waiting() const {
  const Clock::time_point now = Clock::now();
  for (const auto& entry : readers_) {
    const Reader& reader = entry.second;
    const double passed_s = std::chrono::duration<double>(now - reader.since).count();
    if (passed_s < (reader.connected ? reader.settle_s : config_.hold_s)) return true;
  }
  return false;
}

std::vector<std::string> HoldingPublisher::MissingReaders() const {
  const std::lock_guard<std::mutex> lock(mutex_);
  std::vector<std::string> missing;
  for (const auto& entry : readers_) {
    if (!entry.second.connected) missing.push_back(entry.first);
  }
  return missing;
}

void HoldingPublisher::Push(std::function<void()> send) {
  const std::lock_guard<std::mutex> lock(mutex_);
  line_.push_back(std::move(send));
  if (!Waiting()) Flush();
}

void HoldingPublisher::Tick() {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (!line_.empty() && !Waiting()) Flush();
}

std::size_t HoldingPublisher::held() const {
  const std::lock_guard<std::mutex> lock(mutex_);
  return line_.size();
}

void HoldingPublisher::Flush() {
  while (!line_.empty()) {
    line_.front()();
    line_.pop_front();
  }
}

}  // namespace dendro_ros
