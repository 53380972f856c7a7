#include "dendro_slam/geometry/so3.h"

#include <cmath>

#include "inverse_jacobian.h"

namespace dendro {

namespace {
// Below this squared angle the series replaces the closed form.
constexpr double kSmallAngleSquared = 1e-8;
}  // namespace

Eigen::Matrix3d Skew(const Eigen::Vector3d& w) {
  Eigen::Matrix3d m;
  m << 0.0, -w.z(), w.y(), w.z(), 0.0, -w.x(), -w.y(), w.x(), 0.0;
  return m;
}

Eigen::Matrix3d ExpSo3(const Eigen::Vector3d& omega) {
  const double theta2 = omega.squaredNorm();
  const Eigen::Matrix3d W = Skew(omega);
  if (theta2 < kSmallAngleSquared) {
    return Eigen::Matrix3d::Identity() + (1.0 - theta2 / 6.0) * W + (0.5 - theta2 / 24.0) * W * W;
  }
  const double theta = std::sqrt(theta2);
  const double half_sin = std::sin(0.5 * theta);
  return Eigen::Matrix3d::Identity() + std::sin(theta) / theta * W +
         2.0 * half_sin * half_sin / theta2 * W * W;
}

Eigen::Vector3d LogSo3(const Eigen::Matrix3d& R) {
  // Near the identity the antisymmetric part, sin(theta) times the axis, and the series of
  // asin(x) / x in x^2, exact to rounding below 0.05 rad.
  if (R.trace() > 2.9) {
    const Eigen::Vector3d v = 0.5 * Eigen::Vector3d(R(2, 1) - R(1, 2), R(0, 2) - R(2, 0), R(1, 0) - R(0, 1));
    const double s = v.squaredNorm();
    if (s < 2.5e-3) {
      return (1.0 + s * (1.0 / 6.0 +
                         s * (3.0 / 40.0 + s * (5.0 / 112.0 + s * (35.0 / 1152.0 + s * 63.0 / 2816.0))))) *
             v;
    }
  }
  // Through the quaternion: well conditioned at 0 and at pi alike.
  Eigen::Quaterniond q(R);
  q.normalize();
  if (q.w() < 0.0) q.coeffs() = -q.coeffs();
  const double norm = q.vec().norm();
  const double scale =
      norm < 1e-9 ? 2.0 / q.w() : 2.0 * std::atan2(norm, q.w()) / norm;
  return scale * q.vec();
}

Eigen::Matrix3d RightJacobianSo3(const Eigen::Vector3d& omega) {
  const double theta2 = omega.squaredNorm();
  const Eigen::Matrix3d W = Skew(omega);
  if (theta2 < kSmallAngleSquared) {
    return Eigen::Matrix3d::Identity() - (0.5 - theta2 / 24.0) * W +
           (1.0 / 6.0 - theta2 / 120.0) * W * W;
  }
  const double theta = std::sqrt(theta2);
  const double half_sin = std::sin(0.5 * theta);
  return Eigen::Matrix3d::Identity() - 2.0 * half_sin * half_sin / theta2 * W +
         (theta - std::sin(theta)) / (theta2 * theta) * W * W;
}

Eigen::Matrix3d RightJacobianInverseSo3(const Eigen::Vector3d& omega) {
  const Eigen::Matrix3d W = Skew(omega);
  const double c = internal::InverseJacobianCoefficient(omega.squaredNorm());
  return Eigen::Matrix3d::Identity() + 0.5 * W + c * W * W;
}

}  // namespace dendro
