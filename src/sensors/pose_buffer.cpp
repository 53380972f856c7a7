#include "dendro_slam/sensors/pose_buffer.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "dendro_slam/geometry/se3.h"

namespace dendro {

namespace {

constexpr double kRotationTolerance = 1e-3;

bool IsRigid(const Eigen::Isometry3d& T) {
  if (!T.matrix().allFinite()) return false;
  const Eigen::Matrix3d R = T.linear();
  return (R.transpose() * R - Eigen::Matrix3d::Identity()).cwiseAbs().maxCoeff() <
             kRotationTolerance &&
         R.determinant() > 0.0;
}

std::int64_t SecondsToNs(double s) { return static_cast<std::int64_t>(std::llround(s * 1e9)); }

}  // namespace

void PoseBufferConfig::Validate() const {
  if (max_poses < 2) throw std::invalid_argument("max_poses must be at least 2");
  if (!(max_gap_s > 0.0 && max_gap_s < 1e6)) {
    throw std::invalid_argument("max_gap_s must be positive and below 1e6");
  }
  if (!(max_extrapolation_s >= 0.0 && max_extrapolation_s < 1e6)) {
    throw std::invalid_argument("max_extrapolation_s must be at least 0 and below 1e6");
  }
}

PoseBuffer::PoseBuffer(const PoseBufferConfig& config) : config_(config) {
  config_.Validate();
  max_gap_ns_ = SecondsToNs(config_.max_gap_s);
  max_extrapolation_ns_ = SecondsToNs(config_.max_extrapolation_s);
}

PoseBuffer::AddStatus PoseBuffer::Add(std::int64_t stamp_ns, const Eigen::Isometry3d& T_odom_base) {
  if (!IsRigid(T_odom_base)) return AddStatus::kInvalid;
  if (!poses_.empty()) {
    if (stamp_ns == poses_.back().stamp_ns) return AddStatus::kDuplicate;
    if (stamp_ns < poses_.back().stamp_ns) return AddStatus::kTimeWentBack;
  }
  poses_.push_back({stamp_ns, NormalizedSe3(T_odom_base)});
  while (poses_.size() > static_cast<std::size_t>(config_.max_poses)) poses_.pop_front();
  return AddStatus::kAdded;
}

std::optional<Eigen::Isometry3d> PoseBuffer::Lookup(std::int64_t stamp_ns) const {
  if (poses_.empty()) return std::nullopt;
  // First pose after the stamp.
  const auto after =
      std::upper_bound(poses_.begin(), poses_.end(), stamp_ns,
                       [](std::int64_t ns, const StampedPose& p) { return ns < p.stamp_ns; });
  const auto interpolate = [stamp_ns](const StampedPose& a, const StampedPose& b) {
    const double fraction =
        static_cast<double>(stamp_ns - a.stamp_ns) / static_cast<double>(b.stamp_ns - a.stamp_ns);
    return InterpolateSe3(a.T, b.T, fraction);
  };

  if (after == poses_.begin()) {
    if (after->stamp_ns - stamp_ns > max_extrapolation_ns_) return std::nullopt;
    if (poses_.size() < 2 || poses_[1].stamp_ns - poses_[0].stamp_ns > max_gap_ns_) {
      return after->T;
    }
    return interpolate(poses_[0], poses_[1]);
  }
  const auto before = std::prev(after);
  if (before->stamp_ns == stamp_ns) return before->T;
  if (after == poses_.end()) {
    if (stamp_ns - before->stamp_ns > max_extrapolation_ns_) return std::nullopt;
    if (poses_.size() < 2 || before->stamp_ns - std::prev(before)->stamp_ns > max_gap_ns_) {
      return before->T;
    }
    return interpolate(*std::prev(before), *before);
  }
  if (after->stamp_ns - before->stamp_ns > max_gap_ns_) return std::nullopt;
  return interpolate(*before, *after);
}

bool PoseBuffer::Covers(std::int64_t begin_ns, std::int64_t end_ns) const {
  if (poses_.empty() || begin_ns > end_ns) return false;
  if (poses_.front().stamp_ns - begin_ns > max_extrapolation_ns_ ||
      end_ns - poses_.back().stamp_ns > max_extrapolation_ns_) {
    return false;
  }
  auto pose =
      std::upper_bound(poses_.begin(), poses_.end(), begin_ns,
                       [](std::int64_t ns, const StampedPose& p) { return ns < p.stamp_ns; });
  if (pose == poses_.begin()) ++pose;
  for (; pose != poses_.end() && std::prev(pose)->stamp_ns < end_ns; ++pose) {
    if (pose->stamp_ns - std::prev(pose)->stamp_ns > max_gap_ns_) return false;
  }
  return true;
}

void PoseBuffer::Clear() { poses_.clear(); }

}  // namespace dendro
