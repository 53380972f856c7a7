#include "dendro_slam/factor_graph/cylinder_factor.h"

#include <cmath>
#include <limits>
#include <stdexcept>
#include <vector>

#include <Eigen/Cholesky>

#include "cylinder_jacobians.h"
#include "dendro_slam/geometry/se3.h"
#include "dendro_slam/geometry/so3.h"

namespace dendro {

namespace {

void CheckMeasurement(const char* kind, Key landmark, const Cylinder& measured) {
  if (!IsValid(Value(measured))) {
    throw std::invalid_argument(std::string(kind) + " of " + KeyName(landmark) +
                                ": the measured cylinder is not finite or its axis not of unit length");
  }
}

void CheckNoise(const char* kind, Key landmark, const NoiseModel& noise, int dimension) {
  if (noise.dimension() != dimension) {
    throw std::invalid_argument(std::string(kind) + " of " + KeyName(landmark) +
                                ": the noise must have dimension " + std::to_string(dimension));
  }
}

// Square-root information of the active rows' marginal covariance; zero rows elsewhere.
NoiseModel PartsNoise(Key landmark, const Matrix5d& covariance, const CylinderParts& parts) {
  const std::string name = "cylinder factor of " + KeyName(landmark);
  const bool active[5] = {parts.axis, parts.axis, parts.normal, parts.normal, parts.curvature};
  const double weight[5] = {parts.axis_weight,
                            parts.axis_weight,
                            parts.normal_weight,
                            parts.normal_weight,
                            parts.curvature_weight};
  std::vector<int> rows;
  for (int i = 0; i < 5; ++i) {
    if (!active[i]) continue;
    if (!(std::isfinite(weight[i]) && weight[i] > 0.0)) {
      throw std::invalid_argument(name + ": the weights of its parts must be positive");
    }
    rows.push_back(i);
  }
  if (rows.empty()) throw std::invalid_argument(name + ": at least one part must be switched on");
  const int n = static_cast<int>(rows.size());
  Eigen::MatrixXd C(n, n);
  for (int i = 0; i < n; ++i) {
    for (int j = 0; j < n; ++j) {
      C(i, j) = covariance(rows[i], rows[j]) / std::sqrt(weight[rows[i]] * weight[rows[j]]);
    }
  }
  const NoiseModel::Matrix W = NoiseModel::Covariance(C).sqrt_information();
  Matrix5d full = Matrix5d::Zero();
  for (int i = 0; i < n; ++i) {
    for (int j = 0; j < n; ++j) full(rows[i], rows[j]) = W(i, j);
  }
  return NoiseModel::SqrtInformation(full);
}

template <int N>
double MarginalChi2(const Vector5d& r, const Matrix5d& covariance, int start) {
  const Eigen::Matrix<double, N, 1> e = r.segment<N>(start);
  const Eigen::Matrix<double, N, N> C = covariance.block<N, N>(start, start);
  const Eigen::LLT<Eigen::Matrix<double, N, N>> llt(C);
  if (llt.info() != Eigen::Success) return std::numeric_limits<double>::infinity();
  return llt.matrixL().solve(e).squaredNorm();
}

}  // namespace

Vector5d CylinderObservationResidual(const Cylinder& measured,
                                     const Eigen::Isometry3d& T_map_sensor,
                                     const Cylinder& landmark,
                                     Eigen::Matrix<double, 5, 6>* J_pose,
                                     Matrix5d* J_landmark) {
  const Eigen::Matrix3d R_sensor_map = T_map_sensor.linear().transpose();
  Cylinder predicted;
  predicted.axis = R_sensor_map * landmark.axis;
  predicted.point = R_sensor_map * (landmark.point - T_map_sensor.translation());
  predicted.curvature = landmark.curvature;
  const internal::CylinderLocal local = internal::LocalWithDerivatives(measured, predicted);
  const Eigen::Matrix3d axis_cross = Skew(local.axis);
  if (J_pose != nullptr) {
    // Exp(-omega) turns the prediction: d axis = [axis]x omega, d point = [point]x omega - rho.
    J_pose->setZero();
    J_pose->topLeftCorner<4, 3>() = local.J_axis * axis_cross;
    J_pose->block<2, 3>(2, 0) += local.J_point * Skew(predicted.point);
    J_pose->block<2, 3>(2, 3) = -local.J_point;
  }
  if (J_landmark != nullptr) {
    const Eigen::Matrix<double, 3, 2> B = R_sensor_map * PerpendicularBasis(landmark.axis);
    J_landmark->setZero();
    J_landmark->topLeftCorner<4, 2>() = -local.J_axis * (axis_cross * B);
    J_landmark->block<2, 2>(2, 2) = local.J_point * B;
    (*J_landmark)(4, 4) = 1.0;
  }
  return local.delta;
}

CylinderResidual InspectCylinder(const Cylinder& measured,
                                 const Matrix5d& covariance,
                                 const Eigen::Isometry3d& T_map_sensor,
                                 const Cylinder& landmark) {
  const Vector5d r =
      CylinderObservationResidual(measured, T_map_sensor, landmark, nullptr, nullptr);
  CylinderResidual out;
  out.axis = r.head<2>();
  out.normal = r.segment<2>(2);
  out.curvature = r[4];
  out.axis_chi2 = MarginalChi2<2>(r, covariance, 0);
  out.normal_chi2 = MarginalChi2<2>(r, covariance, 2);
  out.curvature_chi2 = MarginalChi2<1>(r, covariance, 4);
  out.chi2 = MarginalChi2<5>(r, covariance, 0);
  return out;
}

CylinderFactor::CylinderFactor(Key pose,
                               Key landmark,
                               const Cylinder& measured,
                               const Matrix5d& covariance,
                               const CylinderParts& parts,
                               const RobustKernel& kernel)
    : TypedFactor(PartsNoise(landmark, covariance, parts).WithKernel(kernel), pose, landmark),
      measured_(measured),
      covariance_(covariance),
      parts_(parts) {
  CheckMeasurement("cylinder factor", landmark, measured);
}

CylinderResidual CylinderFactor::Inspect(const Eigen::Isometry3d& T_map_sensor,
                                         const Cylinder& landmark) const {
  return InspectCylinder(measured_, covariance_, T_map_sensor, landmark);
}

CylinderParts CylinderFactor::Gate(const Eigen::Isometry3d& T_map_sensor,
                                   const Cylinder& landmark,
                                   double axis_gate_chi2,
                                   double normal_gate_chi2,
                                   double curvature_gate_chi2) const {
  const CylinderResidual residual = Inspect(T_map_sensor, landmark);
  CylinderParts out = parts_;
  out.axis = out.axis && residual.axis_chi2 <= axis_gate_chi2;
  out.normal = out.normal && residual.normal_chi2 <= normal_gate_chi2;
  out.curvature = out.curvature && residual.curvature_chi2 <= curvature_gate_chi2;
  return out;
}

void CylinderFactor::Evaluate(const Value* const* values, double* residual, double* jacobian) const {
  const auto& T_map_sensor = *std::get_if<Eigen::Isometry3d>(values[0]);
  const auto& landmark = *std::get_if<Cylinder>(values[1]);
  Eigen::Map<Vector5d> r(residual);
  if (jacobian == nullptr) {
    r = CylinderObservationResidual(measured_, T_map_sensor, landmark, nullptr, nullptr);
    return;
  }
  Eigen::Matrix<double, 5, 6> J_pose;
  Matrix5d J_landmark;
  r = CylinderObservationResidual(measured_, T_map_sensor, landmark, &J_pose, &J_landmark);
  Eigen::Map<Eigen::Matrix<double, 5, 11>> J(jacobian);
  J.leftCols<6>() = J_pose;
  J.rightCols<5>() = J_landmark;
}

AxisFactor::AxisFactor(Key pose, Key landmark, const Cylinder& measured, const NoiseModel& noise)
    : TypedFactor(noise, pose, landmark), measured_(measured) {
  CheckMeasurement("axis factor", landmark, measured);
  CheckNoise("axis factor", landmark, noise, 2);
}

void AxisFactor::Evaluate(const Value* const* values, double* residual, double* jacobian) const {
  Eigen::Matrix<double, 5, 6> J_pose;
  Matrix5d J_landmark;
  const Vector5d r = CylinderObservationResidual(measured_,
                                                 *std::get_if<Eigen::Isometry3d>(values[0]),
                                                 *std::get_if<Cylinder>(values[1]),
                                                 jacobian ? &J_pose : nullptr,
                                                 jacobian ? &J_landmark : nullptr);
  Eigen::Map<Eigen::Vector2d> out(residual);
  out = r.head<2>();
  if (jacobian == nullptr) return;
  Eigen::Map<Eigen::Matrix<double, 2, 11>> J(jacobian);
  J.leftCols<6>() = J_pose.topRows<2>();
  J.rightCols<5>() = J_landmark.topRows<2>();
}

NormalFactor::NormalFactor(Key pose, Key landmark, const Cylinder& measured, const NoiseModel& noise)
    : TypedFactor(noise, pose, landmark), measured_(measured) {
  CheckMeasurement("normal factor", landmark, measured);
  CheckNoise("normal factor", landmark, noise, 2);
}

void NormalFactor::Evaluate(const Value* const* values, double* residual, double* jacobian) const {
  Eigen::Matrix<double, 5, 6> J_pose;
  Matrix5d J_landmark;
  const Vector5d r = CylinderObservationResidual(measured_,
                                                 *std::get_if<Eigen::Isometry3d>(values[0]),
                                                 *std::get_if<Cylinder>(values[1]),
                                                 jacobian ? &J_pose : nullptr,
                                                 jacobian ? &J_landmark : nullptr);
  Eigen::Map<Eigen::Vector2d> out(residual);
  out = r.segment<2>(2);
  if (jacobian == nullptr) return;
  Eigen::Map<Eigen::Matrix<double, 2, 11>> J(jacobian);
  J.leftCols<6>() = J_pose.middleRows<2>(2);
  J.rightCols<5>() = J_landmark.middleRows<2>(2);
}

CurvatureFactor::CurvatureFactor(Key landmark,
                                 double curvature,
                                 double sigma,
                                 const RobustKernel& kernel)
    : TypedFactor(NoiseModel::Isotropic(1, sigma).WithKernel(kernel), landmark),
      curvature_(curvature) {
  if (!std::isfinite(curvature)) {
    throw std::invalid_argument("curvature factor of " + KeyName(landmark) +
                                ": the curvature is not finite");
  }
}

void CurvatureFactor::Evaluate(const Value* const* values, double* residual, double* jacobian) const {
  residual[0] = std::get_if<Cylinder>(values[0])->curvature - curvature_;
  if (jacobian == nullptr) return;
  for (int i = 0; i < 4; ++i) jacobian[i] = 0.0;
  jacobian[4] = 1.0;
}

}  // namespace dendro
