#include "dendro_slam/factor_graph/values.h"

#include <cmath>

#include "cylinder_jacobians.h"
#include "dendro_slam/geometry/se3.h"
#include "dendro_slam/geometry/so3.h"

namespace dendro {

namespace {

using Map3 = Eigen::Map<const Eigen::Vector3d>;
using Map5 = Eigen::Map<const Vector5d>;
using Map6 = Eigen::Map<const Vector6d>;

}  // namespace

const char* TypeName(const Value& value) {
  static constexpr const char* kNames[] = {"pose", "cylinder", "point", "vector"};
  return kNames[value.index()];
}

int TangentDimension(const Value& value) {
  switch (value.index()) {
    case 0:
      return 6;
    case 1:
      return 5;
    case 2:
      return 3;
    default:
      return static_cast<int>(std::get_if<PointN>(&value)->size());
  }
}

Value Retract(const Value& value, const double* delta) {
  Value out = value;
  Retract(value, delta, &out);
  return out;
}

void Retract(const Value& value, const double* delta, Value* out) {
  if (out->index() != value.index()) *out = value;
  if (const auto* pose = std::get_if<Eigen::Isometry3d>(&value)) {
    auto& moved = *std::get_if<Eigen::Isometry3d>(out);
    const Eigen::Isometry3d step = ExpSe3(Map6(delta));
    const Eigen::Matrix3d R = pose->linear() * step.linear();
    const Eigen::Vector3d t = pose->linear() * step.translation() + pose->translation();
    moved.linear() = R;
    moved.translation() = t;
  } else if (const auto* cylinder = std::get_if<Cylinder>(&value)) {
    *std::get_if<Cylinder>(out) = cylinder->Retract(Map5(delta));
  } else if (const auto* point = std::get_if<Eigen::Vector3d>(&value)) {
    *std::get_if<Eigen::Vector3d>(out) = *point + Map3(delta);
  } else {
    const PointN& from = *std::get_if<PointN>(&value);
    PointN& moved = *std::get_if<PointN>(out);
    moved = from;
    for (int i = 0; i < moved.size(); ++i) moved[i] += delta[i];
  }
}

void LocalCoordinates(const Value& from, const Value& to, double* delta) {
  if (const auto* pose = std::get_if<Eigen::Isometry3d>(&from)) {
    const auto& other = std::get<Eigen::Isometry3d>(to);
    Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
    T.linear() = pose->linear().transpose() * other.linear();
    T.translation() = pose->linear().transpose() * (other.translation() - pose->translation());
    Eigen::Map<Vector6d> out(delta);
    out = LogSe3(T);
  } else if (const auto* cylinder = std::get_if<Cylinder>(&from)) {
    Eigen::Map<Vector5d> out(delta);
    out = cylinder->LocalCoordinates(std::get<Cylinder>(to));
  } else if (const auto* point = std::get_if<Eigen::Vector3d>(&from)) {
    Eigen::Map<Eigen::Vector3d> out(delta);
    out = std::get<Eigen::Vector3d>(to) - *point;
  } else {
    const PointN& a = *std::get_if<PointN>(&from);
    const PointN& b = std::get<PointN>(to);
    for (int i = 0; i < a.size(); ++i) delta[i] = b[i] - a[i];
  }
}

void LocalCoordinatesJacobian(const Value& from, const Value& to, double* jacobian) {
  if (std::holds_alternative<Eigen::Isometry3d>(from)) {
    double delta[6];
    LocalCoordinates(from, to, delta);
    Eigen::Map<Matrix6d> J(jacobian);
    J = RightJacobianInverseSe3(Map6(delta));
  } else if (const auto* cylinder = std::get_if<Cylinder>(&from)) {
    const auto& other = std::get<Cylinder>(to);
    const internal::CylinderLocal local = internal::LocalWithDerivatives(*cylinder, other);
    const Eigen::Matrix<double, 3, 2> B = PerpendicularBasis(other.axis);
    Eigen::Map<Matrix5d> J(jacobian);
    J.setZero();
    J.topLeftCorner<4, 2>() = -local.J_axis * (Skew(local.axis) * B);
    J.block<2, 2>(2, 2) = local.J_point * B;
    J(4, 4) = 1.0;
  } else {
    const int n = TangentDimension(from);
    Eigen::Map<Eigen::MatrixXd>(jacobian, n, n).setIdentity();
  }
}

bool IsValid(const Value& value) {
  constexpr double kTolerance = 1e-3;
  if (const auto* pose = std::get_if<Eigen::Isometry3d>(&value)) {
    if (!pose->matrix().allFinite()) return false;
    const Eigen::Matrix3d R = pose->linear();
    return (R.transpose() * R - Eigen::Matrix3d::Identity()).cwiseAbs().maxCoeff() < kTolerance &&
           R.determinant() > 0.0;
  }
  if (const auto* cylinder = std::get_if<Cylinder>(&value)) {
    return cylinder->axis.allFinite() && cylinder->point.allFinite() &&
           std::isfinite(cylinder->curvature) &&
           std::abs(cylinder->axis.squaredNorm() - 1.0) < kTolerance;
  }
  if (const auto* point = std::get_if<Eigen::Vector3d>(&value)) return point->allFinite();
  const PointN& vector = *std::get_if<PointN>(&value);
  return vector.size() > 0 && vector.allFinite();
}

void Values::Insert(Key key, const Value& value) {
  if (!map_.emplace(key, value).second) {
    throw DuplicateVariableError(key, "variable " + KeyName(key) +
                                          " is given twice; insert each variable once, or use Set "
                                          "to overwrite it");
  }
}

const Value& Values::Get(Key key) const {
  const auto it = map_.find(key);
  if (it == map_.end()) {
    throw UnknownVariableError(
        key, "there is no value for variable " + KeyName(key) + "; insert it before it is used");
  }
  return it->second;
}

void Values::ThrowWrongType(Key key) const {
  throw UnknownVariableError(key, "variable " + KeyName(key) + " is a " + TypeName(Get(key)) +
                                      "; ask for it with that type");
}

}  // namespace dendro
