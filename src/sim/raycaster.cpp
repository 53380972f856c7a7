#include "dendro_slam/sim/raycaster.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>

#include <BulletCollision/BroadphaseCollision/btDbvt.h>
#include <Eigen/Geometry>

#include "primitives.h"
#include "rough_ground.h"

namespace dendro {
namespace {

enum class PrimitiveKind : std::int32_t { kCone, kDisc, kTriangle, kSphere, kBox };

struct Bounds {
  Eigen::Vector3d min = Eigen::Vector3d::Constant(std::numeric_limits<double>::infinity());
  Eigen::Vector3d max = Eigen::Vector3d::Constant(-std::numeric_limits<double>::infinity());

  void Add(const Eigen::Vector3d& p) {
    min = min.cwiseMin(p);
    max = max.cwiseMax(p);
  }
  void Add(const Bounds& b) {
    min = min.cwiseMin(b.min);
    max = max.cwiseMax(b.max);
  }
  Eigen::Vector3d Centre() const { return 0.5 * (min + max); }
  double HalfArea() const {
    const Eigen::Vector3d e = max - min;
    return e.x() * e.y() + e.y() * e.z() + e.z() * e.x();
  }
};

/// Surface properties of a primitive.
struct Surface {
  double reflectivity = 0.0;
  SurfaceKind kind = SurfaceKind::kNone;
  std::int16_t tree_id = -1;
  std::int16_t branch_id = -1;
};

/// A primitive as the tree sees it. A long slanted cone has several, each with the box of a stretch.
struct Reference {
  Bounds bounds;
  std::uint32_t primitive = 0;
};

/// Consecutive references of one kind.
struct Cell {
  Bounds bounds;
  PrimitiveKind kind = PrimitiveKind::kCone;
  std::uint32_t first = 0;
  std::uint32_t count = 0;
};

/// A node of the flattened tree; siblings lie next to each other, in one cache line.
struct alignas(32) Node {
  float min[3];
  std::uint32_t first;  ///< Inner node: its left child; leaf: its cell.
  float max[3];
  std::uint32_t is_leaf;
};
static_assert(sizeof(Node) == 32, "two siblings fill a cache line");

Bounds DiscBounds(const Eigen::Vector3d& centre, const Eigen::Vector3d& axis, double radius) {
  // Extent of a circle along each coordinate axis: r sqrt(1 - n_i^2).
  Eigen::Vector3d extent;
  for (int i = 0; i < 3; ++i) extent[i] = radius * std::sqrt(std::max(0.0, 1.0 - axis[i] * axis[i]));
  Bounds b;
  b.Add(centre - extent);
  b.Add(centre + extent);
  return b;
}

/// Splits references [first, last) of one kind into cells of at most `limit`, by the surface-area
/// heuristic over the sorted centres.
void MakeCells(std::vector<Reference>* refs,
               std::size_t first,
               std::size_t last,
               std::size_t limit,
               PrimitiveKind kind,
               std::vector<Cell>* cells) {
  const std::size_t n = last - first;
  if (n == 0) return;
  Bounds all, centres;
  for (std::size_t i = first; i < last; ++i) {
    all.Add((*refs)[i].bounds);
    centres.Add((*refs)[i].bounds.Centre());
  }
  if (n <= limit) {
    cells->push_back({all, kind, static_cast<std::uint32_t>(first), static_cast<std::uint32_t>(n)});
    return;
  }
  constexpr int kBins = 16;
  int best_axis = -1, best_bin = 0;
  double best_cost = std::numeric_limits<double>::infinity();
  const Eigen::Vector3d extent = centres.max - centres.min;
  const auto bin_of = [&](const Reference& r, int axis) {
    const double u = (r.bounds.Centre()[axis] - centres.min[axis]) / extent[axis];
    return std::min(kBins - 1, static_cast<int>(u * kBins));
  };
  for (int axis = 0; axis < 3; ++axis) {
    if (!(extent[axis] > 1e-9)) continue;
    std::array<Bounds, kBins> bounds;
    std::array<std::size_t, kBins> count{};
    for (std::size_t i = first; i < last; ++i) {
      const int bin = bin_of((*refs)[i], axis);
      bounds[bin].Add((*refs)[i].bounds);
      ++count[bin];
    }
    std::array<double, kBins> right_cost{};
    Bounds right;
    std::size_t right_count = 0;
    for (int bin = kBins - 1; bin > 0; --bin) {
      right.Add(bounds[bin]);
      right_count += count[bin];
      right_cost[bin] = right_count == 0 ? 0.0 : right.HalfArea() * static_cast<double>(right_count);
    }
    Bounds left;
    std::size_t left_count = 0;
    for (int bin = 0; bin + 1 < kBins; ++bin) {
      left.Add(bounds[bin]);
      left_count += count[bin];
      if (left_count == 0 || left_count == n) continue;
      const double cost = left.HalfArea() * static_cast<double>(left_count) + right_cost[bin + 1];
      if (cost < best_cost) {
        best_cost = cost;
        best_axis = axis;
        best_bin = bin;
      }
    }
  }
  std::size_t middle = first + n / 2;
  if (best_axis >= 0) {
    const auto it = std::stable_partition(
        refs->begin() + static_cast<std::ptrdiff_t>(first), refs->begin() + static_cast<std::ptrdiff_t>(last),
        [&](const Reference& r) { return bin_of(r, best_axis) <= best_bin; });
    middle = static_cast<std::size_t>(it - refs->begin());
  }
  MakeCells(refs, first, middle, limit, kind, cells);
  MakeCells(refs, middle, last, limit, kind, cells);
}

/// Ray in single precision for the boxes.
struct BoxRay {
  float origin[3];
  float inverse[3];

