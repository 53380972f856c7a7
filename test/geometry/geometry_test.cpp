#include <cmath>
#include <random>

#include <gtest/gtest.h>

#include "dendro_slam/geometry/cylinder.h"
#include "dendro_slam/geometry/se3.h"
#include "dendro_slam/geometry/so3.h"

namespace dendro {
namespace {

constexpr double kStep = 1e-6;

Vector6d RandomTwist(std::mt19937& rng, double angle, double length) {
  std::normal_distribution<double> n;
  Vector6d xi;
  for (int i = 0; i < 6; ++i) xi[i] = n(rng);
  xi.head<3>() *= angle / xi.head<3>().norm();
  xi.tail<3>() *= length / xi.tail<3>().norm();
  return xi;
}

Cylinder RandomCylinder(std::mt19937& rng) {
  std::normal_distribution<double> n;
  Cylinder c;
  c.axis = Eigen::Vector3d(n(rng), n(rng), n(rng)).normalized();
  c.point = 5.0 * Eigen::Vector3d(n(rng), n(rng), n(rng));
  c.curvature = 1.0 / (0.05 + std::abs(n(rng)));
  return c;
}

TEST(So3, QuarterTurnByHand) {
  const Eigen::Matrix3d R = ExpSo3({0, 0, M_PI / 2});
  EXPECT_TRUE((R * Eigen::Vector3d::UnitX()).isApprox(Eigen::Vector3d::UnitY(), 1e-12));
  EXPECT_TRUE(LogSo3(R).isApprox(Eigen::Vector3d(0, 0, M_PI / 2), 1e-12));
}

TEST(So3, LogInvertsExpFromTinyToNearlyPi) {
  std::mt19937 rng(1);
  for (double angle : {1e-12, 1e-7, 1e-5, 1e-4, 0.01, 0.5, 2.0, 3.1, M_PI - 1e-7}) {
    const Eigen::Vector3d w = RandomTwist(rng, angle, 1.0).head<3>();
    EXPECT_LT((LogSo3(ExpSo3(w)) - w).norm(), 1e-8) << angle;
  }
}

TEST(Se3, LogInvertsExp) {
  std::mt19937 rng(2);
  for (double angle : {1e-12, 1e-5, 1e-4, 0.03, 0.1, 1.0, 3.0}) {
    const Vector6d xi = RandomTwist(rng, angle, 3.0);
    EXPECT_LT((LogSe3(ExpSe3(xi)) - xi).norm(), 1e-8) << angle;
  }
}

TEST(Se3, AdjointIdentity) {
  std::mt19937 rng(3);
  const Eigen::Isometry3d T = ExpSe3(RandomTwist(rng, 1.2, 4.0));
  const Vector6d xi = RandomTwist(rng, 0.3, 0.7);
  const Eigen::Isometry3d left = T * ExpSe3(xi) * T.inverse();
  const Vector6d mapped = AdjointSe3(T) * xi;
  EXPECT_TRUE(left.isApprox(ExpSe3(mapped), 1e-10));
}

TEST(Se3, RightJacobianAndInverseMatchCentralDifferences) {
  std::mt19937 rng(4);
  for (double angle : {1e-6, 1e-3, 0.02, 0.04, 0.5, 2.5}) {
    const Vector6d xi = RandomTwist(rng, angle, 2.0);
    const Eigen::Isometry3d T = ExpSe3(xi);
    Matrix6d numeric, numeric_inverse;
    for (int i = 0; i < 6; ++i) {
      const Vector6d d = kStep * Vector6d::Unit(i);
      numeric.col(i) = (LogSe3(T.inverse() * ExpSe3(xi + d)) - LogSe3(T.inverse() * ExpSe3(xi - d))) /
                       (2 * kStep);
      numeric_inverse.col(i) = (LogSe3(T * ExpSe3(d)) - LogSe3(T * ExpSe3(-d))) / (2 * kStep);
    }
    EXPECT_LT((numeric - RightJacobianSe3(xi)).cwiseAbs().maxCoeff(), 1e-7) << angle;
    EXPECT_LT((numeric_inverse - RightJacobianInverseSe3(xi)).cwiseAbs().maxCoeff(), 1e-7) << angle;
  }
}

TEST(Cylinder, BasisIsRightHandedAlsoAtThePoles) {
  std::mt19937 rng(5);
  std::vector<Eigen::Vector3d> axes = {Eigen::Vector3d::UnitX(), Eigen::Vector3d::UnitZ(),
                                       -Eigen::Vector3d::UnitZ()};
  for (int i = 0; i < 100; ++i) axes.push_back(RandomCylinder(rng).axis);
  for (const Eigen::Vector3d& a : axes) {
    Eigen::Matrix3d R;
    R << PerpendicularBasis(a), a;
    EXPECT_TRUE((R.transpose() * R).isIdentity(1e-12)) << a.transpose();
    EXPECT_NEAR(R.determinant(), 1.0, 1e-12);
  }
}

TEST(Cylinder, DistanceByHand) {
  const Cylinder c{Eigen::Vector3d::UnitZ(), {4, 0, 7}, 1.0 / 0.5};
  EXPECT_NEAR(c.Distance({0, 0, 0}), 3.5, 1e-12);
  EXPECT_NEAR(c.Distance({3.5, 0, -2}), 0.0, 1e-12);
  EXPECT_TRUE(c.Foot().isApprox(Eigen::Vector3d(4, 0, 0)));
}

TEST(Cylinder, LocalCoordinatesInvertRetractWhateverSignAndAnchor) {
  std::mt19937 rng(6);
  for (int i = 0; i < 200; ++i) {
    const Cylinder c = RandomCylinder(rng);
    Vector5d d = 0.2 * Vector5d::Random();
    Cylinder moved = c.Retract(d);
    EXPECT_LT((c.LocalCoordinates(moved) - d).norm(), 1e-9);
    moved = moved.Slid(1.7);
    moved.axis = -moved.axis;
    EXPECT_LT((c.LocalCoordinates(moved) - d).norm(), 1e-9);
  }
}

TEST(Cylinder, TangentTransformAndSlideMatchDifferences) {
  std::mt19937 rng(7);
  for (int i = 0; i < 50; ++i) {
    const Cylinder c = RandomCylinder(rng);
    const Eigen::Isometry3d T = ExpSe3(RandomTwist(rng, 1.0, 3.0));
    const Cylinder ct = TransformCylinder(T, c);
    const Cylinder cs = c.Slid(0.8);
    Matrix5d Jt, Js;
    for (int k = 0; k < 5; ++k) {
      const Vector5d d = kStep * Vector5d::Unit(k);
      Jt.col(k) = (ct.LocalCoordinates(TransformCylinder(T, c.Retract(d))) -
                   ct.LocalCoordinates(TransformCylinder(T, c.Retract(-d)))) / (2 * kStep);
      Js.col(k) = (cs.LocalCoordinates(c.Retract(d)) - cs.LocalCoordinates(c.Retract(-d))) / (2 * kStep);
    }
    EXPECT_LT((Jt - CylinderTangentTransform(T, c)).cwiseAbs().maxCoeff(), 1e-7);
    EXPECT_LT((Js - CylinderSlideJacobian(c, 0.8)).cwiseAbs().maxCoeff(), 1e-7);
  }
}

TEST(Cylinder, DisplayAxisConvention) {
  EXPECT_EQ(DisplayAxis({0, 0, -1}), Eigen::Vector3d(0, 0, 1));
  EXPECT_EQ(DisplayAxis({1, 0, 0}), Eigen::Vector3d(1, 0, 0));
  EXPECT_EQ(DisplayAxis({0.6, -0.8, 0}), Eigen::Vector3d(-0.6, 0.8, 0));
}

}  // namespace
}  // namespace dendro
