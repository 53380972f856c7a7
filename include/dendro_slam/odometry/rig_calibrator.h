#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "dendro_slam/odometry/hand_eye.h"
#include "dendro_slam/odometry/scan_to_map.h"
#include "dendro_slam/sensors/lidar_scan.h"
#include "dendro_slam/sensors/pose_buffer.h"

namespace dendro {

struct RigCalibratorConfig {
  int max_points = 2000;       ///< Returns of a scan that are used, spread over it. >= 200.
  double min_range_m = 0.8;    ///< Nearer returns (the carrier, the rig) are left out [m]. >= 0.
  double max_range_m = 30.0;   ///< Farther returns are left out [m]. > min_range_m.
  double spread_m = 0.10;      ///< Returns of one cube of this size count once [m]. > 0.
  int max_scans = 1200;        ///< Further scans are left out. >= 20.
  int passes = 3;              ///< At most; see RigCalibrator. >= 1.
  ScanToMapConfig registration;
  HandEyeConfig hand_eye;

  /// @throws std::invalid_argument naming the field.
  void Validate() const;
};

struct RigCalibration {
  HandEyeResult rig;
  int scans = 0;           ///< Given.
  int registered = 0;      ///< With a pose in the map, last pass.
  double registration_rms_m = 0.0;  ///< Median distance of returns from their surfaces [m].
  int passes = 0;
  std::vector<LidarPose> lidar;     ///< The lidar's trajectory of the last pass.
};

/// Where the lidar sits on the body whose pose the odometry gives, and how their clocks differ, from
/// a recording of both.
///
/// The lidar's trajectory comes from its scans alone: each is registered to the local map of those
/// before (ScanToMap). In the first pass the sweep's motion is taken as constant; once the two
/// trajectories have been aligned (SolveHandEye) the odometry gives the sweep's motion and the guess,
/// and the pass is repeated until the result stands. A pose is that of the middle of the sweep,
/// where errors of the sweep's motion cancel to first order.
class RigCalibrator {
 public:
  /// @throws std::invalid_argument for a bad configuration.
  explicit RigCalibrator(const RigCalibratorConfig& config = RigCalibratorConfig());

  /// Adds a scan with firing times, stamps ascending. Scans beyond `max_scans` are left out.
  /// @return  False when it cannot be used: no times, too few returns, or its stamp is not ahead.
  bool AddScan(const LidarScan& scan);

  /// Aligns the trajectories.
  /// @param odometry  T_odom_body, in its own clock.
  /// @param progress  Called with the fraction done now and then; may be empty.
  RigCalibration Calibrate(const PoseBuffer& odometry,
                           const std::function<void(double)>& progress = {}) const;

 private:
  struct Return {
    Eigen::Vector3f position;
    float time_s;  ///< From the middle of the sweep.
  };
  struct Sweep {
    std::int64_t middle_ns = 0;
    float half_s = 0.0F;
    std::vector<Return> returns;
  };
  std::vector<LidarPose> Track(const PoseBuffer& odometry,
                               const HandEyeResult* rig,
                               const std::function<void(double)>& progress,
                               std::vector<double>* rms) const;

  RigCalibratorConfig config_;
  std::vector<Sweep> sweeps_;
  std::int64_t last_stamp_ns_ = -1;
  int given_ = 0;
};

}  // namespace dendro
