#include "dendro_slam/segmentation/geometric_wood.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <stdexcept>

#include <Eigen/Dense>

namespace dendro {
namespace {

constexpr double kPi = 3.14159265358979323846;
constexpr float kRiseHeight = 0.5F;  // Mean height of what may still be a rise of the ground [m].
constexpr int kGridHalf = 32;  // Cells on each side of the sensor in the local ground grid.

// Neighbouring columns of one row without a step in range between them.
struct Run {
  int row = 0;
  int first_col = 0;  // May exceed cols - 1 - length: columns wrap.
  int length = 0;
  float mean_range = 0.0F;
  float width = 0.0F;      // Across the beam [m].
  float roughness = 0.0F;  // RMS of the range about a parabola over azimuth [m].
  Eigen::Vector3f centre = Eigen::Vector3f::Zero();
};

class DisjointSets {
 public:
  explicit DisjointSets(std::size_t n) : parent_(n) {
    std::iota(parent_.begin(), parent_.end(), std::size_t{0});
  }
  std::size_t Find(std::size_t i) {
    while (parent_[i] != i) {
      parent_[i] = parent_[parent_[i]];
      i = parent_[i];
    }
    return i;
  }
  // The smaller index becomes the root, so the result does not depend on the order of calls.
  void Join(std::size_t a, std::size_t b) {
    a = Find(a);
    b = Find(b);
    if (a != b) parent_[std::max(a, b)] = std::min(a, b);
  }

