#include "dendro_slam/mapping/radius_profile.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>
#include <utility>

#include "dendro_slam/mapping/knots.h"

namespace dendro {

namespace {

constexpr double kTwoPi = 6.283185307179586;
constexpr double kThinM = 0.008;  // A third of the width of a beam 5 m away.

void Require(bool ok, const char* message) {
  if (!ok) throw std::invalid_argument(std::string("RadiusProfileConfig: ") + message);
}

int DistanceBin(double distance_m) {
  if (distance_m < 3.0) return 0;
  if (distance_m < 6.0) return 1;
  return distance_m < 12.0 ? 2 : 3;
}

int DirectionBin(double angle, int bins) {
  const double turn = angle / kTwoPi - std::floor(angle / kTwoPi);
  return std::min(bins - 1, static_cast<int>(turn * bins));
}

struct Estimate {
  double radius = 0.0;
  double sigma = 0.0;
};

// Value below which half of the weight lies.
double WeightedMedian(std::vector<std::pair<double, double>> value_and_weight) {
  std::sort(value_and_weight.begin(), value_and_weight.end());
  double total = 0.0, seen = 0.0;
  for (const auto& [value, weight] : value_and_weight) total += weight;
  for (const auto& [value, weight] : value_and_weight) {
    seen += weight;
    if (seen >= 0.5 * total) return value;
  }
  return value_and_weight.back().first;
}

// Robust mean of the bins' means (an M-estimate with Cauchy's weights, started at the median); each
// bin's variance stops at what its scans share.
//
// A bend, a neighbour or foliage makes a branch look thicker, and that from some sides only: the
// median of the sides is far less moved than their mean. Where the sides disagree by more than their
// sigmas, the excess is taken for an error that most of them share, not one that averages out.
Estimate Combine(const std::vector<RadiusProfile::Bin>& bins, const RadiusProfileConfig& config) {
  constexpr double kCauchyWidth = 2.0;
  constexpr int kIterations = 5;
  constexpr double kNormalOverMad = 1.4826;
  constexpr double kSharedExcess = 0.25;  // Part of the excess variance that more sides do not remove.
  std::vector<double> mean(bins.size()), variance(bins.size());
  std::vector<std::pair<double, double>> ranked(bins.size());
  for (std::size_t i = 0; i < bins.size(); ++i) {
    mean[i] = bins[i].weighted_radius / bins[i].weight;
    const double shared = config.bin_sigma_rel * mean[i];
    variance[i] =
        1.0 / bins[i].weight + shared * shared + config.bin_sigma_m * config.bin_sigma_m;
    ranked[i] = {mean[i], 1.0 / variance[i]};
  }
  Estimate out;
  out.radius = WeightedMedian(ranked);
  for (std::size_t i = 0; i < bins.size(); ++i) {
    const double e = mean[i] - out.radius;
    ranked[i].first = e * e / variance[i];
  }
  // Spread of the sides in units of their sigmas: 1 if the sigmas are right. With few sides it is
  // hardly known, and 1 is assumed along with them.
  const double n = static_cast<double>(bins.size());
  const double mad = kNormalOverMad * kNormalOverMad * WeightedMedian(ranked);
  const double excess = std::max(0.0, (mad * n + 2.0) / (n + 2.0) - 1.0);
  double total = 0.0;
  for (int iteration = 0; iteration < kIterations; ++iteration) {
    double weighted = 0.0;
    total = 0.0;
    for (std::size_t i = 0; i < bins.size(); ++i) {
      const double e = mean[i] - out.radius;
      const double v = variance[i] * (1.0 + excess);
      const double weight = 1.0 / (v * (1.0 + e * e / (v * kCauchyWidth * kCauchyWidth)));
      total += weight;
      weighted += weight * mean[i];
    }
    out.radius = weighted / total;
  }
  double precision = 0.0;
  for (std::size_t i = 0; i < bins.size(); ++i) precision += 1.0 / variance[i];
  const double shared_excess = kSharedExcess * excess * n / precision;
  const double common = config.common_sigma_rel * out.radius;
  // Of wood thinner than the beam only the beams that met much of it returned: what all scans share
  // grows (measured on generated trees: 0.8 mm RMS at 0.6 to 2 cm of radius, 0.2 to 0.3 mm above 4 cm).
  const double thin = kThinM / out.radius;
  out.sigma = std::sqrt(1.0 / total + shared_excess + common * common +
                        config.common_sigma_m * config.common_sigma_m * (1.0 + thin * thin));
  return out;
}

}  // namespace

void RadiusProfileConfig::Validate() const {
  Require(knot_spacing_m > 0.0, "knot_spacing_m must be > 0");
  Require(direction_bins >= 1 && direction_bins <= 36, "direction_bins must be in [1, 36]");
  Require(bin_sigma_rel >= 0.0, "bin_sigma_rel must be >= 0");
  Require(bin_sigma_m >= 0.0, "bin_sigma_m must be >= 0");
  Require(common_sigma_rel >= 0.0, "common_sigma_rel must be >= 0");
  Require(common_sigma_m >= 0.0, "common_sigma_m must be >= 0");
  Require(outlier_sigma > 0.0, "outlier_sigma must be > 0");
}

void RadiusProfile::Add(const Observation& o, const RadiusProfileConfig& config) {
  const double spacing = config.knot_spacing_m;
  const auto [first, last] = KnotsBetween(o.s_start_m, o.s_end_m, spacing);
  const int bin_index = DirectionBin(o.view_angle_rad, config.direction_bins) * kDistanceBins +
                        DistanceBin(o.distance_m);
  for (int k = first; k <= last; ++k) {
    const double ds = k * spacing - o.s_anchor_m;
    const double radius = o.radius_m + o.taper_m_per_m * ds;
    const double variance = o.radius_sigma_m * o.radius_sigma_m +
                            o.taper_sigma_m_per_m * o.taper_sigma_m_per_m * ds * ds;
    if (!(radius > 0.0) || !(variance > 0.0) || !std::isfinite(radius + variance)) continue;
    Knot& knot = AtIndex(k, &knots_);
    double weight = 1.0 / variance;
    if (knot.num_scans >= 5) {
      const Estimate now = Combine(knot.bins, config);
      const double shared = config.bin_sigma_rel * now.radius;
      const double limit =
          config.outlier_sigma * std::sqrt(variance + shared * shared + now.sigma * now.sigma);
      const double difference = std::abs(radius - now.radius);
      if (difference > limit) weight *= (limit / difference) * (limit / difference);
    }
    Bin& bin = AtIndex(bin_index, &knot.bins);
    bin.weight += weight;
    bin.weighted_radius += weight * radius;
    ++bin.num_scans;
    ++knot.num_scans;
  }
}

std::vector<RadiusKnot> RadiusProfile::Knots(const RadiusProfileConfig& config) const {
  std::vector<RadiusKnot> out;
  out.reserve(knots_.size());
  for (const Knot& knot : knots_) {
    if (knot.bins.empty()) continue;
    const Estimate estimate = Combine(knot.bins, config);
    RadiusKnot k;
    k.s_m = knot.index * config.knot_spacing_m;
    k.radius_m = estimate.radius;
    k.radius_sigma_m = estimate.sigma;
    k.num_scans = knot.num_scans;
    out.push_back(k);
  }
  return out;
}

void RadiusProfile::Merge(const RadiusProfile& other,
                          double offset_m,
                          bool same_sign,
                          double turn_rad,
                          const RadiusProfileConfig& config) {
  const double sign = same_sign ? 1.0 : -1.0;
  for (const Knot& knot : other.knots_) {
    const double s = offset_m + sign * knot.index * config.knot_spacing_m;
    Knot& mine =
        AtIndex(static_cast<int>(std::lround(s / config.knot_spacing_m)), &knots_);
    mine.num_scans += knot.num_scans;
    for (const Bin& bin : knot.bins) {
      const int direction = bin.index / kDistanceBins;
      const double angle =
          sign * (direction + 0.5) * kTwoPi / config.direction_bins + turn_rad;
      const int index = DirectionBin(angle, config.direction_bins) * kDistanceBins +
                        bin.index % kDistanceBins;
      Bin& my_bin = AtIndex(index, &mine.bins);
      my_bin.weight += bin.weight;
      my_bin.weighted_radius += bin.weighted_radius;
      my_bin.num_scans += bin.num_scans;
    }
  }
}

void RadiusProfile::Crop(double s_begin_m, double s_end_m, const RadiusProfileConfig& config) {
  const double slack = 0.5 * config.knot_spacing_m;
  knots_.erase(std::remove_if(knots_.begin(),
                              knots_.end(),
                              [&](const Knot& knot) {
                                const double s = knot.index * config.knot_spacing_m;
                                return s < s_begin_m - slack || s > s_end_m + slack;
                              }),
               knots_.end());
}

}  // namespace dendro
