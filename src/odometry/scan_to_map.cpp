#include "dendro_slam/odometry/scan_to_map.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <unordered_map>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

namespace dendro {

namespace {

constexpr int kMostNeighbours = 32;

void Require(bool ok, const char* message) {
  if (!ok) throw std::invalid_argument(std::string("ScanToMapConfig: ") + message);
}

using Cell = Eigen::Vector3i;

// 21 bits per axis: cells to a million from the origin either way.
std::uint64_t Key(const Cell& cell) {
  const auto part = [](int v) { return static_cast<std::uint64_t>(v + (1 << 20)) & 0x1FFFFFULL; };
  return part(cell.x()) << 42 | part(cell.y()) << 21 | part(cell.z());
}

// Spreads the key's bits, which neighbouring cells hardly differ in (splitmix64's finaliser).
struct KeyHash {
  std::size_t operator()(std::uint64_t k) const {
    k = (k ^ (k >> 30)) * 0xBF58476D1CE4E5B9ULL;
    k = (k ^ (k >> 27)) * 0x94D049BB133111EBULL;
    return static_cast<std::size_t>(k ^ (k >> 31));
  }
};

// A surface of the map next to a return.
struct Plane {
  Eigen::Vector3d point = Eigen::Vector3d::Zero();
  Eigen::Vector3d normal = Eigen::Vector3d::Zero();
  Eigen::Vector3d seen_from = Eigen::Vector3d::Zero();  // Where the return was when it was found.
  bool valid = false;
};

}  // namespace

void ScanToMapConfig::Validate() const {
  Require(voxel_m > 0.0, "voxel_m must be > 0");
  Require(point_spacing_m > 0.0, "point_spacing_m must be > 0");
  Require(neighbours >= 5 && neighbours <= kMostNeighbours, "neighbours must be in [5, 32]");
  Require(max_points_per_voxel >= neighbours, "max_points_per_voxel must be >= neighbours");
  Require(max_surface_rms_m > 0.0, "max_surface_rms_m must be > 0");
  Require(noise_sigma_m > 0.0, "noise_sigma_m must be > 0");
  Require(max_distance_m > 0.0, "max_distance_m must be > 0");
  Require(correlation_points >= 1.0, "correlation_points must be >= 1");
  Require(min_matches >= 10, "min_matches must be >= 10");
  Require(max_iterations > 0, "max_iterations must be > 0");
  Require(converged_rad > 0.0, "converged_rad must be > 0");
  Require(converged_m > 0.0, "converged_m must be > 0");
  Require(max_range_m > 0.0, "max_range_m must be > 0");
}

struct ScanToMap::State {
  ScanToMapConfig config;
  std::unordered_map<std::uint64_t, std::vector<Eigen::Vector3f>, KeyHash> cells;
  Eigen::Vector3d pruned_at = Eigen::Vector3d::Zero();

  Cell CellOf(const Eigen::Vector3d& p) const {
    return (p / config.voxel_m).array().floor().cast<int>();
  }

