#pragma once

#include <cstdint>
#include <vector>

#include <Eigen/Core>

#include "dendro_slam/sim/motion.h"

namespace dendro {

/// One message of the inertial sensor, in the base frame.
struct ImuSample {
  std::int64_t stamp_ns = 0;
  Eigen::Vector3d angular_velocity_rps = Eigen::Vector3d::Zero();  ///< Base frame [rad/s].
  Eigen::Vector3d specific_force_mps2 = Eigen::Vector3d::Zero();   ///< Base frame [m/s^2]; at rest +g up.
};

/// Errors of a MEMS inertial sensor: white noise, a constant bias, a bias that walks. Each is switched
/// off by setting it to zero.
///
/// Noise densities are those of the BMI055 inside the T265 (Bosch's data sheet: 0.014 deg/s/sqrt(Hz),
/// 150 ug/sqrt(Hz)); an autopilot's ICM-20689 has 0.006 deg/s/sqrt(Hz) and 150 ug/sqrt(Hz). Biases
/// are what is left after a calibration at the start, and walk as Allan deviations of such sensors show.
struct ImuSimulatorConfig {
  double rate_hz = 200.0;                        ///< Messages per second.
  int seed = 1;
  double gyro_noise_dps_per_sqrt_hz = 0.014;     ///< White noise density [deg/s/sqrt(Hz)].
  double gyro_bias_dps = 0.1;                    ///< Sigma of the constant bias of each axis [deg/s].
  double gyro_bias_walk_dps_per_sqrt_s = 0.002;  ///< Random walk of the bias [deg/s/sqrt(s)].
  double accel_noise_mps2_per_sqrt_hz = 0.0015;  ///< White noise density [m/s^2/sqrt(Hz)].
  double accel_bias_mps2 = 0.05;                 ///< Sigma of the constant bias of each axis [m/s^2].
  double accel_bias_walk_mps2_per_sqrt_s = 0.0005;  ///< Random walk of the bias [m/s^2/sqrt(s)].
  double gravity_mps2 = 9.80665;                 ///< Along -z of the map [m/s^2].

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("rate_hz", rate_hz);
    v("seed", seed);
    v("gyro_noise_dps_per_sqrt_hz", gyro_noise_dps_per_sqrt_hz);
    v("gyro_bias_dps", gyro_bias_dps);
    v("gyro_bias_walk_dps_per_sqrt_s", gyro_bias_walk_dps_per_sqrt_s);
    v("accel_noise_mps2_per_sqrt_hz", accel_noise_mps2_per_sqrt_hz);
    v("accel_bias_mps2", accel_bias_mps2);
    v("accel_bias_walk_mps2_per_sqrt_s", accel_bias_walk_mps2_per_sqrt_s);
    v("gravity_mps2", gravity_mps2);
  }

  /// @throws std::invalid_argument  Naming the field.
  void Validate() const;

  /// Sigma of the white noise of one message: density * sqrt(rate) [rad/s].
  double GyroSigmaRps() const;
  /// As above [m/s^2].
  double AccelSigmaMps2() const;
};

/// Makes inertial measurements from a true motion, message by message, deterministic in the seed.
///
/// With R = R_map_base: `gyro = omega + b_g + n_g`, `accel = R^T (a + g e_z) + b_a + n_a`, omega and a
/// being means over one message period, as the sensor's low-pass gives them.
class ImuSimulator {
 public:
  /// @param start_stamp_ns  Stamp of the motion's time 0.
  /// @throws std::invalid_argument  From ImuSimulatorConfig::Validate.
  ImuSimulator(MotionFunction motion, std::int64_t start_stamp_ns, const ImuSimulatorConfig& config);

  /// The messages of [0, until_s]; a later call continues where this ended. The motion is asked up to
  /// one message period later.
  std::vector<ImuSample> AdvanceTo(double until_s);

  const ImuSimulatorConfig& config() const { return config_; }

 private:
  MotionFunction motion_;
  std::int64_t start_stamp_ns_;
  ImuSimulatorConfig config_;
  std::int64_t next_index_ = 0;
  Eigen::Vector3d gyro_bias_rps_;
  Eigen::Vector3d accel_bias_mps2_;
};

}  // namespace dendro
