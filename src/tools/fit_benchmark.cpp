#include <cmath>
#include <cstdint>
#include <unistd.h>
#include <iostream>
#include <limits>
#include <optional>
#include <random>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <Eigen/Geometry>
#include <fmt/format.h>
#include <nlohmann/json.hpp>
#include <pcl/common/io.h>
#include <pcl/features/normal_3d.h>
#include <pcl/point_types.h>
#include <pcl/sample_consensus/ransac.h>
#include <pcl/sample_consensus/sac_model_cylinder.h>

#include "cylinder_information.h"
#include "dendro_slam/cylinder_fitting/cylinder_fitter.h"
#include "dendro_slam/range_image/projector.h"
#include "dendro_slam/sim/lidar_simulator.h"
#include "dendro_slam/sim/raycaster.h"
#include "dendro_slam/sim/scene.h"
#include "measure.h"

namespace {

using dendro::CylinderFitter;
using dendro::FitStatus;
using dendro::FittedCylinder;
using Eigen::Vector3d;

struct Options {
  std::vector<double> radii{0.05, 0.10, 0.15, 0.30};
  std::vector<double> distances{3.0, 5.0, 8.0};
  std::vector<std::string> noises{"gauss:0.010", "gauss:0.015", "uniform:0.03"};
  int trials = 100;
  double tilt_deg = 25.0;
  double visible = 1.0;
  double beam_scale = 1.0;
  double half_length_m = 1.5;
  int min_rings = 8;
  int bound_views = 20;
  unsigned seed = 1;
  bool json = false;
};

struct Noise {
  std::string name;
  bool uniform = false;
  double size_m = 0.0;
  double Draw(std::mt19937* rng) const {
    if (uniform) return std::uniform_real_distribution<double>(-size_m, size_m)(*rng);
    return std::normal_distribution<double>(0.0, size_m)(*rng);
  }
};

Noise ParseNoise(const std::string& text) {
  const std::size_t colon = text.find(':');
  Noise noise;
  noise.name = text;
  const std::string kind = text.substr(0, colon);
  if (colon == std::string::npos || (kind != "gauss" && kind != "uniform")) {
    throw std::invalid_argument("noise '" + text + "': expected gauss:SIGMA or uniform:HALF_WIDTH [m]");
  }
  noise.uniform = kind == "uniform";
  noise.size_m = std::stod(text.substr(colon + 1));
  return noise;
}

/// Error statistics of one estimator in one cell of the table.
struct Tally {
  int fits = 0, measured = 0, one = 0, two = 0;
  int axis_one = 0, axis_two = 0, position_one = 0, position_two = 0, pairs = 0;
  double sum = 0.0, squares = 0.0, sigma = 0.0, seconds = 0.0;

