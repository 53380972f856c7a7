#pragma once

#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <mutex>
#include <string>
#include <vector>

#include <boost/shared_ptr.hpp>
#include <ros/node_handle.h>
#include <ros/single_subscriber_publisher.h>

namespace dendro_ros {

/// Whom a publisher waits for.
struct HoldingConfig {
  std::vector<std::string> readers;  ///< Names of nodes that must not miss a message.
  double hold_s = 10.0;              ///< It waits for each of them at most this long [s]. >= 0.
  double settle_s = 1.0;             ///< After a reader has come back: the nodelets in it may not
                                     ///< all be there yet [s]. >= 0.
  std::string acknowledger = "";     ///< The reader among them that says what it is done with.
  double keep_s = 30.0;              ///< What it is not done with is kept at most this long [s].
};

/// A publisher that holds its messages back while a reader that matters is away, so that a reader
/// which died and was started again misses nothing. All readers get everything, in order, then late.
///
/// ROS drops what is published while a subscriber is not connected. Here a named reader that has gone
/// (or has not come yet) stops the line for `hold_s` at most; other subscribers come and go freely.
/// What a process had taken but not worked off dies with it: the reader that acknowledges is sent
/// that again, alone, before anything new.
///
/// Thread-safe; callbacks of connections come through the node handle's queue, and one of them may
/// wait for `settle_s`, so the queue needs two threads or more.
class HoldingPublisher {
 public:
  /// @param options  Topic, queue and type; the status callbacks are set here.
  HoldingPublisher(ros::NodeHandle nh, ros::AdvertiseOptions options, HoldingConfig config);
  ~HoldingPublisher();
  HoldingPublisher(const HoldingPublisher&) = delete;
  HoldingPublisher& operator=(const HoldingPublisher&) = delete;

  template <class M>
  static ros::AdvertiseOptions Options(const std::string& topic, std::uint32_t queue_size) {
    ros::AdvertiseOptions options;
    options.init<M>(topic, queue_size);
    return options;
  }

  /// Publishes, or holds back.
  /// @param until_ns  The reader is done with the message when it has acknowledged this stamp.
  /// @param done      Called when the message has been handed to ROS; may be empty.
  template <class M>
  void Publish(const boost::shared_ptr<const M>& message,
               std::int64_t until_ns,
               std::function<void()> done = {}) {
    Message out;
    out.until_ns = until_ns;
    out.send = [this, message, done = std::move(done)] {
      publisher_.publish(message);
      if (done) done();
    };
    if (!config_.acknowledger.empty()) {
      out.send_again = [message](const ros::SingleSubscriberPublisher& link) {
        link.publish(*message);
      };
    }
    Push(std::move(out));
  }

  /// A reader is gone on purpose: it is not waited for until it comes again.
  void Release(const std::string& reader);
  /// The acknowledging reader is done with everything up to this stamp.
  void Acknowledge(std::int64_t stamp_ns);

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
    int comings = 0;
    bool released = false;
    bool catching_up = false;  ///< It is to be sent what it had not worked off.
  };
  struct Message {
    std::int64_t until_ns = 0;
    Clock::time_point sent;
    std::function<void()> send;
    std::function<void(const ros::SingleSubscriberPublisher&)> send_again;
  };

  void Push(Message message);
  void OnConnect(const ros::SingleSubscriberPublisher& link);
  void OnDisconnect(const std::string& reader);
  bool Waiting() const;
  void Flush();

  HoldingConfig config_;
  mutable std::mutex mutex_;
  std::map<std::string, Reader> readers_;
  std::deque<Message> line_;  ///< Not sent yet.
  std::deque<Message> kept_;  ///< Sent, not acknowledged.
  bool ending_ = false;
  std::condition_variable wake_;
  ros::Publisher publisher_;  // Last: its callbacks use everything above.
};

}  // namespace dendro_ros
