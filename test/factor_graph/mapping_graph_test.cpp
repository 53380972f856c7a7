// The graph that the mapping builds, with all its kinds of factors and robust kernels, key frames
// taken out and landmarks merged: after convergence the incremental estimate and its marginals are
// those of batch solutions and of the dense Hessian of the factors that are left.
#include <cmath>
#include <map>
#include <memory>
#include <random>
#include <set>
#include <vector>

#include <gmock/gmock.h>
#include <Eigen/LU>

#include "dendro_slam/factor_graph/between_factor.h"
#include "dendro_slam/factor_graph/cylinder_factor.h"
#include "dendro_slam/factor_graph/incremental_solver.h"
#include "dendro_slam/factor_graph/prior_factor.h"
#include "dendro_slam/mapping/level_factors.h"
#include "dendro_slam/mapping/odometry_drift.h"
#include "graph_test_util.h"

namespace dendro {
namespace {

using namespace test;
using Eigen::Isometry3d;
using Eigen::Vector3d;

Key X(int i) { return MakeKey('x', static_cast<std::uint64_t>(i)); }
Key L(int i) { return MakeKey('l', static_cast<std::uint64_t>(i)); }
Key D(int i) { return MakeKey('d', static_cast<std::uint64_t>(i)); }
const Key kGround = MakeKey('g', 0);

constexpr int kKeyFrames = 80;
constexpr int kTrees = 8;
constexpr int kDriftEvery = 12;  // Key frames with one variable of the drift.
constexpr double kFalsePart = 0.05;

// The weights of robust kernels follow the residuals, so marginals are as exact as the convergence.
SolverConfig Exact() {
  SolverConfig config;
  config.relative_tolerance = 1e-14;
  return config;
}

NoiseModel Huber(const Vector6d& sigma) {
  return NoiseModel::Sigmas(sigma).WithKernel(RobustKernel::Huber(3.0));
}

// What a key frame brings: VIO with a drift, ICP, gravity, ground, and the cylinders in view, some
// false.
class MappingGraph : public testing::TestWithParam<int> {
 protected:
  MappingGraph() : rng_(static_cast<unsigned>(GetParam())) {
    std::uniform_real_distribution<double> uniform(-1.0, 1.0);
    for (int l = 0; l < kTrees; ++l) {
      Cylinder c;
      c.axis = (Vector3d::UnitZ() + RandomVector<3>(rng_, 0.3)).normalized();
      c.point = Vector3d(3.0 * uniform(rng_), 3.0 * uniform(rng_), 1.5);
      c.curvature = 1.0 / (0.1 + 0.05 * uniform(rng_));
      trees_.push_back(c);
    }
    vio_sigma_ << Vector3d::Constant(0.002), Vector3d::Constant(0.005);
    icp_sigma_ << Vector3d::Constant(0.01), Vector3d::Constant(0.02);
    cylinder_sigma_ << 0.02, 0.02, 0.01, 0.01, 0.5;
    drift_ << 0.015, 0.03, -0.02, 0.01;
  }

  static Isometry3d TruePose(int k) {
    const double angle = 2.0 * M_PI * k / 40.0;  // Two laps.
    Isometry3d T = Isometry3d::Identity();
    T.linear() = Eigen::AngleAxisd(angle + M_PI, Vector3d::UnitZ()).toRotationMatrix();
    T.translation() << 6.0 * std::cos(angle), 6.0 * std::sin(angle), 1.2 + 0.1 * std::sin(0.9 * k);
    return T;
  }

  // A landmark may be started twice: the second one is merged later.
  Key LandmarkOf(int tree, int k) const {
    return tree == 0 && k >= 30 && !merged_ ? L(100) : L(tree);
  }

