#include "cylinder_information.h"

#include <algorithm>
#include <cmath>

#include <Eigen/Geometry>

namespace dendro {
namespace {

constexpr int kRowsOfBeam = 9;
constexpr int kRaysOfRow = 24;

double NormalCdf(double x) { return 0.5 * std::erfc(-x * 0.7071067811865476); }

}  // namespace

BeamExpectation ExpectBeam(const Cylinder& cylinder,
                           const Eigen::Vector3d& origin,
                           const Eigen::Vector3d& direction,
                           const LidarSimulatorConfig& lidar) {
  const Eigen::Vector3d left = Eigen::Vector3d::UnitZ().cross(direction).normalized();
  const Eigen::Vector3d up = direction.cross(left);
  const Eigen::Vector3d& a = cylinder.axis;
  const double r = cylinder.radius();
  const double on = lidar.enable_footprint ? 1.0 : 0.0;
  struct Ray {
    Eigen::Vector3d origin, direction;
  };
  const auto ray_at = [&](double x, double y) {
    return Ray{origin + on * (x * lidar.aperture_width_m * left + y * lidar.aperture_height_m * up),
               (direction + on * (x * lidar.divergence_width_rad * left +
                                  y * lidar.divergence_height_rad * up))
                   .normalized()};
  };
  // Signed distance of a ray's line from the axis; nearly linear across the beam.
  const auto offset = [&](const Ray& ray) {
    const Eigen::Vector3d n = a.cross(ray.direction);
    return (ray.origin - cylinder.point).dot(n) / n.norm();
  };
  BeamExpectation out;
  double energy = 0.0, sum = 0.0;
  for (int j = 0; j < kRowsOfBeam; ++j) {
    const double y = (j + 0.5) / kRowsOfBeam - 0.5;
    const double first = offset(ray_at(-0.5, y)), last = offset(ray_at(0.5, y));
    // The stretch of the row, in [0, 1], between the silhouettes.
    double from = 0.0, to = 1.0;
    if (std::abs(last - first) > 1e-9) {
      const double at_minus = (-r - first) / (last - first), at_plus = (r - first) / (last - first);
      from = std::clamp(std::min(at_minus, at_plus), 0.0, 1.0);
      to = std::clamp(std::max(at_minus, at_plus), 0.0, 1.0);
    } else if (std::abs(first) > r) {
      continue;
    }
    if (!(to > from)) continue;
    out.part += (to - from) / kRowsOfBeam;
    for (int i = 0; i < kRaysOfRow; ++i) {
      const Ray ray = ray_at(from + (to - from) * (i + 0.5) / kRaysOfRow - 0.5, y);
      const Eigen::Vector3d v = ray.origin - cylinder.point;
      const double ds = ray.direction.dot(a), vs = v.dot(a);
      const double A = 1.0 - ds * ds, B = v.dot(ray.direction) - vs * ds;
      const double C = v.squaredNorm() - vs * vs - r * r;
      const double root = std::sqrt(std::max(0.0, B * B - A * C));
      // The cosine of incidence is root / r.
      const double weight = (to - from) * root;
      energy += weight;
      sum += weight * (-B - root) / A;
    }
  }
  if (energy > 0.0) out.range_m = sum / energy;
  return out;
}

Matrix5d CylinderInformation(const RangeImage& image,
                             const Cylinder& truth,
                             double half_length_m,
                             const LidarSimulatorConfig& lidar,
                             double range_sigma_m) {
  const Eigen::Vector3d view = truth.point - truth.point.dot(truth.axis) * truth.axis;
  const Eigen::Vector3d e_view = view.normalized();
  const Eigen::Vector3d e_side = truth.axis.cross(e_view);
  const auto moved = [&](int k, double step) {
    Cylinder c = truth;
    if (k < 2) {
      c.axis = Eigen::AngleAxisd(step, k == 0 ? e_side : e_view) * truth.axis;
    } else if (k < 4) {
      c.point += step * (k == 2 ? e_side : e_view);
    } else {
      c.curvature = 1.0 / (truth.radius() + step);
    }
    return c;
  };
  constexpr double kStep = 2e-5;
  Matrix5d information = Matrix5d::Zero();
  for (std::size_t i = 0; i < image.size(); ++i) {
    const Eigen::Vector3d o = image.beam_origin[i].cast<double>();
    const Eigen::Vector3d d = image.beam_direction[i].cast<double>();
    const Eigen::Vector3d n = truth.axis.cross(d);
    if (d.dot(view) <= 0.0 || n.norm() < 1e-3) continue;
    const double range = view.norm() / d.dot(e_view);
    const double reach = 0.5 * (lidar.aperture_width_m + lidar.aperture_height_m) +
                         range * (lidar.divergence_width_rad + lidar.divergence_height_rad);
    if (std::abs((o - truth.point).dot(n) / n.norm()) > truth.radius() + reach) continue;
    if (std::abs((o + range * d - truth.point).dot(truth.axis)) > half_length_m) continue;
    const BeamExpectation at = ExpectBeam(truth, o, d, lidar);
    if (!(at.part > 0.2 * lidar.detection_fraction)) continue;
    Vector5d d_part, d_range;
    for (int k = 0; k < 5; ++k) {
      const BeamExpectation plus = ExpectBeam(moved(k, kStep), o, d, lidar);
      const BeamExpectation minus = ExpectBeam(moved(k, -kStep), o, d, lidar);
      d_part[k] = (plus.part - minus.part) / (2.0 * kStep);
      d_range[k] = (plus.range_m - minus.range_m) / (2.0 * kStep);
    }
    const double z = std::log(at.part / lidar.detection_fraction) / lidar.detection_softness;
    const double p = std::clamp(NormalCdf(z), 1e-12, 1.0 - 1e-12);
    const double density = 0.3989422804014327 * std::exp(-0.5 * z * z);
    const Vector5d d_p = density / (at.part * lidar.detection_softness) * d_part;
    information += d_p * d_p.transpose() / (p * (1.0 - p));
    information += p / (range_sigma_m * range_sigma_m) * d_range * d_range.transpose();
  }
  return information;
}

}  // namespace dendro
