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
    wavelength *= 0.62;
  }
  for (Wave& wave : waves_) {
    wave.amplitude *= amplitude_m_ / sum;
    slope_bound_ += wave.amplitude * std::hypot(wave.kx, wave.ky);
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
                                             double max_range_m) const {
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
  const auto gap = [&](double t) {
    const Eigen::Vector3d p = origin + t * direction;
    return p.z() - Height(p.x(), p.y());
  };
  // Along the ray the gap changes by at most this per metre, so a step of gap / bound cannot pass
  // the surface.
  const double horizontal = std::hypot(direction.x(), direction.y());
  const double bound = std::abs(direction.z()) + slope_bound_ * horizontal;
  constexpr double kTolerance = 1e-6;
  double t = from;
  double g = gap(t);
  const double sign = g >= 0.0 ? 1.0 : -1.0;  // From below, the surface is met from its other side.
  for (int i = 0; i < 100000; ++i) {
    const double distance = sign * g;
    if (distance <= kTolerance) return t;
    const double step = std::max(distance / bound, kTolerance);
    t += step;
    if (t > to) {
      t = to;
      if (sign * gap(t) <= kTolerance) return t;
      return std::nullopt;
    }
    g = gap(t);
  }
  return std::nullopt;
}

}  // namespace dendro
