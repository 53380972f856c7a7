#include "dendro_slam/sim/scene.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <limits>
#include <sstream>

#include <Eigen/Geometry>
#include <fmt/format.h>

#include "counter_rng.h"
#include "dendro_slam/geometry/cylinder.h"
#include "mesh_file.h"
#include "rough_ground.h"
#include "yaml_reader.h"

namespace dendro {
namespace {

constexpr double kDegree = M_PI / 180.0;
constexpr int kMostLeaves = 20000000;  ///< Of one tree; a large oak has a fiftieth of that.

SurfaceKind ReadKind(const YamlMap& map,
                     const std::string& key,
                     SurfaceKind fallback) {
  if (!map.Has(key)) return fallback;
  const std::string name = map.String(key);
  if (name == "wood") return SurfaceKind::kTrunk;
  for (const SurfaceKind kind : {SurfaceKind::kGround, SurfaceKind::kTrunk, SurfaceKind::kBranch,
                                 SurfaceKind::kLeaf, SurfaceKind::kObstacle}) {
    if (name == SurfaceKindName(kind)) return kind;
  }
  map.Fail(key, "expected one of ground, trunk, branch, wood, leaf, obstacle");
}

SceneBranch ReadBranch(const YamlMap& map) {
  map.AllowOnly({"id", "parent", "points", "dead"});
  SceneBranch branch;
  branch.id = map.Integer("id");
  if (branch.id < 0 || branch.id > 32767) map.Fail("id", "expected a whole number from 0 to 32767");
  if (!map.Has("parent")) map.Fail("parent", "the key is missing; expected null for the trunk or the id of a branch");
  if (!map.IsNull("parent")) {
    branch.parent = map.Integer("parent");
    if (branch.parent < 0) map.Fail("parent", "expected null for the trunk or the id of a branch");
  }
  branch.dead = map.Boolean("dead", false);
  const auto rows = map.Rows("points", 4);
  if (rows.size() < 2) map.Fail("points", "expected at least two points [x, y, z, radius]");
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const std::vector<double>& row = rows[i];
    if (row[3] < 0.0) {
      map.Fail("points", fmt::format("point {} has radius {}; expected a radius >= 0", i, row[3]));
    }
    branch.points.push_back({{row[0], row[1], row[2]}, row[3]});
  }
  if (branch.Length() <= 0.0) map.Fail("points", "the branch has no length; expected points at different places");
  return branch;
}

/// Every parent must exist.
bool LeadsToTrunk(const SceneTree& tree, const SceneBranch& branch) {
  const SceneBranch* at = &branch;
  for (std::size_t steps = 0; steps <= tree.branches.size(); ++steps) {
    if (at->parent < 0) return true;
    at = tree.FindBranch(at->parent);
  }
  return false;
}

SceneTree ReadTree(const YamlMap& map) {
  map.AllowOnly({"name", "branches", "leaves"});
  SceneTree tree;
  tree.name = map.String("name");
  const std::vector<YamlMap> branches = map.Maps("branches");
  for (const YamlMap& branch_map : branches) {
    tree.branches.push_back(ReadBranch(branch_map));
    const int id = tree.branches.back().id;
    for (std::size_t i = 0; i + 1 < tree.branches.size(); ++i) {
      if (tree.branches[i].id == id) branch_map.Fail("id", fmt::format("branch {} appears twice", id));
    }
  }
  for (std::size_t i = 0; i < branches.size(); ++i) {
    const SceneBranch& branch = tree.branches[i];
    if (branch.parent == -1) continue;
    if (branch.parent == branch.id || tree.FindBranch(branch.parent) == nullptr) {
      branches[i].Fail("parent", fmt::format("branch {} does not exist in tree {}; expected null or the "
                                             "id of another branch of the tree",
                                             branch.parent, tree.name));
    }
  }
  for (std::size_t i = 0; i < branches.size(); ++i) {
    if (!LeadsToTrunk(tree, tree.branches[i])) {
      branches[i].Fail("parent", "the parents go in a circle; expected them to lead to a trunk (parent: null)");
    }
  }
  if (map.Has("leaves")) {
    const YamlMap leaves = map.Map("leaves");
    leaves.AllowOnly({"count", "size_m", "seed", "max_wood_radius_m", "spread_m"});
    tree.leaves.count = leaves.Integer("count");
    if (tree.leaves.count < 0 || tree.leaves.count > kMostLeaves) {
      leaves.Fail("count", fmt::format("expected a number from 0 to {}", kMostLeaves));
    }
    tree.leaves.size_m = leaves.Number("size_m", tree.leaves.size_m);
    if (tree.leaves.size_m <= 0.0) leaves.Fail("size_m", "expected a size > 0 [m]");
    tree.leaves.seed = leaves.Seed("seed", tree.leaves.seed);
    tree.leaves.max_wood_radius_m = leaves.Number("max_wood_radius_m", tree.leaves.max_wood_radius_m);
    if (tree.leaves.max_wood_radius_m <= 0.0) leaves.Fail("max_wood_radius_m", "expected a radius > 0 [m]");
    tree.leaves.spread_m = leaves.Number("spread_m", tree.leaves.spread_m);
    if (tree.leaves.spread_m < 0.0) leaves.Fail("spread_m", "expected a distance >= 0 [m]");
  }
  if (tree.branches.empty() && tree.leaves.count > 0) {
    map.Fail("branches", "a tree with leaves needs branches");
  }
  return tree;
}

SceneGround ReadGround(const YamlMap& map) {
  SceneGround ground;
  const std::string type = map.String("type");
  if (type == "none") {
    map.AllowOnly({"type"});
    ground.type = SceneGround::Type::kNone;
  } else if (type == "plane") {
    map.AllowOnly({"type", "z"});
    ground.type = SceneGround::Type::kPlane;
    ground.z_m = map.Number("z", 0.0);
  } else if (type == "rough") {
    map.AllowOnly({"type", "z", "amplitude_m", "wavelength_m", "seed"});
    ground.type = SceneGround::Type::kRough;
    ground.z_m = map.Number("z", 0.0);
    ground.amplitude_m = map.Number("amplitude_m", ground.amplitude_m);
    if (ground.amplitude_m < 0.0) map.Fail("amplitude_m", "expected an amplitude >= 0 [m]");
    ground.wavelength_m = map.Number("wavelength_m", ground.wavelength_m);
    if (ground.wavelength_m <= 0.0) map.Fail("wavelength_m", "expected a wavelength > 0 [m]");
    ground.seed = map.Seed("seed", ground.seed);
  } else {
    map.Fail("type", "expected plane, rough or none");
  }
  return ground;
}

SceneBox ReadBox(const YamlMap& map) {
  map.AllowOnly({"type", "size_m", "position", "yaw_deg", "label"});
  if (map.String("type") != "box") map.Fail("type", "expected box");
  SceneBox box;
  box.size_m = map.Vector("size_m");
  if (!(box.size_m.array() > 0.0).all()) map.Fail("size_m", "expected three lengths > 0 [m]");
  box.position = map.Vector("position");
  box.yaw_deg = map.Number("yaw_deg", 0.0);
  box.kind = ReadKind(map, "label", SurfaceKind::kObstacle);
  return box;
}

std::string Resolve(const std::string& scene_file, const std::string& file) {
  const std::filesystem::path path = std::filesystem::path(scene_file).parent_path() / file;
  return std::filesystem::absolute(path).lexically_normal().string();
}

SceneMesh ReadMesh(const YamlMap& map, const std::string& scene_file) {
  map.AllowOnly({"file", "position", "scale", "yaw_deg", "label"});
  SceneMesh mesh;
  mesh.file = Resolve(scene_file, map.String("file"));
  mesh.position = map.Vector("position", Eigen::Vector3d::Zero());
  mesh.scale = map.Number("scale", 1.0);
  if (mesh.scale <= 0.0) map.Fail("scale", "expected a factor > 0");
  mesh.yaw_deg = map.Number("yaw_deg", 0.0);
  mesh.kind = ReadKind(map, "label", SurfaceKind::kObstacle);
  try {
    TriangleMesh triangles = ReadMeshFile(mesh.file);
    mesh.vertices = std::move(triangles.vertices);
    mesh.triangles = std::move(triangles.triangles);
  } catch (const SceneFileError& e) {
    map.Fail("file", e.what());
  }
  const Eigen::AngleAxisd turn(mesh.yaw_deg * kDegree, Eigen::Vector3d::UnitZ());
  for (Eigen::Vector3d& v : mesh.vertices) v = turn * (mesh.scale * v) + mesh.position;
  return mesh;
}

SceneCloud ReadCloud(const YamlMap& map, const std::string& scene_file) {
  map.AllowOnly({"file", "position", "point_radius_m", "label"});
  SceneCloud cloud;
  cloud.file = Resolve(scene_file, map.String("file"));
  cloud.position = map.Vector("position", Eigen::Vector3d::Zero());
  cloud.point_radius_m = map.Number("point_radius_m", cloud.point_radius_m);
  if (cloud.point_radius_m <= 0.0) map.Fail("point_radius_m", "expected a radius > 0 [m]");
  cloud.kind = ReadKind(map, "label", SurfaceKind::kTrunk);
  try {
    cloud.points = ReadPointFile(cloud.file);
  } catch (const SceneFileError& e) {
    map.Fail("file", e.what());
  }
  for (Eigen::Vector3d& p : cloud.points) p += cloud.position;
  return cloud;
}

SceneReflectivity ReadReflectivity(const YamlMap& map) {
  map.AllowOnly({"ground", "trunk", "branch", "leaf", "obstacle"});
  SceneReflectivity r;
  const auto read = [&map](const char* key, double* value) {
    *value = map.Number(key, *value);
    if (*value < 0.0) map.Fail(key, "expected a reflectivity >= 0");
  };
  read("ground", &r.ground);
  read("trunk", &r.trunk);
  read("branch", &r.branch);
  read("leaf", &r.leaf);
  read("obstacle", &r.obstacle);
  return r;
}

/// Shortest text that reads back to the same number.
std::string Text(double value) { return fmt::format("{}", value == 0.0 ? 0.0 : value); }

std::string Text(const Eigen::Vector3d& v) {
  return fmt::format("[{}, {}, {}]", Text(v.x()), Text(v.y()), Text(v.z()));
}

/// A text that YAML reads back unchanged.
std::string Quoted(const std::string& text) {
  std::string out = "\"";
  for (const char c : text) {
    if (c == '"' || c == '\\') out += '\\';
    out += c;
  }
  return out + "\"";
}

}  // namespace

