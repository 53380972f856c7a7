// The optimum of small mapping graphs against a Ceres model that shares no code with the factors:
// other charts, numeric derivatives, Ceres' own robust losses.
#include <array>
#include <cmath>
#include <map>
#include <memory>
#include <random>
#include <vector>

#include <ceres/ceres.h>
#include <ceres/rotation.h>
#include <gmock/gmock.h>

#include "dendro_slam/factor_graph/between_factor.h"
#include "dendro_slam/factor_graph/cylinder_factor.h"
#include "dendro_slam/factor_graph/incremental_solver.h"
#include "dendro_slam/factor_graph/junction_point_factor.h"
#include "dendro_slam/factor_graph/prior_factor.h"
#include "graph_test_util.h"

namespace dendro {
namespace {

using namespace test;
using Eigen::Matrix3d;
using Eigen::Vector3d;

// Charts of the Ceres model: a pose is [angle-axis; translation], a cylinder is a displacement of a
// fixed line: axis ~ a0 + u b1 + v b2, point p0 + s b1 + t b2, curvature.
Matrix3d Rotation(const double* pose) {
  Matrix3d R;
  ceres::AngleAxisToRotationMatrix(pose, R.data());
  return R;
}

struct Line {
  Vector3d axis;
  Vector3d point;
  double curvature;
};

struct CylinderChart {
  Vector3d a0, b1, b2, p0;

  explicit CylinderChart(const Cylinder& c) : a0(c.axis), p0(c.point) {
    b1 = a0.unitOrthogonal();
    b2 = a0.cross(b1);
  }
  Line At(const double* x) const {
    return {(a0 + x[0] * b1 + x[1] * b2).normalized(), p0 + x[2] * b1 + x[3] * b2, x[4]};
  }
};

// The 5 residuals of an observation, from their definition: the rotation between the axes without
// sign, the piercing point in the plane through the measured anchor, the curvatures.
Vector5d ObservationResidual(const Cylinder& measured, const Line& seen) {
  const Vector3d axis = seen.axis.dot(measured.axis) < 0.0 ? Vector3d(-seen.axis) : seen.axis;
  const Eigen::Matrix<double, 3, 2> B = PerpendicularBasis(measured.axis);
  const Eigen::AngleAxisd turn(Eigen::Quaterniond::FromTwoVectors(measured.axis, axis));
  const double along = (measured.point - seen.point).dot(measured.axis) / axis.dot(measured.axis);
  Vector5d r;
  r << B.transpose() * (turn.angle() * turn.axis()),
      B.transpose() * (seen.point + along * axis - measured.point), seen.curvature - measured.curvature;
  return r;
}

struct Between {
  Matrix3d R;
  Vector3d t;
  Vector6d sigma;

  bool operator()(const double* a, const double* b, double* out) const {
    const Matrix3d Ra = Rotation(a), Rb = Rotation(b);
    const Vector3d ta(a[3], a[4], a[5]), tb(b[3], b[4], b[5]);
    return Residual(R.transpose() * Ra.transpose() * Rb,
                    R.transpose() * (Ra.transpose() * (tb - ta) - t), out);
  }
  bool operator()(const double* a, double* out) const {
    const Vector3d ta(a[3], a[4], a[5]);
    return Residual(R.transpose() * Rotation(a), R.transpose() * (ta - t), out);
  }
  bool Residual(const Matrix3d& E, const Vector3d& e, double* out) const {
    Vector3d w;
    ceres::RotationMatrixToAngleAxis(E.data(), w.data());
    Matrix3d W;
    W << 0, -w.z(), w.y(), w.z(), 0, -w.x(), -w.y(), w.x(), 0;
    // V = sum W^n / (n + 1)!
    Matrix3d V = Matrix3d::Identity(), term = Matrix3d::Identity();
    for (int n = 1; n < 25; ++n) {
      term = (term * W / (n + 1)).eval();
      V += term;
    }
    const Vector3d rho = V.partialPivLu().solve(e);
    for (int i = 0; i < 3; ++i) {
      out[i] = w[i] / sigma[i];
      out[3 + i] = rho[i] / sigma[3 + i];
    }
    return true;
  }
};

struct Observation {
  Cylinder measured;
  Matrix5d whitening;
  CylinderChart chart;

