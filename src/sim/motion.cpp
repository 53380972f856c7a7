#include "dendro_slam/sim/motion.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "dendro_slam/geometry/so3.h"

namespace dendro {

Vector6d TwistOf(const MotionFunction& motion, double time_s) {
  constexpr double kStepS = 1e-3;
  const Eigen::Isometry3d before = motion(time_s - kStepS);
  const Eigen::Isometry3d after = motion(time_s + kStepS);
  Vector6d twist;
  twist.head<3>() = LogSo3(before.linear().transpose() * after.linear()) / (2.0 * kStepS);
  twist.tail<3>() = motion(time_s).linear().transpose() *
                    (after.translation() - before.translation()) / (2.0 * kStepS);
  return twist;
}

void FollowerConfig::Validate() const {
  // Four steps of the integration at least, or it becomes unstable.
  if (!(std::isfinite(response_s) && response_s >= 4.0 * FollowedMotion::kStepS)) {
    throw std::invalid_argument("response_s: expected at least 0.01");
  }
  if (!(std::isfinite(max_speed_mps) && max_speed_mps > 0.0)) {
    throw std::invalid_argument("max_speed_mps: expected > 0");
  }
}

FollowedMotion::FollowedMotion(const Eigen::Isometry3d& start, const FollowerConfig& config)
    : config_(config), target_(NormalizedSe3(start)) {
  config_.Validate();
  poses_.assign(static_cast<std::size_t>(std::llround(kMemoryS / kStepS)) + 1, target_);
}

void FollowedMotion::SetTarget(const Eigen::Isometry3d& T_map_base) {
  const Eigen::Matrix3d R = T_map_base.linear();
  if (!T_map_base.matrix().allFinite() ||
      (R.transpose() * R - Eigen::Matrix3d::Identity()).cwiseAbs().maxCoeff() > 1e-3 ||
      R.determinant() < 0.0) {
    throw std::invalid_argument("target pose: expected finite numbers and a rotation");
  }
  const std::lock_guard<std::mutex> lock(mutex_);
  target_ = NormalizedSe3(T_map_base);
}

void FollowedMotion::AdvanceTo(double time_s) {
  const std::lock_guard<std::mutex> lock(mutex_);
  const double rate = 1.0 / config_.response_s;
  const auto size = static_cast<std::int64_t>(poses_.size());
  while (static_cast<double>(newest_) * kStepS < time_s) {
    Eigen::Isometry3d T = poses_[static_cast<std::size_t>(newest_ % size)];
    // Semi-implicit Euler: velocity first.
    Eigen::Vector3d pull = target_.translation() - T.translation();
    // A steady pull p ends in the speed p rate / 2: bounded pull, bounded speed.
    const double reach = 2.0 * config_.max_speed_mps * config_.response_s;
    if (pull.norm() > reach) pull *= reach / pull.norm();
    velocity_ += kStepS * (rate * rate * pull - 2.0 * rate * velocity_);
    const Eigen::Vector3d turn = LogSo3(T.linear().transpose() * target_.linear());
    omega_ += kStepS * (rate * rate * turn - 2.0 * rate * omega_);
    T.translation() += kStepS * velocity_;
    T.linear() = T.linear() * ExpSo3(kStepS * omega_);
    ++newest_;
    poses_[static_cast<std::size_t>(newest_ % size)] = NormalizedSe3(T);
  }
}

Eigen::Isometry3d FollowedMotion::Pose(double time_s) const {
  const std::lock_guard<std::mutex> lock(mutex_);
  const auto size = static_cast<std::int64_t>(poses_.size());
  const double oldest = static_cast<double>(std::max<std::int64_t>(0, newest_ - size + 1));
  const double x = std::clamp(time_s / kStepS, oldest, static_cast<double>(newest_));
  const auto before = std::min(static_cast<std::int64_t>(x), std::max<std::int64_t>(newest_ - 1, 0));
  const double u = x - static_cast<double>(before);
  const Eigen::Isometry3d& a = poses_[static_cast<std::size_t>(before % size)];
  const Eigen::Isometry3d& b = poses_[static_cast<std::size_t>(std::min(before + 1, newest_) % size)];
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  T.translation() = (1.0 - u) * a.translation() + u * b.translation();
  T.linear() = a.linear() * ExpSo3(u * LogSo3(a.linear().transpose() * b.linear()));
  return T;
}

}  // namespace dendro