const char* SurfaceKindName(SurfaceKind kind) {
  switch (kind) {
    case SurfaceKind::kNone: return "none";
    case SurfaceKind::kGround: return "ground";
    case SurfaceKind::kTrunk: return "trunk";
    case SurfaceKind::kBranch: return "branch";
    case SurfaceKind::kLeaf: return "leaf";
    case SurfaceKind::kObstacle: return "obstacle";
  }
  return "none";
}

Label SurfaceLabel(SurfaceKind kind) {
  switch (kind) {
    case SurfaceKind::kNone: return Label::kNone;
    case SurfaceKind::kGround: return Label::kGround;
    case SurfaceKind::kTrunk: return Label::kWood;
    case SurfaceKind::kBranch: return Label::kWood;
    case SurfaceKind::kLeaf: return Label::kLeaf;
    case SurfaceKind::kObstacle: return Label::kOther;
  }
  return Label::kNone;
}

double SceneBranch::Length() const {
  double length = 0.0;
  for (std::size_t i = 1; i < points.size(); ++i) {
    length += (points[i].position - points[i - 1].position).norm();
  }
  return length;
}

const SceneBranch* SceneTree::FindBranch(int id) const {
  for (const SceneBranch& branch : branches) {
    if (branch.id == id) return &branch;
  }
  return nullptr;
}

