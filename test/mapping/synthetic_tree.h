#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <optional>
#include <random>
#include <string>
#include <vector>

#include <Eigen/Cholesky>

#include "dendro_slam/mapping/mapper.h"

/// Fitted cylinders and odometry as a flight around a known tree would give them, with errors drawn
/// from the covariances that come with them.
namespace dendro_test {

using namespace dendro;

struct TrueBranch {
  Eigen::Vector3d from, to;
  double radius_from, radius_to;

  Eigen::Vector3d Axis() const { return (to - from).normalized(); }
  double Length() const { return (to - from).norm(); }
  double RadiusAt(double s) const {
    return radius_from + (radius_to - radius_from) * std::clamp(s / Length(), 0.0, 1.0);
  }
};

/// A tapering trunk and three branches.
inline std::vector<TrueBranch> ThesisLikeTree() {
  return {{{0, 0, 0}, {0.1, 0, 6}, 0.20, 0.12},
          {{0, 0, 2.0}, {1.8, 0.3, 3.1}, 0.08, 0.06},
          {{0, 0, 3.0}, {-1.1, 1.3, 3.9}, 0.07, 0.05},
          {{0, 0, 1.5}, {-0.6, -1.8, 2.1}, 0.06, 0.05}};
}

/// Circles around the z axis at a rising height, looking at the tree; z is up.
inline Eigen::Isometry3d CirclePose(double t, double radius, double speed, double z0, double climb) {
  const double angle = speed * t / radius;
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  T.translation() << radius * std::cos(angle), radius * std::sin(angle), z0 + climb * t;
  T.linear() = (Eigen::AngleAxisd(angle + M_PI, Eigen::Vector3d::UnitZ()) *
                Eigen::AngleAxisd(0.03 * std::sin(1.3 * t), Eigen::Vector3d::UnitY()))
                   .toRotationMatrix();
  return T;
}

class World {
 public:
  World(std::vector<TrueBranch> branches, unsigned seed) : branches_(std::move(branches)), rng_(seed) {}

  double Normal() { return normal_(rng_); }

  /// The stretch of a branch inside a VLP-16's field of view, as a fit with errors; nothing if too
  /// little is seen.
  std::optional<FittedCylinder> Observe(const TrueBranch& branch,
                                        const Eigen::Isometry3d& T_map_lidar,
                                        int segment_id) {
    const Eigen::Vector3d axis = branch.Axis();
    double s0 = 1e9, s1 = -1e9;
    for (double s = 0.0; s <= branch.Length(); s += 0.05) {
      const Eigen::Vector3d p = T_map_lidar.inverse() * (branch.from + s * axis);
      const double elevation = std::atan2(p.z(), p.head<2>().norm());
      if (std::abs(elevation) > 0.26 || p.norm() > 12.0) continue;
      s0 = std::min(s0, s);
      s1 = std::max(s1, s);
    }
    if (s1 - s0 < 0.3) return std::nullopt;
    const double middle = 0.5 * (s0 + s1), half = 0.5 * (s1 - s0);
    const double r = branch.RadiusAt(middle);
    Cylinder in_map{axis, branch.from + middle * axis, 1.0 / r};
    FittedCylinder fit;
    fit.segment_id = segment_id;
    fit.status = FitStatus::kMeasured;
    fit.cylinder = TransformCylinder(T_map_lidar.inverse(), in_map);
    if (segment_id % 2 == 1) fit.cylinder.axis = -fit.cylinder.axis;  // the sign has no meaning
    const double sign = segment_id % 2 == 1 ? -1.0 : 1.0;
    const Eigen::Vector3d p = fit.cylinder.point;
    fit.distance_m = p.norm();
    const auto B = PerpendicularBasis(fit.cylinder.axis);
    Eigen::Vector2d u = B.transpose() * p;
    u.normalize();
    const Eigen::Vector2d w(-u.y(), u.x());
    const double sr = 0.008 * fit.distance_m * r + 0.001;
    const double sd = 0.002, sl = 0.003, sa = 0.006 / half;
    Matrix5d C = Matrix5d::Zero();
    C.topLeftCorner<2, 2>() = sa * sa * Eigen::Matrix2d::Identity();
    C.block<2, 2>(2, 2) = u * u.transpose() * (sr * sr + sd * sd) + w * w.transpose() * sl * sl;
    C.block<2, 1>(2, 4) = -u * sr * sr / (r * r);
    C.block<1, 2>(4, 2) = C.block<2, 1>(2, 4).transpose();
    C(4, 4) = sr * sr / (r * r * r * r) * 1.0001;
    fit.covariance = C;
    Vector5d noise;
    for (int i = 0; i < 5; ++i) noise[i] = Normal();
    fit.cylinder = fit.cylinder.Retract(C.llt().matrixL() * noise);
    fit.taper_m_per_m = sign * (branch.radius_to - branch.radius_from) / branch.Length();
    fit.taper_sigma_m_per_m = 0.005;
    fit.taper_m_per_m += 0.005 * Normal();
    fit.taper_estimated = true;
    fit.start_s_m = -half;
    fit.end_s_m = half;
    fit.end_sigma_m = 0.05;
    fit.num_rings = 6;
    // As many as there are beams over its width.
    fit.num_points = std::max(
        10, static_cast<int>(fit.num_rings * 2.0 * r / (0.0035 * fit.distance_m)));
    fit.visible_arc_rad = 2.5;
    fit.mean_abs_deviation_m = 0.008;
    return fit;
  }

