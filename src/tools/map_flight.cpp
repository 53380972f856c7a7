// Flies through a scene and maps it at the same time: hours of mapping without a bag of a hundred gigabytes.

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "dendro_slam/io/map_directory.h"
#include "dendro_slam/mapping/pipeline.h"
#include "dendro_slam/sim/flight_path.h"
#include "dendro_slam/sim/truth_writer.h"
#include "measure.h"

namespace {

constexpr double kMinuteS = 60.0;
constexpr int kScansPerHits = 10;  // Returns per branch are counted in every so manieth scan.

struct Options {
  std::string scene;
  std::string path;
  std::string output;
  std::optional<int> seed;
  double duration_s = 0.0;
  int threads = 1;
  bool thin_rays = false;
};

/// Memory that this process holds now [MB of 2^20 bytes].
double MemoryMb() {
  std::ifstream file("/proc/self/statm");
  double total = 0.0, resident = 0.0;
  if (!(file >> total >> resident)) throw std::runtime_error("/proc/self/statm cannot be read");
  return resident * static_cast<double>(sysconf(_SC_PAGESIZE)) / (1024.0 * 1024.0);
}

/// What a minute of data cost, and what the map holds at its end.
nlohmann::ordered_json Row(int minute, const std::vector<double>& all_s, const dendro::Pipeline& pipeline) {
  const auto ms = [&all_s](double q) { return 1e3 * dendro::measure::Quantile(all_s, q); };
  const std::vector<double>& every = pipeline.timer().Durations("mapping");
  const std::vector<double> mapping_ms(every.end() - static_cast<std::ptrdiff_t>(all_s.size()), every.end());
  nlohmann::ordered_json row = {{"minute", minute},
                                {"scans", all_s.size()},
                                {"cpu_median_ms", ms(0.5)},
                                {"cpu_p99_ms", ms(0.99)},
                                {"cpu_max_ms", ms(1.0)},
                                {"mapping_wall_median_ms", dendro::measure::Quantile(mapping_ms, 0.5)},
                                {"mapping_wall_p99_ms", dendro::measure::Quantile(mapping_ms, 0.99)},
                                {"mapping_wall_max_ms", dendro::measure::Quantile(mapping_ms, 1.0)},
                                {"memory_mb", MemoryMb()},
                                {"key_frames", pipeline.mapper().num_key_frames()},
                                {"kept_key_frames", pipeline.mapper().num_kept_key_frames()},
                                {"landmarks", pipeline.mapper().Landmarks().size()},
                                {"trees", nlohmann::ordered_json::array()}};
  for (const dendro::MapTree& tree : pipeline.model().trees) {
    row["trees"].push_back({{"id", tree.id}, {"x_m", tree.base.x()}, {"y_m", tree.base.y()}});
  }
  return row;
}

void Run(const Options& options) {
  const dendro::Scene scene = dendro::LoadScene(options.scene);
  dendro::FlightPath path = dendro::LoadFlightPath(options.path);
  dendro::LidarSimulatorConfig lidar;
  if (options.seed) lidar.seed = path.odometry.seed = *options.seed;
  if (options.duration_s > 0.0) path.duration_s = std::min(path.duration_s, options.duration_s);
  dendro::PipelineConfig config;
  if (options.thin_rays) {
    // The fit knows that it is shown a beam without width.
    lidar.enable_footprint = false;
    config.cylinder_fitting.beam_exit_horizontal_m = config.cylinder_fitting.beam_exit_vertical_m = 0.0;
    config.cylinder_fitting.beam_divergence_horizontal_rad = 0.0;
    config.cylinder_fitting.beam_divergence_vertical_rad = 0.0;
  }
  const dendro::Raycaster raycaster(scene);
  const dendro::LidarSimulator simulator(raycaster, lidar, path.start_stamp_ns);
  std::filesystem::create_directories(options.output);
  dendro::TruthWriter truth(options.output + "/truth", scene, false);
  const std::string table = options.output + "/minutes.jsonl";
  std::ofstream minutes(table);
  if (!minutes) throw std::runtime_error(table + " cannot be written");

  dendro::Pipeline pipeline(config);
  pipeline.SetMount(path.T_base_lidar);
  dendro::OdometrySimulator odometry(path.trajectory, path.start_stamp_ns, path.odometry);
  std::vector<double> all_s;
  int minute = 0;
  dendro::SimulateFlight(simulator, path, options.threads, [&](int index, const dendro::SimulatedScan& scan) {
    truth.AddScan(scan, index % kScansPerHits == 0);
    // The odometry covers the revolution that is mapped.
    const std::int64_t end_ns = simulator.ScanStamp(index + 1);
    const double end_s = dendro::NsToSeconds(end_ns - path.start_stamp_ns);
    const double start = dendro::measure::ThreadCpuSeconds();
    for (const dendro::OdometrySample& sample : odometry.AdvanceTo(end_s)) {
      pipeline.AddOdometry(sample.stamp_ns, sample.T_odom_base);
    }
    pipeline.Process(scan.scan);
    all_s.push_back(dendro::measure::ThreadCpuSeconds() - start);
    if (end_s >= kMinuteS * (minute + 1)) {
      minutes << Row(++minute, all_s, pipeline) << std::endl;
      fmt::print(stderr, "\rminute {}", minute);
      all_s.clear();
    }
    return true;
  });
  fmt::print(stderr, "\n");
  truth.Finish();
  pipeline.timer().set_data_duration_s(path.duration_s);
  const dendro::MapFiles files = pipeline.Files();
  dendro::SaveMap(options.output + "/map", files, &pipeline.timer());
  fmt::print("{}: {} trees, {} branches, {} cylinders\n", options.output, files.model.trees.size(),
             files.model.branches.size(), files.model.cylinders.size());
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Flies a VLP-16 through a scene and maps the scans as they come, without a bag between. Writes the "
               "map (OUT/map), the truth (OUT/truth: no labels, returns per branch of every tenth scan) and, for every "
               "minute of data, processor time per scan, memory and the trees (OUT/minutes.jsonl)");
  Options options;
  app.add_option("SCENE", options.scene, "scene file (YAML)")->required();
  app.add_option("PATH", options.path, "flight-path file (YAML)")->required();
  app.add_option("-o,--output", options.output, "folder to write")->required();
  app.add_option("--seed", options.seed, "seed of every random effect");
  app.add_option("--duration", options.duration_s, "end after this time [s]")->check(CLI::PositiveNumber);
  app.add_option("--threads", options.threads, "threads that simulate; the result does not depend on it")
      ->capture_default_str()
      ->check(CLI::PositiveNumber);
  app.add_flag("--thin-rays", options.thin_rays, "beams without width, for speed");
  CLI11_PARSE(app, argc, argv);
  try {
    Run(options);
  } catch (const std::exception& error) {
    fmt::print(stderr, "map_flight: {}\n", error.what());
    return 1;
  }
  return 0;
}
