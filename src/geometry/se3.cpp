#include "dendro_slam/geometry/se3.h"

#include <cmath>

#include "dendro_slam/geometry/so3.h"

#include "inverse_jacobian.h"

namespace dendro {

namespace {

// Below this squared angle the series of ExpSe3 are exact to rounding.
constexpr double kSeriesAngleSquared = 0.01;

// Left Jacobian of SO(3): the V of Exp, translation = V rho.
Eigen::Matrix3d LeftJacobianSo3(const Eigen::Vector3d& omega) { return RightJacobianSo3(-omega); }

// Barfoot's Q block of the left Jacobian (State Estimation for Robotics, eq. 7.86), rotation first.
Eigen::Matrix3d LeftQ(const Eigen::Vector3d& omega, const Eigen::Vector3d& rho) {
  const Eigen::Matrix3d W = Skew(omega);
  const Eigen::Matrix3d P = Skew(rho);
  const double theta2 = omega.squaredNorm();
  double c1 = 1.0 / 6.0 - theta2 / 120.0;
  double c2 = 1.0 / 24.0 - theta2 / 720.0;
  double c3 = 1.0 / 120.0 - theta2 / 2520.0;
  // The closed forms cancel badly below a few hundredths of a radian.
  if (theta2 >= 1e-3) {
    const double theta = std::sqrt(theta2);
    const double s = std::sin(theta);
    const double c = std::cos(theta);
    const double theta4 = theta2 * theta2;
    c1 = (theta - s) / (theta2 * theta);
    c2 = (theta2 + 2.0 * c - 2.0) / (2.0 * theta4);
    c3 = (2.0 * theta - 3.0 * s + theta * c) / (2.0 * theta4 * theta);
  }
  const Eigen::Matrix3d WP = W * P;
  const Eigen::Matrix3d PW = P * W;
  const Eigen::Matrix3d WPW = WP * W;
  return 0.5 * P + c1 * (WP + PW + WPW) + c2 * (W * WP + PW * W - 3.0 * WPW) + c3 * (WPW * W + W * WPW);
}

}  // namespace

// Both series share W and W^2: R = I + a W + b W^2, V = I + b W + c W^2 with a = sin(theta) / theta,
// b = (1 - cos(theta)) / theta^2, c = (theta - sin(theta)) / theta^3.
Eigen::Isometry3d ExpSe3(const Vector6d& xi) {
  const Eigen::Vector3d omega = xi.head<3>();
  const Eigen::Vector3d rho = xi.tail<3>();
  const double theta2 = omega.squaredNorm();
  double a, b, c;
  if (theta2 < kSeriesAngleSquared) {
    a = 1.0 - theta2 / 6.0 * (1.0 - theta2 / 20.0 * (1.0 - theta2 / 42.0 * (1.0 - theta2 / 72.0)));
    b = 0.5 * (1.0 - theta2 / 12.0 * (1.0 - theta2 / 30.0 * (1.0 - theta2 / 56.0 * (1.0 - theta2 / 90.0))));
    c = (1.0 - theta2 / 20.0 * (1.0 - theta2 / 42.0 * (1.0 - theta2 / 72.0 * (1.0 - theta2 / 110.0)))) / 6.0;
  } else {
    const double theta = std::sqrt(theta2);
    const double half_sin = std::sin(0.5 * theta);
    const double sin = std::sin(theta);
    a = sin / theta;
    b = 2.0 * half_sin * half_sin / theta2;
    c = (theta - sin) / (theta2 * theta);
  }
  const double x = omega.x(), y = omega.y(), z = omega.z();
  const double bxy = b * x * y, bxz = b * x * z, byz = b * y * z;
  Eigen::Isometry3d T;
  T.matrix() << 1.0 - b * (y * y + z * z), bxy - a * z, bxz + a * y, 0.0,
      bxy + a * z, 1.0 - b * (x * x + z * z), byz - a * x, 0.0,
      bxz - a * y, byz + a * x, 1.0 - b * (x * x + y * y), 0.0,
      0.0, 0.0, 0.0, 1.0;
  const Eigen::Vector3d u = omega.cross(rho);
  T.translation() = rho + b * u + c * omega.cross(u);
  return T;
}

Vector6d LogSe3(const Eigen::Isometry3d& T) { return LogSe3(T.linear(), T.translation()); }

Vector6d LogSe3(const Eigen::Matrix3d& R, const Eigen::Vector3d& t) {
  Vector6d xi;
  const Eigen::Vector3d omega = LogSo3(R);
  xi.head<3>() = omega;
  // Jl(omega)^-1 t, by cross products.
  const Eigen::Vector3d u = omega.cross(t);
  xi.tail<3>() =
      t - 0.5 * u + internal::InverseJacobianCoefficient(omega.squaredNorm()) * omega.cross(u);
  return xi;
}

Matrix6d AdjointSe3(const Eigen::Isometry3d& T) {
  Matrix6d A = Matrix6d::Zero();
  A.topLeftCorner<3, 3>() = T.linear();
  A.bottomRightCorner<3, 3>() = T.linear();
  A.bottomLeftCorner<3, 3>() = Skew(T.translation()) * T.linear();
  return A;
}

Matrix6d RightJacobianSe3(const Vector6d& xi) {
  const Eigen::Vector3d omega = -xi.head<3>();
  const Eigen::Vector3d rho = -xi.tail<3>();
  Matrix6d J = Matrix6d::Zero();
  J.topLeftCorner<3, 3>() = LeftJacobianSo3(omega);
  J.bottomRightCorner<3, 3>() = J.topLeftCorner<3, 3>();
  J.bottomLeftCorner<3, 3>() = LeftQ(omega, rho);
  return J;
}

Matrix6d RightJacobianInverseSe3(const Vector6d& xi) {
  const Eigen::Matrix3d Ji = RightJacobianInverseSo3(xi.head<3>());
  Matrix6d J = Matrix6d::Zero();
  J.topLeftCorner<3, 3>() = Ji;
  J.bottomRightCorner<3, 3>() = Ji;
  J.bottomLeftCorner<3, 3>() = -Ji * LeftQ(-xi.head<3>(), -xi.tail<3>()) * Ji;
  return J;
}

Eigen::Isometry3d NormalizedSe3(const Eigen::Isometry3d& T) {
  Eigen::Isometry3d out = T;
  out.linear() = Eigen::Quaterniond(T.linear()).normalized().toRotationMatrix();
  return out;
}

Eigen::Isometry3d InterpolateSe3(const Eigen::Isometry3d& a,
                                 const Eigen::Isometry3d& b,
                                 double fraction) {
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  const Eigen::Matrix3d R_ab = a.linear().transpose() * b.linear();
  T.linear() = a.linear() * ExpSo3(fraction * LogSo3(R_ab));
  T.translation() = a.translation() + fraction * (b.translation() - a.translation());
  return T;
}

}  // namespace dendro