  BoxRay(const Eigen::Vector3d& o, const Eigen::Vector3d& d) {
    for (int i = 0; i < 3; ++i) {
      origin[i] = static_cast<float>(o[i]);
      // A direction of zero becomes a tiny one: the slab test stays finite.
      const double v = std::abs(d[i]) < 1e-12 ? (d[i] < 0.0 ? -1e-12 : 1e-12) : d[i];
      inverse[i] = static_cast<float>(1.0 / v);
    }
  }

  /// Range at which the ray enters the box grown by `grow`; larger than `max` when it misses.
  float Enter(const Node& node, float grow, float max) const {
    float near = 0.0F, far = max;
    for (int i = 0; i < 3; ++i) {
      const float a = (node.min[i] - grow - origin[i]) * inverse[i];
      const float b = (node.max[i] + grow - origin[i]) * inverse[i];
      near = std::max(near, std::min(a, b));
      far = std::min(far, std::max(a, b));
    }
    return near <= far ? near : std::numeric_limits<float>::infinity();
  }
};

/// The best hit so far of one ray.
struct Best {
  double range_m = kNoHit;
  PrimitiveKind kind = PrimitiveKind::kCone;
  std::uint32_t primitive = 0;
  bool is_ground = false;
};

constexpr int kStack = 256;  ///< Deepest tree that can be walked.

}  // namespace

struct Raycaster::Impl {
  explicit Impl(const Scene& scene);

  void AddBranch(const SceneBranch& branch, const Surface& surface, std::vector<Reference>* refs);
  void BuildTree(const std::vector<Cell>& unsorted_cells);

  void TestCell(const Cell& cell,
                const Eigen::Vector3d& o,
                const Eigen::Vector3d& d,
                double min_m,
                double max_m,
                Best* best) const;
  double TestGround(const Eigen::Vector3d& o, const Eigen::Vector3d& d, double min_m, double max_m) const;
  void TestGround(const RayBundle& bundle, double max_m, Best* best) const;
  RayHit Resolve(const Eigen::Vector3d& o, const Eigen::Vector3d& d, const Best& best) const;

