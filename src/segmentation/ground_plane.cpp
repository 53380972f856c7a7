#include "dendro_slam/segmentation/ground_plane.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <random>
#include <stdexcept>
#include <vector>

#include <Eigen/Dense>

namespace dendro {
namespace {

constexpr std::size_t kMaxSamples = 3000;
constexpr float kBelowFactor = 3.0F;  // A return this many half thicknesses under is "below".
// The axis of a lidar is more often near the vertical than not; of two planes that explain the scan
// about equally well (ground and wall), this prefers the one across the axis.
constexpr float kUprightBonus = 0.5F;

struct Score {
  float inliers = 0.0F;
  float below = 0.0F;
};

// The returns looked at, coordinate by coordinate: hundreds of planes are tried on all of them. Filled
// up to whole blocks with returns of no weight.
struct Sample {
  static constexpr std::size_t kBlock = 8;
  std::vector<float> x, y, z, weight;

  void Add(const Eigen::Vector3f& p, float w) {
    x.push_back(p.x());
    y.push_back(p.y());
    z.push_back(p.z());
    weight.push_back(w);
  }
  void FillUp() {
    while (x.size() % kBlock != 0) Add(Eigen::Vector3f::Zero(), 0.0F);
  }
  Eigen::Vector3f Point(std::size_t i) const { return {x[i], y[i], z[i]}; }
};

Score Evaluate(const GroundPlane& plane, const Sample& sample, float distance) {
  // Written with vectors (of the compiler's) because the compiler does not find them by itself here.
  using Vector = float __attribute__((vector_size(16)));
  constexpr std::size_t kLanes = sizeof(Vector) / sizeof(float);
  constexpr std::size_t kVectors = Sample::kBlock / kLanes;
  Vector inliers[kVectors] = {};
  Vector below[kVectors] = {};
  const float nx = plane.normal.x();
  const float ny = plane.normal.y();
  const float nz = plane.normal.z();
  const auto load = [](const std::vector<float>& from, std::size_t i) {
    Vector v;
    std::memcpy(&v, from.data() + i, sizeof(v));
    return v;
  };
  for (std::size_t i = 0; i < sample.x.size(); i += Sample::kBlock) {
    for (std::size_t v = 0; v < kVectors; ++v) {
      const std::size_t k = i + v * kLanes;
      const Vector weight = load(sample.weight, k);
      const Vector height = nx * load(sample.x, k) + ny * load(sample.y, k) +
                            nz * load(sample.z, k) + plane.offset;
      inliers[v] += ((height <= distance) & (height >= -distance)) ? weight : Vector{};
      below[v] += height < -kBelowFactor * distance ? weight : Vector{};
    }
  }
  Score score;
  for (std::size_t v = 0; v < kVectors; ++v) {
    for (std::size_t k = 0; k < kLanes; ++k) {
      score.inliers += inliers[v][k];
      score.below += below[v][k];
    }
  }
  return score;
}

}  // namespace

void GroundPlaneConfig::Validate() const {
  if (hypotheses < 1) throw std::invalid_argument("hypotheses must be >= 1");
  if (!(inlier_distance_m > 0.0)) throw std::invalid_argument("inlier_distance_m must be > 0");
  if (!(max_range_m > 0.0)) throw std::invalid_argument("max_range_m must be > 0");
  if (!(far_range_m >= 0.0)) throw std::invalid_argument("far_range_m must be >= 0");
  if (!(min_inlier_ratio > 0.0 && min_inlier_ratio < 1.0)) {
    throw std::invalid_argument("min_inlier_ratio must be in (0, 1)");
  }
  if (!(min_column_ratio >= 0.0 && min_column_ratio < 1.0)) {
    throw std::invalid_argument("min_column_ratio must be in [0, 1)");
  }
  if (!(max_below_ratio >= 0.0 && max_below_ratio < 1.0)) {
    throw std::invalid_argument("max_below_ratio must be in [0, 1)");
  }
}

namespace {

std::optional<GroundPlane> EstimateWithin(const RangeImage& image,
                                          const GroundPlaneConfig& config,
                                          float max_range) {
  std::vector<std::size_t> pixels;
  pixels.reserve(image.size());
  // From the reference column on, so that the samples do not depend on where azimuth 0 lies.
  const int reference = ReferenceColumn(image);
  for (int row = 0; row < image.rows; ++row) {
    for (int k = 0; k < image.cols; ++k) {
      const std::size_t i = image.Index(row, image.WrapColumn(reference + k));
      if (image.HasReturn(i) && image.range[i] <= max_range && image.point[i].allFinite()) {
        pixels.push_back(i);
      }
    }
  }
  if (pixels.size() < 30) return std::nullopt;

  // Every k-th return, with k odd so that no row is systematically favoured.
  std::size_t step = pixels.size() / kMaxSamples + 1;
  if (step % 2 == 0) ++step;
  Sample sample;
  float total = 0.0F;
  for (std::size_t i = 0; i < pixels.size(); i += step) {
    sample.Add(image.point[pixels[i]], image.range[pixels[i]]);
    total += image.range[pixels[i]];
  }
  const std::size_t sampled = sample.x.size();
  sample.FillUp();
  const float distance = static_cast<float>(config.inlier_distance_m);

  std::mt19937 rng(20240531U);
  const auto draw = [&rng](std::size_t n) { return static_cast<std::size_t>(rng()) % n; };
  const auto nearby = [&](std::size_t pixel) -> std::optional<std::size_t> {
    const int row = static_cast<int>(pixel) / image.cols;
    const int col = static_cast<int>(pixel) % image.cols;
    const int reach = std::max(2, image.cols / 6);
    for (int attempt = 0; attempt < 4; ++attempt) {
      const int r = row + static_cast<int>(draw(7)) - 3;
      const int c = col + static_cast<int>(draw(static_cast<std::size_t>(2 * reach))) - reach;
      if (r < 0 || r >= image.rows) continue;
      const std::size_t other = image.Index(r, image.WrapColumn(c));
      if (other != pixel && image.HasReturn(other) && image.range[other] <= max_range) return other;
    }
    return std::nullopt;
  };

  std::optional<GroundPlane> best;
  float best_score = 0.0F;
  for (int h = 0; h < config.hypotheses; ++h) {
    const std::size_t first = pixels[draw(pixels.size())];
    std::size_t second = pixels[draw(pixels.size())];
    std::size_t third = pixels[draw(pixels.size())];
    if (h % 4 != 0) {  // Most triples from one neighbourhood: likelier to be on one surface.
      const auto a = nearby(first);
      const auto b = nearby(first);
      if (!a || !b) continue;
      second = *a;
      third = *b;
    }
    const Eigen::Vector3f edge_a = image.point[second] - image.point[first];
    const Eigen::Vector3f edge_b = image.point[third] - image.point[first];
    const Eigen::Vector3f cross = edge_a.cross(edge_b);
    const float area = cross.norm();
    if (!(area > 0.05F) || !(area > 0.05F * edge_a.norm() * edge_b.norm())) continue;
    GroundPlane plane;
    plane.normal = cross / area;
    plane.offset = -plane.normal.dot(image.point[first]);
    if (plane.offset < 0.0F) {  // The sensor is above the ground.
      plane.normal = -plane.normal;
      plane.offset = -plane.offset;
    }
    if (plane.offset < 0.1F) continue;
    const Score score = Evaluate(plane, sample, distance);
    if (score.below > static_cast<float>(config.max_below_ratio) * total) continue;
    const float value = (score.inliers - 2.0F * score.below) *
                        (1.0F + kUprightBonus * std::abs(plane.normal.z()));
    if (value > best_score) {
      best_score = value;
      best = plane;
    }
  }
  if (!best) return std::nullopt;

  for (int iteration = 0; iteration < 3; ++iteration) {
    Eigen::Vector3d mean = Eigen::Vector3d::Zero();
    Eigen::Matrix3d second_moment = Eigen::Matrix3d::Zero();
    double n = 0.0;
    for (std::size_t i = 0; i < sampled; ++i) {
      const Eigen::Vector3f p = sample.Point(i);
      if (std::abs(best->Height(p)) > distance) continue;
      const Eigen::Vector3d q = p.cast<double>();
      mean += q;
      second_moment += q * q.transpose();
      n += 1.0;
    }
    if (n < 10.0) return std::nullopt;
    mean /= n;
    const Eigen::Matrix3d covariance = second_moment / n - mean * mean.transpose();
    const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solver(covariance);
    Eigen::Vector3d normal = solver.eigenvectors().col(0);
    // Returns along one line do not make a plane.
    if (solver.eigenvalues()(1) < 0.05) return std::nullopt;
    if (normal.dot(best->normal.cast<double>()) < 0.0) normal = -normal;
    best->normal = normal.cast<float>();
    best->offset = static_cast<float>(-normal.dot(mean));
  }
  // A plane laid through a few stems meets only their columns; the ground is seen all around.
  std::vector<char> seen(static_cast<std::size_t>(image.cols), 0);
  for (const std::size_t pixel : pixels) {
    if (std::abs(best->Height(image.point[pixel])) <= distance) {
      seen[pixel % static_cast<std::size_t>(image.cols)] = 1;
    }
  }
  const auto columns = std::count(seen.begin(), seen.end(), 1);
  if (static_cast<double>(columns) < config.min_column_ratio * image.cols) return std::nullopt;

  const Score score = Evaluate(*best, sample, distance);
  if (best->offset < 0.1F ||
      score.inliers < static_cast<float>(config.min_inlier_ratio) * total ||
      score.below > static_cast<float>(config.max_below_ratio) * total) {
    return std::nullopt;
  }
  return best;
}

}  // namespace

std::optional<GroundPlane> EstimateGroundPlane(const RangeImage& image,
                                               const GroundPlaneConfig& config) {
  const auto near = EstimateWithin(image, config, static_cast<float>(config.max_range_m));
  if (near || config.far_range_m <= config.max_range_m) return near;
  return EstimateWithin(image, config, static_cast<float>(config.far_range_m));
}

namespace {

std::optional<GroundPlane> FitGroundPlaneWithin(const LabelledScan& scan, double max_range_m) {
  constexpr int kMinReturns = 100;
  constexpr double kMaxScatter = 0.15;   // [m]
  constexpr double kMinExtent = 0.5;     // Across the narrower direction, standard deviation [m].
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  Eigen::Matrix3d squares = Eigen::Matrix3d::Zero();
  int count = 0;
  for (std::size_t i = 0; i < scan.image.size(); ++i) {
    if (scan.label[i] != Label::kGround || !(scan.image.range[i] <= max_range_m)) continue;
    const Eigen::Vector3d p = scan.image.point[i].cast<double>();
    sum += p;
    squares += p * p.transpose();
    ++count;
  }
  if (count < kMinReturns) return std::nullopt;
  const Eigen::Vector3d mean = sum / count;
  const Eigen::Matrix3d covariance = squares / count - mean * mean.transpose();
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(covariance);
  const Eigen::Vector3d variance = eigen.eigenvalues();
  if (!(variance[0] <= kMaxScatter * kMaxScatter) || !(variance[1] >= kMinExtent * kMinExtent)) {
    return std::nullopt;
  }
  Eigen::Vector3d normal = eigen.eigenvectors().col(0);
  if (normal.dot(mean) > 0.0) normal = -normal;  // Up is where the sensor is.
  GroundPlane plane;
  plane.normal = normal.cast<float>();
  plane.offset = static_cast<float>(-normal.dot(mean));
  if (!(plane.offset > 0.1F)) return std::nullopt;
  return plane;
}

}  // namespace

std::optional<GroundPlane> FitGroundPlane(const LabelledScan& scan, double max_range_m) {
  constexpr double kFarFactor = 4.0;
  const auto near = FitGroundPlaneWithin(scan, max_range_m);
  return near ? near : FitGroundPlaneWithin(scan, kFarFactor * max_range_m);
}

}  // namespace dendro
