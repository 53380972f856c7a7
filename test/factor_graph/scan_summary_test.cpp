// Scans between key frames as one factor per landmark, against the dense normal equations of the
// scans and against the graph that keeps every scan.
#include <map>
#include <memory>
#include <random>
#include <vector>

#include <gmock/gmock.h>
#include <Eigen/LU>

#include "dendro_slam/factor_graph/between_factor.h"
#include "dendro_slam/factor_graph/incremental_solver.h"
#include "dendro_slam/factor_graph/prior_factor.h"
#include "dendro_slam/factor_graph/scan_summary.h"
#include "graph_test_util.h"

namespace dendro {
namespace {

using namespace test;

constexpr int kCylinders = 7;

Key X(int i) { return MakeKey('x', static_cast<std::uint64_t>(i)); }
Key L(int i) { return MakeKey('l', static_cast<std::uint64_t>(i)); }

// A flight past cylinders: the factors of every scan, and where odometry alone puts it.
struct Flight {
  std::vector<Cylinder> trees;
  std::vector<FactorList> scans;
  std::vector<Eigen::Isometry3d> odometry;

  Flight(unsigned seed, int count) {
    std::mt19937 rng(seed);
    Vector6d sigma;
    sigma << 0.002, 0.002, 0.002, 0.01, 0.01, 0.01;
    Vector5d cylinder_sigma;
    cylinder_sigma << 0.02, 0.02, 0.015, 0.015, 0.3;
    const Matrix5d covariance = cylinder_sigma.cwiseAbs2().asDiagonal();
    for (int l = 0; l < kCylinders; ++l) trees.push_back(RandomCylinder(rng));
    Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
    odometry = {T};
    for (int k = 0; k < count; ++k) {
      FactorList factors;
      if (k > 0) {
        Vector6d motion;
        motion << 0.0, 0.0, 0.02, 0.08, 0.01, 0.0;
        T = T * ExpSe3(motion);
        const Eigen::Isometry3d Z =
            ExpSe3(motion) * ExpSe3(sigma.cwiseProduct(RandomVector<6>(rng)));
        factors.push_back(
            std::make_shared<BetweenFactor>(X(k - 1), X(k), Z, NoiseModel::Sigmas(sigma)));
        odometry.push_back(odometry.back() * Z);
      }
      for (int l = 0; l < kCylinders; ++l) {
        if ((k + l) % 3 == 0) continue;  // No scan sees all.
        const Cylinder measured = TransformCylinder(T.inverse(), trees[l])
                                      .Retract(cylinder_sigma.cwiseProduct(RandomVector<5>(rng)));
        factors.push_back(std::make_shared<CylinderFactor>(X(k), L(l), measured, covariance));
      }
      scans.push_back(factors);
    }
  }

