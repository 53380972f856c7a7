#include "dendro_slam/odometry/wood_icp.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <utility>
#include <vector>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "dendro_slam/geometry/so3.h"

namespace dendro {

namespace {

void Require(bool ok, const char* message) {
  if (!ok) throw std::invalid_argument(std::string("WoodIcpConfig: ") + message);
}

// Nearest neighbour in a fixed set of points. Deterministic: ties go to the lower index.
class KdTree {
 public:
  void Build(const std::vector<Eigen::Vector3f>& points) {
    points_ = points;
    order_.resize(points.size());
    for (std::size_t i = 0; i < order_.size(); ++i) order_[i] = static_cast<int>(i);
    nodes_.clear();
    if (!points_.empty()) Split(0, static_cast<int>(points_.size()));
  }

  // Index of the nearest point within sqrt(max_d2), or -1.
  int Nearest(const Eigen::Vector3f& query, float max_d2) const {
    int best = -1;
    float best_d2 = max_d2;
    if (!nodes_.empty()) Search(0, query, &best, &best_d2);
    return best;
  }

 private:
  static constexpr int kLeafSize = 8;
  struct Node {
    int begin = 0, end = 0;  // leaf: range in order_
    int left = -1, right = -1;
    int dimension = 0;
    float split = 0.0F;
  };

  int Split(int begin, int end) {
    const int index = static_cast<int>(nodes_.size());
    nodes_.emplace_back();
    nodes_[index].begin = begin;
    nodes_[index].end = end;
    if (end - begin <= kLeafSize) return index;
    Eigen::Vector3f low = points_[order_[begin]], high = low;
    for (int i = begin; i < end; ++i) {
      low = low.cwiseMin(points_[order_[i]]);
      high = high.cwiseMax(points_[order_[i]]);
    }
    int dimension = 0;
    (high - low).maxCoeff(&dimension);
    const int middle = (begin + end) / 2;
    std::nth_element(order_.begin() + begin,
                     order_.begin() + middle,
                     order_.begin() + end,
                     [this, dimension](int a, int b) {
                       const float xa = points_[a][dimension], xb = points_[b][dimension];
                       return xa < xb || (xa == xb && a < b);
                     });
    const float split = points_[order_[middle]][dimension];
    const int left = Split(begin, middle);
    const int right = Split(middle, end);
    Node& node = nodes_[index];
    node.left = left;
    node.right = right;
    node.dimension = dimension;
    node.split = split;
    return index;
  }

  void Search(int index, const Eigen::Vector3f& query, int* best, float* best_d2) const {
    const Node& node = nodes_[index];
    if (node.left < 0) {
      for (int i = node.begin; i < node.end; ++i) {
        const float d2 = (points_[order_[i]] - query).squaredNorm();
        if (d2 < *best_d2 || (d2 == *best_d2 && *best >= 0 && order_[i] < *best)) {
          *best_d2 = d2;
          *best = order_[i];
        }
      }
      return;
    }
    const float offset = query[node.dimension] - node.split;
    Search(offset < 0.0F ? node.left : node.right, query, best, best_d2);
    if (offset * offset <= *best_d2) {
      Search(offset < 0.0F ? node.right : node.left, query, best, best_d2);
    }
  }

