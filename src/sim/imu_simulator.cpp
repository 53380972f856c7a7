#include "dendro_slam/sim/imu_simulator.h"

#include <cmath>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>

#include "counter_rng.h"
#include "dendro_slam/geometry/so3.h"

namespace dendro {
namespace {

constexpr double kDegree = M_PI / 180.0;

/// Streams of random numbers, so that switching one effect off leaves the others unchanged.
enum Stream : std::uint64_t { kGyroBias = 2000, kAccelBias, kGyroWalk, kAccelWalk, kGyroNoise, kAccelNoise };

Eigen::Vector3d Gauss3(int seed, std::int64_t index, Stream stream) {
  CounterRng rng(static_cast<std::uint64_t>(seed), static_cast<std::uint64_t>(index), stream);
  const double x = rng.Gauss(), y = rng.Gauss(), z = rng.Gauss();
  return {x, y, z};
}

}  // namespace

void ImuSimulatorConfig::Validate() const {
  if (!(rate_hz > 0.0 && rate_hz <= 1000.0)) {
    throw std::invalid_argument("imu.rate_hz: expected more than 0 and at most 1000");
  }
  ImuSimulatorConfig copy = *this;
  copy.Visit([](const char* name, auto& value) {
    if constexpr (std::is_same_v<std::decay_t<decltype(value)>, double>) {
      if (!(std::isfinite(value) && value >= 0.0)) {
        throw std::invalid_argument(std::string("imu.") + name + ": expected >= 0");
      }
    }
  });
}

double ImuSimulatorConfig::GyroSigmaRps() const {
  return gyro_noise_dps_per_sqrt_hz * kDegree * std::sqrt(rate_hz);
}

double ImuSimulatorConfig::AccelSigmaMps2() const {
  return accel_noise_mps2_per_sqrt_hz * std::sqrt(rate_hz);
}

ImuSimulator::ImuSimulator(MotionFunction motion,
                           std::int64_t start_stamp_ns,
                           const ImuSimulatorConfig& config)
    : motion_(std::move(motion)), start_stamp_ns_(start_stamp_ns), config_(config) {
  config_.Validate();
  gyro_bias_rps_ = config_.gyro_bias_dps * kDegree * Gauss3(config_.seed, 0, kGyroBias);
  accel_bias_mps2_ = config_.accel_bias_mps2 * Gauss3(config_.seed, 0, kAccelBias);
}

std::vector<ImuSample> ImuSimulator::AdvanceTo(double until_s) {
  std::vector<ImuSample> samples;
  const double dt = 1.0 / config_.rate_hz;
  const double gyro_walk = config_.gyro_bias_walk_dps_per_sqrt_s * kDegree * std::sqrt(dt);
  const double accel_walk = config_.accel_bias_walk_mps2_per_sqrt_s * std::sqrt(dt);
  while (static_cast<double>(next_index_) * dt <= until_s + 1e-9) {
    const std::int64_t i = next_index_++;
    const double time_s = static_cast<double>(i) * dt;
    const Eigen::Isometry3d before = motion_(time_s - 0.5 * dt), after = motion_(time_s + 0.5 * dt);
    const Eigen::Isometry3d here = motion_(time_s);
    // Mean acceleration: the difference of the mean velocities of the periods before and after.
    const Eigen::Vector3d acceleration = (motion_(time_s + dt).translation() - 2.0 * here.translation() +
                                          motion_(time_s - dt).translation()) /
                                         (dt * dt);
    const Eigen::Vector3d gravity(0.0, 0.0, config_.gravity_mps2);
    ImuSample sample;
    sample.stamp_ns = start_stamp_ns_ + std::llround(static_cast<double>(i) * 1e9 / config_.rate_hz);
    sample.angular_velocity_rps = LogSo3(before.linear().transpose() * after.linear()) / dt +
                                  gyro_bias_rps_ +
                                  config_.GyroSigmaRps() * Gauss3(config_.seed, i, kGyroNoise);
    sample.specific_force_mps2 = here.linear().transpose() * (acceleration + gravity) + accel_bias_mps2_ +
                                 config_.AccelSigmaMps2() * Gauss3(config_.seed, i, kAccelNoise);
    samples.push_back(sample);
    gyro_bias_rps_ += gyro_walk * Gauss3(config_.seed, i, kGyroWalk);
    accel_bias_mps2_ += accel_walk * Gauss3(config_.seed, i, kAccelWalk);
  }
  return samples;
}

}  // namespace dendro
