#include "dendro_slam/sim/training_scans.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <random>
#include <stdexcept>

#include <Eigen/Geometry>
#include <fmt/format.h>

#include "dendro_slam/geometry/se3.h"
#include "dendro_slam/sim/raycaster.h"
#include "dendro_slam/sim/scene_generator.h"

namespace dendro {
namespace {

constexpr double kPi = 3.14159265358979323846;

// The standard distributions differ between libraries; these do not.
class Random {
 public:
  explicit Random(std::uint64_t seed) : engine_(seed) {}
  std::uint64_t Seed() { return engine_() >> 1U; }
  double Uniform(double low, double high) {
    return low + (high - low) * static_cast<double>(engine_() >> 11U) * 0x1.0p-53;
  }
  int Integer(int low, int high) {  // Inclusive.
    return low + static_cast<int>(engine_() % static_cast<std::uint64_t>(high - low + 1));
  }
  bool Chance(double p) { return Uniform(0.0, 1.0) < p; }
  double Gaussian() {
    const double u = std::max(Uniform(0.0, 1.0), 1e-300);
    return std::sqrt(-2.0 * std::log(u)) * std::cos(2.0 * kPi * Uniform(0.0, 1.0));
  }

 private:
  std::mt19937_64 engine_;
};

void AddTrees(const std::string& kind, Random& rng, Scene* scene) {
  const bool thesis = kind == "thesis";
  const bool orchard = kind == "orchard";
  const bool distant = kind == "distant";
  const bool leafy = kind == "leafy" || (orchard && rng.Chance(0.7)) || (distant && rng.Chance(0.6));
  const int wanted = thesis ? rng.Integer(1, 2) : orchard ? rng.Integer(4, 8) : rng.Integer(1, 5);
  const double spacing = rng.Uniform(2.0, 4.5);
  const double area = thesis ? 5.0 : distant ? rng.Uniform(8.0, 24.0) : rng.Uniform(5.0, 12.0);
  std::vector<Eigen::Vector2d> places;
  for (int attempt = 0; attempt < 50 && static_cast<int>(places.size()) < wanted; ++attempt) {
    Eigen::Vector2d place(rng.Uniform(-area / 2, area / 2), rng.Uniform(-area / 2, area / 2));
    if (orchard) {  // One or two rows.
      const int k = static_cast<int>(places.size());
      place = Eigen::Vector2d((k / (wanted > 5 ? 2 : 1)) * spacing + 0.2 * rng.Gaussian(),
                              (wanted > 5 ? k % 2 : 0) * 1.4 * spacing + 0.2 * rng.Gaussian());
    }
    const double apart = orchard ? 0.6 * spacing : 2.5;
    const bool free = std::all_of(places.begin(), places.end(), [&](const Eigen::Vector2d& other) {
      return (other - place).norm() > apart;
    });
    if (!free) continue;
    places.push_back(place);
    TreeGeneratorConfig config = RandomTreeConfig(rng.Seed());
    if (thesis) {
      config.form = rng.Chance(0.5) ? "columnar" : "decurrent";
      config.height_m = rng.Uniform(4.0, 9.0);
      config.dbh_m = rng.Uniform(0.2, 0.6);
      config.num_branches = rng.Integer(2, 7);
      config.max_order = 1;
      config.min_radius_m = 0.02;
      config.leaf_count = 0;
    } else if (leafy && !(orchard && rng.Chance(0.2))) {
      // Few trees are so dense that hardly any wood is seen: draw the density evenly in logarithm.
      config.leaf_count = static_cast<int>(std::exp(rng.Uniform(std::log(600.0), std::log(20000.0))));
      config.leaf_size_m = std::exp(rng.Uniform(std::log(0.02), std::log(0.12)));
    } else {
      config.leaf_count = 0;
    }
    if (orchard) {
      config.height_m = rng.Uniform(2.5, 6.0);
      config.dbh_m = std::clamp(config.height_m * rng.Uniform(0.02, 0.055), 0.06, 0.4);
    }
    const double z = GroundHeight(scene->ground, place.x(), place.y());
    SceneTree tree =
        GenerateTree(config, Eigen::Vector3d(place.x(), place.y(), z - 0.05), rng.Seed());
    if (config.leaf_count > 0) {
      tree.leaves.spread_m = rng.Uniform(0.05, 0.2);
      tree.leaves.max_wood_radius_m *= rng.Uniform(0.5, 1.6);
    }
    tree.name = fmt::format("tree_{}", places.size());
    scene->trees.push_back(std::move(tree));
  }
}

// A tuft of grass: leaves around a few stalks too thin to be met.
void AddGrass(Random& rng, Scene* scene) {
  const int tufts = rng.Integer(3, 25);
  for (int i = 0; i < tufts; ++i) {
    const double x = rng.Uniform(-10.0, 10.0);
    const double y = rng.Uniform(-10.0, 10.0);
    const double z = GroundHeight(scene->ground, x, y);
    SceneTree tuft;
    tuft.name = fmt::format("grass_{}", i);
    SceneBranch stalk;
    stalk.points = {{Eigen::Vector3d(x, y, z), 0.001},
                    {Eigen::Vector3d(x + rng.Uniform(-0.1, 0.1), y + rng.Uniform(-0.1, 0.1),
                                     z + rng.Uniform(0.1, 0.6)), 0.0005}};
    tuft.branches.push_back(stalk);
    tuft.leaves.count = rng.Integer(20, 150);
    tuft.leaves.size_m = rng.Uniform(0.02, 0.08);
    tuft.leaves.spread_m = rng.Uniform(0.05, 0.3);
    tuft.leaves.seed = rng.Seed();
    scene->trees.push_back(std::move(tuft));
  }
}

void AddObstacles(const std::string& kind, Random& rng, Scene* scene) {
  const bool clutter = kind == "clutter";
  const auto add = [&](const Eigen::Vector3d& size, double reach, double least) {
    // Not on top of a trunk.
    for (int attempt = 0; attempt < 20; ++attempt) {
      const double angle = rng.Uniform(0.0, 2.0 * kPi);
      const double distance = rng.Uniform(least, reach);
      const Eigen::Vector2d place(distance * std::cos(angle), distance * std::sin(angle));
      const double half = 0.5 * size.head<2>().norm() + 0.5;
      const bool free =
          std::all_of(scene->trees.begin(), scene->trees.end(), [&](const SceneTree& tree) {
            return (tree.branches.front().points.front().position.head<2>() - place).norm() > half;
          });
      if (!free) continue;
      SceneBox box;
      box.size_m = size;
      box.position = Eigen::Vector3d(
          place.x(), place.y(),
          GroundHeight(scene->ground, place.x(), place.y()) + 0.5 * size.z() - 0.05);
      box.yaw_deg = rng.Uniform(0.0, 360.0);
      scene->obstacles.push_back(box);
      return;
    }
  };
  if (scene->ground.type == SceneGround::Type::kNone) return;
  if (kind == "orchard" && rng.Chance(0.3)) {  // Trellis posts.
    for (int i = rng.Integer(1, 4); i > 0; --i) {
      const double side = rng.Uniform(0.06, 0.16);
      add({side, side, rng.Uniform(1.5, 3.0)}, 9.0, 1.0);
    }
  }
  for (int i = rng.Integer(0, 6); i > 0; --i) {  // Rocks.
    const double s = rng.Uniform(0.15, 0.8);
    add({s * rng.Uniform(0.6, 1.4), s * rng.Uniform(0.6, 1.4), s * rng.Uniform(0.4, 0.9)}, 10.0, 1.0);
  }
  for (int i = rng.Integer(0, 2); i > 0; --i) {  // People.
    add({rng.Uniform(0.4, 0.6), rng.Uniform(0.22, 0.35), rng.Uniform(1.5, 1.95)}, 8.0, 2.0);
  }
  for (int i = rng.Integer(0, 2); i > 0; --i) {  // Crates and cars.
    add({rng.Uniform(0.6, 4.0), rng.Uniform(0.5, 1.8), rng.Uniform(0.5, 1.8)}, 12.0, 4.0);
  }
  if (clutter) {
    for (int i = rng.Integer(1, 3); i > 0; --i) {  // Pillars as thick as trunks, and people.
      const double side = rng.Uniform(0.25, 0.8);
      add({side, side * rng.Uniform(0.7, 1.4), rng.Uniform(1.5, 6.0)}, 9.0, 1.0);
      add({rng.Uniform(0.4, 0.6), rng.Uniform(0.22, 0.35), rng.Uniform(1.5, 1.95)}, 8.0, 1.0);
    }
    // Ends of walls near by, which look like stems from one side.
    add({rng.Uniform(1.5, 6.0), rng.Uniform(0.2, 0.6), rng.Uniform(1.5, 6.0)}, 8.0, 2.0);
  }
  if (rng.Chance(0.3)) {  // Pillars, clearly thicker than a post.
    const double side = rng.Uniform(0.3, 0.7);
    add({side, side, rng.Uniform(2.0, 5.0)}, 9.0, 3.0);
  }
  for (int i = rng.Chance(0.4) ? rng.Integer(1, 2) : 0; i > 0; --i) {  // Walls.
    add({rng.Uniform(3.0, 14.0), rng.Uniform(0.15, 0.4), rng.Uniform(1.5, 6.0)}, 20.0, 7.0);
  }
}

}  // namespace

const std::vector<std::string>& TrainingKinds() {
  static const std::vector<std::string> kinds = {"thesis",  "leafless", "leafy",  "tilted",
                                                 "clutter", "orchard",  "distant"};
  return kinds;
}

Scene RandomTrainingScene(const std::string& kind, std::uint64_t seed) {
  const auto& kinds = TrainingKinds();
  if (std::find(kinds.begin(), kinds.end(), kind) == kinds.end()) {
    throw std::invalid_argument(fmt::format("kind '{}' is unknown", kind));
  }
  Random rng(seed * 2654435761U + 17U);
  Scene scene;
  std::string trees = kind;
  const bool clutter = kind == "clutter";
  if (kind == "tilted" || clutter) {
    trees = rng.Chance(0.5)   ? "leafy"
            : rng.Chance(0.5) ? "leafless"
            : rng.Chance(0.5) ? "thesis"
                              : "orchard";
  }
  if (trees == "thesis" || rng.Chance(0.25)) {
    scene.ground.type = SceneGround::Type::kPlane;
  } else if (rng.Chance(0.05)) {
    scene.ground.type = SceneGround::Type::kNone;
  } else {
    scene.ground.type = SceneGround::Type::kRough;
    scene.ground.amplitude_m = rng.Uniform(0.02, 0.25);
    scene.ground.wavelength_m = rng.Uniform(1.5, 8.0);
    scene.ground.seed = rng.Seed();
  }
  if (scene.ground.type == SceneGround::Type::kNone) {
    // Trees need a place to stand: the height where the ground would be.
    SceneGround plane;
    plane.type = SceneGround::Type::kPlane;
    scene.ground = plane;
    AddTrees(trees, rng, &scene);
    scene.ground.type = SceneGround::Type::kNone;
  } else {
    AddTrees(trees, rng, &scene);
  }
  if (trees == "thesis") {
    if (clutter || rng.Chance(0.3)) AddObstacles(kind, rng, &scene);
  } else {
    AddObstacles(kind, rng, &scene);
    if (scene.ground.type != SceneGround::Type::kNone && rng.Chance(0.4)) AddGrass(rng, &scene);
  }
  // Half of the scenes within what bark, leaves and soil reflect in the near infrared, so that
  // brightness is a hint; a third with anything, so that it is never more than a hint.
  SceneReflectivity& r = scene.reflectivity;
  const double look = rng.Uniform(0.0, 1.0);
  if (look < 0.5) {
    r.ground = rng.Uniform(0.15, 0.45);
    r.trunk = rng.Uniform(0.2, 0.55);
    r.leaf = rng.Uniform(0.38, 0.62);
    r.obstacle = rng.Uniform(0.15, 0.8);
    r.branch = r.trunk * rng.Uniform(0.85, 1.15);
  } else if (look < 0.85) {
    for (double* value : {&r.ground, &r.trunk, &r.leaf, &r.obstacle}) {
      *value = rng.Uniform(0.12, 0.8);
    }
    r.branch = r.trunk * rng.Uniform(0.8, 1.2);
  }
  return scene;
}

std::vector<TrainingScan> SimulateTrainingScans(const std::string& kind,
                                                std::uint64_t seed,
                                                int count,
                                                const LidarSimulatorConfig& lidar,
                                                const ProjectorConfig& projector_config) {
  const Scene scene = RandomTrainingScene(kind, seed);
  const Raycaster raycaster(scene);
  Random rng(seed * 11400714819323198485ULL + 5U);
  LidarSimulatorConfig sensor = lidar;
  sensor.seed = static_cast<int>(rng.Seed() % 1000000U);
  sensor.enable_laser_bias = rng.Chance(0.5);
  const LidarSimulator simulator(raycaster, sensor);
  Projector projector(projector_config);

  const auto is_free = [&](const Eigen::Vector3d& p) {
    for (int i = 0; i < 60; ++i) {  // Directions spread evenly over the sphere.
      const double z = 1.0 - 2.0 * (i + 0.5) / 60.0;
      const double angle = i * 2.399963229728653;
      const double s = std::sqrt(1.0 - z * z);
      const Eigen::Vector3d d(s * std::cos(angle), s * std::sin(angle), z);
      if (raycaster.Cast(p, d, 0.45)) return false;
    }
    return true;
  };
  std::size_t num_trees = 0;
  while (num_trees < scene.trees.size() &&
         scene.trees[num_trees].name.compare(0, 4, "tree") == 0) {
    ++num_trees;
  }

  std::vector<TrainingScan> scans;
  for (int i = 0; i < count; ++i) {
    const SceneTree& tree =
        scene.trees[static_cast<std::size_t>(rng.Integer(0, static_cast<int>(num_trees) - 1))];
    const Eigen::Vector3d base = tree.branches.front().points.front().position;
    const double top = tree.branches.front().points.back().position.z() - base.z();
    Eigen::Vector3d position = base;
    for (int attempt = 0; attempt < 40; ++attempt) {
      const double angle = rng.Uniform(0.0, 2.0 * kPi);
      const double distance =
          kind == "thesis"    ? rng.Uniform(3.0, 8.0)
          : kind == "distant" ? rng.Uniform(8.0, 20.0)
                              : rng.Uniform(2.0, 12.0);
      const double height =
          rng.Uniform(0.5, kind == "thesis" ? std::min(5.0, top) : std::min(8.0, top + 1.0));
      position = base + Eigen::Vector3d(distance * std::cos(angle), distance * std::sin(angle), 0);
      position.z() = std::max(GroundHeight(scene.ground, position.x(), position.y()), base.z()) +
                     height;
      if (is_free(position)) break;
    }
    double tilt_rad = 5.0 * kPi / 180.0 * std::abs(rng.Gaussian());
    if (kind == "thesis") tilt_rad *= 0.4;
    if (kind == "tilted") {
      tilt_rad = rng.Chance(0.4) ? kPi / 2.0 + 0.1 * rng.Gaussian() : rng.Uniform(0.1, kPi / 2.0);
    }
    const double tilt_to = rng.Uniform(0.0, 2.0 * kPi);
    const Eigen::Vector3d tilt_axis(std::cos(tilt_to), std::sin(tilt_to), 0.0);
    Eigen::Isometry3d pose = Eigen::Isometry3d::Identity();
    pose.translation() = position;
    pose.linear() = (Eigen::AngleAxisd(tilt_rad, tilt_axis) *
                     Eigen::AngleAxisd(rng.Uniform(0.0, 2.0 * kPi), Eigen::Vector3d::UnitZ()))
                        .toRotationMatrix();
    Vector6d twist = Vector6d::Zero();
    if (rng.Chance(0.6)) {
      for (int k = 0; k < 3; ++k) twist(k) = 0.1 * rng.Gaussian();
      for (int k = 3; k < 6; ++k) twist(k) = std::clamp(0.4 * rng.Gaussian(), -1.0, 1.0);
    }
    const std::int64_t stamp = simulator.ScanStamp(i);
    const SimulatedScan simulated =
        simulator.SimulateScan(i, [&](std::int64_t t) -> Eigen::Isometry3d {
          return pose * ExpSe3(twist * (static_cast<double>(t - stamp) * 1e-9));
        });
    TrainingScan scan;
    scan.image = projector.Project(simulated.scan, nullptr);
    scan.truth = PixelTruth(scan.image, simulated.truth);
    scan.wood_radius_m = PixelWoodRadius(scan.image, simulated.truth, scene, pose);
    scan.kind = kind;
    scan.seed = seed;
    scans.push_back(std::move(scan));
  }
  return scans;
}

std::vector<Label> PixelTruth(const RangeImage& image, const std::vector<PointTruth>& truth) {
  std::vector<Label> labels(image.size(), Label::kNone);
  for (std::size_t i = 0; i < image.size(); ++i) {
    if (image.point_index[i] < 0) continue;
    labels[i] = SurfaceLabel(truth.at(static_cast<std::size_t>(image.point_index[i])).kind);
  }
  return labels;
}

std::vector<float> PixelWoodRadius(const RangeImage& image,
                                   const std::vector<PointTruth>& truth,
                                   const Scene& scene,
                                   const Eigen::Isometry3d& T_map_lidar) {
  std::vector<float> radius(image.size(), 0.0F);
  for (std::size_t i = 0; i < image.size(); ++i) {
    if (image.point_index[i] < 0) continue;
    const PointTruth& t = truth.at(static_cast<std::size_t>(image.point_index[i]));
    if (t.branch_id < 0) continue;
    const SceneBranch* branch =
        scene.trees.at(static_cast<std::size_t>(t.tree_id)).FindBranch(t.branch_id);
    if (branch == nullptr) continue;
    const Eigen::Vector3d p = T_map_lidar * image.point[i].cast<double>();
    double nearest = std::numeric_limits<double>::infinity();
    for (std::size_t k = 1; k < branch->points.size(); ++k) {
      const BranchPoint& a = branch->points[k - 1];
      const BranchPoint& b = branch->points[k];
      const Eigen::Vector3d axis = b.position - a.position;
      const double u =
          std::clamp((p - a.position).dot(axis) / std::max(axis.squaredNorm(), 1e-12), 0.0, 1.0);
      const double distance = (a.position + u * axis - p).squaredNorm();
      if (distance < nearest) {
        nearest = distance;
        radius[i] = static_cast<float>(a.radius_m + u * (b.radius_m - a.radius_m));
      }
    }
  }
  return radius;
}

}  // namespace dendro
