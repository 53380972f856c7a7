#include "rough_ground.h"

#include <algorithm>
#include <cmath>

#include "counter_rng.h"

namespace dendro {

RoughGround::RoughGround(const SceneGround& ground)
    : z_m_(ground.z_m), amplitude_m_(ground.amplitude_m) {
  double wavelength = ground.wavelength_m;
  double sum = 0.0;
  for (int i = 0; i < kWaves; ++i) {
    CounterRng rng(ground.seed, static_cast<std::uint64_t>(i), 0x6704);
    const double direction = rng.Uniform(0.0, 2.0 * M_PI);
    const double k = 2.0 * M_PI / wavelength;
    kx_[i] = k * std::cos(direction);
    ky_[i] = k * std::sin(direction);
    phase_[i] = rng.Uniform(0.0, 2.0 * M_PI);
    wave_amplitude_[i] = wavelength;
    sum += wavelength;
    wavelength *= 0.55;
  }
  for (int i = 0; i < kWaves; ++i) {
    wave_amplitude_[i] *= amplitude_m_ / sum;
    const double k = std::hypot(kx_[i], ky_[i]);
    slope_bound_ += wave_amplitude_[i] * k;
    curvature_bound_ += wave_amplitude_[i] * k * k;
  }
}

void RoughGround::Evaluate(double x, double y, double dx, double dy, double* height, double* slope) const {
  // Sine and cosine by Taylor series around the nearest multiple of pi (error below 1e-9), without a
  // branch, so that the loop becomes vector instructions.
  constexpr double kRound = 6755399441055744.0;  // 1.5 * 2^52: adding it rounds to a whole number.
  constexpr double kPiHigh = 3.141592653589793, kPiLow = 1.2246467991473532e-16;
  alignas(16) std::array<double, kLanes> h, s;
  for (int i = 0; i < kLanes; ++i) {
    const double phase = kx_[i] * x + ky_[i] * y + phase_[i];
    const double n = (phase * (1.0 / M_PI) + kRound) - kRound;
    const double r = (phase - n * kPiHigh) - n * kPiLow;
    const double half = 0.5 * n;
    const double odd = half - ((half + kRound) - kRound);  // 0, 0.5 or -0.5.
    const double sign = 1.0 - 8.0 * odd * odd;
    const double q = r * r;
    const double sine =
        r * (1.0 + q * (-1.0 / 6 + q * (1.0 / 120 + q * (-1.0 / 5040 + q * (1.0 / 362880 +
             q * (-1.0 / 39916800 + q * (1.0 / 6227020800.0 - q * (1.0 / 1307674368000.0))))))));
    const double cosine =
        1.0 + q * (-0.5 + q * (1.0 / 24 + q * (-1.0 / 720 + q * (1.0 / 40320 + q * (-1.0 / 3628800 +
              q * (1.0 / 479001600.0 - q * (1.0 / 87178291200.0)))))));
    h[i] = wave_amplitude_[i] * sign * sine;
    s[i] = wave_amplitude_[i] * sign * cosine * (kx_[i] * dx + ky_[i] * dy);
  }
  double height_sum = z_m_, slope_sum = 0.0;
  for (int i = 0; i < kLanes; ++i) {
    height_sum += h[i];
    slope_sum += s[i];
  }
  *height = height_sum;
  *slope = slope_sum;
}

double RoughGround::Height(double x, double y) const {
  double height = 0.0, slope = 0.0;
  Evaluate(x, y, 0.0, 0.0, &height, &slope);
  return height;
}

Eigen::Vector3d RoughGround::Normal(double x, double y) const {
  double height = 0.0, dx = 0.0, dy = 0.0;
  Evaluate(x, y, 1.0, 0.0, &height, &dx);
  Evaluate(x, y, 0.0, 1.0, &height, &dy);
  return Eigen::Vector3d(-dx, -dy, 1.0).normalized();
}

std::optional<double> RoughGround::Intersect(const Eigen::Vector3d& origin,
                                             const Eigen::Vector3d& direction,
                                             double min_range_m,
                                             double max_range_m,
                                             double half_width_m,
                                             double half_angle_rad,
                                             double* safe_m) const {
  if (safe_m != nullptr) *safe_m = min_range_m;
  // Only the slab that can hold the surface matters.
  double from = min_range_m, to = max_range_m;
  const double top = z_m_ + amplitude_m_, bottom = z_m_ - amplitude_m_;
  if (std::abs(direction.z()) > 1e-12) {
    const double a = (top - origin.z()) / direction.z();
    const double b = (bottom - origin.z()) / direction.z();
    if (direction.z() < 0.0) {
      from = std::max(from, a);
      to = std::min(to, b + 1e-6);
    } else {
      from = std::max(from, std::min(a, b) - 1e-6);
      to = std::min(to, std::max(a, b));
    }
  } else if (origin.z() > top) {
    return std::nullopt;
  }
  if (from > to) return std::nullopt;
  // Gap between ray and surface, and its derivative along the ray.
  double gap = 0.0, slope = 0.0;
  const auto evaluate = [&](double t) {
    double height = 0.0, along = 0.0;
    Evaluate(origin.x() + t * direction.x(), origin.y() + t * direction.y(), direction.x(), direction.y(), &height,
             &along);
    slope = direction.z() - along;
    gap = origin.z() + t * direction.z() - height;
  };
  // Two steps that cannot pass the surface: by the bound of the slope, and by the bound of the
  // curvature, gap + slope s - K s^2 / 2 > 0, which converges as fast as Newton's method.
  const double horizontal = std::hypot(direction.x(), direction.y());
  const double rate = std::abs(direction.z()) + slope_bound_ * horizontal;
  const double curvature = curvature_bound_ * horizontal * horizontal + 1e-12;
  constexpr double kTolerance = 1e-8;
  double t = from;
  evaluate(t);
  const double sign = gap >= 0.0 ? 1.0 : -1.0;  // From below, the surface is met from its other side.
  bool safe = sign > 0.0;
  for (int i = 0; i < 100000; ++i) {
    const double distance = sign * gap, descent = sign * slope;
    if (safe_m != nullptr && safe) {
      safe = distance > (half_width_m + half_angle_rad * t) * (1.0 + slope_bound_);
      if (safe) *safe_m = t;
    }
    if (distance <= kTolerance) return t;
    const double by_curvature = (descent + std::sqrt(descent * descent + 2.0 * curvature * distance)) / curvature;
    t += std::max({distance / rate, by_curvature, 10.0 * kTolerance});
    if (t > to) {
      evaluate(to);
      if (sign * gap <= kTolerance) return to;
      return std::nullopt;
    }
    evaluate(t);
  }
  return std::nullopt;
}

}  // namespace dendro
