#pragma once

#include <condition_variable>
#include <cstddef>
#include <deque>
#include <functional>
#include <mutex>
#include <thread>
#include <utility>

namespace dendro_ros {

/// One thread that works off a bounded queue in order.
///
/// Callbacks of a nodelet only push, so that what is dropped is counted here and not lost silently in
/// a subscriber's queue. The oldest bulky item (a scan) makes room for a new one; small items (poses)
/// have a bound of their own. Destruction finishes the item in work, drops the rest and joins.
template <class Item>
class Worker {
 public:
  /// @param capacity  Bulky items held at most. >= 1.
  /// @param process   Called in the worker's thread for each item; must not throw.
  Worker(std::size_t capacity, std::function<void(Item&)> process)
      : capacity_(capacity), process_(std::move(process)), thread_([this] { Run(); }) {}

  ~Worker() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      stopping_ = true;
    }
    wake_.notify_all();
    thread_.join();
  }
  Worker(const Worker&) = delete;
  Worker& operator=(const Worker&) = delete;

  /// Adds an item.
  /// @param bulky  It counts against the capacity.
  /// @return  Bulky items dropped to make room.
  std::size_t Push(Item item, bool bulky) {
    std::size_t dropped = 0;
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      queue_.push_back({std::move(item), bulky});
      (bulky ? bulky_ : small_) += 1;
      while (bulky_ > capacity_) {
        DropOldest(true);
        ++dropped;
      }
      if (small_ > kSmallCapacity) DropOldest(false);
    }
    wake_.notify_one();
    return dropped;
  }

 private:
  struct Entry {
    Item item;
    bool bulky;
  };
  static constexpr std::size_t kSmallCapacity = 20000;

  void DropOldest(bool bulky) {
    for (auto it = queue_.begin(); it != queue_.end(); ++it) {
      if (it->bulky != bulky) continue;
      queue_.erase(it);
      (bulky ? bulky_ : small_) -= 1;
      return;
    }
  }

  void Run() {
    std::unique_lock<std::mutex> lock(mutex_);
    while (true) {
      wake_.wait(lock, [this] { return stopping_ || !queue_.empty(); });
      if (stopping_) return;
      Entry entry = std::move(queue_.front());
      queue_.pop_front();
      (entry.bulky ? bulky_ : small_) -= 1;
      lock.unlock();
      process_(entry.item);
      lock.lock();
    }
  }

  const std::size_t capacity_;
  std::function<void(Item&)> process_;
  std::mutex mutex_;
  std::condition_variable wake_;
  std::deque<Entry> queue_;
  std::size_t bulky_ = 0;
  std::size_t small_ = 0;
  bool stopping_ = false;
  std::thread thread_;  // Last: it starts when everything above exists.
};

}  // namespace dendro_ros
