#include "dendro_slam/odometry/hand_eye.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <optional>
#include <stdexcept>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <Eigen/SVD>

#include "dendro_slam/geometry/so3.h"
#include "dendro_slam/sensors/lidar_scan.h"

namespace dendro {

namespace {

constexpr double kRadToDeg = 57.29577951308232;
constexpr int kUnknowns = 8;  // Rotation, translation of X, time offset [s], scale.
using Vector8d = Eigen::Matrix<double, kUnknowns, 1>;
using Matrix8d = Eigen::Matrix<double, kUnknowns, kUnknowns>;
using Matrix68d = Eigen::Matrix<double, 6, kUnknowns>;

void Require(bool ok, const char* message) {
  if (!ok) throw std::invalid_argument(std::string("HandEyeConfig: ") + message);
}

std::int64_t ToNs(double seconds) { return static_cast<std::int64_t>(std::llround(seconds * 1e9)); }

// One pair of stamps.
struct Motion {
  std::int64_t from_ns = 0;
  std::int64_t to_ns = 0;
  Eigen::Isometry3d B = Eigen::Isometry3d::Identity();  // The lidar's motion.
  Matrix6d covariance = Matrix6d::Identity();           // Of both motions, right tangent at B.
  int block = 0;                                        // Stretch of the recording it lies in.
};

struct Unknowns {
  Eigen::Isometry3d X = Eigen::Isometry3d::Identity();
  double time_offset_s = 0.0;
  double scale = 1.0;
};

// The body's motion between two stamps of the lidar.
std::optional<Eigen::Isometry3d> BodyMotion(const PoseBuffer& odometry,
                                            const Motion& motion,
                                            const Unknowns& u) {
  // An odometry stamp plus the offset is a lidar stamp.
  const std::int64_t shift = ToNs(u.time_offset_s);
  const auto from = odometry.Lookup(motion.from_ns - shift);
  const auto to = odometry.Lookup(motion.to_ns - shift);
  if (!from || !to) return std::nullopt;
  Eigen::Isometry3d A = from->inverse() * *to;
  A.translation() /= u.scale;
  return A;
}

std::optional<Vector6d> Residual(const PoseBuffer& odometry, const Motion& motion, const Unknowns& u) {
  const auto A = BodyMotion(odometry, motion, u);
  if (!A) return std::nullopt;
  return LogSe3((*A * u.X).inverse() * u.X * motion.B);
}

// Residual and its Jacobian.
bool Linearise(const PoseBuffer& odometry,
               const Motion& motion,
               const Unknowns& u,
               Vector6d* r,
               Matrix68d* J) {
  const auto A = BodyMotion(odometry, motion, u);
  if (!A) return false;
  const Eigen::Isometry3d E = (*A * u.X).inverse() * u.X * motion.B;
  *r = LogSe3(E);
  // X -> X Exp(xi): E -> Exp(-xi) E B^-1 Exp(xi) B = E Exp((Ad(B^-1) - Ad(E^-1)) xi) to first order.
  J->leftCols<6>() = RightJacobianInverseSe3(*r) *
                     (AdjointSe3(motion.B.inverse()) - AdjointSe3(E.inverse()));
  // The odometry's messages are noisy: a difference over 20 ms, not over a message.
  constexpr double kStepS = 0.01;
  Unknowns later = u;
  Unknowns earlier = u;
  later.time_offset_s += kStepS;
  earlier.time_offset_s -= kStepS;
  const auto a = Residual(odometry, motion, later);
  const auto b = Residual(odometry, motion, earlier);
  if (!a || !b) return false;
  J->col(6) = (*a - *b) / (2.0 * kStepS);
  // A's translation is proportional to 1 / scale; its change acts in the body's frame at `to`.
  Vector6d change = Vector6d::Zero();
  change.tail<3>() = A->linear().transpose() * A->translation() / u.scale;
  J->col(7) = RightJacobianInverseSe3(*r) * AdjointSe3(E.inverse()) *
              AdjointSe3(u.X.inverse()) * change;
  return true;
}

struct Normal {
  Matrix8d H = Matrix8d::Zero();
  Vector8d g = Vector8d::Zero();
  double cost = 0.0;
  double weighted_chi2 = 0.0;
  double weights = 0.0;
};

// Cauchy weights: a relocalisation of the tracker must not bend the result.
constexpr double kRobust = 3.0;

Normal Accumulate(const PoseBuffer& odometry,
                  const std::vector<Motion>& motions,
                  const Unknowns& u,
                  int left_out,
                  double scale_sigma) {
  Normal n;
  Vector6d r;
  Matrix68d J;
  for (const Motion& motion : motions) {
    if (motion.block == left_out) continue;
    if (!Linearise(odometry, motion, u, &r, &J)) continue;
    const Eigen::LLT<Matrix6d> llt(motion.covariance);
    const Vector6d wr = llt.matrixL().solve(r);
    const Matrix68d wJ = llt.matrixL().solve(J);
    const double chi2 = wr.squaredNorm() / 6.0;
    const double w = 1.0 / (1.0 + chi2 / (kRobust * kRobust));
    n.H += w * wJ.transpose() * wJ;
    n.g += w * wJ.transpose() * wr;
    n.cost += kRobust * kRobust * std::log1p(chi2 / (kRobust * kRobust));
    n.weighted_chi2 += w * chi2;
    n.weights += w;
  }
  const double info = 1.0 / (scale_sigma * scale_sigma);
  n.H(7, 7) += info;
  n.g(7) += info * (u.scale - 1.0);
  return n;
}

Unknowns Moved(const Unknowns& u, const Vector8d& step, const HandEyeConfig& config) {
  Unknowns out = u;
  out.X = NormalizedSe3(u.X * ExpSe3(step.head<6>()));
  out.time_offset_s =
      std::clamp(u.time_offset_s + step(6), -config.max_time_offset_s, config.max_time_offset_s);
  out.scale = std::clamp(u.scale + step(7), 0.5, 2.0);
  return out;
}

// Robust Levenberg-Marquardt from a start.
Unknowns Solve(const PoseBuffer& odometry,
               const std::vector<Motion>& motions,
               Unknowns u,
               int left_out,
               int iterations,
               const HandEyeConfig& config) {
  // What the motion hardly shows must not run away: a metre, a radian, a second are held weakly.
  Vector8d prior;
  prior << 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0;
  double lambda = 1e-6;
  Normal now = Accumulate(odometry, motions, u, left_out, config.scale_sigma);
  for (int i = 0; i < iterations; ++i) {
    Matrix8d H = now.H;
    H.diagonal() += prior + lambda * now.H.diagonal();
    const Vector8d step = -H.ldlt().solve(now.g);
    if (!step.allFinite()) break;
    const Unknowns next = Moved(u, step, config);
    const Normal then = Accumulate(odometry, motions, next, left_out, config.scale_sigma);
    if (then.cost <= now.cost * (1.0 + 1e-12)) {
      u = next;
      now = then;
      lambda = std::max(lambda * 0.2, 1e-9);
      if (step.head<6>().norm() < 1e-7 && std::abs(step(6)) < 1e-7) break;
    } else {
      lambda = std::max(lambda * 10.0, 1e-6);
      if (lambda > 1e6) break;
    }
  }
  return u;
}

// The offset at which the two speeds of turning agree best [s].
double CoarseTimeOffset(const std::vector<LidarPose>& lidar,
                        const PoseBuffer& odometry,
                        const HandEyeConfig& config) {
  struct Rate {
    std::int64_t from_ns, to_ns;
    double angle;
  };
  std::vector<Rate> rates;
  for (std::size_t i = 0; i + 1 < lidar.size(); ++i) {
    const LidarPose& a = lidar[i];
    const LidarPose& b = lidar[i + 1];
    if (b.stamp_ns - a.stamp_ns > ToNs(0.5)) continue;
    rates.push_back({a.stamp_ns, b.stamp_ns,
                     LogSo3(a.T_map_lidar.linear().transpose() * b.T_map_lidar.linear()).norm()});
  }
  double best = 0.0;
  double best_cost = -1.0;
  constexpr double kStepS = 0.005;
  const int steps = static_cast<int>(std::floor(config.max_time_offset_s / kStepS));
  for (int k = 0; k <= 2 * steps; ++k) {
    // From zero outwards, so that equal costs choose the smallest offset.
    const double offset = kStepS * ((k + 1) / 2) * (k % 2 == 0 ? 1 : -1);
    double sum = 0.0;
    std::size_t count = 0;
    for (const Rate& rate : rates) {
      const auto a = odometry.Lookup(rate.from_ns - ToNs(offset));
      const auto b = odometry.Lookup(rate.to_ns - ToNs(offset));
      if (!a || !b) continue;
      const double off = LogSo3(a->linear().transpose() * b->linear()).norm() - rate.angle;
      sum += std::min(std::abs(off), 0.1);
      ++count;
    }
    if (count < rates.size() / 2 || count == 0) continue;
    const double cost = sum / static_cast<double>(count);
    if (best_cost < 0.0 || cost < best_cost) {
      best_cost = cost;
      best = offset;
    }
  }
  return best;
}

// The rotation that turns the lidar's rotation vectors, and weakly its steps, into the odometry's
// (Kabsch). Steps settle the turn about the axis when the rig has turned about one axis only.
Eigen::Matrix3d CoarseRotation(const PoseBuffer& odometry,
                               const std::vector<Motion>& motions,
                               const Unknowns& u) {
  Eigen::Matrix3d S = Eigen::Matrix3d::Zero();
  for (const Motion& motion : motions) {
    const auto A = BodyMotion(odometry, motion, u);
    if (!A) continue;
    S += LogSo3(A->linear()) * LogSo3(motion.B.linear()).transpose();
    S += 0.05 * A->translation() * motion.B.translation().transpose();
  }
  const Eigen::JacobiSVD<Eigen::Matrix3d> svd(S, Eigen::ComputeFullU | Eigen::ComputeFullV);
  Eigen::Matrix3d D = Eigen::Matrix3d::Identity();
  D(2, 2) = (svd.matrixU() * svd.matrixV().transpose()).determinant() < 0.0 ? -1.0 : 1.0;
  return svd.matrixU() * D * svd.matrixV().transpose();
}

// Covariance of a pose whose information may be singular: directions without any get a metre.
Matrix6d PoseCovariance(const Matrix6d& information) {
  return (information + Matrix6d::Identity()).inverse();
}

std::vector<Motion> MakeMotions(const std::vector<LidarPose>& lidar, const HandEyeConfig& config) {
  std::vector<Motion> motions;
  if (lidar.size() < 2) return motions;
  // The way along the trajectory, for the odometry's drift.
  std::vector<double> way(lidar.size(), 0.0);
  for (std::size_t i = 1; i < lidar.size(); ++i) {
    way[i] = way[i - 1] +
             (lidar[i].T_map_lidar.translation() - lidar[i - 1].T_map_lidar.translation()).norm();
  }
  const double begin_s = NsToSeconds(lidar.front().stamp_ns);
  const double length_s = NsToSeconds(lidar.back().stamp_ns - lidar.front().stamp_ns);
  for (const double window_s : config.windows_s) {
    std::size_t j = 0;
    std::int64_t next_ns = lidar.front().stamp_ns;
    for (std::size_t i = 0; i < lidar.size(); ++i) {
      // Five starts to a window: more would repeat the same errors.
      if (lidar[i].stamp_ns < next_ns) continue;
      next_ns = lidar[i].stamp_ns + ToNs(0.2 * window_s);
      while (j < lidar.size() && NsToSeconds(lidar[j].stamp_ns - lidar[i].stamp_ns) < window_s - 1e-3) {
        ++j;
      }
      if (j == lidar.size()) break;
      const double span_s = NsToSeconds(lidar[j].stamp_ns - lidar[i].stamp_ns);
      if (span_s > 1.5 * window_s) continue;
      Motion motion;
      motion.from_ns = lidar[i].stamp_ns;
      motion.to_ns = lidar[j].stamp_ns;
      motion.B = lidar[i].T_map_lidar.inverse() * lidar[j].T_map_lidar;
      const Matrix6d Ad = AdjointSe3(motion.B.inverse());
      motion.covariance = Ad * PoseCovariance(lidar[i].information) * Ad.transpose() +
                          PoseCovariance(lidar[j].information);
      const double root_m = std::sqrt(way[j] - way[i]);
      const double rotation = std::hypot(config.odometry_sigma_rad, config.odometry_walk_rad * root_m);
      const double position = std::hypot(config.odometry_sigma_m, config.odometry_walk_m * root_m);
      motion.covariance.diagonal().head<3>().array() += rotation * rotation;
      motion.covariance.diagonal().tail<3>().array() += position * position;
      const double middle = 0.5 * NsToSeconds(motion.from_ns + motion.to_ns) - begin_s;
      motion.block = std::clamp(static_cast<int>(middle / length_s * config.jackknife_blocks), 0,
                                config.jackknife_blocks - 1);
      motions.push_back(motion);
    }
  }
  return motions;
}

std::string Text(const char* format, double a, double b = 0.0, double c = 0.0) {
  std::array<char, 256> out{};
  std::snprintf(out.data(), out.size(), format, a, b, c);
  return out.data();
}

// What to do about what is not known, in words.
void Advise(const HandEyeConfig& config, HandEyeResult* result) {
  const Eigen::Vector3d& turn = result->turn_rms_deg;
  const auto turns = [&] {
    return Text("(turned so far, RMS about the lidar's x, y, z: %.1f, %.1f, %.1f degrees)",
                turn.x(), turn.y(), turn.z());
  };
  if (result->num_motions < 20) {
    result->missing.push_back(
        "too little of the two trajectories lies at the same time: record at least 20 s with both "
        "sensors");
    return;
  }
  const bool turns_about_two = result->second_turn_deg >= config.min_turn_deg;
  if (!result->rotation_known || !result->position_known) {
    if (turn.maxCoeff() < config.min_turn_deg) {
      result->missing.push_back(
          "the rig hardly turned: swing it by 20 degrees and more about two axes, one after the "
          "other and back and forth " + turns());
    } else if (!turns_about_two) {
      result->missing.push_back(
          "the rig turned about one axis only, so its place along that axis does not show: tilt it "
          "by 20 degrees and more as well, nodding and rolling " + turns());
    } else {
      result->missing.push_back(
          Text("not sure enough yet (rotation +-%.2f degrees, position +-%.1f cm): move for longer, "
               "with faster and wider turns about two axes ",
               result->rotation_sigma_deg, 100.0 * result->position_sigma_m) + turns());
    }
  }
  if (!result->time_known) {
    const bool unsure = result->time_sigma_s > config.max_time_sigma_s;
    result->missing.push_back(
        "the time offset does not show" +
        (unsure ? Text(" (+-%.1f ms)", 1e3 * result->time_sigma_s) : std::string()) +
        ": turn the rig back and forth briskly, half a second to a side");
  }
}

}  // namespace

void HandEyeConfig::Validate() const {
  Require(!windows_s.empty(), "windows_s must not be empty");
  for (const double window : windows_s) Require(window > 0.0, "windows_s must be > 0");
  Require(max_time_offset_s > 0.0, "max_time_offset_s must be > 0");
  Require(odometry_sigma_rad > 0.0, "odometry_sigma_rad must be > 0");
  Require(odometry_sigma_m > 0.0, "odometry_sigma_m must be > 0");
  Require(odometry_walk_rad >= 0.0, "odometry_walk_rad must be >= 0");
  Require(odometry_walk_m >= 0.0, "odometry_walk_m must be >= 0");
  Require(scale_sigma > 0.0, "scale_sigma must be > 0");
  Require(max_rotation_sigma_deg > 0.0, "max_rotation_sigma_deg must be > 0");
  Require(max_position_sigma_m > 0.0, "max_position_sigma_m must be > 0");
  Require(max_time_sigma_s > 0.0, "max_time_sigma_s must be > 0");
  Require(min_turn_deg > 0.0, "min_turn_deg must be > 0");
  Require(jackknife_blocks >= 3, "jackknife_blocks must be >= 3");
}

HandEyeResult SolveHandEye(const std::vector<LidarPose>& lidar,
                           const PoseBuffer& odometry,
                           const HandEyeConfig& config) {
  config.Validate();
  HandEyeResult result;
  for (std::size_t i = 1; i < lidar.size(); ++i) {
    result.distance_m +=
        (lidar[i].T_map_lidar.translation() - lidar[i - 1].T_map_lidar.translation()).norm();
  }
  std::vector<Motion> motions = MakeMotions(lidar, config);
  Unknowns u;
  u.time_offset_s = CoarseTimeOffset(lidar, odometry, config);
  motions.erase(std::remove_if(motions.begin(), motions.end(),
                               [&](const Motion& m) { return !BodyMotion(odometry, m, u); }),
                motions.end());
  result.num_motions = static_cast<int>(motions.size());
  if (motions.size() < 20) {
    Advise(config, &result);
    return result;
  }

  Eigen::Matrix3d turning = Eigen::Matrix3d::Zero();
  for (const Motion& motion : motions) {
    const Eigen::Vector3d angle = kRadToDeg * LogSo3(motion.B.linear());
    turning += angle * angle.transpose() / static_cast<double>(motions.size());
  }
  result.turn_rms_deg = turning.diagonal().cwiseSqrt();
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> axes(turning);
  result.second_turn_deg = std::sqrt(std::max(0.0, axes.eigenvalues()[1]));

  u.X.linear() = CoarseRotation(odometry, motions, u);
  constexpr int kNoBlock = -1;
  u = Solve(odometry, motions, u, kNoBlock, 50, config);
  result.T_body_lidar = u.X;
  result.time_offset_s = u.time_offset_s;
  result.scale = u.scale;

  const Normal at_end = Accumulate(odometry, motions, u, kNoBlock, config.scale_sigma);
  Matrix8d H = at_end.H;
  H.diagonal().head<7>().array() += 1e-9;
  // Motions overlap by four fifths and their errors go together: five say what one says.
  constexpr double kOverlap = 5.0;
  const double variance =
      kOverlap * std::max(0.2, at_end.weighted_chi2 / std::max(at_end.weights, 1.0));
  Matrix8d covariance = variance * H.inverse();

  Matrix8d spread = Matrix8d::Zero();
  std::vector<Vector8d> estimates;
  for (int block = 0; block < config.jackknife_blocks; ++block) {
    const Unknowns v = Solve(odometry, motions, u, block, 3, config);
    Vector8d d;
    d << LogSe3(u.X.inverse() * v.X), v.time_offset_s - u.time_offset_s, v.scale - u.scale;
    estimates.push_back(d);
  }
  Vector8d mean = Vector8d::Zero();
  for (const Vector8d& d : estimates) mean += d / static_cast<double>(estimates.size());
  for (const Vector8d& d : estimates) spread += (d - mean) * (d - mean).transpose();
  spread *= static_cast<double>(estimates.size() - 1) / static_cast<double>(estimates.size());
  covariance += spread;
  result.covariance = covariance.topLeftCorner<6, 6>();
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> rotation(covariance.topLeftCorner<3, 3>());
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> position(covariance.block<3, 3>(3, 3));
  result.rotation_sigma_deg = kRadToDeg * std::sqrt(std::max(0.0, rotation.eigenvalues()[2]));
  result.position_sigma_m = std::sqrt(std::max(0.0, position.eigenvalues()[2]));
  result.least_sure_direction = position.eigenvectors().col(2);
  result.time_sigma_s = std::sqrt(std::max(0.0, covariance(6, 6)));

  double weights = 0.0;
  double rotation2 = 0.0;
  double position2 = 0.0;
  for (const Motion& motion : motions) {
    const auto r = Residual(odometry, motion, u);
    if (!r) continue;
    const double chi2 = r->dot(motion.covariance.llt().solve(*r)) / 6.0;
    const double w = 1.0 / (1.0 + chi2 / (kRobust * kRobust));
    weights += w;
    rotation2 += w * r->head<3>().squaredNorm();
    position2 += w * r->tail<3>().squaredNorm();
  }
  result.residual_rotation_deg = kRadToDeg * std::sqrt(rotation2 / weights);
  result.residual_position_m = std::sqrt(position2 / weights);

  const bool turns = result.second_turn_deg >= config.min_turn_deg;
  const bool at_limit = std::abs(u.time_offset_s) >= config.max_time_offset_s - 1e-6;
  result.rotation_known = turns && result.rotation_sigma_deg <= config.max_rotation_sigma_deg;
  result.position_known = turns && result.position_sigma_m <= config.max_position_sigma_m;
  result.time_known = result.time_sigma_s <= config.max_time_sigma_s && !at_limit &&
                      result.turn_rms_deg.maxCoeff() >= config.min_turn_deg;
  Advise(config, &result);
  return result;
}

}  // namespace dendro