  std::vector<FittedCylinder> Scan(const Eigen::Isometry3d& T_map_lidar) {
    std::vector<FittedCylinder> out;
    for (std::size_t i = 0; i < branches_.size(); ++i) {
      if (auto fit = Observe(branches_[i], T_map_lidar, static_cast<int>(i))) out.push_back(*fit);
    }
    return out;
  }

  const std::vector<TrueBranch>& branches() const { return branches_; }

 private:
  std::vector<TrueBranch> branches_;
  std::mt19937 rng_;
  std::normal_distribution<double> normal_{0.0, 1.0};
};

/// Visual-inertial odometry that drifts by about 1 % of the distance.
class DriftingOdometry {
 public:
  /// @param scale  Length measured / true.
  explicit DriftingOdometry(World* world, double scale = 1.005) : world_(world), scale_(scale) {}

  Eigen::Isometry3d Next(const Eigen::Isometry3d& T_map_lidar) {
    if (!last_) {
      T_ = T_map_lidar;
      T_.translation().setZero();  // its own origin
    } else {
      const Eigen::Isometry3d step = last_->inverse() * T_map_lidar;
      const double d = step.translation().norm();
      Vector6d error = Vector6d::Zero();
      error[2] = 0.0026 * std::sqrt(d) * world_->Normal();
      for (int i = 3; i < 6; ++i) error[i] = 0.01 * std::sqrt(d) * world_->Normal();
      Eigen::Isometry3d scaled = step;
      scaled.translation() *= scale_;
      T_ = NormalizedSe3(T_ * scaled * ExpSe3(error));
    }
    last_ = T_map_lidar;
    return T_;
  }
  void Jump(const Vector6d& xi) { T_ = ExpSe3(xi) * T_; }

