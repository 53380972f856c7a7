#include "dendro_slam/sim/odometry_simulator.h"

#include <cmath>
#include <stdexcept>
#include <utility>

#include "counter_rng.h"
#include "dendro_slam/geometry/so3.h"
#include "dendro_slam/sim/flight_path.h"

namespace dendro {
namespace {

constexpr double kDegree = M_PI / 180.0;

enum Stream : int {
  kWalkX, kWalkY, kWalkZ, kWalkYaw,
  kSlowX, kSlowY, kSlowZ, kSlowRoll, kSlowPitch, kSlowYaw,
  kNoiseX, kNoiseY, kNoiseZ, kNoiseRoll, kNoisePitch, kNoiseYaw,
  kJump, kJumpX, kJumpY, kJumpZ, kJumpYaw, kLoss,
  kDriftX, kDriftY, kDriftZ, kOneJump
};

Eigen::Matrix3d RotationZ(double angle) {
  return Eigen::AngleAxisd(angle, Eigen::Vector3d::UnitZ()).toRotationMatrix();
}

}  // namespace

void OdometrySimulatorConfig::Validate() const {
  if (model != "t265" && model != "mavros" && model != "none") {
    throw std::invalid_argument("odometry.model: expected t265, mavros or none");
  }
  if (!(rate_hz > 0.0 && rate_hz <= 1000.0)) {
    throw std::invalid_argument("odometry.rate_hz: expected more than 0 and at most 1000");
  }
  if (!(std::isfinite(scale_error) && std::abs(scale_error) < 0.5)) {
    throw std::invalid_argument("odometry.scale_error: expected between -0.5 and 0.5");
  }
  OdometrySimulatorConfig copy = *this;
  copy.Visit([](const char* name, auto& value) {
    if constexpr (std::is_same_v<std::decay_t<decltype(value)>, double>) {
      const std::string key = name;
      if (key != "scale_error" && !(std::isfinite(value) && value >= 0.0)) {
        throw std::invalid_argument("odometry." + key + ": expected >= 0");
      }
    }
  });
  if (!(tilt_time_s > 0.0)) throw std::invalid_argument("odometry.tilt_time_s: expected > 0");
  if (!(drift_length_m > 0.0)) throw std::invalid_argument("odometry.drift_length_m: expected > 0");
  if (!(mavros_correlation_s > 0.0)) {
    throw std::invalid_argument("odometry.mavros_correlation_s: expected > 0");
  }
}

OdometrySimulator::OdometrySimulator(const Trajectory& trajectory,
                                     std::int64_t start_stamp_ns,
                                     const OdometrySimulatorConfig& config)
    : OdometrySimulator([&trajectory](double time_s) { return trajectory.Pose(time_s); },
                        start_stamp_ns,
                        config) {}

OdometrySimulator::OdometrySimulator(MotionFunction motion,
                                     std::int64_t start_stamp_ns,
                                     const OdometrySimulatorConfig& config)
    : motion_(std::move(motion)), start_stamp_ns_(start_stamp_ns), config_(config) {
  config_.Validate();
  T_map_base_previous_ = motion_(0.0);
  if (config_.model == "t265") {
    const Eigen::Matrix3d R = T_map_base_previous_.linear();
    T_odom_base_.linear() = RotationZ(-std::atan2(R(1, 0), R(0, 0))) * R;
    drift_ = config_.drift_m_per_m *
             Eigen::Vector3d(Gauss(-1, kDriftX), Gauss(-1, kDriftY), Gauss(-1, kDriftZ));
  } else {
    T_odom_base_ = T_map_base_previous_;
    slow_position_ = config_.mavros_position_sigma_m * Eigen::Vector3d(Gauss(-1, kSlowX), Gauss(-1, kSlowY), Gauss(-1, kSlowZ));
    slow_rotation_.z() = config_.mavros_yaw_sigma_deg * kDegree * Gauss(-1, kSlowYaw);
  }
}

double OdometrySimulator::Gauss(std::int64_t index, int stream) const {
  return CounterRng(static_cast<std::uint64_t>(config_.seed), static_cast<std::uint64_t>(index),
                    static_cast<std::uint64_t>(stream) + 1000)
      .Gauss();
}

std::vector<OdometrySample> OdometrySimulator::AdvanceTo(double until_s) {
  std::vector<OdometrySample> samples;
  if (config_.model == "none") return samples;
  const bool t265 = config_.model == "t265";
  const double dt = 1.0 / config_.rate_hz;
  const auto uniform = [&](std::int64_t index, int stream) {
    return CounterRng(static_cast<std::uint64_t>(config_.seed), static_cast<std::uint64_t>(index),
                      static_cast<std::uint64_t>(stream) + 1000)
        .Uniform();
  };
  // True for the first message at or after a time; never for 0.
  const auto reached = [&](double at_s, std::int64_t index) {
    const double now = static_cast<double>(index) * dt;
    return at_s > 0.0 && now >= at_s && now - dt < at_s;
  };
  while (static_cast<double>(next_index_) * dt <= until_s + 1e-9) {
    const std::int64_t i = next_index_++;
    const double time_s = static_cast<double>(i) * dt;
    const Eigen::Isometry3d T_map_base = motion_(time_s);
    OdometrySample sample;
    sample.stamp_ns = start_stamp_ns_ + std::llround(static_cast<double>(i) * 1e9 / config_.rate_hz);
    sample.twist = TwistOf(motion_, time_s);
    bool lost = false;

    if (t265) {
      const Eigen::Isometry3d step = T_map_base_previous_.inverse() * T_map_base;
      const double distance = step.translation().norm();
      if (reached(config_.loss_time_s, i)) lost_until_s_ = time_s + config_.loss_duration_s;
      lost = time_s < lost_until_s_;
      const double worse = lost ? 10.0 : 1.0;
      const double drift_keep = std::exp(-distance / config_.drift_length_m);
      drift_ = drift_keep * drift_ +
               std::sqrt(1.0 - drift_keep * drift_keep) * config_.drift_m_per_m *
                   Eigen::Vector3d(Gauss(i, kDriftX), Gauss(i, kDriftY), Gauss(i, kDriftZ));
      const double walk = config_.position_walk_m_per_sqrt_m * std::sqrt(distance);
      T_odom_base_.translation() +=
          T_odom_base_.linear() * ((1.0 + config_.scale_error) * step.translation()) +
          worse * (distance * drift_ +
                   walk * Eigen::Vector3d(Gauss(i, kWalkX), Gauss(i, kWalkY), Gauss(i, kWalkZ)));
      const double yaw_step =
          config_.yaw_walk_deg_per_sqrt_m * kDegree * std::sqrt(distance) * Gauss(i, kWalkYaw);
      T_odom_base_.linear() = RotationZ(yaw_step) * T_odom_base_.linear() * step.linear();
      if (config_.jump_interval_s > 0.0 && uniform(i, kJump) < dt / config_.jump_interval_s) {
        T_odom_base_.translation() += config_.jump_position_m *
                                      Eigen::Vector3d(Gauss(i, kJumpX), Gauss(i, kJumpY), Gauss(i, kJumpZ));
        T_odom_base_.linear() =
            RotationZ(config_.jump_yaw_deg * kDegree * Gauss(i, kJumpYaw)) * T_odom_base_.linear();
      }
      if (reached(config_.jump_time_s, i)) {
        const double direction = 2.0 * M_PI * uniform(0, kOneJump);
        T_odom_base_.translation() +=
            config_.jump_distance_m * Eigen::Vector3d(std::cos(direction), std::sin(direction), 0.0);
      }
      if (!lost && config_.loss_interval_s > 0.0 && uniform(i, kLoss) < dt / config_.loss_interval_s) {
        lost_until_s_ = time_s + config_.loss_duration_s;
      }
      T_odom_base_ = NormalizedSe3(T_odom_base_);
      const double keep = std::exp(-dt / config_.tilt_time_s);
      const double fresh = std::sqrt(1.0 - keep * keep) * config_.tilt_sigma_deg * kDegree;
      slow_rotation_.x() = keep * slow_rotation_.x() + fresh * Gauss(i, kSlowRoll);
      slow_rotation_.y() = keep * slow_rotation_.y() + fresh * Gauss(i, kSlowPitch);
      sample.T_odom_base = T_odom_base_;
    } else {
      const double keep = std::exp(-dt / config_.mavros_correlation_s);
      const double fresh = std::sqrt(1.0 - keep * keep);
      slow_position_ = keep * slow_position_ +
                       fresh * config_.mavros_position_sigma_m *
                           Eigen::Vector3d(Gauss(i, kSlowX), Gauss(i, kSlowY), Gauss(i, kSlowZ));
      slow_rotation_.z() = keep * slow_rotation_.z() +
                           fresh * config_.mavros_yaw_sigma_deg * kDegree * Gauss(i, kSlowYaw);
      sample.T_odom_base = T_map_base;
      sample.T_odom_base.translation() += slow_position_;
      sample.T_odom_base.linear() = RotationZ(slow_rotation_.z()) * T_map_base.linear();
    }
    T_map_base_previous_ = T_map_base;
    if (lost) continue;

    const double noise_m = t265 ? config_.noise_position_m : config_.mavros_noise_m;
    const double noise_rad = config_.noise_rotation_deg * kDegree;
    sample.T_odom_base.translation() +=
        noise_m * Eigen::Vector3d(Gauss(i, kNoiseX), Gauss(i, kNoiseY), Gauss(i, kNoiseZ));
    const Eigen::Vector3d tilt(slow_rotation_.x(), slow_rotation_.y(), 0.0);
    sample.T_odom_base.linear() =
        sample.T_odom_base.linear() *
        ExpSo3(noise_rad * Eigen::Vector3d(Gauss(i, kNoiseRoll), Gauss(i, kNoisePitch), Gauss(i, kNoiseYaw)) +
               (t265 ? tilt : Eigen::Vector3d::Zero()));
    if (t265) {
      // realsense2_camera: linear_accel_cov * 10^(3 - confidence) for the pose's translation, and
      // angular_velocity_cov * 10^(1 - confidence) for rotation and twist, both parameters 0.01.
      const double pose = 0.01 * std::pow(10.0, 3 - sample.tracker_confidence);
      const double turn = 0.01 * std::pow(10.0, 1 - sample.tracker_confidence);
      sample.pose_covariance.diagonal() << pose, pose, pose, turn, turn, turn;
      sample.twist_covariance.diagonal() << pose, pose, pose, turn, turn, turn;
    } else {
      const double position = std::pow(config_.mavros_position_sigma_m, 2) + std::pow(noise_m, 2);
      const double yaw = std::pow(config_.mavros_yaw_sigma_deg * kDegree, 2) + noise_rad * noise_rad;
      sample.pose_covariance.diagonal() << position, position, position, noise_rad * noise_rad,
          noise_rad * noise_rad, yaw;
      sample.twist_covariance.diagonal() << 1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5;
    }
    samples.push_back(sample);
  }
  return samples;
}

std::vector<OdometrySample> SimulateOdometry(const Trajectory& trajectory,
                                             double duration_s,
                                             std::int64_t start_stamp_ns,
                                             const OdometrySimulatorConfig& config) {
  return OdometrySimulator(trajectory, start_stamp_ns, config).AdvanceTo(duration_s);
}

}  // namespace dendro
