#pragma once

#include <array>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "dendro_slam/range_image/range_image.h"

/// The simulated world, and at the same time the form in which the truth is written. The frame is
/// `map`: z up, metres.
namespace dendro {

/// What a ray hits.
enum class SurfaceKind : std::uint8_t {
  kNone = 0,
  kGround = 1,
  kTrunk = 2,
  kBranch = 3,
  kLeaf = 4,
  kObstacle = 5
};

/// Name of a kind as scene files write it: none, ground, trunk, branch, leaf, obstacle.
const char* SurfaceKindName(SurfaceKind kind);

/// Class of a kind for stage 1: trunk and branch are wood, obstacles are other.
Label SurfaceLabel(SurfaceKind kind);

/// One point of a branch's centre line.
struct BranchPoint {
  Eigen::Vector3d position = Eigen::Vector3d::Zero();  ///< In the map frame [m].
  double radius_m = 0.0;                               ///< >= 0.
};

/// A branch: a chain of conical frusta through its points, base to tip.
///
/// At a bend the gap between two frusta is filled by the wedge of a sphere with the joint's radius,
/// so that the surface is closed; both ends carry a flat disc. Two points at the same place with
/// different radii make a step (a flat ring).
struct SceneBranch {
  int id = 0;                       ///< Unique in its tree, >= 0.
  int parent = -1;                  ///< Id of the branch it leaves; -1 for the trunk.
  std::vector<BranchPoint> points;  ///< At least two.
  bool dead = false;                ///< A dead twig carries no leaves.

  /// Length of the centre line [m].
  double Length() const;
};

/// Leaves of a tree: discs around its thin branches.
struct SceneLeaves {
  int count = 0;                   ///< Number of discs.
  double size_m = 0.06;            ///< Diameter of a leaf [m]; each varies by +-30 %.
  std::uint64_t seed = 1;
  double max_wood_radius_m = 0.03;  ///< Leaves grow where the wood is thinner than this [m].
  double spread_m = 0.12;          ///< Mean distance of a leaf from the twig's surface [m].
};

struct SceneTree {
  std::string name;
  std::vector<SceneBranch> branches;
  SceneLeaves leaves;

  /// The branch with this id, or nullptr.
  const SceneBranch* FindBranch(int id) const;
};

/// A flat disc; the leaves are made of these.
struct Disc {
  Eigen::Vector3d centre = Eigen::Vector3d::Zero();
  Eigen::Vector3d normal = Eigen::Vector3d::UnitZ();  ///< Unit vector; both sides are seen.
  double radius_m = 0.0;
};

/// The leaves of a tree, a deterministic function of the tree and the leaves' seed.
std::vector<Disc> MakeLeaves(const SceneTree& tree);

struct SceneGround {
  enum class Type { kNone, kPlane, kRough };
  Type type = Type::kPlane;
  double z_m = 0.0;
  double amplitude_m = 0.05;   ///< Largest height above or below z [m] (rough only).
  double wavelength_m = 2.0;   ///< Longest wave [m] (rough only).
  std::uint64_t seed = 1;      ///< Phases and directions of the waves (rough only).
};

/// A solid cuboid, turned about z.
struct SceneBox {
  Eigen::Vector3d size_m = Eigen::Vector3d::Ones();       ///< Edge lengths before the turn [m].
  Eigen::Vector3d position = Eigen::Vector3d::Zero();     ///< Centre [m].
  double yaw_deg = 0.0;
  SurfaceKind kind = SurfaceKind::kObstacle;
};

/// A triangle mesh; `vertices` are already moved to their place.
struct SceneMesh {
  std::string file;                                       ///< Absolute; LoadScene makes it so.
  Eigen::Vector3d position = Eigen::Vector3d::Zero();
  double scale = 1.0;
  double yaw_deg = 0.0;
  SurfaceKind kind = SurfaceKind::kObstacle;
  std::vector<Eigen::Vector3d> vertices;                  ///< In the map frame [m].
  std::vector<std::array<std::uint32_t, 3>> triangles;
};

/// A real scan; each point becomes a small sphere. `points` are already moved to their place.
struct SceneCloud {
  std::string file;                                       ///< Absolute; LoadScene makes it so.
  double point_radius_m = 0.008;
  Eigen::Vector3d position = Eigen::Vector3d::Zero();
  SurfaceKind kind = SurfaceKind::kTrunk;
  std::vector<Eigen::Vector3d> points;                    ///< In the map frame [m].
};

/// Diffuse reflectivity by kind of surface at 905 nm, in [0, 1]; above 1 a retro-reflector.
///
/// Bark 0.3 to 0.5, green leaves 0.4 to 0.6 (near-infrared plateau), dry soil and grass 0.2 to 0.4;
/// painted walls are brighter. These are typical values of spectral libraries, not measurements.
struct SceneReflectivity {
  double ground = 0.25;
  double trunk = 0.40;
  double branch = 0.40;
  double leaf = 0.50;
  double obstacle = 0.60;

  double Of(SurfaceKind kind) const;
};

struct Scene {
  std::string frame = "map";
  std::vector<SceneTree> trees;
  SceneGround ground;
  std::vector<SceneBox> obstacles;
  std::vector<SceneMesh> meshes;
  std::vector<SceneCloud> clouds;
  SceneReflectivity reflectivity;
};

/// A scene or path file that cannot be used. The message names the file, the line or key, and what
/// is expected there.
class SceneFileError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// Reads a scene file (YAML). Files named in it are sought relative to its folder.
/// @throws SceneFileError  Unknown key, missing field, wrong type, negative radius, a parent that
///                         does not exist, a mesh or cloud that cannot be read.
Scene LoadScene(const std::string& path);

/// As LoadScene, from text. @param name  Stands for the file in error messages; its folder is where
///                                       meshes and clouds are sought.
Scene ParseScene(const std::string& text, const std::string& name);

/// Writes a scene file that LoadScene reads back to the same scene.
/// @throws SceneFileError  If the file cannot be written.
void SaveScene(const Scene& scene, const std::string& path);

/// The scene file's text.
std::string FormatScene(const Scene& scene);

/// Height of the ground's surface [m]; -infinity without ground.
double GroundHeight(const SceneGround& ground, double x, double y);

/// Checks what a file reader would: unique ids, existing parents, radii, at least two points.
/// @throws std::invalid_argument  Naming the tree, the branch and the field.
void ValidateScene(const Scene& scene);

}  // namespace dendro