  std::vector<Eigen::Vector3f> points_;
  std::vector<int> order_;
  std::vector<Node> nodes_;
};

enum class Shape : std::uint8_t { kPlane, kLine };

// A return with the surface around it.
struct SurfacePoint {
  Eigen::Vector3f position;
  Eigen::Vector3f direction;  // kPlane: the normal; kLine: the line
  Shape shape = Shape::kPlane;
};

// What is kept of a scan: enough to build its surfaces from wood or from all returns.
struct ScanPixels {
  std::int64_t stamp_ns = 0;
  int rows = 0, cols = 0;
  std::vector<Eigen::Vector3f> point;
  std::vector<std::uint8_t> usable;  // bit 0: in range, bit 1: wood
  float ring_step_rad = 0.035F;
  int wood_count = 0;
  int all_count = 0;
};

ScanPixels ExtractPixels(const LabelledScan& scan, const WoodIcpConfig& config) {
  const RangeImage& image = scan.image;
  ScanPixels out;
  out.stamp_ns = image.stamp_ns;
  out.rows = image.rows;
  out.cols = image.cols;
  out.point = image.point;
  out.usable.assign(image.size(), 0);
  for (std::size_t i = 0; i < image.size(); ++i) {
    if (!image.HasReturn(i) || !image.point[i].allFinite()) continue;
    const double range = image.point[i].norm();
    if (range < config.min_range_m || range > config.max_range_m) continue;
    out.usable[i] = 1;
    ++out.all_count;
    if (scan.IsWood(i)) {
      out.usable[i] = 3;
      ++out.wood_count;
    }
  }
  if (image.rows > 1 && image.beam_direction.size() == image.size()) {
    // Mean angle between neighbouring rings, from the first column's outermost beams.
    const Eigen::Vector3f& low = image.beam_direction[image.Index(0, 0)];
    const Eigen::Vector3f& high = image.beam_direction[image.Index(image.rows - 1, 0)];
    const float span = std::abs(std::asin(std::clamp(high.z(), -1.0F, 1.0F)) -
                                std::asin(std::clamp(low.z(), -1.0F, 1.0F)));
    if (std::isfinite(span) && span > 1e-3F) {
      out.ring_step_rad = span / static_cast<float>(image.rows - 1);
    }
  }
  return out;
}

// The surface around a pixel from its neighbours in the image; false for a return on its own.
bool FitSurface(const ScanPixels& scan,
                int row,
                int col,
                std::uint8_t mask,
                const WoodIcpConfig& config,
                SurfacePoint* out) {
  const std::size_t cols = static_cast<std::size_t>(scan.cols);
  const Eigen::Vector3f p = scan.point[static_cast<std::size_t>(row) * cols + col];
  const float range = p.norm();
  const float step = range * 6.2831853F / static_cast<float>(scan.cols);
  const float radius = static_cast<float>(config.neighbour_radius_m);
  // About nine columns are enough for a tangent; a coarser stride keeps the reach at close range.
  const int reach = std::max(1, static_cast<int>(radius / std::max(step, 1e-4F)));
  const int stride = std::max(1, reach / 4);
  const float ring_gap = range * scan.ring_step_rad;

  Eigen::Vector3f mean = Eigen::Vector3f::Zero();
  Eigen::Matrix3f scatter = Eigen::Matrix3f::Zero();
  int count = 0;
  int rings = 0;
  for (int dr = -config.neighbour_rings; dr <= config.neighbour_rings; ++dr) {
    const int r = row + dr;
    if (r < 0 || r >= scan.rows) continue;
    // Rings get farther apart with range; the image, not the distance, says what is a neighbour.
    const float vertical = ring_gap * static_cast<float>(std::abs(dr));
    // Ground and walls are met at a slant, their rings lie several times the spacing apart; the fit of
    // a plane below decides. A branch leans less.
    const float slant = mask == 1 ? 20.0F : 2.25F;
    const float limit2 = radius * radius + slant * vertical * vertical;
    bool any = false;
    for (int k = -4; k <= 4; ++k) {
      int c = col + k * stride;
      c = ((c % scan.cols) + scan.cols) % scan.cols;
      const std::size_t pixel = static_cast<std::size_t>(r) * cols + c;
      if ((scan.usable[pixel] & mask) == 0) continue;
      const Eigen::Vector3f d = scan.point[pixel] - p;
      if (d.squaredNorm() > limit2) continue;
      if (std::abs(scan.point[pixel].norm() - range) > radius + std::sqrt(slant / 2.25F) * vertical) {
        continue;
      }
      mean += d;
      scatter += d * d.transpose();
      ++count;
      any = true;
    }
    if (any) ++rings;
  }
  if (count < 3) return false;
  mean /= static_cast<float>(count);
  const Eigen::Matrix3f covariance =
      scatter / static_cast<float>(count) - mean * mean.transpose();
  Eigen::SelfAdjointEigenSolver<Eigen::Matrix3f> eigen;
  eigen.computeDirect(covariance);
  out->position = p;
  if (rings < 2) {
    // One ring only: its tangent is known, the direction across the rings is not. On wood what is
    // left is the part of the viewing direction perpendicular to the tangent; a ring on the ground
    // would look like a wall that moves with the sensor.
    if (mask == 1) return false;
    const Eigen::Vector3f view = p / range;
    const Eigen::Vector3f tangent = eigen.eigenvectors().col(2);
    const Eigen::Vector3f normal = view - tangent * tangent.dot(view);
    if (normal.norm() < 0.2F) return false;
    out->shape = Shape::kPlane;
    out->direction = normal.normalized();
    return true;
  }
  const Eigen::Vector3f values = eigen.eigenvalues().cwiseMax(1e-8F);
  if (values[1] < 0.04F * values[2] && values[1] < 9.0F * values[0]) {
    out->shape = Shape::kLine;
    out->direction = eigen.eigenvectors().col(2);
    return true;
  }
  if (values[0] > 0.5F * values[1]) return false;  // a clump
  if (mask == 1 && values[0] > 0.0025F) return false;  // rings on different things
  out->shape = Shape::kPlane;
  out->direction = eigen.eigenvectors().col(0);
  return true;
}

std::vector<SurfacePoint> BuildSurfaces(const ScanPixels& scan,
                                        bool all,
                                        int max_points,
                                        const WoodIcpConfig& config) {
  const std::uint8_t mask = all ? 1 : 2;
  const int available = all ? scan.all_count : scan.wood_count;
  std::vector<SurfacePoint> out;
  if (available == 0) return out;
  const double rate = std::min(1.0, static_cast<double>(max_points) / available);
  out.reserve(static_cast<std::size_t>(std::min(available, max_points)) + 16);
  double sum = 0.5;
  for (int row = 0; row < scan.rows; ++row) {
    for (int col = 0; col < scan.cols; ++col) {
      const std::size_t pixel =
          static_cast<std::size_t>(row) * static_cast<std::size_t>(scan.cols) + col;
      if ((scan.usable[pixel] & mask) == 0) continue;
      sum += rate;
      if (sum < 1.0) continue;
      sum -= 1.0;
      SurfacePoint point;
      if (FitSurface(scan, row, col, mask, config, &point)) out.push_back(point);
    }
  }
  return out;
}

// Covariance of a return's position as GICP has it: small across the surface, wide along it.
Eigen::Matrix3d SurfaceCovariance(const SurfacePoint& point, double across2, double along2) {
  const Eigen::Vector3d d = point.direction.cast<double>();
  const Eigen::Matrix3d dd = d * d.transpose();
  if (point.shape == Shape::kPlane) {
    return along2 * Eigen::Matrix3d::Identity() + (across2 - along2) * dd;
  }
  return across2 * Eigen::Matrix3d::Identity() + (along2 - across2) * dd;
}

}  // namespace

void WoodIcpConfig::Validate() const {
  Require(points == "wood" || points == "all", "points must be \"wood\" or \"all\"");
  Require(use_all_points_below_wood_count >= 0, "use_all_points_below_wood_count must be >= 0");
  Require(min_range_m >= 0.0, "min_range_m must be >= 0");
  Require(max_range_m > min_range_m, "max_range_m must be > min_range_m");
  Require(min_points >= 10, "min_points must be >= 10");
  Require(max_points >= min_points, "max_points must be >= min_points");
  Require(max_target_points >= max_points, "max_target_points must be >= max_points");
  Require(neighbour_radius_m > 0.0, "neighbour_radius_m must be > 0");
  Require(neighbour_rings >= 1, "neighbour_rings must be >= 1");
  Require(max_correspondence_m > 0.0, "max_correspondence_m must be > 0");
  Require(final_correspondence_m > 0.0 && final_correspondence_m <= max_correspondence_m,
          "final_correspondence_m must be in (0, max_correspondence_m]");
  Require(noise_sigma_m > 0.0, "noise_sigma_m must be > 0");
  Require(normal_sigma_rad >= 0.0, "normal_sigma_rad must be >= 0");
  Require(correlation_points >= 1.0, "correlation_points must be >= 1");
  Require(sigma_floor_rad >= 0.0, "sigma_floor_rad must be >= 0");
  Require(sigma_floor_m >= 0.0, "sigma_floor_m must be >= 0");
  Require(degenerate_sigma_m > 0.0, "degenerate_sigma_m must be > 0");
  Require(max_iterations > 0, "max_iterations must be > 0");
  Require(converged_rad > 0.0, "converged_rad must be > 0");
  Require(converged_m > 0.0, "converged_m must be > 0");
  Require(min_overlap > 0.0 && min_overlap <= 1.0, "min_overlap must be in (0, 1]");
}

const char* ToString(WoodIcpStatus status) {
  switch (status) {
    case WoodIcpStatus::kConverged: return "converged";
    case WoodIcpStatus::kFirstScan: return "first scan";
    case WoodIcpStatus::kTooFewPoints: return "too few points";
    case WoodIcpStatus::kNotConverged: return "not converged";
    case WoodIcpStatus::kLowOverlap: return "too little overlap between the scans";
    case WoodIcpStatus::kTimeNotAhead: return "stamp not later than the one before";
  }
  return "unknown";
}

struct WoodIcp::State {
  WoodIcpConfig config;
  WoodIcpStatus status = WoodIcpStatus::kFirstScan;
  int iterations = 0;
  int num_correspondences = 0;
  bool used_all = false;

