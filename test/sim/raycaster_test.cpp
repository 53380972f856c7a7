#include "dendro_slam/sim/raycaster.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <optional>
#include <random>

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <gtest/gtest.h>

#include "dendro_slam/sim/scene_generator.h"

namespace dendro {
namespace {

using Inside = std::function<bool(const Eigen::Vector3d&)>;

Scene EmptyScene() {
  Scene scene;
  scene.ground.type = SceneGround::Type::kNone;
  return scene;
}

Scene BranchScene(const std::vector<BranchPoint>& points) {
  Scene scene = EmptyScene();
  SceneTree tree;
  tree.name = "tree";
  tree.branches.push_back({0, -1, points, false});
  scene.trees.push_back(tree);
  return scene;
}

/// Independent oracle: walks along the ray in small steps until it is inside the solid, then bisects.
std::optional<double> March(const Inside& inside,
                            const Eigen::Vector3d& o,
                            const Eigen::Vector3d& d,
                            double from,
                            double to,
                            double step) {
  bool before = inside(o + from * d);
  for (double t = from + step; t <= to; t += step) {
    if (inside(o + t * d) == before) continue;
    double a = t - step, b = t;
    for (int i = 0; i < 60; ++i) {
      const double m = 0.5 * (a + b);
      (inside(o + m * d) == before ? a : b) = m;
    }
    return 0.5 * (a + b);
  }
  return std::nullopt;
}

/// The definition of a branch's solid: its frusta and, at the bends, the wedges of spheres.
Inside BranchSolid(const std::vector<BranchPoint>& points) {
  return [points](const Eigen::Vector3d& p) {
    for (std::size_t i = 1; i < points.size(); ++i) {
      const Eigen::Vector3d a = points[i - 1].position, b = points[i].position;
      const double length = (b - a).norm();
      if (length == 0.0) continue;
      const Eigen::Vector3d axis = (b - a) / length;
      const double s = (p - a).dot(axis);
      const double r = points[i - 1].radius_m + (points[i].radius_m - points[i - 1].radius_m) * s / length;
      if (s >= 0 && s <= length && (p - a - s * axis).norm() <= r) return true;
      if (i + 1 < points.size() && (points[i + 1].position - b).norm() > 0.0) {
        const Eigen::Vector3d next = (points[i + 1].position - b).normalized();
        if ((p - b).norm() <= points[i].radius_m && (p - b).dot(axis) >= 0 && (p - b).dot(next) <= 0) return true;
      }
    }
    return false;
  };
}

struct Comparison {
  std::vector<double> errors;
  int hits = 0, ghosts = 0, misses = 0;

