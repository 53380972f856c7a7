#pragma once

#include <cstdint>
#include <optional>
#include <utility>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "dendro_slam/geometry/se3.h"
#include "dendro_slam/sensors/lidar_scan.h"
#include "dendro_slam/sensors/pose_buffer.h"

namespace dendro {

/// Motion of the lidar during one sweep: `T_stamp_t`, which maps points of the lidar frame at time
/// t to the lidar frame at the scan's stamp (t = 0).
///
/// A table at equal steps, interpolated (normalised linear quaternions, linear translations: at the
/// default step of 1 ms and 10 rad/s the error stays below 1e-7 rad). Outside the table it goes on
/// with the velocity of the end for 20 ms, then stands still.
class SweepMotion {
 public:
  /// @param T_stamp_t  Poses at `begin_s + i * step_s`; at least one.
  /// @param begin_s    Time of the first pose relative to the stamp [s].
  /// @param step_s     Between poses [s]. > 0.
  /// @throws std::invalid_argument on an empty table, a step that is not positive, or poses that
  ///         are not finite.
  SweepMotion(const std::vector<Eigen::Isometry3d>& T_stamp_t, double begin_s, double step_s);

  /// `T_stamp_t = Exp(twist t)`, for runs that know only the last motion between two scans.
  /// @param twist_per_s  Body velocity of the lidar [omega (rad/s); v (m/s)], shape (6).
  /// @param begin_s,end_s  Times to cover, relative to the stamp [s].
  static SweepMotion ConstantVelocity(const Vector6d& twist_per_s,
                                      double begin_s = -0.25,
                                      double end_s = 0.25);

  /// Pose at a time relative to the stamp [s].
  Eigen::Isometry3d At(double time_s) const;

  /// A point measured at a time, in the lidar frame at the stamp [m].
  Eigen::Vector3d TransformPoint(double time_s, const Eigen::Vector3d& p) const;

  double begin_s() const { return begin_s_; }
  double end_s() const { return begin_s_ + step_s_ * static_cast<double>(poses_.size() - 1); }

 private:
  struct Pose {
    Eigen::Quaterniond q;
    Eigen::Vector3d t;
  };
  Pose Interpolate(double time_s) const;

  double begin_s_;
  double step_s_;
  std::vector<Pose> poses_;  ///< Neighbouring quaternions share their hemisphere.
};

/// First and last firing time of the points with a finite position [s], relative to the stamp;
/// (0, 0) when there is none or the scan has no times.
std::pair<double, double> ScanTimeSpan(const LidarScan& scan);

/// Motion of the sweep from odometry.
/// @param poses         Odometry `T_odom_base`.
/// @param T_base_lidar  Mounting of the lidar.
/// @param stamp_ns      Stamp of the scan [ns].
/// @param begin_s,end_s Times of the first and last point relative to the stamp [s].
/// @param step_s        Step of the table [s].
/// @return  Nothing when the odometry does not cover the stamp and the whole sweep.
std::optional<SweepMotion> MakeSweepMotion(const PoseBuffer& poses,
                                           const Eigen::Isometry3d& T_base_lidar,
                                           std::int64_t stamp_ns,
                                           double begin_s,
                                           double end_s,
                                           double step_s = 1e-3);

/// The same over the scan's own time span; for a scan without times over `untimed_span_s`, which
/// should be the span that Projector derives for it.
std::optional<SweepMotion> MakeSweepMotion(const PoseBuffer& poses,
                                           const Eigen::Isometry3d& T_base_lidar,
                                           const LidarScan& scan,
                                           std::pair<double, double> untimed_span_s = {0.0, 0.1});

}  // namespace dendro