 private:
  World* world_;
  double scale_;
  std::optional<Eigen::Isometry3d> last_;
  Eigen::Isometry3d T_ = Eigen::Isometry3d::Identity();
};

struct FlightOptions {
  int scans = 750;
  double radius = 4.0, speed = 1.0, z0 = 0.8, climb = 0.035;
  bool vio = true, icp = true;
  double vio_scale = 1.005;
  int trunk_only_from = -1;  ///< From this scan on only the first branch of the world is seen.
  int jump_at = -1;
  int vio_lost_from = -1, vio_lost_to = -1;
  double start_time = 0.0;   ///< Along the circle [s].
  double yaw_offset = 0.0;
  std::int64_t first_stamp_ns = 1000000000;
};

struct FlightResult {
  std::vector<Eigen::Isometry3d> truth;  ///< T_map_lidar per scan.
  std::vector<MapperResult> results;
  double odometry_ate = 0.0;
};

inline double Ate(const std::vector<Eigen::Isometry3d>& truth,
                  const std::vector<Eigen::Isometry3d>& estimate) {
  const Eigen::Isometry3d align = truth.front() * estimate.front().inverse();
  double sum = 0.0;
  for (std::size_t i = 0; i < truth.size(); ++i) {
    sum += ((align * estimate[i]).translation() - truth[i].translation()).squaredNorm();
  }
  return std::sqrt(sum / static_cast<double>(truth.size()));
}

inline FlightResult Fly(Mapper* mapper, World* world, const FlightOptions& o) {
  FlightResult out;
  DriftingOdometry odometry(world, o.vio_scale);
  std::vector<Eigen::Isometry3d> vio_poses;
  std::int64_t last_stamp = 0;
  for (int i = 0; i < o.scans; ++i) {
    const double t = o.start_time + 0.1 * i;
    const Eigen::Isometry3d T = CirclePose(t, o.radius, o.speed, o.z0, o.climb);
    MapperInput input;
    input.stamp_ns = o.first_stamp_ns + 100000000LL * i;
    input.cylinders = world->Scan(T);
    if (o.trunk_only_from >= 0 && i >= o.trunk_only_from) {
      std::vector<FittedCylinder>& c = input.cylinders;
      c.erase(std::remove_if(c.begin(), c.end(), [](const auto& fit) { return fit.segment_id != 0; }),
              c.end());
    }
    const Eigen::Isometry3d vio = odometry.Next(T);
    if (i == o.jump_at) {
      Vector6d xi;
      xi << 0, 0, 0.05, 0.4, 0.25, 0.15;
      odometry.Jump(xi);
    }
    vio_poses.push_back(vio);
    if (o.vio && !(i >= o.vio_lost_from && i < o.vio_lost_to)) input.T_odom_lidar = vio;
    if (o.icp && i > 0) {
      RelativeMotion motion;
      motion.from_stamp_ns = last_stamp;
      motion.to_stamp_ns = input.stamp_ns;
      Vector6d sigma, noise;
      sigma << 0.004, 0.004, 0.004, 0.008, 0.008, 0.008;
      for (int k = 0; k < 6; ++k) noise[k] = sigma[k] * world->Normal();
      motion.T_from_to = out.truth.back().inverse() * T * ExpSe3(noise);
      motion.covariance = sigma.cwiseAbs2().asDiagonal();
      input.icp = motion;
    }
    last_stamp = input.stamp_ns;
    out.truth.push_back(T);
    out.results.push_back(mapper->AddScan(input));
  }
  out.odometry_ate = Ate(out.truth, vio_poses);
  return out;
}

inline double TrajectoryAte(const FlightResult& flight, const Mapper& mapper) {
  std::vector<Eigen::Isometry3d> estimate;
  for (const StampedPose& pose : mapper.Trajectory()) estimate.push_back(pose.T_map_lidar);
  return Ate(flight.truth, estimate);
}

/// Errors of the map against the truth, landmark by landmark.
struct MapScore {
  int matched = 0;       ///< Landmarks that lie on a true branch.
  int false_count = 0;   ///< Landmarks that lie on none.
  int branches_found = 0;
  std::vector<double> radius_error_rel, radius_error_sigmas, axis_error_rad;
};

inline MapScore Score(const std::vector<Landmark>& landmarks,
                      const std::vector<TrueBranch>& branches,
                      const Eigen::Isometry3d& T_truth_map) {
  MapScore score;
  std::vector<bool> found(branches.size(), false);
  for (const Landmark& l : landmarks) {
    bool ok = false;
    for (std::size_t b = 0; b < branches.size() && !ok; ++b) {
      const TrueBranch& branch = branches[b];
      const Cylinder c = TransformCylinder(T_truth_map, l.cylinder);
      const double angle = std::acos(std::min(1.0, std::abs(c.axis.dot(branch.Axis()))));
      if (angle > 15.0 * M_PI / 180.0) continue;
      const double s = (c.point - branch.from).dot(branch.Axis());
      const double offset = (c.point - branch.from - s * branch.Axis()).norm();
      if (offset > std::max(0.05, branch.RadiusAt(s))) continue;
      if (s < -0.2 || s > branch.Length() + 0.2) continue;
      ok = true;
      found[b] = true;
      score.axis_error_rad.push_back(angle);
      const double sign = c.axis.dot(branch.Axis()) < 0.0 ? -1.0 : 1.0;
      for (const RadiusKnot& knot : l.profile) {
        if (knot.num_scans < 20) continue;
        const double truth = branch.RadiusAt(s + sign * knot.s_m);
        score.radius_error_rel.push_back(std::abs(knot.radius_m - truth) / truth);
        score.radius_error_sigmas.push_back(std::abs(knot.radius_m - truth) / knot.radius_sigma_m);
      }
    }
    if (ok) {
      ++score.matched;
    } else {
      ++score.false_count;
    }
  }
  score.branches_found = static_cast<int>(std::count(found.begin(), found.end(), true));
  return score;
}

inline double Median(std::vector<double> values) {
  if (values.empty()) return 1e9;
  std::nth_element(values.begin(), values.begin() + values.size() / 2, values.end());
  return values[values.size() / 2];
}

}  // namespace dendro_test
