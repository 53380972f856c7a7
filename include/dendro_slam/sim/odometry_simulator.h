#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include <Eigen/Geometry>

#include "dendro_slam/geometry/se3.h"
#include "dendro_slam/sim/motion.h"

namespace dendro {

class Trajectory;

/// One message of the odometry.
struct OdometrySample {
  std::int64_t stamp_ns = 0;
  Eigen::Isometry3d T_odom_base = Eigen::Isometry3d::Identity();
  Matrix6d pose_covariance = Matrix6d::Zero();  ///< As the driver writes it: [translation; rotation].
  Vector6d twist = Vector6d::Zero();            ///< [omega; v] in the base frame [rad/s, m/s].
  Matrix6d twist_covariance = Matrix6d::Zero(); ///< As the driver writes it: [translation; rotation].
  int tracker_confidence = 3;                   ///< T265: 0 failed, 1 low, 2 medium, 3 high.
};

/// Parameters of both odometry models. Each effect is switched off by setting it to zero.
struct OdometrySimulatorConfig {
  std::string model = "t265";   ///< t265, mavros or none.
  double rate_hz = 200.0;       ///< Messages per second.
  int seed = 1;

  // t265: drift grows with the distance travelled. Intel states "less than 1 % drift" of a closed loop
  // as typical, users report 1 % and more. On the thesis' flight (159 m, 40 seeds, measured by
  // flight_path_test) these values give, root mean square over the seeds, a relative translation error
  // of 1.2, 1.1, 1.0 and 0.9 % over pieces of 10, 20, 40 and 80 m of way, and 0.7 % of the way at the
  // end. For a better or worse tracker scale the first four and the yaw walk alike.
  double scale_error = 0.005;                ///< Length measured / true - 1.
  /// Slow drift: error per metre of way, RMS of each axis of the odom frame. Neighbouring pieces of
  /// way share features and bias estimates, so their errors are alike.
  double drift_m_per_m = 0.006;
  double drift_length_m = 50.0;              ///< Way over which the slow drift forgets its direction [m].
  double position_walk_m_per_sqrt_m = 0.005; ///< Random walk of each position axis per root metre.
  double yaw_walk_deg_per_sqrt_m = 0.15;     ///< Random walk of yaw per root metre [deg].
  double tilt_sigma_deg = 0.15;              ///< Roll and pitch error (bounded: gravity is seen).
  double tilt_time_s = 20.0;                 ///< Correlation time of the tilt error [s].
  double noise_position_m = 0.0005;          ///< White noise of a message [m].
  double noise_rotation_deg = 0.02;          ///< White noise of a message [deg].
  double jump_interval_s = 0.0;              ///< Mean time between relocalisation jumps [s]; 0 never.
  double jump_position_m = 0.15;             ///< Sigma of such a jump per axis [m].
  double jump_yaw_deg = 1.5;                 ///< Sigma of such a jump in yaw [deg].
  double jump_time_s = 0.0;                  ///< One jump at this time of the flight [s]; 0 never.
  double jump_distance_m = 0.5;              ///< Length of that one jump, horizontal, any direction [m].
  double loss_interval_s = 0.0;              ///< Mean time between losses of tracking [s]; 0 never.
  double loss_time_s = 0.0;                  ///< One loss from this time of the flight on [s]; 0 never.
  double loss_duration_s = 5.0;              ///< How long a loss lasts: no messages [s]; meanwhile the
                                             ///< position drifts ten times as fast.