  double P99() {
    std::sort(errors.begin(), errors.end());
    return errors.empty() ? 1.0 : errors[errors.size() * 99 / 100];
  }
};

/// Rays towards a ball around the solid, from 2 to 30 m away.
Comparison CompareWithOracle(const Scene& scene,
                             const Inside& inside,
                             const Eigen::Vector3d& centre,
                             double radius,
                             int rays,
                             unsigned seed) {
  const Raycaster raycaster(scene);
  std::mt19937 rng(seed);
  std::normal_distribution<double> n;
  std::uniform_real_distribution<double> u(0.0, 1.0);
  constexpr double kStep = 5e-4;
  Comparison result;
  for (int i = 0; i < rays; ++i) {
    const Eigen::Vector3d away = Eigen::Vector3d(n(rng), n(rng), n(rng)).normalized();
    const Eigen::Vector3d o = centre + (radius + 2.0 + 28.0 * u(rng)) * away;
    const Eigen::Vector3d at = centre + radius * std::cbrt(u(rng)) * Eigen::Vector3d(n(rng), n(rng), n(rng)).normalized();
    const Eigen::Vector3d d = (at - o).normalized();
    const double middle = (centre - o).dot(d);
    const auto truth = March(inside, o, d, middle - radius - 0.1, middle + radius + 0.1, kStep);
    const auto hit = raycaster.Cast(o, d);
    if (hit && truth && std::abs(hit->range_m - *truth) < kStep) {
      ++result.hits;
      result.errors.push_back(std::abs(hit->range_m - *truth));
      EXPECT_LE(hit->normal.dot(d), 0.0);
      EXPECT_NEAR(hit->normal.norm(), 1.0, 1e-9);
    } else if (hit) {
      // The oracle's step may have jumped over a sliver: look again around the hit, finely.
      const auto fine = March(inside, o, d, hit->range_m - 2e-4, hit->range_m + 2e-4, 1e-7);
      if (fine) {
        ++result.hits;
        result.errors.push_back(std::abs(hit->range_m - *fine));
      } else {
        // A sliver thinner than a tenth of a micrometre is no ghost.
        const bool grazing = inside(o + (hit->range_m + 1e-9) * d) || std::abs(hit->normal.dot(d)) < 1e-3;
        if (!grazing) ++result.ghosts;
      }
    } else if (truth) {
      ++result.misses;
    }
  }
  return result;
}

TEST(Raycaster, CylinderByHand) {
  const Raycaster raycaster(BranchScene({{{4, 0, -1}, 0.5}, {{4, 0, 3}, 0.5}}));
  const auto hit = raycaster.Cast({0, 0, 1}, {1, 0, 0});
  ASSERT_TRUE(hit);
  EXPECT_NEAR(hit->range_m, 3.5, 1e-12);
  EXPECT_TRUE(hit->normal.isApprox(Eigen::Vector3d(-1, 0, 0), 1e-12));
  EXPECT_EQ(hit->kind, SurfaceKind::kTrunk);
  EXPECT_EQ(hit->tree_id, 0);
  EXPECT_EQ(hit->branch_id, 0);
  EXPECT_FALSE(raycaster.Cast({0, 0, 3.1}, {1, 0, 0}));
  EXPECT_FALSE(raycaster.Cast({0, 0.51, 1}, {1, 0, 0}));
  EXPECT_FALSE(raycaster.Cast({0, 0, 1}, {1, 0, 0}, 3.4));
  // The flat ends.
  EXPECT_NEAR(raycaster.Cast({4.2, 0.1, 10}, {0, 0, -1})->range_m, 7.0, 1e-12);
  EXPECT_NEAR(raycaster.Cast({4.2, 0.1, -10}, {0, 0, 1})->range_m, 9.0, 1e-12);
  // From inside, the far wall; with a least range, the second wall.
  EXPECT_NEAR(raycaster.Cast({4, 0, 1}, {1, 0, 0})->range_m, 0.5, 1e-12);
  EXPECT_NEAR(raycaster.Cast({0, 0, 1}, {1, 0, 0}, 100.0, 3.6)->range_m, 4.5, 1e-12);
}

TEST(Raycaster, ConeByHand) {
  // Radius 1 at z = 0, 0 at z = 2: at z = 1 the radius is 0.5 and the slope -1/2.
  const Raycaster raycaster(BranchScene({{{0, 0, 0}, 1.0}, {{0, 0, 2}, 0.0}}));
  const auto hit = raycaster.Cast({-5, 0, 1}, {1, 0, 0});
  ASSERT_TRUE(hit);
  EXPECT_NEAR(hit->range_m, 4.5, 1e-12);
  EXPECT_TRUE(hit->normal.isApprox(Eigen::Vector3d(-2, 0, 1).normalized(), 1e-12));
  // The mirrored half of the double cone does not exist.
  EXPECT_FALSE(raycaster.Cast({-5, 0, 2.5}, {1, 0, 0}));
  // A ray parallel to a side of the cone, where the quadratic degenerates: from x = -2.7, z = -5 it
  // reaches z = 0 at x = -0.2, on the base disc.
  const Eigen::Vector3d o(-3.5, 0, -5), d = Eigen::Vector3d(1, 0, 2).normalized();
  const auto parallel = raycaster.Cast(o + Eigen::Vector3d(0.8, 0, 0), d);
  ASSERT_TRUE(parallel);
  EXPECT_NEAR(parallel->range_m, 2.5 * std::sqrt(5.0), 1e-9);
}

TEST(Raycaster, StepBetweenTwoRadiiIsClosed) {
  const Raycaster raycaster(
      BranchScene({{{0, 0, 0}, 0.3}, {{0, 0, 1}, 0.3}, {{0, 0, 1}, 0.2}, {{0, 0, 2}, 0.2}}));
  EXPECT_NEAR(raycaster.Cast({0.25, 0, 5}, {0, 0, -1})->range_m, 4.0, 1e-12);
  EXPECT_NEAR(raycaster.Cast({5, 0, 1.5}, {-1, 0, 0})->range_m, 4.8, 1e-12);
  EXPECT_NEAR(raycaster.Cast({5, 0, 0.5}, {-1, 0, 0})->range_m, 4.7, 1e-12);
}

TEST(Raycaster, RandomChainsOfConesAgreeWithTheOracle) {
  std::mt19937 rng(11);
  std::normal_distribution<double> n;
  std::uniform_real_distribution<double> u(0.0, 1.0);
  Comparison all;
  for (int trial = 0; trial < 40; ++trial) {
    std::vector<BranchPoint> points;
    Eigen::Vector3d p = 20.0 * Eigen::Vector3d(n(rng), n(rng), n(rng));
    Eigen::Vector3d d = Eigen::Vector3d(n(rng), n(rng), n(rng)).normalized();
    const int pieces = 1 + trial % 4;
    for (int i = 0; i <= pieces; ++i) {
      points.push_back({p, 0.01 + 0.25 * u(rng)});
      d = (d + 0.35 * Eigen::Vector3d(n(rng), n(rng), n(rng))).normalized();
      p += (0.3 + 0.5 * u(rng)) * d;
    }
    Eigen::Vector3d centre = Eigen::Vector3d::Zero();
    for (const BranchPoint& q : points) centre += q.position / static_cast<double>(points.size());
    double radius = 0.0;
    for (const BranchPoint& q : points) radius = std::max(radius, (q.position - centre).norm() + q.radius_m);
    const Comparison c = CompareWithOracle(BranchScene(points), BranchSolid(points), centre, radius, 150,
                                           static_cast<unsigned>(trial));
    all.hits += c.hits;
    all.ghosts += c.ghosts;
    all.misses += c.misses;
    all.errors.insert(all.errors.end(), c.errors.begin(), c.errors.end());
  }
  EXPECT_GT(all.hits, 800);
  EXPECT_EQ(all.ghosts, 0);
  EXPECT_EQ(all.misses, 0);
  EXPECT_LT(all.P99(), 1e-6);
}

TEST(Raycaster, RandomBoxesAgreeWithTheOracle) {
  std::mt19937 rng(12);
  std::normal_distribution<double> n;
  std::uniform_real_distribution<double> u(0.1, 2.0);
  Comparison all;
  for (int trial = 0; trial < 15; ++trial) {
    Scene scene = EmptyScene();
    SceneBox box;
    box.size_m = {u(rng), u(rng), u(rng)};
    box.position = 20.0 * Eigen::Vector3d(n(rng), n(rng), n(rng));
    box.yaw_deg = 180.0 * n(rng);
    scene.obstacles.push_back(box);
    const Eigen::AngleAxisd turn(box.yaw_deg * M_PI / 180.0, Eigen::Vector3d::UnitZ());
    const Inside inside = [box, turn](const Eigen::Vector3d& p) {
      const Eigen::Vector3d q = turn.inverse() * (p - box.position);
      return (q.cwiseAbs().array() <= 0.5 * box.size_m.array()).all();
    };
    const Comparison c =
        CompareWithOracle(scene, inside, box.position, 0.5 * box.size_m.norm(), 100, 100 + static_cast<unsigned>(trial));
    all.hits += c.hits;
    all.ghosts += c.ghosts;
    all.misses += c.misses;
    all.errors.insert(all.errors.end(), c.errors.begin(), c.errors.end());
  }
  EXPECT_GT(all.hits, 300);
  EXPECT_EQ(all.ghosts, 0);
  EXPECT_EQ(all.misses, 0);
  EXPECT_LT(all.P99(), 1e-6);
}

/// A closed mesh: a ball of latitude and longitude patches.
SceneMesh Ball(const Eigen::Vector3d& centre, double radius, int n) {
  SceneMesh mesh;
  mesh.file = "ball.ply";
  mesh.kind = SurfaceKind::kLeaf;
  for (int i = 0; i <= n; ++i) {
    for (int j = 0; j < 2 * n; ++j) {
      const double a = M_PI * i / n, b = M_PI * j / n;
      mesh.vertices.push_back(centre + radius * Eigen::Vector3d(std::sin(a) * std::cos(b), std::sin(a) * std::sin(b), std::cos(a)));
    }
  }
  const auto index = [n](int i, int j) { return static_cast<std::uint32_t>(i * 2 * n + j % (2 * n)); };
  for (int i = 0; i < n; ++i) {
    for (int j = 0; j < 2 * n; ++j) {
      if (i > 0) mesh.triangles.push_back({index(i, j), index(i + 1, j), index(i, j + 1)});
      if (i + 1 < n) mesh.triangles.push_back({index(i, j + 1), index(i + 1, j), index(i + 1, j + 1)});
    }
  }
  return mesh;
}

TEST(Raycaster, MeshAgreesWithALinearSolvePerTriangle) {
  Scene scene = EmptyScene();
  scene.meshes.push_back(Ball({8, -3, 2}, 1.5, 12));
  scene.meshes.push_back(Ball({9, -1, 2}, 0.8, 8));
  const Raycaster raycaster(scene);
  std::mt19937 rng(13);
  std::normal_distribution<double> n;
  int hits = 0;
  for (int i = 0; i < 3000; ++i) {
    const Eigen::Vector3d o = 3.0 * Eigen::Vector3d(n(rng), n(rng), n(rng));
    const Eigen::Vector3d d = (Eigen::Vector3d(8.3, -2.4, 2) + 0.9 * Eigen::Vector3d(n(rng), n(rng), n(rng)) - o).normalized();
    double best = 1e9;
    for (const SceneMesh& mesh : scene.meshes) {
      for (const auto& t : mesh.triangles) {
        // a + u (b - a) + v (c - a) = o + t d
        const Eigen::Vector3d a = mesh.vertices[t[0]];
        Eigen::Matrix3d m;
        m << mesh.vertices[t[1]] - a, mesh.vertices[t[2]] - a, -d;
        const Eigen::Vector3d x = m.partialPivLu().solve(o - a);
        if (x[0] >= 0 && x[1] >= 0 && x[0] + x[1] <= 1 && x[2] >= 0) best = std::min(best, x[2]);
      }
    }
    const auto hit = raycaster.Cast(o, d);
    ASSERT_EQ(hit.has_value(), best < 1e8) << i;
    if (!hit) continue;
    ++hits;
    EXPECT_NEAR(hit->range_m, best, 1e-8);
    EXPECT_EQ(hit->kind, SurfaceKind::kLeaf);
  }
  EXPECT_GT(hits, 1000);
}

TEST(Raycaster, GroundPlaneAndRoughGround) {
  Scene scene = EmptyScene();
  scene.ground.type = SceneGround::Type::kPlane;
  scene.ground.z_m = -1.0;
  const auto hit = Raycaster(scene).Cast({0, 0, 1}, Eigen::Vector3d(1, 0, -1).normalized());
  ASSERT_TRUE(hit);
  EXPECT_NEAR(hit->range_m, 2.0 * std::sqrt(2.0), 1e-12);
  EXPECT_EQ(hit->kind, SurfaceKind::kGround);
  EXPECT_FALSE(Raycaster(scene).Cast({0, 0, 1}, {1, 0, 0}));

  scene.ground.type = SceneGround::Type::kRough;
  scene.ground.amplitude_m = 0.15;
  scene.ground.wavelength_m = 3.0;
  const Raycaster rough(scene);
  const Inside inside = [&](const Eigen::Vector3d& p) { return p.z() < GroundHeight(scene.ground, p.x(), p.y()); };
  std::mt19937 rng(14);
  std::uniform_real_distribution<double> u(0.0, 1.0);
  double worst = 0.0;
  for (int i = 0; i < 300; ++i) {
    const Eigen::Vector3d o(20 * u(rng) - 10, 20 * u(rng) - 10, 0.3 + 2 * u(rng));
    const double azimuth = 2 * M_PI * u(rng), elevation = -0.03 - u(rng);
    const Eigen::Vector3d d(std::cos(elevation) * std::cos(azimuth), std::cos(elevation) * std::sin(azimuth), std::sin(elevation));
    const auto truth = March(inside, o, d, 0.0, 60.0, 2e-3);
    const auto rough_hit = rough.Cast(o, d, 60.0);
    ASSERT_EQ(rough_hit.has_value(), truth.has_value());
    if (truth) worst = std::max(worst, std::abs(rough_hit->range_m - *truth));
  }
  EXPECT_LT(worst, 1e-4);
}

TEST(Raycaster, TheTreeFindsWhatTestingEverythingFinds) {
  SceneGeneratorConfig config;
  config.num_trees = 3;
  config.leaf_probability = 1.0;
  Scene scene = GenerateScene(config, 5);
  for (SceneTree& tree : scene.trees) tree.leaves.count = 60;
  const Raycaster whole(scene);
  // Every branch and every leaf alone: no tree to speak of.
  std::vector<Raycaster> parts;
  for (std::size_t t = 0; t < scene.trees.size(); ++t) {
    for (const SceneBranch& branch : scene.trees[t].branches) {
      SceneBranch alone = branch;
      alone.parent = -1;
      Scene part = EmptyScene();
      part.trees.push_back({"part", {alone}, {}});
      parts.emplace_back(part);
    }
  }
  std::vector<Disc> leaves;
  for (const SceneTree& tree : scene.trees) {
    const std::vector<Disc> more = MakeLeaves(tree);
    leaves.insert(leaves.end(), more.begin(), more.end());
  }
  Scene rest = scene;
  rest.trees.clear();
  parts.emplace_back(rest);
  std::mt19937 rng(15);
  std::normal_distribution<double> n;
  int hits = 0;
  for (int i = 0; i < 4000; ++i) {
    const Eigen::Vector3d o(6 * n(rng), 6 * n(rng), 2.0 + std::abs(n(rng)));
    Eigen::Vector3d d = Eigen::Vector3d(n(rng), n(rng), 0.3 * n(rng)).normalized();
    if (i % 50 == 0) d = {1, 0, 0};  // Zero components.
    double best = 1e9;
    for (const Raycaster& part : parts) {
      if (const auto hit = part.Cast(o, d, 80.0)) best = std::min(best, hit->range_m);
    }
    for (const Disc& leaf : leaves) {
      const double t = (leaf.centre - o).dot(leaf.normal) / d.dot(leaf.normal);
      if (t >= 0 && t <= 80.0 && (o + t * d - leaf.centre).norm() <= leaf.radius_m) best = std::min(best, t);
    }
    const auto hit = whole.Cast(o, d, 80.0);
    ASSERT_EQ(hit.has_value(), best < 1e8) << i;
    if (hit) {
      ++hits;
      EXPECT_NEAR(hit->range_m, best, 1e-6) << i;
    }
  }
  EXPECT_GT(hits, 1500);
}

TEST(Raycaster, ABundleGivesWhatItsRaysGiveAlone) {
  SceneGeneratorConfig config;
  config.num_trees = 4;
  config.leaf_probability = 1.0;
  config.area_m = 8.0;
  const Scene scene = GenerateScene(config, 9);
  const Raycaster raycaster(scene);
  std::mt19937 rng(16);
  std::normal_distribution<double> n;
  std::uniform_real_distribution<double> u(-0.5, 0.5);
  std::vector<RayHit> hits;
  int met = 0;
  for (int i = 0; i < 3000; ++i) {
    RayBundle bundle;
    bundle.origin = {5 * n(rng), 5 * n(rng), 1.5 + std::abs(n(rng))};
    bundle.direction = Eigen::Vector3d(n(rng), n(rng), 0.3 * n(rng)).normalized();
    bundle.half_width_m = 0.01;
    bundle.half_angle_rad = 0.003;
    const Eigen::Vector3d side = bundle.direction.cross(Eigen::Vector3d::UnitZ()).normalized();
    for (int k = 0; k < 6; ++k) {
      const double w = u(rng);
      bundle.origins.push_back(bundle.origin + 2 * 0.01 * w * side);
      bundle.directions.push_back((bundle.direction + 2 * 0.003 * w * side).normalized());
    }
    raycaster.CastBundle(bundle, 60.0, &hits);
    ASSERT_EQ(hits.size(), 6u);
    for (std::size_t k = 0; k < 6; ++k) {
      const auto alone = raycaster.Cast(bundle.origins[k], bundle.directions[k], 60.0);
      ASSERT_EQ(alone.has_value(), hits[k].kind != SurfaceKind::kNone) << i;
      if (!alone) continue;
      ++met;
      // The rough ground is met to a micrometre of height from wherever the walk starts.
      EXPECT_NEAR(alone->range_m, hits[k].range_m, alone->kind == SurfaceKind::kGround ? 1e-4 : 0.0);
      EXPECT_EQ(alone->kind, hits[k].kind);
      EXPECT_EQ(alone->branch_id, hits[k].branch_id);
    }
  }
  EXPECT_GT(met, 5000);
}

TEST(Raycaster, CloudPointsAreSpheres) {
  Scene scene = EmptyScene();
  SceneCloud cloud;
  cloud.points = {{3, 0, 0}, {5, 0, 0}};
  cloud.point_radius_m = 0.1;
  scene.clouds.push_back(cloud);
  const Raycaster raycaster(scene);
  EXPECT_NEAR(raycaster.Cast({0, 0, 0}, {1, 0, 0})->range_m, 2.9, 1e-12);
  EXPECT_NEAR(raycaster.Cast({0, 0.06, 0}, {1, 0, 0})->range_m, 3.0 - 0.08, 1e-12);
  EXPECT_FALSE(raycaster.Cast({0, 0.11, 0}, {1, 0, 0}));
}

TEST(Raycaster, RefusesASceneThatIsNotValid) {
  EXPECT_THROW(Raycaster(BranchScene({{{0, 0, 0}, -0.1}, {{0, 0, 1}, 0.1}})), std::invalid_argument);
  EXPECT_THROW(Raycaster(BranchScene({{{0, 0, 0}, 0.1}})), std::invalid_argument);
}

}  // namespace
}  // namespace dendro