double SceneReflectivity::Of(SurfaceKind kind) const {
  switch (kind) {
    case SurfaceKind::kNone: return 0.0;
    case SurfaceKind::kGround: return ground;
    case SurfaceKind::kTrunk: return trunk;
    case SurfaceKind::kBranch: return branch;
    case SurfaceKind::kLeaf: return leaf;
    case SurfaceKind::kObstacle: return obstacle;
  }
  return 0.0;
}

std::vector<Disc> MakeLeaves(const SceneTree& tree) {
  std::vector<Disc> leaves;
  if (tree.leaves.count <= 0 || tree.branches.empty()) return leaves;
  // Leaves hang on the thin wood, in proportion to its length.
  struct Twig {
    Eigen::Vector3d start, end;
    double start_radius_m, end_radius_m, length_until_m;
  };
  std::vector<Twig> twigs;
  double total_m = 0.0;
  const auto collect = [&](double limit_m) {
    for (const SceneBranch& branch : tree.branches) {
      if (branch.dead) continue;
      for (std::size_t i = 1; i < branch.points.size(); ++i) {
        const BranchPoint& a = branch.points[i - 1];
        const BranchPoint& b = branch.points[i];
        if (std::min(a.radius_m, b.radius_m) > limit_m) continue;
        const double length = (b.position - a.position).norm();
        if (length <= 0.0) continue;
        // Only the part of a tapering piece that is thin enough.
        double from = 0.0, to = 1.0;
        if (a.radius_m > limit_m) from = (a.radius_m - limit_m) / (a.radius_m - b.radius_m);
        if (b.radius_m > limit_m) to = (limit_m - a.radius_m) / (b.radius_m - a.radius_m);
        if (to <= from) continue;
        const Eigen::Vector3d d = b.position - a.position;
        const double dr = b.radius_m - a.radius_m;
        total_m += (to - from) * length;
        twigs.push_back({a.position + from * d, a.position + to * d, a.radius_m + from * dr,
                         a.radius_m + to * dr, total_m});
      }
    }
  };
  collect(tree.leaves.max_wood_radius_m);
  // A tree without wood that thin still carries its leaves, on whatever it has.
  if (twigs.empty()) collect(std::numeric_limits<double>::infinity());
  if (twigs.empty()) return leaves;
  leaves.reserve(static_cast<std::size_t>(tree.leaves.count));
  for (int i = 0; i < tree.leaves.count; ++i) {
    CounterRng rng(tree.leaves.seed, static_cast<std::uint64_t>(i), 0x1eaf);
    const double at = rng.Uniform() * total_m;
    const auto twig = std::min(std::lower_bound(twigs.begin(), twigs.end(), at,
                                                [](const Twig& t, double s) { return t.length_until_m < s; }),
                               twigs.end() - 1);
    const double u = rng.Uniform();
    const Eigen::Vector3d axis = (twig->end - twig->start).normalized();
    const Eigen::Matrix<double, 3, 2> basis = PerpendicularBasis(axis);
    const double angle = rng.Uniform(0.0, 2.0 * M_PI);
    const double radius = 0.5 * tree.leaves.size_m * rng.Uniform(0.7, 1.3);
    const double away = twig->start_radius_m + u * (twig->end_radius_m - twig->start_radius_m) + radius -
                        tree.leaves.spread_m * std::log(1.0 - 0.95 * rng.Uniform());
    Disc leaf;
    leaf.centre = twig->start + u * (twig->end - twig->start) +
                  away * (basis * Eigen::Vector2d(std::cos(angle), std::sin(angle)));
    // Leaves prefer to face the sky, but not much.
    const Eigen::Vector3d n(rng.Gauss(), rng.Gauss(), rng.Gauss() + 0.7);
    leaf.normal = n.norm() > 1e-6 ? n.normalized() : Eigen::Vector3d::UnitZ();
    leaf.radius_m = radius;
    leaves.push_back(leaf);
  }
  return leaves;
}

