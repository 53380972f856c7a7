#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "dendro_slam/geometry/so3.h"
#include "dendro_slam/sim/flight_path.h"

namespace dendro {

Trajectory::Trajectory(std::vector<TimedPose> knots) : knots_(std::move(knots)) {
  if (knots_.empty()) throw std::invalid_argument("Trajectory: at least one pose is needed");
  for (std::size_t i = 0; i < knots_.size(); ++i) {
    if (!std::isfinite(knots_[i].time_s) || !knots_[i].T_map_base.matrix().allFinite()) {
      throw std::invalid_argument("Trajectory: times and poses must be finite");
    }
    if (i > 0 && !(knots_[i].time_s > knots_[i - 1].time_s)) {
      throw std::invalid_argument("Trajectory: times must ascend strictly");
    }
    knots_[i].T_map_base = NormalizedSe3(knots_[i].T_map_base);
  }
  const std::size_t n = knots_.size();
  velocity_.assign(n, Eigen::Vector3d::Zero());
  omega_.assign(n, Eigen::Vector3d::Zero());
  for (std::size_t i = 1; i + 1 < n; ++i) {
    // Derivative of the parabola through three knots.
    const double h0 = knots_[i].time_s - knots_[i - 1].time_s;
    const double h1 = knots_[i + 1].time_s - knots_[i].time_s;
    const Eigen::Isometry3d& a = knots_[i - 1].T_map_base;
    const Eigen::Isometry3d& b = knots_[i].T_map_base;
    const Eigen::Isometry3d& c = knots_[i + 1].T_map_base;
    const double w0 = h1 / (h0 + h1), w1 = h0 / (h0 + h1);
    velocity_[i] = w0 * (b.translation() - a.translation()) / h0 +
                   w1 * (c.translation() - b.translation()) / h1;
    omega_[i] = w0 * LogSo3(a.linear().transpose() * b.linear()) / h0 +
                w1 * LogSo3(b.linear().transpose() * c.linear()) / h1;
  }
}

Eigen::Isometry3d Trajectory::Pose(double time_s) const {
  if (!(time_s > knots_.front().time_s)) return knots_.front().T_map_base;
  if (time_s >= knots_.back().time_s) return knots_.back().T_map_base;
  const auto after = std::upper_bound(knots_.begin(), knots_.end(), time_s,
                                      [](double t, const TimedPose& p) { return t < p.time_s; });
  const auto i = static_cast<std::size_t>(after - knots_.begin()) - 1;
  const double h = knots_[i + 1].time_s - knots_[i].time_s;
  const double u = (time_s - knots_[i].time_s) / h;
  const double u2 = u * u, u3 = u2 * u;
  const Eigen::Isometry3d& a = knots_[i].T_map_base;
  const Eigen::Isometry3d& b = knots_[i + 1].T_map_base;
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  T.translation() = (2 * u3 - 3 * u2 + 1) * a.translation() + (u3 - 2 * u2 + u) * h * velocity_[i] +
                    (3 * u2 - 2 * u3) * b.translation() + (u3 - u2) * h * velocity_[i + 1];
  const Eigen::Matrix3d from = a.linear() * ExpSo3(u * h * omega_[i]);
  const Eigen::Matrix3d to = b.linear() * ExpSo3((u - 1.0) * h * omega_[i + 1]);
  const double blend = 3 * u2 - 2 * u3;
  T.linear() = from * ExpSo3(blend * LogSo3(from.transpose() * to));
  return T;
}

Vector6d Trajectory::Twist(double time_s) const {
  return TwistOf([this](double t) { return Pose(t); }, time_s);
}

}  // namespace dendro
