#include "dendro_slam/mapping/mapper.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <set>
#include <stdexcept>
#include <string>
#include <utility>

#include <Eigen/Cholesky>

#include "dendro_slam/factor_graph/between_factor.h"
#include "dendro_slam/factor_graph/cylinder_factor.h"
#include "dendro_slam/factor_graph/incremental_solver.h"
#include "dendro_slam/factor_graph/prior_factor.h"
#include "dendro_slam/mapping/level_factors.h"
#include "dendro_slam/mapping/odometry_drift.h"
#include "dendro_slam/mapping/relocalizer.h"
#include "dendro_slam/sensors/lidar_scan.h"

namespace dendro {

namespace {

constexpr double kRadPerDeg = 0.017453292519943295;

void Require(bool ok, const char* message) {
  if (!ok) throw std::invalid_argument(std::string("MapperConfig: ") + message);
}

Key PoseKey(int index) { return MakeKey('x', static_cast<std::uint64_t>(index)); }
constexpr Key kGroundKey = MakeKey('g', 0);
Key DriftKey(int index) { return MakeKey('d', static_cast<std::uint64_t>(index)); }
Key LandmarkKey(int id) { return MakeKey('l', static_cast<std::uint64_t>(id)); }

bool IsPositiveDefinite(const Eigen::Ref<const Eigen::MatrixXd>& m) {
  if (!m.allFinite()) return false;
  const Eigen::LLT<Eigen::MatrixXd> llt(m);
  return llt.info() == Eigen::Success;
}

// A motion with its uncertainty in the right tangent.
struct UncertainMotion {
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  Matrix6d covariance = Matrix6d::Zero();
};

// First a, then b.
UncertainMotion Compose(const UncertainMotion& a, const UncertainMotion& b) {
  const Matrix6d A = AdjointSe3(b.T.inverse());
  return {NormalizedSe3(a.T * b.T), A * a.covariance * A.transpose() + b.covariance};
}

// Covariance-weighted mean of two measurements of one motion.
UncertainMotion Fuse(const UncertainMotion& a, const UncertainMotion& b) {
  const Vector6d d = LogSe3(a.T.inverse() * b.T);
  const Matrix6d S = a.covariance + b.covariance;
  const Eigen::LDLT<Matrix6d> ldlt(S);
  const Matrix6d K = a.covariance * ldlt.solve(Matrix6d::Identity());
  UncertainMotion out;
  out.T = NormalizedSe3(a.T * ExpSe3(K * d));
  const Matrix6d P = a.covariance - K * a.covariance;
  out.covariance = 0.5 * (P + P.transpose());
  return out;
}

// The estimate of a fit's line when its radius is known from elsewhere: a one-sided view sees the
// surface, so a radius too large puts the axis too far away. Conditional gaussian in the five
// tangent coordinates.
FittedCylinder ConditionOnRadius(const FittedCylinder& fit, double radius, double radius_sigma) {
  if (!(radius > 0.0) || !(radius_sigma > 0.0)) return fit;
  const double kappa = 1.0 / radius;
  const double kappa_sigma = radius_sigma * kappa * kappa;
  const Vector5d column = fit.covariance.col(4);
  const double innovation_variance = column[4] + kappa_sigma * kappa_sigma;
  const Vector5d gain = column / innovation_variance;
  FittedCylinder out = fit;
  out.cylinder = fit.cylinder.Retract(gain * (kappa - fit.cylinder.curvature));
  if (!(out.cylinder.curvature > 0.0)) return fit;
  const Matrix5d C = fit.covariance - gain * column.transpose();
  out.covariance = 0.5 * (C + C.transpose());
  return out;
}

// Share of the beams of a scan that should have met the surface that a fit saw which returned from
// it: 1 for a trunk or branch, less for a cylinder laid around several twigs. The lidar spins about z.
double Fill(const FittedCylinder& fit, double column_step_rad) {
  const Eigen::Vector3d level = Eigen::Vector3d::UnitZ().cross(fit.cylinder.point).normalized();
  // A ring cuts a slanting branch along more columns than its width, a level one has no width.
  const double steep =
      std::sqrt(std::max(0.04, 1.0 - std::pow(fit.cylinder.axis.dot(level), 2)));
  const double half_arc = 0.5 * std::clamp(fit.visible_arc_rad, 0.3, M_PI);
  const double width = 2.0 * fit.cylinder.radius() * std::sin(half_arc) / steep;
  const double beams = fit.num_rings * width / (std::max(fit.distance_m, 0.1) * column_step_rad);
  return fit.num_points / std::max(beams, 1e-9);
}

}  // namespace

void MapperConfig::Validate() const {
  Require(key_frame_distance_m > 0.0, "key_frame_distance_m must be > 0");
  Require(key_frame_angle_deg > 0.0, "key_frame_angle_deg must be > 0");
  Require(key_frame_time_s > 0.0, "key_frame_time_s must be > 0");
  Require(first_key_frames >= 1, "first_key_frames must be >= 1");
  Require(key_frame_reach_m > 0.0, "key_frame_reach_m must be > 0");
  Require(key_frames_in_reach >= 0, "key_frames_in_reach must be >= 0");
  Require(key_frame_window >= 1, "key_frame_window must be >= 1");
  Require(vio_scale_sigma >= 0.0, "vio_scale_sigma must be >= 0");
  Require(vio_drift_m_per_m >= 0.0, "vio_drift_m_per_m must be >= 0");
  Require(vio_drift_length_m > 0.0, "vio_drift_length_m must be > 0");
  Require(vio_walk_m_per_sqrt_m >= 0.0, "vio_walk_m_per_sqrt_m must be >= 0");
  Require(vio_walk_rad_per_sqrt_m >= 0.0, "vio_walk_rad_per_sqrt_m must be >= 0");
  Require(vio_tilt_walk_rad_per_sqrt_m >= 0.0, "vio_tilt_walk_rad_per_sqrt_m must be >= 0");
  Require(vio_sigma_m_per_m >= 0.0, "vio_sigma_m_per_m must be >= 0");
  Require(vio_sigma_per_rad >= 0.0, "vio_sigma_per_rad must be >= 0");
  Require(vio_sigma_floor_rad > 0.0, "vio_sigma_floor_rad must be > 0");
  Require(vio_sigma_floor_m > 0.0, "vio_sigma_floor_m must be > 0");
  Require(icp_scale > 0.0, "icp_scale must be > 0");
  Require(odometry_gate_sigma > 0.0, "odometry_gate_sigma must be > 0");
  Require(max_speed_mps > 0.0, "max_speed_mps must be > 0");
  Require(max_turn_rad_per_s > 0.0, "max_turn_rad_per_s must be > 0");
  Require(max_acceleration_mps2 > 0.0, "max_acceleration_mps2 must be > 0");
  Require(blind_sigma_m_per_s > 0.0, "blind_sigma_m_per_s must be > 0");
  Require(blind_sigma_rad_per_s > 0.0, "blind_sigma_rad_per_s must be > 0");
  Require(gravity_sigma_deg >= 0.0, "gravity_sigma_deg must be >= 0");
  Require(ground_sigma_m >= 0.0, "ground_sigma_m must be >= 0");
  Require(ground_sigma_deg > 0.0, "ground_sigma_deg must be > 0");
  Require(observation_scale > 0.0, "observation_scale must be > 0");
  Require(observation_axis_floor_deg >= 0.0, "observation_axis_floor_deg must be >= 0");
  Require(observation_offset_floor_m >= 0.0, "observation_offset_floor_m must be >= 0");
  Require(observation_axis_shared_deg >= 0.0, "observation_axis_shared_deg must be >= 0");
  Require(observation_offset_shared_m >= 0.0, "observation_offset_shared_m must be >= 0");
  Require(robust_width > 0.0, "robust_width must be > 0");
  Require(min_fill >= 0.0 && min_fill < 1.0, "min_fill must be in [0, 1)");
  Require(column_step_deg > 0.0, "column_step_deg must be > 0");
  Require(nearby_radius_m > 0.0, "nearby_radius_m must be > 0");
  Require(nearby_max >= 1, "nearby_max must be >= 1");
  Require(nearby_exact >= 1, "nearby_exact must be >= 1");
  Require(min_radius_m > 0.0, "min_radius_m must be > 0");
  Require(max_radius_sigma_rel > 0.0, "max_radius_sigma_rel must be > 0");
  Require(relocalize_axis_deg > 0.0, "relocalize_axis_deg must be > 0");
  Require(relocalize_offset_m > 0.0, "relocalize_offset_m must be > 0");
  Require(relocalize_radius_ratio > 1.0, "relocalize_radius_ratio must be > 1");
  Require(relocalize_min_matches >= 2, "relocalize_min_matches must be >= 2");
  Require(relocalize_tilt_deg > 0.0, "relocalize_tilt_deg must be > 0");
  Require(relocalize_every_key_frames >= 1, "relocalize_every_key_frames must be >= 1");
  Require(relocalize_max_scans >= 10, "relocalize_max_scans must be >= 10");
  association.Validate();
  tree_map.Validate();
  radius_profile.Validate();
}

class Mapper::Impl {
 public:
  explicit Impl(const MapperConfig& config_in)
      : config(config_in), map(config_in.tree_map, config_in.radius_profile) {}