  void AddRadius(double error) {
    ++measured;
    sum += error;
    squares += error * error;
  }
  void AddCalibration(double error, const FittedCylinder& fit, const dendro::Cylinder& truth) {
    const double s = fit.radius_sigma_m();
    sigma += s;
    one += std::abs(error) < s;
    two += std::abs(error) < 2.0 * s;
    const dendro::Vector5d d = fit.cylinder.LocalCoordinates(truth);
    for (int k = 0; k < 2; ++k) {
      const double axis = std::abs(d[k]) / std::sqrt(fit.covariance(k, k));
      const double position = std::abs(d[2 + k]) / std::sqrt(fit.covariance(2 + k, 2 + k));
      axis_one += axis < 1.0;
      axis_two += axis < 2.0;
      position_one += position < 1.0;
      position_two += position < 2.0;
      ++pairs;
    }
  }
  void Merge(const Tally& t) {
    fits += t.fits;
    measured += t.measured;
    one += t.one;
    two += t.two;
    axis_one += t.axis_one;
    axis_two += t.axis_two;
    position_one += t.position_one;
    position_two += t.position_two;
    pairs += t.pairs;
    seconds += t.seconds;
  }
  double Bias(double radius) const { return measured > 0 ? 100.0 * sum / measured / radius : NAN; }
  double Rms(double radius) const {
    return measured > 0 ? 100.0 * std::sqrt(squares / measured) / radius : NAN;
  }
  double Milliseconds() const { return fits > 0 ? 1e3 * seconds / fits : NAN; }
};

double Percent(int part, int whole) { return whole > 0 ? 100.0 * part / whole : NAN; }

nlohmann::json Number(double v) {
  return std::isfinite(v) ? nlohmann::json(v) : nlohmann::json(nullptr);
}

/// PCL's cylinder by RANSAC with its coefficients optimised on the inliers.
std::optional<double> PclRadius(const dendro::RangeImage& image, const dendro::Segment& segment) {
  pcl::PointCloud<pcl::PointXYZ>::Ptr cloud(new pcl::PointCloud<pcl::PointXYZ>);
  for (const std::int32_t p : segment.pixels) {
    const Eigen::Vector3f& q = image.point[static_cast<std::size_t>(p)];
    cloud->emplace_back(q.x(), q.y(), q.z());
  }
  pcl::PointCloud<pcl::Normal>::Ptr normals(new pcl::PointCloud<pcl::Normal>);
  pcl::NormalEstimation<pcl::PointXYZ, pcl::Normal> estimation;
  estimation.setInputCloud(cloud);
  estimation.setKSearch(12);
  estimation.compute(*normals);
  pcl::SampleConsensusModelCylinder<pcl::PointXYZ, pcl::Normal>::Ptr model(
      new pcl::SampleConsensusModelCylinder<pcl::PointXYZ, pcl::Normal>(cloud));
  model->setInputNormals(normals);
  model->setRadiusLimits(0.01, 0.8);
  model->setNormalDistanceWeight(0.1);
  pcl::RandomSampleConsensus<pcl::PointXYZ> ransac(model, 0.05);
  ransac.setMaxIterations(500);
  if (!ransac.computeModel()) return std::nullopt;
  std::vector<int> inliers;
  Eigen::VectorXf rough, fine;
  ransac.getInliers(inliers);
  ransac.getModelCoefficients(rough);
  model->optimizeModelCoefficients(inliers, rough, fine);
  if (fine.size() < 7 || !std::isfinite(fine[6])) return std::nullopt;
  return std::abs(static_cast<double>(fine[6]));
}

/// One cylinder in an empty world, seen once without range noise.
struct View {
  dendro::LidarSimulatorConfig lidar;
  dendro::LabelledScan scan;
  dendro::Segment segment;
  dendro::Cylinder truth;
  int rings = 0;
};

View Simulate(double radius, double distance, const Options& options, unsigned seed) {
  std::mt19937 rng(seed);
  std::uniform_real_distribution<double> u(-1.0, 1.0);
  const double azimuth = M_PI * u(rng);
  const double tilt = options.tilt_deg * M_PI / 180.0 * std::sqrt(std::abs(u(rng)));
  const double heading = M_PI * u(rng);
  View view;
  view.truth.axis = {std::sin(tilt) * std::cos(heading), std::sin(tilt) * std::sin(heading),
                     std::cos(tilt)};
  view.truth.point = {distance * std::cos(azimuth), distance * std::sin(azimuth), 0.25 * u(rng)};
  view.truth.curvature = 1.0 / radius;

  dendro::Scene scene;
  scene.ground.type = dendro::SceneGround::Type::kNone;
  dendro::SceneTree tree;
  tree.name = "cylinder";
  dendro::SceneBranch branch;
  for (const double s : {-options.half_length_m, options.half_length_m}) {
    branch.points.push_back({view.truth.point + s * view.truth.axis, radius});
  }
  tree.branches.push_back(branch);
  scene.trees.push_back(tree);
  const dendro::Raycaster raycaster(scene);
  dendro::LidarSimulatorConfig& lidar = view.lidar;
  lidar.enable_range_noise = false;
  lidar.seed = static_cast<int>(seed);
  lidar.aperture_width_m *= options.beam_scale;
  lidar.aperture_height_m *= options.beam_scale;
  lidar.divergence_width_rad *= options.beam_scale;
  lidar.divergence_height_rad *= options.beam_scale;
  lidar.enable_footprint = options.beam_scale > 0.0;
  const dendro::LidarSimulator simulator(raycaster, lidar);
  const dendro::SimulatedScan simulated =
      simulator.SimulateScan(static_cast<int>(seed % 97), Eigen::Isometry3d::Identity());
  dendro::Projector projector;
  view.scan.image = projector.Project(simulated.scan, nullptr);
  dendro::RangeImage& image = view.scan.image;
  view.scan.label.assign(image.size(), dendro::Label::kNone);
  view.scan.wood_probability.assign(image.size(), 0.0F);
  // An occluder in front hides one side of the view.
  const Vector3d side = Vector3d::UnitZ().cross(view.truth.point).normalized();
  const double hidden_from = radius * (2.0 * options.visible - 1.0);
  int last_row = -1;
  for (std::size_t i = 0; i < image.size(); ++i) {
    if (!image.HasReturn(i)) continue;
    const Vector3d p = image.point[i].cast<double>();
    const Vector3d from_axis = p - view.truth.point;
    // A hit may come from a beam whose centre passes beside the surface: hide only when asked to.
    if (options.visible < 1.0 &&
        (from_axis - from_axis.dot(view.truth.axis) * view.truth.axis).dot(side) > hidden_from) {
      image.point[i] *= 0.5F;
      image.range[i] *= 0.5F;
      view.scan.label[i] = dendro::Label::kLeaf;
      continue;
    }
    view.scan.label[i] = dendro::Label::kWood;
    view.scan.wood_probability[i] = 1.0F;
    view.segment.pixels.push_back(static_cast<std::int32_t>(i));
    const int row = static_cast<int>(i) / image.cols;
    view.rings += row != last_row;
    last_row = row;
  }
  return view;
}

void AddNoise(const View& clean, const Noise& noise, std::mt19937* rng, View* noisy) {
  *noisy = clean;
  dendro::RangeImage& image = noisy->scan.image;
  for (const std::int32_t p : noisy->segment.pixels) {
    const auto i = static_cast<std::size_t>(p);
    const Vector3d origin = image.beam_origin[i].cast<double>();
    const Vector3d ray = image.point[i].cast<double>() - origin;
    const double range = ray.norm();
    const double shifted = range + noise.Draw(rng);
    image.point[i] = (origin + ray * (shifted / range)).cast<float>();
    image.range[i] = static_cast<float>(shifted);
  }
}

}  // namespace