double GroundHeight(const SceneGround& ground, double x, double y) {
  switch (ground.type) {
    case SceneGround::Type::kNone: return -std::numeric_limits<double>::infinity();
    case SceneGround::Type::kPlane: return ground.z_m;
    case SceneGround::Type::kRough: return RoughGround(ground).Height(x, y);
  }
  return ground.z_m;
}

void ValidateScene(const Scene& scene) {
  if (scene.trees.size() > 32767) throw std::invalid_argument("scene: more than 32767 trees");
  for (const SceneTree& tree : scene.trees) {
    std::vector<int> ids;
    for (const SceneBranch& branch : tree.branches) ids.push_back(branch.id);
    std::sort(ids.begin(), ids.end());
    for (const SceneBranch& branch : tree.branches) {
      const auto fail = [&](const std::string& what) {
        throw std::invalid_argument(fmt::format("tree {} branch {}: {}", tree.name, branch.id, what));
      };
      if (branch.id < 0 || branch.id > 32767) fail("id must be from 0 to 32767");
      const auto range = std::equal_range(ids.begin(), ids.end(), branch.id);
      if (range.second - range.first > 1) fail("id appears twice");
      if (branch.parent != -1 && (branch.parent == branch.id ||
                                  !std::binary_search(ids.begin(), ids.end(), branch.parent))) {
        fail(fmt::format("parent {} does not exist", branch.parent));
      }
      if (branch.points.size() < 2) fail("points: at least two are needed");
      for (const BranchPoint& p : branch.points) {
        if (!p.position.allFinite()) fail("points: positions must be finite");
        if (!std::isfinite(p.radius_m) || p.radius_m < 0.0) fail("points: radii must be >= 0");
      }
      if (branch.Length() <= 0.0) fail("points: the branch has no length");
      if (!LeadsToTrunk(tree, branch)) fail("parents go in a circle");
    }
    if (tree.leaves.count < 0) throw std::invalid_argument("tree " + tree.name + ": leaves.count must be >= 0");
    if (!(tree.leaves.size_m > 0.0)) throw std::invalid_argument("tree " + tree.name + ": leaves.size_m must be > 0");
  }
  for (const SceneBox& box : scene.obstacles) {
    if (!(box.size_m.array() > 0.0).all() || !box.size_m.allFinite() || !box.position.allFinite()) {
      throw std::invalid_argument("obstacles: size_m must be > 0 and position finite");
    }
  }
  for (const SceneMesh& mesh : scene.meshes) {
    for (const Eigen::Vector3d& v : mesh.vertices) {
      if (!v.allFinite()) throw std::invalid_argument("mesh " + mesh.file + ": vertices must be finite");
    }
    for (const auto& t : mesh.triangles) {
      for (const std::uint32_t i : t) {
        if (i >= mesh.vertices.size()) {
          throw std::invalid_argument("mesh " + mesh.file + ": a triangle names a vertex that does not exist");
        }
      }
    }
  }
  for (const SceneCloud& cloud : scene.clouds) {
    if (!(cloud.point_radius_m > 0.0)) {
      throw std::invalid_argument("cloud " + cloud.file + ": point_radius_m must be > 0");
    }
    for (const Eigen::Vector3d& p : cloud.points) {
      if (!p.allFinite()) throw std::invalid_argument("cloud " + cloud.file + ": points must be finite");
    }
  }
}

