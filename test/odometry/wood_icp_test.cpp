#include "dendro_slam/odometry/wood_icp.h"

#include <chrono>
#include <cmath>
#include <random>

#include <Eigen/Eigenvalues>
#include <gtest/gtest.h>
#include <pcl/point_cloud.h>
#include <pcl/point_types.h>
#include <pcl/registration/gicp.h>

#include "synthetic_scan.h"

namespace dendro {
namespace {

using dendro_test::Rod;
using dendro_test::SimulateRods;
using dendro_test::ThesisLikeTree;

Eigen::Isometry3d PoseAt(double x, double y, double z, double yaw) {
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  T.translation() << x, y, z;
  T.linear() = Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  return T;
}

double RotationError(const Eigen::Isometry3d& a, const Eigen::Isometry3d& b) {
  return LogSe3(a.inverse() * b).head<3>().norm();
}

// A small motion as a drone makes it between two scans, by number.
Eigen::Isometry3d Motion(unsigned k) {
  std::mt19937 rng(1000 + k);
  std::normal_distribution<double> n(0.0, 1.0);
  Vector6d xi;
  xi << 0.01 * n(rng), 0.01 * n(rng), 0.03 * n(rng), 0.08 * n(rng), 0.08 * n(rng), 0.05 * n(rng);
  return ExpSe3(xi);
}

TEST(WoodIcp, FirstScanHasNoMotion) {
  WoodIcp icp;
  const LabelledScan scan = SimulateRods(ThesisLikeTree(), PoseAt(4, 0, 0.5, M_PI), 1000, 0.0, 1);
  EXPECT_FALSE(icp.AddScan(scan, std::nullopt));
  EXPECT_EQ(icp.status(), WoodIcpStatus::kFirstScan);
}

TEST(WoodIcp, SameScanIsIdentity) {
  WoodIcp icp;
  LabelledScan scan = SimulateRods(ThesisLikeTree(), PoseAt(4, 0, 0.5, M_PI), 1000, 0.0, 1);
  icp.AddScan(scan, std::nullopt);
  scan.image.stamp_ns = 2000;
  const auto motion = icp.AddScan(scan, std::nullopt);
  ASSERT_TRUE(motion);
  EXPECT_LT(LogSe3(motion->T_from_to).norm(), 1e-6);
  EXPECT_EQ(motion->from_stamp_ns, 1000);
  EXPECT_EQ(motion->to_stamp_ns, 2000);
}

TEST(WoodIcp, FindsAKnownMotionAtLeastAsWellAsPclGicp) {
  const auto tree = ThesisLikeTree();
  double ours = 0.0, ours_rotation = 0.0, theirs = 0.0, seconds = 0.0;
  int runs = 0;
  for (unsigned k = 0; k < 12; ++k) {
    const Eigen::Isometry3d A = PoseAt(4.0 * std::cos(0.5 * k), 4.0 * std::sin(0.5 * k), 0.3 + 0.1 * k,
                                       M_PI + 0.5 * k);
    const Eigen::Isometry3d truth = Motion(k);
    const LabelledScan first = SimulateRods(tree, A, 1000, 0.01, 2 * k);
    const LabelledScan second = SimulateRods(tree, A * truth, 100001000, 0.01, 2 * k + 1);
    WoodIcp icp;
    icp.AddScan(first, std::nullopt);
    const auto start = std::chrono::steady_clock::now();
    const auto motion = icp.AddScan(second, std::nullopt);
    seconds += std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    ASSERT_TRUE(motion) << ToString(icp.status()) << " run " << k;
    ours += (motion->T_from_to.translation() - truth.translation()).norm();
    ours_rotation += RotationError(motion->T_from_to, truth);

    const auto cloud = [](const LabelledScan& scan) {
      auto out = pcl::PointCloud<pcl::PointXYZ>::Ptr(new pcl::PointCloud<pcl::PointXYZ>);
      for (std::size_t i = 0; i < scan.image.size(); ++i) {
        if (!scan.image.HasReturn(i)) continue;
        const Eigen::Vector3f& p = scan.image.point[i];
        out->push_back({p.x(), p.y(), p.z()});
      }
      return out;
    };
    pcl::GeneralizedIterativeClosestPoint<pcl::PointXYZ, pcl::PointXYZ> gicp;
    gicp.setInputTarget(cloud(first));
    gicp.setInputSource(cloud(second));
    gicp.setMaxCorrespondenceDistance(0.5);
    pcl::PointCloud<pcl::PointXYZ> aligned;
    gicp.align(aligned);
    const Eigen::Matrix4f result = gicp.getFinalTransformation();
    theirs += (result.block<3, 1>(0, 3).cast<double>() - truth.translation()).norm();
    ++runs;
  }
  RecordProperty("mean_translation_error_m", std::to_string(ours / runs));
  RecordProperty("pcl_mean_translation_error_m", std::to_string(theirs / runs));
  RecordProperty("mean_ms", std::to_string(1e3 * seconds / runs));
  std::printf("translation error: ours %.4f m, PCL %.4f m; rotation %.4f rad; %.2f ms\n",
              ours / runs, theirs / runs, ours_rotation / runs, 1e3 * seconds / runs);
  EXPECT_LT(ours / runs, 0.035);
  EXPECT_LT(ours_rotation / runs, 0.012);
  EXPECT_LT(ours, theirs);
}

TEST(WoodIcp, CovarianceTellsTheError) {
  const auto tree = ThesisLikeTree();
  double nees = 0.0;
  int runs = 0;
  for (unsigned k = 0; k < 40; ++k) {
    const Eigen::Isometry3d A = PoseAt(4.0 * std::cos(0.16 * k), 4.0 * std::sin(0.16 * k), 0.8,
                                       M_PI + 0.16 * k);
    const Eigen::Isometry3d truth = Motion(k + 50);
    WoodIcp icp;
    icp.AddScan(SimulateRods(tree, A, 1000, 0.01, 2 * k, 900), std::nullopt);
    const auto motion =
        icp.AddScan(SimulateRods(tree, A * truth, 2000, 0.01, 2 * k + 1, 900), std::nullopt);
    if (!motion) continue;
    const Vector6d d = LogSe3(motion->T_from_to.inverse() * truth);
    nees += d.dot(motion->covariance.ldlt().solve(d));
    ++runs;
  }
  ASSERT_GE(runs, 36);
  std::printf("mean normalised error squared / 6: %.2f over %d runs\n", nees / runs / 6.0, runs);
  EXPECT_GT(nees / runs / 6.0, 0.05);
  EXPECT_LT(nees / runs / 6.0, 2.0);
}

TEST(WoodIcp, AlongALoneTrunkItKeepsTheGuessAndSaysSo) {
  const std::vector<Rod> trunk{{{0, 0, -10}, {0, 0, 10}, 0.2}};
  const Eigen::Isometry3d A = PoseAt(3, 0, 0, M_PI);
  const Eigen::Isometry3d truth = PoseAt(0.05, 0.03, 0.12, 0.0);
  WoodIcp icp;
  icp.AddScan(SimulateRods(trunk, A, 1000, 0.005, 1), std::nullopt);
  const Eigen::Isometry3d guess = PoseAt(0.04, 0.02, 0.09, 0.0);
  const auto motion = icp.AddScan(SimulateRods(trunk, A * truth, 2000, 0.005, 2), guess);
  ASSERT_TRUE(motion) << ToString(icp.status());
  EXPECT_GT(std::sqrt(motion->covariance(5, 5)), 0.3);
  EXPECT_NEAR(motion->T_from_to.translation().z(), 0.09, 0.02);
  // Towards the trunk it knows.
  EXPECT_LT(std::sqrt(motion->covariance(3, 3)), 0.05);
  EXPECT_NEAR(motion->T_from_to.translation().x(), 0.05, 0.02);
  Eigen::SelfAdjointEigenSolver<Matrix6d> eigen(motion->covariance);
  EXPECT_GT(eigen.eigenvalues().minCoeff(), 0.0);
}

TEST(WoodIcp, TooFewPointsAndTimeAreReported) {
  const std::vector<Rod> far{{{0, 0, -1}, {0, 0, 1}, 0.02}};
  WoodIcp icp;
  icp.AddScan(SimulateRods(far, PoseAt(10, 0, 0, 0), 1000, 0.0, 1), std::nullopt);
  EXPECT_FALSE(icp.AddScan(SimulateRods(far, PoseAt(10, 0, 0, 0), 2000, 0.0, 1), std::nullopt));
  EXPECT_EQ(icp.status(), WoodIcpStatus::kTooFewPoints);
  EXPECT_FALSE(icp.AddScan(SimulateRods(far, PoseAt(10, 0, 0, 0), 2000, 0.0, 1), std::nullopt));
  EXPECT_EQ(icp.status(), WoodIcpStatus::kTimeNotAhead);
  icp.Reset();
  icp.AddScan(SimulateRods(far, PoseAt(10, 0, 0, 0), 500, 0.0, 1), std::nullopt);
  EXPECT_EQ(icp.status(), WoodIcpStatus::kFirstScan);
}

TEST(WoodIcp, FallsBackOnAllReturns) {
  LabelledScan a = SimulateRods(ThesisLikeTree(), PoseAt(4, 0, 0.5, M_PI), 1000, 0.005, 1);
  LabelledScan b = SimulateRods(
      ThesisLikeTree(), PoseAt(4, 0, 0.5, M_PI) * PoseAt(0.05, 0.02, 0.03, 0.01), 2000, 0.005, 2);
  for (LabelledScan* scan : {&a, &b}) {
    for (std::size_t i = 0; i < scan->label.size(); ++i) {
      if (scan->image.HasReturn(i)) scan->label[i] = Label::kOther;
    }
  }
  WoodIcp icp;
  icp.AddScan(a, std::nullopt);
  const auto motion = icp.AddScan(b, std::nullopt);
  ASSERT_TRUE(motion) << ToString(icp.status());
  EXPECT_TRUE(icp.used_all_points());
  EXPECT_NEAR(motion->T_from_to.translation().x(), 0.05, 0.03);
  WoodIcpConfig strict;
  strict.use_all_points_below_wood_count = 0;
  WoodIcp wood_only(strict);
  wood_only.AddScan(a, std::nullopt);
  EXPECT_FALSE(wood_only.AddScan(b, std::nullopt));
}

TEST(WoodIcp, SameInputSameBytes) {
  const auto tree = ThesisLikeTree();
  Eigen::Matrix4d results[2];
  for (Eigen::Matrix4d& result : results) {
    WoodIcp icp;
    icp.AddScan(SimulateRods(tree, PoseAt(4, 0, 0.5, M_PI), 1000, 0.01, 1), std::nullopt);
    result = icp.AddScan(SimulateRods(tree, PoseAt(4.1, 0, 0.55, M_PI), 2000, 0.01, 2), std::nullopt)
                 ->T_from_to.matrix();
  }
  EXPECT_EQ(results[0], results[1]);
}

TEST(WoodIcp, BadConfigurationNamesTheField) {
  WoodIcpConfig config;
  config.noise_sigma_m = 0.0;
  try {
    WoodIcp icp(config);
    FAIL();
  } catch (const std::invalid_argument& e) {
    EXPECT_NE(std::string(e.what()).find("noise_sigma_m"), std::string::npos);
  }
}

}  // namespace
}  // namespace dendro
