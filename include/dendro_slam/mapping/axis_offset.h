#pragma once

#include <Eigen/Core>

namespace dendro {

/// The course of an axis beside a straight line: offset c(s) [m] and slope c'(s) at a place s.
struct AxisOffset {
  Eigen::Vector3d offset = Eigen::Vector3d::Zero();
  Eigen::Vector3d slope = Eigen::Vector3d::Zero();
};

/// The straight line with the least mean square distance from a course over a stretch: its offset at
/// the middle of the stretch, and its slope. Of a stretch without length: the course there.
/// @param course  Callable, `AxisOffset course(double s)`.
template <class Course>
AxisOffset ChordOver(double s_begin_m, double s_end_m, const Course& course) {
  constexpr int kSamples = 8;
  const double middle = 0.5 * (s_begin_m + s_end_m), length = s_end_m - s_begin_m;
  if (length < 1e-6) return course(middle);
  AxisOffset out;
  double weight = 0.0;
  for (int i = 0; i < kSamples; ++i) {
    const double t = (i + 0.5) / kSamples - 0.5;
    const Eigen::Vector3d offset = course(middle + t * length).offset;
    out.offset += offset / kSamples;
    out.slope += t * offset;
    weight += t * t;
  }
  out.slope /= weight * length;
  return out;
}

}  // namespace dendro
