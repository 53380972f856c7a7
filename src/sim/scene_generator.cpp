#include "dendro_slam/sim/scene_generator.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include <Eigen/Geometry>
#include <fmt/format.h>

#include "counter_rng.h"
#include "dendro_slam/geometry/cylinder.h"

namespace dendro {
namespace {

constexpr double kDegree = M_PI / 180.0;

/// Grows one tree; keeps the order parents before children.
class Grower {
 public:
  Grower(const TreeGeneratorConfig& config, const Eigen::Vector3d& base, std::uint64_t seed)
      : config_(config), base_(base), rng_(seed, 0x7ee5) {}

  SceneTree Grow(std::uint64_t seed) {
    SceneTree tree;
    tree_ = &tree;
    Trunk();
    const double first_radius = tree.branches[0].points[0].radius_m;
    if (config_.max_order >= 1) FirstOrder();
    ClampRadii(first_radius);
    tree.leaves.count = config_.leaf_count;
    tree.leaves.size_m = config_.leaf_size_m;
    tree.leaves.seed = seed;
    tree.leaves.max_wood_radius_m = std::max(0.015, 0.12 * config_.dbh_m);
    tree.leaves.spread_m = 0.12;
    tree.name = fmt::format("{}_{}", config_.form, seed);
    return tree;
  }

 private:
  double Vary(double value, double part) { return value * (1.0 + part * rng_.Uniform(-1.0, 1.0)); }

  static Eigen::Vector3d Horizontal(double azimuth) { return {std::cos(azimuth), std::sin(azimuth), 0.0}; }

  /// Radius of the leader at a height: the taper is linear up to the crown and a little convex above.
  double TrunkRadius(double height) const {
    const double h = std::clamp(height / config_.height_m, 0.0, 1.0);
    const double breast = std::min(1.3, 0.5 * config_.height_m) / config_.height_m;
    const auto shape = [&](double x) { return 1.0 - config_.taper * std::pow(x, 1.1); };
    const double flare = 0.18 * std::exp(-height / 0.35);  // Root flare.
    const double flare_breast = 0.18 * std::exp(-breast * config_.height_m / 0.35);
    return 0.5 * config_.dbh_m * shape(h) / shape(breast) * (1.0 + flare) / (1.0 + flare_breast);
  }

  void Trunk() {
    double top = config_.height_m;
    if (config_.form == "decurrent") top = config_.height_m * rng_.Uniform(0.4, 0.6);
    const double lean_azimuth = rng_.Uniform(0.0, 2.0 * M_PI);
    const double sweep_azimuth = rng_.Uniform(0.0, 2.0 * M_PI);
    const double lean = Vary(config_.lean_deg, 0.5) * kDegree;
    const double sweep = Vary(config_.sweep, 0.5) * config_.height_m;
    const double wave = rng_.Uniform(0.7, 1.6);
    const int pieces = std::max(3, static_cast<int>(std::ceil(top / config_.segment_length_m)));
    SceneBranch trunk;
    trunk.id = 0;
    for (int i = 0; i <= pieces; ++i) {
      const double z = top * i / pieces;
      const double u = z / config_.height_m;
      const Eigen::Vector3d p = base_ + Eigen::Vector3d(0, 0, z) + z * std::tan(lean) * Horizontal(lean_azimuth) +
                                sweep * (1.0 - std::cos(wave * M_PI * u)) * 0.5 * Horizontal(sweep_azimuth);
      // The trunk starts a little below the ground, so that a rough ground leaves no gap.
      Eigen::Vector3d q = p;
      if (i == 0) q.z() -= 0.15;
      trunk.points.push_back({q, std::max(config_.min_radius_m, TrunkRadius(z))});
    }
    tree_->branches.push_back(trunk);
    if (config_.form == "decurrent") Forks(0, top, std::max(1, config_.num_forks));
  }

