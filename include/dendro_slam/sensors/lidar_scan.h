#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include <Eigen/Core>

namespace dendro {

/// One return of the lidar, as the usual drivers publish it.
struct LidarPoint {
  Eigen::Vector3f position = Eigen::Vector3f::Zero();  ///< In the lidar frame at firing time [m].
  float intensity = 0.0F;                              ///< Calibrated reflectivity, 0 to 255.
  float time_s = 0.0F;      ///< Firing time relative to the scan's stamp [s]; may be negative.
  std::uint16_t ring = 0;   ///< Laser by elevation, 0 is the lowest.
};

/// One revolution of the lidar, as raw returns in the cloud's order.
struct LidarScan {
  std::int64_t stamp_ns = 0;          ///< Time of the scan in the data's clock [ns].
  std::vector<LidarPoint> points;     ///< May hold NaN positions; they are skipped downstream.
  bool has_ring = true;               ///< False: `ring` was absent from the source.
  bool has_time = true;               ///< False: `time_s` was absent from the source.
};

/// Nanoseconds to seconds, for differences of stamps.
inline double NsToSeconds(std::int64_t ns) { return static_cast<double>(ns) * 1e-9; }

}  // namespace dendro
