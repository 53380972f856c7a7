#include "dendro_slam/mapping/landmark.h"

#include <algorithm>

#include "dendro_slam/mapping/axis_offset.h"

namespace dendro {

namespace {

// Linear interpolation of one field of the profile, constant beyond its ends.
double Interpolate(const std::vector<RadiusKnot>& profile, double s, double RadiusKnot::*field) {
  if (profile.empty()) return 0.0;
  if (s <= profile.front().s_m) return profile.front().*field;
  for (std::size_t i = 1; i < profile.size(); ++i) {
    if (s > profile[i].s_m) continue;
    const double span = profile[i].s_m - profile[i - 1].s_m;
    const double f = span > 0.0 ? (s - profile[i - 1].s_m) / span : 1.0;
    return (1.0 - f) * (profile[i - 1].*field) + f * (profile[i].*field);
  }
  return profile.back().*field;
}

// The offset at s and its slope: linear between the knots, the outer stretches go on beyond them.
AxisOffset Offset(const std::vector<RadiusKnot>& profile, double s) {
  if (profile.size() < 2) {
    return {profile.empty() ? Eigen::Vector3d::Zero() : profile.front().offset_m,
            Eigen::Vector3d::Zero()};
  }
  std::size_t i = 1;
  while (i + 1 < profile.size() && s > profile[i].s_m) ++i;
  const RadiusKnot& a = profile[i - 1];
  const RadiusKnot& b = profile[i];
  const double span = b.s_m - a.s_m;
  if (!(span > 1e-6)) return {b.offset_m, Eigen::Vector3d::Zero()};
  const Eigen::Vector3d slope = (b.offset_m - a.offset_m) / span;
  return {a.offset_m + (s - a.s_m) * slope, slope};
}

}  // namespace

double Landmark::RadiusAt(double s_m) const { return Interpolate(profile, s_m, &RadiusKnot::radius_m); }

double Landmark::RadiusSigmaAt(double s_m) const {
  return Interpolate(profile, s_m, &RadiusKnot::radius_sigma_m);
}

Eigen::Vector3d Landmark::PointAt(double s_m) const {
  return cylinder.point + s_m * cylinder.axis + Offset(profile, s_m).offset;
}

Eigen::Vector3d Landmark::AxisAt(double s_m) const {
  return (cylinder.axis + Offset(profile, s_m).slope).normalized();
}

Cylinder Landmark::LineOver(double s_begin_m, double s_end_m) const {
  Cylinder line = cylinder.Slid(0.5 * (s_begin_m + s_end_m));
  const bool straight = std::all_of(
      profile.begin(), profile.end(), [](const RadiusKnot& k) { return k.offset_m.isZero(0.0); });
  if (straight) return line;
  const AxisOffset chord =
      ChordOver(s_begin_m, s_end_m, [this](double s) { return Offset(profile, s); });
  line.point += chord.offset;
  line.axis = (line.axis + chord.slope).normalized();
  return line;
}

Landmark TransformLandmark(const Eigen::Isometry3d& T_a_b, const Landmark& landmark_b) {
  Landmark out = landmark_b;
  const Matrix5d J = CylinderTangentTransform(T_a_b, landmark_b.cylinder);
  out.covariance = J * landmark_b.covariance * J.transpose();
  out.cylinder = TransformCylinder(T_a_b, landmark_b.cylinder);
  for (RadiusKnot& knot : out.profile) knot.offset_m = T_a_b.linear() * knot.offset_m;
  return out;
}

}  // namespace dendro
