#pragma once

#include <vector>

#include <Eigen/Core>

#include "dendro_slam/cylinder_fitting/fitted_cylinder.h"
#include "dendro_slam/geometry/se3.h"
#include "dendro_slam/mapping/axis_offset.h"

namespace dendro {

/// A bent axis as its second derivative along a straight one: c'' linear between the knots and constant
/// beyond them; c(0) = 0 and c'(0) = 0 at first. Across the straight axis, in its frame.
class BentAxis {
 public:
  BentAxis() = default;
  /// @param first   Index of the first knot, at `first * spacing_m`.
  /// @param second  c'' at the knots [1/m], one after the other.
  BentAxis(int first, double spacing_m, std::vector<Eigen::Vector3d> second);

  bool straight() const { return second_.empty(); }
  AxisOffset At(double s) const;
  /// The straight line with the least mean square distance from the stretch [begin, end] (ChordOver).
  AxisOffset Chord(double begin, double end) const;
  /// The same course beside its chord of a stretch in place of the line that touches it at s = 0.
  BentAxis BesideChord(double begin, double end) const;

 private:
  Eigen::Vector3d Second(double s) const;

  int first_ = 0;
  double spacing_m_ = 1.0;
  std::vector<Eigen::Vector3d> second_;
  std::vector<AxisOffset> at_knot_;
};

/// How a landmark bends, kept beside its straight line: a sum per knot of what the scans' fits say of
/// the second derivative of the axis. Vectors are in the map frame, so neither the sign of the axis
/// nor where the line lies matters. Plain data, for files.
class BendProfile {
 public:
  struct Knot {
    int index = 0;  ///< At index * spacing.
    Eigen::Matrix3d information = Eigen::Matrix3d::Zero();  ///< Sum over the fits [m^2].
    Eigen::Vector3d vector = Eigen::Vector3d::Zero();       ///< Sum of information times bend [m].
  };

  /// Adds a fit to every knot from s_begin to s_end (the nearest one if there is none between).
  /// @param observation  In the lidar frame.
  void Add(const FittedCylinder& observation,
           const Eigen::Isometry3d& T_map_lidar,
           double s_begin_m,
           double s_end_m,
           double spacing_m);

  /// Adds the sums of another landmark's.
  /// @param offset_m   Position of the other's anchor along this axis.
  /// @param same_sign  False: the other's axis points the other way.
  void Merge(const BendProfile& other, double offset_m, bool same_sign, double spacing_m);

  /// The course of the axis across `axis`, by least squares with a prior of a straight one.
  /// @param prior_sigma_per_m  Of the second derivative in each direction [1/m].
  BentAxis Solve(const Eigen::Vector3d& axis, double spacing_m, double prior_sigma_per_m) const;

  const std::vector<Knot>& knots() const { return knots_; }
  void set_knots(std::vector<Knot> knots) { knots_ = std::move(knots); }

 private:
  std::vector<Knot> knots_;  // ascending in index
};

}  // namespace dendro