  std::vector<Cone> cones;
  std::vector<Surface> cone_surface;
  std::vector<Disc> discs;
  std::vector<Surface> disc_surface;
  std::vector<Triangle> triangles;
  std::vector<Surface> triangle_surface;
  std::vector<Sphere> spheres;
  std::vector<Surface> sphere_surface;
  std::vector<Box> boxes;
  std::vector<Surface> box_surface;

  std::vector<std::uint32_t> cone_order;  ///< Cells of cones index this: a cone may be in several.
  std::vector<Cell> cells;
  std::vector<Node> nodes;

  SceneGround::Type ground_type = SceneGround::Type::kNone;
  double ground_z_m = 0.0;
  std::unique_ptr<RoughGround> rough;
  double ground_reflectivity = 0.0;
};

Raycaster::Impl::Impl(const Scene& scene) {
  ValidateScene(scene);
  const SceneReflectivity& r = scene.reflectivity;
  std::vector<Reference> cone_refs, disc_refs, triangle_refs, sphere_refs, box_refs;

  for (std::size_t t = 0; t < scene.trees.size(); ++t) {
    const SceneTree& tree = scene.trees[t];
    for (const SceneBranch& branch : tree.branches) {
      const SurfaceKind kind = branch.parent < 0 ? SurfaceKind::kTrunk : SurfaceKind::kBranch;
      AddBranch(branch,
                {r.Of(kind), kind, static_cast<std::int16_t>(t), static_cast<std::int16_t>(branch.id)},
                &cone_refs);
    }
    for (const Disc& leaf : MakeLeaves(tree)) {
      disc_refs.push_back({DiscBounds(leaf.centre, leaf.normal, leaf.radius_m),
                           static_cast<std::uint32_t>(discs.size())});
      discs.push_back(leaf);
      disc_surface.push_back({r.leaf, SurfaceKind::kLeaf, static_cast<std::int16_t>(t), -1});
    }
  }
  for (const SceneBox& b : scene.obstacles) {
    Box box;
    box.centre = b.position;
    box.half_m = 0.5 * b.size_m;
    box.cos_yaw = std::cos(b.yaw_deg * M_PI / 180.0);
    box.sin_yaw = std::sin(b.yaw_deg * M_PI / 180.0);
    Bounds bounds;
    for (int corner = 0; corner < 8; ++corner) {
      const Eigen::Vector3d sign((corner & 1) ? 1 : -1, (corner & 2) ? 1 : -1, (corner & 4) ? 1 : -1);
      bounds.Add(box.centre + box.FromBox(box.half_m.cwiseProduct(sign)));
    }
    box_refs.push_back({bounds, static_cast<std::uint32_t>(boxes.size())});
    boxes.push_back(box);
    box_surface.push_back({r.Of(b.kind), b.kind, -1, -1});
  }
  for (const SceneMesh& mesh : scene.meshes) {
    for (const auto& index : mesh.triangles) {
      const Eigen::Vector3d& a = mesh.vertices[index[0]];
      const Eigen::Vector3d& b = mesh.vertices[index[1]];
      const Eigen::Vector3d& c = mesh.vertices[index[2]];
      Bounds bounds;
      bounds.Add(a);
      bounds.Add(b);
      bounds.Add(c);
      triangle_refs.push_back({bounds, static_cast<std::uint32_t>(triangles.size())});
      triangles.push_back({a, b - a, c - a});
      triangle_surface.push_back({r.Of(mesh.kind), mesh.kind, -1, -1});
    }
  }
  for (const SceneCloud& cloud : scene.clouds) {
    for (const Eigen::Vector3d& p : cloud.points) {
      Bounds bounds;
      bounds.Add(p - Eigen::Vector3d::Constant(cloud.point_radius_m));
      bounds.Add(p + Eigen::Vector3d::Constant(cloud.point_radius_m));
      sphere_refs.push_back({bounds, static_cast<std::uint32_t>(spheres.size())});
      spheres.push_back({p, cloud.point_radius_m});
      sphere_surface.push_back({r.Of(cloud.kind), cloud.kind, -1, -1});
    }
  }

  // Primitives are stored in the order of the cells, so a cell's primitives lie together.
  std::vector<Cell> all;
  const auto sort_kind = [&](std::vector<Reference>* refs, std::size_t limit, PrimitiveKind kind,
                             auto* primitives, auto* surfaces) {
    MakeCells(refs, 0, refs->size(), limit, kind, &all);
    auto sorted = *primitives;
    auto sorted_surfaces = *surfaces;
    for (std::size_t i = 0; i < refs->size(); ++i) {
      sorted[i] = (*primitives)[(*refs)[i].primitive];
      sorted_surfaces[i] = (*surfaces)[(*refs)[i].primitive];
    }
    primitives->swap(sorted);
    surfaces->swap(sorted_surfaces);
  };
  MakeCells(&cone_refs, 0, cone_refs.size(), 1, PrimitiveKind::kCone, &all);
  for (const Reference& ref : cone_refs) cone_order.push_back(ref.primitive);
  sort_kind(&disc_refs, 4, PrimitiveKind::kDisc, &discs, &disc_surface);
  sort_kind(&triangle_refs, 4, PrimitiveKind::kTriangle, &triangles, &triangle_surface);
  sort_kind(&sphere_refs, 4, PrimitiveKind::kSphere, &spheres, &sphere_surface);
  sort_kind(&box_refs, 1, PrimitiveKind::kBox, &boxes, &box_surface);
  BuildTree(all);

  ground_type = scene.ground.type;
  ground_z_m = scene.ground.z_m;
  ground_reflectivity = r.ground;
  if (ground_type == SceneGround::Type::kRough) rough = std::make_unique<RoughGround>(scene.ground);
}

void Raycaster::Impl::AddBranch(const SceneBranch& branch,
                                const Surface& surface,
                                std::vector<Reference>* refs) {
  const std::size_t first = cones.size();
  for (std::size_t i = 1; i < branch.points.size(); ++i) {
    const BranchPoint& a = branch.points[i - 1];
    const BranchPoint& b = branch.points[i];
    const double length = (b.position - a.position).norm();
    if (length <= 0.0) continue;
    Cone cone;
    cone.base = a.position;
    cone.axis = (b.position - a.position) / length;
    cone.length_m = length;
    cone.base_radius_m = a.radius_m;
    cone.slope = (b.radius_m - a.radius_m) / length;
    if (cones.size() == first) {
      cone.base_end = Cone::End::kDisc;
      cone.base_disc_m = a.radius_m;
    } else {
      Cone& previous = cones.back();
      if (std::abs(previous.TipRadius() - a.radius_m) > 1e-9) {
        // A step: both pieces are closed by their own discs.
        previous.tip_end = Cone::End::kDisc;
        previous.tip_disc_m = previous.TipRadius();
        cone.base_end = Cone::End::kDisc;
        cone.base_disc_m = a.radius_m;
      } else if (previous.axis.dot(cone.axis) < 1.0 - 1e-12) {
        previous.tip_end = Cone::End::kJoint;
        previous.next_axis = cone.axis;
      }
    }
    cones.push_back(cone);
    cone_surface.push_back(surface);
  }
  Cone& last = cones.back();
  last.tip_end = Cone::End::kDisc;
  last.tip_disc_m = std::max(0.0, last.TipRadius());

  for (std::size_t i = first; i < cones.size(); ++i) {
    const Cone& cone = cones[i];
    // The box of a long slanted piece is mostly air; several short boxes are not.
    const double width = std::max(cone.base_radius_m, cone.TipRadius());
    const int stretches =
        std::clamp(static_cast<int>(std::ceil(cone.length_m / std::max(4.0 * width, 0.2))), 1, 16);
    for (int s = 0; s < stretches; ++s) {
      const double from = cone.length_m * s / stretches;
      const double to = cone.length_m * (s + 1) / stretches;
      Bounds bounds = DiscBounds(cone.base + from * cone.axis, cone.axis, cone.base_radius_m + cone.slope * from);
      bounds.Add(DiscBounds(cone.base + to * cone.axis, cone.axis, cone.base_radius_m + cone.slope * to));
      if (s + 1 == stretches && cone.tip_end == Cone::End::kJoint) {
        const Eigen::Vector3d r = Eigen::Vector3d::Constant(cone.TipRadius());
        bounds.Add(cone.Tip() - r);
        bounds.Add(cone.Tip() + r);
      }
      refs->push_back({bounds, static_cast<std::uint32_t>(i)});
    }
  }
}

void Raycaster::Impl::BuildTree(const std::vector<Cell>& unsorted_cells) {
  if (unsorted_cells.empty()) return;
  // Bullet builds the tree; its nodes are then laid out one after the other, siblings together.
  btDbvt tree;
  for (std::size_t i = 0; i < unsorted_cells.size(); ++i) {
    const Bounds& b = unsorted_cells[i].bounds;
    // Single precision and the slab test's own rounding: widen by more than both.
    const Eigen::Vector3d pad =
        Eigen::Vector3d::Constant(1e-4) + 1e-6 * b.min.cwiseAbs().cwiseMax(b.max.cwiseAbs());
    const Eigen::Vector3d lo = b.min - pad, hi = b.max + pad;
    const btVector3 min(static_cast<btScalar>(lo.x()), static_cast<btScalar>(lo.y()), static_cast<btScalar>(lo.z()));
    const btVector3 max(static_cast<btScalar>(hi.x()), static_cast<btScalar>(hi.y()), static_cast<btScalar>(hi.z()));
    btDbvtNode* leaf = tree.insert(btDbvtVolume::FromMM(min, max), nullptr);
    leaf->dataAsInt = static_cast<int>(i);
  }
  tree.optimizeTopDown();

  const auto fill = [](const btDbvtNode* from, Node* to) {
    for (int i = 0; i < 3; ++i) {
      to->min[i] = from->volume.Mins()[i];
      to->max[i] = from->volume.Maxs()[i];
    }
  };
  nodes.reserve(2 * unsorted_cells.size());
  cells.reserve(unsorted_cells.size());
  nodes.resize(2);  // Node 1 is padding: siblings start at even indices.
  nodes[1] = {};
  struct Open {
    const btDbvtNode* node;
    std::uint32_t index;
    int depth;
  };
  std::vector<Open> open = {{tree.m_root, 0, 1}};
  while (!open.empty()) {
    const auto [node, index, depth] = open.back();
    open.pop_back();
    if (depth >= kStack) throw std::runtime_error("Raycaster: the bounding-volume tree is too deep");
    fill(node, &nodes[index]);
    if (node->isleaf()) {
      nodes[index].is_leaf = 1;
      nodes[index].first = static_cast<std::uint32_t>(cells.size());
      cells.push_back(unsorted_cells[static_cast<std::size_t>(node->dataAsInt)]);
      continue;
    }
    nodes[index].is_leaf = 0;
    const auto left = static_cast<std::uint32_t>(nodes.size());
    nodes[index].first = left;
    nodes.resize(nodes.size() + 2);
    open.push_back({node->childs[1], left + 1, depth + 1});
    open.push_back({node->childs[0], left, depth + 1});
  }
}

void Raycaster::Impl::TestCell(const Cell& cell,
                               const Eigen::Vector3d& o,
                               const Eigen::Vector3d& d,
                               double min_m,
                               double max_m,
                               Best* best) const {
  for (std::uint32_t i = cell.first; i < cell.first + cell.count; ++i) {
    const double limit = std::min(max_m, best->range_m);
    double t = kNoHit;
    std::uint32_t primitive = i;
    Eigen::Vector3d normal;
    switch (cell.kind) {
      case PrimitiveKind::kCone:
        primitive = cone_order[i];
        t = IntersectCone(o, d, cones[primitive], min_m, limit, &normal);
        break;
      case PrimitiveKind::kDisc:
        t = IntersectDisc(o, d, discs[i].centre, discs[i].normal, discs[i].radius_m, min_m, limit);
        break;
      case PrimitiveKind::kTriangle: t = IntersectTriangle(o, d, triangles[i], min_m, limit); break;
      case PrimitiveKind::kSphere:
        t = IntersectSphere(o, d, spheres[i].centre, spheres[i].radius_m, min_m, limit);
        break;
      case PrimitiveKind::kBox: t = IntersectBox(o, d, boxes[i], min_m, limit, &normal); break;
    }
    if (t < best->range_m) *best = {t, cell.kind, primitive, false};
  }
}

double Raycaster::Impl::TestGround(const Eigen::Vector3d& o,
                                   const Eigen::Vector3d& d,
                                   double min_m,
                                   double max_m) const {
  if (ground_type == SceneGround::Type::kPlane) {
    if (d.z() == 0.0) return kNoHit;
    const double t = (ground_z_m - o.z()) / d.z();
    return t >= min_m && t <= max_m ? t : kNoHit;
  }
  if (ground_type == SceneGround::Type::kRough) {
    const std::optional<double> t = rough->Intersect(o, d, min_m, max_m);
    return t ? *t : kNoHit;
  }
  return kNoHit;
}

void Raycaster::Impl::TestGround(const RayBundle& bundle, double max_m, Best* best) const {
  const std::size_t n = bundle.directions.size();
  double from_m = 0.0;
  if (rough) {
    // One walk along the central ray tells how far every sub-ray is above the rough ground.
    rough->Intersect(bundle.origin, bundle.direction, 0.0, max_m, bundle.half_width_m,
                     1.01 * bundle.half_angle_rad, &from_m);
  }
  double next_m = from_m;
  for (std::size_t i = 0; i < n; ++i) {
    const Eigen::Vector3d& o = bundle.origins[i];
    const Eigen::Vector3d& d = bundle.directions[i];
    if (rough && i + 1 < n) {
      // And each sub-ray tells it for the next one, which is nearer still.
      double safe_m = from_m;
      const auto t = rough->Intersect(o, d, next_m, max_m, (bundle.origins[i + 1] - o).norm(),
                                      (bundle.directions[i + 1] - d).norm(), &safe_m);
      best[i].range_m = t ? *t : kNoHit;
      next_m = safe_m;
    } else {
      best[i].range_m = TestGround(o, d, next_m, max_m);
    }
    best[i].is_ground = best[i].range_m < kNoHit;
  }
}

RayHit Raycaster::Impl::Resolve(const Eigen::Vector3d& o,
                                const Eigen::Vector3d& d,
                                const Best& best) const {
  RayHit hit;
  hit.range_m = best.range_m;
  if (best.is_ground) {
    const Eigen::Vector3d p = o + best.range_m * d;
    hit.normal = rough ? rough->Normal(p.x(), p.y()) : Eigen::Vector3d::UnitZ();
    hit.kind = SurfaceKind::kGround;
    hit.reflectivity = ground_reflectivity;
  } else {
    const Surface* surface = nullptr;
    const double lo = best.range_m, hi = best.range_m;
    switch (best.kind) {
      case PrimitiveKind::kCone:
        surface = &cone_surface[best.primitive];
        IntersectCone(o, d, cones[best.primitive], lo, hi, &hit.normal);
        break;
      case PrimitiveKind::kDisc:
        surface = &disc_surface[best.primitive];
        hit.normal = discs[best.primitive].normal;
        break;
      case PrimitiveKind::kTriangle:
        surface = &triangle_surface[best.primitive];
        hit.normal = triangles[best.primitive].ab.cross(triangles[best.primitive].ac).normalized();
        break;
      case PrimitiveKind::kSphere:
        surface = &sphere_surface[best.primitive];
        hit.normal = (o + best.range_m * d - spheres[best.primitive].centre).normalized();
        break;
      case PrimitiveKind::kBox:
        surface = &box_surface[best.primitive];
        IntersectBox(o, d, boxes[best.primitive], lo, hi, &hit.normal);
        break;
    }
    hit.kind = surface->kind;
    hit.reflectivity = surface->reflectivity;
    hit.tree_id = surface->tree_id;
    hit.branch_id = surface->branch_id;
  }
  if (hit.normal.dot(d) > 0.0) hit.normal = -hit.normal;
  return hit;
}

Raycaster::Raycaster(const Scene& scene) : impl_(std::make_unique<Impl>(scene)) {}
Raycaster::~Raycaster() = default;
Raycaster::Raycaster(Raycaster&&) noexcept = default;
Raycaster& Raycaster::operator=(Raycaster&&) noexcept = default;

std::size_t Raycaster::num_primitives() const {
  return impl_->cones.size() + impl_->discs.size() + impl_->triangles.size() + impl_->spheres.size() +
         impl_->boxes.size();
}

std::optional<RayHit> Raycaster::Cast(const Eigen::Vector3d& origin,
                                      const Eigen::Vector3d& direction,
                                      double max_range_m,
                                      double min_range_m) const {
  const Impl& impl = *impl_;
  Best best;
  best.range_m = impl.TestGround(origin, direction, min_range_m, max_range_m);
  best.is_ground = best.range_m < kNoHit;
  if (!impl.nodes.empty()) {
    const BoxRay ray(origin, direction);
    const auto limit = [&] {
      return static_cast<float>(std::min(best.range_m, max_range_m)) * 1.000001F + 1e-4F;
    };
    struct Entry {
      std::uint32_t node;
      float enter;
    };
    std::array<Entry, kStack> stack;
    int depth = 0;
    float far = limit();
    if (ray.Enter(impl.nodes[0], 0.0F, far) <= far) stack[depth++] = {0, 0.0F};
    while (depth > 0) {
      const Entry entry = stack[--depth];
      if (entry.enter > far) continue;
      std::uint32_t index = entry.node;
      while (true) {
        const Node& node = impl.nodes[index];
        if (node.is_leaf != 0U) {
          impl.TestCell(impl.cells[node.first], origin, direction, min_range_m, max_range_m, &best);
          far = limit();
          break;
        }
        const float left = ray.Enter(impl.nodes[node.first], 0.0F, far);
        const float right = ray.Enter(impl.nodes[node.first + 1], 0.0F, far);
        const bool hit_left = left <= far, hit_right = right <= far;
        if (hit_left && hit_right) {
          const bool left_first = left <= right;
          stack[depth++] = left_first ? Entry{node.first + 1, right} : Entry{node.first, left};
          index = left_first ? node.first : node.first + 1;
        } else if (hit_left) {
          index = node.first;
        } else if (hit_right) {
          index = node.first + 1;
        } else {
          break;
        }
      }
    }
  }
  if (best.range_m >= kNoHit) return std::nullopt;
  return impl.Resolve(origin, direction, best);
}

void Raycaster::CastBundle(const RayBundle& bundle,
                           double max_range_m,
                           std::vector<RayHit>* hits) const {
  const Impl& impl = *impl_;
  const std::size_t n = bundle.directions.size();
  hits->resize(n);
  constexpr std::size_t kMaxRays = 256;
  std::array<Best, kMaxRays> best;
  if (n > kMaxRays || bundle.origins.size() != n) {
    throw std::invalid_argument("RayBundle: origins and directions must agree, at most 256 sub-rays");
  }
  double farthest = 0.0;
  for (std::size_t i = 0; i < n; ++i) best[i] = Best();
  impl.TestGround(bundle, max_range_m, best.data());
  for (std::size_t i = 0; i < n; ++i) farthest = std::max(farthest, std::min(best[i].range_m, max_range_m));
  const auto half_width = static_cast<float>(bundle.half_width_m) + 1e-5F;
  const auto half_angle = static_cast<float>(bundle.half_angle_rad) * 1.01F;
  if (!impl.nodes.empty()) {
    const BoxRay ray(bundle.origin, bundle.direction);
    float far = static_cast<float>(farthest) * 1.00001F + 1e-3F;
    // A box is grown by the half width of the bundle at its farthest corner.
    const auto enter = [&](const Node& node) {
      float distance = 0.0F;
      for (int i = 0; i < 3; ++i) {
        distance += std::max(std::abs(node.min[i] - ray.origin[i]), std::abs(node.max[i] - ray.origin[i]));
      }
      return ray.Enter(node, half_width + half_angle * std::min(distance, far), far);
    };
    // True when the bundle cannot touch the sphere.
    const auto skip = [&](const Eigen::Vector3d& centre, double radius) {
      const Eigen::Vector3d m = centre - bundle.origin;
      const double along = m.dot(bundle.direction);
      const double reach = radius + static_cast<double>(half_width) +
                           static_cast<double>(half_angle) * (std::abs(along) + radius);
      return m.squaredNorm() - along * along > reach * reach;
    };
    struct Entry {
      std::uint32_t node;
      float enter;
    };
    std::array<Entry, kStack> stack;
    int depth = 0;
    if (enter(impl.nodes[0]) <= far) stack[depth++] = {0, 0.0F};
    while (depth > 0) {
      const Entry entry = stack[--depth];
      if (entry.enter > far) continue;
      std::uint32_t index = entry.node;
      while (true) {
        const Node& node = impl.nodes[index];
        if (node.is_leaf != 0U) {
          const Cell& cell = impl.cells[node.first];
          const bool round = cell.kind == PrimitiveKind::kDisc || cell.kind == PrimitiveKind::kSphere;
          if (round) {
            for (std::uint32_t k = cell.first; k < cell.first + cell.count; ++k) {
              const bool disc = cell.kind == PrimitiveKind::kDisc;
              if (skip(disc ? impl.discs[k].centre : impl.spheres[k].centre,
                       disc ? impl.discs[k].radius_m : impl.spheres[k].radius_m)) {
                continue;
              }
              const Cell single{cell.bounds, cell.kind, k, 1};
              for (std::size_t i = 0; i < n; ++i) {
                impl.TestCell(single, bundle.origins[i], bundle.directions[i], 0.0, max_range_m, &best[i]);
              }
            }
          } else {
            for (std::size_t i = 0; i < n; ++i) {
              impl.TestCell(cell, bundle.origins[i], bundle.directions[i], 0.0, max_range_m, &best[i]);
            }
          }
          farthest = 0.0;
          for (std::size_t i = 0; i < n; ++i) {
            farthest = std::max(farthest, std::min(best[i].range_m, max_range_m));
          }
          far = static_cast<float>(farthest) * 1.00001F + 1e-3F;
          break;
        }
        const float left = enter(impl.nodes[node.first]);
        const float right = enter(impl.nodes[node.first + 1]);
        const bool hit_left = left <= far, hit_right = right <= far;
        if (hit_left && hit_right) {
          const bool left_first = left <= right;
          stack[depth++] = left_first ? Entry{node.first + 1, right} : Entry{node.first, left};
          index = left_first ? node.first : node.first + 1;
        } else if (hit_left) {
          index = node.first;
        } else if (hit_right) {
          index = node.first + 1;
        } else {
          break;
        }
      }
    }
  }
  for (std::size_t i = 0; i < n; ++i) {
    if (best[i].range_m < kNoHit) {
      (*hits)[i] = impl.Resolve(bundle.origins[i], bundle.directions[i], best[i]);
    } else {
      (*hits)[i] = RayHit();
      (*hits)[i].range_m = std::numeric_limits<double>::infinity();
    }
  }
}

}  // namespace dendro
