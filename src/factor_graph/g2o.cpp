#include "dendro_slam/factor_graph/g2o.h"

#include <cmath>
#include <istream>
#include <iomanip>
#include <limits>
#include <ostream>
#include <sstream>
#include <stdexcept>
#include <string>

#include <Eigen/Cholesky>
#include <Eigen/SVD>
#include <Eigen/SparseCholesky>

#include "dendro_slam/factor_graph/between_factor.h"

namespace dendro {

namespace {

[[noreturn]] void Fail(int line, const std::string& what) {
  throw std::runtime_error("line " + std::to_string(line) + ": " + what);
}

double ReadNumber(std::istringstream& in, int line) {
  double x = 0.0;
  if (!(in >> x) || !std::isfinite(x)) Fail(line, "a number is missing or not finite");
  return x;
}

std::int64_t ReadId(std::istringstream& in, int line) {
  std::int64_t id = 0;
  if (!(in >> id) || id < 0) Fail(line, "a vertex id is missing or negative");
  return id;
}

Eigen::Isometry3d ReadPose(std::istringstream& in, int line) {
  double v[7];
  for (double& x : v) x = ReadNumber(in, line);
  const Eigen::Quaterniond q(v[6], v[3], v[4], v[5]);
  if (q.norm() < 1e-6) Fail(line, "the quaternion is zero");
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
  out << ' ' << T.translation().x() << ' ' << T.translation().y() << ' ' << T.translation().z() << ' '
      << q.x() << ' ' << q.y() << ' ' << q.z() << ' ' << q.w();
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
  std::string text;
  for (int line = 1; std::getline(in, text); ++line) {
    std::istringstream fields(text);
    std::string tag;
    if (!(fields >> tag) || tag[0] == '#' || tag == "FIX") continue;
    if (tag == "VERTEX_SE3:QUAT") {
      const std::int64_t id = ReadId(fields, line);
      const Eigen::Isometry3d pose = ReadPose(fields, line);
      if (!graph.poses.emplace(id, pose).second) {
        Fail(line, "vertex " + std::to_string(id) + " is given twice");
      }
    } else if (tag == "EDGE_SE3:QUAT") {
      PoseGraphEdge edge;
      edge.from = ReadId(fields, line);
      edge.to = ReadId(fields, line);
      if (edge.from == edge.to) Fail(line, "an edge joins a vertex with itself");
      edge.T_from_to = ReadPose(fields, line);
      Matrix6d information;
      for (int r = 0; r < 6; ++r) {
        for (int c = r; c < 6; ++c) {
          information(r, c) = information(c, r) = ReadNumber(fields, line);
        }
      }
      edge.information = SwapBlocks(information);
      if (Eigen::LLT<Matrix6d>(edge.information).info() != Eigen::Success) {
        Fail(line, "the information matrix is not positive definite");
      }
      graph.edges.push_back(edge);
    } else {
      Fail(line, "tag " + tag + " is not VERTEX_SE3:QUAT or EDGE_SE3:QUAT");
    }
  }
  for (const PoseGraphEdge& edge : graph.edges) {
    graph.poses.emplace(edge.from, Eigen::Isometry3d::Identity());
    graph.poses.emplace(edge.to, Eigen::Isometry3d::Identity());
  }
  if (graph.poses.empty()) throw std::runtime_error("the file holds no SE(3) vertex");
  return graph;
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
  std::map<std::int64_t, int> index;
  for (const auto& entry : graph.poses) index.emplace(entry.first, static_cast<int>(index.size()) - 1);
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
      throw std::runtime_error("the pose graph is not connected");
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
