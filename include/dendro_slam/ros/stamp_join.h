#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <optional>
#include <utility>

namespace dendro_ros {

/// Joins two streams of one scan's results by their exact stamp, in order.
///
/// Both streams ascend in time, so a later message of one says that it will not bring an earlier one
/// any more. A stamp that goes back by more than a second starts the stream anew.
template <class First, class Second>
class StampJoin {
 public:
  enum class Missing {
    kDrop,    ///< A pair without its second half is dropped.
    kAccept,  ///< It is given without it.
  };
  struct Joined {
    std::int64_t stamp_ns;
    First first;
    std::optional<Second> second;
  };

  StampJoin(std::size_t capacity, Missing missing) : capacity_(capacity), missing_(missing) {}

  void AddFirst(std::int64_t stamp_ns, First first) {
    NoticeJump(stamp_ns);
    first_[stamp_ns] = std::move(first);
    if (first_.size() > capacity_) {
      first_.erase(first_.begin());
      ++dropped_;
    }
  }

  void AddSecond(std::int64_t stamp_ns, Second second) {
    NoticeJump(stamp_ns);
    newest_second_ns_ = stamp_ns;
    second_[stamp_ns] = std::move(second);
    if (second_.size() > capacity_) second_.erase(second_.begin());
  }

  /// The next pair that is complete, or known to stay incomplete.
  std::optional<Joined> Pop() {
    while (!first_.empty()) {
      auto it = first_.begin();
      const std::int64_t stamp_ns = it->first;
      const auto partner = second_.find(stamp_ns);
      const bool complete = partner != second_.end();
      if (!complete && !(newest_second_ns_ && *newest_second_ns_ > stamp_ns)) return std::nullopt;
      if (!complete && missing_ == Missing::kDrop) {
        first_.erase(it);
        ++dropped_;
        continue;
      }
      Joined joined{stamp_ns, std::move(it->second), std::nullopt};
      if (complete) joined.second = std::move(partner->second);
      first_.erase(it);
      second_.erase(second_.begin(), second_.upper_bound(stamp_ns));
      return joined;
    }
    return std::nullopt;
  }

  /// Pairs dropped since the last call.
  std::size_t TakeDropped() { return std::exchange(dropped_, 0); }

 private:
  void NoticeJump(std::int64_t stamp_ns) {
    constexpr std::int64_t kJumpNs = 1000000000;
    if (newest_ns_ && stamp_ns < *newest_ns_ - kJumpNs) {
      first_.clear();
      second_.clear();
      newest_second_ns_.reset();
      newest_ns_ = stamp_ns;
    }
    if (!newest_ns_ || stamp_ns > *newest_ns_) newest_ns_ = stamp_ns;
  }

  std::size_t capacity_;
  Missing missing_;
  std::map<std::int64_t, First> first_;
  std::map<std::int64_t, Second> second_;
  std::optional<std::int64_t> newest_second_ns_;
  std::optional<std::int64_t> newest_ns_;
  std::size_t dropped_ = 0;
};

}  // namespace dendro_ros
