#include "dendro_slam/odometry/rig_calibrator.h"

#include <algorithm>
#include <cmath>
#include <optional>
#include <stdexcept>
#include <unordered_set>

#include "dendro_slam/geometry/so3.h"
#include "dendro_slam/sensors/deskew.h"

namespace dendro {

namespace {

void Require(bool ok, const char* message) {
  if (!ok) throw std::invalid_argument(std::string("RigCalibratorConfig: ") + message);
}

std::int64_t ToNs(double seconds) { return static_cast<std::int64_t>(std::llround(seconds * 1e9)); }

}  // namespace

void RigCalibratorConfig::Validate() const {
  Require(max_points >= 200, "max_points must be >= 200");
  Require(min_range_m >= 0.0, "min_range_m must be >= 0");
  Require(max_range_m > min_range_m, "max_range_m must be > min_range_m");
  Require(spread_m > 0.0, "spread_m must be > 0");
  Require(max_scans >= 20, "max_scans must be >= 20");
  Require(passes >= 1, "passes must be >= 1");
  registration.Validate();
  hand_eye.Validate();
}

RigCalibrator::RigCalibrator(const RigCalibratorConfig& config) : config_(config) {
  config_.Validate();
}

bool RigCalibrator::AddScan(const LidarScan& scan) {
  ++given_;
  if (!scan.has_time || scan.stamp_ns <= last_stamp_ns_) return false;
  if (static_cast<int>(sweeps_.size()) >= config_.max_scans) return false;
  const auto [begin_s, end_s] = ScanTimeSpan(scan);
  Sweep sweep;
  const double middle_s = 0.5 * (begin_s + end_s);
  sweep.middle_ns = scan.stamp_ns + ToNs(middle_s);
  sweep.half_s = static_cast<float>(0.5 * (end_s - begin_s));
  // One return per cube: near surfaces do not drown the far ones.
  std::unordered_set<std::uint64_t> taken;
  const float scale = 1.0F / static_cast<float>(config_.spread_m);
  for (const LidarPoint& point : scan.points) {
    if (!point.position.allFinite() || !std::isfinite(point.time_s)) continue;
    const double range = point.position.norm();
    if (range < config_.min_range_m || range > config_.max_range_m) continue;
    const Eigen::Vector3i cube = (point.position * scale).array().floor().cast<int>();
    std::uint64_t key = 0;
    for (int axis = 0; axis < 3; ++axis) {
      key = key << 21 | (static_cast<std::uint64_t>(cube[axis] + (1 << 20)) & 0x1FFFFFULL);
    }
    if (!taken.insert(key).second) continue;
    sweep.returns.push_back({point.position, static_cast<float>(point.time_s - middle_s)});
  }
  const auto limit = static_cast<std::size_t>(config_.max_points);
  if (sweep.returns.size() > limit) {
    std::vector<Return> kept;
    kept.reserve(limit);
    for (std::size_t i = 0; i < limit; ++i) {
      kept.push_back(sweep.returns[i * sweep.returns.size() / limit]);
    }
    sweep.returns = std::move(kept);
  }
  if (static_cast<int>(sweep.returns.size()) < config_.registration.min_matches) return false;
  last_stamp_ns_ = scan.stamp_ns;
  sweeps_.push_back(std::move(sweep));
  return true;
}

std::vector<LidarPose> RigCalibrator::Track(const PoseBuffer& odometry,
                                            const HandEyeResult* rig,
                                            const std::function<void(double)>& progress,
                                            std::vector<double>* rms) const {
  std::vector<LidarPose> poses;
  ScanToMap map(config_.registration);
  Vector6d twist = Vector6d::Zero();  // Of the lidar, body frame, per second.
  std::vector<Eigen::Vector3f> points;
  const std::int64_t shift = rig != nullptr ? ToNs(rig->time_offset_s) : 0;
  const auto lidar_in_odom = [&](std::int64_t stamp_ns) -> std::optional<Eigen::Isometry3d> {
    if (rig == nullptr) return std::nullopt;
    const auto pose = odometry.Lookup(stamp_ns - shift);
    if (!pose) return std::nullopt;
    return *pose * rig->T_body_lidar;
  };
  for (std::size_t k = 0; k < sweeps_.size(); ++k) {
    const Sweep& sweep = sweeps_[k];
    if (progress) progress(static_cast<double>(k) / static_cast<double>(sweeps_.size()));
    const auto T_odom_now = lidar_in_odom(sweep.middle_ns);
    const bool has_odometry = T_odom_now.has_value();
    Eigen::Isometry3d guess = Eigen::Isometry3d::Identity();
    const double gap_s =
        poses.empty() ? 0.0 : NsToSeconds(sweep.middle_ns - poses.back().stamp_ns);
    if (!poses.empty()) {
      guess = poses.back().T_map_lidar * ExpSe3(twist * std::min(gap_s, 0.5));
      const auto T_odom_before = lidar_in_odom(poses.back().stamp_ns);
      if (has_odometry && T_odom_before) {
        guess = poses.back().T_map_lidar * (T_odom_before->inverse() * *T_odom_now);
      }
    }
    std::optional<SweepMotion> motion;
    if (has_odometry) {
      motion = MakeSweepMotion(odometry, rig->T_body_lidar, sweep.middle_ns - shift,
                               -static_cast<double>(sweep.half_s), sweep.half_s, 2e-3);
    }
    // Without odometry the sweep's motion follows from the pose and the pose from the sweep: twice.
    const int rounds = motion || poses.empty() ? 1 : 2;
    std::optional<MapRegistration> found;
    for (int round = 0; round < rounds; ++round) {
      const SweepMotion sweep_motion =
          motion ? *motion
                 : SweepMotion::ConstantVelocity(twist, -static_cast<double>(sweep.half_s) - 1e-3,
                                                 static_cast<double>(sweep.half_s) + 1e-3);
      points.clear();
      for (const Return& r : sweep.returns) {
        points.push_back(
            sweep_motion.TransformPoint(static_cast<double>(r.time_s), r.position.cast<double>())
                .cast<float>());
      }
      if (poses.empty()) break;
      found = map.Register(points, found ? found->T_map_scan : guess);
      if (!found) break;
      if (gap_s > 0.0 && gap_s < 0.5) {
        twist = LogSe3(poses.back().T_map_lidar.inverse() * found->T_map_scan) / gap_s;
      }
    }
    if (poses.empty()) {
      LidarPose first;
      first.stamp_ns = sweep.middle_ns;
      first.information = Matrix6d::Identity() * 1e6;
      poses.push_back(first);
      map.Add(points, first.T_map_lidar);
      continue;
    }
    if (!found) {
      // The next scan starts from the guess.
      continue;
    }
    LidarPose pose;
    pose.stamp_ns = sweep.middle_ns;
    pose.T_map_lidar = found->T_map_scan;
    pose.information = found->information;
    poses.push_back(pose);
    rms->push_back(found->rms_m);
    map.Add(points, pose.T_map_lidar);
  }
  return poses;
}

RigCalibration RigCalibrator::Calibrate(const PoseBuffer& odometry,
                                        const std::function<void(double)>& progress) const {
  RigCalibration out;
  out.scans = given_;
  for (int pass = 0; pass < config_.passes; ++pass) {
    const auto report = [&](double fraction) {
      if (progress) progress((pass + fraction) / config_.passes);
    };
    std::vector<double> rms;
    const HandEyeResult before = out.rig;
    const std::vector<LidarPose> poses = Track(odometry, pass == 0 ? nullptr : &before, report, &rms);
    const HandEyeResult rig = SolveHandEye(poses, odometry, config_.hand_eye);
    out.rig = rig;
    out.passes = pass + 1;
    out.lidar = poses;
    out.registered = static_cast<int>(poses.size());
    if (!rms.empty()) {
      std::nth_element(rms.begin(), rms.begin() + static_cast<std::ptrdiff_t>(rms.size() / 2), rms.end());
      out.registration_rms_m = rms[rms.size() / 2];
    }
    // A mounting far from known makes a worse sweep than none.
    const bool usable = rig.rotation_sigma_deg < 2.0 && rig.position_sigma_m < 0.2 &&
                        rig.num_motions >= 20 && rig.time_sigma_s < 0.01;
    if (!usable) break;
    if (pass > 0) {
      const Vector6d change = LogSe3(before.T_body_lidar.inverse() * rig.T_body_lidar);
      if (change.head<3>().norm() < 5e-4 && change.tail<3>().norm() < 5e-4 &&
          std::abs(rig.time_offset_s - before.time_offset_s) < 2e-4) {
        break;
      }
    }
  }
  if (progress) progress(1.0);
  if (2 * out.registered < out.scans && out.scans > 0) {
    out.rig.rotation_known = out.rig.position_known = out.rig.time_known = false;
    out.rig.missing.insert(out.rig.missing.begin(),
                           "most scans could not be followed: walk where walls, trunks and the ground "
                           "surround the lidar, and begin standing still");
  }
  return out;
}

}  // namespace dendro
