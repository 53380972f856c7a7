#pragma once

#include <chrono>
#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <mutex>
#include <string>
#include <vector>

#include <boost/shared_ptr.hpp>
#include <ros/node_handle.h>

namespace dendro_ros {

/// Whom a publisher waits for.
struct HoldingConfig {
  std::vector<std::string> readers;  ///< Names of nodes that must not miss a message.
  double hold_s = 10.0;              ///< It waits for each of them at most this long [s]. >= 0.
  double settle_s = 1.0;             ///< After a reader has come back: the nodelets in it may not
                                     ///< all be there yet [s]. >= 0.
};

/// A publisher that holds its messages back while a reader that matters is away, so that a reader
/// which died and was started again misses nothing. All readers get everything, in order, then late.
///
/// ROS drops what is published while a subscriber is not connected. Here a named reader that has gone
/// (or has not come yet) stops the line for `hold_s` at most; other subscribers come and go freely.
/// Thread-safe; callbacks of connections come through the node handle's queue.
class HoldingPublisher {
 public:
  /// @param options  Topic, queue and type; the status callbacks are set here.
  HoldingPublisher(ros::NodeHandle nh, ros::AdvertiseOptions options, HoldingConfig config);
  HoldingPublisher(const HoldingPublisher&) = delete;
  HoldingPublisher& operator=(const HoldingPublisher&) = delete;

  template <class M>
  static ros::AdvertiseOptions Options(const std::string& topic, std::uint32_t queue_size) {
    ros::AdvertiseOptions options;
    options.init<M>(topic, queue_size);
    return options;
  }

  /// Publishes, or holds back.
  /// @param done  Called when the message has been handed to ROS; may be empty.
  template <class M>
  void Publish(const boost::shared_ptr<const M>& message, std::function<void()> done = {}) {
    Push([this, message, done = std::move(done)] {
      publisher_.publish(message);
      if (done) done();
    });
  }

  /// Sends what may go; to be called every few milliseconds.
  void Tick();

  std::size_t held() const;
  /// The readers that are waited for now, for a message to the user; empty when none are.
  std::vector<std::string> MissingReaders() const;

 private:
  using Clock = std::chrono::steady_clock;
  struct Reader {
    bool connected = false;
    bool seen = false;  ///< It was connected once; when it comes again, it was started anew.
    Clock::time_point since = Clock::now();  ///< When it went or came.
    double settle_s = 0.0;
  };

  void Push(std::function<void()> send);
  void Changed(const std::string& reader, bool connected);
  bool Waiting() const;
  void Flush();

  HoldingConfig config_;
  mutable std::mutex mutex_;
  std::map<std::string, Reader> readers_;
  std::deque<std::function<void()>> line_;
  ros::Publisher publisher_;  // Last: its callbacks use everything above.
};

}  // namespace dendro_ros
