#include "dendro_slam/sim/lidar_simulator.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <condition_variable>
#include <exception>
#include <map>
#include <mutex>
#include <stdexcept>
#include <thread>

#include "counter_rng.h"
#include "dendro_slam/sim/flight_path.h"

namespace dendro {
namespace {

/// Streams of random numbers, so that switching one effect off leaves the others unchanged.
enum Stream : std::uint64_t {
  kStreamDetection = 1,
  kStreamDropout,
  kStreamRange,
  kStreamRangeLast,
  kStreamIntensity,
  kStreamBias
};

constexpr int kLasers = vlp16::kLasers;

/// The surfaces of one beam that the sensor takes for one target.
struct Echo {
  double energy = 0.0;         ///< Sum of reflectivity cos(incidence) / range^2 over the footprint.
  double reflected = 0.0;      ///< Sum of reflectivity cos(incidence) over the footprint.
  double range_m = 0.0;        ///< Weighted by energy.
  double fraction = 0.0;       ///< Part of the footprint.
  double max_reflectivity = 0.0;
  PointTruth truth;
};

struct SubHit {
  double range_m;
  double energy;
  double reflected;
  const RayHit* hit;
};

/// Buffers of one scan, so that no beam allocates.
struct Workspace {
  RayBundle bundle;
  std::vector<RayHit> hits;
  std::vector<SubHit> sorted;
  std::vector<Echo> echoes;
};

PointTruth TruthOf(const RayHit& hit) {
  PointTruth truth;
  truth.kind = hit.kind;
  truth.tree_id = hit.tree_id;
  truth.branch_id = hit.branch_id;
  return truth;
}

/// Groups the sub-rays' hits into echoes, near to far.
void FindEchoes(const LidarSimulatorConfig& config, std::size_t sub_rays, Workspace* w) {
  w->sorted.clear();
  w->echoes.clear();
  const double weight = 1.0 / static_cast<double>(sub_rays);
  for (std::size_t i = 0; i < sub_rays; ++i) {
    const RayHit& hit = w->hits[i];
    if (hit.kind == SurfaceKind::kNone) continue;
    const double cosine = std::max(1e-3, -hit.normal.dot(w->bundle.directions[i]));
    const double reflected = weight * hit.reflectivity * cosine;
    const double range = std::max(hit.range_m, 1e-3);
    w->sorted.push_back({hit.range_m, reflected / (range * range), reflected, &hit});
  }
  std::stable_sort(w->sorted.begin(), w->sorted.end(),
                   [](const SubHit& a, const SubHit& b) { return a.range_m < b.range_m; });
  for (std::size_t begin = 0; begin < w->sorted.size();) {
    std::size_t end = begin + 1;
    while (end < w->sorted.size() &&
           w->sorted[end].range_m - w->sorted[end - 1].range_m <= config.echo_separation_m) {
      ++end;
    }
    Echo echo;
    double best_energy = -1.0;
    for (std::size_t i = begin; i < end; ++i) {
      const SubHit& s = w->sorted[i];
      echo.energy += s.energy;
      echo.reflected += s.reflected;
      echo.range_m += s.energy * s.range_m;
      echo.fraction += weight;
      echo.max_reflectivity = std::max(echo.max_reflectivity, s.hit->reflectivity);
      // The surface with the most energy names the echo.
      double same = 0.0;
      for (std::size_t k = begin; k < end; ++k) {
        const RayHit& other = *w->sorted[k].hit;
        if (other.kind == s.hit->kind && other.tree_id == s.hit->tree_id &&
            other.branch_id == s.hit->branch_id) {
          same += w->sorted[k].energy;
        }
      }
      if (same > best_energy) {
        best_energy = same;
        echo.truth = TruthOf(*s.hit);
      }
    }
    echo.range_m = echo.energy > 0.0 ? echo.range_m / echo.energy : w->sorted[begin].range_m;
    w->echoes.push_back(echo);
    begin = end;
  }
}

}  // namespace

void LidarSimulatorConfig::Validate() const {
  const auto require = [](bool ok, const char* message) {
    if (!ok) throw std::invalid_argument(message);
  };
  const auto at_least_zero = [&](double value, const char* message) {
    require(std::isfinite(value) && value >= 0.0, message);
  };
  require(rpm >= vlp16::kMinRpm && rpm <= vlp16::kMaxRpm, "rpm: expected 300 to 1200");
  require(return_mode == "strongest" || return_mode == "last" || return_mode == "dual",
          "return_mode: expected strongest, last or dual");
  at_least_zero(range_sigma_m, "range_sigma_m: expected >= 0");
  at_least_zero(range_uniform_m, "range_uniform_m: expected >= 0");
  at_least_zero(laser_bias_sigma_m, "laser_bias_sigma_m: expected >= 0");
  at_least_zero(aperture_width_m, "aperture_width_m: expected >= 0");
  at_least_zero(aperture_height_m, "aperture_height_m: expected >= 0");
  at_least_zero(divergence_width_rad, "divergence_width_rad: expected >= 0");
  at_least_zero(divergence_height_rad, "divergence_height_rad: expected >= 0");
  require(sub_rays_width >= 1 && sub_rays_height >= 1 && sub_rays_width * sub_rays_height <= 255,
          "sub_rays_width, sub_rays_height: expected at least 1 and a product of at most 255");
  at_least_zero(echo_separation_m, "echo_separation_m: expected >= 0");
  require(detection_fraction >= 0.0 && detection_fraction <= 1.0,
          "detection_fraction: expected 0 to 1");
  require(std::isfinite(range_10_percent_m) && range_10_percent_m > 0.0,
          "range_10_percent_m: expected > 0");
  at_least_zero(detection_softness, "detection_softness: expected >= 0");
  require(dropout_probability >= 0.0 && dropout_probability <= 1.0,
          "dropout_probability: expected 0 to 1");
  at_least_zero(intensity_sigma, "intensity_sigma: expected >= 0");
  at_least_zero(min_range_m, "min_range_m: expected >= 0");
  require(std::isfinite(max_range_m) && max_range_m > min_range_m,
          "max_range_m: expected more than min_range_m");
  require(max_range_m <= 131.0, "max_range_m: expected at most 131 (16 bits of 2 mm)");
}

LidarSimulator::LidarSimulator(const Raycaster& raycaster,
                               const LidarSimulatorConfig& config,
                               std::int64_t start_stamp_ns)
    : raycaster_(raycaster), config_(config), start_stamp_ns_(start_stamp_ns) {
  config_.Validate();
  if (config_.enable_laser_bias) {
    for (int laser = 0; laser < kLasers; ++laser) {
      CounterRng rng(static_cast<std::uint64_t>(config_.seed), static_cast<std::uint64_t>(laser), kStreamBias);
      laser_bias_m_[static_cast<std::size_t>(laser)] = config_.laser_bias_sigma_m * rng.Gauss();
    }
  }
}

std::int64_t LidarSimulator::FirstFiring(int scan_index) const {
  const double firings = vlp16::FiringsPerRevolution(config_.rpm) * scan_index;
  return static_cast<std::int64_t>(std::ceil(firings - 1e-9));
}

std::int64_t LidarSimulator::ScanStamp(int scan_index) const {
  return start_stamp_ns_ + FirstFiring(scan_index) * std::llround(vlp16::kFiringPeriodS * 1e9);
}

int LidarSimulator::NumScans(double duration_s) const {
  return std::max(0, static_cast<int>(std::floor(duration_s * config_.rpm / 60.0 + 1e-9)));
}

SimulatedScan LidarSimulator::SimulateScan(int scan_index, const Eigen::Isometry3d& T_map_lidar) const {
  return SimulateScan(scan_index, [&](std::int64_t) { return T_map_lidar; });
}

SimulatedScan LidarSimulator::SimulateScan(int scan_index, const LidarPoseFunction& T_map_lidar) const {
  if (scan_index < 0) throw std::invalid_argument("scan_index: expected >= 0");
  const std::int64_t first = FirstFiring(scan_index);
  const std::int64_t last = FirstFiring(scan_index + 1);
  const std::int64_t firing_period_ns = std::llround(vlp16::kFiringPeriodS * 1e9);
  const double pitch_deg = vlp16::FiringPitchDeg(config_.rpm);
  const double rate_deg = vlp16::AzimuthRateDegPerS(config_.rpm);
  const auto seed = static_cast<std::uint64_t>(config_.seed);
  const bool dual = config_.return_mode == "dual";
  const bool last_mode = config_.return_mode == "last";

  SimulatedScan out;
  out.scan.stamp_ns = ScanStamp(scan_index);
  out.T_map_lidar = T_map_lidar(out.scan.stamp_ns);
  const auto num_firings = static_cast<std::size_t>(last - first);
  out.firings.resize(num_firings);
  out.scan.points.reserve(num_firings * kLasers);
  out.truth.reserve(num_firings * kLasers);
  if (config_.record_all_beams) out.beams.resize(num_firings * kLasers);

  // Sub-rays in the beam's own frame: x along the beam, y to the left, z up.
  const int nw = config_.enable_footprint ? config_.sub_rays_width : 1;
  const int nh = config_.enable_footprint ? config_.sub_rays_height : 1;
  const auto sub_rays = static_cast<std::size_t>(nw * nh);
  std::vector<Eigen::Vector2d> sub(sub_rays);
  for (int j = 0; j < nh; ++j) {
    for (int i = 0; i < nw; ++i) {
      // To and fro across the beam, so that each sub-ray is next to the one before.
      const int column = j % 2 == 0 ? i : nw - 1 - i;
      sub[static_cast<std::size_t>(j * nw + i)] = {(column + 0.5) / nw - 0.5, (j + 0.5) / nh - 0.5};
    }
  }
  // With an odd grid the middle sub-ray is the central ray; else the central ray is one more.
  const bool has_centre = nw % 2 == 1 && nh % 2 == 1;
  const std::size_t rays = sub_rays + (has_centre ? 0 : 1);
  const std::size_t centre = has_centre ? sub_rays / 2 : sub_rays;
  Workspace w;
  w.bundle.origins.resize(rays);
  w.bundle.directions.resize(rays);
  if (config_.enable_footprint) {
    w.bundle.half_width_m = 0.5 * std::hypot(config_.aperture_width_m, config_.aperture_height_m);
    w.bundle.half_angle_rad = 0.5 * std::hypot(config_.divergence_width_rad, config_.divergence_height_rad);
  }
  const double energy_limit = 0.1 / (config_.range_10_percent_m * config_.range_10_percent_m);
  // Beyond the largest range nothing returns, but an echo's mean may lie nearer than its hits.
  const double cast_range_m = config_.max_range_m + 1.0;

  for (std::int64_t k = first; k < last; ++k) {
    const auto firing_index = static_cast<std::size_t>(k - first);
    const std::int64_t stamp_ns = start_stamp_ns_ + k * firing_period_ns;
    const Eigen::Isometry3d T = T_map_lidar(stamp_ns);
    RawFiring& firing = out.firings[firing_index];
    firing.stamp_ns = stamp_ns;
    firing.azimuth_deg = vlp16::WrapAzimuthDeg(static_cast<double>(k) * pitch_deg);
    const double azimuth_in_turn_deg = static_cast<double>(k) * pitch_deg - 360.0 * scan_index;

    for (int laser = 0; laser < kLasers; ++laser) {
      const auto l = static_cast<std::size_t>(laser);
      const double azimuth_deg = azimuth_in_turn_deg + rate_deg * vlp16::LaserTimeS(laser);
      const Eigen::Vector3d direction_lidar = vlp16::BeamDirection(laser, azimuth_deg);
      const Eigen::Vector3d origin = T * vlp16::BeamOrigin(laser);
      const Eigen::Vector3d direction = T.linear() * direction_lidar;
      const double a = azimuth_deg * vlp16::kDegToRad;
      const Eigen::Vector3d left = T.linear() * Eigen::Vector3d(std::sin(a), std::cos(a), 0.0);
      const Eigen::Vector3d up = direction.cross(left);
      w.bundle.origin = origin;
      w.bundle.direction = direction;
      if (config_.enable_footprint) {
        for (std::size_t i = 0; i < sub_rays; ++i) {
          w.bundle.origins[i] = origin + sub[i].x() * config_.aperture_width_m * left +
                                sub[i].y() * config_.aperture_height_m * up;
          w.bundle.directions[i] = (direction + sub[i].x() * config_.divergence_width_rad * left +
                                    sub[i].y() * config_.divergence_height_rad * up)
                                       .normalized();
        }
      }
      w.bundle.origins[centre] = origin;
      w.bundle.directions[centre] = direction;
      raycaster_.CastBundle(w.bundle, cast_range_m, &w.hits);

      const RayHit& central = w.hits[centre];
      PointTruth beam_truth = TruthOf(central);
      if (central.kind != SurfaceKind::kNone) {
        beam_truth.thin_range_m = static_cast<float>(central.range_m);
      }
      if (config_.record_all_beams) out.beams[firing_index * kLasers + l] = beam_truth;

      FindEchoes(config_, sub_rays, &w);
      if (w.echoes.empty()) continue;

      const std::uint64_t key = static_cast<std::uint64_t>(k) * kLasers + l;
      double limit_factor = 1.0;
      if (config_.enable_detection_limit && config_.detection_softness > 0.0) {
        limit_factor = std::exp(config_.detection_softness * CounterRng(seed, key, kStreamDetection).Gauss());
      }
      int strongest = -1, second = -1, farthest = -1;
      for (std::size_t e = 0; e < w.echoes.size(); ++e) {
        const Echo& echo = w.echoes[e];
        if (echo.range_m < config_.min_range_m || echo.range_m > config_.max_range_m) continue;
        if (config_.enable_detection_limit &&
            (echo.fraction < config_.detection_fraction * limit_factor ||
             echo.energy < energy_limit * limit_factor)) {
          continue;
        }
        const int index = static_cast<int>(e);
        if (strongest < 0 || echo.energy > w.echoes[static_cast<std::size_t>(strongest)].energy) {
          second = strongest;
          strongest = index;
        } else if (second < 0 || echo.energy > w.echoes[static_cast<std::size_t>(second)].energy) {
          second = index;
        }
        farthest = index;
      }
      if (strongest < 0) continue;
      if (config_.enable_dropouts && config_.dropout_probability > 0.0 &&
          CounterRng(seed, key, kStreamDropout).Uniform() < config_.dropout_probability) {
        continue;
      }
      // Manual, section 6.2: in dual mode, when the strongest return is also the last, the second
      // strongest takes the strongest's place.
      if (dual && strongest == farthest && second >= 0) strongest = second;

      const auto measure = [&](int index, Stream stream) {
        const Echo& echo = w.echoes[static_cast<std::size_t>(index)];
        RawReturn r;
        double range = echo.range_m + laser_bias_m_[l];
        if (config_.enable_range_noise) {
          CounterRng noise(seed, key, stream);
          range += config_.range_sigma_m * noise.Gauss();
          range += noise.Uniform(-config_.range_uniform_m, config_.range_uniform_m);
        }
        if (config_.enable_quantisation) {
          range = vlp16::kRangeResolutionM * std::round(range / vlp16::kRangeResolutionM);
        }
        r.range_m = static_cast<float>(std::clamp(range, vlp16::kRangeResolutionM, 131.0));
        double level = echo.reflected;
        if (config_.enable_intensity_noise) {
          level *= 1.0 + config_.intensity_sigma *
                             CounterRng(seed, key, kStreamIntensity + 16 * stream).Gauss();
        }
        // Calibrated reflectivity: 0 to 100 diffuse, 101 to 255 retro-reflectors (manual).
        const double value = echo.max_reflectivity > 1.0 ? std::clamp(100.0 + 50.0 * level, 101.0, 255.0)
                                                         : std::clamp(100.0 * level, 0.0, 100.0);
        r.reflectivity = static_cast<std::uint8_t>(std::lround(value));
        return r;
      };
      firing.strongest[l] = measure(strongest, kStreamRange);
      firing.last[l] = farthest == strongest ? firing.strongest[l] : measure(farthest, kStreamRangeLast);

      const auto emit = [&](int index, const RawReturn& r) {
        LidarPoint point;
        point.position = vlp16::PointAt(laser, azimuth_deg, static_cast<double>(r.range_m)).cast<float>();
        point.intensity = static_cast<float>(r.reflectivity);
        point.time_s = static_cast<float>(static_cast<double>(k - first) * vlp16::kFiringPeriodS +
                                          vlp16::LaserTimeS(laser));
        point.ring = static_cast<std::uint16_t>(vlp16::RingOfLaser(laser));
        out.scan.points.push_back(point);
        PointTruth truth = w.echoes[static_cast<std::size_t>(index)].truth;
        truth.thin_range_m = beam_truth.thin_range_m;
        out.truth.push_back(truth);
      };
      if (last_mode) {
        emit(farthest, firing.last[l]);
      } else {
        emit(strongest, firing.strongest[l]);
        if (dual && farthest != strongest) emit(farthest, firing.last[l]);
      }
    }
  }
  return out;
}

void SimulateFlight(const LidarSimulator& simulator,
                    const FlightPath& path,
                    int threads,
                    const std::function<bool(int scan_index, const SimulatedScan& scan)>& consumer) {
  if (threads < 1) throw std::invalid_argument("threads: expected at least 1");
  const int count = simulator.NumScans(path.duration_s);
  const LidarPoseFunction pose = [&path](std::int64_t stamp_ns) { return path.LidarPose(stamp_ns); };
  if (threads == 1) {
    for (int i = 0; i < count; ++i) {
      if (!consumer(i, simulator.SimulateScan(i, pose))) return;
    }
    return;
  }
  std::mutex mutex;
  std::condition_variable changed;
  std::map<int, SimulatedScan> done;
  std::exception_ptr error;
  int next = 0, delivered = 0;
  bool stop = false;
  const int lead = 2 * threads;
  const auto work = [&] {
    while (true) {
      int index = 0;
      {
        std::unique_lock<std::mutex> lock(mutex);
        changed.wait(lock, [&] { return stop || next >= count || next < delivered + lead; });
        if (stop || next >= count) return;
        index = next++;
      }
      try {
        SimulatedScan scan = simulator.SimulateScan(index, pose);
        const std::lock_guard<std::mutex> lock(mutex);
        done.emplace(index, std::move(scan));
      } catch (...) {
        const std::lock_guard<std::mutex> lock(mutex);
        error = std::current_exception();
        stop = true;
      }
      changed.notify_all();
    }
  };
  std::vector<std::thread> pool;
  for (int i = 0; i < threads; ++i) pool.emplace_back(work);
  const auto finish = [&] {
    {
      const std::lock_guard<std::mutex> lock(mutex);
      stop = true;
    }
    changed.notify_all();
    for (std::thread& thread : pool) thread.join();
  };
  try {
    while (delivered < count) {
      SimulatedScan scan;
      {
        std::unique_lock<std::mutex> lock(mutex);
        changed.wait(lock, [&] { return error || done.count(delivered) > 0; });
        if (error) break;
        scan = std::move(done[delivered]);
        done.erase(delivered);
      }
      const bool go_on = consumer(delivered, scan);
      {
        const std::lock_guard<std::mutex> lock(mutex);
        ++delivered;
      }
      changed.notify_all();
      if (!go_on) break;
    }
  } catch (...) {
    finish();
    throw;
  }
  finish();
  if (error) std::rethrow_exception(error);
}

}  // namespace dendro
