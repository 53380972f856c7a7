// Laps around the same trees: how an update's time, the memory and the error of the factor graph behave over a long run.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <map>
#include <random>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <fmt/core.h>
#include <fmt/ostream.h>
#include <nlohmann/json.hpp>

#include "dendro_slam/factor_graph/between_factor.h"
#include "dendro_slam/factor_graph/cylinder_factor.h"
#include "dendro_slam/factor_graph/incremental_solver.h"
#include "dendro_slam/factor_graph/junction_point_factor.h"
#include "dendro_slam/factor_graph/prior_factor.h"
#include "dendro_slam/factor_graph/scan_summary.h"
#include "dendro_slam/geometry/se3.h"
#include "measure.h"

namespace {

using dendro::Cylinder;
using dendro::FactorList;
using dendro::Key;
using dendro::NoiseModel;
using dendro::Vector5d;
using dendro::Vector6d;
using Eigen::Isometry3d;
using Eigen::Vector3d;

constexpr double kScanRateHz = 10.0;
constexpr double kRingRadiusM = 7.0;       // Of the flight around the trees.
constexpr double kTreesRadiusM = 4.0;      // The cylinders stand within it.
constexpr double kHalfLengthM = 0.5;       // From the middle of a cylinder to its ends.
constexpr double kPriorSigma = 1e-4;
constexpr double kOdometryRotationSigma = 0.001;    // Per scan [rad].
constexpr double kOdometryTranslationSigma = 0.005; // Per scan [m].
constexpr double kPointSigmaM = 0.02;

struct Options {
  double minutes = 10.0;
  double laps_per_minute = 1.0;
  int cylinders = 40;
  int seen = 12;               // Cylinders observed from a pose: the nearest ones.
  int seed = 1;
  double key_frame_hz = kScanRateHz;
  // What becomes of the scans between key frames: "drop"; "summarize": one cylinder factor per landmark on
  // the next key frame; "marginalize": poses of the graph until the next key frame is there.
  std::string between = "drop";
  std::string landmarks = "cylinders";
  std::string write;           // The same measurements for another solver.
};

// One pose of the run: odometry from the pose before and what was seen.
struct Scan {
  Isometry3d odometry = Isometry3d::Identity();
  struct Observation {
    int cylinder = 0;
    Cylinder measured;                   // In the sensor frame.
    std::array<Vector3d, 2> ends;        // The two ends, measured each on its own.
  };
  std::vector<Observation> observations;
};

struct Run {
  std::vector<Cylinder> truth;
  Isometry3d first = Isometry3d::Identity();
  std::vector<Scan> scans;
  Vector6d odometry_sigma;
  Vector5d cylinder_sigma;
};

template <int N>
Eigen::Matrix<double, N, 1> Normal(std::mt19937* rng) {
  std::normal_distribution<double> normal;
  Eigen::Matrix<double, N, 1> v;
  for (int i = 0; i < N; ++i) v[i] = normal(*rng);
  return v;
}

// Scans from one key frame to the next.
int KeyFrameStride(const Options& options) {
  return std::max(1, static_cast<int>(std::lround(kScanRateHz / options.key_frame_hz)));
}

Run Simulate(const Options& options) {
  std::mt19937 rng(static_cast<unsigned>(options.seed));
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  Run run;
  run.cylinder_sigma << 0.02, 0.02, 0.015, 0.015, 0.4;
  for (int i = 0; i < options.cylinders; ++i) {
    const double radius = kTreesRadiusM * std::sqrt(uniform(rng));
    const double angle = 2.0 * M_PI * uniform(rng);
    Cylinder c;
    c.axis = (Vector3d::UnitZ() + 0.6 * Normal<3>(&rng)).normalized();
    c.point = Vector3d(radius * std::cos(angle), radius * std::sin(angle), 0.5 + 3.0 * uniform(rng));
    c.curvature = 1.0 / (0.04 + 0.16 * uniform(rng));
    run.truth.push_back(c);
  }
  const int stride = options.between == "drop" ? KeyFrameStride(options) : 1;
  const int count = static_cast<int>(std::lround(options.minutes * 60.0 * kScanRateHz));
  // Between key frames the odometry's errors add up.
  run.odometry_sigma << Vector3d::Constant(kOdometryRotationSigma), Vector3d::Constant(kOdometryTranslationSigma);
  run.odometry_sigma *= std::sqrt(static_cast<double>(stride));
  Isometry3d before = Isometry3d::Identity();
  for (int k = 0; k < count; k += stride) {
    const double t = k / kScanRateHz;
    const double angle = 2.0 * M_PI * options.laps_per_minute * t / 60.0;
    Isometry3d T = Isometry3d::Identity();
    T.linear() = Eigen::AngleAxisd(angle + M_PI, Vector3d::UnitZ()).toRotationMatrix();
    T.translation() << kRingRadiusM * std::cos(angle), kRingRadiusM * std::sin(angle), 1.5 + 0.5 * std::sin(0.7 * t);
    Scan scan;
    if (k == 0) {
      run.first = T;
    } else {
      scan.odometry =
          before.inverse() * T * dendro::ExpSe3(run.odometry_sigma.cwiseProduct(Normal<6>(&rng)));
    }
    before = T;
    std::vector<std::pair<double, int>> near;
    for (int i = 0; i < options.cylinders; ++i) {
      near.emplace_back((run.truth[i].point - T.translation()).norm(), i);
    }
    std::sort(near.begin(), near.end());
    near.resize(std::min<std::size_t>(near.size(), options.seen));
    for (const auto& entry : near) {
      const Cylinder seen = dendro::TransformCylinder(T.inverse(), run.truth[entry.second]);
      Scan::Observation o;
      o.cylinder = entry.second;
      o.measured = seen.Retract(run.cylinder_sigma.cwiseProduct(Normal<5>(&rng)));
      for (int end = 0; end < 2; ++end) {
        o.ends[end] = seen.point + (end == 0 ? -kHalfLengthM : kHalfLengthM) * seen.axis +
                      kPointSigmaM * Normal<3>(&rng);
      }
      scan.observations.push_back(o);
    }
    run.scans.push_back(scan);
  }
  return run;
}

// One line per measurement: "PRIOR pose sigma", "ODOMETRY pose sigmas", "POINT id x y z sigma"; a pose is
// "x y z qx qy qz qw" and a new SCAN line starts every pose.
void Write(const Run& run, const std::string& file) {
  std::ofstream out(file);
  const auto pose = [](const Isometry3d& T) {
    const Eigen::Quaterniond q(T.linear());
    const Vector3d t = T.translation();
    return fmt::format("{:.17g} {:.17g} {:.17g} {:.17g} {:.17g} {:.17g} {:.17g}", t.x(), t.y(), t.z(), q.x(), q.y(),
                       q.z(), q.w());
  };
  for (std::size_t k = 0; k < run.scans.size(); ++k) {
    fmt::print(out, "SCAN\n");
    if (k == 0) {
      fmt::print(out, "PRIOR {} {}\n", pose(run.first), kPriorSigma);
    } else {
      fmt::print(out, "ODOMETRY {} {:.17g} {:.17g}\n", pose(run.scans[k].odometry), run.odometry_sigma[0],
                 run.odometry_sigma[3]);
    }
    for (const Scan::Observation& o : run.scans[k].observations) {
      for (int end = 0; end < 2; ++end) {
        fmt::print(out, "POINT {} {:.17g} {:.17g} {:.17g} {}\n", 2 * o.cylinder + end, o.ends[end].x(),
                   o.ends[end].y(), o.ends[end].z(), kPointSigmaM);
      }
    }
  }
  if (!out.flush()) throw std::runtime_error(file + " cannot be written");
}

Key PoseKey(std::size_t k) { return dendro::MakeKey('x', k); }
Key LandmarkKey(int i) { return dendro::MakeKey('l', static_cast<std::uint64_t>(i)); }

// The factors of one observation, and the initial values of landmarks that are new.
void AddObservation(const Options& options,
                    const Run& run,
                    Key pose,
                    const Isometry3d& T_map_sensor,
                    const Scan::Observation& o,
                    const dendro::IncrementalSolver& solver,
                    FactorList* factors,
                    dendro::Values* values) {
  const dendro::Matrix5d covariance = run.cylinder_sigma.cwiseAbs2().asDiagonal();
  if (options.landmarks == "points") {
    for (int end = 0; end < 2; ++end) {
      const Key point = LandmarkKey(2 * o.cylinder + end);
      factors->push_back(std::make_shared<dendro::JunctionPointFactor>(
          pose, point, o.ends[end], NoiseModel::Isotropic(3, kPointSigmaM)));
      if (!solver.Contains(point)) values->Insert(point, Vector3d(T_map_sensor * o.ends[end]));
    }
    return;
  }
  const Key landmark = LandmarkKey(o.cylinder);
  if (options.landmarks == "cylinders") {
    factors->push_back(std::make_shared<dendro::CylinderFactor>(pose, landmark, o.measured, covariance));
  } else {
    const Vector5d& s = run.cylinder_sigma;
    factors->push_back(std::make_shared<dendro::AxisFactor>(pose, landmark, o.measured, NoiseModel::Sigmas(s.head<2>())));
    factors->push_back(
        std::make_shared<dendro::NormalFactor>(pose, landmark, o.measured, NoiseModel::Sigmas(s.segment<2>(2))));
    factors->push_back(std::make_shared<dendro::CurvatureFactor>(landmark, o.measured.curvature, s[4]));
  }
  if (!solver.Contains(landmark)) values->Insert(landmark, dendro::TransformCylinder(T_map_sensor, o.measured));
}

}  // namespace

