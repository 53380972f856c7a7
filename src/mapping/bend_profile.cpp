#include "dendro_slam/mapping/bend_profile.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include <Eigen/Cholesky>

#include "dendro_slam/mapping/knots.h"

namespace dendro {

BentAxis::BentAxis(int first, double spacing_m, std::vector<Eigen::Vector3d> second)
    : first_(first), spacing_m_(spacing_m), second_(std::move(second)) {
  // Integrated from the first knot; then the straight line that touches the course at s = 0 is
  // taken off.
  at_knot_.resize(second_.size());
  for (std::size_t k = 1; k < second_.size(); ++k) {
    const double h = spacing_m_;
    const Eigen::Vector3d& a = second_[k - 1];
    const Eigen::Vector3d& b = second_[k];
    at_knot_[k].slope = at_knot_[k - 1].slope + 0.5 * h * (a + b);
    at_knot_[k].offset =
        at_knot_[k - 1].offset + h * at_knot_[k - 1].slope + h * h * (a / 3.0 + b / 6.0);
  }
  if (second_.empty()) return;
  const AxisOffset zero = At(0.0);
  for (std::size_t k = 0; k < at_knot_.size(); ++k) {
    const double s = (first_ + static_cast<int>(k)) * spacing_m_;
    at_knot_[k].offset -= zero.offset + s * zero.slope;
    at_knot_[k].slope -= zero.slope;
  }
}

Eigen::Vector3d BentAxis::Second(double s) const {
  const double at = s / spacing_m_ - first_;
  const double last = static_cast<double>(second_.size() - 1);
  if (at <= 0.0) return second_.front();
  if (at >= last) return second_.back();
  const auto k = static_cast<std::size_t>(at);
  const double f = at - static_cast<double>(k);
  return (1.0 - f) * second_[k] + f * second_[k + 1];
}

AxisOffset BentAxis::At(double s) const {
  AxisOffset out;
  if (second_.empty()) return out;
  const double at = s / spacing_m_ - first_;
  const double last = static_cast<double>(second_.size() - 1);
  const auto k = static_cast<std::size_t>(std::clamp(at, 0.0, last));
  const double d = s - (first_ + static_cast<int>(k)) * spacing_m_;
  const Eigen::Vector3d& a = second_[k];
  const Eigen::Vector3d b = Second(s);
  // c'' runs linearly from a to b.
  out.slope = at_knot_[k].slope + 0.5 * d * (a + b);
  out.offset = at_knot_[k].offset + d * at_knot_[k].slope + d * d * (a / 3.0 + b / 6.0);
  return out;
}

AxisOffset BentAxis::Chord(double begin, double end) const {
  return ChordOver(begin, end, [this](double s) { return At(s); });
}

BentAxis BentAxis::BesideChord(double begin, double end) const {
  BentAxis out = *this;
  const AxisOffset chord = Chord(begin, end);
  for (std::size_t k = 0; k < out.at_knot_.size(); ++k) {
    const double s = (first_ + static_cast<int>(k)) * spacing_m_;
    out.at_knot_[k].offset -= chord.offset + (s - 0.5 * (begin + end)) * chord.slope;
    out.at_knot_[k].slope -= chord.slope;
  }
  return out;
}

void BendProfile::Add(const FittedCylinder& observation,
                      const Eigen::Isometry3d& T_map_lidar,
                      double s_begin_m,
                      double s_end_m,
                      double spacing_m) {
  if (observation.bend_information.isZero() || !observation.bend_information.allFinite() ||
      !observation.bend_vector.allFinite()) {
    return;
  }
  const Eigen::Matrix<double, 3, 2> B =
      T_map_lidar.linear() * PerpendicularBasis(observation.cylinder.axis);
  const Eigen::Matrix3d information = B * observation.bend_information * B.transpose();
  const Eigen::Vector3d vector = B * observation.bend_vector;
  const auto [first, last] = KnotsBetween(s_begin_m, s_end_m, spacing_m);
  for (int k = first; k <= last; ++k) {
    Knot& knot = AtIndex(k, &knots_);
    knot.information += information;
    knot.vector += vector;
  }
}

void BendProfile::Merge(const BendProfile& other,
                        double offset_m,
                        bool same_sign,
                        double spacing_m) {
  const double sign = same_sign ? 1.0 : -1.0;
  for (const Knot& knot : other.knots_) {
    const double s = offset_m + sign * knot.index * spacing_m;
    Knot& mine = AtIndex(static_cast<int>(std::lround(s / spacing_m)), &knots_);
    mine.information += knot.information;
    mine.vector += knot.vector;
  }
}

BentAxis BendProfile::Solve(const Eigen::Vector3d& axis,
                            double spacing_m,
                            double prior_sigma_per_m) const {
  if (knots_.empty()) return {};
  const Eigen::Matrix3d prior =
      Eigen::Matrix3d::Identity() / (prior_sigma_per_m * prior_sigma_per_m);
  const int first = knots_.front().index, last = knots_.back().index;
  std::vector<Eigen::Vector3d> second(static_cast<std::size_t>(last - first + 1),
                                      Eigen::Vector3d::Zero());
  for (const Knot& knot : knots_) {
    const Eigen::Vector3d b = (knot.information + prior).ldlt().solve(knot.vector);
    second[static_cast<std::size_t>(knot.index - first)] = b - b.dot(axis) * axis;
  }
  // A knot that nothing covered lies on the way from one neighbour to the other.
  for (std::size_t k = 1; k < knots_.size(); ++k) {
    const int a = knots_[k - 1].index, b = knots_[k].index;
    for (int i = a + 1; i < b; ++i) {
      const double f = static_cast<double>(i - a) / (b - a);
      second[static_cast<std::size_t>(i - first)] =
          (1.0 - f) * second[static_cast<std::size_t>(a - first)] +
          f * second[static_cast<std::size_t>(b - first)];
    }
  }
  return BentAxis(first, spacing_m, std::move(second));
}

}  // namespace dendro
