#include <cmath>
#include <limits>
#include <stdexcept>

#include <gmock/gmock.h>

#include "dendro_slam/factor_graph/between_factor.h"
#include "dendro_slam/factor_graph/cylinder_factor.h"
#include "dendro_slam/factor_graph/junction_point_factor.h"
#include "dendro_slam/factor_graph/prior_factor.h"
#include "dendro_slam/geometry/so3.h"
#include "graph_test_util.h"

namespace dendro {
namespace {

using namespace test;

const Key kX0 = MakeKey('x', 0);
const Key kX1 = MakeKey('x', 1);
const Key kL0 = MakeKey('l', 0);
const Key kP0 = MakeKey('p', 0);

TEST(Key, NamesRoundTrip) {
  EXPECT_EQ(KeyName(kX1), "x1");
  EXPECT_EQ(KeySymbol(MakeKey('l', 42)), 'l');
  EXPECT_EQ(KeyIndex(MakeKey('l', 42)), 42u);
  EXPECT_EQ(KeyName(7), "7");
  EXPECT_LT(MakeKey('l', 1000), MakeKey('x', 0));
}

TEST(Values, InsertsOnceAndNamesWhatIsMissing) {
  Values values;
  values.Insert(kP0, Eigen::Vector3d(1, 2, 3));
  EXPECT_THROW(values.Insert(kP0, Eigen::Vector3d(1, 2, 3)), DuplicateVariableError);
  EXPECT_THROW(values.At<Eigen::Isometry3d>(kP0), UnknownVariableError);
  try {
    values.Get(kX1);
    FAIL();
  } catch (const UnknownVariableError& error) {
    EXPECT_EQ(error.key(), kX1);
    EXPECT_THAT(error.what(), testing::HasSubstr("x1"));
  }
}

TEST(Values, LocalCoordinatesInvertRetract) {
  std::mt19937 rng(1);
  for (int trial = 0; trial < 50; ++trial) {
    PointN vector(2);
    vector << 1.0, -2.0;
    const Value values[] = {RandomPose(rng), RandomCylinder(rng),
                            Eigen::Vector3d(RandomVector<3>(rng)), vector};
    for (const Value& value : values) {
      double delta[6], back[6];
      const int n = TangentDimension(value);
      for (double& d : delta) d = 0.3 * Normal(rng);
      LocalCoordinates(value, Retract(value, delta), back);
      for (int i = 0; i < n; ++i) EXPECT_NEAR(delta[i], back[i], 1e-9) << TypeName(value);
    }
  }
}

TEST(Values, RejectsWhatIsNotOnTheManifold) {
  Eigen::Isometry3d pose = Eigen::Isometry3d::Identity();
  EXPECT_TRUE(IsValid(Value(pose)));
  pose.translation().x() = std::numeric_limits<double>::quiet_NaN();
  EXPECT_FALSE(IsValid(Value(pose)));
  pose = Eigen::Isometry3d::Identity();
  pose.linear() *= 1.1;
  EXPECT_FALSE(IsValid(Value(pose)));
  Cylinder cylinder;
  cylinder.axis *= 2.0;
  EXPECT_FALSE(IsValid(Value(cylinder)));
}

TEST(NoiseModel, HandComputed) {
  const double r[2] = {0.2, -0.6};
  EXPECT_NEAR(NoiseModel::Sigmas(Eigen::Vector2d(0.1, 0.3)).SquaredMahalanobis(r), 8.0, 1e-12);
  Eigen::Matrix2d C;
  C << 2.0, 1.0, 1.0, 2.0;
  const double expected = Eigen::Vector2d(0.2, -0.6).dot(C.inverse() * Eigen::Vector2d(0.2, -0.6));
  EXPECT_NEAR(NoiseModel::Covariance(C).SquaredMahalanobis(r), expected, 1e-12);
  EXPECT_NEAR(NoiseModel::Information(C.inverse()).SquaredMahalanobis(r), expected, 1e-12);
  EXPECT_NEAR(NoiseModel::Covariance(C).Error(r), 0.5 * expected, 1e-12);
}

TEST(NoiseModel, RejectsWhatIsNotANoise) {
  EXPECT_THROW(NoiseModel::Isotropic(3, 0.0), std::invalid_argument);
  EXPECT_THROW(NoiseModel::Isotropic(7, 1.0), std::invalid_argument);
  EXPECT_THROW(NoiseModel::Sigmas(Eigen::Vector2d(1.0, std::nan(""))), std::invalid_argument);
  Eigen::Matrix2d C;
  C << 1.0, 2.0, 2.0, 1.0;
  EXPECT_THROW(NoiseModel::Covariance(C), std::invalid_argument);
  C << 1.0, 0.5, 0.4, 1.0;
  EXPECT_THROW(NoiseModel::Information(C), std::invalid_argument);
}

TEST(RobustKernel, WeightIsTheDerivativeOfTheLoss) {
  for (const RobustKernel& kernel :
       {RobustKernel{}, RobustKernel::Huber(1.2), RobustKernel::Cauchy(1.5), RobustKernel::Dcs(2.0)}) {
    EXPECT_EQ(kernel.Loss(0.0), 0.0);
    EXPECT_EQ(kernel.Weight(0.0), 1.0);
    for (const double s : {0.1, 1.0, 1.9, 2.1, 10.0, 300.0}) {
      const double h = 1e-6 * s;
      EXPECT_NEAR(kernel.Weight(s), (kernel.Loss(s + h) - kernel.Loss(s - h)) / (2 * h), 1e-7);
    }
  }
  EXPECT_NEAR(RobustKernel::Huber(2.0).Loss(9.0), 2 * 2 * 3 - 4, 1e-12);
  EXPECT_NEAR(RobustKernel::Dcs(1.0).Loss(1e12), 3.0, 1e-9);
}

TEST(Prior, JacobiansMatch) {
  std::mt19937 rng(2);
  for (int trial = 0; trial < 20; ++trial) {
    Values values;
    const Eigen::Isometry3d T = RandomPose(rng);
    values.Set(kX0, Eigen::Isometry3d(T * RandomPose(rng, 0.5, 1.0)));
    ExpectJacobianMatches(
        PosePrior(kX0, T, NoiseModel::Covariance(RandomCovariance<6>(rng, 1.0))), values);
    Cylinder mean = RandomCylinder(rng);
    values.Set(kL0, mean.Slid(0.7).Retract(RandomVector<5>(rng, 0.3)));
    if (trial % 2) mean.axis = -mean.axis;
    ExpectJacobianMatches(
        CylinderPrior(kL0, mean, NoiseModel::Covariance(RandomCovariance<5>(rng, 1.0))), values);
    values.Set(kP0, Eigen::Vector3d(RandomVector<3>(rng)));
    ExpectJacobianMatches(
        PointPrior(kP0, RandomVector<3>(rng), NoiseModel::Covariance(RandomCovariance<3>(rng, 1.0))),
        values);
  }
}

TEST(Prior, TheMeanHasNoError) {
  std::mt19937 rng(3);
  Values values;
  const Cylinder c = RandomCylinder(rng);
  Cylinder same = c.Slid(1.5);
  same.axis = -same.axis;
  values.Set(kL0, same);
  EXPECT_NEAR(CylinderPrior(kL0, c, NoiseModel::Unit(5)).Error(values), 0.0, 1e-20);
  EXPECT_THROW(CylinderPrior(kL0, c, NoiseModel::Unit(6)), std::invalid_argument);
}

TEST(Between, HandComputed) {
  Values values;
  Eigen::Isometry3d a = Eigen::Isometry3d::Identity();
  Eigen::Isometry3d b = Eigen::Isometry3d::Identity();
  a.translation() << 1, 0, 0;
  a.linear() = ExpSo3(Eigen::Vector3d(0, 0, M_PI / 2));
  b.translation() << 1, 2, 0;
  b.linear() = a.linear();
  values.Set(kX0, a);
  values.Set(kX1, b);
  // b lies 2 m ahead of a along its own x axis; 1.5 m were measured.
  Eigen::Isometry3d measured = Eigen::Isometry3d::Identity();
  measured.translation() << 1.5, 0, 0;
  Eigen::MatrixXd J;
  Eigen::VectorXd r;
  BetweenFactor(kX0, kX1, measured, NoiseModel::Isotropic(6, 0.5)).Linearize(values, &J, &r);
  Vector6d expected;
  expected << 0, 0, 0, 1.0, 0, 0;
  EXPECT_LT((r - expected).norm(), 1e-12);
}

TEST(Between, JacobiansMatch) {
  std::mt19937 rng(4);
  for (int trial = 0; trial < 50; ++trial) {
    Values values;
    const Eigen::Isometry3d a = RandomPose(rng);
    const Eigen::Isometry3d measured = RandomPose(rng);
    const double error = trial % 3 == 0 ? 1e-4 : 0.6;
    values.Set(kX0, a);
    values.Set(kX1, Eigen::Isometry3d(a * measured * RandomPose(rng, error, error)));
    ExpectJacobianMatches(
        BetweenFactor(kX0, kX1, measured, NoiseModel::Covariance(RandomCovariance<6>(rng, 1.0))), values);
  }
}

struct CylinderScene {
  Values values;
  Cylinder measured;
};

CylinderScene RandomScene(std::mt19937& rng, double error) {
  CylinderScene scene;
  const Eigen::Isometry3d T = RandomPose(rng);
  const Cylinder landmark = RandomCylinder(rng);
  scene.measured =
      TransformCylinder(T.inverse(), landmark).Slid(Normal(rng)).Retract(RandomVector<5>(rng, error));
  if (Normal(rng) > 0) scene.measured.axis = -scene.measured.axis;
  scene.values.Set(kX0, T);
  scene.values.Set(kL0, landmark);
  return scene;
}

TEST(CylinderFactors, JacobiansMatch) {
  std::mt19937 rng(5);
  for (int trial = 0; trial < 50; ++trial) {
    const CylinderScene scene = RandomScene(rng, trial % 3 == 0 ? 1e-5 : 0.2);
    const Matrix5d C = RandomCovariance<5>(rng, 1.0);
    ExpectJacobianMatches(CylinderFactor(kX0, kL0, scene.measured, C), scene.values);
    ExpectJacobianMatches(AxisFactor(kX0, kL0, scene.measured, NoiseModel::Unit(2)), scene.values);
    ExpectJacobianMatches(
        NormalFactor(kX0, kL0, scene.measured, NoiseModel::Covariance(RandomCovariance<2>(rng, 1.0))),
        scene.values);
    ExpectJacobianMatches(CurvatureFactor(kL0, 4.0, 0.5), scene.values);
  }
}

TEST(CylinderFactors, ResidualIsLocalCoordinatesAndParts) {
  std::mt19937 rng(6);
  const CylinderScene scene = RandomScene(rng, 0.1);
  const auto& T = scene.values.At<Eigen::Isometry3d>(kX0);
  const auto& landmark = scene.values.At<Cylinder>(kL0);
  const Matrix5d C = RandomCovariance<5>(rng, 0.1);
  const Vector5d expected =
      scene.measured.LocalCoordinates(TransformCylinder(T.inverse(), landmark));
  const CylinderResidual parts = InspectCylinder(scene.measured, C, T, landmark);
  EXPECT_LT((parts.axis - expected.head<2>()).norm(), 1e-12);
  EXPECT_LT((parts.normal - expected.segment<2>(2)).norm(), 1e-12);
  EXPECT_NEAR(parts.curvature, expected[4], 1e-12);
  EXPECT_NEAR(parts.chi2, expected.dot(C.inverse() * expected), 1e-9);
  EXPECT_NEAR(CylinderFactor(kX0, kL0, scene.measured, C).Error(scene.values), 0.5 * parts.chi2, 1e-9);
}

TEST(CylinderFactors, MotionAlongTheAxisIsFree) {
  // The thesis' normal factor pulls a sensor down that rises beside a vertical trunk (math.md 3).
  const Cylinder trunk{Eigen::Vector3d::UnitZ(), Eigen::Vector3d(3, 0, 1), 5.0};
  const CylinderFactor factor(kX0, kL0, Cylinder{Eigen::Vector3d::UnitZ(), {3, 0, 0}, 5.0},
                              1e-4 * Matrix5d::Identity());
  Values values;
  values.Set(kL0, trunk);
  for (const double height : {0.0, 1.0, 2.0}) {
    Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
    T.translation().z() = height;
    values.Set(kX0, T);
    EXPECT_NEAR(factor.Error(values), 0.0, 1e-18);
  }
}

TEST(CylinderFactors, PartsSwitchWeighAndGate) {
  std::mt19937 rng(7);
  const CylinderScene scene = RandomScene(rng, 0.1);
  const auto& T = scene.values.At<Eigen::Isometry3d>(kX0);
  const auto& landmark = scene.values.At<Cylinder>(kL0);
  const Matrix5d C = RandomCovariance<5>(rng, 0.1);
  const CylinderResidual inspected = InspectCylinder(scene.measured, C, T, landmark);
  CylinderParts only_axis;
  only_axis.normal = only_axis.curvature = false;
  only_axis.axis_weight = 3.0;
  const CylinderFactor axis(kX0, kL0, scene.measured, C, only_axis);
  EXPECT_NEAR(axis.Error(scene.values), 1.5 * inspected.axis_chi2, 1e-9);
  ExpectJacobianMatches(axis, scene.values);
  CylinderParts only_curvature;
  only_curvature.axis = only_curvature.normal = false;
  EXPECT_NEAR(CylinderFactor(kX0, kL0, scene.measured, C, only_curvature).Error(scene.values),
              CurvatureFactor(kL0, scene.measured.curvature, std::sqrt(C(4, 4))).Error(scene.values),
              1e-9);
  const CylinderParts gated = CylinderFactor(kX0, kL0, scene.measured, C)
                                  .Gate(T, landmark, 1e9, 0.0, 1e9);
  EXPECT_TRUE(gated.axis);
  EXPECT_FALSE(gated.normal);
  EXPECT_TRUE(gated.curvature);
  CylinderParts none;
  none.axis = none.normal = none.curvature = false;
  EXPECT_THROW(CylinderFactor(kX0, kL0, scene.measured, C, none), std::invalid_argument);
}

TEST(PointFactors, JacobiansMatch) {
  std::mt19937 rng(8);
  for (int trial = 0; trial < 20; ++trial) {
    Values values;
    values.Set(kX0, RandomPose(rng));
    values.Set(kL0, RandomCylinder(rng));
    values.Set(kP0, Eigen::Vector3d(RandomVector<3>(rng)));
    ExpectJacobianMatches(JunctionPointFactor(kX0, kP0, RandomVector<3>(rng),
                                              NoiseModel::Covariance(RandomCovariance<3>(rng, 1.0))),
                          values);
    ExpectJacobianMatches(PointOnAxisFactor(kL0, kP0, 0.5), values);
  }
}

TEST(PointFactors, DistanceToTheAxis) {
  Values values;
  values.Set(kL0, Cylinder{Eigen::Vector3d::UnitZ(), {1, 0, 0}, 5.0});
  values.Set(kP0, Eigen::Vector3d(1.3, 0.4, 7.0));
  EXPECT_NEAR(PointOnAxisFactor(kL0, kP0, 0.1).Error(values), 12.5, 1e-9);
}

TEST(Factor, WrongTypesAreNamed) {
  Values values;
  values.Set(kX0, Eigen::Vector3d(1, 2, 3));
  values.Set(kX1, Eigen::Isometry3d::Identity());
  const BetweenFactor factor(kX0, kX1, Eigen::Isometry3d::Identity(), NoiseModel::Unit(6));
  EXPECT_EQ(factor.Describe(), "between x0 x1");
  try {
    factor.Error(values);
    FAIL();
  } catch (const UnknownVariableError& error) {
    EXPECT_EQ(error.key(), kX0);
    EXPECT_THAT(error.what(), testing::HasSubstr("point"));
  }
}

}  // namespace
}  // namespace dendro
