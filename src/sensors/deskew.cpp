#include "dendro_slam/sensors/deskew.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

namespace dendro {

namespace {

constexpr double kMaxExtrapolationS = 0.02;
constexpr double kTableStepS = 1e-3;
constexpr double kLongestSweepS = 10.0;  // 300 rpm takes 0.2 s; a longer span is a broken clock.

}  // namespace

SweepMotion::SweepMotion(const std::vector<Eigen::Isometry3d>& T_stamp_t,
                         double begin_s,
                         double step_s)
    : begin_s_(begin_s), step_s_(step_s) {
  if (T_stamp_t.empty()) throw std::invalid_argument("T_stamp_t must hold at least one pose");
  if (!(step_s > 0.0) || !std::isfinite(step_s) || !std::isfinite(begin_s)) {
    throw std::invalid_argument("step_s must be positive, and begin_s finite");
  }
  poses_.reserve(T_stamp_t.size());
  for (const Eigen::Isometry3d& T : T_stamp_t) {
    if (!T.matrix().allFinite()) throw std::invalid_argument("T_stamp_t must be finite");
    Pose pose{Eigen::Quaterniond(T.linear()).normalized(), T.translation()};
    if (!poses_.empty() && poses_.back().q.dot(pose.q) < 0.0) pose.q.coeffs() *= -1.0;
    poses_.push_back(pose);
  }
}

SweepMotion SweepMotion::ConstantVelocity(const Vector6d& twist_per_s,
                                          double begin_s,
                                          double end_s) {
  if (!twist_per_s.allFinite()) throw std::invalid_argument("twist_per_s must be finite");
  if (!(end_s >= begin_s) || end_s - begin_s > kLongestSweepS) {
    throw std::invalid_argument("end_s must not lie before begin_s, nor 10 s after it");
  }
  const int steps = std::max(1, static_cast<int>(std::ceil((end_s - begin_s) / kTableStepS)));
  std::vector<Eigen::Isometry3d> table;
  table.reserve(static_cast<std::size_t>(steps) + 1);
  for (int i = 0; i <= steps; ++i) {
    table.push_back(ExpSe3(twist_per_s * (begin_s + i * kTableStepS)));
  }
  return SweepMotion(table, begin_s, kTableStepS);
}

SweepMotion::Pose SweepMotion::Interpolate(double time_s) const {
  if (poses_.size() == 1) return poses_.front();
  const double t = std::clamp(time_s, begin_s() - kMaxExtrapolationS, end_s() + kMaxExtrapolationS);
  const double u = (t - begin_s_) / step_s_;
  const int last = static_cast<int>(poses_.size()) - 2;
  const int i = std::clamp(static_cast<int>(std::floor(u)), 0, last);
  const double f = u - i;
  const Pose& a = poses_[static_cast<std::size_t>(i)];
  const Pose& b = poses_[static_cast<std::size_t>(i) + 1];
  Pose out{a.q, a.t + f * (b.t - a.t)};
  out.q.coeffs() += f * (b.q.coeffs() - a.q.coeffs());
  out.q.normalize();
  return out;
}

Eigen::Isometry3d SweepMotion::At(double time_s) const {
  const Pose pose = Interpolate(time_s);
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  T.linear() = pose.q.toRotationMatrix();
  T.translation() = pose.t;
  return T;
}

Eigen::Vector3d SweepMotion::TransformPoint(double time_s, const Eigen::Vector3d& p) const {
  const Pose pose = Interpolate(time_s);
  return pose.q * p + pose.t;
}

std::pair<double, double> ScanTimeSpan(const LidarScan& scan) {
  if (!scan.has_time) return {0.0, 0.0};
  float begin = std::numeric_limits<float>::infinity();
  float end = -begin;
  for (const LidarPoint& p : scan.points) {
    if (!p.position.allFinite() || !std::isfinite(p.time_s)) continue;
    begin = std::min(begin, p.time_s);
    end = std::max(end, p.time_s);
  }
  if (begin > end) return {0.0, 0.0};
  return {begin, end};
}

std::optional<SweepMotion> MakeSweepMotion(const PoseBuffer& poses,
                                           const Eigen::Isometry3d& T_base_lidar,
                                           std::int64_t stamp_ns,
                                           double begin_s,
                                           double end_s,
                                           double step_s) {
  if (!T_base_lidar.matrix().allFinite()) {
    throw std::invalid_argument("T_base_lidar must be finite");
  }
  if (!(step_s > 0.0)) throw std::invalid_argument("step_s must be positive");
  if (!(end_s >= begin_s) || end_s - begin_s > kLongestSweepS || std::abs(begin_s) > 1e6) {
    return std::nullopt;
  }
  const auto at = [stamp_ns](double s) {
    return stamp_ns + static_cast<std::int64_t>(std::llround(s * 1e9));
  };
  const std::optional<Eigen::Isometry3d> T_odom_stamp = poses.Lookup(stamp_ns);
  if (!T_odom_stamp || !poses.Covers(at(begin_s), at(end_s))) return std::nullopt;

  const Eigen::Isometry3d T_stamp_odom = (*T_odom_stamp * T_base_lidar).inverse();
  // The steps divide the span, so that no look-up lies outside of it.
  const int steps = std::max(1, static_cast<int>(std::ceil((end_s - begin_s) / step_s)));
  const double step = std::max((end_s - begin_s) / steps, 1e-6);
  std::vector<Eigen::Isometry3d> table;
  table.reserve(static_cast<std::size_t>(steps) + 1);
  for (int i = 0; i <= steps; ++i) {
    const std::optional<Eigen::Isometry3d> T_odom_t =
        poses.Lookup(std::min(at(begin_s + i * step), at(end_s)));
    if (!T_odom_t) return std::nullopt;
    table.push_back(T_stamp_odom * *T_odom_t * T_base_lidar);
  }
  return SweepMotion(table, begin_s, step);
}

std::optional<SweepMotion> MakeSweepMotion(const PoseBuffer& poses,
                                           const Eigen::Isometry3d& T_base_lidar,
                                           const LidarScan& scan,
                                           std::pair<double, double> untimed_span_s) {
  const std::pair<double, double> span = scan.has_time ? ScanTimeSpan(scan) : untimed_span_s;
  return MakeSweepMotion(poses, T_base_lidar, scan.stamp_ns, span.first, span.second);
}

}  // namespace dendro
