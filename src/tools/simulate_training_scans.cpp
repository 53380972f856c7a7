// Simulates random scenes and writes range images with the class of every pixel, as the training
// script of the segmentation reads them.

#include <unistd.h>

#include <cstdint>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <numeric>
#include <stdexcept>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <Eigen/Core>
#include <nlohmann/json.hpp>

#include "dendro_slam/segmentation/ground_plane.h"
#include "dendro_slam/segmentation/network_input.h"
#include "dendro_slam/sim/training_scans.h"

namespace {

struct Options {
  std::string folder;
  int scans = 100;
  int scans_per_scene = 2;
  std::uint64_t seed = 1000;
  int sub_rays_width = 8;
  int sub_rays_height = 3;
  std::string kinds =
      "leafy,tilted,orchard,distant,clutter,leafless,leafy,tilted,orchard,distant,clutter,thesis";
  dendro::ProjectorConfig projector;
};

std::vector<std::string> SplitKinds(const std::string& text) {
  std::vector<std::string> kinds;
  std::string word;
  std::istringstream stream(text);
  while (std::getline(stream, word, ',')) kinds.push_back(word);
  if (kinds.empty()) throw std::invalid_argument("--kinds is empty");
  return kinds;
}

void Run(const Options& options) {
  namespace fs = std::filesystem;
  const std::vector<std::string> kinds = SplitKinds(options.kinds);
  fs::create_directories(options.folder);
  const fs::path folder(options.folder);
  std::ofstream planes_file(folder / "planes.f16", std::ios::binary);
  std::ofstream labels_file(folder / "labels.u8", std::ios::binary);
  if (!planes_file || !labels_file) {
    throw std::runtime_error("cannot write into " + options.folder);
  }
  dendro::LidarSimulatorConfig lidar;
  lidar.sub_rays_width = options.sub_rays_width;
  lidar.sub_rays_height = options.sub_rays_height;
  const dendro::GroundPlaneConfig ground_config;
  std::vector<int> columns(static_cast<std::size_t>(options.projector.cols));
  std::iota(columns.begin(), columns.end(), 0);

  const bool progress = isatty(STDERR_FILENO) != 0;
  nlohmann::json scans = nlohmann::json::array();
  int done = 0;
  for (std::uint64_t scene = 0; done < options.scans; ++scene) {
    const std::string& kind = kinds[scene % kinds.size()];
    const int count = std::min(options.scans_per_scene, options.scans - done);
    for (const dendro::TrainingScan& scan : dendro::SimulateTrainingScans(
             kind, options.seed + scene, count, lidar, options.projector)) {
      const auto ground = dendro::EstimateGroundPlane(scan.image, ground_config);
      const std::vector<float> planes = dendro::NetworkInput(scan.image, ground, columns);
      std::vector<Eigen::half> half(planes.size());
      for (std::size_t i = 0; i < planes.size(); ++i) half[i] = Eigen::half(planes[i]);
      planes_file.write(reinterpret_cast<const char*>(half.data()),
                        static_cast<std::streamsize>(half.size() * sizeof(Eigen::half)));
      labels_file.write(reinterpret_cast<const char*>(scan.truth.data()),
                        static_cast<std::streamsize>(scan.truth.size()));
      scans.push_back({{"kind", scan.kind}, {"seed", scan.seed}, {"ground", ground.has_value()}});
      ++done;
    }
    if (progress) std::fprintf(stderr, "\rsimulated %d of %d scans", done, options.scans);
  }
  if (progress) std::fprintf(stderr, "\n");
  planes_file.close();
  labels_file.close();
  // The description comes last: without it the folder counts as unfinished.
  std::ofstream meta(folder / "meta.json");
  meta << nlohmann::json({{"input", dendro::kNetworkInputVersion},
                          {"count", done},
                          {"planes", dendro::kNetworkInputChannels},
                          {"rows", options.projector.rows},
                          {"cols", options.projector.cols},
                          {"seed", options.seed},
                          {"scans", scans}})
              .dump(1)
       << "\n";
  if (!planes_file || !labels_file || !meta) throw std::runtime_error("cannot write the data");
}

}  // namespace

int main(int argc, char** argv) {
  Options options;
  CLI::App app("Simulates training scans for the segmentation: planes.f16, labels.u8, meta.json.");
  app.add_option("-o,--output", options.folder, "Folder to write")->required();
  app.add_option("--scans", options.scans, "Number of scans")->check(CLI::Range(1, 1000000));
  app.add_option("--scans-per-scene", options.scans_per_scene)->check(CLI::Range(1, 1000));
  app.add_option("--seed", options.seed, "Of the first scene; the next ones count up");
  app.add_option("--sub-rays-width", options.sub_rays_width)->check(CLI::Range(1, 64));
  app.add_option("--sub-rays-height", options.sub_rays_height)->check(CLI::Range(1, 64));
  app.add_option("--kinds", options.kinds, "Kinds of scenes, in turn (thesis, leafless, leafy, tilted, clutter, orchard, distant)");
  app.add_option("--model", options.projector.model, "vlp16 or uniform");
  app.add_option("--rows", options.projector.rows);
  app.add_option("--cols", options.projector.cols);
  CLI11_PARSE(app, argc, argv);
  try {
    Run(options);
  } catch (const std::exception& error) {
    std::cerr << "simulate_training_scans: " << error.what() << "\n";
    return 1;
  }
  return 0;
}
