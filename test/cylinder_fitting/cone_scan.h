#pragma once

#include <cmath>
#include <limits>
#include <random>
#include <vector>

#include <Eigen/Core>

#include "dendro_slam/branch_separation/segment.h"
#include "dendro_slam/range_image/range_image.h"

/// A small generator of range images for the tests of stages 2 and 3, independent of the simulator:
/// truncated cones seen by 16 rings of rectangular beams, each integrated over sub-rays.
namespace dendro_test {

struct TestCone {
  Eigen::Vector3d base = Eigen::Vector3d::Zero();  // m
  Eigen::Vector3d tip = Eigen::Vector3d::UnitZ();  // m
  double base_radius = 0.1;                        // m
  double tip_radius = 0.1;                         // m
};

struct TestSensor {
  int cols = 1800;
  double sigma = 0.01;            // Range noise [m].
  double uniform = 0.0;           // Additional uniform noise, half-width [m].
  bool footprint = true;
  double detection = 0.2;
  double azimuth_offset_deg = 0.0;
  double dropout = 0.0;
  int across = 21, high = 7;      // Sub-rays.
};

struct TestScan {
  dendro::LabelledScan scan;
  std::vector<int> truth;  // Cone per pixel, or -1.
};

/// Range along a ray, or infinity, and the cosine of incidence.
inline double RayCone(const TestCone& cone,
                      const Eigen::Vector3d& origin,
                      const Eigen::Vector3d& direction,
                      double* cosine) {
  const Eigen::Vector3d span = cone.tip - cone.base;
  const double length = span.norm();
  const Eigen::Vector3d a = span / length;
  const double k = (cone.tip_radius - cone.base_radius) / length;
  const Eigen::Vector3d v = origin - cone.base;
  const double vs = v.dot(a), ds = direction.dot(a);
  const double r = cone.base_radius + k * vs;
  const double A = 1.0 - ds * ds - k * k * ds * ds;
  const double B = v.dot(direction) - vs * ds - k * ds * r;
  const double C = v.squaredNorm() - vs * vs - r * r;
  const double disc = B * B - A * C;
  if (A < 1e-12 || disc <= 0.0) return std::numeric_limits<double>::infinity();
  const double t = (-B - std::sqrt(disc)) / A;
  const double s = vs + t * ds;
  if (t <= 0.0 || s < 0.0 || s > length) return std::numeric_limits<double>::infinity();
  const Eigen::Vector3d p = v + t * direction;
  const Eigen::Vector3d normal = ((p - s * a).normalized() - k * a).normalized();
  *cosine = std::abs(normal.dot(direction));
  return t;
}

inline TestScan SimulateCones(const std::vector<TestCone>& cones,
                              const TestSensor& sensor,
                              unsigned seed) {
  std::mt19937 rng(seed);
  std::normal_distribution<double> gauss;
  std::uniform_real_distribution<double> unit(0.0, 1.0);
  TestScan out;
  dendro::RangeImage& image = out.scan.image;
  image.rows = 16;
  image.cols = sensor.cols;
  const std::size_t size = 16u * static_cast<std::size_t>(sensor.cols);
  const float nan = std::numeric_limits<float>::quiet_NaN();
  image.point.assign(size, Eigen::Vector3f::Constant(nan));
  image.range.assign(size, nan);
  image.intensity.assign(size, 0.0F);
  image.time_s.assign(size, 0.0F);
  image.beam_origin.assign(size, Eigen::Vector3f::Zero());
  image.beam_direction.assign(size, Eigen::Vector3f::UnitX());
  image.point_index.assign(size, -1);
  out.scan.wood_probability.assign(size, 0.0F);
  out.scan.label.assign(size, dendro::Label::kNone);
  out.truth.assign(size, -1);
  const int across = sensor.footprint ? sensor.across : 1;
  const int high = sensor.footprint ? sensor.high : 1;
  for (int row = 0; row < 16; ++row) {
    const double elevation = (-15.0 + 2.0 * row) * M_PI / 180.0;
    const int order = row < 8 ? 2 * row : 2 * row - 15;  // VLP-16 firing order by ring.
    for (int col = 0; col < sensor.cols; ++col) {
      const std::size_t pixel = image.Index(row, col);
      const double azimuth =
          ((col + order * 2.304 / 55.296) * 360.0 / sensor.cols + sensor.azimuth_offset_deg) *
          M_PI / 180.0;
      const Eigen::Vector3d d(std::cos(elevation) * std::cos(azimuth),
                              -std::cos(elevation) * std::sin(azimuth), std::sin(elevation));
      image.beam_direction[pixel] = d.cast<float>();
      bool near = false;  // Cheap rejection: only cones within a beam's reach are cast.
      for (const TestCone& cone : cones) {
        const Eigen::Vector3d m = 0.5 * (cone.base + cone.tip);
        const double reach = 0.5 * (cone.tip - cone.base).norm() + cone.base_radius + 0.1;
        near = near || (m.cross(d).norm() < reach && m.dot(d) > 0.0);
      }
      if (!near) continue;
      const Eigen::Vector3d h = Eigen::Vector3d::UnitZ().cross(d).normalized();
      const Eigen::Vector3d w = d.cross(h);
      std::vector<double> energy(cones.size(), 0.0), range(cones.size(), 0.0),
          share(cones.size(), 0.0);
      for (int i = 0; i < across; ++i) {
        for (int j = 0; j < high; ++j) {
          const double x = (i + 0.5) / across - 0.5, y = (j + 0.5) / high - 0.5;
          const double on = sensor.footprint ? 1.0 : 0.0;
          const Eigen::Vector3d origin = on * (x * 0.0095 * h + y * 0.0127 * w);
          const Eigen::Vector3d ray = (d + on * (x * 0.003 * h + y * 0.0015 * w)).normalized();
          double best = std::numeric_limits<double>::infinity(), cosine = 0.0;
          int which = -1;
          for (std::size_t c = 0; c < cones.size(); ++c) {
            double this_cosine = 0.0;
            const double t = RayCone(cones[c], origin, ray, &this_cosine);
            if (t < best) {
              best = t;
              cosine = this_cosine;
              which = static_cast<int>(c);
            }
          }
          if (which < 0) continue;
          const double e = (sensor.footprint ? cosine : 1.0) / (across * high);
          energy[static_cast<std::size_t>(which)] += e;
          share[static_cast<std::size_t>(which)] += 1.0 / (across * high);
          range[static_cast<std::size_t>(which)] += e * best;
        }
      }
      int best = -1;
      for (std::size_t c = 0; c < cones.size(); ++c) {
        if (energy[c] > 0.0 && (best < 0 || energy[c] > energy[static_cast<std::size_t>(best)])) {
          best = static_cast<int>(c);
        }
      }
      if (best < 0) continue;
      const auto b = static_cast<std::size_t>(best);
      if (sensor.footprint && share[b] < sensor.detection) continue;
      if (unit(rng) < sensor.dropout) continue;
      const double r = range[b] / energy[b] + sensor.sigma * gauss(rng) +
                       sensor.uniform * (2.0 * unit(rng) - 1.0);
      image.range[pixel] = static_cast<float>(r);
      image.point[pixel] = (r * d).cast<float>();
      image.intensity[pixel] = static_cast<float>(40.0 * energy[b]);
      image.point_index[pixel] = static_cast<std::int32_t>(pixel);
      out.scan.label[pixel] = dendro::Label::kWood;
      out.scan.wood_probability[pixel] = 1.0F;
      out.truth[pixel] = best;
    }
  }
  return out;
}

/// All pixels of one cone as a segment.
inline dendro::Segment SegmentOf(const TestScan& scan, int cone) {
  dendro::Segment segment;
  for (std::size_t i = 0; i < scan.truth.size(); ++i) {
    if (scan.truth[i] == cone) segment.pixels.push_back(static_cast<std::int32_t>(i));
  }
  return segment;
}

}  // namespace dendro_test
