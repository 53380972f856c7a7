#include "dendro_slam/mapping/data_association.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>

#include <Eigen/Cholesky>

#include "dendro_slam/factor_graph/cylinder_factor.h"

namespace dendro {

namespace {

constexpr double kRadPerDeg = 0.017453292519943295;

void Require(bool ok, const char* message) {
  if (!ok) throw std::invalid_argument(std::string("DataAssociationConfig: ") + message);
}

// Chi-squared value with `dof` degrees that is as unlikely as `sigma` of a normal (Wilson and
// Hilferty's cube-root approximation, good to a per cent here).
double Chi2Gate(double sigma, double dof) {
  const double a = 2.0 / (9.0 * dof);
  const double root = 1.0 - a + sigma * std::sqrt(a);
  return dof * root * root * root;
}

struct Candidate {
  int observation = 0;
  int landmark = 0;
  double cost = 0.0;
  double mahalanobis2 = 0.0;
  double s_begin = 0.0, s_end = 0.0;  // the observation's extent on the landmark
};

}  // namespace

void DataAssociationConfig::Validate() const {
  Require(gate_sigma > 0.0, "gate_sigma must be > 0");
  Require(max_axis_angle_deg > 0.0 && max_axis_angle_deg < 90.0,
          "max_axis_angle_deg must be in (0, 90)");
  Require(max_offset_m > 0.0, "max_offset_m must be > 0");
  Require(max_offset_radii > 0.0, "max_offset_radii must be > 0");
  Require(extent_tolerance_m >= 0.0, "extent_tolerance_m must be >= 0");
  Require(max_radius_ratio > 1.0, "max_radius_ratio must be > 1");
  Require(axis_sigma_floor_deg >= 0.0, "axis_sigma_floor_deg must be >= 0");
  Require(max_reach_m > 0.0, "max_reach_m must be > 0");
  Require(offset_sigma_floor_m >= 0.0, "offset_sigma_floor_m must be >= 0");
}

LineResidual ComputeLineResidual(const FittedCylinder& observation,
                                 const Landmark& landmark,
                                 const Eigen::Isometry3d& T_map_lidar,
                                 const Matrix6d& pose_covariance,
                                 const DataAssociationConfig& config) {
  LineResidual out;
  const Cylinder in_map = TransformCylinder(T_map_lidar, observation.cylinder);
  const double cosine = in_map.axis.dot(landmark.cylinder.axis);
  out.angle_rad = std::acos(std::min(1.0, std::abs(cosine)));
  const double sign = cosine < 0.0 ? -1.0 : 1.0;

  // The common extent along the landmark; the observation is compared at its middle.
  const double s_anchor = (in_map.point - landmark.cylinder.point).dot(landmark.cylinder.axis);
  const double a = s_anchor + sign * observation.start_s_m;
  const double b = s_anchor + sign * observation.end_s_m;
  const double low = std::max(std::min(a, b), landmark.s_min_m);
  const double high = std::min(std::max(a, b), landmark.s_max_m);
  out.overlap_m = high - low;
  const double s_landmark = 0.5 * (low + high);
  const double s_observation = std::clamp(sign * (s_landmark - s_anchor),
                                          std::min(observation.start_s_m, 0.0),
                                          std::max(observation.end_s_m, 0.0));

  const Cylinder measured = observation.cylinder.Slid(s_observation);
  const Matrix5d J_slide = CylinderSlideJacobian(observation.cylinder, s_observation);
  const Matrix5d C = J_slide * observation.covariance * J_slide.transpose();
  // Where the landmark is bent, the straight line nearest to it over the same stretch.
  Cylinder line = landmark.LineOver(std::min(a, b), std::max(a, b));
  line = line.Slid(s_landmark - 0.5 * (a + b));
  const Matrix5d J_line = CylinderTurnJacobian(landmark.cylinder.axis, line.axis) *
                          CylinderSlideJacobian(landmark.cylinder, s_landmark);
  const Matrix5d L = J_line * landmark.covariance * J_line.transpose();

  Eigen::Matrix<double, 5, 6> J_pose;
  Matrix5d J_landmark;
  const Vector5d r = CylinderObservationResidual(measured, T_map_lidar, line, &J_pose, &J_landmark);
  Matrix5d S = J_pose * pose_covariance * J_pose.transpose() +
               J_landmark * L * J_landmark.transpose() + C;
  const double axis_floor = config.axis_sigma_floor_deg * kRadPerDeg;
  S.diagonal().head<2>().array() += axis_floor * axis_floor;
  S.diagonal().segment<2>(2).array() += config.offset_sigma_floor_m * config.offset_sigma_floor_m;
  out.residual = r.head<4>();
  out.covariance = S.topLeftCorner<4, 4>();
  out.J_pose = J_pose.topRows<4>();
  out.offset_m = r.segment<2>(2).norm();

  out.radius_m = observation.cylinder.radius() + observation.taper_m_per_m * s_observation;
  out.landmark_radius_m = landmark.RadiusAt(s_landmark);
  const double sigma_observation = observation.radius_sigma_m();
  const double sigma_taper = observation.taper_sigma_m_per_m * s_observation;
  const double sigma_landmark = landmark.RadiusSigmaAt(s_landmark);
  out.radius_difference_sigma_m =
      std::sqrt(sigma_observation * sigma_observation + sigma_taper * sigma_taper +
                sigma_landmark * sigma_landmark);
  return out;
}

std::vector<Match> Associate(const std::vector<FittedCylinder>& observations,
                             const std::vector<const Landmark*>& landmarks,
                             const Eigen::Isometry3d& T_map_lidar,
                             const Matrix6d& pose_covariance,
                             const DataAssociationConfig& config) {
  const double gate = Chi2Gate(config.gate_sigma, 4.0);
  std::vector<Candidate> candidates;
  for (int i = 0; i < static_cast<int>(observations.size()); ++i) {
    const FittedCylinder& o = observations[static_cast<std::size_t>(i)];
    if (o.status != FitStatus::kMeasured) continue;
    const Eigen::Vector3d anchor = T_map_lidar * o.cylinder.point;
    const Eigen::Vector3d axis = T_map_lidar.linear() * o.cylinder.axis;
    const double half = 0.5 * (o.end_s_m - o.start_s_m);
    for (int j = 0; j < static_cast<int>(landmarks.size()); ++j) {
      const Landmark& l = *landmarks[static_cast<std::size_t>(j)];
      // Cheap tests first: axes, then a bound on the distance.
      const double cosine = axis.dot(l.cylinder.axis);
      if (std::abs(cosine) < std::cos(config.max_axis_angle_deg * kRadPerDeg)) continue;
      const Eigen::Vector3d d = anchor - l.cylinder.point;
      const double s = d.dot(l.cylinder.axis);
      if (std::abs(s) > config.max_reach_m) continue;
      if ((d - s * l.cylinder.axis).norm() > config.max_offset_m + half) continue;

      const LineResidual r = ComputeLineResidual(o, l, T_map_lidar, pose_covariance, config);
      if (r.overlap_m < -config.extent_tolerance_m) continue;
      const double offset_sigma = std::sqrt(
          std::max(0.0, 0.5 * (r.covariance(2, 2) + r.covariance(3, 3))));
      const double offset_limit =
          std::min(config.max_offset_m,
                   config.max_offset_radii * std::max(r.landmark_radius_m, r.radius_m) +
                       config.gate_sigma * offset_sigma);
      if (r.offset_m > offset_limit) continue;
      const double difference = std::abs(r.radius_m - r.landmark_radius_m);
      if (r.radius_m <= 0.0) continue;
      const double ratio = std::max(r.radius_m / r.landmark_radius_m, r.landmark_radius_m / r.radius_m);
      if (ratio > config.max_radius_ratio &&
          difference > config.gate_sigma * r.radius_difference_sigma_m) {
        continue;
      }
      const double mahalanobis2 = r.residual.dot(r.covariance.ldlt().solve(r.residual));
      if (!(mahalanobis2 <= gate)) continue;
      const double radius_sigma =
          std::hypot(r.radius_difference_sigma_m, 0.1 * r.landmark_radius_m);
      Candidate c;
      c.observation = i;
      c.landmark = j;
      c.mahalanobis2 = mahalanobis2;
      // Lines with a tight covariance are the likelier match at equal distance, as the gaussian's
      // normalisation has it.
      c.cost = mahalanobis2 + (difference / radius_sigma) * (difference / radius_sigma) +
               0.5 * std::log(std::max(r.covariance.determinant(), 1e-300));
      const double sign = cosine < 0.0 ? -1.0 : 1.0;
      c.s_begin = std::min(s + sign * o.start_s_m, s + sign * o.end_s_m);
      c.s_end = std::max(s + sign * o.start_s_m, s + sign * o.end_s_m);
      candidates.push_back(c);
    }
  }
  std::stable_sort(candidates.begin(), candidates.end(), [](const Candidate& a, const Candidate& b) {
    return a.cost < b.cost;
  });

  // Ascending in cost: the first candidate of an observation is its best landmark, and nothing else
  // will do. A landmark takes its best observation and those beside it.
  std::vector<bool> decided(observations.size(), false);
  std::vector<Match> matches;
  std::vector<const Candidate*> accepted;
  for (const Candidate& c : candidates) {
    if (decided[static_cast<std::size_t>(c.observation)]) continue;
    decided[static_cast<std::size_t>(c.observation)] = true;
    bool free = true;
    for (const Candidate* other : accepted) {
      if (other->landmark != c.landmark) continue;
      const double common =
          std::min(other->s_end, c.s_end) - std::max(other->s_begin, c.s_begin);
      if (common > 0.3 * std::min(other->s_end - other->s_begin, c.s_end - c.s_begin)) {
        free = false;
        break;
      }
    }
    if (!free) continue;
    accepted.push_back(&c);
    matches.push_back({c.observation, c.landmark, c.mahalanobis2});
  }
  std::sort(matches.begin(), matches.end(), [](const Match& a, const Match& b) {
    return a.observation < b.observation;
  });
  return matches;
}

}  // namespace dendro
