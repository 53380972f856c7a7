#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>
#include <string>
#include <utility>

#include <nav_msgs/Odometry.h>

#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/ros/lidar_mount.h"
#include "dendro_slam/sensors/odometry_wait.h"
#include "dendro_slam/sensors/pose_buffer.h"

namespace dendro_ros {

/// What became of a message given to a ScanGate.
enum class GateEvent {
  kAccepted,
  kRefused,         ///< Older than the one before by less than a second: dropped.
  kTimeJumpedBack,  ///< Older by more: everything was forgotten, and this message taken as the first.
  kInvalid          ///< A pose that is not finite or not a rigid motion: dropped.
};

/// Joins scans with the odometry that covers them, and notices when time jumps back (a bag that
/// starts anew). Not synchronised: one thread.
template <class Item>
class ScanGate {
 public:
  /// @param timeout_s  Silence of the odometry after which scans go on without it [s].
  /// @param capacity   Scans held at most.
  ScanGate(double timeout_s,
           std::size_t capacity,
           const dendro::PoseBufferConfig& pose_buffer,
           LidarMount mount)
      : wait_(timeout_s, capacity), poses_(pose_buffer), mount_(std::move(mount)) {}

  GateEvent AddOdometry(const nav_msgs::Odometry& odometry) {
    OdometryPose pose;
    try {
      pose = FromMsg(odometry);
    } catch (const std::invalid_argument&) {
      return GateEvent::kInvalid;
    }
    GateEvent event = GateEvent::kAccepted;
    if (!poses_.empty() && pose.stamp_ns < poses_.newest_ns()) {
      if (poses_.newest_ns() - pose.stamp_ns < kJumpNs) return GateEvent::kRefused;
      Clear();
      event = GateEvent::kTimeJumpedBack;
    }
    if (poses_.Add(pose.stamp_ns, pose.T_odom_child) == dendro::PoseBuffer::AddStatus::kInvalid) {
      return GateEvent::kInvalid;
    }
    odom_frame_ = odometry.header.frame_id;
    body_frame_ = odometry.child_frame_id;
    Update();
    return event;
  }

  /// @param need_ns  Odometry is waited for until this stamp.
  /// @param dropped  Scans dropped to make room are added to this.
  GateEvent AddScan(std::int64_t stamp_ns,
                    std::int64_t need_ns,
                    const std::string& lidar_frame,
                    Item item,
                    std::size_t* dropped) {
    GateEvent event = GateEvent::kAccepted;
    if (last_scan_ns_ && stamp_ns <= *last_scan_ns_) {
      if (*last_scan_ns_ - stamp_ns < kJumpNs) return GateEvent::kRefused;
      Clear();
      event = GateEvent::kTimeJumpedBack;
    }
    last_scan_ns_ = stamp_ns;
    lidar_frame_ = lidar_frame;
    Update();
    *dropped += wait_.Push(stamp_ns, need_ns, std::move(item));
    return event;
  }

  /// The oldest scan that is ready, if any.
  std::optional<Item> Pop() { return wait_.Pop(); }

  /// Odometry for the scans that Pop gives; null while none is usable.
  const dendro::PoseBuffer* poses() const {
    return T_body_lidar_ && !poses_.empty() ? &poses_ : nullptr;
  }
  Eigen::Isometry3d T_body_lidar() const {
    return T_body_lidar_.value_or(Eigen::Isometry3d::Identity());
  }
  /// What keeps the odometry from being used; empty when nothing does.
  const std::string& mount_error() const { return mount_.error(); }
  const std::string& odom_frame() const { return odom_frame_; }
  const std::string& body_frame() const { return body_frame_; }
  std::size_t size() const { return wait_.size(); }

  void Clear() {
    wait_.Clear();
    poses_.Clear();
    last_scan_ns_.reset();
  }

 private:
  static constexpr std::int64_t kJumpNs = 1000000000;

  void Update() {
    if (poses_.empty() || lidar_frame_.empty()) return;
    T_body_lidar_ = mount_.Find(body_frame_, lidar_frame_);
    if (T_body_lidar_) wait_.SetOdometry(poses_.newest_ns());
  }

  dendro::OdometryWait<Item> wait_;
  dendro::PoseBuffer poses_;
  LidarMount mount_;
  std::optional<Eigen::Isometry3d> T_body_lidar_;
  std::optional<std::int64_t> last_scan_ns_;
  std::string lidar_frame_;
  std::string odom_frame_;
  std::string body_frame_;
};

}  // namespace dendro_ros
