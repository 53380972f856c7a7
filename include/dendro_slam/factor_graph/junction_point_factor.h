#pragma once

#include "dendro_slam/factor_graph/factor.h"

/// Points on trees that can be met again: junctions and ends of branches. They make motion along an
/// axis observable, which cylinders alone do not (limitation 7.1 of the thesis).
namespace dendro {

/// A point landmark seen from a pose: `r = T_map_sensor^-1 * p_map - p_measured`, shape (3) [m].
class JunctionPointFactor final : public TypedFactor<Eigen::Isometry3d, Eigen::Vector3d> {
 public:
  /// @param p_sensor  Measured point in the sensor frame [m].
  /// @param noise     Of the point in the sensor frame, dimension 3.
  JunctionPointFactor(Key pose, Key point, const Eigen::Vector3d& p_sensor, const NoiseModel& noise);
  void Evaluate(const Value* const* values, double* residual, double* jacobian) const override;

 private:
  const char* Kind() const override { return "junction"; }
  Eigen::Vector3d p_sensor_;
};

/// A point landmark that lies on the axis of a cylinder landmark: `r = (I - a a^T)(p - anchor)`,
/// shape (3) of rank 2 [m]. Isotropic: the plane's basis does not matter.
class PointOnAxisFactor final : public TypedFactor<Cylinder, Eigen::Vector3d> {
 public:
  /// @param sigma_m  Of the distance to the axis in each direction [m].
  PointOnAxisFactor(Key cylinder, Key point, double sigma_m, const RobustKernel& kernel = {});
  void Evaluate(const Value* const* values, double* residual, double* jacobian) const override;

 private:
  const char* Kind() const override { return "point-on-axis"; }
};

}  // namespace dendro