  MapperResult AddScan(const MapperInput& input);
  MapperResult AddScanWhileLost(const MapperInput& input);
  std::vector<StampedPose> Trajectory(std::size_t step = 1) const;
  std::vector<LandmarkState> StatesWithMarginals(bool confirmed_only) const;
  void StartFrom(const MapSnapshot& snapshot, const Eigen::Isometry3d& T_map_lidar);

  MapperConfig config;
  TreeMap map;
  IncrementalSolver solver;

  // Key frames and the trajectory hung on them.
  struct TrajectoryEntry {
    std::int64_t stamp_ns;
    int key_frame;
    Eigen::Isometry3d T_kf_lidar;
  };
  std::vector<TrajectoryEntry> trajectory;
  int num_key_frames = 0;
  std::int64_t key_frame_stamp_ns = 0;
  Eigen::Isometry3d T_map_kf = Eigen::Isometry3d::Identity();
  Matrix6d kf_covariance = Matrix6d::Zero();

  // Motion since the key frame.
  UncertainMotion since_kf;                 // the chain of the best steps
  UncertainMotion odometry_since_kf;        // the same without what the map corrected
  std::optional<UncertainMotion> icp_since_kf;
  std::optional<Eigen::Isometry3d> T_odom_kf;  // unset when VIO was absent or rejected since
  std::int64_t last_stamp_ns = 0;
  std::optional<Eigen::Isometry3d> T_odom_last;
  std::optional<Vector6d> velocity;         // of the last step, body frame
  double last_score = 0.0;

  // The slow drift of the odometry, a variable per piece of way.
  int num_drifts = 0;
  double drift_way_m = 0.0;                 // since the newest one
  Eigen::Vector4d drift = Eigen::Vector4d::Zero();  // the newest one's estimate

  Eigen::Isometry3d T_map_odom = Eigen::Isometry3d::Identity();
  bool upright = false;
  std::int64_t scan_number = 0;

  // First pose: known exactly, unless it comes from finding a loaded map again.
  std::optional<Eigen::Isometry3d> start_pose;

  std::map<int, Matrix5d> marginals;  // of the landmarks' lines, as last computed
  std::map<int, int> computed_at;     // key frame at which that was, of the landmarks in `nearby`

  // Key frames of long ago.
  using Cell = std::array<int, 3>;
  Cell CellOf(const Eigen::Vector3d& position) const;
  int CountKeptAround(const Eigen::Vector3d& position) const;
  std::map<Cell, std::vector<Eigen::Vector3d>> kept_in_cell;  // Where those stand that stay for good.
  std::vector<std::int64_t> key_frame_scans;    // scan number of each key frame
  std::vector<std::size_t> key_frame_entries;   // first entry of `trajectory` of each key frame
  int last_kept = 0;                            // before `next_judged`
  int next_judged = 1;                          // older ones are kept or gone for good
  int num_gone = 0;

  // Changes of the graph that go into its next update together.
  struct {
    FactorList factors;
    Values values;
    UpdateOptions options;
    std::set<Key> keys;
  } waiting;

  // Landmarks near the key frame, in its frame, with their covariance relative to it.
  std::vector<Landmark> nearby;

  // A loaded map that has not been found yet.
  std::optional<MapSnapshot> pending;
  std::unique_ptr<Mapper> local;
  std::vector<MapperInput> buffer;
  int tried_at_key_frame = 0;

 private:
  struct Hypothesis {
    UncertainMotion kf_now;      // prior
    UncertainMotion step;        // from the last scan
    bool uses_vio = false;
    bool uses_icp = false;
    std::vector<Match> matches;  // landmark: index into nearby
    Eigen::Isometry3d T_kf_lidar = Eigen::Isometry3d::Identity();  // refined
    double score = 0.0;
  };