Scene ParseScene(const std::string& text, const std::string& name) {
  const YamlMap map = YamlMap::Parse(text, name);
  map.AllowOnly({"frame", "trees", "ground", "obstacles", "meshes", "clouds", "reflectivity"});
  Scene scene;
  scene.frame = map.String("frame", "map");
  if (scene.frame != "map") map.Fail("frame", "expected map");
  for (const YamlMap& tree : map.Maps("trees")) {
    scene.trees.push_back(ReadTree(tree));
    for (std::size_t i = 0; i + 1 < scene.trees.size(); ++i) {
      if (scene.trees[i].name == scene.trees.back().name) tree.Fail("name", "another tree has this name");
    }
  }
  if (!map.Has("ground")) {
    map.Fail("ground", "the key is missing; expected {type: plane, rough or none}");
  }
  scene.ground = ReadGround(map.Map("ground"));
  for (const YamlMap& box : map.Maps("obstacles")) scene.obstacles.push_back(ReadBox(box));
  for (const YamlMap& mesh : map.Maps("meshes")) scene.meshes.push_back(ReadMesh(mesh, name));
  for (const YamlMap& cloud : map.Maps("clouds")) scene.clouds.push_back(ReadCloud(cloud, name));
  if (map.Has("reflectivity")) scene.reflectivity = ReadReflectivity(map.Map("reflectivity"));
  return scene;
}

