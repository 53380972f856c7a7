#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>
#include <vector>

#include "dendro_slam/range_image/range_image.h"

namespace dendro::test {

/// A vertical cylinder that stands on the ground.
struct Stem {
  double x, y, radius;
  double height;  ///< Above the ground [m].
};

struct SyntheticScan {
  RangeImage image;
  std::vector<Label> truth;
};

/// An image of the given size without a single return.
inline RangeImage EmptyImage(int rows, int cols) {
  RangeImage image;
  image.rows = rows;
  image.cols = cols;
  const std::size_t n = static_cast<std::size_t>(rows * cols);
  const float nan = std::numeric_limits<float>::quiet_NaN();
  image.point.assign(n, Eigen::Vector3f::Constant(nan));
  image.range.assign(n, nan);
  image.intensity.assign(n, 0.0F);
  image.time_s.assign(n, 0.0F);
  image.beam_origin.assign(n, Eigen::Vector3f::Zero());
  image.beam_direction.assign(n, Eigen::Vector3f::UnitX());
  image.point_index.assign(n, -1);
  for (int r = 0; r < rows; ++r) {
    const double elevation = (-15.0 + 30.0 * r / std::max(1, rows - 1)) * M_PI / 180.0;
    for (int c = 0; c < cols; ++c) {
      const double azimuth = -2.0 * M_PI * (c + 0.5) / cols;
      image.beam_direction[image.Index(r, c)] =
          Eigen::Vector3d(std::cos(elevation) * std::cos(azimuth),
                          std::cos(elevation) * std::sin(azimuth), std::sin(elevation))
              .cast<float>();
    }
  }
  return image;
}

/// Thin rays from a sensor at `height_m` above a plane, turned by `R_map_lidar`, to stems and ground.
inline SyntheticScan MakeScan(const std::vector<Stem>& stems,
                              double height_m,
                              double sigma_m,
                              unsigned seed,
                              const Eigen::Matrix3d& R_map_lidar = Eigen::Matrix3d::Identity(),
                              int rows = 16,
                              int cols = 1800) {
  SyntheticScan scan;
  scan.image = EmptyImage(rows, cols);
  RangeImage& image = scan.image;
  scan.truth.assign(image.size(), Label::kNone);
  std::mt19937 rng(seed);
  std::normal_distribution<double> noise(0.0, sigma_m);
  for (std::size_t i = 0; i < image.size(); ++i) {
    const Eigen::Vector3d d = R_map_lidar * image.beam_direction[i].cast<double>();
    double best = 100.0;
    Label label = Label::kNone;
    if (d.z() < 0.0 && -height_m / d.z() < best) {
      best = -height_m / d.z();
      label = Label::kGround;
    }
    for (const Stem& stem : stems) {
      const double a = d.x() * d.x() + d.y() * d.y();
      const double b = d.x() * stem.x + d.y() * stem.y;
      const double c = stem.x * stem.x + stem.y * stem.y - stem.radius * stem.radius;
      const double disc = b * b - a * c;
      if (disc < 0.0 || a == 0.0) continue;
      const double t = (b - std::sqrt(disc)) / a;
      const double z = height_m + t * d.z();
      if (t > 0.5 && t < best && z >= 0.0 && z <= stem.height) {
        best = t;
        label = Label::kWood;
      }
    }
    if (label == Label::kNone) continue;
    const double range = best + noise(rng);
    image.range[i] = static_cast<float>(range);
    image.point[i] = image.beam_direction[i] * static_cast<float>(range);
    image.intensity[i] = label == Label::kWood ? 40.0F : 25.0F;
    image.point_index[i] = static_cast<std::int32_t>(image.pixel_of_point.size());
    image.pixel_of_point.push_back(static_cast<std::int32_t>(i));
    scan.truth[i] = label;
  }
  return scan;
}

/// Intersection over union of wood.
inline double WoodIou(const std::vector<Label>& labels, const std::vector<Label>& truth) {
  std::size_t both = 0;
  std::size_t either = 0;
  for (std::size_t i = 0; i < truth.size(); ++i) {
    const bool a = labels[i] == Label::kWood;
    const bool b = truth[i] == Label::kWood;
    both += a && b;
    either += a || b;
  }
  return either == 0 ? 1.0 : static_cast<double>(both) / static_cast<double>(either);
}

/// Part of the returns whose label is right.
inline double Accuracy(const std::vector<Label>& labels, const std::vector<Label>& truth) {
  std::size_t right = 0;
  std::size_t total = 0;
  for (std::size_t i = 0; i < truth.size(); ++i) {
    if (truth[i] == Label::kNone) continue;
    ++total;
    right += labels[i] == truth[i];
  }
  return total == 0 ? 1.0 : static_cast<double>(right) / static_cast<double>(total);
}

/// The image turned by k columns: its column c is the original's column c + k.
inline RangeImage Rolled(const RangeImage& image, int k) {
  RangeImage out = image;
  for (int r = 0; r < image.rows; ++r) {
    for (int c = 0; c < image.cols; ++c) {
      const std::size_t to = image.Index(r, c);
      const std::size_t from = image.Index(r, image.WrapColumn(c + k));
      // The sensor turned with the columns: the geometry keeps its place relative to them.
      const double turn = 2.0 * M_PI * k / image.cols;
      const Eigen::Matrix3f rotation =
          Eigen::AngleAxisf(static_cast<float>(turn), Eigen::Vector3f::UnitZ()).toRotationMatrix();
      out.point[to] = rotation * image.point[from];
      out.range[to] = image.range[from];
      out.intensity[to] = image.intensity[from];
      out.time_s[to] = image.time_s[from];
      out.beam_direction[to] = rotation * image.beam_direction[from];
      out.point_index[to] = image.point_index[from];
    }
  }
  for (std::size_t i = 0; i < out.size(); ++i) {
    if (out.point_index[i] >= 0) {
      out.pixel_of_point[static_cast<std::size_t>(out.point_index[i])] =
          static_cast<std::int32_t>(i);
    }
  }
  return out;
}

}  // namespace dendro::test