  std::vector<FittedCylinder> Usable(const std::vector<FittedCylinder>& cylinders) const;
  UncertainMotion VioMotion(const Eigen::Isometry3d& T_odom_from,
                            const Eigen::Isometry3d& T_odom_to) const;
  bool AddVioFactor(int key_frame,
                    const Eigen::Isometry3d& T_odom_to,
                    FactorList* factors,
                    Values* values) const;
  void Evaluate(const std::vector<FittedCylinder>& cylinders, Hypothesis* h) const;
  FittedCylinder Conditioned(const FittedCylinder& fit,
                             const Landmark& landmark,
                             const Eigen::Isometry3d& T_frame_lidar) const;
  bool InsideALandmark(const FittedCylinder& fit, const Eigen::Isometry3d& T_kf_lidar) const;
  bool OnALandmarkOutOfReach(const FittedCylinder& fit, const Eigen::Isometry3d& T_kf_lidar) const;
  void AddKeyFrame(const MapperInput& input,
                   const std::vector<FittedCylinder>& cylinders,
                   const Hypothesis& h,
                   bool first,
                   MapperResult* result);
  void AddLevelFactors(const MapperInput& input,
                       int key_frame,
                       const Eigen::Isometry3d& T_map_lidar,
                       FactorList* factors,
                       Values* values) const;
  FactorPtr ObservationFactor(int key_frame,
                              int id,
                              const FittedCylinder& fit,
                              const Eigen::Isometry3d& T_map_lidar) const;
  std::optional<UncertainMotion> MotionBetween(const std::vector<FactorId>& factors,
                                               Key from,
                                               Key to) const;
  int FindRedundantKeyFrame();
  void MaintainMap();
  void MoveFactors(const std::vector<FactorId>& factors, Key to, const Cylinder* initial);
  void UpdateWaiting();
  void RefreshLines();
  void RefreshNearby(int id);
};

std::vector<FittedCylinder> Mapper::Impl::Usable(
    const std::vector<FittedCylinder>& cylinders) const {
  std::vector<FittedCylinder> out;
  out.reserve(cylinders.size());
  for (const FittedCylinder& c : cylinders) {
    if (c.status != FitStatus::kMeasured) continue;
    if (!c.cylinder.axis.allFinite() || !c.cylinder.point.allFinite() ||
        !std::isfinite(c.cylinder.curvature) || !(c.cylinder.curvature > 0.0) ||
        !std::isfinite(c.start_s_m) || !std::isfinite(c.end_s_m) || c.end_s_m <= c.start_s_m ||
        !c.bend_information.allFinite() || !c.bend_vector.allFinite() ||
        !std::isfinite(c.taper_m_per_m) || !std::isfinite(c.taper_sigma_m_per_m) ||
        std::abs(c.cylinder.axis.norm() - 1.0) > 1e-3) {
      continue;
    }
    const double radius = c.cylinder.radius();
    if (radius < config.min_radius_m) continue;
    if (!IsPositiveDefinite(c.covariance)) continue;
    if (c.radius_sigma_m() > config.max_radius_sigma_rel * radius) continue;
    if (Fill(c, config.column_step_deg * kRadPerDeg) < config.min_fill) continue;
    FittedCylinder scaled = c;
    scaled.cylinder.axis.normalize();
    scaled.covariance *= config.observation_scale * config.observation_scale;
    const double axis_floor = config.observation_axis_floor_deg * kRadPerDeg;
    scaled.covariance.diagonal().head<2>().array() += axis_floor * axis_floor;
    scaled.covariance.diagonal().segment<2>(2).array() +=
        config.observation_offset_floor_m * config.observation_offset_floor_m;
    out.push_back(scaled);
  }
  return out;
}

// A VIO motion as measured, with the noise that is left without the slow drift. VIO sees gravity, so
// its tilt drifts less than its heading.
UncertainMotion Mapper::Impl::VioMotion(const Eigen::Isometry3d& T_odom_from,
                                        const Eigen::Isometry3d& T_odom_to) const {
  const Eigen::Isometry3d T = T_odom_from.inverse() * T_odom_to;
  const Vector6d xi = LogSe3(T);
  const double distance = xi.tail<3>().norm(), angle = xi.head<3>().norm();
  const auto square = [](double x) { return x * x; };
  const double floor = square(config.vio_sigma_floor_rad) + square(config.vio_sigma_per_rad * angle);
  const double heading = floor + square(config.vio_walk_rad_per_sqrt_m) * distance;
  const double tilt = floor + square(config.vio_tilt_walk_rad_per_sqrt_m) * distance;
  const Eigen::Vector3d up = T_odom_to.linear().transpose() * Eigen::Vector3d::UnitZ();
  const double translation = square(config.vio_sigma_floor_m) +
                             square(config.vio_walk_m_per_sqrt_m) * distance +
                             square(config.vio_sigma_m_per_m * distance);
  UncertainMotion out;
  out.T = T;
  out.covariance.topLeftCorner<3, 3>() =
      tilt * Eigen::Matrix3d::Identity() + (heading - tilt) * up * up.transpose();
  out.covariance.diagonal().tail<3>().setConstant(translation);
  return out;
}

// Between-factor of the odometry from the last key frame to a new one.
// @return  The drift that it hangs on is a new variable.
bool Mapper::Impl::AddVioFactor(int key_frame,
                                const Eigen::Isometry3d& T_odom_to,
                                FactorList* factors,
                                Values* values) const {
  constexpr double kPiecesPerLength = 4.0;
  constexpr double kScaleKept = 0.02;  // Of the scale's sigma: how much it changes over a piece of way.
  constexpr double kMinSigma = 1e-6;
  const double piece = config.vio_drift_length_m / kPiecesPerLength;
  const bool is_new = num_drifts == 0 || drift_way_m > piece;
  const Key key = DriftKey(is_new ? num_drifts : num_drifts - 1);
  if (is_new) {
    Eigen::Vector4d sigma;
    sigma << config.vio_scale_sigma, Eigen::Vector3d::Constant(config.vio_drift_m_per_m);
    sigma = (kDriftWayM * sigma).cwiseMax(kMinSigma);
    Eigen::Vector4d value = Eigen::Vector4d::Zero();
    if (num_drifts == 0) {
      factors->push_back(std::make_shared<VectorPrior>(key, value, NoiseModel::Sigmas(sigma)));
    } else {
      Eigen::Vector4d keep = Eigen::Vector4d::Ones();
      keep.tail<3>().setConstant(std::exp(-drift_way_m / config.vio_drift_length_m));
      value = keep.cwiseProduct(drift);
      sigma[0] = std::max(kMinSigma, kScaleKept * sigma[0]);
      sigma.tail<3>() = (sigma.tail<3>() * std::sqrt(1.0 - keep[3] * keep[3])).cwiseMax(kMinSigma);
      factors->push_back(std::make_shared<DriftChangeFactor>(
          DriftKey(num_drifts - 1), key, keep, NoiseModel::Sigmas(sigma)));
    }
    values->Insert(key, Value(PointN(value)));
  }
  const UncertainMotion vio = VioMotion(*T_odom_kf, T_odom_to);
  factors->push_back(std::make_shared<DriftingMotionFactor>(
      PoseKey(key_frame - 1),
      PoseKey(key_frame),
      key,
      vio.T,
      T_odom_kf->linear(),
      NoiseModel::Covariance(vio.covariance).WithKernel(RobustKernel::Huber(3.0))));
  return is_new;
}

FittedCylinder Mapper::Impl::Conditioned(const FittedCylinder& fit,
                                         const Landmark& landmark,
                                         const Eigen::Isometry3d& T_frame_lidar) const {
  const double s = (T_frame_lidar * fit.cylinder.point - landmark.cylinder.point)
                       .dot(landmark.cylinder.axis);
  return ConditionOnRadius(fit, landmark.RadiusAt(s), landmark.RadiusSigmaAt(s));
}

// Associates under the prior, refines the pose on the matches, associates again with what is then
// known, and scores how well the scan fits the map.
void Mapper::Impl::Evaluate(const std::vector<FittedCylinder>& cylinders, Hypothesis* h) const {
  std::vector<const Landmark*> landmarks;
  landmarks.reserve(nearby.size());
  for (const Landmark& l : nearby) landmarks.push_back(&l);
  DataAssociationConfig as_in_graph = config.association;
  as_in_graph.axis_sigma_floor_deg = config.observation_axis_shared_deg;
  as_in_graph.offset_sigma_floor_m = config.observation_offset_shared_m;

  Eigen::Isometry3d T = h->kf_now.T;
  Matrix6d P = h->kf_now.covariance;
  const Matrix6d prior_information =
      h->kf_now.covariance.ldlt().solve(Matrix6d::Identity());
  for (int round = 0; round < 2; ++round) {
    h->matches = Associate(cylinders, landmarks, T, P, config.association);
    if (h->matches.empty()) break;
    Eigen::Isometry3d refined = T;
    for (int iteration = 0; iteration < 4; ++iteration) {
      const Vector6d prior_error = LogSe3(h->kf_now.T.inverse() * refined);
      const Matrix6d Jr = RightJacobianInverseSe3(prior_error);
      Matrix6d H = Jr.transpose() * prior_information * Jr;
      Vector6d b = -Jr.transpose() * prior_information * prior_error;
      for (const Match& match : h->matches) {
        const Landmark& l = *landmarks[static_cast<std::size_t>(match.landmark)];
        const FittedCylinder fit =
            Conditioned(cylinders[static_cast<std::size_t>(match.observation)], l, refined);
        const LineResidual r =
            ComputeLineResidual(fit, l, refined, Matrix6d::Zero(), as_in_graph);
        const Eigen::Matrix4d W = r.covariance.ldlt().solve(Eigen::Matrix4d::Identity());
        const double norm = std::sqrt(std::max(0.0, r.residual.dot(W * r.residual)));
        const double weight = norm > config.robust_width ? config.robust_width / norm : 1.0;
        H.noalias() += weight * r.J_pose.transpose() * W * r.J_pose;
        b.noalias() -= weight * r.J_pose.transpose() * (W * r.residual);
      }
      const Vector6d step = H.ldlt().solve(b);
      if (!step.allFinite()) break;
      refined = NormalizedSe3(refined * ExpSe3(step));
      P = H.ldlt().solve(Matrix6d::Identity());
      if (step.norm() < 1e-6) break;
    }
    T = refined;
  }
  h->T_kf_lidar = T;
  // Twice the logarithm of the evidence, up to what all hypotheses share. A vague prior can be bent to
  // fit anything: the last term is what it pays for that.
  const Vector6d moved = LogSe3(h->kf_now.T.inverse() * T);
  h->score = -moved.dot(prior_information * moved);
  for (const Match& match : h->matches) {
    h->score += std::max(0.0, 20.0 - match.mahalanobis2);
  }
  const auto log_det = [](const Matrix6d& m) {
    return m.ldlt().vectorD().cwiseMax(1e-300).array().log().sum();
  };
  h->score -= log_det(h->kf_now.covariance) - log_det(P);
}

bool Mapper::Impl::InsideALandmark(const FittedCylinder& fit,
                                   const Eigen::Isometry3d& T_kf_lidar) const {
  const Eigen::Vector3d middle = T_kf_lidar * fit.cylinder.point;
  for (const Landmark& l : nearby) {
    if (std::abs((middle - l.cylinder.point).dot(l.cylinder.axis)) > config.association.max_reach_m) {
      continue;
    }
    const LineResidual r =
        ComputeLineResidual(fit, l, T_kf_lidar, Matrix6d::Zero(), config.association);
    if (r.angle_rad > 20.0 * kRadPerDeg) continue;
    if (r.overlap_m < 0.5 * (fit.end_s_m - fit.start_s_m)) continue;
    if (r.offset_m < 0.8 * std::max(r.landmark_radius_m, r.radius_m)) return true;
  }
  return false;
}

// True when a fit lies on a landmark of the map that was not looked for, because it is too far away or others
// are nearer: it is begun no second time. (Twins of landmarks push landmarks out of `nearby`, which then get
// twins.)
bool Mapper::Impl::OnALandmarkOutOfReach(const FittedCylinder& fit,
                                         const Eigen::Isometry3d& T_kf_lidar) const {
  constexpr double kMaxAngleDeg = 20.0;
  constexpr double kThickestM = 1.0;
  const Eigen::Isometry3d T_map_lidar = T_map_kf * T_kf_lidar;
  const Eigen::Vector3d middle = T_map_lidar * fit.cylinder.point;
  const Eigen::Vector3d axis = T_map_lidar.linear() * fit.cylinder.axis;
  const double half = std::max(std::abs(fit.start_s_m), std::abs(fit.end_s_m));
  for (const LandmarkState& state : map.states()) {
    if (!state.confirmed || computed_at.count(state.id) > 0) continue;
    if (std::abs(axis.dot(state.line.axis)) < std::cos(kMaxAngleDeg * kRadPerDeg)) continue;
    const double reach = half + config.tree_map.max_length_m + kThickestM;
    if ((middle - state.line.point).squaredNorm() > reach * reach) continue;
    const LineResidual r = ComputeLineResidual(
        fit, map.Summary(state.id), T_map_lidar, Matrix6d::Zero(), config.association);
    if (r.overlap_m > 0.0 && r.offset_m < 2.0 * std::max(r.landmark_radius_m, r.radius_m)) return true;
  }
  return false;
}

// Gravity as VIO sees it, and the ground.
void Mapper::Impl::AddLevelFactors(const MapperInput& input,
                                   int key_frame,
                                   const Eigen::Isometry3d& T_map_lidar,
                                   FactorList* factors,
                                   Values* values) const {
  if (upright && input.T_odom_lidar && config.gravity_sigma_deg > 0.0) {
    const Eigen::Vector3d up = input.T_odom_lidar->linear().transpose() * Eigen::Vector3d::UnitZ();
    factors->push_back(std::make_shared<GravityFactor>(
        PoseKey(key_frame),
        up,
        NoiseModel::Isotropic(2, config.gravity_sigma_deg * kRadPerDeg)
            .WithKernel(RobustKernel::Huber(3.0))));
  }
  if (!input.ground || config.ground_sigma_m == 0.0) return;
  const Eigen::Vector3d normal = input.ground->normal.cast<double>().normalized();
  const double height = input.ground->offset;
  const bool known = solver.Contains(kGroundKey);
  const Eigen::Vector3d in_map = T_map_lidar.linear() * normal;
  // The map's plane is z over x and y: that needs a map that is upright, more or less.
  if (in_map.z() < 0.7) return;
  if (!known) {
    const Eigen::Vector3d foot = T_map_lidar.translation() - height * in_map;
    PointN plane(3);
    plane[1] = -in_map.x() / in_map.z();
    plane[2] = -in_map.y() / in_map.z();
    plane[0] = foot.z() - plane[1] * foot.x() - plane[2] * foot.y();
    values->Insert(kGroundKey, Value(plane));
  }
  Eigen::Vector3d sigmas;
  sigmas[0] = config.ground_sigma_m;
  sigmas.tail<2>().setConstant(config.ground_sigma_deg * kRadPerDeg);
  factors->push_back(std::make_shared<GroundFactor>(
      PoseKey(key_frame),
      kGroundKey,
      normal,
      height,
      NoiseModel::Sigmas(sigmas).WithKernel(RobustKernel::Cauchy(2.0))));
}

FactorPtr Mapper::Impl::ObservationFactor(int key_frame,
                                          int id,
                                          const FittedCylinder& fit,
                                          const Eigen::Isometry3d& T_map_lidar) const {
  const Landmark summary = map.Summary(id);
  const LandmarkState& state = map.State(id);
  FittedCylinder conditioned = Conditioned(fit, summary, T_map_lidar);
  // The variable's curvature is that at its own anchor: bring the measured one there along the
  // profile, so that a taper does not pull.
  const double s_variable = (state.line.point - summary.cylinder.point).dot(summary.cylinder.axis);
  const double s_fit = (T_map_lidar * fit.cylinder.point - summary.cylinder.point)
                           .dot(summary.cylinder.axis);
  const double shift = 1.0 / summary.RadiusAt(s_variable) - 1.0 / summary.RadiusAt(s_fit);
  if (conditioned.cylinder.curvature + shift > 0.0) conditioned.cylinder.curvature += shift;
  Matrix5d covariance = conditioned.covariance;
  const double axis_shared = config.observation_axis_shared_deg * kRadPerDeg;
  covariance.diagonal().head<2>().array() += axis_shared * axis_shared;
  covariance.diagonal().segment<2>(2).array() +=
      config.observation_offset_shared_m * config.observation_offset_shared_m;
  return std::make_shared<CylinderFactor>(PoseKey(key_frame),
                                          LandmarkKey(id),
                                          conditioned.cylinder,
                                          covariance,
                                          CylinderParts{},
                                          RobustKernel::Huber(config.robust_width));
}

void Mapper::Impl::AddKeyFrame(const MapperInput& input,
                               const std::vector<FittedCylinder>& cylinders,
                               const Hypothesis& h,
                               bool first,
                               MapperResult* result) {
  const int index = num_key_frames;
  const Eigen::Isometry3d T_map_lidar = first ? h.T_kf_lidar : NormalizedSe3(T_map_kf * h.T_kf_lidar);
  FactorList factors;
  Values values;
  values.Insert(PoseKey(index), Value(T_map_lidar));
  bool new_drift = false;
  if (first) {
    Vector6d sigmas = Vector6d::Constant(1e-4);
    if (start_pose) {
      sigmas.head<3>().setConstant(2.0 * config.relocalize_axis_deg * kRadPerDeg);
      sigmas.tail<3>().setConstant(2.0 * config.relocalize_offset_m);
    }
    factors.push_back(
        std::make_shared<PosePrior>(PoseKey(index), T_map_lidar, NoiseModel::Sigmas(sigmas)));
  } else {
    const bool any = h.uses_vio && T_odom_kf && input.T_odom_lidar;
    if (any) new_drift = AddVioFactor(index, *input.T_odom_lidar, &factors, &values);
    if (icp_since_kf && any) {
      factors.push_back(std::make_shared<BetweenFactor>(
          PoseKey(index - 1),
          PoseKey(index),
          icp_since_kf->T,
          NoiseModel::Covariance(icp_since_kf->covariance).WithKernel(RobustKernel::Cauchy(3.0))));
    }
    if (!any) {
      // VIO was not there all the way: the chain of what there was, step by step.
      factors.push_back(std::make_shared<BetweenFactor>(
          PoseKey(index - 1),
          PoseKey(index),
          odometry_since_kf.T,
          NoiseModel::Covariance(odometry_since_kf.covariance).WithKernel(RobustKernel::Huber(3.0))));
    }
  }

  AddLevelFactors(input, index, T_map_lidar, &factors, &values);
  std::vector<int> landmark_of(cylinders.size(), -1);
  for (const Match& match : h.matches) {
    landmark_of[static_cast<std::size_t>(match.observation)] =
        nearby[static_cast<std::size_t>(match.landmark)].id;
  }
  std::vector<int> started;
  for (std::size_t i = 0; i < cylinders.size(); ++i) {
    int id = landmark_of[i];
    const bool is_new = id < 0;
    if (is_new) {
      if (InsideALandmark(cylinders[i], h.T_kf_lidar)) continue;
      // At first the whole map was looked for.
      if (!first && OnALandmarkOutOfReach(cylinders[i], h.T_kf_lidar)) continue;
      id = map.Add(cylinders[i], T_map_lidar, scan_number);
      started.push_back(id);
      values.Insert(LandmarkKey(id), Value(map.State(id).line));
    }
    factors.push_back(ObservationFactor(index, id, cylinders[i], T_map_lidar));
    for (ObservationVerdict& verdict : result->observations) {
      if (verdict.segment_id != cylinders[i].segment_id) continue;
      verdict.landmark_id = id;
      verdict.is_new = is_new;
    }
  }

  // Old observations that were moved from one landmark to another hang on poses that may go now.
  if (!waiting.factors.empty()) UpdateWaiting();
  UpdateOptions options = waiting.options;
  const int redundant = FindRedundantKeyFrame();
  Eigen::Isometry3d T_kept_redundant = Eigen::Isometry3d::Identity();
  if (redundant >= 0) {
    const Key kept = PoseKey(last_kept), gone = PoseKey(redundant), next = PoseKey(redundant + 1);
    const std::vector<FactorId> old = solver.FactorsOf(gone);
    const UncertainMotion motion =
        Compose(*MotionBetween(old, kept, gone), *MotionBetween(old, gone, next));
    factors.push_back(std::make_shared<BetweenFactor>(
        kept,
        next,
        motion.T,
        NoiseModel::Covariance(motion.covariance).WithKernel(RobustKernel::Huber(3.0))));
    T_kept_redundant = solver.Estimate<Eigen::Isometry3d>(kept).inverse() *
                       solver.Estimate<Eigen::Isometry3d>(gone);
    std::vector<FactorId>& removed = options.remove_factors;
    removed.insert(removed.end(), old.begin(), old.end());
    std::sort(removed.begin(), removed.end());
    removed.erase(std::unique(removed.begin(), removed.end()), removed.end());
  }
  UpdateResult update;
  try {
    update = solver.Update(factors, values, options);
  } catch (const GraphError& error) {
    // The graph is as before: go on from the old key frame.
    for (int id : started) map.Remove(id);
    if (first) throw;
    result->warning = std::string("key frame left out: ") + error.what();
    return;
  }
  result->is_key_frame = true;
  result->error_before = update.error_before;
  result->error_after = update.error_after;
  result->damping = update.damping;
  result->variables_relinearized = update.variables_relinearized;
  result->variables_reeliminated = update.variables_reeliminated;

  waiting = {};
  if (redundant >= 0) {
    // What hung on it hangs on the one before.
    for (std::size_t i = key_frame_entries[static_cast<std::size_t>(redundant)];
         i < key_frame_entries[static_cast<std::size_t>(redundant) + 1];
         ++i) {
      trajectory[i].key_frame = last_kept;
      trajectory[i].T_kf_lidar = NormalizedSe3(T_kept_redundant * trajectory[i].T_kf_lidar);
    }
    ++next_judged;
    ++num_gone;
  }
  ++num_key_frames;
  if (new_drift) {
    ++num_drifts;
    drift_way_m = 0.0;
  }
  drift_way_m += h.T_kf_lidar.translation().norm();
  if (num_drifts > 0) drift = solver.Estimate<PointN>(DriftKey(num_drifts - 1));
  key_frame_scans.push_back(scan_number);
  key_frame_entries.push_back(trajectory.size());
  key_frame_stamp_ns = input.stamp_ns;
  T_map_kf = solver.Estimate<Eigen::Isometry3d>(PoseKey(index));
  since_kf = UncertainMotion{};
  odometry_since_kf = UncertainMotion{};
  icp_since_kf = UncertainMotion{};
  T_odom_kf = input.T_odom_lidar;
  MaintainMap();
  RefreshLines();
}

Mapper::Impl::Cell Mapper::Impl::CellOf(const Eigen::Vector3d& position) const {
  Cell cell;
  for (int i = 0; i < 3; ++i) {
    cell[static_cast<std::size_t>(i)] =
        static_cast<int>(std::floor(position[i] / config.key_frame_reach_m));
  }
  return cell;
}

int Mapper::Impl::CountKeptAround(const Eigen::Vector3d& position) const {
  const Cell middle = CellOf(position);
  int count = 0;
  for (int x = -1; x <= 1; ++x) {
    for (int y = -1; y <= 1; ++y) {
      for (int z = -1; z <= 1; ++z) {
        const auto it = kept_in_cell.find({middle[0] + x, middle[1] + y, middle[2] + z});
        if (it == kept_in_cell.end()) continue;
        for (const Eigen::Vector3d& kept : it->second) {
          if ((kept - position).norm() <= config.key_frame_reach_m) ++count;
        }
      }
    }
  }
  return count;
}

// What the between-factors say together, without those that the estimate contradicts.
std::optional<UncertainMotion> Mapper::Impl::MotionBetween(const std::vector<FactorId>& factors,
                                                           Key from,
                                                           Key to) const {
  constexpr double kOutlierError = 0.5 * 25.0;  // 1/2 chi2 of six coordinates.
  std::optional<UncertainMotion> out;
  double best = 0.0;
  for (FactorId id : factors) {
    const Factor* factor = solver.GetFactor(id).get();
    if (factor->keys().size() < 2 || factor->keys()[0] != from || factor->keys()[1] != to) continue;
    UncertainMotion motion;
    Eigen::MatrixXd W;
    if (const auto* between = dynamic_cast<const BetweenFactor*>(factor)) {
      motion.T = between->T_from_to();
      W = between->noise().sqrt_information();
    } else if (const auto* drifting = dynamic_cast<const DriftingMotionFactor*>(factor)) {
      // The drift of long ago is known.
      motion.T = drifting->Without(solver.Estimate<PointN>(drifting->keys()[2]));
      W = drifting->noise().sqrt_information();
    } else {
      continue;
    }
    motion.covariance = (W.transpose() * W).inverse();
    const double error = solver.FactorError(id);
    if (!out || (best > kOutlierError && error < best)) {
      out = motion;
      best = error;
    } else if (error <= kOutlierError) {
      out = Fuse(*out, motion);
    }
  }
  return out;
}

// The next key frame that is old and stands where there are enough others, or -1. Its observations
// are given up: what is left knows less than all of them did, never more.
int Mapper::Impl::FindRedundantKeyFrame() {
  constexpr int kMinOthers = 4;  // Observations that a landmark of the map must keep; a candidate, one: most
                                 // of them go, and no key frame should stay for their sake.
  constexpr int kLater = 5;      // Key frames.
  if (config.key_frames_in_reach == 0) return -1;
  for (; next_judged < num_key_frames - config.key_frame_window; ++next_judged) {
    // Candidates that only it saw must have had their time, and be out of the graph.
    const int later = std::min(next_judged + kLater, num_key_frames - 1);
    if (scan_number - key_frame_scans[static_cast<std::size_t>(later)] <=
        config.tree_map.candidate_max_gap_scans) {
      return -1;
    }
    const Key key = PoseKey(next_judged);
    const Eigen::Vector3d position = solver.Estimate<Eigen::Isometry3d>(key).translation();
    bool redundant = CountKeptAround(position) >= config.key_frames_in_reach;
    if (redundant) {
      const std::vector<FactorId> factors = solver.FactorsOf(key);
      // Two segments of one scan may lie on one landmark.
      std::map<Key, int> of_landmark;
      for (FactorId id : factors) {
        const auto* o = dynamic_cast<const CylinderFactor*>(solver.GetFactor(id).get());
        if (o != nullptr) ++of_landmark[o->keys()[1]];
      }
      for (const auto& [landmark, count] : of_landmark) {
        const int id = static_cast<int>(KeyIndex(landmark));
        const int others = solver.NumFactorsOf(landmark) - count;
        if (others < (map.Has(id) && map.State(id).confirmed ? kMinOthers : 1)) redundant = false;
      }
      redundant = redundant && MotionBetween(factors, PoseKey(last_kept), key) &&
                  MotionBetween(factors, key, PoseKey(next_judged + 1));
    }
    if (redundant) return next_judged;
    kept_in_cell[CellOf(position)].push_back(position);
    last_kept = next_judged;
  }
  return -1;
}

void Mapper::Impl::UpdateWaiting() {
  if (!waiting.factors.empty() || !waiting.options.remove_factors.empty()) {
    solver.Update(waiting.factors, waiting.values, waiting.options);
  }
  waiting = {};
}

// Confirms, drops, merges and splits, and keeps the graph in step.
void Mapper::Impl::MaintainMap() {
  for (int id : map.Promote(scan_number)) {
    const std::vector<FactorId> factors = solver.FactorsOf(LandmarkKey(id));
    waiting.options.remove_factors.insert(
        waiting.options.remove_factors.end(), factors.begin(), factors.end());
    map.Remove(id);
    marginals.erase(id);
  }
  const auto wait_for = [this](Key a, Key b) {
    const bool known = waiting.keys.count(a) + waiting.keys.count(b) > 0;
    if (known) UpdateWaiting();
    waiting.keys.insert(a);
    waiting.keys.insert(b);
  };
  // A few per key frame: the rest waits for the next one.
  for (int i = 0; i < 3; ++i) {
    const std::optional<LandmarkMerge> merge = map.FindDuplicate(config.association);
    if (!merge) break;
    wait_for(LandmarkKey(merge->keep_id), LandmarkKey(merge->drop_id));
    MoveFactors(solver.FactorsOf(LandmarkKey(merge->drop_id)), LandmarkKey(merge->keep_id), nullptr);
    map.Merge(*merge);
    marginals.erase(merge->drop_id);
  }
  for (int i = 0; i < 3; ++i) {
    const std::optional<LandmarkSplit> split = map.FindSplit();
    if (!split) break;
    wait_for(LandmarkKey(split->landmark_id), LandmarkKey(split->landmark_id));
    const Cylinder line = map.State(split->landmark_id).line;
    const Matrix5d covariance = map.State(split->landmark_id).covariance;
    const double middle = 0.5 * (split->gap_begin_m + split->gap_end_m);
    const std::pair<int, bool> piece = map.Split(*split);
    map.SetLine(piece.first, line, covariance);
    marginals[piece.first] = covariance;
    std::vector<FactorId> moved;
    for (FactorId factor : solver.FactorsOf(LandmarkKey(split->landmark_id))) {
      const auto* observation =
          dynamic_cast<const CylinderFactor*>(solver.GetFactor(factor).get());
      if (observation == nullptr) continue;
      const Eigen::Isometry3d& pose =
          solver.Estimate<Eigen::Isometry3d>(observation->keys()[0]);
      const double s = (pose * observation->measured().point - line.point).dot(line.axis);
      if ((s > middle) == piece.second) moved.push_back(factor);
    }
    if (!moved.empty()) {
      MoveFactors(moved, LandmarkKey(piece.first), &line);
    } else {
      // Nothing of this session fell on it: what an earlier one knew holds for both pieces.
      waiting.values.Insert(LandmarkKey(piece.first), Value(line));
      waiting.factors.push_back(std::make_shared<CylinderPrior>(
          LandmarkKey(piece.first), line, NoiseModel::Covariance(covariance)));
    }
    UpdateWaiting();
    if (!solver.Contains(LandmarkKey(piece.first))) map.Remove(piece.first);
    if (!solver.Contains(LandmarkKey(split->landmark_id))) map.Remove(split->landmark_id);
  }
  // The rest goes with the next key frame.
}

// Hangs observations of one landmark on another one, which `initial` creates, with the next update.
void Mapper::Impl::MoveFactors(const std::vector<FactorId>& factors,
                               Key to,
                               const Cylinder* initial) {
  for (FactorId id : factors) {
    const FactorPtr& factor = solver.GetFactor(id);
    if (const auto* o = dynamic_cast<const CylinderFactor*>(factor.get())) {
      waiting.factors.push_back(std::make_shared<CylinderFactor>(
          o->keys()[0], to, o->measured(), o->covariance(), o->parts(), o->noise().kernel()));
    } else if (const auto* prior = dynamic_cast<const CylinderPrior*>(factor.get())) {
      waiting.factors.push_back(std::make_shared<CylinderPrior>(to, prior->mean(), prior->noise()));
    }
    waiting.options.remove_factors.push_back(id);
  }
  if (initial != nullptr) waiting.values.Insert(to, Value(*initial));
}

// Brings the landmarks' lines up to date with the graph, and the covariances of those in reach of
// the sensor: the others cannot be seen, theirs wait.
void Mapper::Impl::RefreshLines() {
  const Key pose = PoseKey(num_key_frames - 1);
  T_map_kf = solver.Estimate<Eigen::Isometry3d>(pose);
  // Candidates apart, those first that were seen last: there may be many that never come again, and they
  // must not push the map, or each other, out of sight.
  std::vector<std::pair<double, int>> by_distance, candidates;
  for (const LandmarkState& state : map.states()) {
    const Cylinder& line = solver.Estimate<Cylinder>(LandmarkKey(state.id));
    map.SetLine(state.id, line, state.covariance);
    // The nearest point of the part of the line that was seen.
    const double cell = config.tree_map.coverage_cell_m;
    const double begin = state.first_cell * cell;
    const double end = begin + cell * static_cast<double>(state.coverage.size());
    const double s = std::clamp(
        (T_map_kf.translation() - line.point).dot(line.axis), begin, std::max(begin, end));
    const double distance = (line.point + s * line.axis - T_map_kf.translation()).norm();
    if (distance > config.nearby_radius_m) continue;
    const auto gap = static_cast<double>(scan_number - state.last_scan);
    if (state.confirmed) {
      by_distance.emplace_back(distance, state.id);
    } else {
      candidates.emplace_back(gap * config.nearby_radius_m + distance, state.id);
    }
  }
  std::vector<int> ids;
  for (auto* group : {&by_distance, &candidates}) {
    std::sort(group->begin(), group->end());
    if (static_cast<int>(group->size()) > config.nearby_max) {
      group->resize(static_cast<std::size_t>(config.nearby_max));
    }
    for (const auto& [distance, id] : *group) ids.push_back(id);
  }
  std::sort(ids.begin(), ids.end());
  // Exact are those that come into reach, and then those that have waited longest. A landmark begun
  // at this key frame has its fit's covariance, which is relative to it.
  const int index = num_key_frames - 1;
  std::map<int, int> last;
  std::vector<std::pair<int, int>> waiting_since;
  for (int id : ids) {
    const auto it = computed_at.find(id);
    const bool begun = it == computed_at.end() && map.State(id).first_scan == scan_number;
    last[id] = begun ? index : it == computed_at.end() ? -1 : it->second;
    if (!begun) waiting_since.emplace_back(last[id], id);
  }
  std::sort(waiting_since.begin(), waiting_since.end());
  std::vector<Key> keys;
  if (index > 0) keys.push_back(PoseKey(index - 1));
  for (const auto& [since, id] : waiting_since) {
    if (since >= 0 && static_cast<int>(keys.size()) > config.nearby_exact) break;
    keys.push_back(LandmarkKey(id));
  }
  const std::vector<Eigen::MatrixXd> joints = solver.PairMarginalCovariances(pose, keys);
  kf_covariance = joints.empty() ? Matrix6d(solver.MarginalCovariance(pose))
                                 : Matrix6d(joints.front().topLeftCorner<6, 6>());
  Matrix6d way = Matrix6d::Zero();  // Covariance of the motion from the key frame before.
  if (index > 0) {
    const Eigen::Isometry3d& T_map_before = solver.Estimate<Eigen::Isometry3d>(PoseKey(index - 1));
    Eigen::Matrix<double, 6, 12> J;
    J << Matrix6d::Identity(), -AdjointSe3(T_map_kf.inverse() * T_map_before);
    way = J * joints.front() * J.transpose();
  }
  std::map<int, const Eigen::MatrixXd*> exact;
  for (std::size_t i = index > 0 ? 1 : 0; i < keys.size(); ++i) {
    exact[static_cast<int>(KeyIndex(keys[i]))] = &joints[i];
  }
  nearby.clear();
  for (int id : ids) {
    const Cylinder& line = solver.Estimate<Cylinder>(LandmarkKey(id));
    // Covariance of the landmark as the key frame sees it: what both drifted together cancels.
    const Cylinder seen = TransformCylinder(T_map_kf.inverse(), line);
    Eigen::Matrix<double, 5, 6> J_pose;
    Matrix5d J_landmark;
    CylinderObservationResidual(seen, T_map_kf, line, &J_pose, &J_landmark);
    const Matrix5d R = CylinderTangentTransform(T_map_kf, seen);
    const auto joint = exact.find(id);
    if (joint != exact.end()) {
      marginals[id] = joint->second->bottomRightCorner<5, 5>();
      Eigen::Matrix<double, 5, 11> J;
      J << J_pose, J_landmark;
      const Matrix5d relative = J * *joint->second * J.transpose();
      map.SetLine(id, line, R * relative * R.transpose());
      last[id] = index;
    } else if (last[id] < index) {
      const Matrix5d grown = J_pose * way * J_pose.transpose();
      map.SetLine(id, line, map.State(id).covariance + R * grown * R.transpose());
    }
    nearby.push_back(TransformLandmark(T_map_kf.inverse(), map.Summary(id)));
  }
  computed_at = std::move(last);
}

void Mapper::Impl::RefreshNearby(int id) {
  for (Landmark& l : nearby) {
    if (l.id != id) continue;
    l = TransformLandmark(T_map_kf.inverse(), map.Summary(id));
  }
}

MapperResult Mapper::Impl::AddScan(const MapperInput& input) {
  MapperResult result;
  result.stamp_ns = input.stamp_ns;
  const bool first = num_key_frames == 0;
  if (!first && input.stamp_ns <= last_stamp_ns) {
    result.warning = "scan refused: its stamp is not later than the one before; reset the mapper "
                     "when the data starts anew";
    if (!trajectory.empty()) result.T_map_lidar = T_map_kf * trajectory.back().T_kf_lidar;
    return result;
  }
  MapperInput scan = input;
  if (scan.T_odom_lidar && !scan.T_odom_lidar->matrix().allFinite()) scan.T_odom_lidar.reset();
  if (scan.icp && (!scan.icp->T_from_to.matrix().allFinite() ||
                   !IsPositiveDefinite(scan.icp->covariance) ||
                   scan.icp->from_stamp_ns != last_stamp_ns ||
                   scan.icp->to_stamp_ns != scan.stamp_ns)) {
    scan.icp.reset();
  }
  ++scan_number;
  const std::vector<FittedCylinder> cylinders = Usable(scan.cylinders);
  for (const FittedCylinder& c : scan.cylinders) {
    result.observations.push_back({c.segment_id, -1, false});
  }

  Hypothesis best;
  if (first) {
    if (!start_pose) upright = scan.T_odom_lidar.has_value();
    Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
    if (start_pose) {
      T = *start_pose;
      // The loaded landmarks, in the map frame: the first pose's uncertainty is the search's.
      nearby = map.Landmarks(true);
      best.kf_now.T = T;
      best.kf_now.covariance.diagonal().head<3>().setConstant(
          std::pow(config.relocalize_axis_deg * kRadPerDeg, 2));
      best.kf_now.covariance.diagonal().tail<3>().setConstant(
          std::pow(config.relocalize_offset_m, 2));
      Evaluate(cylinders, &best);
    } else {
      if (scan.T_odom_lidar) T = *scan.T_odom_lidar;
      best.T_kf_lidar = T;
    }
    AddKeyFrame(scan, cylinders, best, true, &result);
    for (const Match& match : best.matches) {
      const int id = nearby[static_cast<std::size_t>(match.landmark)].id;
      if (!map.Has(id)) continue;
      map.Observe(id, cylinders[static_cast<std::size_t>(match.observation)], T_map_kf, scan_number);
    }
    best.T_kf_lidar = Eigen::Isometry3d::Identity();
  } else {
    const double dt = std::max(1e-3, NsToSeconds(scan.stamp_ns - last_stamp_ns));
    std::optional<UncertainMotion> vio, icp;
    bool suspicious = false;
    if (scan.T_odom_lidar && T_odom_last) {
      vio = VioMotion(*T_odom_last, *scan.T_odom_lidar);
      vio->T.translation() -= DriftJacobian(vio->T, T_odom_last->linear()) * drift;
      const Vector6d xi = LogSe3(vio->T);
      if (xi.tail<3>().norm() > config.max_speed_mps * dt + 0.05 ||
          xi.head<3>().norm() > config.max_turn_rad_per_s * dt + 0.05) {
        vio.reset();
        result.odometry_rejected = true;
      } else if (velocity && (xi / dt - *velocity).tail<3>().norm() >
                                 config.max_acceleration_mps2 * dt + 0.02 / dt) {
        suspicious = true;
      }
    }
    if (scan.icp) {
      icp = UncertainMotion{scan.icp->T_from_to,
                            scan.icp->covariance * config.icp_scale * config.icp_scale};
      const Vector6d xi = LogSe3(icp->T);
      if (xi.tail<3>().norm() > config.max_speed_mps * dt + 0.05) icp.reset();
    }
    if (vio && icp) {
      const Vector6d d = LogSe3(vio->T.inverse() * icp->T);
      const double chi2 = d.dot((vio->covariance + icp->covariance).ldlt().solve(d));
      if (chi2 > config.odometry_gate_sigma * config.odometry_gate_sigma + 6.0) suspicious = true;
    }
    // The last velocity goes on: the only guess left without odometry, and the judge of a jump.
    UncertainMotion blind;
    if (velocity) blind.T = ExpSe3(*velocity * std::min(dt, 0.5));
    blind.covariance.diagonal().head<3>().setConstant(
        std::pow(config.blind_sigma_rad_per_s * dt, 2));
    blind.covariance.diagonal().tail<3>().setConstant(std::pow(config.blind_sigma_m_per_s * dt, 2));

    std::vector<Hypothesis> hypotheses;
    const auto add = [&](const UncertainMotion& step, bool uses_vio, bool uses_icp) {
      Hypothesis h;
      h.step = step;
      h.kf_now = Compose(since_kf, step);
      h.uses_vio = uses_vio;
      h.uses_icp = uses_icp;
      Evaluate(cylinders, &h);
      hypotheses.push_back(std::move(h));
    };
    if (vio && icp && !suspicious) {
      add(Fuse(*vio, *icp), true, true);
    } else if (vio) {
      add(*vio, true, false);
    } else if (icp) {
      // Where ICP knows little, the motion before goes on.
      add(velocity ? Fuse(*icp, blind) : *icp, false, true);
    } else {
      add(blind, false, false);
    }
    // A scan that suddenly fits the map far worse makes its odometry suspect, too.
    if (vio && hypotheses.front().score < 0.5 * last_score - 10.0) suspicious = true;
    if (suspicious) {
      if (icp && vio) {
        add(velocity ? Fuse(*icp, blind) : *icp, false, true);
        add(*vio, true, false);
      }
      if (vio) add(blind, false, false);
    }
    std::size_t chosen = 0;
    for (std::size_t i = 1; i < hypotheses.size(); ++i) {
      if (hypotheses[i].score > hypotheses[chosen].score + 10.0) chosen = i;
    }
    best = std::move(hypotheses[chosen]);
    if (suspicious && vio && !best.uses_vio) result.odometry_rejected = true;

    odometry_since_kf = Compose(odometry_since_kf, best.step);
    since_kf = best.kf_now;
    since_kf.T = best.T_kf_lidar;
    if (best.uses_vio && !T_odom_kf) best.uses_vio = false;
    if (!vio || result.odometry_rejected) T_odom_kf.reset();
    if (icp && icp_since_kf && (best.uses_icp || !suspicious)) {
      icp_since_kf = Compose(*icp_since_kf, *icp);
    } else {
      icp_since_kf.reset();
    }
    const Eigen::Isometry3d step = trajectory.back().key_frame == num_key_frames - 1
                                       ? trajectory.back().T_kf_lidar.inverse() * best.T_kf_lidar
                                       : best.T_kf_lidar;
    // Smoothed: the difference of two poses a tenth of a second apart is mostly noise.
    const Vector6d now = LogSe3(step) / dt;
    velocity = velocity ? Vector6d(0.6 * *velocity + 0.4 * now) : now;
    last_score = 0.7 * last_score + 0.3 * best.score;

    const Vector6d since = LogSe3(best.T_kf_lidar);
    const bool key_frame =
        num_key_frames < config.first_key_frames ||
        since.tail<3>().norm() >= config.key_frame_distance_m ||
        since.head<3>().norm() >= config.key_frame_angle_deg * kRadPerDeg ||
        NsToSeconds(scan.stamp_ns - key_frame_stamp_ns) >= config.key_frame_time_s;
    Eigen::Isometry3d T_kf_lidar = best.T_kf_lidar;
    std::vector<std::pair<int, int>> seen;  // observation, landmark id
    for (const Match& match : best.matches) {
      seen.emplace_back(match.observation, nearby[static_cast<std::size_t>(match.landmark)].id);
    }
    for (const auto& [observation, id] : seen) {
      for (ObservationVerdict& verdict : result.observations) {
        if (verdict.segment_id != cylinders[static_cast<std::size_t>(observation)].segment_id) continue;
        verdict.landmark_id = id;
      }
    }
    const int before = num_key_frames;
    if (key_frame) {
      AddKeyFrame(scan, cylinders, best, false, &result);
      if (num_key_frames != before) T_kf_lidar = Eigen::Isometry3d::Identity();
    }
    const Eigen::Isometry3d T_map_lidar = T_map_kf * T_kf_lidar;
    for (const auto& [observation, id] : seen) {
      if (!map.Has(id)) continue;
      map.Observe(id, cylinders[static_cast<std::size_t>(observation)], T_map_lidar, scan_number);
      RefreshNearby(id);
    }
    best.T_kf_lidar = T_kf_lidar;
  }

  trajectory.push_back({scan.stamp_ns, num_key_frames - 1, best.T_kf_lidar});
  last_stamp_ns = scan.stamp_ns;
  T_odom_last = scan.T_odom_lidar;
  result.T_map_lidar = NormalizedSe3(T_map_kf * best.T_kf_lidar);
  const Matrix6d A = AdjointSe3(best.T_kf_lidar.inverse());
  result.pose_covariance = A * kf_covariance * A.transpose() + since_kf.covariance;
  if (scan.T_odom_lidar) {
    T_map_odom = NormalizedSe3(result.T_map_lidar * scan.T_odom_lidar->inverse());
  }
  return result;
}

void Mapper::Impl::StartFrom(const MapSnapshot& snapshot, const Eigen::Isometry3d& T_map_lidar) {
  map.Restore(snapshot.landmarks, snapshot.next_landmark_id);
  FactorList factors;
  Values values;
  for (const LandmarkState& state : snapshot.landmarks) {
    values.Insert(LandmarkKey(state.id), Value(state.line));
    Matrix5d covariance = state.covariance;
    covariance.diagonal().head<2>().array() += 1e-8;
    covariance.diagonal().segment<2>(2).array() += 1e-8;
    covariance(4, 4) += 1e-6;
    factors.push_back(std::make_shared<CylinderPrior>(
        LandmarkKey(state.id), state.line, NoiseModel::Covariance(covariance)));
    marginals[state.id] = state.covariance;
    scan_number = std::max(scan_number, state.last_scan);
  }
  if (snapshot.ground) {
    const PointN plane = *snapshot.ground;
    values.Insert(kGroundKey, Value(plane));
    Eigen::Vector3d sigmas(config.ground_sigma_m,
                           config.ground_sigma_deg * kRadPerDeg,
                           config.ground_sigma_deg * kRadPerDeg);
    factors.push_back(
        std::make_shared<VectorPrior>(kGroundKey, plane, NoiseModel::Sigmas(sigmas)));
  }
  if (!factors.empty()) solver.Update(factors, values);
  start_pose = T_map_lidar;
  upright = snapshot.upright;
}

MapperResult Mapper::Impl::AddScanWhileLost(const MapperInput& input) {
  MapperResult result = local->AddScan(input);
  if (!result.warning.empty() && local->num_key_frames() > 0 && !buffer.empty() &&
      input.stamp_ns <= buffer.back().stamp_ns) {
    return result;
  }
  buffer.push_back(input);
  if (static_cast<int>(buffer.size()) > config.relocalize_max_scans) {
    buffer.clear();
    local = std::make_unique<Mapper>(config);
    tried_at_key_frame = 0;
    result.warning = "the loaded map was not recognised in what was seen so far; starting the search anew";
    return result;
  }
  result.warning = "the loaded map has not been recognised yet";
  if (local->num_key_frames() < tried_at_key_frame + config.relocalize_every_key_frames) return result;
  tried_at_key_frame = local->num_key_frames();

  RelocalizerConfig search;
  search.axis_deg = config.relocalize_axis_deg;
  search.offset_m = config.relocalize_offset_m;
  search.radius_ratio = config.relocalize_radius_ratio;
  search.min_matches = config.relocalize_min_matches;
  search.tilt_deg = config.relocalize_tilt_deg;
  const MapSnapshot seen = local->Snapshot();
  search.upright = pending->upright && seen.upright;
  search.local_ground = seen.ground;
  search.loaded_ground = pending->ground;
  TreeMap loaded(config.tree_map, config.radius_profile);
  loaded.Restore(pending->landmarks, pending->next_landmark_id);
  const std::optional<Relocalization> found =
      Relocalize(local->Landmarks(), loaded.Landmarks(false), search);
  if (!found) return result;

  // Go through what was seen since the start once more, now on the loaded map.
  const Eigen::Isometry3d start = found->T_map_local * local->Trajectory().front().T_map_lidar;
  const std::vector<MapperInput> replay = std::move(buffer);
  Impl fresh(config);
  fresh.StartFrom(*pending, start);
  for (const MapperInput& scan : replay) result = fresh.AddScan(scan);
  *this = std::move(fresh);
  return result;
}

// Every `step`-th pose from the first on, and the last.
std::vector<StampedPose> Mapper::Impl::Trajectory(std::size_t step) const {
  std::vector<StampedPose> out;
  out.reserve(trajectory.size() / step + 2);
  for (std::size_t i = 0; i < trajectory.size(); ++i) {
    if (i % step != 0 && i + 1 != trajectory.size()) continue;
    const TrajectoryEntry& entry = trajectory[i];
    const Eigen::Isometry3d& T = solver.Estimate<Eigen::Isometry3d>(PoseKey(entry.key_frame));
    out.push_back({entry.stamp_ns, NormalizedSe3(T * entry.T_kf_lidar)});
  }
  return out;
}

std::vector<LandmarkState> Mapper::Impl::StatesWithMarginals(bool confirmed_only) const {
  std::vector<LandmarkState> states;
  for (const LandmarkState& state : map.states()) {
    if (confirmed_only && !state.confirmed) continue;
    states.push_back(state);
    const auto it = marginals.find(state.id);
    if (it != marginals.end()) states.back().covariance = it->second;
  }
  return states;
}

Mapper::Mapper(MapperConfig config) {
  config.Validate();
  impl_ = std::make_unique<Impl>(config);
}
Mapper::~Mapper() = default;
Mapper::Mapper(Mapper&&) noexcept = default;
Mapper& Mapper::operator=(Mapper&&) noexcept = default;

MapperResult Mapper::AddScan(const MapperInput& input) {
  return impl_->pending ? impl_->AddScanWhileLost(input) : impl_->AddScan(input);
}

std::vector<Landmark> Mapper::Landmarks() const {
  TreeMap map(impl_->config.tree_map, impl_->config.radius_profile);
  if (impl_->pending) {
    map.Restore(impl_->pending->landmarks, impl_->pending->next_landmark_id);
  } else {
    map.Restore(impl_->StatesWithMarginals(true), impl_->map.next_id());
  }
  return SeparatePieces(map.Landmarks(false));
}

std::vector<Landmark> Mapper::AllLandmarks() const {
  TreeMap map(impl_->config.tree_map, impl_->config.radius_profile);
  if (impl_->pending) {
    map.Restore(impl_->pending->landmarks, impl_->pending->next_landmark_id);
  } else {
    map.Restore(impl_->StatesWithMarginals(false), impl_->map.next_id());
  }
  return map.Landmarks(true);
}

std::vector<StampedPose> Mapper::Trajectory() const {
  return impl_->pending ? impl_->local->Trajectory() : impl_->Trajectory();
}
std::vector<StampedPose> Mapper::ThinnedTrajectory(std::size_t most) const {
  if (impl_->pending) return impl_->local->ThinnedTrajectory(most);
  std::size_t step = 1;
  // The last one comes on top of every step-th.
  while (impl_->trajectory.size() / step + 2 > std::max<std::size_t>(most, 3) &&
         step < impl_->trajectory.size()) {
    step *= 2;
  }
  return impl_->Trajectory(step);
}
Eigen::Isometry3d Mapper::T_map_odom() const {
  return impl_->pending ? impl_->local->T_map_odom() : impl_->T_map_odom;
}
int Mapper::num_key_frames() const {
  return impl_->pending ? impl_->local->num_key_frames() : impl_->num_key_frames;
}
int Mapper::num_kept_key_frames() const {
  return impl_->pending ? impl_->local->num_kept_key_frames()
                        : impl_->num_key_frames - impl_->num_gone;
}
bool Mapper::relocalizing() const { return impl_->pending.has_value(); }

MapSnapshot Mapper::Snapshot() const {
  if (impl_->pending) return *impl_->pending;
  MapSnapshot snapshot{impl_->map.next_id(), impl_->upright, {}, impl_->StatesWithMarginals(false)};
  if (impl_->solver.Contains(kGroundKey)) {
    snapshot.ground = impl_->solver.Estimate<PointN>(kGroundKey);
  }
  return snapshot;
}

void Mapper::Load(const MapSnapshot& snapshot) {
  if (snapshot.ground && !snapshot.ground->allFinite()) {
    throw std::invalid_argument("MapSnapshot: the ground is not finite");
  }
  int previous = -1;
  for (const LandmarkState& state : snapshot.landmarks) {
    const std::string name = "MapSnapshot: landmark " + std::to_string(state.id);
    if (state.id <= previous || state.id >= snapshot.next_landmark_id) {
      throw std::invalid_argument(name + ": ids must ascend and stay below next_landmark_id");
    }
    previous = state.id;
    if (!state.line.axis.allFinite() || std::abs(state.line.axis.norm() - 1.0) > 1e-3 ||
        !state.line.point.allFinite() || !std::isfinite(state.line.curvature) ||
        !(state.line.curvature > 0.0)) {
      throw std::invalid_argument(name + ": its line is not a cylinder");
    }
    if (!IsPositiveDefinite(state.covariance)) {
      throw std::invalid_argument(name + ": its covariance is not positive definite");
    }
    if (state.coverage.empty() || state.profile.knots().empty()) {
      throw std::invalid_argument(name + ": it has no extent or no radius");
    }
  }
  auto fresh = std::make_unique<Impl>(impl_->config);
  if (!snapshot.landmarks.empty()) {
    fresh->pending = snapshot;
    fresh->local = std::make_unique<Mapper>(impl_->config);
  } else {
    fresh->map.Restore({}, snapshot.next_landmark_id);
  }
  impl_ = std::move(fresh);
}

void Mapper::Reset() { impl_ = std::make_unique<Impl>(impl_->config); }

const MapperConfig& Mapper::config() const { return impl_->config; }

}  // namespace dendro