  void AddKeyFrame(int k) {
    FactorList factors;
    Values values;
    const Isometry3d T = TruePose(k);
    Isometry3d guess = T;
    if (k == 0) {
      factors.push_back(std::make_shared<PosePrior>(X(0), T, NoiseModel::Isotropic(6, 1e-3)));
      const PointN flat = PointN::Zero(3);
      values.Insert(kGround, flat);
      factors.push_back(
          std::make_shared<VectorPrior>(kGround, flat, NoiseModel::Isotropic(3, 1.0)));
    } else {
      const Isometry3d motion = TruePose(k - 1).inverse() * T;
      const int d = (k - 1) / kDriftEvery;
      if ((k - 1) % kDriftEvery == 0) {
        const PointN zero = PointN::Zero(kDriftDimension);
        values.Insert(D(d), zero);
        if (d == 0) {
          factors.push_back(
              std::make_shared<VectorPrior>(D(0), zero, NoiseModel::Isotropic(4, 0.05)));
        } else {
          factors.push_back(std::make_shared<DriftChangeFactor>(
              D(d - 1), D(d), Eigen::Vector4d(1.0, 0.8, 0.8, 0.8), NoiseModel::Isotropic(4, 0.01)));
        }
      }
      const Eigen::Matrix3d R = TruePose(k - 1).linear();
      Isometry3d vio = motion;
      vio.translation() += DriftJacobian(motion, R) * drift_;
      vio = vio * ExpSe3(vio_sigma_.cwiseProduct(RandomVector<6>(rng_)));
      factors.push_back(
          std::make_shared<DriftingMotionFactor>(X(k - 1), X(k), D(d), vio, R, Huber(vio_sigma_)));
      if (k % 3 != 0) {
        const Isometry3d icp = motion * ExpSe3(icp_sigma_.cwiseProduct(RandomVector<6>(rng_)));
        factors.push_back(std::make_shared<BetweenFactor>(X(k - 1), X(k), icp, Huber(icp_sigma_)));
      }
      guess = solver_.Estimate<Isometry3d>(X(k - 1)) * vio;
    }
    values.Insert(X(k), guess);
    const Vector3d up =
        (T.linear().transpose() * Vector3d::UnitZ() + RandomVector<3>(rng_, 0.005)).normalized();
    factors.push_back(std::make_shared<GravityFactor>(
        X(k), up, NoiseModel::Isotropic(2, 0.005).WithKernel(RobustKernel::Huber(3.0))));
    if (k % 2 == 0) {
      factors.push_back(std::make_shared<GroundFactor>(
          X(k),
          kGround,
          up,
          T.translation().z() + 0.05 * Normal(rng_),
          NoiseModel::Sigmas(Vector3d(0.05, 0.03, 0.03)).WithKernel(RobustKernel::Cauchy(2.0))));
    }
    std::uniform_real_distribution<double> uniform(0.0, 1.0);
    for (int l = 0; l < kTrees; ++l) {
      if ((k / 10 + l) % 4 == 0) continue;  // Out of view.
      const double wrong = uniform(rng_) < kFalsePart ? 8.0 : 1.0;
      const Cylinder measured =
          TransformCylinder(T.inverse(), trees_[l])
              .Retract(wrong * Vector5d(cylinder_sigma_.cwiseProduct(RandomVector<5>(rng_))));
      const Key landmark = LandmarkOf(l, k);
      factors.push_back(
          std::make_shared<CylinderFactor>(X(k),
                                           landmark,
                                           measured,
                                           Matrix5d(cylinder_sigma_.cwiseAbs2().asDiagonal()),
                                           CylinderParts{},
                                           RobustKernel::Huber(1.5)));
      if (!solver_.Contains(landmark)) values.Insert(landmark, TransformCylinder(guess, measured));
    }
    const UpdateResult result = solver_.Update(factors, values);
    EXPECT_LE(result.error_after, result.error_before * (1 + 1e-12)) << k;
  }

  // Takes a key frame out; the motion over it takes its place.
  void RemoveKeyFrame(int k) {
    UpdateOptions options;
    options.remove_factors = solver_.FactorsOf(X(k));
    const Isometry3d motion = TruePose(k - 1).inverse() * TruePose(k + 1);
    solver_.Update({std::make_shared<BetweenFactor>(X(k - 1), X(k + 1), motion, Huber(icp_sigma_))},
                   {},
                   options);
    EXPECT_FALSE(solver_.Contains(X(k)));
  }

