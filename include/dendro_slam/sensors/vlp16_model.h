#pragma once

#include <array>
#include <cmath>

#include <Eigen/Core>

/// Geometry and timing of the Velodyne VLP-16, from its user manual (63-9243, chapters 6, 9 and
/// appendix A).
///
/// Frame: the ROS frame of `velodyne_pointcloud`, x forward at azimuth 0, y left, z up along the
/// spin axis. The azimuth grows clockwise seen from above, so azimuth 90 degrees points to -y. (The
/// manual's own frame has azimuth 0 along +y and 90 degrees along +x: x_ros = y_manual,
/// y_ros = -x_manual.)
///
/// A **laser** is numbered in firing order, 0 to 15; a **ring** is numbered by elevation, 0 the
/// lowest. A **firing sequence** (here: a firing) is one shot of all 16 lasers, 2.304 us apart, and
/// starts every 55.296 us.
namespace dendro {
namespace vlp16 {

constexpr int kLasers = 16;
constexpr double kLaserPeriodS = 2.304e-6;    ///< Between two lasers of one firing [s].
constexpr double kFiringPeriodS = 55.296e-6;  ///< Between the starts of two firings [s].
constexpr double kRangeResolutionM = 0.002;   ///< Of the ranges in the packets [m].
constexpr double kMinRpm = 300.0;
constexpr double kMaxRpm = 1200.0;
constexpr double kElevationStepDeg = 2.0;     ///< Between neighbouring rings [deg].
constexpr double kLowestElevationDeg = -15.0; ///< Of ring 0 [deg].
constexpr double kDegToRad = 0.017453292519943295;

/// Elevation by laser [deg].
constexpr std::array<double, kLasers> kElevationDeg = {-15, 1, -13, 3, -11, 5, -9, 7,
                                                       -7, 9, -5, 11, -3, 13, -1, 15};

/// Height of the beam's start above the frame's origin by laser [m] (the manual's vertical
/// correction): the beams cross 4.2 cm outside the axis, at the lens.
constexpr std::array<double, kLasers> kVerticalOffsetM = {
    0.0112, -0.0007, 0.0097, -0.0022, 0.0081, -0.0037, 0.0066, -0.0051,
    0.0051, -0.0066, 0.0037, -0.0081, 0.0022, -0.0097, 0.0007, -0.0112};

/// Ring (0 the lowest) of a laser: even lasers look down, odd lasers up.
constexpr int RingOfLaser(int laser) { return laser % 2 == 0 ? laser / 2 : 8 + laser / 2; }
/// Laser of a ring, the inverse of RingOfLaser.
constexpr int LaserOfRing(int ring) { return ring < 8 ? 2 * ring : 2 * (ring - 8) + 1; }

/// Elevation of a ring [deg].
constexpr double RingElevationDeg(int ring) {
  return kLowestElevationDeg + kElevationStepDeg * ring;
}
/// Vertical offset of a ring's beam [m].
constexpr double RingVerticalOffsetM(int ring) { return kVerticalOffsetM[LaserOfRing(ring)]; }

/// Time at which a laser fires after the start of its firing sequence [s].
constexpr double LaserTimeS(int laser) { return laser * kLaserPeriodS; }
/// The same by ring [s].
constexpr double RingTimeS(int ring) { return LaserTimeS(LaserOfRing(ring)); }

/// Speed of the head [deg/s] at a number of revolutions per minute.
constexpr double AzimuthRateDegPerS(double rpm) { return rpm * 6.0; }
/// Azimuth between two firings [deg]: 0.199 at 600 rpm.
constexpr double FiringPitchDeg(double rpm) { return AzimuthRateDegPerS(rpm) * kFiringPeriodS; }
/// Firings in one revolution: 1808.4 at 600 rpm.
constexpr double FiringsPerRevolution(double rpm) { return 360.0 / FiringPitchDeg(rpm); }
/// Columns of a range image for a speed: the nominal resolution of 0.2 degrees at 600 rpm, that is
/// 1800, and proportionally for others (a multiple of 8, never more than one revolution's firings,
/// so that no column stays without a firing).
constexpr int ColumnsPerRevolution(double rpm) {
  const int columns = static_cast<int>(1800.0 * 600.0 / rpm + 0.5);
  return columns - columns % 8;
}

/// Azimuth brought into [0, 360) [deg].
inline double WrapAzimuthDeg(double azimuth_deg) {
  const double wrapped = std::fmod(azimuth_deg, 360.0);
  if (wrapped >= 0.0) return wrapped;
  const double positive = wrapped + 360.0;
  return positive < 360.0 ? positive : 0.0;
}

/// Azimuth in [0, 360) of a point in the ROS frame [deg].
inline double AzimuthDegOf(double x, double y) {
  return WrapAzimuthDeg(std::atan2(-y, x) / kDegToRad);
}

/// Unit direction of a beam in the sensor frame.
/// @param azimuth_deg    Azimuth of the head when the laser fires, clockwise from +x [deg].
/// @param elevation_deg  Above the horizontal [deg].
inline Eigen::Vector3d Direction(double azimuth_deg, double elevation_deg) {
  const double a = azimuth_deg * kDegToRad;
  const double e = elevation_deg * kDegToRad;
  return {std::cos(e) * std::cos(a), -std::cos(e) * std::sin(a), std::sin(e)};
}

/// Unit direction of a laser's beam in the sensor frame.
inline Eigen::Vector3d BeamDirection(int laser, double azimuth_deg) {
  return Direction(azimuth_deg, kElevationDeg[static_cast<std::size_t>(laser)]);
}

/// Start of a laser's beam in the sensor frame [m]; ranges count from here. It lies on the spin
/// axis and does not depend on the azimuth.
inline Eigen::Vector3d BeamOrigin(int laser) {
  return {0.0, 0.0, kVerticalOffsetM[static_cast<std::size_t>(laser)]};
}

/// Return of a laser at a range: `BeamOrigin + range * BeamDirection` [m].
inline Eigen::Vector3d PointAt(int laser, double azimuth_deg, double range_m) {
  return BeamOrigin(laser) + range_m * BeamDirection(laser, azimuth_deg);
}

}  // namespace vlp16
}  // namespace dendro
