#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <optional>

#include <Eigen/Geometry>

namespace dendro {

struct PoseBufferConfig {
  int max_poses = 20000;              ///< Oldest poses are dropped beyond this count. >= 2.
  double max_gap_s = 0.25;            ///< No interpolation across a longer silence [s]. > 0.
  double max_extrapolation_s = 0.02;  ///< How far before the first or after the last pose [s]. >= 0.

  void Validate() const;
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("max_poses", max_poses);
    v("max_gap_s", max_gap_s);
    v("max_extrapolation_s", max_extrapolation_s);
  }
};

/// Odometry of the recent past, ordered by time: poses `T_odom_base` at any stamp by interpolation.
///
/// Bounded; lookups are binary searches. Not synchronised: one thread, or a lock around it.
class PoseBuffer {
 public:
  enum class AddStatus {
    kAdded,
    kDuplicate,     ///< Same stamp as the newest pose: ignored.
    kTimeWentBack,  ///< Older than the newest pose: refused (the clock jumped: Clear and start anew).
    kInvalid        ///< Not finite, or its rotation is not one: refused.
  };

  /// @throws std::invalid_argument naming the field.
  explicit PoseBuffer(const PoseBufferConfig& config = PoseBufferConfig());

  /// Appends a pose.
  /// @param stamp_ns     Stamp in the data's clock [ns].
  /// @param T_odom_base  Pose of the base.
  AddStatus Add(std::int64_t stamp_ns, const Eigen::Isometry3d& T_odom_base);

  /// Pose at a stamp: slerp and linear between its neighbours, or up to `max_extrapolation_s`
  /// beyond the ends with the velocity of the last two poses there (held with a single pose).
  /// @return  Nothing outside that reach or inside a silence longer than `max_gap_s`.
  std::optional<Eigen::Isometry3d> Lookup(std::int64_t stamp_ns) const;

  /// True when Lookup succeeds for every stamp in [begin_ns, end_ns].
  bool Covers(std::int64_t begin_ns, std::int64_t end_ns) const;

  void Clear();
  bool empty() const { return poses_.empty(); }
  std::size_t size() const { return poses_.size(); }
  /// Stamps of the first and last pose held; only when not empty.
  std::int64_t oldest_ns() const { return poses_.front().stamp_ns; }
  std::int64_t newest_ns() const { return poses_.back().stamp_ns; }

 private:
  struct StampedPose {
    std::int64_t stamp_ns;
    Eigen::Isometry3d T;
  };

  PoseBufferConfig config_;
  std::int64_t max_gap_ns_;
  std::int64_t max_extrapolation_ns_;
  std::deque<StampedPose> poses_;
};

}  // namespace dendro
