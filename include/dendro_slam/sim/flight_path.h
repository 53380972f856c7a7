#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include <Eigen/Geometry>

#include "dendro_slam/geometry/se3.h"
#include "dendro_slam/sensors/vlp16_packet.h"
#include "dendro_slam/sim/odometry_simulator.h"

namespace dendro {

/// A pose at a time, counted from the start of the trajectory.
struct TimedPose {
  double time_s = 0.0;
  Eigen::Isometry3d T_map_base = Eigen::Isometry3d::Identity();
};

/// A motion with continuous velocity (C1) through timed poses.
///
/// Position: cubic Hermite; rotation: the two first-order motions from the neighbouring knots,
/// blended by `3u^2 - 2u^3` on SO(3), which has the knots' angular velocities at both ends. Knot
/// velocities are central differences. Before the first and after the last knot it rests.
class Trajectory {
 public:
  /// @param knots  Strictly ascending in time, at least one, finite.
  /// @throws std::invalid_argument
  explicit Trajectory(std::vector<TimedPose> knots);

  double start_s() const { return knots_.front().time_s; }
  double end_s() const { return knots_.back().time_s; }

  /// T_map_base at a time [s].
  Eigen::Isometry3d Pose(double time_s) const;

  /// Velocity in the base frame at a time: [omega (rad/s); v (m/s)].
  Vector6d Twist(double time_s) const;

 private:
  std::vector<TimedPose> knots_;
  std::vector<Eigen::Vector3d> velocity_;  ///< Per knot, map frame [m/s].
  std::vector<Eigen::Vector3d> omega_;     ///< Per knot, base frame [rad/s].
};

/// What a path file says: the motion, where the sensors sit on the body, and the odometry.
struct FlightPath {
  std::string name;                    ///< File name without its extension.
  Trajectory trajectory;               ///< T_map_base over time, from 0 s.
  double duration_s = 0.0;             ///< Time to simulate [s].
  std::int64_t start_stamp_ns = 0;     ///< Stamp of time 0 [ns].
  Eigen::Isometry3d T_base_lidar = Eigen::Isometry3d::Identity();
  Eigen::Isometry3d T_base_camera = Eigen::Isometry3d::Identity();
  OdometrySimulatorConfig odometry;    ///< Model and drift.
  double origin_latitude_deg = 33.4214;    ///< Of the map's origin, WGS 84; x points east, y north.
  double origin_longitude_deg = -111.9324;

  /// T_map_lidar at a stamp [ns].
  Eigen::Isometry3d LidarPose(std::int64_t stamp_ns) const;

  /// What a GNSS receiver without error reports at a stamp [ns]: the fix of the last full second. The
  /// map's plane is laid on the ellipsoid at the origin by its two radii of curvature.
  GnssFix Fix(std::int64_t stamp_ns) const;
};

/// Reads a flight-path file (YAML): `type` quadrangle, circle, helix, conical_helix, walk or poses.
/// The keys of each type are described in config/paths/README.md.
/// @throws SceneFileError  As LoadScene: names the file, the line or key, and what is expected.
FlightPath LoadFlightPath(const std::string& path);

/// As LoadFlightPath, from text. @param name  Stands for the file in error messages.
FlightPath ParseFlightPath(const std::string& text, const std::string& name);

}  // namespace dendro