Scene LoadScene(const std::string& path) {
  std::ifstream file(path);
  if (!file) throw SceneFileError(fmt::format("{}: cannot be read: {}", path, std::strerror(errno)));
  std::ostringstream text;
  text << file.rdbuf();
  return ParseScene(text.str(), path);
}

std::string FormatScene(const Scene& scene) {
  std::string out = fmt::format("frame: {}\ntrees:{}\n", scene.frame, scene.trees.empty() ? " []" : "");
  for (const SceneTree& tree : scene.trees) {
    out += fmt::format("  - name: {}\n    branches:{}\n", Quoted(tree.name),
                       tree.branches.empty() ? " []" : "");
    for (const SceneBranch& branch : tree.branches) {
      const std::string parent = branch.parent < 0 ? "null" : std::to_string(branch.parent);
      out += fmt::format("      - {{id: {}, parent: {}, {}points: [", branch.id, parent,
                         branch.dead ? "dead: true, " : "");
      for (std::size_t i = 0; i < branch.points.size(); ++i) {
        const BranchPoint& p = branch.points[i];
        out += fmt::format("{}[{}, {}, {}, {}]", i == 0 ? "" : ", ", Text(p.position.x()),
                           Text(p.position.y()), Text(p.position.z()), Text(p.radius_m));
      }
      out += "]}\n";
    }
    const SceneLeaves& l = tree.leaves;
    out += fmt::format(
        "    leaves: {{count: {}, size_m: {}, seed: {}, max_wood_radius_m: {}, spread_m: {}}}\n", l.count,
        Text(l.size_m), l.seed, Text(l.max_wood_radius_m), Text(l.spread_m));
  }
  const SceneGround& g = scene.ground;
  switch (g.type) {
    case SceneGround::Type::kNone: out += "ground: {type: none}\n"; break;
    case SceneGround::Type::kPlane: out += fmt::format("ground: {{type: plane, z: {}}}\n", Text(g.z_m)); break;
    case SceneGround::Type::kRough:
      out += fmt::format("ground: {{type: rough, z: {}, amplitude_m: {}, wavelength_m: {}, seed: {}}}\n",
                         Text(g.z_m), Text(g.amplitude_m), Text(g.wavelength_m), g.seed);
      break;
  }
  if (!scene.obstacles.empty()) out += "obstacles:\n";
  for (const SceneBox& box : scene.obstacles) {
    out += fmt::format("  - {{type: box, size_m: {}, position: {}, yaw_deg: {}, label: {}}}\n",
                       Text(box.size_m), Text(box.position), Text(box.yaw_deg), SurfaceKindName(box.kind));
  }
  if (!scene.meshes.empty()) out += "meshes:\n";
  for (const SceneMesh& mesh : scene.meshes) {
    out += fmt::format("  - {{file: {}, position: {}, scale: {}, yaw_deg: {}, label: {}}}\n",
                       Quoted(mesh.file), Text(mesh.position), Text(mesh.scale), Text(mesh.yaw_deg),
                       SurfaceKindName(mesh.kind));
  }
  if (!scene.clouds.empty()) out += "clouds:\n";
  for (const SceneCloud& cloud : scene.clouds) {
    out += fmt::format("  - {{file: {}, position: {}, point_radius_m: {}, label: {}}}\n", Quoted(cloud.file),
                       Text(cloud.position), Text(cloud.point_radius_m), SurfaceKindName(cloud.kind));
  }
  const SceneReflectivity& r = scene.reflectivity;
  out += fmt::format("reflectivity: {{ground: {}, trunk: {}, branch: {}, leaf: {}, obstacle: {}}}\n",
                     Text(r.ground), Text(r.trunk), Text(r.branch), Text(r.leaf), Text(r.obstacle));
  return out;
}

void SaveScene(const Scene& scene, const std::string& path) {
  std::ofstream file(path);
  file << FormatScene(scene);
  file.close();
  if (!file) throw SceneFileError(fmt::format("{}: cannot be written: {}", path, std::strerror(errno)));
}

}  // namespace dendro
