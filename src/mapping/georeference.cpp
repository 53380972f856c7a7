#include "dendro_slam/mapping/georeference.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <stdexcept>

#include <Eigen/Cholesky>
#include <GeographicLib/LocalCartesian.hpp>

#include "dendro_slam/geometry/se3.h"

namespace dendro {

namespace {

constexpr double kDegToRad = 0.017453292519943295;

void Require(bool ok, const char* message) {
  if (!ok) throw std::invalid_argument(std::string("GeoreferencerConfig: ") + message);
}

// A fix beside the antenna's place in the map at that time.
struct Pair {
  Eigen::Vector2d map = Eigen::Vector2d::Zero();
  Eigen::Vector2d east_north = Eigen::Vector2d::Zero();
  double map_z = 0.0;
  std::optional<double> altitude_m;
  double vertical_sigma_m = 0.0;
  double sigma_m = 1.0;   // Each axis.
  double share = 1.0;     // Of an independent fix.
};

struct Fit {
  double psi = 0.0;  // Map's x axis, counter-clockwise from east [rad].
  Eigen::Vector2d t = Eigen::Vector2d::Zero();
  std::vector<double> weight;  // Robust, 0 to 1.
  double cost = 0.0;
};

Eigen::Matrix2d Rotation(double psi) {
  return Eigen::Rotation2Dd(psi).toRotationMatrix();
}

constexpr double kRobust = 2.5;  // Cauchy: a fix this many sigmas off counts half.

double RobustCost(double chi2) { return kRobust * kRobust * std::log1p(chi2 / (kRobust * kRobust)); }

void Weigh(const std::vector<Pair>& pairs, Fit* fit) {
  const Eigen::Matrix2d R = Rotation(fit->psi);
  fit->weight.resize(pairs.size());
  fit->cost = 0.0;
  for (std::size_t i = 0; i < pairs.size(); ++i) {
    const Eigen::Vector2d r = pairs[i].east_north - R * pairs[i].map - fit->t;
    const double chi2 = r.squaredNorm() / (pairs[i].sigma_m * pairs[i].sigma_m);
    fit->weight[i] = 1.0 / (1.0 + chi2 / (kRobust * kRobust));
    fit->cost += pairs[i].share * RobustCost(chi2);
  }
}

double Median(std::vector<double> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

// Translation that a heading asks for, by medians.
Fit StartAt(const std::vector<Pair>& pairs, double psi) {
  const Eigen::Matrix2d R = Rotation(psi);
  std::vector<double> east, north;
  for (const Pair& pair : pairs) {
    const Eigen::Vector2d d = pair.east_north - R * pair.map;
    east.push_back(d.x());
    north.push_back(d.y());
  }
  Fit fit;
  fit.psi = psi;
  fit.t = {Median(std::move(east)), Median(std::move(north))};
  Weigh(pairs, &fit);
  return fit;
}

// Weighted least squares in closed form (Umeyama 1991 in the plane, without scale).
void Align(const std::vector<Pair>& pairs, Fit* fit) {
  double sum = 0.0;
  Eigen::Vector2d p = Eigen::Vector2d::Zero();
  Eigen::Vector2d e = Eigen::Vector2d::Zero();
  const auto w = [&](std::size_t i) {
    return fit->weight[i] * pairs[i].share / (pairs[i].sigma_m * pairs[i].sigma_m);
  };
  for (std::size_t i = 0; i < pairs.size(); ++i) {
    sum += w(i);
    p += w(i) * pairs[i].map;
    e += w(i) * pairs[i].east_north;
  }
  p /= sum;
  e /= sum;
  double cosine = 0.0;
  double sine = 0.0;
  for (std::size_t i = 0; i < pairs.size(); ++i) {
    const Eigen::Vector2d a = pairs[i].map - p;
    const Eigen::Vector2d b = pairs[i].east_north - e;
    cosine += w(i) * a.dot(b);
    sine += w(i) * (a.x() * b.y() - a.y() * b.x());
  }
  if (std::hypot(cosine, sine) > 0.0) fit->psi = std::atan2(sine, cosine);
  fit->t = e - Rotation(fit->psi) * p;
}

double WrapDeg(double degrees) {
  const double wrapped = std::fmod(degrees, 360.0);
  return wrapped < 0.0 ? wrapped + 360.0 : wrapped;
}

std::optional<Eigen::Isometry3d> PoseAt(const std::vector<StampedPose>& trajectory,
                                        std::int64_t stamp_ns) {
  constexpr std::int64_t kMaxGapNs = 2000000000LL;
  const auto after = std::lower_bound(
      trajectory.begin(), trajectory.end(), stamp_ns,
      [](const StampedPose& pose, std::int64_t stamp) { return pose.stamp_ns < stamp; });
  if (after == trajectory.end()) return std::nullopt;
  if (after->stamp_ns == stamp_ns) return after->T_map_lidar;
  if (after == trajectory.begin()) return std::nullopt;
  const auto before = std::prev(after);
  const std::int64_t gap = after->stamp_ns - before->stamp_ns;
  if (gap > kMaxGapNs) return std::nullopt;
  const double u = static_cast<double>(stamp_ns - before->stamp_ns) / static_cast<double>(gap);
  return InterpolateSe3(before->T_map_lidar, after->T_map_lidar, u);
}

}  // namespace

void GeoreferencerConfig::Validate() const {
  Require(default_sigma_m > 0.0, "default_sigma_m must be > 0");
  Require(min_sigma_m > 0.0, "min_sigma_m must be > 0");
  Require(correlation_s > 0.0, "correlation_s must be > 0");
  Require(max_heading_sigma_deg > 0.0, "max_heading_sigma_deg must be > 0");
  Require(min_fixes >= 1, "min_fixes must be >= 1");
  Require(std::isfinite(antenna_x_m) && std::isfinite(antenna_y_m) && std::isfinite(antenna_z_m),
          "antenna_x_m, antenna_y_m, antenna_z_m must be finite");
}

GeoPosition Georeference::Locate(const Eigen::Vector3d& p_map) const {
  const GeographicLib::LocalCartesian plane(origin.latitude_deg, origin.longitude_deg,
                                            origin.altitude_m.value_or(0.0));
  // Without a heading all that is known of a point is that it is near the pivot; the origin is then
  // where the pivot was found.
  Eigen::Vector2d east_north = Eigen::Vector2d::Zero();
  if (heading_deg) {
    east_north = Rotation((90.0 - *heading_deg) * kDegToRad) * p_map.head<2>();
  }
  GeoPosition out;
  double altitude = 0.0;
  plane.Reverse(east_north.x(), east_north.y(), p_map.z(), out.latitude_deg, out.longitude_deg,
                altitude);
  if (origin.altitude_m) out.altitude_m = altitude;
  return out;
}

double Georeference::HorizontalSigma(const Eigen::Vector3d& p_map) const {
  const double distance = (p_map.head<2>() - pivot).norm();
  if (!heading_deg) return std::hypot(horizontal_sigma_m, distance);
  return std::hypot(horizontal_sigma_m, distance * heading_sigma_deg * kDegToRad);
}

Georeferencer::Georeferencer(const GeoreferencerConfig& config) : config_(config) {
  config_.Validate();
}

bool Georeferencer::Add(const GeoFix& fix) {
  if (!std::isfinite(fix.latitude_deg) || std::abs(fix.latitude_deg) > 90.0 ||
      !std::isfinite(fix.longitude_deg) || std::abs(fix.longitude_deg) > 360.0) {
    return false;
  }
  if (!fixes_.empty() && fix.stamp_ns <= fixes_.back().stamp_ns) return false;
  GeoFix sound = fix;
  if (sound.altitude_m && !std::isfinite(*sound.altitude_m)) sound.altitude_m.reset();
  const auto check_sigma = [](std::optional<double>* sigma) {
    if (*sigma && !(std::isfinite(**sigma) && **sigma > 0.0)) sigma->reset();
  };
  check_sigma(&sound.horizontal_sigma_m);
  check_sigma(&sound.vertical_sigma_m);
  fixes_.push_back(sound);
  return true;
}

std::optional<Georeference> Georeferencer::Solve(const std::vector<StampedPose>& trajectory) const {
  const Eigen::Vector3d antenna(config_.antenna_x_m, config_.antenna_y_m, config_.antenna_z_m);
  std::vector<Pair> pairs;
  std::vector<std::int64_t> stamps;
  std::optional<GeographicLib::LocalCartesian> plane;
  for (const GeoFix& fix : fixes_) {
    const auto T_map_lidar = PoseAt(trajectory, fix.stamp_ns);
    if (!T_map_lidar) continue;
    if (!plane) plane.emplace(fix.latitude_deg, fix.longitude_deg, fix.altitude_m.value_or(0.0));
    const Eigen::Vector3d p = *T_map_lidar * antenna;
    double east = 0.0, north = 0.0, up = 0.0;
    plane->Forward(fix.latitude_deg, fix.longitude_deg, fix.altitude_m.value_or(0.0), east, north, up);
    Pair pair;
    pair.map = p.head<2>();
    pair.map_z = p.z();
    pair.east_north = {east, north};
    pair.altitude_m = fix.altitude_m;
    pair.sigma_m = std::max(config_.min_sigma_m, fix.horizontal_sigma_m.value_or(config_.default_sigma_m));
    pair.vertical_sigma_m =
        std::max(config_.min_sigma_m, fix.vertical_sigma_m.value_or(2.0 * pair.sigma_m));
    pairs.push_back(pair);
    stamps.push_back(fix.stamp_ns);
  }
  if (static_cast<int>(pairs.size()) < config_.min_fixes) return std::nullopt;
  // How many of its neighbours say the same.
  for (std::size_t i = 0; i < pairs.size(); ++i) {
    const std::int64_t reach = static_cast<std::int64_t>(1e9 * config_.correlation_s);
    const auto low = std::lower_bound(stamps.begin(), stamps.end(), stamps[i] - reach);
    const auto high = std::upper_bound(stamps.begin(), stamps.end(), stamps[i] + reach);
    pairs[i].share = 1.0 / static_cast<double>(high - low);
  }

  Fit best;
  constexpr int kStarts = 72;
  for (int k = 0; k < kStarts; ++k) {
    Fit fit = StartAt(pairs, 2.0 * M_PI * k / kStarts);
    if (k == 0 || fit.cost < best.cost) best = std::move(fit);
  }
  for (int iteration = 0; iteration < 50; ++iteration) {
    const Fit before = best;
    Align(pairs, &best);
    Weigh(pairs, &best);
    if ((best.t - before.t).norm() < 1e-9 && std::abs(best.psi - before.psi) < 1e-12) break;
  }

  Georeference out;
  out.num_fixes = static_cast<int>(pairs.size());
  const Eigen::Matrix2d R = Rotation(best.psi);
  double sum = 0.0;
  double chi2 = 0.0;
  double dof_sum = 0.0;
  double residual2 = 0.0;
  int inliers = 0;
  for (std::size_t i = 0; i < pairs.size(); ++i) {
    const double w = best.weight[i] * pairs[i].share / (pairs[i].sigma_m * pairs[i].sigma_m);
    sum += w;
    out.pivot += w * pairs[i].map;
    const double r2 = (pairs[i].east_north - R * pairs[i].map - best.t).squaredNorm();
    chi2 += best.weight[i] * pairs[i].share * r2 / (pairs[i].sigma_m * pairs[i].sigma_m);
    dof_sum += best.weight[i] * pairs[i].share;
    constexpr double kOutlier = 0.3;  // Some four sigmas off.
    if (best.weight[i] < kOutlier) {
      ++out.num_outliers;
    } else {
      residual2 += r2;
      ++inliers;
    }
  }
  out.pivot /= sum;
  double spread = 0.0;
  double span2 = 0.0;
  for (std::size_t i = 0; i < pairs.size(); ++i) {
    const double w = best.weight[i] * pairs[i].share / (pairs[i].sigma_m * pairs[i].sigma_m);
    const double d2 = (pairs[i].map - out.pivot).squaredNorm();
    spread += w * d2;
    span2 += w / sum * d2;
  }
  out.span_m = std::sqrt(span2);
  out.residual_m = inliers > 0 ? std::sqrt(residual2 / inliers) : 0.0;
  // Per axis; never better than the receiver says.
  const double scale = std::max(1.0, chi2 / (2.0 * std::max(dof_sum, 1e-9)));
  out.horizontal_sigma_m = std::sqrt(scale / sum);
  const double heading_sigma_rad = spread > 0.0 ? std::sqrt(scale / spread) : M_PI;
  out.heading_sigma_deg = std::min(180.0, heading_sigma_rad / kDegToRad);

  double altitude_sum = 0.0;
  double altitude_weight = 0.0;
  for (std::size_t i = 0; i < pairs.size(); ++i) {
    if (!pairs[i].altitude_m) continue;
    const double w = best.weight[i] * pairs[i].share /
                     (pairs[i].vertical_sigma_m * pairs[i].vertical_sigma_m);
    altitude_sum += w * (*pairs[i].altitude_m - pairs[i].map_z);
    altitude_weight += w;
  }

  const bool heading_known = out.heading_sigma_deg <= config_.max_heading_sigma_deg;
  // The origin of the map; without a heading it stands for the pivot, which is known.
  const Eigen::Vector2d origin = heading_known ? best.t : Eigen::Vector2d(R * out.pivot + best.t);
  double altitude = 0.0;
  plane->Reverse(origin.x(), origin.y(), 0.0, out.origin.latitude_deg, out.origin.longitude_deg,
                 altitude);
  if (altitude_weight > 0.0) {
    out.origin.altitude_m = altitude_sum / altitude_weight;
    out.vertical_sigma_m = std::sqrt(1.0 / altitude_weight);
  }
  if (heading_known) {
    out.heading_deg = WrapDeg(90.0 - best.psi / kDegToRad);
  } else {
    // The heading's sigma is the position's over the extent of the walk.
    std::array<char, 256> text{};
    const double needed =
        out.horizontal_sigma_m / (config_.max_heading_sigma_deg * kDegToRad);
    std::snprintf(text.data(), text.size(),
                  "the heading is not known: the walk extends over %.1f m (RMS) only, for fixes this good "
                  "it takes about %.0f m; all trees are put where the walk was, +-%.1f m",
                  out.span_m, std::ceil(needed), std::hypot(out.horizontal_sigma_m, out.span_m));
    out.note = text.data();
  }
  return out;
}

}  // namespace dendro