int main(int argc, char** argv) {
  Options options;
  bool json = false;
  bool check = false;
  std::string trace_file;
  dendro::SolverConfig config;
  config.relinearize_skip = 10;
  double wildfire = 1e-3;
  CLI::App app{"Flies laps around the same trees and feeds poses and landmarks to the factor graph, one update a pose. "
               "Prints the processor time of the updates minute by minute, the error and the peak memory."};
  app.add_option("--minutes", options.minutes, "Length of the run")->capture_default_str()->check(CLI::PositiveNumber);
  app.add_option("--laps-per-minute", options.laps_per_minute, "Laps around the trees")->capture_default_str();
  app.add_option("--cylinders", options.cylinders, "Trunks and branches in the scene")->capture_default_str();
  app.add_option("--seen", options.seen, "Of those, seen from a pose: the nearest")->capture_default_str();
  app.add_option("--seed", options.seed, "Of the scene and the noise")->capture_default_str();
  app.add_option("--key-frame-hz", options.key_frame_hz, "Poses per second")
      ->capture_default_str()
      ->check(CLI::Range(0.1, kScanRateHz));
  app.add_option("--between", options.between,
                 "Scans between key frames. drop: not used; summarize: become one cylinder factor per landmark of the "
                 "next key frame; marginalize: stay poses until then and leave one dense factor")
      ->capture_default_str()
      ->check(CLI::IsMember({"drop", "summarize", "marginalize"}));
  app.add_option("--landmarks", options.landmarks,
                 "cylinders: one factor of 5 residuals an observation; parts: axis, normal and curvature factor each on "
                 "its own; points: both ends as points, which other solvers know too")
      ->capture_default_str()
      ->check(CLI::IsMember({"cylinders", "parts", "points"}));
  app.add_option("--relinearize-skip", config.relinearize_skip, "Re-linearise in every n-th update")->capture_default_str();
  app.add_option("--wildfire", wildfire, "Smaller changes of a variable (rad, m) wait")->capture_default_str();
  app.add_option("--write", options.write, "Write the measurements (ends as points) to this text file for another solver");
  app.add_option("--trace", trace_file, "Write the processor seconds of every update to this text file");
  app.add_flag("--converge", check, "At the end also iterate to the optimum and report how far the run was from it");
  app.add_flag("--json", json, "Print one JSON object instead of lines for people");
  CLI11_PARSE(app, argc, argv);
  config.wildfire_threshold = config.still_threshold = wildfire;

  try {
    if (options.between == "summarize" && options.landmarks != "cylinders") {
      throw std::invalid_argument("--between summarize makes cylinder factors: it needs --landmarks cylinders");
    }
    const Run run = Simulate(options);
    if (!options.write.empty()) Write(run, options.write);
    const double memory_before_mb = dendro::measure::PeakMemoryMb();
    dendro::IncrementalSolver solver(config);
    std::vector<double> seconds;
    std::size_t relinearized = 0;
    std::size_t reeliminated = 0;
    int refused = 0;
    // Not yet in the graph: the factors of the scans since the last key frame, and where they stand.
    FactorList pending;
    dendro::Values pending_poses;
    Isometry3d T = run.first;
    std::size_t key_frame = 0;
    const std::size_t stride = options.between == "drop" ? 1 : static_cast<std::size_t>(KeyFrameStride(options));
    for (std::size_t k = 0; k < run.scans.size(); ++k) {
      const Scan& scan = run.scans[k];
      FactorList factors;
      dendro::Values values;
      dendro::UpdateOptions update_options;
      if (k == 0) {
        factors.push_back(
            std::make_shared<dendro::PosePrior>(PoseKey(0), run.first, NoiseModel::Isotropic(6, kPriorSigma)));
      } else {
        if (solver.Contains(PoseKey(k - 1))) T = solver.Estimate<Isometry3d>(PoseKey(k - 1));
        T = T * scan.odometry;
        factors.push_back(std::make_shared<dendro::BetweenFactor>(PoseKey(k - 1), PoseKey(k), scan.odometry,
                                                                  NoiseModel::Sigmas(run.odometry_sigma)));
      }
      values.Insert(PoseKey(k), T);
      for (const Scan::Observation& o : scan.observations) {
        AddObservation(options, run, PoseKey(k), T, o, solver, &factors, &values);
      }
      const double start = dendro::measure::ThreadCpuSeconds();
      if (options.between == "summarize" && k > 0) {
        pending.insert(pending.end(), factors.begin(), factors.end());
        pending_poses.Insert(PoseKey(k), T);
        if (k % stride != 0) continue;
        pending_poses.Insert(PoseKey(key_frame), solver.Estimate<Isometry3d>(PoseKey(key_frame)));
        factors = dendro::SummarizeScans(PoseKey(key_frame), PoseKey(k), pending, pending_poses).factors;
        // Landmarks that only a scan between saw are new as well.
        for (const dendro::FactorPtr& factor : factors) {
          const auto* seen = dynamic_cast<const dendro::CylinderFactor*>(factor.get());
          if (seen == nullptr || solver.Contains(seen->keys()[1]) || values.Contains(seen->keys()[1])) continue;
          values.Insert(seen->keys()[1], dendro::TransformCylinder(T, seen->measured()));
        }
        pending.clear();
        pending_poses = {};
        key_frame = k;
      } else if (options.between == "marginalize" && stride > 1 && k > 1 && (k - 1) % stride == 0) {
        // The scans before the last key frame leave the graph with the next scan's update.
        for (std::size_t i = k - stride; i + 1 < k; ++i) update_options.marginalize.push_back(PoseKey(i));
      }
      const dendro::UpdateResult result = solver.Update(factors, values, update_options);
      seconds.push_back(dendro::measure::ThreadCpuSeconds() - start);
      relinearized += result.variables_relinearized;
      reeliminated += result.variables_reeliminated;
      refused += result.steps_refused;
    }
    const double peak_mb = dendro::measure::PeakMemoryMb();
    const double error = solver.Error();
    nlohmann::ordered_json report;
    report["landmarks"] = options.landmarks;
    report["poses"] = run.scans.size();
    report["variables"] = solver.num_variables();
    report["factors"] = solver.num_factors();
    report["half_chi2"] = error;
    if (check) report["half_chi2_converged"] = solver.Optimize().error_after;
    double total = 0.0;
    for (const double s : seconds) total += s;
    report["total_cpu_s"] = total;
    report["p99_ms"] = 1e3 * dendro::measure::Quantile(seconds, 0.99);
    const auto per_minute = static_cast<std::size_t>(
        std::lround(static_cast<double>(seconds.size()) / options.minutes));
    for (std::size_t begin = 0; begin < seconds.size(); begin += per_minute) {
      const std::vector<double> part(seconds.begin() + static_cast<long>(begin),
                                     seconds.begin() + static_cast<long>(std::min(begin + per_minute, seconds.size())));
      report["minutes"].push_back({{"median_ms", 1e3 * dendro::measure::Quantile(part, 0.5)},
                                   {"p99_ms", 1e3 * dendro::measure::Quantile(part, 0.99)},
                                   {"max_ms", 1e3 * dendro::measure::Quantile(part, 1.0)}});
    }
    report["relinearized"] = relinearized;
    report["reeliminated"] = reeliminated;
    report["steps_refused"] = refused;
    report["peak_memory_mb"] = peak_mb;
    report["peak_memory_before_mb"] = memory_before_mb;
    if (options.landmarks != "points") {
      double worst = 0.0;
      Vector5d squares = Vector5d::Zero();
      int mapped = 0;
      for (int i = 0; i < options.cylinders; ++i) {
        if (!solver.Contains(LandmarkKey(i))) continue;
        const double radius = solver.Estimate<Cylinder>(LandmarkKey(i)).radius();
        report["radii_m"].push_back(radius);
        worst = std::max(worst, std::abs(radius - run.truth[i].radius()));
        squares += run.truth[i].LocalCoordinates(solver.Estimate<Cylinder>(LandmarkKey(i))).cwiseAbs2();
        ++mapped;
      }
      report["axis_error_rms_rad"] = std::sqrt(squares.head<2>().sum() / std::max(1, mapped));
      report["offset_error_rms_m"] = std::sqrt(squares.segment<2>(2).sum() / std::max(1, mapped));
      report["radius_error_max_m"] = worst;
    }
    if (!trace_file.empty()) {
      std::ofstream trace(trace_file);
      for (const double s : seconds) trace << s << '\n';
      if (!trace.flush()) throw std::runtime_error(trace_file + " cannot be written");
    }
    if (json) {
      fmt::print("{}\n", report.dump(2));
    } else {
      fmt::print("{} poses, {} variables, {} factors ({})\n", run.scans.size(), solver.num_variables(),
                 solver.num_factors(), options.landmarks);
      int minute = 1;
      for (const auto& m : report["minutes"]) {
        fmt::print("minute {:3d}   median {:8.3f} ms   p99 {:8.3f} ms   max {:8.3f} ms\n", minute++,
                   m["median_ms"].get<double>(), m["p99_ms"].get<double>(), m["max_ms"].get<double>());
      }
      fmt::print("total {:.2f} s (processor), 1/2 chi2 {:.6f}, peak memory {:.1f} MB\n", total, error, peak_mb);
      if (check) fmt::print("1/2 chi2 of the optimum {:.6f}\n", report["half_chi2_converged"].get<double>());
    }
  } catch (const std::exception& e) {
    fmt::print(stderr, "cylinder_workload: {}\n", e.what());
    return 1;
  }
  return 0;
}