  /// Splits the end of a branch into two or three leaders that share its section by the pipe model.
  void Forks(int parent, double height, int levels) {
    const SceneBranch base = tree_->branches[static_cast<std::size_t>(parent)];
    const Eigen::Vector3d start = base.points.back().position;
    const Eigen::Vector3d axis = (start - base.points[base.points.size() - 2].position).normalized();
    const double radius = base.points.back().radius_m;
    const int arms = rng_.Uniform() < 0.3 ? 3 : 2;
    std::vector<double> share(static_cast<std::size_t>(arms));
    double sum = 0.0;
    for (double& s : share) sum += s = rng_.Uniform(0.6, 1.0);
    const double azimuth = rng_.Uniform(0.0, 2.0 * M_PI);
    std::vector<int> ids;
    for (int k = 0; k < arms; ++k) {
      const double r = radius * std::pow(share[static_cast<std::size_t>(k)] / sum, 1.0 / config_.pipe_exponent);
      const double angle = rng_.Uniform(20.0, 40.0) * kDegree;
      const Eigen::Matrix<double, 3, 2> basis = PerpendicularBasis(axis);
      const double turn = azimuth + 2.0 * M_PI * k / arms + rng_.Uniform(-0.3, 0.3);
      const Eigen::Vector3d direction =
          std::cos(angle) * axis + std::sin(angle) * (basis * Eigen::Vector2d(std::cos(turn), std::sin(turn)));
      const double left = config_.height_m - height;
      const double length = left / levels / std::max(0.5, direction.z()) * rng_.Uniform(0.85, 1.0);
      const double tip = levels > 1 ? r * 0.75 : r * std::max(0.1, 1.0 - config_.taper);
      const int id = AddBranch(parent, start, direction, r, tip, length, 0.5 * config_.gravitropism, false);
      leaders_.push_back(id);
      ids.push_back(id);
    }
    if (levels > 1) {
      for (const int id : ids) {
        const double z = tree_->branches[static_cast<std::size_t>(id)].points.back().position.z() - base_.z();
        Forks(id, std::min(z, 0.9 * config_.height_m), levels - 1);
      }
    }
  }

  /// A branch that starts on the centre line of its parent and bends as it grows.
  int AddBranch(int parent,
                const Eigen::Vector3d& start,
                Eigen::Vector3d direction,
                double base_radius,
                double tip_radius,
                double length,
                double gravitropism,
                bool dead) {
    SceneBranch branch;
    branch.id = static_cast<int>(tree_->branches.size());
    branch.parent = parent;
    branch.dead = dead;
    const int pieces = std::max(2, static_cast<int>(std::ceil(length / config_.segment_length_m)));
    const double step = length / pieces;
    Eigen::Vector3d p = start;
    branch.points.push_back({p, base_radius});
    for (int i = 1; i <= pieces; ++i) {
      const double u = static_cast<double>(i) / pieces;
      const Eigen::Vector3d noise(rng_.Gauss(), rng_.Gauss(), rng_.Gauss());
      direction = (direction + gravitropism / pieces * Eigen::Vector3d::UnitZ() + 0.06 * std::sqrt(step) * noise).normalized();
      p += step * direction;
      // Wood does not grow into the ground.
      if (p.z() < base_.z() + 0.15) {
        p.z() = base_.z() + 0.15;
        direction.z() = std::max(direction.z(), 0.1);
        direction.normalize();
      }
      branch.points.push_back({p, base_radius + u * (tip_radius - base_radius)});
    }
    tree_->branches.push_back(branch);
    return branch.id;
  }

