#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <string>
#include <vector>

#include "dendro_slam/segmentation/erfnet.h"
#include "dendro_slam/segmentation/safetensors.h"

// Fuzz target: the input is a weights file. It gives a network that can be run, or a WeightsError of
// one line; nothing else may come out.

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  try {
    const dendro::TensorFile file =
        dendro::TensorFile::Parse(std::vector<std::uint8_t>(data, data + size), "input");
    dendro::ErfNet net(file);
    const int rows = net.row_multiple();
    const int cols = net.col_multiple();
    if (rows * cols > 4096) return 0;
    const std::size_t pixels = static_cast<std::size_t>(rows) * static_cast<std::size_t>(cols);
    const std::vector<float> logits = net.Forward(
        std::vector<float>(pixels * static_cast<std::size_t>(net.input_channels()), 0.5F), rows, cols);
    if (logits.size() != pixels * static_cast<std::size_t>(net.classes())) std::abort();
  } catch (const dendro::WeightsError& error) {
    if (std::string(error.what()).find('\n') != std::string::npos) std::abort();
  }
  return 0;
}