  bool operator()(const double* pose, const double* landmark, double* out) const {
    const Line line = chart.At(landmark);
    const Matrix3d Rt = Rotation(pose).transpose();
    const Vector3d t(pose[3], pose[4], pose[5]);
    Eigen::Map<Vector5d> r(out);
    r = whitening * ObservationResidual(measured, {Rt * line.axis, Rt * (line.point - t), line.curvature});
    return true;
  }
};

struct Junction {
  Vector3d measured;
  double sigma;

  bool operator()(const double* pose, const double* point, double* out) const {
    const Vector3d t(pose[3], pose[4], pose[5]);
    Eigen::Map<Vector3d> r(out);
    r = (Rotation(pose).transpose() * (Vector3d(point[0], point[1], point[2]) - t) - measured) / sigma;
    return true;
  }
};

struct OnAxis {
  CylinderChart chart;
  double sigma;

  bool operator()(const double* landmark, const double* point, double* out) const {
    const Line line = chart.At(landmark);
    Eigen::Map<Vector3d> r(out);
    r = line.axis.cross(Vector3d(point[0], point[1], point[2]) - line.point) / sigma;
    return true;
  }
};

struct Curvature {
  double measured, sigma;

  bool operator()(const double* landmark, double* out) const {
    out[0] = (landmark[4] - measured) / sigma;
    return true;
  }
};

// Dynamic covariance scaling as Agarwal et al. give it, for Ceres.
class DcsLoss : public ceres::LossFunction {
 public:
  explicit DcsLoss(double phi) : phi_(phi) {}
  void Evaluate(double s, double* rho) const override {
    if (s <= phi_) {
      rho[0] = s, rho[1] = 1.0, rho[2] = 0.0;
      return;
    }
    const double u = phi_ + s;
    rho[0] = 3.0 * phi_ - 4.0 * phi_ * phi_ / u;
    rho[1] = 4.0 * phi_ * phi_ / (u * u);
    rho[2] = -8.0 * phi_ * phi_ / (u * u * u);
  }

