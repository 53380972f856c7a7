#pragma once

#include <optional>
#include <vector>

#include <Eigen/Core>

#include "dendro_slam/mapping/tree_model.h"
#include "dendro_slam/topology/map_cloud.h"

namespace dendro {

/// Measures a crown by its leaf points.
///
/// Volume: the alpha shape in space (Edelsbrunner and Muecke 1994), that is the tetrahedra of the
/// Delaunay triangulation whose circumscribed balls are no larger than `alpha_m`: a hollow that a
/// ball of that radius fits into is not crown. Projected area: the same in the plane, seen from
/// above. Both are CGAL's. The alpha shape of points lies inside the body that they sample, so thin
/// sampling makes both small; too large an alpha approaches the convex hull.
///
/// Base and top are the 2nd and the 98th percentile of the points' heights, so that one stray
/// return moves neither.
///
/// @param leaf_points  In the map frame, z up [m].
/// @param base_z_m     Height of the tree's base in the map frame [m].
/// @param alpha_m      Radius of the probing ball [m]. > 0.
/// @return Nothing for fewer than ten points, or points that enclose no volume.
/// @throws std::invalid_argument  If alpha_m is not positive or a point is not finite.
std::optional<MapCrown> MeasureCrown(const std::vector<Eigen::Vector3d>& leaf_points,
                                     double base_z_m,
                                     double alpha_m);

/// Measures the crown of every tree of the model by its leaf points among `points`
/// (AssignPoints); trees without leaves have none.
void MeasureCrowns(const std::vector<CloudPoint>& points, double alpha_m, TreeModel* model);

}  // namespace dendro