  // Factors and estimates of the scans after `first` up to `last`.
  FactorList Between(int first, int last, Values* poses) const {
    FactorList out;
    poses->Insert(X(first), odometry[first]);
    for (int k = first + 1; k <= last; ++k) {
      out.insert(out.end(), scans[k].begin(), scans[k].end());
      poses->Insert(X(k), odometry[k]);
    }
    return out;
  }
};

TEST(ScanSummary, CarriesTheMarginalsOfTheDenseNormalEquations) {
  const Flight flight(3, 6);
  Values poses;
  const FactorList factors = flight.Between(0, 5, &poses);
  const ScanSummary summary = SummarizeScans(X(0), X(5), factors, poses);
  ASSERT_EQ(summary.factors.size(), 1u + kCylinders);
  ASSERT_EQ(summary.scans.size(), 6u);

  // All variables of the scans but X(5), which is the origin, at the summary's estimate.
  Values at;
  std::map<Key, int> offset;
  int size = 0;
  for (const auto& [key, T_to_scan] : summary.scans) {
    at.Insert(key, T_to_scan);
    if (key == X(5)) continue;
    offset[key] = size;
    size += 6;
  }
  EXPECT_LT((summary.scans.at(X(5)).matrix() - Eigen::Matrix4d::Identity()).norm(), 1e-9);
  for (std::size_t i = 1; i < summary.factors.size(); ++i) {
    const auto& seen = dynamic_cast<const CylinderFactor&>(*summary.factors[i]);
    EXPECT_EQ(seen.keys()[0], X(5));
    at.Insert(seen.keys()[1], seen.measured());
    offset[seen.keys()[1]] = size;
    size += 5;
  }
  Eigen::MatrixXd H = Eigen::MatrixXd::Zero(size, size);
  Eigen::VectorXd g = Eigen::VectorXd::Zero(size);
  for (const FactorPtr& factor : factors) {
    Eigen::MatrixXd J;
    Eigen::VectorXd r;
    factor->Linearize(at, &J, &r);
    Eigen::MatrixXd wide = Eigen::MatrixXd::Zero(J.rows(), size);
    int column = 0;
    for (const Key key : factor->keys()) {
      const int d = TangentDimension(at.Get(key));
      if (key != X(5)) wide.middleCols(offset.at(key), d) = J.middleCols(column, d);
      column += d;
    }
    H += wide.transpose() * wide;
    g -= wide.transpose() * r;
  }
  const Eigen::MatrixXd covariance = H.inverse();
  // It is the optimum: what is left to move is far below the sigmas.
  EXPECT_LT((covariance * g).cwiseQuotient(covariance.diagonal().cwiseSqrt()).cwiseAbs().maxCoeff(),
            1e-2);
  for (std::size_t i = 1; i < summary.factors.size(); ++i) {
    const auto& seen = dynamic_cast<const CylinderFactor&>(*summary.factors[i]);
    const int o = offset.at(seen.keys()[1]);
    const Matrix5d expected = covariance.block<5, 5>(o, o);
    EXPECT_LT((seen.covariance() - expected).norm(), 1e-6 * expected.norm())
        << KeyName(seen.keys()[1]);
  }
  const auto& motion = dynamic_cast<const BetweenFactor&>(*summary.factors[0]);
  EXPECT_EQ(motion.keys()[0], X(5));
  EXPECT_EQ(motion.keys()[1], X(0));
  const Eigen::MatrixXd W = motion.noise().sqrt_information();
  const Matrix6d expected = covariance.block<6, 6>(offset.at(X(0)), offset.at(X(0)));
  EXPECT_LT(((W.transpose() * W).inverse() - expected).norm(), 1e-6 * expected.norm());
}

// Which frame the estimates are in does not matter.
TEST(ScanSummary, DoesNotDependOnTheFrame) {
  const Flight flight(4, 5);
  Values poses, moved;
  const FactorList factors = flight.Between(0, 4, &poses);
  std::mt19937 rng(9);
  const Eigen::Isometry3d T = RandomPose(rng);
  for (const auto& [key, pose] : poses) {
    moved.Insert(key, Eigen::Isometry3d(T * std::get<Eigen::Isometry3d>(pose)));
  }
  const ScanSummary a = SummarizeScans(X(0), X(4), factors, poses);
  const ScanSummary b = SummarizeScans(X(0), X(4), factors, moved);
  ASSERT_EQ(a.factors.size(), b.factors.size());
  for (std::size_t i = 1; i < a.factors.size(); ++i) {
    const auto& one = dynamic_cast<const CylinderFactor&>(*a.factors[i]);
    const auto& other = dynamic_cast<const CylinderFactor&>(*b.factors[i]);
    EXPECT_LT(one.measured().LocalCoordinates(other.measured()).norm(), 1e-8);
  }
}

// A flight of key frames only, every fifth scan, knows the landmarks as well as one of all scans.
TEST(ScanSummary, KeyFramesKnowWhatAllScansKnow) {
  constexpr int kStride = 5, kCount = 101;
  const Flight flight(5, kCount);
  const FactorPtr prior =
      std::make_shared<PosePrior>(X(0), flight.odometry[0], NoiseModel::Isotropic(6, 1e-3));
  const auto start_of = [&](const FactorList& factors, Values values) {
    for (const FactorPtr& factor : factors) {
      const auto* seen = dynamic_cast<const CylinderFactor*>(factor.get());
      if (seen == nullptr || values.Contains(seen->keys()[1])) continue;
      values.Insert(
          seen->keys()[1],
          TransformCylinder(values.At<Eigen::Isometry3d>(seen->keys()[0]), seen->measured()));
    }
    return values;
  };
  FactorList all = {prior}, key_frames = {prior};
  Values all_poses, key_poses;
  for (int k = 0; k < kCount; ++k) {
    all.insert(all.end(), flight.scans[k].begin(), flight.scans[k].end());
    all_poses.Insert(X(k), flight.odometry[k]);
    if (k % kStride == 0) key_poses.Insert(X(k), flight.odometry[k]);
  }
  key_frames.insert(key_frames.end(), flight.scans[0].begin(), flight.scans[0].end());
  for (int k = kStride; k < kCount; k += kStride) {
    Values poses;
    const FactorList factors = flight.Between(k - kStride, k, &poses);
    const ScanSummary summary = SummarizeScans(X(k - kStride), X(k), factors, poses);
    key_frames.insert(key_frames.end(), summary.factors.begin(), summary.factors.end());
  }
  IncrementalSolver full, few;
  full.OptimizeBatch(all, start_of(all, all_poses));
  few.OptimizeBatch(key_frames, start_of(key_frames, key_poses));
  EXPECT_EQ(few.num_variables(), kCylinders + (kCount + kStride - 1) / kStride);
  for (int l = 0; l < kCylinders; ++l) {
    const auto& expected = full.Estimate<Cylinder>(L(l));
    const Matrix5d P = full.MarginalCovariance(L(l));
    const Vector5d difference = expected.LocalCoordinates(few.Estimate<Cylinder>(L(l)));
    // Axis and line move by less than their sigmas.
    for (int i = 0; i < 4; ++i)
      EXPECT_LT(std::abs(difference[i]), std::sqrt(P(i, i))) << l << " " << i;
    // The curvature is no matter of poses: nothing of it is lost.
    EXPECT_NEAR(difference[4], 0.0, 1e-6 * expected.curvature);
    EXPECT_NEAR(few.MarginalCovariance(L(l))(4, 4), P(4, 4), 1e-6 * P(4, 4));
  }
}

TEST(ScanSummary, NamesWhatIsMissing) {
  const Flight flight(6, 4);
  Values poses;
  FactorList factors = flight.Between(0, 3, &poses);
  Values few;
  few.Insert(X(0), flight.odometry[0]);
  few.Insert(X(3), flight.odometry[3]);
  try {
    SummarizeScans(X(0), X(3), factors, few);
    FAIL();
  } catch (const UnknownVariableError& e) {
    EXPECT_EQ(e.key(), X(1));
  }
  // Nobody measured this landmark's curvature.
  const auto& seen = dynamic_cast<const CylinderFactor&>(*factors.back());
  CylinderParts parts;
  parts.curvature = false;
  factors.push_back(
      std::make_shared<CylinderFactor>(X(2), L(99), seen.measured(), seen.covariance(), parts));
  try {
    SummarizeScans(X(0), X(3), factors, poses);
    FAIL();
  } catch (const UnderconstrainedError& e) {
    EXPECT_EQ(e.key(), L(99));
  }
}

}  // namespace
}  // namespace dendro
