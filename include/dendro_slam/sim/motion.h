#pragma once

#include <cstdint>
#include <functional>
#include <mutex>
#include <vector>

#include <Eigen/Geometry>

#include "dendro_slam/geometry/se3.h"

namespace dendro {

/// T_map_base as a function of the time since the start [s].
using MotionFunction = std::function<Eigen::Isometry3d(double time_s)>;

/// Velocity in the base frame at a time, by central differences over 2 ms: [omega (rad/s); v (m/s)].
Vector6d TwistOf(const MotionFunction& motion, double time_s);

struct FollowerConfig {
  double response_s = 0.2;     ///< Time constant of the body's answer to a new target [s]. > 0.
  double max_speed_mps = 5.0;  ///< The body goes towards a far target at most this fast [m/s]. > 0.

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("response_s", response_s);
    v("max_speed_mps", max_speed_mps);
  }

  /// @throws std::invalid_argument  Naming the field.
  void Validate() const;
};

/// A body that a pilot steers: it follows the newest target pose as a critically damped second-order
/// system, `a = (x_target - x) / T^2 - 2 v / T`, in position and on SO(3), so that targets may come at
/// any rate, with gaps and leaps, and the motion still has a continuous velocity.
///
/// SetTarget may be called from any thread while another advances and asks for poses.
class FollowedMotion {
 public:
  /// @param start  T_map_base at time 0, at rest.
  /// @throws std::invalid_argument  From FollowerConfig::Validate.
  FollowedMotion(const Eigen::Isometry3d& start, const FollowerConfig& config);

  /// The pose to go to from now on.
  /// @throws std::invalid_argument  Not finite, or its linear part is no rotation.
  void SetTarget(const Eigen::Isometry3d& T_map_base);

  /// Moves the body on, in steps of kStepS, until poses up to this time are known.
  void AdvanceTo(double time_s);

  /// T_map_base at a time within the last kMemoryS before the time advanced to; beyond, the nearest known.
  Eigen::Isometry3d Pose(double time_s) const;

  static constexpr double kStepS = 0.0025;
  static constexpr double kMemoryS = 2.0;

 private:
  FollowerConfig config_;
  mutable std::mutex mutex_;
  Eigen::Isometry3d target_;
  Eigen::Vector3d velocity_ = Eigen::Vector3d::Zero();  ///< Map frame [m/s].
  Eigen::Vector3d omega_ = Eigen::Vector3d::Zero();     ///< Base frame [rad/s].
  std::vector<Eigen::Isometry3d> poses_;                ///< A ring: pose number k at k % size.
  std::int64_t newest_ = 0;                             ///< Number of the newest pose, at newest_ * kStepS.
};

}  // namespace dendro
