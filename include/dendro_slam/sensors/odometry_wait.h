#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <optional>
#include <utility>

namespace dendro {

/// Holds items (scans) until the odometry covers them, in order.
///
/// An item is ready when the newest odometry is not older than the item needs. When the odometry has
/// been silent for longer than a time-out, counted in the time of the data, items are ready without
/// it: a lost or absent odometry delays but never stops the pipeline. No clock is read, so a replay
/// gives the same result at any speed.
template <class Item>
class OdometryWait {
 public:
  /// @param timeout_s  Silence after which items no longer wait [s].
  /// @param capacity   Items held at most; the oldest is dropped beyond it.
  OdometryWait(double timeout_s, std::size_t capacity)
      : timeout_ns_(static_cast<std::int64_t>(timeout_s * 1e9)), capacity_(capacity) {}

  /// Adds an item.
  /// @param stamp_ns  Its stamp: tells how far the data has come [ns].
  /// @param need_ns   It is ready once the odometry has reached this [ns].
  /// @return  Items dropped to make room.
  std::size_t Push(std::int64_t stamp_ns, std::int64_t need_ns, Item item) {
    if (!newest_data_ns_ || stamp_ns > *newest_data_ns_) newest_data_ns_ = stamp_ns;
    if (!silent_since_ns_) silent_since_ns_ = stamp_ns;
    waiting_.push_back({need_ns, std::move(item)});
    std::size_t dropped = 0;
    while (waiting_.size() > capacity_) {
      waiting_.pop_front();
      ++dropped;
    }
    return dropped;
  }

  /// Tells the stamp of the newest usable odometry [ns].
  void SetOdometry(std::int64_t newest_ns) {
    odometry_ns_ = newest_ns;
    silent_since_ns_ = newest_ns;
  }

  /// The oldest item, if it is ready.
  std::optional<Item> Pop() {
    if (waiting_.empty()) return std::nullopt;
    const bool covered = odometry_ns_ && waiting_.front().need_ns <= *odometry_ns_;
    if (!covered && *newest_data_ns_ - *silent_since_ns_ <= timeout_ns_) return std::nullopt;
    std::optional<Item> item(std::in_place, std::move(waiting_.front().item));
    waiting_.pop_front();
    return item;
  }

  std::size_t size() const { return waiting_.size(); }

  void Clear() {
    waiting_.clear();
    odometry_ns_.reset();
    silent_since_ns_.reset();
    newest_data_ns_.reset();
  }

 private:
  struct Waiting {
    std::int64_t need_ns;
    Item item;
  };

  std::int64_t timeout_ns_;
  std::size_t capacity_;
  std::deque<Waiting> waiting_;
  std::optional<std::int64_t> odometry_ns_;
  std::optional<std::int64_t> silent_since_ns_;  ///< Newest odometry, else the first item.
  std::optional<std::int64_t> newest_data_ns_;
};

}  // namespace dendro