  /// Place, direction and radius of a parent at a part of its length.
  struct Station {
    Eigen::Vector3d position, axis;
    double radius;
  };
  Station At(int id, double part) const {
    const SceneBranch& b = tree_->branches[static_cast<std::size_t>(id)];
    double along = part * b.Length();
    for (std::size_t i = 1; i < b.points.size(); ++i) {
      const Eigen::Vector3d d = b.points[i].position - b.points[i - 1].position;
      const double length = d.norm();
      if (along <= length || i + 1 == b.points.size()) {
        const double u = std::clamp(along / length, 0.0, 1.0);
        return {b.points[i - 1].position + u * d, d / length,
                b.points[i - 1].radius_m + u * (b.points[i].radius_m - b.points[i - 1].radius_m)};
      }
      along -= length;
    }
    return {b.points.back().position, Eigen::Vector3d::UnitZ(), b.points.back().radius_m};
  }

  Eigen::Vector3d Away(const Eigen::Vector3d& axis, double azimuth, double angle) const {
    const Eigen::Matrix<double, 3, 2> basis = PerpendicularBasis(axis);
    return std::cos(angle) * axis + std::sin(angle) * (basis * Eigen::Vector2d(std::cos(azimuth), std::sin(azimuth)));
  }

  void FirstOrder() {
    std::vector<int> carriers = {0};
    if (config_.form == "decurrent") carriers = leaders_;
    double azimuth = rng_.Uniform(0.0, 2.0 * M_PI);
    for (int k = 0; k < config_.num_branches; ++k) {
      const int parent = carriers[static_cast<std::size_t>(k) % carriers.size()];
      double part;
      if (config_.form == "decurrent") {
        part = rng_.Uniform(0.2, 0.9);
      } else {
        const double spread = (k + rng_.Uniform(0.2, 0.8)) / config_.num_branches;
        part = config_.crown_base_ratio + (0.95 - config_.crown_base_ratio) * spread;
      }
      const Station at = At(parent, part);
      // Phyllotaxis: the golden angle between neighbours.
      azimuth += 137.5 * kDegree + rng_.Uniform(-0.3, 0.3);
      double angle = Vary(config_.branch_angle_deg, 0.25) * kDegree;
      double length = config_.branch_length_ratio * config_.height_m * rng_.Uniform(0.6, 1.0);
      double gravitropism = config_.gravitropism;
      double ratio = rng_.Uniform(0.3, 0.6);
      if (config_.form == "excurrent") length *= 1.0 - 0.75 * std::max(0.0, part - config_.crown_base_ratio);
      if (config_.form == "columnar") {
        // Arms leave sideways, turn up sharply and stay stout.
        angle = Vary(75.0, 0.15) * kDegree;
        gravitropism = 2.5;
        ratio = rng_.Uniform(0.65, 0.9);
      }
      double radius = ratio * at.radius;
      const double cap = config_.form == "columnar" ? radius : std::min(radius, 0.03 * length + 0.005);
      radius = std::max(config_.min_radius_m, cap);
      if (radius <= config_.min_radius_m * 1.01 && config_.form != "columnar") continue;
      const double tip = config_.form == "columnar"
                             ? 0.8 * radius
                             : std::max(config_.min_radius_m, radius * (1.0 - std::max(0.5, config_.taper)));
      const int id = AddBranch(parent, at.position, Away(at.axis, azimuth, angle), radius, tip, length, gravitropism,
                               config_.max_order == 1 && rng_.Uniform() < config_.dead_twig_ratio);
      if (config_.max_order >= 2 && config_.form != "columnar") Children(id, 2);
    }
  }

  void Children(int parent, int order) {
    const double parent_length = tree_->branches[static_cast<std::size_t>(parent)].Length();
    double azimuth = rng_.Uniform(0.0, 2.0 * M_PI);
    for (int k = 0; k < config_.children_per_branch; ++k) {
      const double part = 0.25 + 0.7 * (k + rng_.Uniform(0.1, 0.9)) / config_.children_per_branch;
      const Station at = At(parent, part);
      azimuth += 137.5 * kDegree;
      const double radius = rng_.Uniform(0.45, 0.75) * at.radius;
      if (radius < config_.min_radius_m) continue;
      const bool last = order >= config_.max_order;
      const bool dead = last && rng_.Uniform() < config_.dead_twig_ratio;
      double length = parent_length * rng_.Uniform(0.3, 0.55) * (1.1 - 0.6 * part);
      if (dead) length *= 0.4;
      const int id = AddBranch(parent, at.position, Away(at.axis, azimuth, Vary(config_.branch_angle_deg, 0.3) * kDegree),
                               radius, std::max(config_.min_radius_m, 0.35 * radius), std::max(0.1, length),
                               config_.gravitropism, dead);
      if (!last) Children(id, order + 1);
    }
  }

