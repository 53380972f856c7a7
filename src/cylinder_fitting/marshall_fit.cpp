#include "dendro_slam/cylinder_fitting/marshall_fit.h"

#include <cmath>

#include <ceres/tiny_solver.h>

namespace dendro {
namespace {

struct Directions {
  Eigen::Vector3d n, n_phi, n_psi, a, side;
  double sin_psi, cos_psi;
};

Directions DirectionsOf(const Vector5d& q) {
  const double cp = std::cos(q[1]), sp = std::sin(q[1]);
  const double cs = std::cos(q[2]), ss = std::sin(q[2]);
  const double ca = std::cos(q[4]), sa = std::sin(q[4]);
  Directions out;
  out.sin_psi = ss;
  out.cos_psi = cs;
  out.n = {cp * cs, sp * cs, ss};
  out.n_phi = {-sp, cp, 0.0};
  out.n_psi = {-cp * ss, -sp * ss, cs};
  out.a = ca * out.n_psi + sa * out.n_phi;
  out.side = -sa * out.n_psi + ca * out.n_phi;  // d a / d alpha
  return out;
}

double Residual(const Directions& d,
                const Vector5d& q,
                const Eigen::Vector3d& p,
                Vector5d* jacobian) {
  const double rho = q[0], kappa = q[3];
  const double pn = p.dot(d.n), pa = p.dot(d.a);
  const double bracket = p.squaredNorm() - 2.0 * rho * pn - pa * pa + rho * rho;
  if (jacobian != nullptr) {
    const double by_pn = -(kappa * rho + 1.0);
    const double by_pa = -kappa * pa;
    const double p_phi = p.dot(d.n_phi), p_psi = p.dot(d.n_psi);
    // n_psi turns by -sin psi n_phi with phi; n_phi turns by -(cos psi n - sin psi n_psi).
    const double ca = d.a.dot(d.n_psi), sa = d.a.dot(d.n_phi);
    const double a_phi = -ca * d.sin_psi * p_phi - sa * (d.cos_psi * pn - d.sin_psi * p_psi);
    (*jacobian)[0] = kappa * (rho - pn) + 1.0;
    (*jacobian)[1] = by_pn * d.cos_psi * p_phi + by_pa * a_phi;
    (*jacobian)[2] = by_pn * p_psi + by_pa * (-ca * pn);
    (*jacobian)[3] = 0.5 * bracket;
    (*jacobian)[4] = by_pa * p.dot(d.side);
  }
  return 0.5 * kappa * bracket + rho - pn;
}

// The interface of ceres::TinySolver: Ceres' own Levenberg-Marquardt with fixed sizes.
class MarshallFunction {
 public:
  using Scalar = double;
  enum { NUM_RESIDUALS = Eigen::Dynamic, NUM_PARAMETERS = 5 };

  explicit MarshallFunction(const std::vector<Eigen::Vector3d>& points) : points_(points) {}
  int NumResiduals() const { return static_cast<int>(points_.size()); }
  bool operator()(const double* parameters, double* residuals, double* jacobian) const {
    const Vector5d q = Eigen::Map<const Vector5d>(parameters);
    const Directions directions = DirectionsOf(q);
    const auto rows = static_cast<Eigen::Index>(points_.size());
    Vector5d row;
    for (Eigen::Index i = 0; i < rows; ++i) {
      residuals[i] = Residual(directions, q, points_[static_cast<std::size_t>(i)],
                              jacobian != nullptr ? &row : nullptr);
      if (jacobian != nullptr) {
        Eigen::Map<Eigen::Matrix<double, Eigen::Dynamic, 5>>(jacobian, rows, 5).row(i) =
            row.transpose();
      }
    }
    return true;
  }

 private:
  const std::vector<Eigen::Vector3d>& points_;
};

}  // namespace

double MarshallResidual(const Vector5d& q, const Eigen::Vector3d& p, Vector5d* jacobian) {
  return Residual(DirectionsOf(q), q, p, jacobian);
}

std::optional<Cylinder> FitMarshall(const std::vector<Eigen::Vector3d>& points,
                                    const Eigen::Vector3d& origin,
                                    const Cylinder& initial) {
  if (points.size() < 5) return std::nullopt;
  // A frame at the sensor with x towards the axis line and z along it keeps the angles small.
  const Eigen::Vector3d z = initial.axis.normalized();
  Eigen::Vector3d foot = initial.point - origin;
  foot -= foot.dot(z) * z;
  const double distance = foot.norm();
  if (!(distance > 1e-6) || !(initial.curvature > 0.0)) return std::nullopt;
  Eigen::Matrix3d R;
  R.col(0) = foot / distance;
  R.col(2) = z;
  R.col(1) = z.cross(R.col(0));
  std::vector<Eigen::Vector3d> local;
  local.reserve(points.size());
  for (const Eigen::Vector3d& p : points) local.emplace_back(R.transpose() * (p - origin));

  MarshallFunction function(local);
  ceres::TinySolver<MarshallFunction> solver;
  solver.options.max_num_iterations = 30;
  Vector5d q;
  q << distance - initial.radius(), 0.0, 0.0, initial.curvature, 0.0;
  solver.Solve(function, &q);
  if (!q.allFinite() || !(q[3] > 1e-3)) return std::nullopt;
  const Directions d = DirectionsOf(q);
  Cylinder out;
  out.axis = (R * d.a).normalized();
  out.point = origin + R * ((q[0] + 1.0 / q[3]) * d.n);
  out.curvature = q[3];
  return out;
}

}  // namespace dendro
