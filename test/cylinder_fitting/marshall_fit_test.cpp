#include "dendro_slam/cylinder_fitting/marshall_fit.h"

#include <cmath>
#include <random>

#include <ceres/ceres.h>
#include <gtest/gtest.h>

namespace dendro {
namespace {

using Eigen::Vector3d;

TEST(MarshallResidual, PerfectCylinderFourMetresAwayIsZero) {
  // Vertical cylinder of radius 0.25 whose surface is 4 m ahead: rho 4, n = x, a = z.
  Vector5d q;
  q << 4.0, 0.0, 0.0, 4.0, 0.0;
  for (const double angle : {0.0, 0.7, 2.0, 3.0}) {
    const Vector3d p(4.25 + 0.25 * std::cos(angle), 0.25 * std::sin(angle), 0.3 - angle);
    EXPECT_NEAR(MarshallResidual(q, p, nullptr), 0.0, 1e-12);
  }
}

TEST(MarshallResidual, HandComputedOffTheSurface) {
  Vector5d q;
  q << 4.0, 0.0, 0.0, 4.0, 0.0;
  // 0.05 m outside on the near side: d + d^2 kappa / 2 = 0.05 + 0.0025 * 2 = 0.055.
  EXPECT_NEAR(MarshallResidual(q, Vector3d(3.95, 0.0, 1.0), nullptr), 0.055, 1e-12);
}

TEST(MarshallResidual, JacobianMatchesCentralDifferences) {
  std::mt19937 rng(1);
  std::uniform_real_distribution<double> u(-1.0, 1.0);
  for (int i = 0; i < 100; ++i) {
    Vector5d q;
    q << 3.0 + u(rng), 0.4 * u(rng), 0.4 * u(rng), 5.0 + 3.0 * u(rng), 0.4 * u(rng);
    const Vector3d p(3.0 + u(rng), u(rng), u(rng));
    Vector5d J;
    MarshallResidual(q, p, &J);
    for (int k = 0; k < 5; ++k) {
      Vector5d d = Vector5d::Zero();
      d[k] = 1e-6;
      const double numeric =
          (MarshallResidual(q + d, p, nullptr) - MarshallResidual(q - d, p, nullptr)) / 2e-6;
      EXPECT_NEAR(J[k], numeric, 1e-6 * (1.0 + std::abs(numeric)));
    }
  }
}

std::vector<Vector3d> Patch(const Cylinder& c, double sigma, unsigned seed) {
  std::mt19937 rng(seed);
  std::normal_distribution<double> gauss(0.0, sigma);
  const Eigen::Matrix<double, 3, 2> B = PerpendicularBasis(c.axis);
  const Vector3d front = -c.Foot().normalized();
  const Vector3d side = c.axis.cross(front);
  std::vector<Vector3d> points;
  for (int ring = 0; ring < 8; ++ring) {
    for (int i = -6; i <= 6; ++i) {
      const double angle = 0.2 * i;
      const double r = c.radius() + (sigma > 0.0 ? gauss(rng) : 0.0);
      points.push_back(c.point + (0.2 * ring - 0.7) * c.axis +
                       r * (std::cos(angle) * front + std::sin(angle) * side));
    }
  }
  (void)B;
  return points;
}

TEST(FitMarshall, RecoversAnExactCylinder) {
  const Cylinder truth{Vector3d(0.2, -0.3, 1.0).normalized(), Vector3d(3.0, 2.0, 0.5), 1.0 / 0.15};
  Cylinder start = truth;
  start.axis = Vector3d(0.1, -0.1, 1.0).normalized();
  start.point += Vector3d(0.05, -0.1, 0.0);
  start.curvature = 1.0 / 0.25;
  const auto fit = FitMarshall(Patch(truth, 0.0, 0), Vector3d::Zero(), start);
  ASSERT_TRUE(fit);
  const Vector5d d = fit->LocalCoordinates(truth);
  EXPECT_LT(d.head<4>().norm(), 1e-5);
  EXPECT_NEAR(fit->radius(), 0.15, 1e-5);
}

// The same cost in the full Ceres solver with automatic derivatives, over the redundant thesis
// parameters with n and a made orthonormal: an independent formulation of the same optimum.
struct RedundantResidual {
  Vector3d p;
  template <class T>
  bool operator()(const T* const axis, const T* const normal, const T* const rho,
                  const T* const kappa, T* residual) const {
    const Eigen::Matrix<T, 3, 1> a = Eigen::Map<const Eigen::Matrix<T, 3, 1>>(axis).normalized();
    Eigen::Matrix<T, 3, 1> n = Eigen::Map<const Eigen::Matrix<T, 3, 1>>(normal);
    n = (n - n.dot(a) * a).normalized();
    const Eigen::Matrix<T, 3, 1> point = p.cast<T>();
    const T pn = point.dot(n), pa = point.dot(a);
    residual[0] = T(0.5) * kappa[0] *
                      (point.squaredNorm() - T(2.0) * rho[0] * pn - pa * pa + rho[0] * rho[0]) +
                  rho[0] - pn;
    return true;
  }
};

TEST(FitMarshall, EqualsTheFullCeresSolverOnNoisyPoints) {
  const Cylinder truth{Vector3d(0.3, 0.1, 1.0).normalized(), Vector3d(4.0, -1.0, 0.2), 1.0 / 0.2};
  for (unsigned seed = 1; seed <= 5; ++seed) {
    const std::vector<Vector3d> points = Patch(truth, 0.01, seed);
    const auto fit = FitMarshall(points, Vector3d::Zero(), truth);
    ASSERT_TRUE(fit);
    Vector3d a = truth.axis, n = truth.Foot().normalized();
    double rho = truth.Foot().norm() - truth.radius(), kappa = truth.curvature;
    ceres::Problem problem;
    for (const Vector3d& p : points) {
      problem.AddResidualBlock(
          new ceres::AutoDiffCostFunction<RedundantResidual, 1, 3, 3, 1, 1>(new RedundantResidual{p}),
          nullptr, a.data(), n.data(), &rho, &kappa);
    }
    ceres::Solver::Options options;
    options.linear_solver_type = ceres::DENSE_QR;
    options.logging_type = ceres::SILENT;
    options.max_num_iterations = 200;
    options.function_tolerance = 1e-14;
    options.parameter_tolerance = 1e-14;
    ceres::Solver::Summary summary;
    ceres::Solve(options, &problem, &summary);
    EXPECT_NEAR(fit->radius(), 1.0 / kappa, 2e-5);
    EXPECT_LT(fit->axis.cross(a.normalized()).norm(), 1e-4);
  }
}

TEST(FitMarshall, RefusesTooFewPointsAndAnAxisThroughTheOrigin) {
  const Cylinder c{Vector3d::UnitZ(), Vector3d(4, 0, 0), 5.0};
  EXPECT_FALSE(FitMarshall({{4, 0, 0}, {4, 0.1, 0}}, Vector3d::Zero(), c));
  const Cylinder through{Vector3d::UnitX(), Vector3d(4, 0, 0), 5.0};
  EXPECT_FALSE(FitMarshall(Patch(c, 0.0, 0), Vector3d::Zero(), through));
}

}  // namespace
}  // namespace dendro
