#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <limits>
#include <vector>

#include <Eigen/Eigenvalues>

#include "dendro_slam/branch_separation/branch_separator.h"
#include "dendro_slam/cylinder_fitting/cylinder_fitter.h"

// Fuzz target: the input draws a scan; stages 2 and 3 have to keep their promises about it: segments
// are disjoint and hold what is wood, and a cylinder is either near its returns, with a covariance
// that is one, or UNRESOLVED with a reason.
//
// Input: records of 8 bytes, the first the kind (see Draw), the others its parameters. At most
// kMostRecords of them are used, so that no input is slow.

namespace {

using dendro::FitStatus;
using Eigen::Vector3d;

constexpr int kRows = 16, kCols = 240;
constexpr int kMostRecords = 12;
constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();

void Require(bool condition) {
  if (!condition) std::abort();
}

// Values that arithmetic goes wrong with, and some harmless ones.
float Special(std::uint8_t b) {
  constexpr float kInf = std::numeric_limits<float>::infinity();
  const float values[] = {kNaN, kInf, -kInf, 0.0F, -0.0F, 1e-30F, 1e-42F, 1e-4F, 1e3F, 1e7F, 1e30F,
                          std::numeric_limits<float>::max(), -1.0F, 1.0F, 4.0F, 0.05F};
  return values[b % 16];
}

dendro::LabelledScan Empty() {
  dendro::LabelledScan scan;
  dendro::RangeImage& image = scan.image;
  image.rows = kRows;
  image.cols = kCols;
  constexpr std::size_t kSize = kRows * kCols;
  image.point.assign(kSize, Eigen::Vector3f::Constant(kNaN));
  image.range.assign(kSize, kNaN);
  image.intensity.assign(kSize, 0.0F);
  image.time_s.assign(kSize, 0.0F);
  image.beam_origin.assign(kSize, Eigen::Vector3f::Zero());
  image.beam_direction.resize(kSize);
  image.point_index.assign(kSize, -1);
  scan.wood_probability.assign(kSize, 0.0F);
  scan.label.assign(kSize, dendro::Label::kNone);
  for (int row = 0; row < kRows; ++row) {
    for (int col = 0; col < kCols; ++col) {
      const double e = (-15.0 + 2.0 * row) * M_PI / 180.0, a = -2.0 * M_PI * col / kCols;
      image.beam_direction[image.Index(row, col)] =
          Vector3d(std::cos(e) * std::cos(a), std::cos(e) * std::sin(a), std::sin(e)).cast<float>();
    }
  }
  return scan;
}

void SetReturn(std::size_t pixel, double range, dendro::Label label, dendro::LabelledScan* scan) {
  dendro::RangeImage& image = scan->image;
  image.range[pixel] = static_cast<float>(range);
  image.point[pixel] =
      image.beam_origin[pixel] + static_cast<float>(range) * image.beam_direction[pixel];
  image.point_index[pixel] = static_cast<std::int32_t>(pixel);
  image.intensity[pixel] = 40.0F;
  scan->label[pixel] = label;
}

// One shape, or one thing that is wrong.
void Draw(const std::uint8_t* r, dendro::LabelledScan* scan) {
  dendro::RangeImage& image = scan->image;
  const auto part = [&](int i) { return r[i] / 255.0; };
  const auto label = r[0] & 0x80 ? dendro::Label::kLeaf : dendro::Label::kWood;
  const double azimuth = -2.0 * M_PI * part(1);
  const double distance = 0.3 + 12.0 * part(2) * part(2);
  const Vector3d centre(distance * std::cos(azimuth), distance * std::sin(azimuth),
                        4.0 * (part(3) - 0.5));
  const int col = r[1] * kCols / 256, row = r[3] % kRows;
  // A cheap noise that depends on nothing but the record and the pixel.
  const auto noise = [&](std::size_t pixel) {
    std::uint32_t x = static_cast<std::uint32_t>(pixel) * 2654435761U + r[7] * 40503U;
    x ^= x >> 15;
    x *= 2246822519U;
    x ^= x >> 13;
    return x / 4294967296.0 - 0.5;
  };
  const auto each = [&](auto range_of) {
    for (std::size_t i = 0; i < image.size(); ++i) {
      const double range = range_of(image.beam_direction[i].cast<double>(), i);
      if (range > 0.0) SetReturn(i, range + 0.03 * part(7) * noise(i), label, scan);
    }
  };
  switch (r[0] % 16) {
    case 0:
    case 1:
    case 2: {  // A cylinder, also thin, level or long.
      const double radius = 0.005 + part(4) * part(4);
      const Vector3d a = Vector3d(part(5) - 0.5, part(6) - 0.5, 0.3).normalized();
      const double half = 0.1 + 2.0 * part(7);
      each([&](const Vector3d& d, std::size_t) {
        const Vector3d v = -centre;
        const double ds = d.dot(a), vs = v.dot(a);
        const double A = 1.0 - ds * ds, B = v.dot(d) - vs * ds;
        const double C = v.squaredNorm() - vs * vs - radius * radius;
        const double disc = B * B - A * C;
        if (A < 1e-9 || disc <= 0.0) return 0.0;
        const double t = (-B - std::sqrt(disc)) / A;
        return std::abs(vs + t * ds) <= half ? t : 0.0;
      });
      return;
    }
    case 3:  // A sphere.
      each([&](const Vector3d& d, std::size_t) {
        const double radius = 0.02 + part(4);
        const double b = d.dot(centre);
        const double disc = b * b - centre.squaredNorm() + radius * radius;
        return disc > 0.0 ? b - std::sqrt(disc) : 0.0;
      });
      return;
    case 4: {  // A patch of a plane.
      const Vector3d n = Vector3d(part(4) - 0.5, part(5) - 0.5, part(6) - 0.3);
      each([&](const Vector3d& d, std::size_t) {
        const double t = n.dot(centre) / n.dot(d);
        return t > 0.0 && t < 30.0 && (t * d - centre).norm() < 0.2 + part(7) ? t : 0.0;
      });
      return;
    }
    case 5:  // A stretch of one ring.
      for (int c = 0; c <= r[4] / 4; ++c) {
        SetReturn(image.Index(row, image.WrapColumn(col + c)), distance + 0.01 * part(5) * c, label, scan);
      }
      return;
    case 6:  // One column, or a diagonal: collinear returns.
      for (int k = 0; k < kRows; ++k) {
        const std::size_t pixel = image.Index(k, image.WrapColumn(col + k * (r[4] % 5)));
        const auto d = image.beam_direction[pixel].cast<double>();
        SetReturn(pixel, distance / std::hypot(d.x(), d.y()), label, scan);
      }
      return;
    case 7:
    case 8:  // Returns at random ranges.
      for (int k = 0; k < kRows; ++k) {
        for (int c = 0; c < 2 + r[4] / 8; ++c) {
          const std::size_t pixel = image.Index(k, image.WrapColumn(col + c));
          if (noise(pixel) + 0.5 < part(5)) {
            SetReturn(pixel, distance + 4.0 * part(6) * (noise(pixel * 7 + 1) + 0.5), label, scan);
          }
        }
      }
      return;
    case 9:
      SetReturn(image.Index(row, col), Special(r[4]), label, scan);
      return;
    case 10:
      image.point[image.Index(row, col)] = {Special(r[4]), Special(r[5]), Special(r[6])};
      image.point_index[image.Index(row, col)] = 0;
      scan->label[image.Index(row, col)] = label;
      return;
    case 11:  // All of a patch in one place.
      for (int k = row; k < std::min(kRows, row + 8); ++k) {
        for (int c = 0; c < 8; ++c) {
          const std::size_t pixel = image.Index(k, image.WrapColumn(col + c));
          SetReturn(pixel, distance, label, scan);
          image.point[pixel] = centre.cast<float>();
        }
      }
      return;
    case 12:  // A beam that is none.
      for (int c = 0; c < 1 + r[7] % 8; ++c) {
        const std::size_t pixel = image.Index(row, image.WrapColumn(col + c));
        image.beam_direction[pixel] = {Special(r[4]), Special(r[5]), Special(r[6])};
      }
      return;
    case 13:
      for (int c = 0; c < 1 + r[7] % 8; ++c) {
        const std::size_t pixel = image.Index(row, image.WrapColumn(col + c));
        image.beam_origin[pixel] = {Special(r[4]), Special(r[5]), Special(r[6])};
      }
      return;
    case 14:
      for (int c = 0; c < 8; ++c) {
        const std::size_t pixel = image.Index(row, image.WrapColumn(col + c));
        image.intensity[pixel] = Special(r[4]);
        image.time_s[pixel] = Special(r[5]);
      }
      return;
    default:  // The sensor moved: every beam of a ring starts elsewhere.
      for (int c = 0; c < kCols; ++c) {
        image.beam_origin[image.Index(row, c)] = {static_cast<float>(0.2 * (part(4) - 0.5)),
                                                  static_cast<float>(0.2 * (part(5) - 0.5)), 0.0F};
      }
  }
}

void CheckSegments(const dendro::LabelledScan& scan, const std::vector<dendro::Segment>& segments) {
  std::vector<char> seen(scan.image.size(), 0);
  std::size_t held = 0;
  for (std::size_t k = 0; k < segments.size(); ++k) {
    Require(segments[k].id == static_cast<int>(k) && !segments[k].pixels.empty());
    std::int32_t last = -1;
    for (const std::int32_t pixel : segments[k].pixels) {
      Require(pixel > last && pixel < static_cast<std::int32_t>(scan.image.size()));
      last = pixel;
      const auto i = static_cast<std::size_t>(pixel);
      Require(!seen[i] && scan.IsWood(i) && scan.image.HasReturn(i));
      seen[i] = 1;
      ++held;
    }
  }
  std::size_t wood = 0;
  for (std::size_t i = 0; i < scan.image.size(); ++i) {
    wood += scan.IsWood(i) && scan.image.HasReturn(i) && scan.image.point[i].allFinite();
  }
  Require(held == wood);
}

void CheckFit(const dendro::LabelledScan& scan,
              const dendro::Segment& segment,
              const dendro::CylinderFitterConfig& config) {
  const dendro::CylinderFitter fitter(config);
  const dendro::FittedCylinder fit = fitter.FitSegment(scan, segment);
  const auto initial = fitter.Initial(scan, segment);
  if (initial) Require(initial->point.allFinite() && initial->axis.allFinite() && initial->radius() > 0.0);
  const dendro::Cylinder& c = fit.cylinder;
  Require(c.axis.allFinite() && c.point.allFinite() && std::abs(c.axis.norm() - 1.0) < 1e-6);
  Require(std::isfinite(c.curvature) && fit.covariance.allFinite());
  Require(fit.bend_information.allFinite() && fit.bend_vector.allFinite());
  Require(std::isfinite(fit.distance_m) && std::isfinite(fit.end_sigma_m) &&
          std::isfinite(fit.mean_abs_deviation_m) && std::isfinite(fit.taper_m_per_m) &&
          std::isfinite(fit.taper_sigma_m_per_m));
  Require(fit.start_s_m <= fit.end_s_m && std::isfinite(fit.end_s_m - fit.start_s_m));
  Require(fit.status != FitStatus::kInferred);
  if (fit.status == FitStatus::kUnresolved) {
    Require(fit.reason != dendro::UnresolvedReason::kNone);
    return;
  }
  Require(fit.reason == dendro::UnresolvedReason::kNone);
  Require(c.radius() >= config.min_radius_m && c.radius() <= config.max_radius_m);
  Require(fit.radius_sigma_m() > 0.0 &&
          fit.radius_sigma_m() <= config.max_radius_sigma_ratio * c.radius() + 0.5 * config.revolution_sigma_m);
  Require(Eigen::SelfAdjointEigenSolver<dendro::Matrix5d>(fit.covariance).eigenvalues().minCoeff() > -1e-9);
  Require(fit.num_points >= config.min_points && fit.num_rings >= (c.radius() <= config.twig_radius_m ? 2 : config.min_rings));
  Require(fit.visible_arc_rad <= M_PI + 1e-9);
  // As many returns near the surface as it says; a bent axis leaves the straight one.
  const double length = fit.end_s_m - fit.start_s_m;
  int near = 0;
  for (const std::int32_t pixel : segment.pixels) {
    const auto i = static_cast<std::size_t>(pixel);
    if (!scan.image.HasReturn(i) || !scan.image.point[i].allFinite()) continue;
    const Vector3d p = scan.image.point[i].cast<double>();
    near += std::abs(c.Distance(p)) < 0.15 + 0.15 * length * length;
  }
  Require(near >= fit.num_points);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  dendro::LabelledScan scan = Empty();
  const std::size_t records = std::min<std::size_t>(size / 8, kMostRecords);
  for (std::size_t k = 0; k < records; ++k) Draw(data + 8 * k, &scan);

  dendro::BranchSeparatorConfig separation;
  CheckSegments(scan, dendro::BranchSeparator(separation).Separate(scan));
  separation.thesis_mode = true;
  CheckSegments(scan, dendro::BranchSeparator(separation).Separate(scan));
  separation.thesis_mode = false;
  const auto segments = dendro::BranchSeparator(separation).Separate(scan);

  dendro::CylinderFitterConfig config;
  for (const dendro::Segment& segment : segments) CheckFit(scan, segment, config);
  // Whatever is wood as one segment, also what stage 2 leaves out; and the thesis' fit.
  dendro::Segment all;
  for (std::size_t i = 0; i < scan.image.size(); ++i) {
    if (scan.IsWood(i)) all.pixels.push_back(static_cast<std::int32_t>(i));
  }
  CheckFit(scan, all, config);
  config.marshall_only = true;
  CheckFit(scan, all, config);
  return 0;
}
