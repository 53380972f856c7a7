#pragma once

#include <cstdint>
#include <iosfwd>
#include <map>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "dendro_slam/factor_graph/errors.h"
#include "dendro_slam/factor_graph/factor.h"
#include "dendro_slam/geometry/se3.h"

/// Pose graphs in the g2o text format (VERTEX_SE3:QUAT, EDGE_SE3:QUAT) and their initialisation.
namespace dendro {

/// Measured motion between two poses.
struct PoseGraphEdge {
  std::int64_t from = 0;
  std::int64_t to = 0;
  Eigen::Isometry3d T_from_to = Eigen::Isometry3d::Identity();
  /// Rotation first (the file holds translation first), as this project and GTSAM order it; the
  /// rotation block applies to the rotation vector, as GTSAM reads it.
  Matrix6d information = Matrix6d::Identity();
};

struct PoseGraph {
  std::map<std::int64_t, Eigen::Isometry3d> poses;
  std::vector<PoseGraphEdge> edges;
};

/// Reads a graph. In a file of edges alone all vertices start at the identity; FIX is read over.
/// @throws std::runtime_error naming the line, the vertex or edge and what to do, for a tag that is no
///         SE(3) vertex or edge, a missing or non-finite number, a zero quaternion, or an
///         information matrix that is not positive definite; UnknownVariableError for an edge to a
///         vertex that is missing among those given.
PoseGraph ReadG2o(std::istream& in);

/// The order in which poses can be added one by one, every one but the first with an edge to one
/// before it: ascending ids, a pose that no edge joins to a lower one as soon as it can be.
/// @throws UnderconstrainedError naming a pose that is not connected to the first; std::invalid_argument
///         without poses.
std::vector<std::int64_t> InsertionOrder(const PoseGraph& graph);

/// Writes a graph with all digits.
void WriteG2o(const PoseGraph& graph, std::ostream& out);

/// The key of a vertex in a factor graph: MakeKey('x', id).
Key PoseGraphKey(std::int64_t id);

/// Between-factors of the edges, in their order.
FactorList PoseGraphFactors(const PoseGraph& graph);

/// Chordal initialisation (Martinec and Pajdla 2007; Carlone et al., ICRA 2015): rotations from the
/// linear relaxation `R_j = R_i R_ij`, projected onto SO(3), then translations by linear least
/// squares. The first pose keeps its value. It does not end in the local minima that an odometry
/// chain on a sphere or torus leads to.
/// @throws as InsertionOrder does.
std::map<std::int64_t, Eigen::Isometry3d> ChordalInitialization(const PoseGraph& graph);

}  // namespace dendro
