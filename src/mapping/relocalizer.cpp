#include "dendro_slam/mapping/relocalizer.h"

#include <algorithm>
#include <cmath>

#include <Eigen/Cholesky>

#include "dendro_slam/factor_graph/cylinder_factor.h"

namespace dendro {

namespace {

constexpr double kRadPerDeg = 0.017453292519943295;

// The points where two lines come closest.
struct Closest {
  Eigen::Vector3d on_a, on_b;
  double cosine = 0.0;
};

Closest ClosestPoints(const Cylinder& a, const Cylinder& b) {
  Closest out;
  out.cosine = a.axis.dot(b.axis);
  const Eigen::Vector3d d = b.point - a.point;
  const double denominator = std::max(1e-9, 1.0 - out.cosine * out.cosine);
  const double s = (d.dot(a.axis) - d.dot(b.axis) * out.cosine) / denominator;
  const double t = (d.dot(a.axis) * out.cosine - d.dot(b.axis)) / denominator;
  out.on_a = a.point + s * a.axis;
  out.on_b = b.point + t * b.axis;
  return out;
}

Eigen::Matrix3d FrameOf(const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
  Eigen::Matrix3d frame;
  frame.col(0) = (a + b).normalized();
  frame.col(2) = a.cross(b).normalized();
  frame.col(1) = frame.col(2).cross(frame.col(0));
  return frame;
}

struct Fit {
  double angle = 0.0, offset = 0.0;
  double s_loaded = 0.0;  // where they are compared, from the loaded anchor
};

// How a local cylinder lies on a loaded one under a motion; nothing if they do not agree.
std::optional<Fit> Compare(const Landmark& local,
                           const Landmark& loaded,
                           const Eigen::Isometry3d& T,
                           const RelocalizerConfig& config) {
  const Cylinder moved = TransformCylinder(T, local.cylinder);
  const double cosine = moved.axis.dot(loaded.cylinder.axis);
  Fit fit;
  fit.angle = std::acos(std::min(1.0, std::abs(cosine)));
  if (fit.angle > config.axis_deg * kRadPerDeg) return std::nullopt;
  const double sign = cosine < 0.0 ? -1.0 : 1.0;
  const double s = (moved.point - loaded.cylinder.point).dot(loaded.cylinder.axis);
  const double a = s + sign * local.s_min_m, b = s + sign * local.s_max_m;
  const double low = std::max(std::min(a, b), loaded.s_min_m);
  const double high = std::min(std::max(a, b), loaded.s_max_m);
  if (high - low < -config.offset_m) return std::nullopt;
  fit.s_loaded = 0.5 * (low + high);
  const double s_local = sign * (fit.s_loaded - s);
  const Eigen::Vector3d p = moved.point + s_local * moved.axis;
  const Eigen::Vector3d q = loaded.cylinder.point + fit.s_loaded * loaded.cylinder.axis;
  const Eigen::Vector3d d = p - q;
  fit.offset = (d - d.dot(loaded.cylinder.axis) * loaded.cylinder.axis).norm();
  if (fit.offset > config.offset_m) return std::nullopt;
  const double r1 = local.RadiusAt(s_local), r2 = loaded.RadiusAt(fit.s_loaded);
  if (std::max(r1 / r2, r2 / r1) > config.radius_ratio) return std::nullopt;
  return fit;
}

struct Verified {
  std::vector<std::pair<int, int>> matches;  // indices
  double cost = 0.0;
};

Verified Verify(const std::vector<Landmark>& local,
                const std::vector<Landmark>& loaded,
                const Eigen::Isometry3d& T,
                const RelocalizerConfig& config) {
  struct Pair {
    double cost;
    int a, b;
  };
  std::vector<Pair> pairs;
  for (std::size_t i = 0; i < local.size(); ++i) {
    for (std::size_t k = 0; k < loaded.size(); ++k) {
      const std::optional<Fit> fit = Compare(local[i], loaded[k], T, config);
      if (!fit) continue;
      const double angle = fit->angle / (config.axis_deg * kRadPerDeg);
      const double offset = fit->offset / config.offset_m;
      pairs.push_back(
          {angle * angle + offset * offset, static_cast<int>(i), static_cast<int>(k)});
    }
  }
  std::stable_sort(
      pairs.begin(), pairs.end(), [](const Pair& x, const Pair& y) { return x.cost < y.cost; });
  std::vector<bool> used(local.size(), false), taken(loaded.size(), false);
  Verified out;
  for (const Pair& pair : pairs) {
    if (used[static_cast<std::size_t>(pair.a)] || taken[static_cast<std::size_t>(pair.b)]) continue;
    used[static_cast<std::size_t>(pair.a)] = taken[static_cast<std::size_t>(pair.b)] = true;
    out.matches.emplace_back(pair.a, pair.b);
    out.cost += pair.cost;
  }
  return out;
}

// Least squares over all matched lines.
Eigen::Isometry3d Refine(const std::vector<Landmark>& local,
                         const std::vector<Landmark>& loaded,
                         const std::vector<std::pair<int, int>>& matches,
                         Eigen::Isometry3d T,
                         const RelocalizerConfig& config) {
  const double axis_sigma = config.axis_deg * kRadPerDeg, offset_sigma = config.offset_m;
  for (int iteration = 0; iteration < 8; ++iteration) {
    // A little damping: motion along all axes at once may be free.
    Matrix6d H = Matrix6d::Identity() * 1e-3;
    Vector6d g = Vector6d::Zero();
    for (const auto& [a, b] : matches) {
      const Landmark& mine = local[static_cast<std::size_t>(a)];
      const Landmark& theirs = loaded[static_cast<std::size_t>(b)];
      const std::optional<Fit> fit = Compare(mine, theirs, T, config);
      if (!fit) continue;
      const Cylinder moved = TransformCylinder(T, mine.cylinder);
      const double sign = moved.axis.dot(theirs.cylinder.axis) < 0.0 ? -1.0 : 1.0;
      const Eigen::Vector3d q =
          theirs.cylinder.point + fit->s_loaded * theirs.cylinder.axis;
      const double s_local = sign * (q - moved.point).dot(theirs.cylinder.axis);
      Eigen::Matrix<double, 5, 6> J;
      const Vector5d r = CylinderObservationResidual(
          mine.cylinder.Slid(s_local), T, theirs.cylinder.Slid(fit->s_loaded), &J, nullptr);
      Eigen::Vector4d w;
      w << 1.0 / axis_sigma, 1.0 / axis_sigma, 1.0 / offset_sigma, 1.0 / offset_sigma;
      const Eigen::Matrix<double, 4, 6> Jw = w.asDiagonal() * J.topRows<4>();
      const Eigen::Vector4d rw = w.asDiagonal() * r.head<4>();
      H += Jw.transpose() * Jw;
      g -= Jw.transpose() * rw;
    }
    const Vector6d step = H.ldlt().solve(g);
    if (!step.allFinite()) break;
    T = NormalizedSe3(T * ExpSe3(step));
    if (step.norm() < 1e-8) break;
  }
  return T;
}

// Height of a point above a plane given as z over x and y.
double Above(const Eigen::Vector3d& ground, const Eigen::Vector3d& p) {
  return p.z() - (ground[0] + ground[1] * p.x() + ground[2] * p.y());
}

}  // namespace

std::optional<Relocalization> Relocalize(const std::vector<Landmark>& local,
                                         const std::vector<Landmark>& loaded,
                                         const RelocalizerConfig& config) {
  struct Found {
    Eigen::Isometry3d T;
    Verified verified;
  };
  std::vector<Found> found;
  const auto distinct = [&](const Eigen::Isometry3d& a, const Eigen::Isometry3d& b) {
    const Vector6d d = LogSe3(a.inverse() * b);
    return d.head<3>().norm() > 3.0 * config.axis_deg * kRadPerDeg ||
           ((a.translation() - b.translation()).norm() > 4.0 * config.offset_m);
  };
  const double angle_tolerance = config.axis_deg * kRadPerDeg;
  const auto radius_agrees = [&](const Landmark& a, const Landmark& b) {
    // Extents may differ between the maps: any common radius will do here, Verify looks closer.
    double a_low = 1e9, a_high = 0.0, b_low = 1e9, b_high = 0.0;
    for (const RadiusKnot& k : a.profile) {
      a_low = std::min(a_low, k.radius_m);
      a_high = std::max(a_high, k.radius_m);
    }
    for (const RadiusKnot& k : b.profile) {
      b_low = std::min(b_low, k.radius_m);
      b_high = std::max(b_high, k.radius_m);
    }
    return a_low < b_high * config.radius_ratio && b_low < a_high * config.radius_ratio;
  };
  const bool ground_known = config.local_ground && config.loaded_ground;
  const bool two_are_enough =
      config.two_matches_margin > 0.0 && config.upright && ground_known;
  const int needed = two_are_enough ? std::min(2, config.min_matches) : config.min_matches;
  const auto ground_agrees = [&](const Eigen::Isometry3d& T, const Verified& verified) {
    if (!ground_known) return true;
    for (const auto& [a, b] : verified.matches) {
      const Eigen::Vector3d& p = local[static_cast<std::size_t>(a)].cylinder.point;
      const double difference = Above(*config.local_ground, p) - Above(*config.loaded_ground, T * p);
      if (std::abs(difference) > config.ground_m) return false;
    }
    return true;
  };
  // Angles and closest points of the loaded pairs, once.
  struct LoadedPair {
    int k, l;
    Closest closest;
  };
  std::vector<LoadedPair> loaded_pairs;
  for (int k = 0; k < static_cast<int>(loaded.size()); ++k) {
    for (int l = 0; l < static_cast<int>(loaded.size()); ++l) {
      if (k == l) continue;
      const Landmark& a = loaded[static_cast<std::size_t>(k)];
      const Landmark& b = loaded[static_cast<std::size_t>(l)];
      if ((a.cylinder.point - b.cylinder.point).norm() > 15.0) continue;
      const Closest closest = ClosestPoints(a.cylinder, b.cylinder);
      if (std::abs(closest.cosine) > 0.94) continue;
      loaded_pairs.push_back({k, l, closest});
    }
  }
  for (std::size_t i = 0; i < local.size(); ++i) {
    for (std::size_t j = i + 1; j < local.size(); ++j) {
      const Closest mine = ClosestPoints(local[i].cylinder, local[j].cylinder);
      if (std::abs(mine.cosine) > 0.94) continue;
      const double my_distance = (mine.on_b - mine.on_a).norm();
      const double my_angle = std::acos(std::abs(mine.cosine));
      for (const LoadedPair& pair : loaded_pairs) {
        const double their_distance = (pair.closest.on_b - pair.closest.on_a).norm();
        if (std::abs(their_distance - my_distance) > 2.0 * config.offset_m) continue;
        const double their_angle = std::acos(std::abs(pair.closest.cosine));
        if (std::abs(their_angle - my_angle) > 1.5 * angle_tolerance) continue;
        const Landmark& k = loaded[static_cast<std::size_t>(pair.k)];
        const Landmark& l = loaded[static_cast<std::size_t>(pair.l)];
        if (!radius_agrees(local[i], k) || !radius_agrees(local[j], l)) continue;
        for (double s1 : {1.0, -1.0}) {
          for (double s2 : {1.0, -1.0}) {
            const double cosine = s1 * s2 * pair.closest.cosine;
            if (std::abs(std::acos(std::clamp(cosine, -1.0, 1.0)) -
                         std::acos(std::clamp(mine.cosine, -1.0, 1.0))) > 1.5 * angle_tolerance) {
              continue;
            }
            Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
            T.linear() = FrameOf(s1 * k.cylinder.axis, s2 * l.cylinder.axis) *
                         FrameOf(local[i].cylinder.axis, local[j].cylinder.axis).transpose();
            if (config.upright && T.linear()(2, 2) < std::cos(config.tilt_deg * kRadPerDeg)) continue;
            T.translation() = 0.5 * (pair.closest.on_a + pair.closest.on_b) -
                              T.linear() * (0.5 * (mine.on_a + mine.on_b));
            if ((T * mine.on_a - pair.closest.on_a).norm() > 2.0 * config.offset_m) continue;
            RelocalizerConfig loose = config;
            loose.axis_deg *= 1.5;
            loose.offset_m *= 1.5;
            Verified verified = Verify(local, loaded, T, loose);
            if (static_cast<int>(verified.matches.size()) < needed) continue;
            T = Refine(local, loaded, verified.matches, T, loose);
            verified = Verify(local, loaded, T, config);
            if (static_cast<int>(verified.matches.size()) < needed) continue;
            if (!ground_agrees(T, verified)) continue;
            bool known = false;
            for (Found& f : found) {
              if (distinct(f.T, T)) continue;
              known = true;
              if (verified.matches.size() > f.verified.matches.size() ||
                  (verified.matches.size() == f.verified.matches.size() &&
                   verified.cost < f.verified.cost)) {
                f = {T, verified};
              }
              break;
            }
            if (!known) found.push_back({T, verified});
          }
        }
      }
    }
  }
  if (found.empty()) return std::nullopt;
  std::stable_sort(found.begin(), found.end(), [](const Found& a, const Found& b) {
    if (a.verified.matches.size() != b.verified.matches.size()) {
      return a.verified.matches.size() > b.verified.matches.size();
    }
    return a.verified.cost < b.verified.cost;
  });
  const Found& best = found.front();
  const double share =
      static_cast<double>(best.verified.matches.size()) / static_cast<double>(local.size());
  if (share < config.min_share) return std::nullopt;
  if (static_cast<int>(best.verified.matches.size()) < config.min_matches) {
    // So few could agree by chance: nothing else may agree, and they must agree well.
    RelocalizerConfig strict = config;
    strict.axis_deg /= config.two_matches_margin;
    strict.offset_m /= config.two_matches_margin;
    strict.radius_ratio = 1.0 + (config.radius_ratio - 1.0) / config.two_matches_margin;
    strict.ground_m /= config.two_matches_margin;
    if (found.size() > 1) return std::nullopt;
    if (Verify(local, loaded, best.T, strict).matches.size() < best.verified.matches.size()) {
      return std::nullopt;
    }
  }
  if (found.size() > 1 && found[1].verified.matches.size() == best.verified.matches.size() &&
      distinct(best.T, found[1].T)) {
    return std::nullopt;  // two places fit as well
  }
  Relocalization out;
  out.T_map_local = best.T;
  out.cost = best.verified.cost;
  for (const auto& [a, b] : best.verified.matches) {
    out.matches.emplace_back(local[static_cast<std::size_t>(a)].id,
                             loaded[static_cast<std::size_t>(b)].id);
  }
  return out;
}

}  // namespace dendro
