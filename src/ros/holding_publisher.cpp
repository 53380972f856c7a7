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
  options.connect_cb = [this](const ros::SingleSubscriberPublisher& link) { OnConnect(link); };
  options.disconnect_cb = [this](const ros::SingleSubscriberPublisher& link) {
    OnDisconnect(link.getSubscriberName());
  };
  publisher_ = nh.advertise(options);
}

HoldingPublisher::~HoldingPublisher() {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    ending_ = true;
  }
  wake_.notify_all();
  publisher_.shutdown();  // Waits for callbacks at work.
}

void HoldingPublisher::OnConnect(const ros::SingleSubscriberPublisher& link) {
  std::unique_lock<std::mutex> lock(mutex_);
  const auto it = readers_.find(link.getSubscriberName());
  if (it == readers_.end()) return;
  Reader& reader = it->second;
  reader.connected = true;
  reader.released = false;
  reader.since = Clock::now();
  reader.settle_s = reader.seen ? config_.settle_s : kFirstSettle_s;
  reader.seen = true;
  const int coming = ++reader.comings;
  if (it->first != config_.acknowledger || kept_.empty()) return;
  reader.catching_up = true;
  const auto settled = reader.since + std::chrono::duration_cast<Clock::duration>(
                                          std::chrono::duration<double>(reader.settle_s));
  wake_.wait_until(lock, settled, [this] { return ending_; });
  // The link is good for this callback only.
  if (ending_ || reader.comings != coming || !reader.connected) return;
  for (const Message& message : kept_) message.send_again(link);
  reader.catching_up = false;
  Flush();
}

void HoldingPublisher::OnDisconnect(const std::string& name) {
  const std::lock_guard<std::mutex> lock(mutex_);
  const auto it = readers_.find(name);
  if (it == readers_.end()) return;
  it->second.connected = false;
  it->second.catching_up = false;
  it->second.since = Clock::now();
}

void HoldingPublisher::Release(const std::string& reader) {
  const std::lock_guard<std::mutex> lock(mutex_);
  const auto it = readers_.find(reader);
  if (it != readers_.end()) it->second.released = true;
}

void HoldingPublisher::Acknowledge(std::int64_t stamp_ns) {
  const std::lock_guard<std::mutex> lock(mutex_);
  while (!kept_.empty() && kept_.front().until_ns <= stamp_ns) kept_.pop_front();
}

bool HoldingPublisher::Waiting() const {
  const Clock::time_point now = Clock::now();
  for (const auto& entry : readers_) {
    const Reader& reader = entry.second;
    const double passed_s = std::chrono::duration<double>(now - reader.since).count();
    if (reader.released) continue;
    if (reader.catching_up) return true;
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

void HoldingPublisher::Push(Message message) {
  const std::lock_guard<std::mutex> lock(mutex_);
  line_.push_back(std::move(message));
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
  const Clock::time_point now = Clock::now();
  const auto keep = std::chrono::duration<double>(config_.keep_s);
  while (!kept_.empty() && now - kept_.front().sent > keep) kept_.pop_front();
  while (!line_.empty()) {
    Message message = std::move(line_.front());
    line_.pop_front();
    message.send();
    if (!message.send_again) continue;
    message.send = nullptr;
    message.sent = now;
    kept_.push_back(std::move(message));
  }
}

}  // namespace dendro_ros