  std::optional<ScanPixels> previous;
  std::vector<SurfacePoint> target;  // surfaces of `previous`
  bool target_is_all = false;
  KdTree tree;

  // The lidar's velocity [rad/s, m/s] as a Kalman filter sees it: the guess when nobody gives one. A
  // direction that the scans do not tell keeps its velocity instead of wandering.
  bool has_twist = false;
  Vector6d twist = Vector6d::Zero();
  Matrix6d twist_covariance = Matrix6d::Zero();

  void FilterTwist(const RelativeMotion& motion, double dt) {
    const Vector6d measured = LogSe3(motion.T_from_to) / dt;
    const Matrix6d R = motion.covariance / (dt * dt);
    constexpr double kAcceleration = 3.0;  // per axis, one sigma [rad/s^2, m/s^2]
    if (!has_twist) {
      // At rest until told otherwise, give or take a walking pace.
      twist.setZero();
      twist_covariance = Matrix6d::Identity() * 2.0;
      has_twist = true;
    } else {
      twist_covariance.diagonal().array() += kAcceleration * kAcceleration * dt * dt;
    }
    const Matrix6d S = twist_covariance + R;
    const Matrix6d K = twist_covariance * S.ldlt().solve(Matrix6d::Identity());
    twist += K * (measured - twist);
    twist_covariance -= K * twist_covariance;
    twist_covariance = 0.5 * (twist_covariance + twist_covariance.transpose()).eval();
  }

