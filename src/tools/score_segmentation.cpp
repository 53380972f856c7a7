// Scores stage 1 on simulated scans of scenes that were never trained on: per kind of scene and
// range, with the time per scan; network and geometric fallback by the same scorer.

#include <unistd.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <exception>
#include <iostream>
#include <map>
#include <sstream>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <nlohmann/json.hpp>

#include "dendro_slam/segmentation/wood_segmenter.h"
#include "dendro_slam/sensors/deskew.h"
#include "dendro_slam/sim/flight_path.h"
#include "dendro_slam/sim/training_scans.h"
#include "measure.h"

namespace {

using dendro::Label;

struct Options {
  int scans_per_kind = 20;
  int scans_per_scene = 4;
  std::uint64_t seed = 5000000;
  std::string methods = "network,geometric";
  std::string weights;
  std::string scene;  ///< Scene file; with `path` instead of random scenes.
  std::string path;
  int every = 10;     ///< Of the flight's scans.
  std::string kinds = "thesis,leafless,leafy,orchard,tilted,clutter,distant";
  int sub_rays_width = 8;
  int sub_rays_height = 3;
  dendro::ProjectorConfig projector;
};

std::vector<std::string> Split(const std::string& text) {
  std::vector<std::string> words;
  std::string word;
  std::istringstream stream(text);
  while (std::getline(stream, word, ',')) words.push_back(word);
  return words;
}

struct Counts {
  double both = 0, either = 0, truth = 0, guess = 0, right = 0, total = 0;

  void Add(Label label, Label expected) {
    const bool wood = expected == Label::kWood;
    const bool found = label == Label::kWood;
    both += wood && found;
    either += wood || found;
    truth += wood;
    guess += found;
    right += label == expected;
    total += 1;
  }
  nlohmann::json Json() const {
    const auto ratio = [](double a, double b) -> nlohmann::json {
      if (b <= 0) return nullptr;
      return std::round(a / b * 1e4) / 1e4;
    };
    return {{"wood_iou", ratio(both, either)}, {"accuracy", ratio(right, total)},
            {"wood_recall", ratio(both, truth)}, {"wood_precision", ratio(both, guess)},
            {"wood_pixels", truth}};
  }
};

const std::array<float, 5> kRangeEdges = {0.0F, 4.0F, 8.0F, 16.0F, 200.0F};
const std::array<float, 6> kRadiusEdgesCm = {0.0F, 1.0F, 2.0F, 4.0F, 8.0F, 1000.0F};

struct Score {
  Counts all;
  Counts beyond_8m;
  std::array<Counts, 4> by_range;
  std::array<Counts, 5> by_radius;  ///< True wood only: its recall.
  std::array<std::array<double, 5>, 5> confusion{};  ///< [truth][label], indexed as enum Label.
  std::vector<double> milliseconds;

