#pragma once

#include <cstdint>
#include <limits>
#include <memory>
#include <optional>
#include <vector>

#include <Eigen/Core>

#include "dendro_slam/sim/scene.h"

namespace dendro {

/// The first surface along a ray.
struct RayHit {
  double range_m = 0.0;                                ///< Along the ray [m].
  Eigen::Vector3d normal = Eigen::Vector3d::UnitZ();   ///< Unit, turned against the ray.
  double reflectivity = 0.0;                           ///< Of the surface, see SceneReflectivity.
  SurfaceKind kind = SurfaceKind::kNone;
  std::int16_t tree_id = -1;                           ///< Index in Scene::trees, or -1.
  std::int16_t branch_id = -1;                         ///< SceneBranch::id, or -1.
};

/// A bundle of rays from (nearly) one place: the sub-rays of a lidar's beam.
struct RayBundle {
  Eigen::Vector3d origin = Eigen::Vector3d::Zero();       ///< Of the central ray [m].
  Eigen::Vector3d direction = Eigen::Vector3d::UnitX();   ///< Of the central ray, unit.
  double half_width_m = 0.0;     ///< Every sub-ray starts within this distance of `origin` ...
  double half_angle_rad = 0.0;   ///< ... and within this angle of `direction`.
  std::vector<Eigen::Vector3d> origins;      ///< Per sub-ray.
  std::vector<Eigen::Vector3d> directions;   ///< Per sub-ray, unit.
};

/// Casts rays into a scene.
///
/// The broad phase is Bullet's bounding-volume tree (btDbvt) over small cells of primitives, walked
/// from near to far; each primitive is then met exactly: conical frusta with the joints and ends of
/// SceneBranch, boxes, triangles, discs, spheres, the ground plane or the rough ground. Bullet's own
/// convex shapes are not exact enough to be truth. Narrow-phase arithmetic is double precision; the
/// tree's boxes are single precision, widened so that nothing is missed. Casting is const and
/// thread-safe. A surface is seen from both sides.
class Raycaster {
 public:
  /// @throws std::invalid_argument  From ValidateScene.
  explicit Raycaster(const Scene& scene);
  ~Raycaster();
  Raycaster(Raycaster&&) noexcept;
  Raycaster& operator=(Raycaster&&) noexcept;

  /// The nearest surface with min_range <= range <= max_range, if any.
  /// @param origin     In the map frame [m].
  /// @param direction  Unit vector in the map frame.
  std::optional<RayHit> Cast(const Eigen::Vector3d& origin,
                             const Eigen::Vector3d& direction,
                             double max_range_m = 1e3,
                             double min_range_m = 0.0) const;

  /// Casts all sub-rays of a bundle with one walk through the tree.
  /// @param hits  Resized to the number of sub-rays; kind kNone and range infinity where nothing
  ///              was met within max_range_m.
  void CastBundle(const RayBundle& bundle, double max_range_m, std::vector<RayHit>* hits) const;

  /// Number of primitives in the tree.
  std::size_t num_primitives() const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace dendro
