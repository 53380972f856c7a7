#include "dendro_slam/mapping/ground_surface.h"

#include <gtest/gtest.h>

#include <cmath>
#include <functional>

namespace dendro {
namespace {

// The plane that touches z(x, y) below a lidar 1.6 m above it, as the lidar sees it, turned and leaned.
void See(const std::function<double(double, double)>& z,
         double x,
         double y,
         double turn,
         double lean,
         GroundSurface* surface,
         double height = 1.6) {
  constexpr double kStep = 1e-4;
  const Eigen::Vector2d slope((z(x + kStep, y) - z(x - kStep, y)) / (2.0 * kStep),
                              (z(x, y + kStep) - z(x, y - kStep)) / (2.0 * kStep));
  const Eigen::Vector3d normal = Eigen::Vector3d(-slope.x(), -slope.y(), 1.0).normalized();
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  T.translation() = Eigen::Vector3d(x, y, z(x, y) + height);
  T.linear() = (Eigen::AngleAxisd(turn, Eigen::Vector3d::UnitZ()) *
                Eigen::AngleAxisd(lean, Eigen::Vector3d::UnitY()))
                   .toRotationMatrix();
  GroundPlane plane;
  plane.normal = (T.linear().transpose() * normal).cast<float>();
  plane.offset = static_cast<float>(height * normal.z());
  surface->Add(plane, T);
}

TEST(GroundSurface, ASlopeIsExactEverywhereAroundTheWalk) {
  const auto slope = [](double x, double y) { return 0.7 + 0.25 * x - 0.1 * y; };
  GroundSurface surface;
  for (int i = 0; i < 60; ++i) See(slope, 0.2 * i, std::sin(0.2 * i), 0.1 * i, 0.02 * (i % 7), &surface);
  for (const Eigen::Vector2d& place : {Eigen::Vector2d(0, 3), Eigen::Vector2d(6, -4), Eigen::Vector2d(13, 2)}) {
    const auto ground = surface.At(place);
    ASSERT_TRUE(ground);
    EXPECT_NEAR(ground->z_m, slope(place.x(), place.y()), 1e-4);
    EXPECT_GE(ground->sigma_m, 0.01);
    EXPECT_LT(ground->sigma_m, 0.035);
  }
  EXPECT_FALSE(surface.At({40.0, 0.0}));  // Nobody was there.
}

TEST(GroundSurface, OnAHillTheNearPlanesDecideAndTheirDisagreementIsTheSigma) {
  const auto hill = [](double x, double y) { return 1.2 * std::sin(x / 8.0) + 0.05 * y; };
  GroundSurface surface;
  for (int i = 0; i < 200; ++i) See(hill, 0.12 * i, 3.0, 0.0, 0.0, &surface);
  for (const double x : {4.0, 10.0, 20.0}) {
    const auto ground = surface.At({x, 0.0});
    ASSERT_TRUE(ground);
    EXPECT_NEAR(ground->z_m, hill(x, 0.0), 0.08);
    EXPECT_LT(std::abs(ground->z_m - hill(x, 0.0)), 2.5 * ground->sigma_m);
  }
}

TEST(GroundSurface, IsTheSameAfterAFile) {
  const auto hill = [](double x, double y) { return 1.2 * std::sin(x / 8.0) + 0.05 * y; };
  GroundSurface surface, restored;
  for (int i = 0; i < 200; ++i) See(hill, 0.12 * i - 7.0, 3.0, 0.0, 0.0, &surface);
  restored.Restore(surface.Patches());
  for (const double x : {-5.0, 4.0, 10.0}) {
    EXPECT_NEAR(restored.At({x, 0.0})->z_m, surface.At({x, 0.0})->z_m, 1e-12);
    EXPECT_NEAR(restored.At({x, 0.0})->sigma_m, surface.At({x, 0.0})->sigma_m, 1e-12);
  }
  // And goes on.
  for (GroundSurface* s : {&surface, &restored}) See(hill, 2.0, 4.0, 0.0, 0.0, s);
  EXPECT_NEAR(restored.At({2.0, 5.0})->z_m, surface.At({2.0, 5.0})->z_m, 1e-12);
}

TEST(GroundSurface, LeavesOutBanksFarGroundAndTooFewScans) {
  const auto flat = [](double, double) { return 0.0; };
  const auto bank = [](double x, double) { return 0.8 * x; };
  GroundSurface surface;
  for (int i = 0; i < 9; ++i) See(flat, 0.0, 0.0, 0.0, 0.0, &surface);
  EXPECT_FALSE(surface.At({1.0, 0.0}));  // Nine scans.
  for (int i = 0; i < 50; ++i) See(bank, 1.0, 0.0, 0.0, 0.0, &surface);
  for (int i = 0; i < 50; ++i) See(flat, 1.0, 0.0, 0.0, 0.0, &surface, 8.0);
  EXPECT_FALSE(surface.At({1.0, 0.0}));
  See(flat, 0.5, 0.0, 0.0, 0.0, &surface);
  ASSERT_TRUE(surface.At({1.0, 0.0}));
  EXPECT_NEAR(surface.At({1.0, 0.0})->z_m, 0.0, 1e-6);
  surface.Clear();
  EXPECT_FALSE(surface.At({1.0, 0.0}));
}

}  // namespace
}  // namespace dendro