int main(int argc, char** argv) {
  Options options;
  CLI::App app(
      "Monte-Carlo of the single-scan cylinder fit over radius, distance, tilt and noise: bias, "
      "scatter, coverage of the reported sigma and time, beside the plain Marshall fit and PCL.");
  app.add_option("--radius", options.radii, "Radii [m]");
  app.add_option("--distance", options.distances, "Distances [m]");
  app.add_option("--noise", options.noises, "gauss:SIGMA or uniform:HALF_WIDTH [m]");
  app.add_option("--trials", options.trials, "Scans per radius and distance")
      ->check(CLI::PositiveNumber);
  app.add_option("--tilt", options.tilt_deg, "Largest tilt of the axis [deg]")
      ->check(CLI::Range(0.0, 60.0));
  app.add_option("--visible", options.visible, "Share of the width that is not hidden")
      ->check(CLI::Range(0.2, 1.0));
  app.add_option("--beam-scale", options.beam_scale,
                 "Width of the simulated beam relative to the data sheet; the fit keeps the data sheet's")
      ->check(CLI::Range(0.0, 4.0));
  app.add_option("--min-rings", options.min_rings, "Scans with fewer rings on the cylinder are left out");
  app.add_option("--bound-views", options.bound_views,
                 "Scans per cell whose information makes the Cramer-Rao bound (CR%; gaussian noise only)")
      ->check(CLI::NonNegativeNumber);
  app.add_option("--seed", options.seed, "Of everything random");
  app.add_flag("--json", options.json, "One JSON object on standard output instead of the table");
  CLI11_PARSE(app, argc, argv);

  try {
    const CylinderFitter fitter;
    dendro::CylinderFitterConfig plain;
    plain.marshall_only = true;
    const CylinderFitter marshall(plain);
    std::vector<Noise> noises;
    for (const std::string& text : options.noises) noises.push_back(ParseNoise(text));

    nlohmann::json cells = nlohmann::json::array();
    Tally total;
    Tally pcl_total, marshall_total;
    if (!options.json) {
      fmt::print("{:<12} {:>4} {:>5} | {:>6} {:>5} {:>5} {:>5} {:>5} {:>5} {:>5} {:>5} {:>5} {:>6} | {:>6} {:>6} | {:>7} {:>7} {:>6}\n",
                 "noise", "r", "dist", "bias%", "rms%", "CR%", "sig%", "1sig", "2sig", "axis", "pos", "unres",
                 "ms", "M.bias", "M.rms", "P.bias", "P.rms", "P.ms");
    }
    const bool progress = isatty(2) != 0;
    for (const double distance : options.distances) {
      for (const double radius : options.radii) {
        std::vector<Tally> ours(noises.size()), theirs(noises.size()), simple(noises.size());
        std::vector<dendro::Matrix5d> information(noises.size(), dendro::Matrix5d::Zero());
        int bounded = 0;
        std::mt19937 rng(options.seed + 7u);
        for (int trial = 0; trial < options.trials; ++trial) {
          const View clean = Simulate(radius, distance, options,
                                      options.seed + 1000u * static_cast<unsigned>(trial + 1));
          if (clean.rings < options.min_rings) continue;
          // With part of it hidden the sensor model of the bound does not hold.
          if (bounded < options.bound_views && options.visible >= 1.0 && options.beam_scale > 0.0) {
            for (std::size_t k = 0; k < noises.size(); ++k) {
              if (noises[k].uniform) continue;
              information[k] += CylinderInformation(clean.scan.image, clean.truth, options.half_length_m,
                                                    clean.lidar, noises[k].size_m);
            }
            ++bounded;
          }
          View view;
          for (std::size_t k = 0; k < noises.size(); ++k) {
            AddNoise(clean, noises[k], &rng, &view);
            double begin = dendro::measure::ThreadCpuSeconds();
            const FittedCylinder fit = fitter.FitSegment(view.scan, view.segment);
            ours[k].seconds += dendro::measure::ThreadCpuSeconds() - begin;
            ++ours[k].fits;
            if (fit.status == FitStatus::kMeasured) {
              const double error = fit.cylinder.radius() - radius;
              ours[k].AddRadius(error);
              ours[k].AddCalibration(error, fit, view.truth);
            }
            begin = dendro::measure::ThreadCpuSeconds();
            const FittedCylinder rough = marshall.FitSegment(view.scan, view.segment);
            simple[k].seconds += dendro::measure::ThreadCpuSeconds() - begin;
            ++simple[k].fits;
            if (rough.reason != dendro::UnresolvedReason::kNotConverged &&
                rough.reason != dendro::UnresolvedReason::kRadiusOutOfRange &&
                rough.reason != dendro::UnresolvedReason::kTooFewPoints) {
              simple[k].AddRadius(rough.cylinder.radius() - radius);
            }
            begin = dendro::measure::ThreadCpuSeconds();
            const std::optional<double> pcl = PclRadius(view.scan.image, view.segment);
            theirs[k].seconds += dendro::measure::ThreadCpuSeconds() - begin;
            ++theirs[k].fits;
            if (pcl) theirs[k].AddRadius(*pcl - radius);
          }
          if (progress) std::cerr << "\rr " << radius << " m at " << distance << " m: " << trial + 1 << "/" << options.trials << "   ";
        }
        if (progress) std::cerr << "\r\033[K";
        for (std::size_t k = 0; k < noises.size(); ++k) {
          const Tally& t = ours[k];
          total.Merge(t);
          pcl_total.Merge(theirs[k]);
          marshall_total.Merge(simple[k]);
          const int unresolved = t.fits - t.measured;
          const double bound =
              bounded > 0 && !noises[k].uniform
                  ? 100.0 / radius * std::sqrt((information[k] / bounded).inverse()(4, 4))
                  : NAN;
          const double sigma = t.measured > 0 ? 100.0 * t.sigma / t.measured / radius : NAN;
          if (options.json) {
            cells.push_back({{"noise", noises[k].name},
                             {"radius_m", radius},
                             {"distance_m", distance},
                             {"fits", t.fits},
                             {"unresolved", unresolved},
                             {"bias_percent", Number(t.Bias(radius))},
                             {"rms_percent", Number(t.Rms(radius))},
                             {"mean_sigma_percent", Number(sigma)},
                             {"cramer_rao_rms_percent", Number(bound)},
                             {"radius_coverage_1_sigma", Number(Percent(t.one, t.measured))},
                             {"radius_coverage_2_sigma", Number(Percent(t.two, t.measured))},
                             {"axis_coverage_1_sigma", Number(Percent(t.axis_one, t.pairs))},
                             {"axis_coverage_2_sigma", Number(Percent(t.axis_two, t.pairs))},
                             {"position_coverage_1_sigma", Number(Percent(t.position_one, t.pairs))},
                             {"position_coverage_2_sigma", Number(Percent(t.position_two, t.pairs))},
                             {"ms_per_fit", Number(t.Milliseconds())},
                             {"marshall_bias_percent", Number(simple[k].Bias(radius))},
                             {"marshall_rms_percent", Number(simple[k].Rms(radius))},
                             {"marshall_ms_per_fit", Number(simple[k].Milliseconds())},
                             {"pcl_bias_percent", Number(theirs[k].Bias(radius))},
                             {"pcl_rms_percent", Number(theirs[k].Rms(radius))},
                             {"pcl_ms_per_fit", Number(theirs[k].Milliseconds())}});
          } else {
            fmt::print("{:<12} {:>4.2f} {:>5.1f} | {:>+6.2f} {:>5.2f} {:>5.2f} {:>5.2f} {:>5.1f} {:>5.1f} {:>5.1f} {:>5.1f} {:>5} {:>6.3f} | {:>+6.2f} {:>6.2f} | {:>+7.1f} {:>7.1f} {:>6.3f}\n",
                       noises[k].name, radius, distance, t.Bias(radius), t.Rms(radius), bound, sigma,
                       Percent(t.one, t.measured), Percent(t.two, t.measured),
                       Percent(t.axis_one, t.pairs), Percent(t.position_one, t.pairs), unresolved,
                       t.Milliseconds(), simple[k].Bias(radius), simple[k].Rms(radius),
                       theirs[k].Bias(radius), theirs[k].Rms(radius), theirs[k].Milliseconds());
            std::cout.flush();
          }
        }
      }
    }
    const nlohmann::json summary = {
        {"fits", total.fits},
        {"measured", total.measured},
        {"radius_coverage_1_sigma", Number(Percent(total.one, total.measured))},
        {"radius_coverage_2_sigma", Number(Percent(total.two, total.measured))},
        {"axis_coverage_1_sigma", Number(Percent(total.axis_one, total.pairs))},
        {"axis_coverage_2_sigma", Number(Percent(total.axis_two, total.pairs))},
        {"position_coverage_1_sigma", Number(Percent(total.position_one, total.pairs))},
        {"position_coverage_2_sigma", Number(Percent(total.position_two, total.pairs))},
        {"ms_per_fit", Number(total.Milliseconds())},
        {"marshall_ms_per_fit", Number(marshall_total.Milliseconds())},
        {"pcl_ms_per_fit", Number(pcl_total.Milliseconds())}};
    if (options.json) {
      std::cout << nlohmann::json{{"cells", cells}, {"summary", summary}}.dump(2) << "\n";
    } else {
      std::cout << summary.dump(2) << "\n";
    }
  } catch (const std::exception& e) {
    std::cerr << "fit_benchmark: " << e.what() << "\n";
    return 1;
  }
  return 0;
}