  void Merge() {
    UpdateOptions options;
    FactorList moved;
    for (const FactorId id : solver_.FactorsOf(L(100))) {
      const auto& seen = dynamic_cast<const CylinderFactor&>(*solver_.GetFactor(id));
      moved.push_back(std::make_shared<CylinderFactor>(seen.keys()[0],
                                                       L(0),
                                                       seen.measured(),
                                                       seen.covariance(),
                                                       seen.parts(),
                                                       seen.noise().kernel()));
      options.remove_factors.push_back(id);
    }
    solver_.Update(moved, {}, options);
    merged_ = true;
    EXPECT_FALSE(solver_.Contains(L(100)));
  }

  // Converges, and compares with batch solutions from two starts and with the dense Hessian.
  void ExpectBatch() {
    UpdateOptions converge;
    converge.converge = true;
    const double error = solver_.Update({}, {}, converge).error_after;
    const Values estimates = solver_.Estimates();
    std::set<FactorId> ids;
    std::map<Key, int> offset;
    int size = 0;
    for (const auto& [key, value] : estimates) {
      for (const FactorId id : solver_.FactorsOf(key)) ids.insert(id);
      offset[key] = size;
      size += TangentDimension(value);
    }
    FactorList left;
    for (const FactorId id : ids) left.push_back(solver_.GetFactor(id));
    ASSERT_EQ(static_cast<int>(left.size()), solver_.num_factors());
    for (const double disturbance : {0.0, 0.02}) {
      Values start;
      for (const auto& [key, value] : estimates) {
        double delta[kMaxTangentDimension];
        for (double& d : delta) d = disturbance * Normal(rng_);
        start.Insert(key, Retract(value, delta));
      }
      IncrementalSolver batch;
      EXPECT_NEAR(error, batch.OptimizeBatch(left, start).error_after, 1e-6 * error);
    }
    Eigen::MatrixXd H = Eigen::MatrixXd::Zero(size, size);
    for (const FactorPtr& factor : left) {
      Eigen::MatrixXd J;
      Eigen::VectorXd r;
      factor->Linearize(estimates, &J, &r);
      int ca = 0;
      for (const Key a : factor->keys()) {
        const int da = TangentDimension(estimates.Get(a));
        int cb = 0;
        for (const Key b : factor->keys()) {
          const int db = TangentDimension(estimates.Get(b));
          H.block(offset.at(a), offset.at(b), da, db) +=
              J.middleCols(ca, da).transpose() * J.middleCols(cb, db);
          cb += db;
        }
        ca += da;
      }
    }
    const Eigen::MatrixXd covariance = H.inverse();
    for (const auto& [key, value] : estimates) {
      const int d = TangentDimension(value);
      const Eigen::MatrixXd expected = covariance.block(offset.at(key), offset.at(key), d, d);
      EXPECT_LT((solver_.MarginalCovariance(key) - expected).norm(), 1e-5 * expected.norm())
          << KeyName(key);
    }
  }

  std::mt19937 rng_;
  std::vector<Cylinder> trees_;
  Vector6d vio_sigma_, icp_sigma_;
  Vector5d cylinder_sigma_;
  Eigen::Vector4d drift_;
  bool merged_ = false;
  IncrementalSolver solver_{Exact()};
};

TEST_P(MappingGraph, IncrementalEqualsBatch) {
  for (int k = 0; k < kKeyFrames; ++k) {
    AddKeyFrame(k);
    if (k == 45) Merge();
    if (k > 50 && k % 10 == 5) RemoveKeyFrame(k - 40);
    if (k % 40 == 39) ExpectBatch();
  }
  // And it is a map: the landmarks stand where the trees do, in spite of drift and false
  // observations.
  for (int l = 0; l < kTrees; ++l) {
    const Vector5d error = trees_[l].LocalCoordinates(solver_.Estimate<Cylinder>(L(l)));
    EXPECT_LT(error.head<2>().norm(), 0.02) << l;
    EXPECT_LT(error.segment<2>(2).norm(), 0.02) << l;
  }
}

INSTANTIATE_TEST_SUITE_P(Seeds, MappingGraph, testing::Range(1, 4));

}  // namespace
}  // namespace dendro
