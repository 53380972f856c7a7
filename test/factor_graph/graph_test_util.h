#pragma once

#include <cmath>
#include <random>

#include <gtest/gtest.h>

#include "dendro_slam/factor_graph/factor.h"
#include "dendro_slam/geometry/se3.h"

namespace dendro::test {

inline double Normal(std::mt19937& rng) { return std::normal_distribution<double>()(rng); }

template <int N>
Eigen::Matrix<double, N, 1> RandomVector(std::mt19937& rng, double scale = 1.0) {
  Eigen::Matrix<double, N, 1> v;
  for (int i = 0; i < N; ++i) v[i] = scale * Normal(rng);
  return v;
}

inline Eigen::Isometry3d RandomPose(std::mt19937& rng, double rotation = 1.0, double translation = 3.0) {
  Vector6d xi;
  xi << RandomVector<3>(rng, rotation), RandomVector<3>(rng, translation);
  return ExpSe3(xi);
}

inline Cylinder RandomCylinder(std::mt19937& rng) {
  Cylinder c;
  c.axis = RandomVector<3>(rng).normalized();
  c.point = RandomVector<3>(rng, 3.0);
  c.curvature = std::exp(RandomVector<1>(rng, 0.5)[0]) * 5.0;
  return c;
}

template <int N>
Eigen::Matrix<double, N, N> RandomCovariance(std::mt19937& rng, double scale) {
  Eigen::Matrix<double, N, N> A;
  for (int i = 0; i < N; ++i) A.col(i) = RandomVector<N>(rng);
  return scale * scale * (A * A.transpose() / N + Eigen::Matrix<double, N, N>::Identity());
}

/// Analytic whitened Jacobian against central differences of the whitened residual.
inline void ExpectJacobianMatches(const Factor& factor, const Values& values, double tolerance = 1e-6) {
  Eigen::MatrixXd jacobian, unused;
  Eigen::VectorXd residual, plus, minus;
  factor.Linearize(values, &jacobian, &residual);
  constexpr double kStep = 1e-6;
  int column = 0;
  for (const Key key : factor.keys()) {
    const Value& value = values.Get(key);
    for (int i = 0; i < TangentDimension(value); ++i, ++column) {
      double delta[6] = {};
      Values moved = values;
      delta[i] = kStep;
      moved.Set(key, Retract(value, delta));
      factor.Linearize(moved, &unused, &plus);
      delta[i] = -kStep;
      moved.Set(key, Retract(value, delta));
      factor.Linearize(moved, &unused, &minus);
      const Eigen::VectorXd numeric = (plus - minus) / (2.0 * kStep);
      const double scale = std::max(1.0, jacobian.cwiseAbs().maxCoeff());
      EXPECT_LT((numeric - jacobian.col(column)).cwiseAbs().maxCoeff(), tolerance * scale)
          << factor.Describe() << " column " << column;
    }
  }
}

}  // namespace dendro::test
