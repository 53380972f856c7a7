#pragma once

#include <cmath>
#include <cstdint>

namespace dendro {

/// Random numbers as a function of a key: the same key gives the same sequence, whatever was drawn
/// before and in whichever thread. SplitMix64 (Steele et al. 2014) started from a hash of the key.
class CounterRng {
 public:
  CounterRng(std::uint64_t seed, std::uint64_t a, std::uint64_t b = 0)
      : state_(Mix(Mix(Mix(seed + kGamma) + a) + b)) {}

  std::uint64_t Next() { return Mix(state_ += kGamma); }

  /// Uniform in [0, 1).
  double Uniform() { return static_cast<double>(Next() >> 11) * 0x1.0p-53; }
  double Uniform(double low, double high) { return low + (high - low) * Uniform(); }

  /// Uniform whole number in [0, n).
  int Below(int n) { return static_cast<int>(Uniform() * n); }

  /// Standard normal (Box and Muller 1958).
  double Gauss() {
    const double u = 1.0 - Uniform();
    const double v = Uniform();
    return std::sqrt(-2.0 * std::log(u)) * std::cos(2.0 * M_PI * v);
  }

 private:
  static constexpr std::uint64_t kGamma = 0x9E3779B97F4A7C15ULL;

  static std::uint64_t Mix(std::uint64_t z) {
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ULL;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBULL;
    return z ^ (z >> 31);
  }

  std::uint64_t state_;
};

}  // namespace dendro
