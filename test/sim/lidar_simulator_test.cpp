#include "dendro_slam/sim/lidar_simulator.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <functional>
#include <stdexcept>
#include <vector>

#include <gtest/gtest.h>

#include "cylinder_information.h"

#include "dendro_slam/sim/flight_path.h"
#include "dendro_slam/sim/scene_generator.h"

namespace dendro {
namespace {

Scene EmptyScene() {
  Scene scene;
  scene.ground.type = SceneGround::Type::kNone;
  return scene;
}

SceneBox Wall(double x, double y_from, double y_to) {
  SceneBox box;
  box.size_m = {0.2, y_to - y_from, 20.0};
  box.position = {x + 0.1, 0.5 * (y_from + y_to), 0.0};
  return box;
}

/// No random effect and no footprint.
LidarSimulatorConfig Ideal() {
  LidarSimulatorConfig config;
  config.enable_range_noise = false;
  config.enable_quantisation = false;
  config.enable_footprint = false;
  config.enable_detection_limit = false;
  config.enable_dropouts = false;
  config.enable_intensity_noise = false;
  return config;
}

TEST(LidarSimulator, WallByHand) {
  Scene scene = EmptyScene();
  scene.obstacles.push_back(Wall(5.0, -50.0, 50.0));
  const Raycaster raycaster(scene);
  const LidarSimulator simulator(raycaster, Ideal(), 7000000000);
  const SimulatedScan out = simulator.SimulateScan(3, Eigen::Isometry3d::Identity());
  EXPECT_EQ(out.scan.stamp_ns, simulator.ScanStamp(3));
  EXPECT_NEAR(static_cast<double>(out.firings.size()), 1808.4, 1.0);
  EXPECT_NEAR(static_cast<double>(out.scan.stamp_ns - 7000000000) * 1e-9, 0.3, 56e-6);
  ASSERT_GT(out.scan.points.size(), 12000u);
  std::size_t negative_azimuth = 0;
  for (std::size_t i = 0; i < out.scan.points.size(); ++i) {
    const LidarPoint& p = out.scan.points[i];
    EXPECT_NEAR(p.position.x(), 5.0, 1e-4);
    EXPECT_LT(p.ring, 16);
    const double elevation = std::atan2(p.position.z() - vlp16::RingVerticalOffsetM(p.ring), std::hypot(p.position.x(), p.position.y()));
    EXPECT_NEAR(elevation * 180.0 / M_PI, -15.0 + 2.0 * p.ring, 1e-3);
    // The head turns clockwise: azimuth = rate * time since the zero crossing.
    const double turned = 3600.0 * (static_cast<double>(out.scan.stamp_ns - 7000000000) * 1e-9 + p.time_s) - 3 * 360.0;
    double difference = vlp16::AzimuthDegOf(p.position.x(), p.position.y()) - turned;
    difference -= 360.0 * std::round(difference / 360.0);
    EXPECT_NEAR(difference, 0.0, 2e-3);
    negative_azimuth += p.position.y() > 0 ? 1 : 0;
    if (i > 0) {
      EXPECT_GT(p.time_s, out.scan.points[i - 1].time_s);
    }
    EXPECT_EQ(out.truth[i].kind, SurfaceKind::kObstacle);
  }
  // Clockwise from +x: the right half (y < 0) comes first.
  EXPECT_LT(out.scan.points.front().position.y(), 0.1);
  EXPECT_GT(out.scan.points.back().position.y(), -0.1);
  EXPECT_GT(negative_azimuth, 5000u);
}

TEST(LidarSimulator, ScansFollowEachOtherWithoutGapOrOverlap) {
  const Raycaster raycaster(EmptyScene());
  const LidarSimulator simulator(raycaster, Ideal());
  std::int64_t next = 0;
  for (int i = 0; i < 5; ++i) {
    const SimulatedScan out = simulator.SimulateScan(i, Eigen::Isometry3d::Identity());
    EXPECT_EQ(out.firings.front().stamp_ns, next);
    EXPECT_LT(out.firings.front().azimuth_deg, vlp16::FiringPitchDeg(600.0));
    next = out.firings.back().stamp_ns + 55296;
  }
  EXPECT_EQ(simulator.NumScans(10.0), 100);
}

TEST(LidarSimulator, MovingSensorDistortsTheSweep) {
  Scene scene = EmptyScene();
  scene.obstacles.push_back(Wall(5.0, -50.0, 50.0));
  const Raycaster raycaster(scene);
  const LidarSimulator simulator(raycaster, Ideal());
  const SimulatedScan out = simulator.SimulateScan(0, [](std::int64_t stamp_ns) {
    return Eigen::Isometry3d(Eigen::Translation3d(2.0 * static_cast<double>(stamp_ns) * 1e-9, 0, 0));
  });
  for (const LidarPoint& p : out.scan.points) EXPECT_NEAR(p.position.x() + 2.0 * p.time_s, 5.0, 2e-4);
}

TEST(LidarSimulator, RangeNoiseHasItsSigmaAndQuantisationItsStep) {
  Scene scene = EmptyScene();
  scene.obstacles.push_back(Wall(5.0, -50.0, 50.0));
  const Raycaster raycaster(scene);
  LidarSimulatorConfig config = Ideal();
  config.enable_range_noise = true;
  config.enable_quantisation = true;
  const SimulatedScan out = LidarSimulator(raycaster, config).SimulateScan(0, Eigen::Isometry3d::Identity());
  double sum = 0, square = 0;
  for (std::size_t i = 0; i < out.scan.points.size(); ++i) {
    const Eigen::Vector3d p = out.scan.points[i].position.cast<double>() -
                              Eigen::Vector3d(0, 0, vlp16::RingVerticalOffsetM(out.scan.points[i].ring));
    const double e = p.norm() - static_cast<double>(out.truth[i].thin_range_m);
    sum += e;
    square += e * e;
    const double steps = p.norm() / 0.002;
    EXPECT_NEAR(steps, std::round(steps), 5e-3);
  }
  const double n = static_cast<double>(out.scan.points.size());
  EXPECT_NEAR(sum / n, 0.0, 4 * 0.01 / std::sqrt(n));
  EXPECT_NEAR(std::sqrt(square / n), std::hypot(0.01, 0.002 / std::sqrt(12.0)), 3e-4);
}

// The thesis' noise: every error within +-3 cm equally likely, none beyond; beside the gaussian one
// where both are set.
TEST(LidarSimulator, EvenNoiseIsEvenAndBounded) {
  Scene scene = EmptyScene();
  scene.obstacles.push_back(Wall(5.0, -50.0, 50.0));
  const Raycaster raycaster(scene);
  LidarSimulatorConfig config = Ideal();
  config.enable_range_noise = true;
  config.range_uniform_m = 0.03;
  const auto errors = [&](double sigma) {
    config.range_sigma_m = sigma;
    const SimulatedScan out = LidarSimulator(raycaster, config).SimulateScan(0, Eigen::Isometry3d::Identity());
    std::vector<double> e;
    for (std::size_t i = 0; i < out.scan.points.size(); ++i) {
      const Eigen::Vector3d p = out.scan.points[i].position.cast<double>() -
                                Eigen::Vector3d(0, 0, vlp16::RingVerticalOffsetM(out.scan.points[i].ring));
      e.push_back(p.norm() - static_cast<double>(out.truth[i].thin_range_m));
    }
    return e;
  };
  const std::vector<double> even = errors(0.0);
  const double n = static_cast<double>(even.size());
  ASSERT_GT(n, 12000);
  int part[6] = {};
  for (const double e : even) {
    ASSERT_LE(std::abs(e), 0.03 + 1e-5);
    ++part[std::min(5, std::max(0, static_cast<int>((e + 0.03) / 0.01)))];
  }
  for (const int count : part) EXPECT_NEAR(count, n / 6.0, 4.0 * std::sqrt(n * 5.0 / 36.0));
  double square = 0.0;
  for (const double e : errors(0.01)) square += e * e;
  EXPECT_NEAR(std::sqrt(square / n), std::hypot(0.01, 0.03 / std::sqrt(3.0)), 4e-4);
  config.range_uniform_m = -0.01;
  EXPECT_THROW(config.Validate(), std::invalid_argument);
}

// What the Cramer-Rao bound of fit_benchmark expects of a beam on a leaning cylinder.
TEST(LidarSimulator, TheBoundOfTheFitExpectsWhatIsSimulated) {
  const double radius = 0.08;
  const Eigen::Vector3d axis = Eigen::Vector3d(0.2, 0.3, 1.0).normalized(), centre(4.0, 0.0, 0.0);
  Scene scene = EmptyScene();
  SceneTree tree;
  tree.branches.push_back({0, -1, {{centre - 10.0 * axis, radius}, {centre + 10.0 * axis, radius}}, false});
  scene.trees.push_back(tree);
  const Raycaster raycaster(scene);
  LidarSimulatorConfig config = Ideal();
  config.enable_footprint = true;
  config.sub_rays_width = 24;
  config.sub_rays_height = 9;
  const SimulatedScan out = LidarSimulator(raycaster, config).SimulateScan(0, Eigen::Isometry3d::Identity());
  const Cylinder cylinder{axis, centre, 1.0 / radius};
  double square = 0.0;
  int whole = 0, cut = 0;
  for (const LidarPoint& p : out.scan.points) {
    const Eigen::Vector3d origin(0, 0, vlp16::RingVerticalOffsetM(p.ring));
    const Eigen::Vector3d ray = p.position.cast<double>() - origin;
    const BeamExpectation expected = ExpectBeam(cylinder, origin, ray.normalized(), config);
    EXPECT_GT(expected.part, 0.0);
    ++(expected.part > 0.999 ? whole : cut);
    const double error = ray.norm() - expected.range_m;
    EXPECT_LT(std::abs(error), 0.006) << expected.part;
    square += error * error;
  }
  EXPECT_GT(whole, 50);
  EXPECT_GT(cut, 10);
  EXPECT_LT(std::sqrt(square / (whole + cut)), 0.0015);
}

TEST(LidarSimulator, EdgeOfAPlateBlursOverTheFootprint) {
  // A plate whose left edge is at y = 0; nothing behind. The last beam that returns is the one whose
  // footprint still has a fifth on the plate.
  Scene scene = EmptyScene();
  scene.obstacles.push_back(Wall(6.0, -30.0, 0.0));
  const Raycaster raycaster(scene);
  LidarSimulatorConfig config = Ideal();
  config.enable_footprint = true;
  config.enable_detection_limit = true;
  config.detection_softness = 0.0;
  config.sub_rays_width = 40;
  config.sub_rays_height = 1;
  const LidarSimulator simulator(raycaster, config);
  int wrong = 0, near_edge = 0;
  for (int scan = 0; scan < 12; ++scan) {
    const SimulatedScan out = simulator.SimulateScan(scan, Eigen::Isometry3d::Identity());
    for (const RawFiring& firing : out.firings) {
      for (int laser = 0; laser < 16; ++laser) {
        double azimuth = firing.azimuth_deg + 3600.0 * vlp16::LaserTimeS(laser);
        if (azimuth > 180.0) azimuth -= 360.0;
        if (std::abs(azimuth) > 2.0) continue;
        // Brute force: every ray of a dense fan across the beam, met with the plane x = 6.
        const double elevation = vlp16::kElevationDeg[static_cast<std::size_t>(laser)] * M_PI / 180.0;
        int on = 0;
        constexpr int kRays = 1501;
        for (int i = 0; i < kRays; ++i) {
          const double u = (i + 0.5) / kRays - 0.5;
          const double a = azimuth * M_PI / 180.0;
          // Left of the beam is (sin a, cos a, 0); the beam is (cos e cos a, -cos e sin a, sin e).
          const double dx = std::cos(elevation) * std::cos(a) + u * 0.003 * std::sin(a);
          const double dy = -std::cos(elevation) * std::sin(a) + u * 0.003 * std::cos(a);
          const double x0 = u * 0.0095 * std::sin(a), y0 = u * 0.0095 * std::cos(a);
          const double t = (6.0 - x0) / dx;
          if (y0 + t * dy < 0.0) ++on;
        }
        const double part = static_cast<double>(on) / kRays;
        const bool detected = firing.strongest[static_cast<std::size_t>(laser)].range_m > 0.0F;
        if (part > 0.0 && part < 1.0) ++near_edge;
        if (std::abs(part - 0.2) < 0.03) continue;  // Finer than 40 sub-rays can tell.
        if (detected != (part > 0.2)) ++wrong;
      }
    }
  }
  EXPECT_GT(near_edge, 200);
  EXPECT_EQ(wrong, 0);
}

TEST(LidarSimulator, ThinTwigIsSeenAsOftenAsTheIntegralSays) {
  // A vertical twig of 1 cm at several distances, nothing behind it. The part of the footprint on it
  // depends on where between two firings it stands; every beam is compared with the integral.
  for (const double distance : {4.0, 8.0, 12.0, 16.0}) {
    Scene scene = EmptyScene();
    SceneTree tree;
    tree.name = "twig";
    tree.branches.push_back({0, -1, {{{distance, 0, -10}, 0.005}, {{distance, 0, 10}, 0.005}}, false});
    scene.trees.push_back(tree);
    const Raycaster raycaster(scene);
    LidarSimulatorConfig config = Ideal();
    config.enable_footprint = true;
    config.enable_detection_limit = true;
    config.detection_softness = 0.0;
    config.sub_rays_width = 250;
    config.sub_rays_height = 1;
    const LidarSimulator simulator(raycaster, config);
    int seen = 0, wrong = 0;
    for (int scan = 0; scan < 3; ++scan) {
      const SimulatedScan out = simulator.SimulateScan(scan, Eigen::Isometry3d::Identity());
      for (const RawFiring& firing : out.firings) {
        for (int laser = 0; laser < 16; ++laser) {
          double azimuth = firing.azimuth_deg + 3600.0 * vlp16::LaserTimeS(laser);
          if (azimuth > 180.0) azimuth -= 360.0;
          const bool detected = firing.strongest[static_cast<std::size_t>(laser)].range_m > 0.0F;
          if (std::abs(azimuth) > 1.0) {
            EXPECT_FALSE(detected);
            continue;
          }
          const double elevation = vlp16::kElevationDeg[static_cast<std::size_t>(laser)] * M_PI / 180.0;
          constexpr int kRays = 1001;
          int on = 0;
          for (int i = 0; i < kRays; ++i) {
            // In the horizontal plane: distance of the ray from the twig's axis.
            const double u = (i + 0.5) / kRays - 0.5;
            const double a = azimuth * M_PI / 180.0;
            Eigen::Vector2d d(std::cos(elevation) * std::cos(a) + u * 0.003 * std::sin(a),
                              -std::cos(elevation) * std::sin(a) + u * 0.003 * std::cos(a));
            d.normalize();
            const Eigen::Vector2d m = Eigen::Vector2d(distance, 0) - u * 0.0095 * Eigen::Vector2d(std::sin(a), std::cos(a));
            if (std::abs(m.x() * d.y() - m.y() * d.x()) <= 0.005) ++on;
          }
          const double part = static_cast<double>(on) / kRays;
          seen += part > 0.2 ? 1 : 0;
          if (std::abs(part - 0.2) > 0.006 && detected != (part > 0.2)) ++wrong;
        }
      }
    }
    // At 12 m the beam is 4.55 cm wide and the twig fills 0.22 of it; at 16 m only 0.17.
    EXPECT_EQ(seen > 0, distance < 13.0) << distance;
    EXPECT_EQ(wrong, 0) << distance;
  }
}

TEST(LidarSimulator, MixedPixelsLieBetweenABranchAndTheWallBehindIt) {
  // Wall 0.4 m behind the plate's edge: beams that hang over the edge give one echo in between, at the
  // energy-weighted mean.
  Scene scene = EmptyScene();
  scene.obstacles.push_back(Wall(6.0, -30.0, 0.0));
  scene.obstacles.push_back(Wall(6.4, -30.0, 30.0));
  const Raycaster raycaster(scene);
  LidarSimulatorConfig config = Ideal();
  config.enable_footprint = true;
  config.sub_rays_width = 40;
  config.sub_rays_height = 1;
  const SimulatedScan out = LidarSimulator(raycaster, config).SimulateScan(0, Eigen::Isometry3d::Identity());
  int mixed = 0;
  for (const LidarPoint& p : out.scan.points) {
    if (std::abs(p.position.y()) > 0.5 || p.position.x() < 0) continue;
    if (p.position.x() > 6.01 && p.position.x() < 6.39) {
      ++mixed;
      EXPECT_LT(std::abs(p.position.y()), 0.5 * (0.0095 + 6.4 * 0.003) + 1e-3);
      // Energy-weighted mean of two planes seen alike: weights q / 6^2 and (1 - q) / 6.4^2, where q is
      // the part of the beam to the right of the edge.
      const double width = 0.0095 + 6.0 * 0.003;
      const double y = p.position.y() * 6.0 / p.position.x();
      const double q = std::clamp(0.5 - y / width, 0.0, 1.0);
      const double a = q / 36.0, b = (1.0 - q) / 40.96;
      EXPECT_NEAR(p.position.x(), (6.0 * a + 6.4 * b) / (a + b), 0.02);
    }
  }
  EXPECT_GT(mixed, 8);

  // A wall 3 m behind is another echo: no pixels in between.
  scene.obstacles[1] = Wall(9.0, -30.0, 30.0);
  const Raycaster far(scene);
  const SimulatedScan strongest = LidarSimulator(far, config).SimulateScan(0, Eigen::Isometry3d::Identity());
  for (const LidarPoint& p : strongest.scan.points) {
    if (std::abs(p.position.y()) > 5.0) continue;  // The far end of the wall blurs too.
    EXPECT_TRUE(p.position.x() < 6.01 || p.position.x() > 8.99) << p.position.transpose();
  }
  // And dual return reports both at the edge.
  config.return_mode = "dual";
  const SimulatedScan dual = LidarSimulator(far, config).SimulateScan(0, Eigen::Isometry3d::Identity());
  int pairs = 0;
  for (const RawFiring& firing : dual.firings) {
    for (int laser = 0; laser < 16; ++laser) {
      const auto l = static_cast<std::size_t>(laser);
      if (firing.strongest[l].range_m != firing.last[l].range_m) ++pairs;
    }
  }
  EXPECT_GT(pairs, 8);
  EXPECT_EQ(dual.scan.points.size(), strongest.scan.points.size() + static_cast<std::size_t>(pairs));
}

/// What one ray of an independent integral over the footprint meets.
struct OracleHit {
  double range_m = 0.0;   ///< 0: nothing.
  double reflected = 0.0; ///< Reflectivity times cosine of incidence.
};
using OracleScene = std::function<OracleHit(const Eigen::Vector3d& o, const Eigen::Vector3d& d)>;

/// A round twig: all points nearer than `radius` to the line through `p` along the unit vector `a`.
OracleHit MeetTwig(const Eigen::Vector3d& o, const Eigen::Vector3d& d, const Eigen::Vector3d& p,
                   const Eigen::Vector3d& a, double radius, double reflectivity) {
  // In the plane perpendicular to the twig.
  const Eigen::Vector3d m = (o - p) - (o - p).dot(a) * a, v = d - d.dot(a) * a;
  const double qa = v.squaredNorm(), qb = m.dot(v), qc = m.squaredNorm() - radius * radius;
  const double disc = qb * qb - qa * qc;
  if (disc < 0.0) return {};
  const double t = (-qb - std::sqrt(disc)) / qa;
  if (t <= 0.0) return {};
  const Eigen::Vector3d normal = (m + t * v) / radius;
  return {t, reflectivity * -normal.dot(d)};
}

OracleHit MeetBox(const Eigen::Vector3d& o, const Eigen::Vector3d& d, const SceneBox& box, double reflectivity) {
  double enter = -1e9, leave = 1e9, cosine = 0.0;
  for (int i = 0; i < 3; ++i) {
    const double a = (box.position[i] - 0.5 * box.size_m[i] - o[i]) / d[i];
    const double b = (box.position[i] + 0.5 * box.size_m[i] - o[i]) / d[i];
    if (std::min(a, b) > enter) {
      enter = std::min(a, b);
      cosine = std::abs(d[i]);
    }
    leave = std::min(leave, std::max(a, b));
  }
  return enter > 0.0 && enter < leave ? OracleHit{enter, reflectivity * cosine} : OracleHit{};
}

/// Sums over all beams that touch the target.
struct FootprintFigures {
  double beams = 0.0;        ///< That touch it at all, by the integral.
  double expected = 0.0;     ///< Returns that the integral predicts.
  double found = 0.0;        ///< Returns of the simulator.
  double range_bias_m = 0.0; ///< Simulator minus integral, over returns with a near surface in both.
  double range_rms_m = 0.0;
  double mixed_expected = 0.0, mixed_found = 0.0;  ///< Ranges between the two surfaces.
};

/// `near_m` and `far_m` are depths along x: a nearer hit is on the target, a range between is mixed.
/// Flies a few revolutions past the target and integrates every beam near it over 60 x 40 rays. All of
/// the beam's geometry is written here again from the manual: aperture 9.5 x 12.7 mm, divergence 3.0 x
/// 1.5 mrad, a rectangle; an echo needs a fifth of the footprint, softly (sigma 0.1 of the logarithm).
FootprintFigures CompareWithIntegral(const Scene& scene, const OracleScene& oracle, double near_m, double far_m) {
  const Raycaster raycaster(scene);
  LidarSimulatorConfig config;  // All defaults but noise: 8 x 3 sub-rays.
  config.enable_range_noise = config.enable_quantisation = config.enable_dropouts = false;
  const LidarSimulator simulator(raycaster, config);
  FootprintFigures f;
  double pairs = 0.0;
  for (int scan = 0; scan < 6; ++scan) {
    // A little to the side each time, so that the target lies everywhere between two beams.
    Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
    T.translation() = Eigen::Vector3d(0.0, 0.0031 * scan, 0.0093 * scan);
    const SimulatedScan out = simulator.SimulateScan(scan, T);
    for (const RawFiring& firing : out.firings) {
      for (int laser = 0; laser < 16; ++laser) {
        const auto l = static_cast<std::size_t>(laser);
        double azimuth = firing.azimuth_deg + 3600.0 * vlp16::LaserTimeS(laser);
        if (azimuth > 180.0) azimuth -= 360.0;
        if (std::abs(azimuth) > 6.0) continue;
        const double a = azimuth * M_PI / 180.0, e = vlp16::kElevationDeg[l] * M_PI / 180.0;
        const Eigen::Vector3d direction(std::cos(e) * std::cos(a), -std::cos(e) * std::sin(a), std::sin(e));
        const Eigen::Vector3d left(std::sin(a), std::cos(a), 0.0), up = direction.cross(left);
        const Eigen::Vector3d origin = T.translation() + vlp16::BeamOrigin(laser);
        constexpr int kWide = 60, kHigh = 40;
        double near_part = 0.0, part = 0.0, energy = 0.0, range = 0.0;
        for (int i = 0; i < kWide; ++i) {
          for (int j = 0; j < kHigh; ++j) {
            const double u = (i + 0.5) / kWide - 0.5, v = (j + 0.5) / kHigh - 0.5;
            const OracleHit hit = oracle(origin + u * 0.0095 * left + v * 0.0127 * up,
                                         (direction + u * 0.0030 * left + v * 0.0015 * up).normalized());
            if (hit.range_m == 0.0) continue;
            part += 1.0 / (kWide * kHigh);
            if (hit.range_m * direction.x() < near_m) near_part += 1.0 / (kWide * kHigh);
            const double w = hit.reflected / (hit.range_m * hit.range_m);
            energy += w;
            range += w * hit.range_m;
          }
        }
        if (near_part == 0.0) continue;
        range /= energy;
        f.beams += 1.0;
        // The chance that the fraction exceeds 0.2 exp(0.1 g) of a standard normal g.
        f.expected += 0.5 * std::erfc(-std::log(part / 0.2) / 0.1 / std::sqrt(2.0));
        const double measured = static_cast<double>(firing.strongest[l].range_m);
        if (measured > 0.0) f.found += 1.0;
        const auto mixed = [&](double r) {
          return r * direction.x() > near_m && r * direction.x() < far_m ? 1.0 : 0.0;
        };
        if (part > 0.3) {
          f.mixed_expected += mixed(range);
          f.mixed_found += mixed(measured);
          if (measured > 0.0) {
            pairs += 1.0;
            f.range_bias_m += measured - range;
            f.range_rms_m += (measured - range) * (measured - range);
          }
        }
      }
    }
  }
  f.range_bias_m /= std::max(1.0, pairs);
  f.range_rms_m = std::sqrt(f.range_rms_m / std::max(1.0, pairs));
  return f;
}

Scene TwigScene(const Eigen::Vector3d& p, const Eigen::Vector3d& a, double radius) {
  Scene scene = EmptyScene();
  SceneTree tree;
  tree.name = "twig";
  tree.branches.push_back({0, -1, {{p - 10.0 * a, radius}, {p + 10.0 * a, radius}}, false});
  scene.trees.push_back(tree);
  return scene;
}

TEST(LidarSimulator, TheDefaultSubRaysDetectTwigsAndPlatesAsTheIntegralOverTheFootprintDoes) {
  for (const double distance : {3.0, 6.0, 9.0, 11.0}) {
    for (const double tilt_deg : {0.0, 35.0, 60.0}) {
      // A twig of 1 cm, upright to leaning.
      const Eigen::Vector3d p(distance, 0.01, 0.02);
      const Eigen::Vector3d a(0.0, std::sin(tilt_deg * M_PI / 180.0), std::cos(tilt_deg * M_PI / 180.0));
      const FootprintFigures f = CompareWithIntegral(
          TwigScene(p, a, 0.005),
          [&](const Eigen::Vector3d& o, const Eigen::Vector3d& d) { return MeetTwig(o, d, p, a, 0.005, 0.4); },
          distance + 5.0, distance + 6.0);
      ASSERT_GT(f.beams, 20.0);
      // One or two beams near the limit of detection are chance.
      EXPECT_NEAR(f.found / f.beams, f.expected / f.beams, 0.06 + 1.5 / f.beams) << distance << " m, " << tilt_deg << " deg";
      EXPECT_LT(std::abs(f.range_bias_m), 0.001);
    }
    // A plate of 1 cm seen edge-on: 30 cm deep, standing along the beam.
    Scene scene = EmptyScene();
    SceneBox plate;
    plate.size_m = {0.3, 0.01, 20.0};
    plate.position = {distance + 0.15, 0.004, 0.0};
    scene.obstacles.push_back(plate);
    const FootprintFigures f = CompareWithIntegral(
        scene, [&](const Eigen::Vector3d& o, const Eigen::Vector3d& d) { return MeetBox(o, d, plate, 0.6); },
        distance + 5.0, distance + 6.0);
    ASSERT_GT(f.beams, 100.0);
    EXPECT_NEAR(f.found / f.beams, f.expected / f.beams, 0.06) << distance;
    EXPECT_LT(std::abs(f.range_bias_m), 0.004) << distance;
  }
}

TEST(LidarSimulator, ABranchBeforeAWallGivesTheMixedPixelsOfTheIntegral) {
  for (const double distance : {4.0, 7.0}) {
    // A branch of 8 cm, leaning, and a wall 0.4 m behind it.
    const Eigen::Vector3d p(distance, 0.0, 0.0), a(0.0, std::sin(0.5), std::cos(0.5));
    Scene scene = TwigScene(p, a, 0.04);
    scene.obstacles.push_back(Wall(distance + 0.4, -30.0, 30.0));
    const OracleScene oracle = [&](const Eigen::Vector3d& o, const Eigen::Vector3d& d) {
      const OracleHit branch = MeetTwig(o, d, p, a, 0.04, scene.reflectivity.trunk);
      if (branch.range_m > 0.0) return branch;
      const double t = (distance + 0.4 - o.x()) / d.x();
      return OracleHit{t, scene.reflectivity.obstacle * d.x()};
    };
    // More than 5 cm from either surface is mixed.
    const FootprintFigures f = CompareWithIntegral(scene, oracle, distance + 0.05, distance + 0.35);
    EXPECT_GT(f.mixed_expected, 40.0) << distance;
    EXPECT_NEAR(f.mixed_found, f.mixed_expected, 0.1 * f.mixed_expected) << distance;
    EXPECT_LT(std::abs(f.range_bias_m), 0.003) << distance;
    EXPECT_LT(f.range_rms_m, 0.03) << distance;
    std::printf("branch at %.0f m: %.0f beams, mixed %.0f of %.0f predicted, range %+.1f mm, rms %.1f mm\n", distance,
                f.beams, f.mixed_found, f.mixed_expected, 1e3 * f.range_bias_m, 1e3 * f.range_rms_m);
  }
}

TEST(LidarSimulator, IntensityTellsReflectivityAndIncidence) {
  Scene scene = EmptyScene();
  scene.obstacles.push_back(Wall(5.0, -50.0, 50.0));
  scene.reflectivity.obstacle = 0.6;
  const Raycaster raycaster(scene);
  const SimulatedScan out = LidarSimulator(raycaster, Ideal()).SimulateScan(0, Eigen::Isometry3d::Identity());
  for (const LidarPoint& p : out.scan.points) {
    const Eigen::Vector3d d = p.position.cast<double>() - Eigen::Vector3d(0, 0, vlp16::RingVerticalOffsetM(p.ring));
    EXPECT_NEAR(p.intensity, 60.0 * d.x() / d.norm(), 0.51);
  }
  scene.reflectivity.obstacle = 1.8;
  const Raycaster retro(scene);
  for (const LidarPoint& p : LidarSimulator(retro, Ideal()).SimulateScan(0, Eigen::Isometry3d::Identity()).scan.points) {
    EXPECT_GT(p.intensity, 100.0F);
  }
}

TEST(LidarSimulator, RangeLimits) {
  Scene scene = EmptyScene();
  scene.obstacles.push_back(Wall(0.3, -0.2, 0.2));
  scene.obstacles.push_back(Wall(5.0, -50.0, 50.0));
  const Raycaster raycaster(scene);
  LidarSimulatorConfig config = Ideal();
  config.max_range_m = 8.0;
  const SimulatedScan out = LidarSimulator(raycaster, config).SimulateScan(0, Eigen::Isometry3d::Identity());
  ASSERT_FALSE(out.scan.points.empty());
  for (const LidarPoint& p : out.scan.points) {
    EXPECT_GT(p.position.norm(), 4.9);
    EXPECT_LT(p.position.norm(), 8.05);
    // The near plate gives nothing but hides what is behind it.
    EXPECT_GT(std::abs(p.position.y()), 5.0 * 0.2 / 0.5 - 0.2);
  }
}

TEST(LidarSimulator, SwitchesDoNotDisturbEachOther) {
  Scene scene = EmptyScene();
  scene.obstacles.push_back(Wall(5.0, -50.0, 50.0));
  const Raycaster raycaster(scene);
  LidarSimulatorConfig config = Ideal();
  config.enable_dropouts = true;
  config.dropout_probability = 0.1;
  const SimulatedScan a = LidarSimulator(raycaster, config).SimulateScan(0, Eigen::Isometry3d::Identity());
  config.enable_range_noise = true;
  config.enable_intensity_noise = true;
  const SimulatedScan b = LidarSimulator(raycaster, config).SimulateScan(0, Eigen::Isometry3d::Identity());
  ASSERT_EQ(a.scan.points.size(), b.scan.points.size());
  for (std::size_t i = 0; i < a.scan.points.size(); ++i) {
    EXPECT_EQ(a.scan.points[i].time_s, b.scan.points[i].time_s);
  }
  config.enable_dropouts = false;
  const SimulatedScan c = LidarSimulator(raycaster, config).SimulateScan(0, Eigen::Isometry3d::Identity());
  EXPECT_NEAR(static_cast<double>(b.scan.points.size()) / static_cast<double>(c.scan.points.size()), 0.9, 0.01);
}

TEST(LidarSimulator, SameSeedSameBytesWhateverTheNumberOfThreads) {
  SceneGeneratorConfig generator;
  generator.leaf_probability = 1.0;
  const Raycaster raycaster(GenerateScene(generator, 2));
  FlightPath path = ParseFlightPath(
      "type: circle\nradius_m: 5\naltitude_m: 1.5\nspeed_mps: 2\nlook_at: [0, 0, 1]\nduration_s: 0.9\n", "t.yaml");
  LidarSimulatorConfig config;
  config.sub_rays_width = 4;
  config.sub_rays_height = 1;
  config.record_all_beams = true;
  const LidarSimulator simulator(raycaster, config, path.start_stamp_ns);
  const auto bytes = [&](int threads) {
    std::string all;
    int expected = 0;
    SimulateFlight(simulator, path, threads, [&](int index, const SimulatedScan& scan) {
      EXPECT_EQ(index, expected++);
      for (const LidarPoint& p : scan.scan.points) {
        char buffer[24];
        std::memcpy(buffer, p.position.data(), 12);
        std::memcpy(buffer + 12, &p.intensity, 4);
        std::memcpy(buffer + 16, &p.time_s, 4);
        std::memcpy(buffer + 20, &p.ring, 2);
        all.append(buffer, 22);
      }
      for (const PointTruth& t : scan.truth) {
        all.append(reinterpret_cast<const char*>(&t.branch_id), 2);
        all.append(reinterpret_cast<const char*>(&t.thin_range_m), 4);
      }
      EXPECT_EQ(scan.beams.size(), 16 * scan.firings.size());
      return true;
    });
    EXPECT_EQ(expected, 9);
    return all;
  };
  const std::string one = bytes(1);
  EXPECT_GT(one.size(), 100000u);
  EXPECT_EQ(one, bytes(3));
  LidarSimulatorConfig other = config;
  other.seed = 2;
  const LidarSimulator reseeded(raycaster, other, path.start_stamp_ns);
  const auto a = simulator.SimulateScan(0, Eigen::Isometry3d::Identity());
  const auto b = reseeded.SimulateScan(0, Eigen::Isometry3d::Identity());
  EXPECT_NE(a.scan.points[10].position, b.scan.points[10].position);
}

TEST(LidarSimulator, AConsumerCanStopTheFlightAndErrorsComeThrough) {
  const Raycaster raycaster(EmptyScene());
  const FlightPath path = ParseFlightPath(
      "type: circle\nradius_m: 5\naltitude_m: 1.5\nspeed_mps: 2\nyaw: 0\nduration_s: 2\n", "t.yaml");
  const LidarSimulator simulator(raycaster, Ideal(), path.start_stamp_ns);
  int count = 0;
  SimulateFlight(simulator, path, 2, [&](int, const SimulatedScan&) { return ++count < 3; });
  EXPECT_EQ(count, 3);
  EXPECT_THROW(SimulateFlight(simulator, path, 2,
                              [](int, const SimulatedScan&) -> bool { throw std::runtime_error("disk full"); }),
               std::runtime_error);
}

TEST(LidarSimulatorConfig, NamesTheFieldThatIsWrong) {
  const auto message = [](auto&& change) {
    LidarSimulatorConfig config;
    change(&config);
    try {
      config.Validate();
    } catch (const std::invalid_argument& e) {
      return std::string(e.what());
    }
    return std::string();
  };
  EXPECT_EQ(message([](LidarSimulatorConfig*) {}), "");
  EXPECT_NE(message([](LidarSimulatorConfig* c) { c->rpm = 100; }).find("rpm"), std::string::npos);
  EXPECT_NE(message([](LidarSimulatorConfig* c) { c->return_mode = "first"; }).find("return_mode"), std::string::npos);
  EXPECT_NE(message([](LidarSimulatorConfig* c) { c->range_sigma_m = -1; }).find("range_sigma_m"), std::string::npos);
  EXPECT_NE(message([](LidarSimulatorConfig* c) { c->sub_rays_width = 0; }).find("sub_rays_width"), std::string::npos);
  EXPECT_NE(message([](LidarSimulatorConfig* c) { c->max_range_m = 0.1; }).find("max_range_m"), std::string::npos);
}

}  // namespace
}  // namespace dendro