  // mavros: PX4's EKF output is anchored by GNSS; its error is bounded and slowly varying.
  double mavros_position_sigma_m = 0.05;     ///< Slow error of each axis [m].
  double mavros_yaw_sigma_deg = 0.5;         ///< Slow error of yaw [deg].
  double mavros_correlation_s = 30.0;        ///< Correlation time of the slow errors [s].
  double mavros_noise_m = 0.003;             ///< White noise of a message [m].

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("model", model);
    v("rate_hz", rate_hz);
    v("seed", seed);
    v("scale_error", scale_error);
    v("drift_m_per_m", drift_m_per_m);
    v("drift_length_m", drift_length_m);
    v("position_walk_m_per_sqrt_m", position_walk_m_per_sqrt_m);
    v("yaw_walk_deg_per_sqrt_m", yaw_walk_deg_per_sqrt_m);
    v("tilt_sigma_deg", tilt_sigma_deg);
    v("tilt_time_s", tilt_time_s);
    v("noise_position_m", noise_position_m);
    v("noise_rotation_deg", noise_rotation_deg);
    v("jump_interval_s", jump_interval_s);
    v("jump_position_m", jump_position_m);
    v("jump_yaw_deg", jump_yaw_deg);
    v("jump_time_s", jump_time_s);
    v("jump_distance_m", jump_distance_m);
    v("loss_interval_s", loss_interval_s);
    v("loss_time_s", loss_time_s);
    v("loss_duration_s", loss_duration_s);
    v("mavros_position_sigma_m", mavros_position_sigma_m);
    v("mavros_yaw_sigma_deg", mavros_yaw_sigma_deg);
    v("mavros_correlation_s", mavros_correlation_s);
    v("mavros_noise_m", mavros_noise_m);
  }

  /// @throws std::invalid_argument  Naming the field.
  void Validate() const;
};

/// Makes odometry from a true motion, message by message, deterministic in the seed.
///
/// `t265`: visual-inertial odometry. The odom frame is the body's place and heading at the start,
/// with z up.
/// Increments of the true motion carry a scale error, a slow drift (a Gauss-Markov process over the way)
/// and random walks in position and yaw; roll and pitch errors stay bounded. A relocalisation jump moves
/// the pose at once; during a loss of tracking no message comes. The covariance is what realsense2_camera writes from the tracker
/// confidence (0.01 m^2 * 10^(3 - confidence) linear): it does not tell the drift.
///
/// `mavros`: PX4's local position. The odom frame is the map; the error is a bounded, slowly varying
/// (Gauss-Markov) offset plus white noise.
class OdometrySimulator {
 public:
  /// @param trajectory      Must outlive this object.
  /// @param start_stamp_ns  Stamp of the trajectory's time 0.
  /// @throws std::invalid_argument  From OdometrySimulatorConfig::Validate.
  OdometrySimulator(const Trajectory& trajectory,
                    std::int64_t start_stamp_ns,
                    const OdometrySimulatorConfig& config);

  /// Of any motion; it is asked up to 1 ms later than the newest message.
  OdometrySimulator(MotionFunction motion,
                    std::int64_t start_stamp_ns,
                    const OdometrySimulatorConfig& config);

  /// The messages of [0, until_s], as often as `rate_hz`; a later call continues where this ended.
  /// Empty for model "none" and during losses.
  std::vector<OdometrySample> AdvanceTo(double until_s);

 private:
  double Gauss(std::int64_t index, int stream) const;

  MotionFunction motion_;
  std::int64_t start_stamp_ns_;
  OdometrySimulatorConfig config_;
  std::int64_t next_index_ = 0;
  Eigen::Isometry3d T_map_base_previous_ = Eigen::Isometry3d::Identity();
  Eigen::Isometry3d T_odom_base_ = Eigen::Isometry3d::Identity();  ///< Before tilt and white noise.
  Eigen::Vector3d slow_position_ = Eigen::Vector3d::Zero();
  Eigen::Vector3d slow_rotation_ = Eigen::Vector3d::Zero();
  Eigen::Vector3d drift_ = Eigen::Vector3d::Zero();  ///< Present slow drift [m per m], odom frame.
  double lost_until_s_ = -1.0;
};

/// The whole odometry of a motion at once.
std::vector<OdometrySample> SimulateOdometry(const Trajectory& trajectory,
                                             double duration_s,
                                             std::int64_t start_stamp_ns,
                                             const OdometrySimulatorConfig& config);

}  // namespace dendro