  /// No branch is thicker than its parent where it leaves, and no radius below the smallest.
  void ClampRadii(double largest) {
    for (SceneBranch& b : tree_->branches) {
      for (BranchPoint& p : b.points) p.radius_m = std::clamp(p.radius_m, config_.min_radius_m, largest);
    }
  }

  const TreeGeneratorConfig& config_;
  Eigen::Vector3d base_;
  CounterRng rng_;
  SceneTree* tree_ = nullptr;
  std::vector<int> leaders_;
};

}  // namespace

void TreeGeneratorConfig::Validate() const {
  const auto require = [](bool ok, const char* message) {
    if (!ok) throw std::invalid_argument(message);
  };
  require(form == "excurrent" || form == "decurrent" || form == "columnar",
          "form: expected excurrent, decurrent or columnar");
  require(height_m >= 0.5 && height_m <= 80.0, "height_m: expected 0.5 to 80");
  require(dbh_m >= 0.01 && dbh_m <= 5.0, "dbh_m: expected 0.01 to 5");
  require(crown_base_ratio >= 0.0 && crown_base_ratio < 0.95, "crown_base_ratio: expected 0 to 0.95");
  require(num_branches >= 0 && num_branches <= 500, "num_branches: expected 0 to 500");
  require(max_order >= 0 && max_order <= 3, "max_order: expected 0 to 3");
  require(children_per_branch >= 0 && children_per_branch <= 20, "children_per_branch: expected 0 to 20");
  require(branch_angle_deg > 0.0 && branch_angle_deg < 150.0, "branch_angle_deg: expected 0 to 150");
  require(branch_length_ratio > 0.0 && branch_length_ratio <= 1.0, "branch_length_ratio: expected 0 to 1");
  require(taper >= 0.0 && taper <= 0.98, "taper: expected 0 to 0.98");
  require(sweep >= 0.0 && sweep <= 0.5, "sweep: expected 0 to 0.5");
  require(lean_deg >= 0.0 && lean_deg <= 45.0, "lean_deg: expected 0 to 45");
  require(std::abs(gravitropism) <= 5.0, "gravitropism: expected -5 to 5");
  require(num_forks >= 0 && num_forks <= 4, "num_forks: expected 0 to 4");
  require(pipe_exponent >= 1.5 && pipe_exponent <= 4.0, "pipe_exponent: expected 1.5 to 4");
  require(min_radius_m > 0.0 && min_radius_m <= 0.5 * dbh_m, "min_radius_m: expected > 0 and at most half of dbh_m");
  require(dead_twig_ratio >= 0.0 && dead_twig_ratio <= 1.0, "dead_twig_ratio: expected 0 to 1");
  require(leaf_count >= 0 && leaf_count <= 2000000, "leaf_count: expected 0 to 2000000");
  require(leaf_size_m > 0.0 && leaf_size_m <= 1.0, "leaf_size_m: expected 0 to 1");
  require(segment_length_m >= 0.05, "segment_length_m: expected at least 0.05");
}

SceneTree GenerateTree(const TreeGeneratorConfig& config, const Eigen::Vector3d& base, std::uint64_t seed) {
  config.Validate();
  return Grower(config, base, seed).Grow(seed);
}

TreeGeneratorConfig RandomTreeConfig(std::uint64_t seed) {
  CounterRng rng(seed, 0xC0F16);
  TreeGeneratorConfig c;
  const double form = rng.Uniform();
  c.form = form < 0.45 ? "excurrent" : form < 0.85 ? "decurrent" : "columnar";
  c.height_m = rng.Uniform(3.0, 14.0);
  c.dbh_m = std::clamp(c.height_m * rng.Uniform(0.018, 0.05), 0.08, 0.7);
  c.crown_base_ratio = rng.Uniform(0.12, 0.5);
  c.num_branches = 3 + rng.Below(14);
  c.max_order = 1 + rng.Below(3);
  c.children_per_branch = 2 + rng.Below(4);
  c.branch_angle_deg = rng.Uniform(30.0, 85.0);
  c.branch_length_ratio = rng.Uniform(0.2, 0.55);
  c.taper = rng.Uniform(0.4, 0.95);
  c.sweep = rng.Uniform(0.0, 0.12);
  c.lean_deg = rng.Uniform(0.0, 8.0);
  c.gravitropism = rng.Uniform(-0.5, 1.2);
  c.num_forks = 1 + rng.Below(2);
  c.dead_twig_ratio = rng.Uniform(0.0, 0.3);
  c.leaf_size_m = rng.Uniform(0.03, 0.12);
  if (c.form == "columnar") {
    c.dbh_m = std::clamp(c.height_m * rng.Uniform(0.04, 0.08), 0.2, 0.7);
    c.num_branches = rng.Below(6);
    c.branch_length_ratio = rng.Uniform(0.2, 0.4);
    c.taper = rng.Uniform(0.1, 0.4);
  }
  return c;
}

void SceneGeneratorConfig::Validate() const {
  const auto require = [](bool ok, const char* message) {
    if (!ok) throw std::invalid_argument(message);
  };
  require(num_trees >= 0 && num_trees <= 1000, "num_trees: expected 0 to 1000");
  require(area_m > 0.0 && area_m <= 1000.0, "area_m: expected 0 to 1000");
  require(min_spacing_m >= 0.0, "min_spacing_m: expected >= 0");
  require(leaf_probability >= 0.0 && leaf_probability <= 1.0, "leaf_probability: expected 0 to 1");
  require(num_obstacles >= 0 && num_rocks >= 0 && num_grass_tufts >= 0,
          "num_obstacles, num_rocks, num_grass_tufts: expected >= 0");
}

Scene GenerateScene(const SceneGeneratorConfig& config, std::uint64_t seed) {
  config.Validate();
  CounterRng rng(seed, 0x5CE7E);
  Scene scene;
  if (config.rough_ground) {
    scene.ground.type = SceneGround::Type::kRough;
    scene.ground.amplitude_m = rng.Uniform(0.02, 0.2);
    scene.ground.wavelength_m = rng.Uniform(2.0, 8.0);
    scene.ground.seed = seed;
  }
  scene.reflectivity.ground = rng.Uniform(0.15, 0.4);
  scene.reflectivity.trunk = rng.Uniform(0.2, 0.55);
  scene.reflectivity.branch = scene.reflectivity.trunk * rng.Uniform(0.8, 1.2);
  scene.reflectivity.leaf = rng.Uniform(0.3, 0.6);
  scene.reflectivity.obstacle = rng.Uniform(0.2, 0.9);

  std::vector<Eigen::Vector2d> trunks;
  const double half = 0.5 * config.area_m;
  for (int i = 0; i < config.num_trees; ++i) {
    Eigen::Vector2d place = Eigen::Vector2d::Zero();
    bool free = config.num_trees == 1;
    for (int attempt = 0; attempt < 200 && !free; ++attempt) {
      place = {rng.Uniform(-half, half), rng.Uniform(-half, half)};
      free = std::all_of(trunks.begin(), trunks.end(), [&](const Eigen::Vector2d& t) {
        return (t - place).norm() >= config.min_spacing_m;
      });
    }
    if (!free) break;  // The square is full.
    trunks.push_back(place);
    const std::uint64_t tree_seed = seed * 1000 + static_cast<std::uint64_t>(i);
    TreeGeneratorConfig tree = RandomTreeConfig(tree_seed);
    if (rng.Uniform() < config.leaf_probability && tree.form != "columnar") {
      tree.leaf_count = static_cast<int>(rng.Uniform(500.0, 9000.0));
    }
    const double z = GroundHeight(scene.ground, place.x(), place.y());
    scene.trees.push_back(GenerateTree(tree, {place.x(), place.y(), z}, tree_seed));
  }
  const auto free_place = [&](double margin) {
    for (int attempt = 0; attempt < 100; ++attempt) {
      const Eigen::Vector2d p(rng.Uniform(-1.6 * half, 1.6 * half), rng.Uniform(-1.6 * half, 1.6 * half));
      const bool ok = std::all_of(trunks.begin(), trunks.end(),
                                  [&](const Eigen::Vector2d& t) { return (t - p).norm() >= margin; });
      if (ok) return p;
    }
    return Eigen::Vector2d(1.6 * half, 1.6 * half);
  };
  for (int i = 0; i < config.num_obstacles; ++i) {
    SceneBox box;
    const double kind = rng.Uniform();
    if (kind < 0.35) {
      box.size_m = {rng.Uniform(2.0, 8.0), rng.Uniform(0.15, 0.4), rng.Uniform(1.0, 4.0)};  // Wall.
    } else if (kind < 0.7) {
      const double w = rng.Uniform(0.08, 0.3);
      box.size_m = {w, w, rng.Uniform(1.5, 6.0)};  // Post.
    } else {
      box.size_m = {rng.Uniform(0.5, 2.5), rng.Uniform(0.5, 2.5), rng.Uniform(0.4, 2.5)};  // Crate, car.
    }
    const Eigen::Vector2d p = free_place(2.0);
    box.position = {p.x(), p.y(), GroundHeight(scene.ground, p.x(), p.y()) + 0.5 * box.size_m.z() - 0.1};
    box.yaw_deg = rng.Uniform(0.0, 180.0);
    scene.obstacles.push_back(box);
  }
  for (int i = 0; i < config.num_rocks; ++i) {
    SceneBox rock;
    rock.size_m = {rng.Uniform(0.2, 1.2), rng.Uniform(0.2, 1.2), rng.Uniform(0.15, 0.7)};
    const Eigen::Vector2d p = free_place(1.0);
    rock.position = {p.x(), p.y(), GroundHeight(scene.ground, p.x(), p.y()) + 0.3 * rock.size_m.z()};
    rock.yaw_deg = rng.Uniform(0.0, 180.0);
    scene.obstacles.push_back(rock);
  }
  if (config.num_grass_tufts > 0) {
    // Tufts of blades: leaves around stalks that are too thin to count as wood.
    SceneTree grass;
    grass.name = "grass";
    for (int i = 0; i < config.num_grass_tufts; ++i) {
      const Eigen::Vector2d p = free_place(0.3);
      const double z = GroundHeight(scene.ground, p.x(), p.y());
      SceneBranch stalk;
      stalk.id = i;
      const Eigen::Vector3d foot(p.x(), p.y(), z);
      stalk.points = {{foot, 1e-4},
                      {foot + Eigen::Vector3d(rng.Uniform(-0.1, 0.1), rng.Uniform(-0.1, 0.1), rng.Uniform(0.15, 0.6)), 1e-4}};
      grass.branches.push_back(stalk);
    }
    grass.leaves.count = 60 * config.num_grass_tufts;
    grass.leaves.size_m = 0.03;
    grass.leaves.spread_m = 0.06;
    grass.leaves.seed = seed;
    scene.trees.push_back(grass);
  }
  return scene;
}

}  // namespace dendro
