#include "dendro_slam/factor_graph/g2o.h"

#include <cmath>
#include <iomanip>
#include <istream>
#include <limits>
#include <ostream>
#include <set>
#include <sstream>
#include <stdexcept>
#include <string>

#include <Eigen/Cholesky>
#include <Eigen/SVD>
#include <Eigen/SparseCholesky>

#include "dendro_slam/factor_graph/between_factor.h"

namespace dendro {

namespace {

// One line of the file, and what it is about ("vertex 3", "edge 3 4") as soon as that is known.
struct Line {
  int number = 0;
  std::istringstream fields;
  std::string subject;

  [[noreturn]] void Fail(const std::string& what) const {
    throw std::runtime_error("line " + std::to_string(number) + ": " +
                             (subject.empty() ? "" : subject + ": ") + what);
  }
};

double ReadNumber(Line* line) {
  double x = 0.0;
  if (!(line->fields >> x) || !std::isfinite(x)) {
    line->Fail("a number is missing or not finite; correct the line or take it out");
  }
  return x;
}

std::int64_t ReadId(Line* line) {
  std::int64_t id = 0;
  if (!(line->fields >> id) || id < 0 || static_cast<std::uint64_t>(id) > kKeyIndexMask) {
    line->Fail("a vertex id is missing, negative or above 2^56 - 1; number the vertices from 0");
  }
  return id;
}

Eigen::Isometry3d ReadPose(Line* line) {
  double v[7];
  for (double& x : v) x = ReadNumber(line);
  const Eigen::Quaterniond q(v[6], v[3], v[4], v[5]);
  if (q.norm() < 1e-6) line->Fail("the quaternion is zero; 0 0 0 1 is no rotation");
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  T.linear() = q.normalized().toRotationMatrix();
  T.translation() << v[0], v[1], v[2];
  return T;
}

// Translation first to rotation first, and back.
Matrix6d SwapBlocks(const Matrix6d& m) {
  Matrix6d out;
  out << m.bottomRightCorner<3, 3>(), m.bottomLeftCorner<3, 3>(), m.topRightCorner<3, 3>(),
      m.topLeftCorner<3, 3>();
  return out;
}

void WritePose(const Eigen::Isometry3d& T, std::ostream& out) {
  Eigen::Quaterniond q(T.linear());
  q.normalize();
  out << ' ' << T.translation().x() << ' ' << T.translation().y() << ' ' << T.translation().z()
      << ' ' << q.x() << ' ' << q.y() << ' ' << q.z() << ' ' << q.w();
}

Eigen::Matrix3d NearestRotation(const Eigen::Matrix3d& M) {
  const Eigen::JacobiSVD<Eigen::Matrix3d> svd(M, Eigen::ComputeFullU | Eigen::ComputeFullV);
  Eigen::Vector3d sign(1.0, 1.0, 1.0);
  if ((svd.matrixU() * svd.matrixV().transpose()).determinant() < 0.0) sign.z() = -1.0;
  return svd.matrixU() * sign.asDiagonal() * svd.matrixV().transpose();
}

}  // namespace

PoseGraph ReadG2o(std::istream& in) {
  PoseGraph graph;
  std::vector<int> edge_lines;
  std::string text;
  for (int number = 1; std::getline(in, text); ++number) {
    Line line;
    line.number = number;
    line.fields.str(text);
    std::string tag;
    if (!(line.fields >> tag) || tag[0] == '#' || tag == "FIX") continue;
    if (tag == "VERTEX_SE3:QUAT") {
      const std::int64_t id = ReadId(&line);
      line.subject = "vertex " + std::to_string(id);
      const Eigen::Isometry3d pose = ReadPose(&line);
      if (!graph.poses.emplace(id, pose).second) line.Fail("given twice; take one of them out");
    } else if (tag == "EDGE_SE3:QUAT") {
      PoseGraphEdge edge;
      edge.from = ReadId(&line);
      edge.to = ReadId(&line);
      line.subject = "edge " + std::to_string(edge.from) + " " + std::to_string(edge.to);
      if (edge.from == edge.to) line.Fail("joins a vertex with itself; take it out");
      edge.T_from_to = ReadPose(&line);
      Matrix6d information;
      for (int r = 0; r < 6; ++r) {
        for (int c = r; c < 6; ++c) information(r, c) = information(c, r) = ReadNumber(&line);
      }
      edge.information = SwapBlocks(information);
      if (Eigen::LLT<Matrix6d>(edge.information).info() != Eigen::Success) {
        line.Fail(
            "the information matrix is not positive definite; give a direction that was not "
            "measured a small information, not none");
      }
      graph.edges.push_back(edge);
      edge_lines.push_back(number);
    } else {
      line.Fail("tag " + tag +
                " is not VERTEX_SE3:QUAT or EDGE_SE3:QUAT; only SE(3) pose graphs are read");
    }
  }
  const bool has_vertices = !graph.poses.empty();
  for (std::size_t i = 0; i < graph.edges.size(); ++i) {
    const PoseGraphEdge& edge = graph.edges[i];
    for (const std::int64_t id : {edge.from, edge.to}) {
      if (!graph.poses.emplace(id, Eigen::Isometry3d::Identity()).second || !has_vertices) continue;
      throw UnknownVariableError(PoseGraphKey(id),
                                 "line " + std::to_string(edge_lines[i]) + ": edge " +
                                     std::to_string(edge.from) + " " + std::to_string(edge.to) +
                                     ": vertex " + std::to_string(id) +
                                     " has no VERTEX_SE3:QUAT line; add one or take the edge out");
    }
  }
  if (graph.poses.empty()) {
    throw std::runtime_error(
        "the file holds no SE(3) vertex; it needs VERTEX_SE3:QUAT or EDGE_SE3:QUAT lines");
  }
  return graph;
}

std::vector<std::int64_t> InsertionOrder(const PoseGraph& graph) {
  if (graph.poses.empty()) throw std::invalid_argument("pose graph: no poses; add at least one");
  std::map<std::int64_t, std::vector<std::int64_t>> neighbours;
  for (const PoseGraphEdge& edge : graph.edges) {
    neighbours[edge.from].push_back(edge.to);
    neighbours[edge.to].push_back(edge.from);
  }
  std::vector<std::int64_t> order;
  std::set<std::int64_t> reached = {graph.poses.begin()->first};
  std::set<std::int64_t> next = reached;
  while (!next.empty()) {
    const std::int64_t id = *next.begin();
    next.erase(next.begin());
    order.push_back(id);
    for (const std::int64_t other : neighbours[id]) {
      if (reached.insert(other).second) next.insert(other);
    }
  }
  for (const auto& entry : graph.poses) {
    if (reached.count(entry.first) != 0) continue;
    const Key key = PoseGraphKey(entry.first);
    throw UnderconstrainedError(
        key,
        "variable " + KeyName(key) +
            " is under-constrained: no path of edges leads from it to the first pose, " +
            KeyName(PoseGraphKey(order.front())) + " (" + std::to_string(order.size()) + " of " +
            std::to_string(graph.poses.size()) +
            " poses are joined to that); add an edge between the two parts, or solve them as two "
            "graphs");
  }
  return order;
}

void WriteG2o(const PoseGraph& graph, std::ostream& out) {
  out << std::setprecision(std::numeric_limits<double>::max_digits10);
  for (const auto& [id, pose] : graph.poses) {
    out << "VERTEX_SE3:QUAT " << id;
    WritePose(pose, out);
    out << '\n';
  }
  for (const PoseGraphEdge& edge : graph.edges) {
    out << "EDGE_SE3:QUAT " << edge.from << ' ' << edge.to;
    WritePose(edge.T_from_to, out);
    const Matrix6d information = SwapBlocks(edge.information);
    for (int r = 0; r < 6; ++r) {
      for (int c = r; c < 6; ++c) out << ' ' << information(r, c);
    }
    out << '\n';
  }
}

Key PoseGraphKey(std::int64_t id) { return MakeKey('x', static_cast<std::uint64_t>(id)); }

FactorList PoseGraphFactors(const PoseGraph& graph) {
  FactorList factors;
  factors.reserve(graph.edges.size());
  for (const PoseGraphEdge& edge : graph.edges) {
    factors.push_back(std::make_shared<BetweenFactor>(PoseGraphKey(edge.from),
                                                      PoseGraphKey(edge.to),
                                                      edge.T_from_to,
                                                      NoiseModel::Information(edge.information)));
  }
  return factors;
}

std::map<std::int64_t, Eigen::Isometry3d> ChordalInitialization(const PoseGraph& graph) {
  InsertionOrder(graph);  // Throws unless all hang together.
  std::map<std::int64_t, int> index;
  for (const auto& entry : graph.poses)
    index.emplace(entry.first, static_cast<int>(index.size()) - 1);
  const int n = static_cast<int>(index.size()) - 1;  // The first pose is known and has index -1.
  std::map<std::int64_t, Eigen::Isometry3d> out;
  const Eigen::Isometry3d& first = graph.poses.begin()->second;
  if (n == 0) {
    out.emplace(graph.poses.begin()->first, first);
    return out;
  }
  using Triplet = Eigen::Triplet<double>;
  using Sparse = Eigen::SparseMatrix<double>;
  Eigen::SimplicialLDLT<Sparse> solver;
  const auto solve = [&](const std::vector<Triplet>& triplets, const Eigen::MatrixXd& rhs) {
    Sparse H(3 * n, 3 * n);
    H.setFromTriplets(triplets.begin(), triplets.end());
    solver.compute(H);
    if (solver.info() != Eigen::Success || !(solver.vectorD().minCoeff() > 0.0)) {
      throw std::runtime_error(
          "the linear system of the initialisation has no unique solution although the graph "
          "is connected; the information matrices of the edges differ too much in size");
    }
    return Eigen::MatrixXd(solver.solve(rhs));
  };
  const auto add = [](std::vector<Triplet>* triplets, int i, int j, const Eigen::Matrix3d& m) {
    for (int r = 0; r < 3; ++r) {
      for (int c = 0; c < 3; ++c) triplets->emplace_back(3 * i + r, 3 * j + c, m(r, c));
    }
  };

  // Rows of R: `r_j = R_ij^T r_i` for each row as a column vector; residual weight from the
  // rotation information.
  std::vector<Triplet> triplets;
  Eigen::MatrixXd rhs = Eigen::MatrixXd::Zero(3 * n, 3);
  for (const PoseGraphEdge& edge : graph.edges) {
    const double w = edge.information.topLeftCorner<3, 3>().trace() / 3.0;
    const int i = index.at(edge.from);
    const int j = index.at(edge.to);
    const Eigen::Matrix3d Rt = edge.T_from_to.linear().transpose();
    if (i >= 0) add(&triplets, i, i, w * Eigen::Matrix3d::Identity());
    if (j >= 0) add(&triplets, j, j, w * Eigen::Matrix3d::Identity());
    if (i >= 0 && j >= 0) {
      add(&triplets, j, i, -w * Rt);
      add(&triplets, i, j, -w * Rt.transpose());
    } else if (j >= 0) {
      rhs.middleRows<3>(3 * j) += w * Rt * first.linear().transpose();
    } else if (i >= 0) {
      rhs.middleRows<3>(3 * i) += w * Rt.transpose() * first.linear().transpose();
    }
  }
  const Eigen::MatrixXd rows = solve(triplets, rhs);
  std::vector<Eigen::Matrix3d> rotations(n);
  for (int i = 0; i < n; ++i) {
    rotations[i] = NearestRotation(rows.middleRows<3>(3 * i).transpose());
  }

  // Translations given the rotations: `t_j - t_i = R_i t_ij` with the information turned along.
  triplets.clear();
  Eigen::VectorXd b = Eigen::VectorXd::Zero(3 * n);
  for (const PoseGraphEdge& edge : graph.edges) {
    const int i = index.at(edge.from);
    const int j = index.at(edge.to);
    const Eigen::Matrix3d R_i = i >= 0 ? rotations[i] : Eigen::Matrix3d(first.linear());
    const Eigen::Matrix3d R_j = j >= 0 ? rotations[j] : Eigen::Matrix3d(first.linear());
    const Eigen::Matrix3d W = R_j * edge.information.bottomRightCorner<3, 3>() * R_j.transpose();
    Eigen::Vector3d offset = R_i * edge.T_from_to.translation();
    if (i < 0) offset += first.translation();
    if (j < 0) offset -= first.translation();
    if (i >= 0) {
      add(&triplets, i, i, W);
      b.segment<3>(3 * i) -= W * offset;
    }
    if (j >= 0) {
      add(&triplets, j, j, W);
      b.segment<3>(3 * j) += W * offset;
    }
    if (i >= 0 && j >= 0) {
      add(&triplets, i, j, -W);
      add(&triplets, j, i, -W);
    }
  }
  const Eigen::MatrixXd t = solve(triplets, b);
  for (const auto& [id, i] : index) {
    Eigen::Isometry3d T = first;
    if (i >= 0) {
      T.linear() = rotations[i];
      T.translation() = t.middleRows<3>(3 * i).col(0);
    }
    out.emplace(id, T);
  }
  return out;
}

}  // namespace dendro
