#include "dendro_slam/mapping/tree_map.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>
#include <utility>

#include <Eigen/Cholesky>

#include "dendro_slam/factor_graph/cylinder_factor.h"

namespace dendro {

namespace {

constexpr double kTwoPi = 6.283185307179586;
constexpr double kRadPerDeg = 0.017453292519943295;
// Taper that an observation too short to show its own may have (a trunk's is about a per cent, a
// branch's base or a buttress several) [m/m].
constexpr double kUnknownTaperSigma = 0.02;

void Require(bool ok, const char* message) {
  if (!ok) throw std::invalid_argument(std::string("TreeMapConfig: ") + message);
}

// Direction from the axis to a point, as an angle in the axis' perpendicular basis.
double AngleAround(const Cylinder& line, const Eigen::Vector3d& point) {
  const Eigen::Vector2d d = PerpendicularBasis(line.axis).transpose() * (point - line.point);
  return std::atan2(d.y(), d.x());
}

int CellOf(double s, double cell) { return static_cast<int>(std::floor(s / cell)); }

// Counts the cells from s_begin to s_end once.
void Cover(LandmarkState* state, double s_begin, double s_end, double cell) {
  const int first = CellOf(s_begin, cell);
  const int last = std::max(first, CellOf(s_end - 1e-9, cell));
  if (state->coverage.empty()) state->first_cell = first;
  if (first < state->first_cell) {
    state->coverage.insert(
        state->coverage.begin(), static_cast<std::size_t>(state->first_cell - first), 0);
    state->first_cell = first;
  }
  const std::size_t needed = static_cast<std::size_t>(last - state->first_cell + 1);
  if (state->coverage.size() < needed) state->coverage.resize(needed, 0);
  for (int k = first; k <= last; ++k) ++state->coverage[static_cast<std::size_t>(k - state->first_cell)];
}

// What lies so far from a landmark's line is on it [m].
constexpr double kOnLineM = 0.015;

struct Extent {
  double begin = 0.0, end = 0.0;
};

// From the first to the last cell with enough support. A tip is seen from fewer places than a
// middle, so the support wanted is a small share of the densest cell's.
Extent ExtentOf(const LandmarkState& state, const TreeMapConfig& config) {
  int densest = 0;
  for (int count : state.coverage) densest = std::max(densest, count);
  const int wanted = std::clamp(
      static_cast<int>(std::ceil(config.end_support * densest)), std::min(densest, 3), densest);
  int first = -1, last = -1;
  for (int k = 0; k < static_cast<int>(state.coverage.size()); ++k) {
    if (state.coverage[static_cast<std::size_t>(k)] < wanted) continue;
    if (first < 0) first = k;
    last = k;
  }
  Extent out;
  if (first < 0) return out;
  out.begin = (state.first_cell + first) * config.coverage_cell_m;
  out.end = (state.first_cell + last + 1) * config.coverage_cell_m;
  return out;
}

Landmark Summarize(const LandmarkState& state,
                   const TreeMapConfig& config,
                   const RadiusProfileConfig& profile_config) {
  const Extent extent = ExtentOf(state, config);
  const double middle = 0.5 * (extent.begin + extent.end);
  Landmark out;
  out.id = state.id;
  out.cylinder = state.line.Slid(middle);
  const Matrix5d J = CylinderSlideJacobian(state.line, middle);
  // The graph's line is the one nearest to all that was seen: the axis bends about it.
  const BentAxis bent = state.bend
                            .Solve(state.line.axis, profile_config.knot_spacing_m, config.bend_sigma_per_m)
                            .BesideChord(extent.begin, extent.end);
  out.covariance = J * state.covariance * J.transpose();
  out.s_min_m = extent.begin - middle;
  out.s_max_m = extent.end - middle;
  out.s_min_sigma_m = out.s_max_sigma_m = state.end_sigma_m;
  RadiusProfile cropped = state.profile;
  cropped.Crop(extent.begin, extent.end, profile_config);
  out.profile = cropped.Knots(profile_config);
  if (out.profile.empty()) out.profile = state.profile.Knots(profile_config);
  for (RadiusKnot& knot : out.profile) {
    if (!bent.straight()) {
      const Eigen::Vector3d from_anchor = state.line.point + knot.s_m * state.line.axis +
                                          bent.At(knot.s_m).offset - out.cylinder.point;
      knot.offset_m = from_anchor - from_anchor.dot(out.cylinder.axis) * out.cylinder.axis;
    }
    knot.s_m -= middle;
  }
  const double radius = out.RadiusAt(0.0);
  out.cylinder.curvature = 1.0 / radius;
  // The radius is the profile's business; the graph's curvature only helps the lines.
  const double sigma = out.RadiusSigmaAt(0.0) / (radius * radius);
  out.covariance.row(4).setZero();
  out.covariance.col(4).setZero();
  out.covariance(4, 4) = sigma * sigma;
  out.num_scans = state.num_scans;
  out.num_points = state.num_points;
  out.arc_seen = state.arc_seen;
  out.mean_abs_deviation_m = state.num_scans > 0 ? state.deviation_sum_m / state.num_scans : 0.0;
  out.confirmed = state.confirmed;
  return out;
}

// The part of a landmark from begin to end along its axis.
void Clip(double begin, double end, Landmark* landmark) {
  const double middle = 0.5 * (begin + end);
  const Matrix5d J = CylinderSlideJacobian(landmark->cylinder, middle);
  landmark->covariance = J * landmark->covariance * J.transpose();
  landmark->cylinder = landmark->cylinder.Slid(middle);
  const double radius = landmark->RadiusAt(middle);
  const double sigma = landmark->RadiusSigmaAt(middle) / (radius * radius);
  landmark->cylinder.curvature = 1.0 / radius;
  landmark->covariance.row(4).setZero();
  landmark->covariance.col(4).setZero();
  landmark->covariance(4, 4) = sigma * sigma;
  // The profile keeps its shape up to the new ends.
  std::vector<RadiusKnot> profile;
  for (const double s : {begin, end}) {
    RadiusKnot knot;
    knot.s_m = s;
    knot.radius_m = landmark->RadiusAt(s);
    knot.radius_sigma_m = landmark->RadiusSigmaAt(s);
    knot.num_scans = landmark->num_scans;
    knot.offset_m =
        landmark->PointAt(s) - landmark->cylinder.point - s * landmark->cylinder.axis;
    profile.push_back(knot);
  }
  for (const RadiusKnot& knot : landmark->profile) {
    if (knot.s_m > begin && knot.s_m < end) profile.insert(profile.end() - 1, knot);
  }
  for (RadiusKnot& knot : profile) knot.s_m -= middle;
  landmark->profile = std::move(profile);
  landmark->s_min_m = begin - middle;
  landmark->s_max_m = end - middle;
}

// True when `piece` runs close beside `other` over its whole length and was seen by next to none of the
// scans that saw the other, though it is not thinner: fits laid across two neighbours, no wood. Wood there
// would have been seen as often.
bool IsPhantomBeside(const Landmark& piece, const Landmark& other) {
  constexpr double kMaxAngleDeg = 35.0;
  constexpr double kMaxApartM = 0.25;
  constexpr double kThinnest = 0.75;  // Of the other's radius.
  constexpr int kFewerScans = 20;
  if (kFewerScans * piece.num_scans > other.num_scans) return false;
  if (piece.cylinder.radius() < kThinnest * other.cylinder.radius()) return false;
  if (std::abs(piece.cylinder.axis.dot(other.cylinder.axis)) < std::cos(kMaxAngleDeg * kRadPerDeg)) {
    return false;
  }
  for (const double s : {piece.s_min_m, piece.s_max_m}) {
    const Eigen::Vector3d p = piece.PointAt(s);
    const double t = (p - other.cylinder.point).dot(other.cylinder.axis);
    if (t < other.s_min_m || t > other.s_max_m || (p - other.PointAt(t)).norm() > kMaxApartM) return false;
  }
  return true;
}

// True when a place lies in the wood of a landmark.
bool IsInside(const Eigen::Vector3d& place, const Landmark& landmark) {
  constexpr double kThickestM = 1.0;  // Radius and bend together.
  const Eigen::Vector3d d = place - landmark.cylinder.point;
  const double reach = std::max(std::abs(landmark.s_min_m), std::abs(landmark.s_max_m)) + kThickestM;
  if (d.squaredNorm() > reach * reach) return false;
  const double s = d.dot(landmark.cylinder.axis);
  const double radius = landmark.RadiusAt(s);
  if (s < landmark.s_min_m - radius || s > landmark.s_max_m + radius) return false;
  return (place - landmark.PointAt(std::clamp(s, landmark.s_min_m, landmark.s_max_m))).norm() < radius;
}

// True when `piece` cuts the corner of an elbow: it begins in one of two pieces that meet and ends in the
// other, and fewer scans saw it than either.
bool CutsCorner(const Landmark& piece, const Landmark& a, const Landmark& b) {
  if (piece.num_scans >= std::min(a.num_scans, b.num_scans)) return false;
  const Eigen::Vector3d begin = piece.PointAt(piece.s_min_m), end = piece.PointAt(piece.s_max_m);
  if (!(IsInside(begin, a) && IsInside(end, b)) && !(IsInside(begin, b) && IsInside(end, a))) return false;
  return IsInside(a.PointAt(a.s_min_m), b) || IsInside(a.PointAt(a.s_max_m), b) ||
         IsInside(b.PointAt(b.s_min_m), a) || IsInside(b.PointAt(b.s_max_m), a);
}

}  // namespace

std::vector<Landmark> SeparatePieces(std::vector<Landmark> landmarks) {
  constexpr double kMaxAngleDeg = 20.0;
  constexpr double kMaxOffsetRadii = 0.8;
  constexpr double kTwigsApartM = 0.025;  // Thin wood side by side more closely is the same wood.
  constexpr double kMinRest = 0.25;  // A piece of which less is left lies within the other one.
  constexpr double kMinRestM = 0.1;
  // The same wood measured twice has one radius: a piece that stays in another's wood along this share of
  // the shorter one is no wood of its own if its radius differs by more than this, or if it was seen by
  // so much fewer scans.
  constexpr double kSameWoodRatio = 1.4;
  constexpr double kSameWoodShare = 0.4;
  constexpr int kFewerScans = 5;
  std::vector<bool> dropped(landmarks.size(), false);
  const auto length = [](const Landmark& l) { return l.s_max_m - l.s_min_m; };
  // Extent of b along a's axis.
  const auto extent_on = [](const Landmark& a, const Landmark& b) {
    const Eigen::Vector3d d = b.cylinder.point - a.cylinder.point;
    const double s = d.dot(a.cylinder.axis), cosine = b.cylinder.axis.dot(a.cylinder.axis);
    return std::minmax({s + cosine * b.s_min_m, s + cosine * b.s_max_m});
  };
  // Neither end of `thin` leaves the cylinder of this radius round the line of `thick`.
  const auto stays_inside = [](const Landmark& thin, const Landmark& thick, double radius) {
    for (const double s : {thin.s_min_m, thin.s_max_m}) {
      const Eigen::Vector3d d =
          thin.cylinder.point + s * thin.cylinder.axis - thick.cylinder.point;
      if ((d - d.dot(thick.cylinder.axis) * thick.cylinder.axis).norm() > radius) return false;
    }
    return true;
  };
  for (std::size_t k = 0; k < landmarks.size(); ++k) {
    const Eigen::Vector3d begin = landmarks[k].PointAt(landmarks[k].s_min_m);
    const Eigen::Vector3d end = landmarks[k].PointAt(landmarks[k].s_max_m);
    std::vector<std::size_t> around;  // that an end of this one lies in
    for (std::size_t i = 0; i < landmarks.size(); ++i) {
      if (i != k && !dropped[i] && (IsInside(begin, landmarks[i]) || IsInside(end, landmarks[i]))) {
        around.push_back(i);
      }
    }
    for (const std::size_t i : around) {
      for (const std::size_t j : around) {
        if (i < j && CutsCorner(landmarks[k], landmarks[i], landmarks[j])) dropped[k] = true;
      }
    }
  }
  for (std::size_t i = 0; i < landmarks.size(); ++i) {
    for (std::size_t j = i + 1; j < landmarks.size() && !dropped[i]; ++j) {
      if (dropped[j]) continue;
      Landmark& a = landmarks[i];
      Landmark& b = landmarks[j];
      if (IsPhantomBeside(a, b) || IsPhantomBeside(b, a)) {
        dropped[a.num_scans < b.num_scans ? i : j] = true;
        continue;
      }
      if (std::abs(a.cylinder.axis.dot(b.cylinder.axis)) < std::cos(kMaxAngleDeg * kRadPerDeg)) {
        continue;
      }
      const std::pair<double, double> on_a = extent_on(a, b), on_b = extent_on(b, a);
      const double begin = std::max(a.s_min_m, on_a.first), end = std::min(a.s_max_m, on_a.second);
      if (end <= begin) continue;
      const double middle = 0.5 * (begin + end);
      const Eigen::Vector3d p = a.PointAt(middle);
      const double s_b = (p - b.cylinder.point).dot(b.cylinder.axis);
      const Eigen::Vector3d d = p - b.PointAt(s_b);
      const double offset = (d - d.dot(b.cylinder.axis) * b.cylinder.axis).norm();
      const double ra = a.RadiusAt(middle), rb = b.RadiusAt(s_b);
      if (offset > std::max(kMaxOffsetRadii * std::max(ra, rb), kTwigsApartM)) continue;
      const bool differ =
          std::max(ra, rb) > kSameWoodRatio * std::min(ra, rb) &&
          std::abs(ra - rb) > 2.0 * std::hypot(a.RadiusSigmaAt(middle), b.RadiusSigmaAt(s_b));
      const bool hardly_seen =
          kFewerScans * std::min(a.num_scans, b.num_scans) < std::max(a.num_scans, b.num_scans);
      const bool a_is_part = hardly_seen ? a.num_scans < b.num_scans : ra < rb;
      if ((differ || hardly_seen) &&
          end - begin > kSameWoodShare * std::min(length(a), length(b)) &&
          (a_is_part ? stays_inside(a, b, std::max({ra, rb, kTwigsApartM}))
                     : stays_inside(b, a, std::max({ra, rb, kTwigsApartM})))) {
        dropped[a.num_scans < b.num_scans ? i : j] = true;
        continue;
      }
      // What is left of each when cut in the middle of the common stretch.
      const bool b_above = on_a.first + on_a.second > a.s_min_m + a.s_max_m;
      const bool a_above = on_b.first + on_b.second > b.s_min_m + b.s_max_m;
      const double rest_a = b_above ? begin - a.s_min_m : a.s_max_m - end;
      const double rest_b = length(b) - (end - begin);
      const bool a_within = rest_a < std::max(kMinRestM, kMinRest * length(a));
      const bool b_within = rest_b < std::max(kMinRestM, kMinRest * length(b));
      if (a_within || b_within) {
        // The shorter one, unless the longer one was hardly seen and most of it is over the same stretch.
        const bool a_less_seen = a.num_scans < b.num_scans;
        const bool drop_less_seen = hardly_seen && end - begin > 0.5 * length(a_less_seen ? a : b);
        dropped[(drop_less_seen ? a_less_seen : length(a) < length(b)) ? i : j] = true;
        continue;
      }
      const double cut_b = std::clamp(s_b, b.s_min_m, b.s_max_m);
      if (b_above) {
        Clip(a.s_min_m, middle, &a);
      } else {
        Clip(middle, a.s_max_m, &a);
      }
      if (a_above) {
        Clip(b.s_min_m, cut_b, &b);
      } else {
        Clip(cut_b, b.s_max_m, &b);
      }
    }
  }
  std::vector<Landmark> out;
  for (std::size_t i = 0; i < landmarks.size(); ++i) {
    if (!dropped[i]) out.push_back(std::move(landmarks[i]));
  }
  return out;
}

void TreeMapConfig::Validate() const {
  Require(confirm_scans >= 1, "confirm_scans must be >= 1");
  Require(confirm_ratio >= 0.0 && confirm_ratio <= 1.0, "confirm_ratio must be in [0, 1]");
  Require(confirm_scans_around >= 1, "confirm_scans_around must be >= 1");
  Require(confirm_arc_deg >= 0.0, "confirm_arc_deg must be >= 0");
  Require(confirm_radius_sigma_rel > 0.0, "confirm_radius_sigma_rel must be > 0");
  Require(confirm_radius_sigma_m >= 0.0, "confirm_radius_sigma_m must be >= 0");
  Require(candidate_max_gap_scans >= 1, "candidate_max_gap_scans must be >= 1");
  Require(candidate_gap_per_scan >= 1, "candidate_gap_per_scan must be >= 1");
  Require(max_length_m > 0.0, "max_length_m must be > 0");
  Require(bend_sigma_per_m > 0.0, "bend_sigma_per_m must be > 0");
  Require(coverage_cell_m > 0.0, "coverage_cell_m must be > 0");
  Require(end_support > 0.0 && end_support <= 1.0, "end_support must be in (0, 1]");
  Require(min_gap_m > 0.0, "min_gap_m must be > 0");
  Require(gap_support >= 0.0 && gap_support < 1.0, "gap_support must be in [0, 1)");
  Require(gap_min_scans >= 1, "gap_min_scans must be >= 1");
  Require(merge_gate_sigma > 0.0, "merge_gate_sigma must be > 0");
  Require(std::isfinite(merge_min_overlap), "merge_min_overlap must be finite");
  Require(merge_reach_m > 0.0, "merge_reach_m must be > 0");
  Require(merge_inside_overlap > 0.0, "merge_inside_overlap must be > 0");
  Require(merge_inside_angle_deg >= 0.0 && merge_inside_angle_deg < 90.0,
          "merge_inside_angle_deg must be in [0, 90)");
  Require(merge_inside_radii >= 0.0, "merge_inside_radii must be >= 0");
  Require(merge_inside_m >= 0.0, "merge_inside_m must be >= 0");
}

TreeMap::TreeMap(TreeMapConfig config, RadiusProfileConfig profile_config)
    : config_(config), profile_config_(profile_config) {
  config_.Validate();
  profile_config_.Validate();
}

LandmarkState* TreeMap::Find(int id) {
  auto it = std::lower_bound(states_.begin(), states_.end(), id, [](const LandmarkState& s, int i) {
    return s.id < i;
  });
  return it != states_.end() && it->id == id ? &*it : nullptr;
}

const LandmarkState* TreeMap::Find(int id) const { return const_cast<TreeMap*>(this)->Find(id); }

bool TreeMap::Has(int id) const { return Find(id) != nullptr; }

const LandmarkState& TreeMap::State(int id) const {
  const LandmarkState* state = Find(id);
  if (state == nullptr) {
    throw std::invalid_argument("TreeMap: no landmark with id " + std::to_string(id));
  }
  return *state;
}

int TreeMap::Add(const FittedCylinder& observation,
                 const Eigen::Isometry3d& T_map_lidar,
                 std::int64_t scan_number) {
  LandmarkState state;
  state.id = next_id_++;
  state.line = TransformCylinder(T_map_lidar, observation.cylinder);
  // A sign for people; from now on it is this landmark's own.
  const Eigen::Vector3d axis = DisplayAxis(state.line.axis);
  const Matrix5d J = CylinderTangentTransform(T_map_lidar, observation.cylinder);
  Matrix5d covariance = J * observation.covariance * J.transpose();
  if (axis.dot(state.line.axis) < 0.0) {
    const Matrix5d flip = CylinderTurnJacobian(state.line.axis, axis);
    covariance = flip * covariance * flip.transpose();
  }
  state.line.axis = axis;
  state.covariance = covariance;
  state.first_scan = scan_number;
  states_.push_back(std::move(state));
  Observe(states_.back().id, observation, T_map_lidar, scan_number);
  return states_.back().id;
}

void TreeMap::Observe(int id,
                      const FittedCylinder& observation,
                      const Eigen::Isometry3d& T_map_lidar,
                      std::int64_t scan_number) {
  LandmarkState* state = Find(id);
  if (state == nullptr) return;
  summaries_.erase(id);
  const Cylinder in_map = TransformCylinder(T_map_lidar, observation.cylinder);
  const double sign = in_map.axis.dot(state->line.axis) < 0.0 ? -1.0 : 1.0;
  const double s = (in_map.point - state->line.point).dot(state->line.axis);
  // Only the part of the observation that is this landmark's: as far to either side as from where it was
  // begun, and on to the branch's end where that lies on its line. A bent branch goes on as another landmark.
  const double reach = 0.5 * config_.max_length_m;
  const Extent known = ExtentOf(*state, config_);
  const auto within = [&](double end) {
    const double place = s + sign * end;
    if (std::abs(place) <= reach) return place;
    const Eigen::Vector3d d = in_map.point + end * in_map.axis - state->line.point;
    if ((d - d.dot(state->line.axis) * state->line.axis).norm() > kOnLineM) {
      return std::clamp(place, -reach, reach);
    }
    return std::clamp(place, std::min(-reach, known.end - config_.max_length_m),
                      std::max(reach, known.begin + config_.max_length_m));
  };
  const double a = within(observation.start_s_m);
  const double b = within(observation.end_s_m);

  RadiusProfile::Observation o;
  o.s_start_m = std::min(a, b);
  o.s_end_m = std::max(a, b);
  o.s_anchor_m = s;
  o.radius_m = observation.cylinder.radius();
  o.radius_sigma_m = observation.radius_sigma_m();
  if (observation.taper_estimated) {
    o.taper_m_per_m = sign * observation.taper_m_per_m;
    o.taper_sigma_m_per_m = observation.taper_sigma_m_per_m;
  } else {
    o.taper_sigma_m_per_m = kUnknownTaperSigma;
  }
  o.view_angle_rad = AngleAround(state->line, T_map_lidar.translation());
  o.distance_m = observation.distance_m;
  state->profile.Add(o, profile_config_);
  state->bend.Add(observation, T_map_lidar, o.s_start_m, o.s_end_m, profile_config_.knot_spacing_m);

  Cover(state, o.s_start_m, o.s_end_m, config_.coverage_cell_m);
  state->end_sigma_m = (state->end_sigma_m * state->num_scans + observation.end_sigma_m) /
                       (state->num_scans + 1);
  if (state->num_scans == 0 || state->last_scan != scan_number) ++state->num_scans;
  state->num_points += observation.num_points;
  state->deviation_sum_m += observation.mean_abs_deviation_m;
  // The arc with returns is centred on the viewing direction.
  const double half = 0.5 * observation.visible_arc_rad;
  const double bin = kTwoPi / Landmark::kArcBins;
  for (double angle = o.view_angle_rad - half; angle <= o.view_angle_rad + half + 1e-9;
       angle += std::max(1e-3, std::min(bin, half > 0.0 ? half : bin))) {
    const double turn = angle / kTwoPi - std::floor(angle / kTwoPi);
    state->arc_seen.set(std::min<std::size_t>(Landmark::kArcBins - 1,
                                              static_cast<std::size_t>(turn * Landmark::kArcBins)));
  }
  state->last_scan = scan_number;
}

void TreeMap::SetLine(int id, const Cylinder& line, const Matrix5d& covariance) {
  LandmarkState* state = Find(id);
  if (state == nullptr) return;
  const bool same = state->line.point == line.point && state->line.axis == line.axis &&
                    state->line.curvature == line.curvature && state->covariance == covariance;
  if (same) return;
  state->line = line;
  state->covariance = covariance;
  summaries_.erase(id);
}

std::vector<int> TreeMap::Promote(std::int64_t scan_number) {
  std::vector<int> drop;
  for (LandmarkState& state : states_) {
    if (state.confirmed) continue;
    const std::int64_t max_gap =
        std::min<std::int64_t>(config_.candidate_max_gap_scans,
                               static_cast<std::int64_t>(config_.candidate_gap_per_scan) * state.num_scans);
    if (scan_number - state.last_scan > max_gap) {
      drop.push_back(state.id);
      continue;
    }
    if (state.num_scans < config_.confirm_scans) continue;
    const double span = static_cast<double>(state.last_scan - state.first_scan + 1);
    const bool around = state.num_scans >= config_.confirm_scans_around &&
                        static_cast<double>(state.arc_seen.count()) * 360.0 / Landmark::kArcBins >=
                            config_.confirm_arc_deg;
    if (state.num_scans < config_.confirm_ratio * span && !around) continue;
    const std::vector<RadiusKnot> knots = state.profile.Knots(profile_config_);
    const bool known = std::any_of(knots.begin(), knots.end(), [&](const RadiusKnot& knot) {
      return knot.radius_sigma_m <= std::max(config_.confirm_radius_sigma_m,
                                             config_.confirm_radius_sigma_rel * knot.radius_m);
    });
    if (!known) continue;
    state.confirmed = true;
    summaries_.erase(state.id);
  }
  return drop;
}

void TreeMap::Remove(int id) {
  summaries_.erase(id);
  states_.erase(std::remove_if(states_.begin(),
                               states_.end(),
                               [id](const LandmarkState& state) { return state.id == id; }),
                states_.end());
}

std::optional<LandmarkMerge> TreeMap::FindDuplicate(
    const DataAssociationConfig& association) const {
  std::vector<const Landmark*> summaries;
  std::vector<double> thickest;
  for (const LandmarkState& state : states_) {
    summaries.push_back(&SummaryOf(state));
    double radius = summaries.back()->cylinder.radius();
    for (const RadiusKnot& knot : summaries.back()->profile) radius = std::max(radius, knot.radius_m);
    thickest.push_back(radius);
  }
  constexpr double kMaxSlope = 0.25;       // Sine of the largest angle, rounded up.
  constexpr double kMaxOffsetRadii = 1.5;  // Offsets are measured across either axis.
  constexpr double kMaxBendM = 0.2;        // Of an axis beside its straight line.
  DataAssociationConfig gates = association;
  gates.gate_sigma = config_.merge_gate_sigma;
  for (std::size_t i = 0; i < summaries.size(); ++i) {
    const Landmark& a = *summaries[i];
    for (std::size_t j = i + 1; j < summaries.size(); ++j) {
      const Landmark& b = *summaries[j];
      if (!a.confirmed && !b.confirmed) continue;
      if (std::abs(a.cylinder.axis.dot(b.cylinder.axis)) < 0.97) continue;
      const Eigen::Vector3d apart = b.cylinder.point - a.cylinder.point;
      const double along = apart.dot(a.cylinder.axis);
      if (std::abs(along) > config_.merge_reach_m) continue;
      // A bound on the offset that is looked at below, wherever along b it is taken.
      const double reach = kMaxSlope * std::max(std::abs(b.s_min_m), std::abs(b.s_max_m)) +
                           kMaxOffsetRadii *
                               std::max(std::max(0.5, config_.merge_inside_radii) *
                                            std::max(thickest[i], thickest[j]),
                                        config_.merge_inside_m) +
                           association.offset_sigma_floor_m + kMaxBendM;
      if (apart.squaredNorm() - along * along > reach * reach) continue;
      FittedCylinder as_observation;
      as_observation.status = FitStatus::kMeasured;
      as_observation.cylinder = b.cylinder;
      as_observation.covariance = b.covariance;
      as_observation.start_s_m = b.s_min_m;
      as_observation.end_s_m = b.s_max_m;
      const LineResidual r = ComputeLineResidual(
          as_observation, a, Eigen::Isometry3d::Identity(), Matrix6d::Zero(), gates);
      const double shorter = std::min(a.s_max_m - a.s_min_m, b.s_max_m - b.s_min_m);
      if (r.overlap_m < std::min(config_.merge_min_overlap, shorter)) continue;
      const double thicker = std::max(r.landmark_radius_m, r.radius_m);
      const double inside_m =
          std::max(config_.merge_inside_radii * thicker, config_.merge_inside_m);
      if (r.offset_m > std::max(0.5 * thicker, inside_m) + association.offset_sigma_floor_m) continue;
      if (thicker > association.max_radius_ratio * std::min(r.landmark_radius_m, r.radius_m) &&
          std::abs(r.landmark_radius_m - r.radius_m) >
              config_.merge_gate_sigma * r.radius_difference_sigma_m) {
        continue;
      }
      const double merged_length =
          (a.s_max_m - a.s_min_m) + (b.s_max_m - b.s_min_m) - std::max(0.0, r.overlap_m);
      if (merged_length > config_.max_length_m) continue;
      const double mahalanobis2 = r.residual.dot(r.covariance.ldlt().solve(r.residual));
      const double gate = config_.merge_gate_sigma * config_.merge_gate_sigma + 4.0;
      // Lines of a bent branch miss each other by more than their sigmas; but two branches cannot run
      // inside each other.
      const bool inside = r.overlap_m >= config_.merge_inside_overlap * shorter &&
                          r.angle_rad < config_.merge_inside_angle_deg * kRadPerDeg &&
                          r.offset_m < inside_m;
      if (!(mahalanobis2 <= gate) && !inside) continue;
      // A confirmed landmark is kept before a candidate, the older before the younger.
      const bool swap = b.confirmed && !a.confirmed;
      return swap ? LandmarkMerge{b.id, a.id} : LandmarkMerge{a.id, b.id};
    }
  }
  return std::nullopt;
}

void TreeMap::Merge(const LandmarkMerge& merge) {
  LandmarkState* keep = Find(merge.keep_id);
  const LandmarkState* drop = Find(merge.drop_id);
  if (keep == nullptr || drop == nullptr || keep == drop) return;
  summaries_.erase(merge.keep_id);
  const bool same_sign = keep->line.axis.dot(drop->line.axis) >= 0.0;
  const double offset = (drop->line.point - keep->line.point).dot(keep->line.axis);
  // Where the other's zero of the angle lies in this basis.
  const Eigen::Vector3d zero = PerpendicularBasis(drop->line.axis).col(0);
  const Eigen::Vector2d turned = PerpendicularBasis(keep->line.axis).transpose() * zero;
  const double turn = std::atan2(turned.y(), turned.x());
  keep->profile.Merge(drop->profile, offset, same_sign, turn, profile_config_);
  keep->bend.Merge(drop->bend, offset, same_sign, profile_config_.knot_spacing_m);
  const double cell = config_.coverage_cell_m;
  for (std::size_t k = 0; k < drop->coverage.size(); ++k) {
    if (drop->coverage[k] == 0) continue;
    const double middle = (drop->first_cell + static_cast<int>(k) + 0.5) * cell;
    const double s = offset + (same_sign ? middle : -middle);
    const int target = CellOf(s, cell);
    Cover(keep, (target + 0.25) * cell, (target + 0.75) * cell, cell);
    keep->coverage[static_cast<std::size_t>(target - keep->first_cell)] += drop->coverage[k] - 1;
  }
  for (int k = 0; k < Landmark::kArcBins; ++k) {
    if (!drop->arc_seen[static_cast<std::size_t>(k)]) continue;
    const double angle =
        (same_sign ? 1.0 : -1.0) * (k + 0.5) * kTwoPi / Landmark::kArcBins + turn;
    const double t = angle / kTwoPi - std::floor(angle / kTwoPi);
    keep->arc_seen.set(std::min<std::size_t>(Landmark::kArcBins - 1,
                                             static_cast<std::size_t>(t * Landmark::kArcBins)));
  }
  const int scans = keep->num_scans + drop->num_scans;
  keep->end_sigma_m =
      (keep->end_sigma_m * keep->num_scans + drop->end_sigma_m * drop->num_scans) /
      std::max(1, scans);
  keep->num_scans = scans;
  keep->num_points += drop->num_points;
  keep->deviation_sum_m += drop->deviation_sum_m;
  keep->first_scan = std::min(keep->first_scan, drop->first_scan);
  keep->last_scan = std::max(keep->last_scan, drop->last_scan);
  keep->confirmed = keep->confirmed || drop->confirmed;
  Remove(merge.drop_id);
}

std::optional<LandmarkSplit> TreeMap::FindSplit() const {
  for (const LandmarkState& state : states_) {
    const int n = static_cast<int>(state.coverage.size());
    if (n < 3) continue;
    const Extent extent = ExtentOf(state, config_);
    // Densest cell on the left of and including k; then the same from the right.
    std::vector<int> right(static_cast<std::size_t>(n) + 1, 0);
    for (int k = n - 1; k >= 0; --k) {
      right[static_cast<std::size_t>(k)] =
          std::max(right[static_cast<std::size_t>(k) + 1], state.coverage[static_cast<std::size_t>(k)]);
    }
    int left = 0;
    int gap_first = -1;
    for (int k = 0; k < n; ++k) {
      const int count = state.coverage[static_cast<std::size_t>(k)];
      const int sides = std::min(left, right[static_cast<std::size_t>(k) + 1]);
      const bool low = sides >= config_.gap_min_scans && count < config_.gap_support * sides;
      if (low && gap_first < 0) gap_first = k;
      if (!low && gap_first >= 0) {
        const double begin = (state.first_cell + gap_first) * config_.coverage_cell_m;
        const double end = (state.first_cell + k) * config_.coverage_cell_m;
        if (end - begin >= config_.min_gap_m && begin > extent.begin && end < extent.end) {
          return LandmarkSplit{state.id, begin, end};
        }
        gap_first = -1;
      }
      left = std::max(left, count);
    }
  }
  return std::nullopt;
}

std::pair<int, bool> TreeMap::Split(const LandmarkSplit& split) {
  LandmarkState* state = Find(split.landmark_id);
  if (state == nullptr) {
    throw std::invalid_argument("TreeMap: no landmark with id " + std::to_string(split.landmark_id));
  }
  summaries_.erase(split.landmark_id);
  const double cell = config_.coverage_cell_m;
  const double middle = 0.5 * (split.gap_begin_m + split.gap_end_m);
  LandmarkState below = *state, above = *state;
  const int cut = CellOf(middle, cell) - state->first_cell;
  below.coverage.resize(static_cast<std::size_t>(std::max(0, cut)));
  above.coverage.erase(above.coverage.begin(), above.coverage.begin() + std::max(0, cut));
  above.first_cell = state->first_cell + std::max(0, cut);
  below.profile.Crop(-1e9, split.gap_begin_m, profile_config_);
  above.profile.Crop(split.gap_end_m, 1e9, profile_config_);
  const auto densest = [](const std::vector<int>& coverage) {
    int most = 0;
    for (int count : coverage) most = std::max(most, count);
    return most;
  };
  const int scans_below = densest(below.coverage), scans_above = densest(above.coverage);
  below.num_scans = std::min(state->num_scans, scans_below);
  above.num_scans = std::min(state->num_scans, scans_above);
  const double share =
      static_cast<double>(scans_below) / std::max(1, scans_below + scans_above);
  below.num_points = static_cast<int>(state->num_points * share);
  above.num_points = state->num_points - below.num_points;
  below.deviation_sum_m = state->deviation_sum_m * below.num_scans / std::max(1, state->num_scans);
  above.deviation_sum_m = state->deviation_sum_m * above.num_scans / std::max(1, state->num_scans);
  const bool new_is_above = scans_below >= scans_above;
  LandmarkState& fresh = new_is_above ? above : below;
  fresh.id = next_id_++;
  const int fresh_id = fresh.id;
  *state = new_is_above ? below : above;
  states_.push_back(new_is_above ? std::move(above) : std::move(below));
  return {fresh_id, new_is_above};
}

const Landmark& TreeMap::SummaryOf(const LandmarkState& state) const {
  const auto it = summaries_.find(state.id);
  if (it != summaries_.end()) return it->second;
  return summaries_.emplace(state.id, Summarize(state, config_, profile_config_)).first->second;
}

Landmark TreeMap::Summary(int id) const { return SummaryOf(State(id)); }

std::vector<Landmark> TreeMap::Landmarks(bool with_candidates) const {
  std::vector<Landmark> out;
  for (const LandmarkState& state : states_) {
    if (state.confirmed || with_candidates) out.push_back(SummaryOf(state));
  }
  return out;
}

void TreeMap::Restore(std::vector<LandmarkState> states, int next_id) {
  states_ = std::move(states);
  summaries_.clear();
  next_id_ = next_id;
}

}  // namespace dendro
