#include <chrono>
#include <cmath>
#include <ctime>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

#include <BulletCollision/CollisionDispatch/btCollisionDispatcher.h>
#include <BulletCollision/CollisionDispatch/btCollisionObject.h>
#include <BulletCollision/CollisionDispatch/btCollisionWorld.h>
#include <BulletCollision/CollisionDispatch/btDefaultCollisionConfiguration.h>
#include <BulletCollision/BroadphaseCollision/btDbvtBroadphase.h>
#include <BulletCollision/CollisionShapes/btBvhTriangleMeshShape.h>
#include <BulletCollision/CollisionShapes/btTriangleMesh.h>
#include <CLI/CLI.hpp>
#include <fmt/format.h>

#include "dendro_slam/geometry/cylinder.h"
#include "dendro_slam/sensors/vlp16_model.h"
#include "dendro_slam/sim/raycaster.h"
#include "dendro_slam/sim/scene_generator.h"

namespace {

using dendro::Scene;

/// The leaf triangles of one tree, cut from its leaf discs.
dendro::SceneMesh LeafTriangles(const dendro::SceneTree& tree) {
  dendro::SceneMesh mesh;
  mesh.file = tree.name;
  mesh.kind = dendro::SurfaceKind::kLeaf;
  for (const dendro::Disc& leaf : dendro::MakeLeaves(tree)) {
    const Eigen::Matrix<double, 3, 2> basis = dendro::PerpendicularBasis(leaf.normal);
    const auto first = static_cast<std::uint32_t>(mesh.vertices.size());
    for (int k = 0; k < 3; ++k) {
      const double a = 2.0 * M_PI * k / 3.0;
      mesh.vertices.push_back(leaf.centre + leaf.radius_m * (basis * Eigen::Vector2d(std::cos(a), std::sin(a))));
    }
    mesh.triangles.push_back({first, first + 1, first + 2});
  }
  return mesh;
}

Scene MakeScene(int trees, int triangles) {
  Scene scene;
  scene.ground.type = dendro::SceneGround::Type::kNone;
  for (int i = 0; i < trees; ++i) {
    dendro::TreeGeneratorConfig config;
    config.form = i % 2 == 0 ? "decurrent" : "excurrent";
    config.leaf_count = triangles / trees;
    config.max_order = 2;
    config.num_branches = 12;
    const double angle = 2.4 * i;
    const double radius = 2.5 + 1.1 * i;
    scene.trees.push_back(dendro::GenerateTree(
        config, {radius * std::cos(angle), radius * std::sin(angle), 0.0}, static_cast<std::uint64_t>(i) + 1));
    scene.meshes.push_back(LeafTriangles(scene.trees.back()));
    scene.trees.back().leaves.count = 0;
  }
  return scene;
}

btVector3 ToBullet(const Eigen::Vector3d& v) {
  return {static_cast<btScalar>(v.x()), static_cast<btScalar>(v.y()), static_cast<btScalar>(v.z())};
}

/// The same scene for Bullet: frusta as 64-gon meshes (its own convex shapes are off by millimetres to
/// centimetres), leaves as the same triangles.
class BulletWorld {
 public:
  explicit BulletWorld(const Scene& scene)
      : dispatcher_(&configuration_), world_(&dispatcher_, &broadphase_, &configuration_) {
    for (const dendro::SceneTree& tree : scene.trees) {
      auto mesh = std::make_unique<btTriangleMesh>();
      for (const dendro::SceneBranch& branch : tree.branches) {
        for (std::size_t i = 1; i < branch.points.size(); ++i) {
          const auto& a = branch.points[i - 1];
          const auto& b = branch.points[i];
          const Eigen::Vector3d axis = (b.position - a.position).normalized();
          const Eigen::Matrix<double, 3, 2> basis = dendro::PerpendicularBasis(axis);
          for (int k = 0; k < 64; ++k) {
            const double u = 2.0 * M_PI * k / 64, v = 2.0 * M_PI * (k + 1) / 64;
            const Eigen::Vector3d du = basis * Eigen::Vector2d(std::cos(u), std::sin(u));
            const Eigen::Vector3d dv = basis * Eigen::Vector2d(std::cos(v), std::sin(v));
            const btVector3 a0 = ToBullet(a.position + a.radius_m * du), a1 = ToBullet(a.position + a.radius_m * dv);
            const btVector3 b0 = ToBullet(b.position + b.radius_m * du), b1 = ToBullet(b.position + b.radius_m * dv);
            mesh->addTriangle(a0, a1, b0);
            mesh->addTriangle(a1, b1, b0);
          }
        }
      }
      Add(std::move(mesh));
    }
    for (const dendro::SceneMesh& leaves : scene.meshes) {
      auto mesh = std::make_unique<btTriangleMesh>();
      for (const auto& t : leaves.triangles) {
        mesh->addTriangle(ToBullet(leaves.vertices[t[0]]), ToBullet(leaves.vertices[t[1]]), ToBullet(leaves.vertices[t[2]]));
      }
      Add(std::move(mesh));
    }
    world_.updateAabbs();
  }
  ~BulletWorld() {
    for (const auto& object : objects_) world_.removeCollisionObject(object.get());
  }

