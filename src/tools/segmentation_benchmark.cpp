// Runs the network of stage 1 on given input planes, one pass per line on stdin, and prints the time
// of each pass: the C++ half of scripts/benchmark_segmentation.py, which runs its peers between the
// passes so that all meet the same load of the machine.

#include <chrono>
#include <cstddef>
#include <cstdio>
#include <exception>
#include <fstream>
#include <iostream>
#include <stdexcept>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <opencv2/core/utility.hpp>

#include "dendro_slam/segmentation/erfnet.h"
#include "dendro_slam/segmentation/wood_segmenter.h"
#include "measure.h"

namespace {

struct Options {
  std::string weights;
  std::string planes;
  std::string logits;
  int rows = 16;
  int cols = 1800;
  int threads = 1;
  bool layers = false;
};

void Run(const Options& options) {
  dendro::ErfNet net(dendro::TensorFile::Load(
      options.weights.empty() ? dendro::ShippedWoodWeights() : options.weights));
  cv::setNumThreads(options.threads);
  const std::size_t image = static_cast<std::size_t>(net.input_channels()) *
                            static_cast<std::size_t>(options.rows) *
                            static_cast<std::size_t>(options.cols);
  std::ifstream input(options.planes, std::ios::binary);
  if (!input) throw std::runtime_error("cannot read " + options.planes);
  std::ofstream output;
  if (!options.logits.empty()) {
    output.open(options.logits, std::ios::binary);
    if (!output) throw std::runtime_error("cannot write " + options.logits);
  }
  std::vector<float> planes(image);
  std::string line;
  while (std::getline(std::cin, line)) {
    const auto offset = static_cast<std::streamoff>(std::stoull(line) * image * sizeof(float));
    input.seekg(offset);
    input.read(reinterpret_cast<char*>(planes.data()),
               static_cast<std::streamsize>(image * sizeof(float)));
    if (!input) throw std::runtime_error("no image " + line + " in " + options.planes);
    const auto start = std::chrono::steady_clock::now();
    const double cpu_start = 1e3 * dendro::measure::ProcessCpuSeconds();
    const std::vector<float> logits = net.Forward(planes, options.rows, options.cols);
    const double cpu_ms = 1e3 * dendro::measure::ProcessCpuSeconds() - cpu_start;
    const std::chrono::duration<double, std::milli> wall =
        std::chrono::steady_clock::now() - start;
    if (output.is_open()) {
      output.write(reinterpret_cast<const char*>(logits.data()),
                   static_cast<std::streamsize>(logits.size() * sizeof(float)));
      output.flush();
      if (!output) throw std::runtime_error("cannot write " + options.logits);
    }
    std::printf("%.4f %.4f\n", wall.count(), cpu_ms);
    if (options.layers) {
      for (const auto& [layer, ms] : net.LayerMilliseconds()) {
        std::printf("  %8.3f  %s\n", ms, layer.c_str());
      }
    }
    std::fflush(stdout);
  }
}

}  // namespace

int main(int argc, char** argv) {
  Options options;
  CLI::App app("Per line on stdin (an image's number) one pass of the network; prints wall and CPU ms.");
  app.add_option("--weights", options.weights, "Weights file; default: the shipped one");
  app.add_option("--planes", options.planes, "Input planes, 32-bit floats, image after image")
      ->required();
  app.add_option("--logits", options.logits, "Writes the logits of every pass there");
  app.add_option("--rows", options.rows)->check(CLI::Range(1, 4096));
  app.add_option("--cols", options.cols)->check(CLI::Range(1, 65536));
  app.add_option("--threads", options.threads)->check(CLI::Range(1, 64));
  app.add_flag("--layers", options.layers, "Also prints the time of every layer");
  CLI11_PARSE(app, argc, argv);
  try {
    Run(options);
  } catch (const std::exception& error) {
    std::cerr << "segmentation_benchmark: " << error.what() << "\n";
    return 1;
  }
  return 0;
}
