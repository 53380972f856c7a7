// The only file that includes CGAL: its headers take long to compile.

#include "dendro_slam/topology/crown.h"

#include <CGAL/Delaunay_triangulation_2.h>
#include <CGAL/Delaunay_triangulation_3.h>
#include <CGAL/Exact_predicates_inexact_constructions_kernel.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <stdexcept>

namespace dendro {

namespace {

using Kernel = CGAL::Exact_predicates_inexact_constructions_kernel;
using Delaunay3 = CGAL::Delaunay_triangulation_3<Kernel>;
using Delaunay2 = CGAL::Delaunay_triangulation_2<Kernel>;

constexpr std::size_t kMinPoints = 10;
constexpr double kStrayShare = 0.02;
// Leaves this low are grass and herbs at the foot.
constexpr double kMinLeafHeightM = 0.3;

// Value below which a share of the list lies.
double Percentile(std::vector<double> values, double share) {
  const auto k = static_cast<std::ptrdiff_t>(
      std::lround(share * static_cast<double>(values.size() - 1)));
  std::nth_element(values.begin(), values.begin() + k, values.end());
  return values[static_cast<std::size_t>(k)];
}

}  // namespace

std::optional<MapCrown> MeasureCrown(const std::vector<Eigen::Vector3d>& leaf_points,
                                     double base_z_m,
                                     double alpha_m) {
  if (!(alpha_m > 0.0)) throw std::invalid_argument("alpha_m: must be positive");
  std::vector<Kernel::Point_3> space;
  std::vector<Kernel::Point_2> plane;
  std::vector<double> heights;
  for (const Eigen::Vector3d& p : leaf_points) {
    if (!p.allFinite()) throw std::invalid_argument("leaf_points: a point is not finite");
    space.emplace_back(p.x(), p.y(), p.z());
    plane.emplace_back(p.x(), p.y());
    heights.push_back(p.z() - base_z_m);
  }
  if (space.size() < kMinPoints) return std::nullopt;

  // The classification of alpha shapes needs no more than the circumscribed balls for the cells of
  // full dimension, which alone have a volume.
  MapCrown crown;
  const double alpha2 = alpha_m * alpha_m;
  const Delaunay3 tetrahedra(space.begin(), space.end());
  if (tetrahedra.dimension() < 3) return std::nullopt;
  for (const auto cell : tetrahedra.finite_cell_handles()) {
    const auto& a = cell->vertex(0)->point();
    const auto& b = cell->vertex(1)->point();
    const auto& c = cell->vertex(2)->point();
    const auto& d = cell->vertex(3)->point();
    const double volume = std::abs(CGAL::volume(a, b, c, d));
    crown.hull_volume_m3 += volume;
    if (CGAL::squared_radius(a, b, c, d) <= alpha2) crown.volume_m3 += volume;
  }
  const Delaunay2 triangles(plane.begin(), plane.end());
  for (const auto face : triangles.finite_face_handles()) {
    const auto& a = face->vertex(0)->point();
    const auto& b = face->vertex(1)->point();
    const auto& c = face->vertex(2)->point();
    const double area = std::abs(CGAL::area(a, b, c));
    crown.hull_area_m2 += area;
    if (CGAL::squared_radius(a, b, c) <= alpha2) crown.projected_area_m2 += area;
  }
  crown.base_height_m = Percentile(heights, kStrayShare);
  crown.top_height_m = Percentile(std::move(heights), 1.0 - kStrayShare);
  crown.num_points = static_cast<int>(space.size());
  crown.alpha_m = alpha_m;
  if (!(crown.volume_m3 > 0.0)) return std::nullopt;
  return crown;
}

void MeasureCrowns(const std::vector<CloudPoint>& points, double alpha_m, TreeModel* model) {
  std::map<int, std::vector<Eigen::Vector3d>> leaves;
  for (const CloudPoint& point : points) {
    if (point.label == Label::kLeaf && point.tree_id >= 0) {
      leaves[point.tree_id].push_back(point.position);
    }
  }
  for (MapTree& tree : model->trees) {
    tree.crown.reset();
    const auto it = leaves.find(tree.id);
    if (it == leaves.end()) continue;
    std::vector<Eigen::Vector3d> above;
    for (const Eigen::Vector3d& p : it->second) {
      if (p.z() - tree.base.z() >= kMinLeafHeightM) above.push_back(p);
    }
    tree.crown = MeasureCrown(above, tree.base.z(), alpha_m);
  }
}

}  // namespace dendro