  Plane FindPlane(const Eigen::Vector3d& p) const {
    Plane plane;
    plane.seen_from = p;
    std::array<std::pair<float, const Eigen::Vector3f*>, kMostNeighbours> nearest;
    std::size_t count = 0;
    const auto wanted = static_cast<std::size_t>(config.neighbours);
    const Cell centre = CellOf(p);
    const Eigen::Vector3f query = p.cast<float>();
    // Where few scans have been, the rings still lie far apart: a second look reaches twice as far.
    for (int reach = 1; reach <= 2 && count < wanted; ++reach) {
      count = 0;
      const double radius = reach * config.voxel_m;
      float limit = static_cast<float>(radius * radius);
      for (int dx = -reach; dx <= reach; ++dx) {
        for (int dy = -reach; dy <= reach; ++dy) {
          for (int dz = -reach; dz <= reach; ++dz) {
            const auto cell = cells.find(Key(centre + Cell(dx, dy, dz)));
            if (cell == cells.end()) continue;
            for (const Eigen::Vector3f& q : cell->second) {
              const float d2 = (q - query).squaredNorm();
              if (d2 >= limit) continue;
              if (count < wanted) ++count;
              std::size_t at = count - 1;
              for (; at > 0 && nearest[at - 1].first > d2; --at) nearest[at] = nearest[at - 1];
              nearest[at] = {d2, &q};
              if (count == wanted) limit = nearest[count - 1].first;
            }
          }
        }
      }
    }
    constexpr std::size_t kFewest = 6;
    if (count < std::min(kFewest, wanted)) return plane;
    Eigen::Vector3d mean = Eigen::Vector3d::Zero();
    for (std::size_t i = 0; i < count; ++i) mean += nearest[i].second->cast<double>();
    mean /= static_cast<double>(count);
    Eigen::Matrix3d scatter = Eigen::Matrix3d::Zero();
    for (std::size_t i = 0; i < count; ++i) {
      const Eigen::Vector3d d = nearest[i].second->cast<double>() - mean;
      scatter += d * d.transpose();
    }
    Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen;
    eigen.computeDirect(scatter / static_cast<double>(count));
    const Eigen::Vector3d& values = eigen.eigenvalues();
    // A plane is thin, and wide in two directions: neighbours along one ring only do not span one.
    if (values[0] > config.max_surface_rms_m * config.max_surface_rms_m) return plane;
    if (values[1] < 4.0 * std::max(values[0], 1e-6) || values[1] < 0.02 * values[2]) return plane;
    plane.point = mean;
    plane.normal = eigen.eigenvectors().col(0);
    plane.valid = true;
    return plane;
  }
};

ScanToMap::ScanToMap(const ScanToMapConfig& config) : state_(std::make_unique<State>()) {
  config.Validate();
  state_->config = config;
}

ScanToMap::~ScanToMap() = default;
ScanToMap::ScanToMap(ScanToMap&&) noexcept = default;
ScanToMap& ScanToMap::operator=(ScanToMap&&) noexcept = default;

bool ScanToMap::empty() const { return state_->cells.empty(); }

std::optional<MapRegistration> ScanToMap::Register(const std::vector<Eigen::Vector3f>& points,
                                                   const Eigen::Isometry3d& T_map_scan_guess) const {
  const State& s = *state_;
  const ScanToMapConfig& config = s.config;
  MapRegistration result;
  result.T_map_scan = T_map_scan_guess;
  std::vector<Plane> planes(points.size());
  // A surface is looked up again when its return has moved by more than this since.
  constexpr double kRefreshM = 0.02;
  bool settled = false;
  for (int iteration = 0; iteration < config.max_iterations && !settled; ++iteration) {
    const Eigen::Matrix3d R = result.T_map_scan.linear();
    // From wide to narrow, so that a guess some way off still finds its surfaces.
    const double reach = std::max(3.0 * config.noise_sigma_m,
                                  config.max_distance_m * std::pow(0.6, iteration));
    const double scale2 = reach * reach / 4.0;
    Matrix6d H = Matrix6d::Zero();
    Vector6d g = Vector6d::Zero();
    double sum_w = 0.0;
    double sum_wr2 = 0.0;
    int matches = 0;
    for (std::size_t i = 0; i < points.size(); ++i) {
      const Eigen::Vector3d p = points[i].cast<double>();
      const Eigen::Vector3d q = result.T_map_scan * p;
      Plane& plane = planes[i];
      if (iteration == 0 || (q - plane.seen_from).squaredNorm() > kRefreshM * kRefreshM) {
        plane = s.FindPlane(q);
      }
      if (!plane.valid) continue;
      const double r = plane.normal.dot(q - plane.point);
      if (std::abs(r) > config.max_distance_m) continue;
      // Geman-McClure: far from any surface it has no say.
      const double k = scale2 / (scale2 + r * r);
      const double w = k * k;
      const Eigen::Vector3d n = R.transpose() * plane.normal;
      Vector6d J;
      J << p.cross(n), n;
      H.selfadjointView<Eigen::Lower>().rankUpdate(J, w);
      g += w * r * J;
      sum_w += w;
      sum_wr2 += w * r * r;
      if (std::abs(r) < 3.0 * config.noise_sigma_m) ++matches;
    }
    if (matches < config.min_matches) {
      if (iteration >= 3 || sum_w < config.min_matches) return std::nullopt;
    }
    H = H.selfadjointView<Eigen::Lower>();
    const double variance = std::max(config.noise_sigma_m * config.noise_sigma_m,
                                     sum_wr2 / std::max(sum_w, 1.0));
    result.matches = matches;
    result.rms_m = std::sqrt(sum_wr2 / std::max(sum_w, 1.0));
    result.information = H / (variance * config.correlation_points);
    // Directions without information keep the guess: a weak prior holds them.
    Matrix6d damped = result.information;
    damped.diagonal().head<3>().array() += 1.0 / (0.2 * 0.2);
    damped.diagonal().tail<3>().array() += 1.0;
    const Vector6d step = -damped.ldlt().solve(g / (variance * config.correlation_points));
    if (!step.allFinite()) return std::nullopt;
    result.T_map_scan = NormalizedSe3(result.T_map_scan * ExpSe3(step));
    settled = reach <= 3.0 * config.noise_sigma_m + 1e-9 &&
              step.head<3>().norm() < config.converged_rad &&
              step.tail<3>().norm() < config.converged_m;
  }
  if (result.matches < config.min_matches) return std::nullopt;
  return result;
}

void ScanToMap::Add(const std::vector<Eigen::Vector3f>& points, const Eigen::Isometry3d& T_map_scan) {
  State& s = *state_;
  const ScanToMapConfig& config = s.config;
  const float spacing2 = static_cast<float>(config.point_spacing_m * config.point_spacing_m);
  for (const Eigen::Vector3f& point : points) {
    const Eigen::Vector3d p = T_map_scan * point.cast<double>();
    if (!p.allFinite() || p.cwiseAbs().maxCoeff() > 1e5) continue;
    std::vector<Eigen::Vector3f>& cell = s.cells[Key(s.CellOf(p))];
    if (static_cast<int>(cell.size()) >= config.max_points_per_voxel) continue;
    const Eigen::Vector3f q = p.cast<float>();
    const bool crowded = std::any_of(cell.begin(), cell.end(), [&](const Eigen::Vector3f& other) {
      return (other - q).squaredNorm() < spacing2;
    });
    if (!crowded) cell.push_back(q);
  }
  if ((T_map_scan.translation() - s.pruned_at).norm() > 0.25 * config.max_range_m) {
    s.pruned_at = T_map_scan.translation();
    for (auto cell = s.cells.begin(); cell != s.cells.end();) {
      const bool far = cell->second.empty() ||
                       (cell->second.front().cast<double>() - s.pruned_at).norm() > config.max_range_m;
      cell = far ? s.cells.erase(cell) : std::next(cell);
    }
  }
}

}  // namespace dendro