 private:
  std::vector<std::size_t> parent_;
};

// RMS of the residuals of a parabola through the ranges; 0 for fewer than five.
float Roughness(const RangeImage& image, const Run& run) {
  if (run.length < 5) return 0.0F;
  Eigen::Matrix3d normal = Eigen::Matrix3d::Zero();
  Eigen::Vector3d rhs = Eigen::Vector3d::Zero();
  const double half = 0.5 * (run.length - 1);
  const auto range_at = [&](int k) {
    return static_cast<double>(
               image.range[image.Index(run.row, image.WrapColumn(run.first_col + k))]) -
           static_cast<double>(run.mean_range);
  };
  for (int k = 0; k < run.length; ++k) {
    const double t = (k - half) / half;
    const Eigen::Vector3d basis(1.0, t, t * t);
    normal += basis * basis.transpose();
    rhs += basis * range_at(k);
  }
  const Eigen::Vector3d coefficients = normal.ldlt().solve(rhs);
  // The outermost returns of a run are mixed with what is behind; they say nothing about leaves.
  double sum = 0.0;
  int count = 0;
  for (int k = 1; k + 1 < run.length; ++k) {
    const double t = (k - half) / half;
    const double e = range_at(k) - coefficients.dot(Eigen::Vector3d(1.0, t, t * t));
    sum += e * e;
    ++count;
  }
  return static_cast<float>(std::sqrt(sum / count));
}

// Marks what lies on the ground: within the tolerance of the lowest return of its cell.
void LabelGround(const RangeImage& image,
                 const GroundPlane& ground,
                 const GeometricWoodConfig& config,
                 std::vector<Label>* labels) {
  const Eigen::Vector3f u = (std::abs(ground.normal.x()) < 0.9F ? Eigen::Vector3f::UnitX()
                                                               : Eigen::Vector3f::UnitY())
                                .cross(ground.normal)
                                .normalized();
  const Eigen::Vector3f v = ground.normal.cross(u);
  const float cell = static_cast<float>(config.ground_cell_m);
  const int side = 2 * kGridHalf + 1;
  const auto cell_of = [&](const Eigen::Vector3f& p) {
    const int a = static_cast<int>(std::floor(std::clamp(
                      u.dot(p) / cell + 0.5F, static_cast<float>(-kGridHalf),
                      static_cast<float>(kGridHalf)))) + kGridHalf;
    const int b = static_cast<int>(std::floor(std::clamp(
                      v.dot(p) / cell + 0.5F, static_cast<float>(-kGridHalf),
                      static_cast<float>(kGridHalf)))) + kGridHalf;
    return static_cast<std::size_t>(a * side + b);
  };
  constexpr float kNone = std::numeric_limits<float>::infinity();
  std::vector<float> lowest(static_cast<std::size_t>(side * side), kNone);
  for (std::size_t i = 0; i < image.size(); ++i) {
    if (!image.HasReturn(i)) continue;
    const float height = ground.Height(image.point[i]);
    // Terrain rises and falls about the plane, but a cell whose lowest return is far from it is
    // one where the ground is hidden.
    if (std::abs(height) > 0.5F) continue;
    float& entry = lowest[cell_of(image.point[i])];
    entry = std::min(entry, height);
  }
  const float tolerance = static_cast<float>(config.ground_tolerance_m);
  for (std::size_t i = 0; i < image.size(); ++i) {
    if (!image.HasReturn(i)) continue;
    const float height = ground.Height(image.point[i]);
    const float local = lowest[cell_of(image.point[i])];
    const float base = local == kNone ? 0.0F : local;
    // The plane's tilt error and what grazing beams miss grow with the range.
    const float slack = tolerance + 0.01F * image.range[i];
    if (height < std::max(base, -0.1F) + slack) (*labels)[i] = Label::kGround;
  }
}

std::vector<Run> FindRuns(const RangeImage& image,
                          const std::vector<Label>& labels,
                          const GeometricWoodConfig& config) {
  const float column_rad = static_cast<float>(2.0 * kPi / image.cols);
  const float jump = static_cast<float>(config.jump_m);
  const float jump_per_m = static_cast<float>(config.jump_per_m);
  const auto free = [&](std::size_t i) { return image.HasReturn(i) && labels[i] == Label::kNone; };
  std::vector<Run> runs;
  for (int row = 0; row < image.rows; ++row) {
    const auto joined = [&](int a, int b) {
      const std::size_t i = image.Index(row, image.WrapColumn(a));
      const std::size_t j = image.Index(row, image.WrapColumn(b));
      return free(i) && free(j) &&
             std::abs(image.range[i] - image.range[j]) <= jump + jump_per_m * image.range[i];
    };
    // Start behind a gap, so that no run is cut at column 0.
    int start = 0;
    while (start < image.cols && joined(start - 1, start)) ++start;
    if (start == image.cols) start = 0;
    for (int k = 0; k < image.cols;) {
      const int col = start + k;
      if (!free(image.Index(row, image.WrapColumn(col)))) {
        ++k;
        continue;
      }
      Run run;
      run.row = row;
      run.first_col = image.WrapColumn(col);
      run.length = 1;
      while (k + run.length < image.cols && joined(col + run.length - 1, col + run.length)) {
        ++run.length;
      }
      for (int m = 0; m < run.length; ++m) {
        const std::size_t i = image.Index(row, image.WrapColumn(col + m));
        run.mean_range += image.range[i];
        run.centre += image.point[i];
      }
      run.mean_range /= static_cast<float>(run.length);
      run.centre /= static_cast<float>(run.length);
      run.width = static_cast<float>(run.length) * column_rad * run.mean_range;
      run.roughness = Roughness(image, run);
      k += run.length;
      runs.push_back(run);
    }
  }
  return runs;
}

bool Overlap(const Run& a, const Run& b, int cols) {
  // Distance from the first column of a to that of b, the short way round.
  int shift = (b.first_col - a.first_col) % cols;
  if (shift < 0) shift += cols;
  return shift <= a.length || cols - shift <= b.length;
}

}  // namespace

void GeometricWoodConfig::Validate() const {
  if (!(ground_tolerance_m > 0.0)) throw std::invalid_argument("ground_tolerance_m must be > 0");
  if (!(ground_cell_m > 0.0)) throw std::invalid_argument("ground_cell_m must be > 0");
  if (!(jump_m > 0.0)) throw std::invalid_argument("jump_m must be > 0");
  if (!(jump_per_m >= 0.0)) throw std::invalid_argument("jump_per_m must be >= 0");
  if (!(max_width_m > 0.0)) throw std::invalid_argument("max_width_m must be > 0");
  if (!(max_roughness_m > 0.0)) throw std::invalid_argument("max_roughness_m must be > 0");
  if (!(min_elongation >= 1.0)) throw std::invalid_argument("min_elongation must be >= 1");
  if (min_group_points < 1) throw std::invalid_argument("min_group_points must be >= 1");
}

std::vector<Label> LabelGeometrically(const RangeImage& image,
                                      const std::optional<GroundPlane>& ground,
                                      const GeometricWoodConfig& config) {
  std::vector<Label> labels(image.size(), Label::kNone);
  if (image.rows == 0 || image.cols == 0) return labels;
  if (ground) LabelGround(image, *ground, config, &labels);
  const std::vector<Run> runs = FindRuns(image, labels, config);

  // Join runs of adjacent rows that look like one stem: they overlap, at about the same range, with
  // about the same width. Runs are sorted by row, then by column.
  std::vector<std::size_t> row_begin(static_cast<std::size_t>(image.rows) + 2, runs.size());
  for (std::size_t i = runs.size(); i-- > 0;) row_begin[static_cast<std::size_t>(runs[i].row)] = i;
  for (std::size_t r = static_cast<std::size_t>(image.rows); r-- > 0;) {
    row_begin[r] = std::min(row_begin[r], row_begin[r + 1]);
  }
  DisjointSets sets(runs.size());
  for (std::size_t r = 0; r + 1 < static_cast<std::size_t>(image.rows); ++r) {
    for (std::size_t i = row_begin[r]; i < row_begin[r + 1]; ++i) {
      for (std::size_t j = row_begin[r + 1]; j < row_begin[r + 2]; ++j) {
        const Run& a = runs[i];
        const Run& b = runs[j];
        const float thin = std::min(a.width, b.width);
        const float thick = std::max(a.width, b.width);
        if (Overlap(a, b, image.cols) && thick < 2.5F * thin + 0.06F &&
            std::abs(a.mean_range - b.mean_range) < 0.3F + 0.5F * thin) {
          sets.Join(i, j);
        }
      }
    }
  }

  struct Group {
    int points = 0;
    int runs = 0;
    float roughness = 0.0F;  // Weighted by length, of the runs long enough to tell.
    int rough_weight = 0;
    float width = 0.0F;   // Weighted by length.
    float height = 0.0F;  // Over the ground, weighted by length.
    Eigen::Vector3f low = Eigen::Vector3f::Constant(std::numeric_limits<float>::infinity());
    Eigen::Vector3f high = Eigen::Vector3f::Constant(-std::numeric_limits<float>::infinity());
  };
  std::vector<Group> groups(runs.size());
  for (std::size_t i = 0; i < runs.size(); ++i) {
    Group& group = groups[sets.Find(i)];
    const Run& run = runs[i];
    group.points += run.length;
    group.runs += 1;
    group.width += run.width * static_cast<float>(run.length);
    if (ground) group.height += ground->Height(run.centre) * static_cast<float>(run.length);
    if (run.length >= 5) {
      group.roughness += run.roughness * static_cast<float>(run.length);
      group.rough_weight += run.length;
    }
    for (int k = 0; k < run.length; ++k) {
      const std::size_t i_pixel = image.Index(run.row, image.WrapColumn(run.first_col + k));
      group.low = group.low.cwiseMin(image.point[i_pixel]);
      group.high = group.high.cwiseMax(image.point[i_pixel]);
    }
  }

  // First pass: groups that speak for themselves. Small ones are decided by the company they keep:
  // among many small groups they are foliage, in a bare crown they are twigs.
  std::vector<Label> verdict(runs.size(), Label::kNone);
  int small_points = 0;
  int free_points = 0;
  for (std::size_t g = 0; g < groups.size(); ++g) {
    Group& group = groups[g];
    if (group.points == 0) continue;
    free_points += group.points;
    group.width /= static_cast<float>(group.points);
    const float rough =
        group.rough_weight > 0 ? group.roughness / static_cast<float>(group.rough_weight) : 0.0F;
    const float length = (group.high - group.low).norm();
    if (group.points < config.min_group_points) {
      small_points += group.points;
    } else if (group.width > static_cast<float>(config.max_width_m) && group.runs > 1) {
      // Wide and low is a rise of the ground, wide and high a wall. A wall seen at a slant is far
      // from a parabola, so this comes before roughness.
      const bool low = ground && group.height / static_cast<float>(group.points) < kRiseHeight;
      verdict[g] = low ? Label::kGround : Label::kOther;
    } else if (rough > static_cast<float>(config.max_roughness_m)) {
      verdict[g] = Label::kLeaf;
    } else if (group.runs == 1 ||
               length >= static_cast<float>(config.min_elongation) * group.width) {
      verdict[g] = Label::kWood;
    } else {
      verdict[g] = Label::kOther;
    }
  }
  const Label small_label =
      2 * small_points > free_points ? Label::kLeaf : Label::kWood;
  for (std::size_t i = 0; i < runs.size(); ++i) {
    const std::size_t g = sets.Find(i);
    const Label label = verdict[g] == Label::kNone ? small_label : verdict[g];
    for (int k = 0; k < runs[i].length; ++k) {
      labels[image.Index(runs[i].row, image.WrapColumn(runs[i].first_col + k))] = label;
    }
  }
  return labels;
}

}  // namespace dendro