  void SetTarget(bool all) {
    target = BuildSurfaces(*previous, all, config.max_target_points, config);
    target_is_all = all;
    std::vector<Eigen::Vector3f> positions(target.size());
    for (std::size_t i = 0; i < target.size(); ++i) positions[i] = target[i].position;
    tree.Build(positions);
  }

  std::optional<RelativeMotion> Register(const ScanPixels& current,
                                         const std::vector<SurfacePoint>& source,
                                         const Eigen::Isometry3d& guess);
};

std::optional<RelativeMotion> WoodIcp::State::Register(const ScanPixels& current,
                                                       const std::vector<SurfacePoint>& source,
                                                       const Eigen::Isometry3d& guess) {
  const std::size_t n = source.size();
  // Motion is expressed about the points' centroid, rotations as arc lengths at their mean reach:
  // all six coordinates are then metres, and eigenvalues can be compared.
  Eigen::Vector3d centroid = Eigen::Vector3d::Zero();
  for (const SurfacePoint& s : source) centroid += s.position.cast<double>();
  centroid /= static_cast<double>(n);
  double reach2 = 0.0;
  for (const SurfacePoint& s : source) {
    reach2 += (s.position.cast<double>() - centroid).squaredNorm();
  }
  const double reach = std::max(0.1, std::sqrt(reach2 / static_cast<double>(n)));

  const double across2 = config.noise_sigma_m * config.noise_sigma_m;
  // Wide enough that neighbouring rings do not hold each other, narrow enough to settle.
  const double along2 = 0.1 * 0.1;
  const double degenerate = config.degenerate_sigma_m / 10.0;

  Eigen::Isometry3d T = guess;
  double limit = config.max_correspondence_m;
  bool converged = false;
  Matrix6d honest = Matrix6d::Zero();  // information across the surfaces only
  double chi2 = 0.0, chi2_dof = 0.0;
  iterations = 0;
  constexpr int kFreezeAfter = 12;
  std::vector<int> partner(n, -1);
  while (iterations < config.max_iterations && !converged) {
    ++iterations;
    Matrix6d H = Matrix6d::Zero();
    Vector6d b = Vector6d::Zero();
    honest.setZero();
    chi2 = 0.0;
    chi2_dof = 0.0;
    num_correspondences = 0;
    const Eigen::Matrix3d R = T.linear();
    // Returns between two partners flip from one to the other for ever: after a while the partners
    // stay, and the problem has an optimum.
    const bool frozen = iterations > kFreezeAfter && limit <= config.final_correspondence_m;
    const float limit2 = static_cast<float>(limit * limit);
    for (std::size_t i = 0; i < n; ++i) {
      const SurfacePoint& s = source[i];
      const Eigen::Vector3d p = s.position.cast<double>();
      const Eigen::Vector3d q = T * p;
      if (!frozen) partner[i] = tree.Nearest(q.cast<float>(), limit2);
      const int index = partner[i];
      if (index < 0) continue;
      const SurfacePoint& t = target[static_cast<std::size_t>(index)];
      if (t.shape != s.shape) continue;
      const Eigen::Vector3d s_direction = R * s.direction.cast<double>();
      const double cosine = std::abs(s_direction.dot(t.direction.cast<double>()));
      if (cosine < 0.7) continue;
      SurfacePoint turned = s;
      turned.direction = s_direction.cast<float>();
      const Eigen::Matrix3d C = SurfaceCovariance(t, across2, along2) +
                                SurfaceCovariance(turned, across2, along2);
      const Eigen::Matrix3d M = C.inverse();
      const Eigen::Vector3d e = t.position.cast<double>() - q;
      // Jacobian of q in [reach * omega; rho at the centroid].
      Eigen::Matrix<double, 3, 6> J;
      J.leftCols<3>() = -R * Skew(p - centroid) / reach;
      J.rightCols<3>() = R;

      // Honest residual: across the mean surface (plane) or the mean line only.
      Eigen::Vector3d mean_direction = t.direction.cast<double>();
      mean_direction += s_direction.dot(mean_direction) < 0.0 ? Eigen::Vector3d(-s_direction)
                                                              : s_direction;
      mean_direction.normalize();
      Eigen::Matrix3d P = mean_direction * mean_direction.transpose();
      double dof = 1.0;
      if (t.shape == Shape::kLine) {
        P = Eigen::Matrix3d::Identity() - P;
        dof = 2.0;
      }
      const double r2 = e.dot(P * e) / (2.0 * across2);
      // Geman-McClure: returns of another surface do not pull.
      constexpr double kWidth2 = 9.0;
      const double anneal = limit / config.final_correspondence_m;
      const double width2 = kWidth2 * anneal * anneal;
      const double root = width2 / (width2 + r2);
      const double weight = root * root;

      H.noalias() += weight * J.transpose() * M * J;
      b.noalias() += weight * J.transpose() * (M * e);
      // Errors of the normals look like information along the surface; its mean is taken off.
      const double normal2 = config.normal_sigma_rad * config.normal_sigma_rad;
      const Eigen::Matrix3d known = P - normal2 * (Eigen::Matrix3d::Identity() - P);
      honest.noalias() += weight * J.transpose() * (known / (2.0 * across2)) * J;
      chi2 += weight * r2;
      chi2_dof += weight * dof;
      ++num_correspondences;
    }
    if (num_correspondences < std::max(config.min_points / 2, 12) ||
        num_correspondences < config.min_overlap * static_cast<double>(n)) {
      status = WoodIcpStatus::kLowOverlap;
      return std::nullopt;
    }
    // Directions that the surfaces do not tell keep the guess: steps stay in the others' span.
    Eigen::SelfAdjointEigenSolver<Matrix6d> eigen(honest / config.correlation_points);
    Vector6d step = Vector6d::Zero();
    const double threshold = 1.0 / (degenerate * degenerate);
    int first = 0;
    while (first < 6 && eigen.eigenvalues()[first] < threshold) ++first;
    if (first < 6) {
      const auto V = eigen.eigenvectors().rightCols(6 - first);
      const Eigen::MatrixXd reduced = V.transpose() * H * V;
      step = V * reduced.ldlt().solve(V.transpose() * b);
    }
    Vector6d xi;
    xi.head<3>() = step.head<3>() / reach;
    xi.tail<3>() = step.tail<3>() - xi.head<3>().cross(centroid);
    T = NormalizedSe3(T * ExpSe3(xi));
    if (!T.matrix().allFinite()) {
      status = WoodIcpStatus::kNotConverged;
      return std::nullopt;
    }
    const bool small = xi.head<3>().norm() < config.converged_rad &&
                       step.tail<3>().norm() < config.converged_m;
    if (limit > config.final_correspondence_m) {
      const double shrink = small ? 0.4 : 0.7;
      limit = std::max(config.final_correspondence_m, limit * shrink);
    } else {
      converged = small;
    }
  }
  if (!converged) {
    status = WoodIcpStatus::kNotConverged;
    return std::nullopt;
  }

  // Covariance: the inverse of the honest information, scaled by the residuals (at least 1) and by
  // how many returns err together; eigenvalues that say nothing are floored, never inverted.
  const double scale = std::max(1.0, chi2 / std::max(1.0, chi2_dof - 6.0));
  Eigen::SelfAdjointEigenSolver<Matrix6d> eigen(honest / (config.correlation_points * scale));
  Vector6d variance;
  for (int i = 0; i < 6; ++i) {
    const double value = eigen.eigenvalues()[i];
    variance[i] = value * degenerate * degenerate < 1.0
                      ? config.degenerate_sigma_m * config.degenerate_sigma_m
                      : 1.0 / value;
  }
  const Matrix6d centred =
      eigen.eigenvectors() * variance.asDiagonal() * eigen.eigenvectors().transpose();
  Matrix6d A = Matrix6d::Zero();
  A.topLeftCorner<3, 3>() = Eigen::Matrix3d::Identity() / reach;
  A.bottomLeftCorner<3, 3>() = Skew(centroid) / reach;
  A.bottomRightCorner<3, 3>() = Eigen::Matrix3d::Identity();
  Matrix6d covariance = A * centred * A.transpose();
  covariance.topLeftCorner<3, 3>().diagonal().array() +=
      config.sigma_floor_rad * config.sigma_floor_rad;
  covariance.bottomRightCorner<3, 3>().diagonal().array() +=
      config.sigma_floor_m * config.sigma_floor_m;

  RelativeMotion motion;
  motion.from_stamp_ns = previous->stamp_ns;
  motion.to_stamp_ns = current.stamp_ns;
  motion.T_from_to = T;
  motion.covariance = 0.5 * (covariance + covariance.transpose());
  status = WoodIcpStatus::kConverged;
  return motion;
}

WoodIcp::WoodIcp(WoodIcpConfig config) : state_(std::make_unique<State>()) {
  config.Validate();
  state_->config = std::move(config);
}
WoodIcp::~WoodIcp() = default;
WoodIcp::WoodIcp(WoodIcp&&) noexcept = default;
WoodIcp& WoodIcp::operator=(WoodIcp&&) noexcept = default;

std::optional<RelativeMotion> WoodIcp::AddScan(
    const LabelledScan& scan, const std::optional<Eigen::Isometry3d>& T_prev_cur_guess) {
  State& s = *state_;
  s.iterations = 0;
  s.num_correspondences = 0;
  s.used_all = false;
  ScanPixels current = ExtractPixels(scan, s.config);
  std::optional<RelativeMotion> motion;
  std::vector<SurfacePoint> current_surfaces;
  bool current_is_all = s.config.points == "all";

  if (!s.previous) {
    s.status = WoodIcpStatus::kFirstScan;
  } else if (current.stamp_ns <= s.previous->stamp_ns) {
    s.status = WoodIcpStatus::kTimeNotAhead;
    s.has_twist = false;
  } else {
    const double dt = 1e-9 * static_cast<double>(current.stamp_ns - s.previous->stamp_ns);
    const int wood = std::min(current.wood_count, s.previous->wood_count);
    const bool all = s.config.points == "all" || wood < s.config.use_all_points_below_wood_count;
    s.used_all = all;
    current_is_all = all;
    if (s.target_is_all != all || s.target.empty()) s.SetTarget(all);
    current_surfaces = BuildSurfaces(current, all, s.config.max_target_points, s.config);
    const std::size_t min_points = static_cast<std::size_t>(s.config.min_points);
    if (current_surfaces.size() < min_points || s.target.size() < min_points) {
      s.status = WoodIcpStatus::kTooFewPoints;
    } else {
      Eigen::Isometry3d guess = Eigen::Isometry3d::Identity();
      if (T_prev_cur_guess && T_prev_cur_guess->matrix().allFinite()) {
        guess = *T_prev_cur_guess;
      } else if (s.has_twist) {
        guess = ExpSe3(s.twist * std::min(dt, 0.5));
      }
      // An even choice of the source returns; the target keeps all of its own.
      const std::size_t max_points = static_cast<std::size_t>(s.config.max_points);
      if (current_surfaces.size() > max_points) {
        std::vector<SurfacePoint> source;
        source.reserve(max_points);
        for (std::size_t i = 0; i < max_points; ++i) {
          source.push_back(current_surfaces[i * current_surfaces.size() / max_points]);
        }
        motion = s.Register(current, source, guess);
      } else {
        motion = s.Register(current, current_surfaces, guess);
      }
    }
    if (motion) {
      s.FilterTwist(*motion, dt);
    } else {
      s.has_twist = false;
    }
  }

  s.previous = std::move(current);
  if (current_surfaces.empty()) {
    s.SetTarget(current_is_all);
  } else {
    s.target = std::move(current_surfaces);
    s.target_is_all = current_is_all;
    std::vector<Eigen::Vector3f> positions(s.target.size());
    for (std::size_t i = 0; i < s.target.size(); ++i) positions[i] = s.target[i].position;
    s.tree.Build(positions);
  }
  return motion;
}

WoodIcpStatus WoodIcp::status() const { return state_->status; }
int WoodIcp::iterations() const { return state_->iterations; }
int WoodIcp::num_correspondences() const { return state_->num_correspondences; }
bool WoodIcp::used_all_points() const { return state_->used_all; }

void WoodIcp::Reset() {
  const WoodIcpConfig config = state_->config;
  state_ = std::make_unique<State>();
  state_->config = config;
}

}  // namespace dendro
