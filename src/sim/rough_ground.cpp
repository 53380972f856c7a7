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
    waves_[i] = {k * std::cos(direction), k * std::sin(direction), rng.Uniform(0.0, 2.0 * M_PI),
                 wavelength};
    sum += wavelength;
    wavelength *= 0.55;
  }
  for (Wave& wave : waves_) {
    wave.amplitude *= amplitude_m_ / sum;
    const double k = std::hypot(wave.kx, wave.ky);
    slope_bound_ += wave.amplitude * k;
    curvature_bound_ += wave.amplitude * k * k;
  }
}

double RoughGround::Height(double x, double y) const {
  double h = z_m_;
  for (const Wave& w : waves_) h += w.amplitude * std::sin(w.kx * x + w.ky * y + w.phase);
  return h;
}

Eigen::Vector3d RoughGround::Normal(double x, double y) const {
  double dx = 0.0, dy = 0.0;
  for (const Wave& w : waves_) {
    const double c = w.amplitude * std::cos(w.kx * x + w.ky * y + w.phase);
    dx += c * w.kx;
    dy += c * w.ky;
  }
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
    const double x = origin.x() + t * direction.x(), y = origin.y() + t * direction.y();
    double height = z_m_;
    slope = direction.z();
    for (const Wave& w : waves_) {
      const double phase = w.kx * x + w.ky * y + w.phase;
      height += w.amplitude * std::sin(phase);
      slope -= w.amplitude * std::cos(phase) * (w.kx * direction.x() + w.ky * direction.y());
    }
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
