#include "rough_ground.h"

#include <algorithm>
#include <cmath>

#include "counter_rng.h"

namespace dendro {

RoughGround::RoughGround(const SceneGround& ground)
    : z_m_(ground.z_m), amplitude_m_(ground.amplitude_m) {
  double wavelength = ground.wavelength_m;
  double sum = 0.0;
  std::array<double, kWaves> wave_amplitude{};
  for (int i = 0; i < kWaves; ++i) {
    CounterRng rng(ground.seed, static_cast<std::uint64_t>(i), 0x6704);
    const double direction = rng.Uniform(0.0, 2.0 * M_PI);
    const double k = 2.0 * M_PI / wavelength;
    kx_[i] = k * std::cos(direction);
    ky_[i] = k * std::sin(direction);
    phase_[i] = rng.Uniform(0.0, 2.0 * M_PI);
    wave_amplitude[i] = wavelength;
    sum += wavelength;
    wavelength *= 0.55;
  }
  for (int i = 0; i < kWaves; ++i) {
    wave_amplitude[i] *= amplitude_m_ / sum;
    const double k = std::hypot(kx_[i], ky_[i]);
    slope_bound_ += wave_amplitude[i] * k;
    curvature_bound_ += wave_amplitude[i] * k * k;
    amplitude_f_[i] = static_cast<float>(wave_amplitude[i]);
    slope_x_f_[i] = static_cast<float>(wave_amplitude[i] * kx_[i]);
    slope_y_f_[i] = static_cast<float>(wave_amplitude[i] * ky_[i]);
  }
}

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && !defined(__SANITIZE_ADDRESS__)
// The same operations, four doubles at a time where the processor can; AVX2 alone fuses none of them,
// so the bytes are the same.
__attribute__((target_clones("avx2", "default")))
#endif
RoughGround::Surface RoughGround::Evaluate(double x, double y) const {
  // Phases and their reduction to the nearest multiple of pi in double, as they grow with the distance;
  // sine and cosine of what is left in single precision by minimax polynomials (those of DirectXMath;
  // with the rounding, off by 2e-7 at most), all without a branch, so that the loops become vector
  // instructions. Heights are off by less than a micrometre per three metres of amplitude.
  constexpr double kRound = 6755399441055744.0;  // 1.5 * 2^52: adding it rounds to a whole number.
  constexpr double kPiHigh = 3.141592653589793, kPiLow = 1.2246467991473532e-16;
  alignas(16) std::array<float, kLanes> rest, sign;
  for (int i = 0; i < kLanes; ++i) {
    const double phase = kx_[i] * x + ky_[i] * y + phase_[i];
    const double n = (phase * (1.0 / M_PI) + kRound) - kRound;
    const double half = 0.5 * n;
    const double odd = half - ((half + kRound) - kRound);  // 0, 0.5 or -0.5.
    rest[i] = static_cast<float>((phase - n * kPiHigh) - n * kPiLow);
    sign[i] = static_cast<float>(1.0 - 8.0 * odd * odd);
  }
  alignas(16) std::array<float, kLanes> h, sx, sy;
  for (int i = 0; i < kLanes; ++i) {
    const float r = rest[i], q = r * r;
    const float sine =
        r * (1.0F + q * (-0.16666667F + q * (0.0083333310F + q * (-0.00019840874F +
             q * (2.7525562e-06F - q * 2.3889859e-08F)))));
    const float cosine =
        1.0F + q * (-0.5F + q * (0.041666638F + q * (-0.0013888378F + q * (2.4760495e-05F - q * 2.6051615e-07F))));
    h[i] = amplitude_f_[i] * (sign[i] * sine);
    sx[i] = slope_x_f_[i] * (sign[i] * cosine);
    sy[i] = slope_y_f_[i] * (sign[i] * cosine);
  }
  float height = 0.0F, slope_x = 0.0F, slope_y = 0.0F;
  for (int i = 0; i < kWaves; ++i) {
    height += h[i];
    slope_x += sx[i];
    slope_y += sy[i];
  }
  return {z_m_ + static_cast<double>(height), static_cast<double>(slope_x), static_cast<double>(slope_y)};
}

double RoughGround::Height(double x, double y) const { return Evaluate(x, y).height_m; }

Eigen::Vector3d RoughGround::Normal(double x, double y) const {
  const Surface surface = Evaluate(x, y);
  return Eigen::Vector3d(-surface.slope_x, -surface.slope_y, 1.0).normalized();
}

std::optional<double> RoughGround::Intersect(const Eigen::Vector3d& origin,
                                             const Eigen::Vector3d& direction,
                                             double min_range_m,
                                             double max_range_m,
                                             double half_width_m,
                                             double half_angle_rad,
                                             double* safe_m) const {
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
    const Surface surface = Evaluate(origin.x() + t * direction.x(), origin.y() + t * direction.y());
    slope = direction.z() - surface.slope_x * direction.x() - surface.slope_y * direction.y();
    gap = origin.z() + t * direction.z() - surface.height_m;
  };
  // Two steps that cannot pass the surface: by the bound of the slope, and by the bound of the
  // curvature, gap + slope s - K s^2 / 2 > 0, which converges as fast as Newton's method.
  const double horizontal2 = direction.head<2>().squaredNorm();
  const double inverse_rate = 1.0 / (std::abs(direction.z()) + slope_bound_ * std::sqrt(horizontal2) + 1e-12);
  const double curvature = curvature_bound_ * horizontal2 + 1e-12;
  const double inverse_curvature = 1.0 / curvature;
  // The last step is Newton's, when its error K s^2 / 2 means less than kAccuracyM of range.
  constexpr double kAccuracyM = 2e-5, kTolerance = 2e-8, kShortestM = 1e-6;
  double t = from;
  evaluate(t);
  const double sign = gap >= 0.0 ? 1.0 : -1.0;  // From below, the surface is met from its other side.
  bool safe = sign > 0.0;
  for (int i = 0; i < 100000; ++i) {
    const double distance = sign * gap, descent = -sign * slope;
    if (safe_m != nullptr && safe) {
      safe = distance > (half_width_m + half_angle_rad * t) * (1.0 + slope_bound_);
      if (safe) *safe_m = t;
    }
    if (distance <= kTolerance) return t;
    if (descent > 0.0 &&
        curvature * distance * distance <= 2.0 * kAccuracyM * descent * descent * descent) {
      const double last = t + distance / descent;
      if (last > to) return std::nullopt;
      return last;
    }
    const double by_curvature =
        (std::sqrt(descent * descent + 2.0 * curvature * distance) - descent) * inverse_curvature;
    t += std::max({distance * inverse_rate, by_curvature, kShortestM});
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