 private:
  double phi_;
};

ceres::LossFunction* Loss(const RobustKernel& kernel) {
  switch (kernel.type) {
    case RobustKernelType::kHuber:
      return new ceres::HuberLoss(kernel.parameter);
    case RobustKernelType::kCauchy:
      return new ceres::CauchyLoss(kernel.parameter);
    case RobustKernelType::kDcs:
      return new DcsLoss(kernel.parameter);
    default:
      return nullptr;
  }
}

template <int Rows, int A, class Functor>
ceres::CostFunction* Unary(const Functor& f) {
  return new ceres::NumericDiffCostFunction<Functor, ceres::CENTRAL, Rows, A>(new Functor(f));
}

template <int Rows, int A, int B, class Functor>
ceres::CostFunction* Binary(const Functor& f) {
  return new ceres::NumericDiffCostFunction<Functor, ceres::CENTRAL, Rows, A, B>(new Functor(f));
}

class CeresOracle : public testing::TestWithParam<int> {};

TEST_P(CeresOracle, SameOptimum) {
  constexpr int kPoses = 8;
  constexpr int kCylinders = 5;
  constexpr int kPoints = 2;
  const int seed = GetParam();
  std::mt19937 rng(static_cast<unsigned>(seed));
  const std::array<RobustKernel, 4> kernels = {RobustKernel{}, RobustKernel::Huber(1.5), RobustKernel::Cauchy(2.0),
                                               RobustKernel::Dcs(4.0)};
  FactorList factors;
  Values values;
  ceres::Problem problem;
  std::vector<std::array<double, 6>> poses(kPoses);
  std::vector<std::array<double, 5>> lines(kCylinders);
  std::vector<std::array<double, 3>> points(kPoints);
  std::vector<CylinderChart> charts;
  const auto X = [](int i) { return MakeKey('x', static_cast<std::uint64_t>(i)); };
  const auto L = [](int i) { return MakeKey('l', static_cast<std::uint64_t>(i)); };
  const auto P = [](int i) { return MakeKey('p', static_cast<std::uint64_t>(i)); };

  // Truth, and initial values off it.
  std::vector<Eigen::Isometry3d> truth;
  std::vector<Cylinder> trees;
  std::vector<Vector3d> junctions;
  for (int i = 0; i < kPoses; ++i) {
    Vector6d motion;
    motion << 0.05, -0.02, 0.25, 0.7, 0.1, 0.05;
    truth.push_back(i == 0 ? Eigen::Isometry3d::Identity() : Eigen::Isometry3d(truth.back() * ExpSe3(motion)));
    const Eigen::Isometry3d start = truth.back() * RandomPose(rng, 0.02, 0.05);
    values.Insert(X(i), start);
    const Matrix3d R = start.linear();
    ceres::RotationMatrixToAngleAxis(R.data(), poses[i].data());
    Eigen::Map<Vector3d>(poses[i].data() + 3) = start.translation();
  }
  for (int i = 0; i < kCylinders; ++i) {
    trees.push_back(RandomCylinder(rng));
    const Cylinder start = trees.back().Retract(RandomVector<5>(rng, 0.05));
    values.Insert(L(i), start);
    charts.emplace_back(start);
    lines[i] = {0, 0, 0, 0, start.curvature};
  }
  for (int i = 0; i < kPoints; ++i) {
    junctions.push_back(trees[i].point + 0.4 * trees[i].axis);
    const Vector3d start = junctions.back() + RandomVector<3>(rng, 0.05);
    values.Insert(P(i), start);
    points[i] = {start.x(), start.y(), start.z()};
  }

  const Vector6d prior_sigma = Vector6d::Constant(1e-2);
  factors.push_back(std::make_shared<PosePrior>(X(0), truth[0], NoiseModel::Sigmas(prior_sigma)));
  problem.AddResidualBlock(Unary<6, 6>(Between{truth[0].linear(), truth[0].translation(), prior_sigma}), nullptr,
                           poses[0].data());
  int count = 0;
  for (int i = 0; i < kPoses; ++i) {
    if (i > 0) {
      Vector6d sigma;
      sigma << 0.01, 0.02, 0.01, 0.03, 0.04, 0.02;
      const Eigen::Isometry3d Z =
          truth[i - 1].inverse() * truth[i] * ExpSe3(sigma.cwiseProduct(RandomVector<6>(rng)));
      const RobustKernel& kernel = kernels[i % 4];
      factors.push_back(
          std::make_shared<BetweenFactor>(X(i - 1), X(i), Z, NoiseModel::Sigmas(sigma).WithKernel(kernel)));
      problem.AddResidualBlock(Binary<6, 6, 6>(Between{Z.linear(), Z.translation(), sigma}), Loss(kernel),
                               poses[i - 1].data(), poses[i].data());
    }
    for (int l = 0; l < kCylinders; ++l) {
      if ((i + l) % 4 == 0) continue;
      const Matrix5d covariance = RandomCovariance<5>(rng, 0.02);
      // Every seventh observation is far off, so that the kernels have something to do.
      const double scale = ++count % 7 == 0 ? 8.0 : 1.0;
      const Eigen::LLT<Matrix5d> llt(covariance);
      const Matrix5d root = llt.matrixL();
      const Vector5d noise = scale * root * RandomVector<5>(rng);
      const Cylinder measured = TransformCylinder(truth[i].inverse(), trees[l]).Retract(noise);
      const RobustKernel& kernel = kernels[count % 4];
      factors.push_back(
          std::make_shared<CylinderFactor>(X(i), L(l), measured, covariance, CylinderParts{}, kernel));
      const Matrix5d whitening = llt.matrixL().solve(Matrix5d::Identity());
      problem.AddResidualBlock(Binary<5, 6, 5>(Observation{measured, whitening, charts[l]}), Loss(kernel),
                               poses[i].data(), lines[l].data());
    }
    for (int p = 0; p < kPoints; ++p) {
      const Vector3d seen = truth[i].inverse() * junctions[p] + RandomVector<3>(rng, 0.03);
      factors.push_back(
          std::make_shared<JunctionPointFactor>(X(i), P(p), seen, NoiseModel::Isotropic(3, 0.03)));
      problem.AddResidualBlock(Binary<3, 6, 3>(Junction{seen, 0.03}), nullptr, poses[i].data(), points[p].data());
    }
  }
  for (int p = 0; p < kPoints; ++p) {
    factors.push_back(std::make_shared<PointOnAxisFactor>(L(p), P(p), 0.02));
    problem.AddResidualBlock(Binary<3, 5, 3>(OnAxis{charts[p], 0.02}), nullptr, lines[p].data(), points[p].data());
  }
  for (int l = 0; l < kCylinders; ++l) {
    factors.push_back(std::make_shared<CurvatureFactor>(L(l), trees[l].curvature + 0.1, 0.2, RobustKernel::Huber(1.0)));
    problem.AddResidualBlock(Unary<1, 5>(Curvature{trees[l].curvature + 0.1, 0.2}), new ceres::HuberLoss(1.0),
                             lines[l].data());
  }

  // The same objective at the start: the models agree before anything is solved.
  double cost = 0.0;
  problem.Evaluate({}, &cost, nullptr, nullptr, nullptr);
  double own = 0.0;
  for (const FactorPtr& factor : factors) own += factor->Error(values);
  EXPECT_NEAR(own, cost, 1e-9 * cost);

  ceres::Solver::Options options;
  options.function_tolerance = 1e-15;
  options.gradient_tolerance = 1e-12;
  options.parameter_tolerance = 1e-14;
  options.max_num_iterations = 500;
  options.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);

