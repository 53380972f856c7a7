#pragma once

#include "dendro_slam/factor_graph/factor.h"

/// What holds a map upright and at its height besides the trees: gravity, as visual-inertial odometry
/// sees it, and the ground. Trunks lean and bend; a map that took them for straight lines would tilt.
namespace dendro {

/// Direction of the map's z axis as a pose sees it: `r = B^T R^T e_z`, shape (2) [rad], with R the
/// pose's rotation and B a basis perpendicular to the measured direction. Heading is left free.
class GravityFactor final : public TypedFactor<Eigen::Isometry3d> {
 public:
  /// @param up_sensor  Measured direction of up in the sensor frame, of unit length.
  /// @param noise      Of the two tilt angles [rad], dimension 2.
  /// @throws std::invalid_argument if the direction is not a unit vector or the dimension differs.
  GravityFactor(Key pose, const Eigen::Vector3d& up_sensor, const NoiseModel& noise);
  void Evaluate(const Value* const* values, double* residual, double* jacobian) const override;

 private:
  const char* Kind() const override { return "gravity"; }
  Eigen::Vector3d up_sensor_;
  Eigen::Matrix<double, 3, 2> basis_;
};

/// The ground seen from a pose. The ground of the map is a plane `z = c + a x + b y`, a PointN
/// (c, a, b); the residual, shape (3), is the height of the sensor above it minus the measured one
/// [m] and the two angles between the normals [rad].
class GroundFactor final : public TypedFactor<Eigen::Isometry3d, PointN> {
 public:
  /// @param normal_sensor  Measured upward normal in the sensor frame, of unit length.
  /// @param height_m       Measured distance of the sensor from the plane.
  /// @param noise          Dimension 3: height [m], then two angles [rad].
  /// @throws std::invalid_argument if a number is not finite, the normal not of unit length, or the
  ///         dimension differs.
  GroundFactor(Key pose,
               Key ground,
               const Eigen::Vector3d& normal_sensor,
               double height_m,
               const NoiseModel& noise);
  void Evaluate(const Value* const* values, double* residual, double* jacobian) const override;

 private:
  const char* Kind() const override { return "ground"; }
  Eigen::Vector3d normal_sensor_;
  Eigen::Matrix<double, 3, 2> basis_;
  double height_m_;
};

}  // namespace dendro
