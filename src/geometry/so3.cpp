#include "dendro_slam/geometry/so3.h"

#include <cmath>

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
  const double theta2 = omega.squaredNorm();
  const Eigen::Matrix3d W = Skew(omega);
  double c = 1.0 / 12.0 + theta2 / 720.0;
  if (theta2 >= kSmallAngleSquared) {
    const double theta = std::sqrt(theta2);
    c = 1.0 / theta2 - 0.5 / (theta * std::tan(0.5 * theta));
  }
  return Eigen::Matrix3d::Identity() + 0.5 * W + c * W * W;
}

}  // namespace dendro