  /// Range of the first hit; negative when there is none.
  double Cast(const Eigen::Vector3d& o, const Eigen::Vector3d& d, double max_range) const {
    const btVector3 from = ToBullet(o), to = ToBullet(o + max_range * d);
    btCollisionWorld::ClosestRayResultCallback callback(from, to);
    world_.rayTest(from, to, callback);
    return callback.hasHit() ? callback.m_closestHitFraction * max_range : -1.0;
  }

 private:
  void Add(std::unique_ptr<btTriangleMesh> mesh) {
    shapes_.push_back(std::make_unique<btBvhTriangleMeshShape>(mesh.get(), true));
    meshes_.push_back(std::move(mesh));
    objects_.push_back(std::make_unique<btCollisionObject>());
    objects_.back()->setCollisionShape(shapes_.back().get());
    world_.addCollisionObject(objects_.back().get());
  }

  btDefaultCollisionConfiguration configuration_;
  btCollisionDispatcher dispatcher_;
  btDbvtBroadphase broadphase_;
  btCollisionWorld world_;
  std::vector<std::unique_ptr<btTriangleMesh>> meshes_;
  std::vector<std::unique_ptr<btBvhTriangleMeshShape>> shapes_;
  std::vector<std::unique_ptr<btCollisionObject>> objects_;
};

struct Figure {
  double rays_per_cpu_s = 0.0;
  std::size_t hits = 0;
};

/// Time of this thread's processor, so that other programs on the machine do not count.
template <class Function>
Figure Measure(const std::vector<Eigen::Vector3d>& origins,
               const std::vector<Eigen::Vector3d>& directions,
               std::vector<double>* ranges,
               const Function& cast) {
  Figure figure;
  ranges->clear();
  const std::clock_t start = std::clock();
  for (const Eigen::Vector3d& o : origins) {
    for (const Eigen::Vector3d& d : directions) {
      ranges->push_back(cast(o, d));
      figure.hits += ranges->back() >= 0.0 ? 1 : 0;
    }
  }
  const double seconds = static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC;
  figure.rays_per_cpu_s = static_cast<double>(ranges->size()) / seconds;
  return figure;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app(
      "Rays per second of the simulator's ray caster beside Bullet's own rayTest, one thread, the same scene and "
      "the same rays: a VLP-16's revolutions from places among the trees.");
  int trees = 15, triangles = 300000, places = 6;
  app.add_option("--trees", trees, "Trees in the scene")->capture_default_str();
  app.add_option("--triangles", triangles, "Leaf triangles in all")->capture_default_str();
  app.add_option("--places", places, "Revolutions to cast, each from another place")->capture_default_str();
  CLI11_PARSE(app, argc, argv);
  try {
    const Scene scene = MakeScene(trees, triangles);
    const dendro::Raycaster raycaster(scene);
    const BulletWorld bullet(scene);
    std::vector<Eigen::Vector3d> origins, directions;
    for (int i = 0; i < places; ++i) {
      const double a = 2.0 * M_PI * i / places;
      const double r = 3.0 + 3.0 * (i % 3);
      origins.emplace_back(r * std::cos(a), r * std::sin(a), 1.5 + 0.7 * (i % 4));
    }
    for (int k = 0; k < 1808; ++k) {
      for (int laser = 0; laser < dendro::vlp16::kLasers; ++laser) {
        directions.push_back(dendro::vlp16::BeamDirection(laser, 0.1991 * k));
      }
    }
    const double max_range = 100.0;
    std::vector<double> ours, theirs;
    const auto cast_ours = [&](const Eigen::Vector3d& o, const Eigen::Vector3d& d) {
      const auto hit = raycaster.Cast(o, d, max_range);
      return hit ? hit->range_m : -1.0;
    };
    const auto cast_theirs = [&](const Eigen::Vector3d& o, const Eigen::Vector3d& d) {
      return bullet.Cast(o, d, max_range);
    };
    Measure(origins, directions, &ours, cast_ours);  // Warms the caches.
    const Figure a = Measure(origins, directions, &ours, cast_ours);
    const Figure b = Measure(origins, directions, &theirs, cast_theirs);
    std::size_t agree = 0;
    for (std::size_t i = 0; i < ours.size(); ++i) agree += std::abs(ours[i] - theirs[i]) < 2e-3 ? 1 : 0;
    std::cout << fmt::format(
        "{{\"trees\": {}, \"primitives\": {}, \"rays\": {}, \"raycaster_rays_per_s\": {:.0f}, "
        "\"bullet_rays_per_s\": {:.0f}, \"ratio\": {:.2f}, \"raycaster_hits\": {}, \"bullet_hits\": {}, "
        "\"ranges_that_agree_within_2_mm\": {:.4f}}}\n",
        trees, raycaster.num_primitives(), ours.size(), a.rays_per_cpu_s, b.rays_per_cpu_s,
        a.rays_per_cpu_s / b.rays_per_cpu_s, a.hits, b.hits,
        static_cast<double>(agree) / static_cast<double>(ours.size()));
  } catch (const std::exception& e) {
    std::cerr << "raycast_benchmark: " << e.what() << "\n";
    return 1;
  }
  return 0;
}