  nlohmann::json Json() {
    nlohmann::json json = all.Json();
    for (std::size_t i = 0; i < by_range.size(); ++i) {
      std::ostringstream name;
      name << kRangeEdges[i] << "-" << kRangeEdges[i + 1] << "m";
      json["by_range"][name.str()] = by_range[i].Json();
    }
    json["wood_recall_beyond_8m"] = beyond_8m.Json()["wood_recall"];
    for (std::size_t i = 0; i < by_radius.size(); ++i) {
      std::ostringstream name;
      name << kRadiusEdgesCm[i] << "-" << kRadiusEdgesCm[i + 1] << "cm";
      const nlohmann::json counts = by_radius[i].Json();
      json["by_wood_radius"][name.str()] = {{"wood_recall", counts["wood_recall"]},
                                            {"wood_pixels", counts["wood_pixels"]}};
    }
    const std::array<const char*, 5> names = {"none", "ground", "wood", "leaf", "other"};
    for (std::size_t t = 1; t < 5; ++t) {
      for (std::size_t l = 1; l < 5; ++l) json["confusion"][names[t]][names[l]] = confusion[t][l];
    }
    std::sort(milliseconds.begin(), milliseconds.end());
    const std::size_t n = milliseconds.size();
    json["cpu_ms_median"] = milliseconds[n / 2];
    json["cpu_ms_p95"] = milliseconds[std::min(n - 1, n * 95 / 100)];
    json["scans"] = n;
    return json;
  }
};

using Segmenters = std::vector<std::pair<std::string, dendro::WoodSegmenter>>;
using Scores = std::map<std::string, std::map<std::string, Score>>;  // By method, then kind.

void ScoreScan(const dendro::TrainingScan& scan, Segmenters* segmenters, Scores* scores) {
  for (auto& [method, segmenter] : *segmenters) {
    dendro::RangeImage image = scan.image;
    const double start = 1e3 * dendro::measure::ProcessCpuSeconds();
    const dendro::LabelledScan result = segmenter.Segment(std::move(image));
    Score& score = (*scores)[method][scan.kind];
    score.milliseconds.push_back(1e3 * dendro::measure::ProcessCpuSeconds() - start);
    for (std::size_t i = 0; i < scan.truth.size(); ++i) {
      if (scan.truth[i] == Label::kNone) continue;
      score.all.Add(result.label[i], scan.truth[i]);
      score.confusion[static_cast<std::size_t>(scan.truth[i])]
                     [static_cast<std::size_t>(result.label[i])] += 1;
      const float range = result.image.range[i];
      if (range >= 8.0F) score.beyond_8m.Add(result.label[i], scan.truth[i]);
      if (scan.truth[i] == Label::kWood) {
        const float radius_cm = 100.0F * scan.wood_radius_m[i];
        for (std::size_t k = 0; k < score.by_radius.size(); ++k) {
          if (radius_cm >= kRadiusEdgesCm[k] && radius_cm < kRadiusEdgesCm[k + 1]) {
            score.by_radius[k].Add(result.label[i], scan.truth[i]);
          }
        }
      }
      for (std::size_t k = 0; k < score.by_range.size(); ++k) {
        if (range >= kRangeEdges[k] && range < kRangeEdges[k + 1]) {
          score.by_range[k].Add(result.label[i], scan.truth[i]);
        }
      }
    }
  }
}

// Every n-th scan of a flight, deskewed with the true motion.
void ScoreFlight(const Options& options,
                 const dendro::LidarSimulatorConfig& lidar,
                 Segmenters* segmenters,
                 Scores* scores) {
  const dendro::Scene scene = dendro::LoadScene(options.scene);
  const dendro::FlightPath path = dendro::LoadFlightPath(options.path);
  const dendro::Raycaster raycaster(scene);
  const dendro::LidarSimulator simulator(raycaster, lidar, path.start_stamp_ns);
  dendro::Projector projector(options.projector);
  const auto slash = options.scene.find_last_of('/');
  const std::string name =
      slash == std::string::npos ? options.scene : options.scene.substr(slash + 1);
  const auto pose = [&path](std::int64_t stamp) { return path.LidarPose(stamp); };
  for (int i = 0; i < simulator.NumScans(path.duration_s); i += options.every) {
    const dendro::SimulatedScan simulated = simulator.SimulateScan(i, pose);
    constexpr double kStep = 1e-3;
    std::vector<Eigen::Isometry3d> T_stamp_t;
    for (int k = -10; k <= 220; ++k) {
      const auto t = simulated.scan.stamp_ns + static_cast<std::int64_t>(k * kStep * 1e9);
      T_stamp_t.push_back(pose(simulated.scan.stamp_ns).inverse() * pose(t));
    }
    const dendro::SweepMotion motion(T_stamp_t, -10 * kStep, kStep);
    dendro::TrainingScan scan;
    scan.image = projector.Project(simulated.scan, &motion);
    scan.truth = dendro::PixelTruth(scan.image, simulated.truth);
    scan.wood_radius_m = dendro::PixelWoodRadius(
        scan.image, simulated.truth, scene, pose(simulated.scan.stamp_ns));
    scan.kind = name;
    ScoreScan(scan, segmenters, scores);
  }
}

void Run(const Options& options) {
  Segmenters segmenters;
  for (const std::string& method : Split(options.methods)) {
    dendro::WoodSegmenterConfig config;
    config.method = method;
    config.weights = options.weights;
    segmenters.emplace_back(method, dendro::WoodSegmenter(config));
  }
  dendro::LidarSimulatorConfig lidar;
  lidar.sub_rays_width = options.sub_rays_width;
  lidar.sub_rays_height = options.sub_rays_height;
  const bool progress = isatty(STDERR_FILENO) != 0;
  Scores scores;
  if (!options.scene.empty()) {
    ScoreFlight(options, lidar, &segmenters, &scores);
  } else {
    for (const std::string& kind : Split(options.kinds)) {
      int done = 0;
      for (std::uint64_t scene = 0; done < options.scans_per_kind; ++scene) {
        const int count = std::min(options.scans_per_scene, options.scans_per_kind - done);
        for (const dendro::TrainingScan& scan : dendro::SimulateTrainingScans(
                 kind, options.seed + scene, count, lidar, options.projector)) {
          ScoreScan(scan, &segmenters, &scores);
          ++done;
        }
        if (progress) {
          std::fprintf(
              stderr, "\r%-10s %d of %d scans", kind.c_str(), done, options.scans_per_kind);
        }
      }
    }
    if (progress) std::fprintf(stderr, "\n");
  }
  nlohmann::json json;
  for (auto& [method, kinds] : scores) {
    for (auto& [kind, score] : kinds) json[method][kind] = score.Json();
  }
  std::cout << json.dump(1) << "\n";
}

}  // namespace

int main(int argc, char** argv) {
  Options options;
  CLI::App app("Scores the wood segmentation on simulated scans; prints one JSON object.");
  app.add_option("--scans", options.scans_per_kind, "Per kind of scene")->check(CLI::Range(1, 100000));
  app.add_option("--scans-per-scene", options.scans_per_scene)->check(CLI::Range(1, 1000));
  app.add_option("--seed", options.seed, "Of the first scene; training uses 1000 and 900000 upwards");
  app.add_option("--methods", options.methods, "network, geometric or both, with a comma");
  app.add_option("--weights", options.weights, "Weights file; default: the shipped one");
  app.add_option("--kinds", options.kinds);
  auto* scene = app.add_option("--scene", options.scene, "Scene file, instead of random scenes");
  auto* path = app.add_option("--path", options.path, "Flight through the scene");
  scene->needs(path);
  path->needs(scene);
  app.add_option("--every", options.every, "Scores every n-th scan of the flight")
      ->check(CLI::Range(1, 100000));
  app.add_option("--sub-rays-width", options.sub_rays_width)->check(CLI::Range(1, 64));
  app.add_option("--sub-rays-height", options.sub_rays_height)->check(CLI::Range(1, 64));
  app.add_option("--model", options.projector.model, "vlp16 or uniform");
  app.add_option("--rows", options.projector.rows);
  app.add_option("--cols", options.projector.cols);
  CLI11_PARSE(app, argc, argv);
  try {
    Run(options);
  } catch (const std::exception& error) {
    std::cerr << "score_segmentation: " << error.what() << "\n";
    return 1;
  }
  return 0;
}
