#pragma once

#include "dendro_slam/factor_graph/factor.h"

/// Observations of a cylinder landmark from a pose.
///
/// The landmark, brought into the sensor frame, is compared with the measured cylinder in the
/// measured cylinder's own tangent coordinates (Cylinder::LocalCoordinates): the axes without their
/// sign in the tangent plane of the measured axis, the lines where the landmark pierces the plane
/// through the measured anchor perpendicular to the measured axis, and the curvatures. The anchor
/// is the centre of the observed segment, where axis and offset errors are nearly uncorrelated.
/// Nothing constrains motion along the axis.
///
/// @note Deviates: the thesis' normal factor (4.8, 4.9) compares feet of perpendiculars from the
///       sensor, which pulls on motion along the axis; its axis factor flips with the sign rule.
namespace dendro {

/// Which parts of an observation count, and how much. A weight multiplies the information.
struct CylinderParts {
  bool axis = true;
  bool normal = true;
  bool curvature = true;
  double axis_weight = 1.0;       ///< > 0.
  double normal_weight = 1.0;     ///< > 0.
  double curvature_weight = 1.0;  ///< > 0.
};

/// One observation looked at part by part.
struct CylinderResidual {
  Eigen::Vector2d axis = Eigen::Vector2d::Zero();    ///< Predicted minus measured [rad].
  Eigen::Vector2d normal = Eigen::Vector2d::Zero();  ///< Displacement at the observed centre [m].
  double curvature = 0.0;                            ///< [1/m].
  double axis_chi2 = 0.0;       ///< Squared Mahalanobis norm under the fit's covariance, 2 dof.
  double normal_chi2 = 0.0;     ///< 2 dof.
  double curvature_chi2 = 0.0;  ///< 1 dof.
  double chi2 = 0.0;            ///< All five under the full covariance, 5 dof.
};

/// The combined factor of one observation (pose, landmark): 5 residuals, whitened together by the
/// fit's covariance. Parts that are switched off have zero rows; the others keep their marginal
/// covariance.
class CylinderFactor final : public TypedFactor<Eigen::Isometry3d, Cylinder> {
 public:
  /// @param measured    In the sensor frame; anchor at the middle of the observed stretch.
  /// @param covariance  Of the 5 tangent coordinates of `measured`.
  /// @throws std::invalid_argument for a non-finite measurement, a covariance that is not positive
  ///         definite, a weight that is not positive, or no part at all.
  CylinderFactor(Key pose,
                 Key landmark,
                 const Cylinder& measured,
                 const Matrix5d& covariance,
                 const CylinderParts& parts = {},
                 const RobustKernel& kernel = {});

  const Cylinder& measured() const { return measured_; }
  const CylinderParts& parts() const { return parts_; }
  /// The fit's covariance as given.
  Matrix5d covariance() const { return covariance_; }

  /// Residual and chi2 of every part, also of those that are switched off.
  CylinderResidual Inspect(const Eigen::Isometry3d& T_map_sensor, const Cylinder& landmark) const;

  /// The parts whose chi2 is within its gate; the others are switched off in the result.
  CylinderParts Gate(const Eigen::Isometry3d& T_map_sensor,
                     const Cylinder& landmark,
                     double axis_gate_chi2,
                     double normal_gate_chi2,
                     double curvature_gate_chi2) const;

  void Evaluate(const Value* const* values, double* residual, double* jacobian) const override;

 private:
  const char* Kind() const override { return "cylinder"; }

  Cylinder measured_;
  Matrix5d covariance_;
  CylinderParts parts_;
};

/// Residual and chi2 of an observation without a factor, for data association.
CylinderResidual InspectCylinder(const Cylinder& measured,
                                 const Matrix5d& covariance,
                                 const Eigen::Isometry3d& T_map_sensor,
                                 const Cylinder& landmark);

/// Residual of an observation and its Jacobians, for the joint covariance of data association:
/// `S = J_pose P J_pose^T + ... + covariance`.
/// @param J_pose      Out, shape (5, 6), or null.
/// @param J_landmark  Out, shape (5, 5), or null.
Vector5d CylinderObservationResidual(const Cylinder& measured,
                                     const Eigen::Isometry3d& T_map_sensor,
                                     const Cylinder& landmark,
                                     Eigen::Matrix<double, 5, 6>* J_pose,
                                     Matrix5d* J_landmark);

/// Axis part alone (pose, landmark): 2 residuals [rad].
class AxisFactor final : public TypedFactor<Eigen::Isometry3d, Cylinder> {
 public:
  /// @param noise  Of the 2 axis coordinates.
  AxisFactor(Key pose, Key landmark, const Cylinder& measured, const NoiseModel& noise);
  void Evaluate(const Value* const* values, double* residual, double* jacobian) const override;

 private:
  const char* Kind() const override { return "axis"; }
  Cylinder measured_;
};

/// Normal part alone (pose, landmark): 2 residuals [m] at the centre of the observed segment.
class NormalFactor final : public TypedFactor<Eigen::Isometry3d, Cylinder> {
 public:
  /// @param noise  Of the 2 offset coordinates.
  NormalFactor(Key pose, Key landmark, const Cylinder& measured, const NoiseModel& noise);
  void Evaluate(const Value* const* values, double* residual, double* jacobian) const override;

 private:
  const char* Kind() const override { return "normal"; }
  Cylinder measured_;
};

/// Curvature part alone (landmark): 1 residual [1/m].
class CurvatureFactor final : public TypedFactor<Cylinder> {
 public:
  /// @param curvature  Measured [1/m].
  /// @param sigma      Of the curvature [1/m].
  CurvatureFactor(Key landmark, double curvature, double sigma, const RobustKernel& kernel = {});
  void Evaluate(const Value* const* values, double* residual, double* jacobian) const override;

 private:
  const char* Kind() const override { return "curvature"; }
  double curvature_;
};

}  // namespace dendro