  IncrementalSolver solver;
  const UpdateResult result = solver.OptimizeBatch(factors, values);
  EXPECT_TRUE(result.converged);
  EXPECT_LT(result.error_after, 0.9 * own);
  EXPECT_NEAR(result.error_after, summary.final_cost, 1e-6 * summary.final_cost);
  for (int i = 0; i < kPoses; ++i) {
    const auto& T = solver.Estimate<Eigen::Isometry3d>(X(i));
    EXPECT_LT((T.linear() - Rotation(poses[i].data())).norm(), 1e-4);
    EXPECT_LT((T.translation() - Eigen::Map<Vector3d>(poses[i].data() + 3)).norm(), 1e-4);
  }
  for (int l = 0; l < kCylinders; ++l) {
    const auto& c = solver.Estimate<Cylinder>(L(l));
    const Line line = charts[l].At(lines[l].data());
    EXPECT_LT(c.axis.cross(line.axis).norm(), 1e-4);
    EXPECT_LT(line.axis.cross(c.point - line.point).norm(), 1e-4);
    EXPECT_NEAR(c.curvature, line.curvature, 1e-3);
  }
  for (int p = 0; p < kPoints; ++p) {
    EXPECT_LT((solver.Estimate<Vector3d>(P(p)) - Eigen::Map<Vector3d>(points[p].data())).norm(), 1e-4);
  }
}

INSTANTIATE_TEST_SUITE_P(Seeds, CeresOracle, testing::Values(1, 2, 3, 4));

}  // namespace
}  // namespace dendro
