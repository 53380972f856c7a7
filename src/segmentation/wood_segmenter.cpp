#include "dendro_slam/segmentation/wood_segmenter.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <fstream>
#include <optional>
#include <stdexcept>
#include <utility>
#include <vector>

#include <fmt/format.h>
#include <opencv2/core/utility.hpp>

#include "dendro_slam/segmentation/erfnet.h"
#include "dendro_slam/segmentation/network_input.h"

namespace dendro {
namespace {

struct ShippedWeights {
  const char* name;
  int rows, cols;  // Of the images they were trained on.
};
constexpr std::array<ShippedWeights, 2> kShippedWeights = {
    {{"erfnet_wood.safetensors", 16, 1800}, {"erfnet_wood_32x360.safetensors", 32, 360}}};
constexpr const char* kClassList = "ground,wood,leaf,other";
constexpr int kClasses = 4;
constexpr int kWoodClass = 1;
// Canvas widths are rounded up to this many columns, so that the network's buffers are seldom
// laid out anew from one scan to the next.
constexpr int kWidthStep = 64;
constexpr float kGeometricWoodProbability = 0.9F;

Label LabelOfClass(int k) { return static_cast<Label>(k + 1); }

void CheckImage(const RangeImage& image) {
  if (image.rows < 0 || image.cols < 0) throw std::invalid_argument("image: negative size");
  const std::size_t n = static_cast<std::size_t>(image.rows) * static_cast<std::size_t>(image.cols);
  if (image.point.size() != n || image.range.size() != n || image.intensity.size() != n ||
      image.point_index.size() != n || image.beam_direction.size() != n) {
    throw std::invalid_argument("image: vectors do not have rows x cols entries");
  }
}

}  // namespace

void WoodSegmenterConfig::Validate() const {
  if (method != "network" && method != "geometric") {
    throw std::invalid_argument("method must be 'network' or 'geometric'");
  }
  if (!(min_range_m >= 0.0)) throw std::invalid_argument("min_range_m must be >= 0");
  if (!(max_range_m > min_range_m)) {
    throw std::invalid_argument("max_range_m must be > min_range_m");
  }
  if (!(wood_threshold > 0.0 && wood_threshold < 1.0)) {
    throw std::invalid_argument("wood_threshold must be in (0, 1)");
  }
  if (!(far_range_m > 0.0)) throw std::invalid_argument("far_range_m must be > 0");
  if (!(far_wood_threshold > 0.0 && far_wood_threshold < 1.0)) {
    throw std::invalid_argument("far_wood_threshold must be in (0, 1)");
  }
  if (margin_columns < 0) throw std::invalid_argument("margin_columns must be >= 0");
  if (num_threads < 1) throw std::invalid_argument("num_threads must be >= 1");
  ground.Validate();
  geometric.Validate();
}

std::string ShippedWoodWeights(int rows, int cols) {
  // How many times as fine or coarse, summed over both axes in logarithm.
  const auto unlike = [&](const ShippedWeights& weights) {
    return std::abs(std::log(std::max(rows, 1) / static_cast<double>(weights.rows))) +
           std::abs(std::log(std::max(cols, 1) / static_cast<double>(weights.cols)));
  };
  const ShippedWeights& best = *std::min_element(
      kShippedWeights.begin(), kShippedWeights.end(),
      [&](const ShippedWeights& a, const ShippedWeights& b) { return unlike(a) < unlike(b); });
  for (const char* folder : {DENDRO_SOURCE_MODELS, DENDRO_INSTALLED_MODELS}) {
    const std::string path = std::string(folder) + "/" + best.name;
    if (std::ifstream(path)) return path;
  }
  throw WeightsError(fmt::format("weights file '{}' is neither in {} nor in {}", best.name,
                                 DENDRO_SOURCE_MODELS, DENDRO_INSTALLED_MODELS));
}

namespace {

ErfNet LoadNetwork(const std::string& path) {
  const TensorFile weights = TensorFile::Load(path);
  if (weights.Metadata("input") != kNetworkInputVersion || weights.Metadata("classes") != kClassList) {
    throw WeightsError(fmt::format("weights file '{}': was trained for another input or other "
                                   "classes", weights.name()));
  }
  ErfNet net(weights);
  if (net.input_channels() != kNetworkInputChannels || net.classes() != kClasses) {
    throw WeightsError(fmt::format("weights file '{}': wants {} input planes and has {} classes, "
                                   "expected {} and {}", weights.name(), net.input_channels(),
                                   net.classes(), kNetworkInputChannels, kClasses));
  }
  return net;
}

}  // namespace

struct WoodSegmenter::Impl {
  WoodSegmenterConfig config;
  std::optional<ErfNet> net;
  std::string net_path;  // Where `net` came from.
  int last_rows = 0, last_cols = 0;  // Of the image that `net` was chosen for.

  // Shipped weights follow the size of the image.
  void ChooseNetwork(int rows, int cols) {
    if (!config.weights.empty()) return;
    const std::string path = ShippedWoodWeights(rows, cols);
    if (path == net_path) return;
    net.emplace(LoadNetwork(path));
    net_path = path;
  }

  bool InRange(const RangeImage& image, std::size_t pixel) const {
    return image.HasReturn(pixel) &&
           image.range[pixel] >= static_cast<float>(config.min_range_m) &&
           image.range[pixel] <= static_cast<float>(config.max_range_m);
  }

  // Columns to look at, 1 per column that is: those that hold a return in range that is not bare
  // ground, and the margin around them.
  std::vector<char> ChooseColumns(const RangeImage& image,
                                  const std::optional<GroundPlane>& ground) const {
    const std::size_t cols = static_cast<std::size_t>(image.cols);
    std::vector<char> occupied(cols, 0);
    const float tolerance = static_cast<float>(config.ground.inlier_distance_m);
    for (int row = 0; row < image.rows; ++row) {
      for (int col = 0; col < image.cols; ++col) {
        const std::size_t pixel = image.Index(row, col);
        if (!InRange(image, pixel)) continue;
        if (config.skip_bare_ground && ground &&
            std::abs(ground->Height(image.point[pixel])) < tolerance) {
          continue;
        }
        occupied[static_cast<std::size_t>(col)] = 1;
      }
    }
    std::vector<char> chosen(cols, 0);
    for (int col = 0; col < image.cols; ++col) {
      if (!occupied[static_cast<std::size_t>(col)]) continue;
      const int reach = std::min(config.margin_columns, image.cols / 2);
      for (int k = -reach; k <= reach; ++k) {
        chosen[static_cast<std::size_t>(image.WrapColumn(col + k))] = 1;
      }
    }
    return chosen;
  }

  // Lays the chosen columns side by side. Where all columns are chosen the image is closed across
  // its ends by repeating the margin on both. `writes` marks the columns whose result counts. The
  // reference column comes first: the network's strides then fall alike wherever azimuth 0 lies.
  void LayCanvas(const std::vector<char>& chosen,
                 int cols,
                 int reference,
                 std::vector<int>* source,
                 std::vector<char>* writes) const {
    const auto wrap = [cols](int c) { return ((c % cols) + cols) % cols; };
    const bool all = std::all_of(chosen.begin(), chosen.end(), [](char c) { return c != 0; });
    if (all) {
      const int margin = std::min(config.margin_columns, cols);
      for (int k = -margin; k < cols + margin; ++k) {
        source->push_back(wrap(reference + k));
        writes->push_back(k >= 0 && k < cols);
      }
    } else {
      // Start at the first column behind a gap, so that no sector is torn.
      int start = reference;
      while (chosen[static_cast<std::size_t>(start)]) start = wrap(start + 1);
      for (int k = 0; k < cols; ++k) {
        const int col = wrap(start + k);
        if (!chosen[static_cast<std::size_t>(col)]) continue;
        source->push_back(col);
        writes->push_back(1);
      }
    }
    const std::size_t step = all ? 1 : kWidthStep;
    while (source->size() % step != 0 ||
           source->size() % static_cast<std::size_t>(net->col_multiple()) != 0) {
      source->push_back(-1);
      writes->push_back(0);
    }
  }

  void RunNetwork(LabelledScan* scan, const std::optional<GroundPlane>& ground) {
    const RangeImage& image = scan->image;
    const std::vector<char> chosen = ChooseColumns(image, ground);
    if (std::none_of(chosen.begin(), chosen.end(), [](char c) { return c != 0; })) return;
    std::vector<int> source;
    std::vector<char> writes;
    LayCanvas(chosen, image.cols, ReferenceColumn(image), &source, &writes);
    const int width = static_cast<int>(source.size());
    std::vector<float> planes = NetworkInput(image, ground, source);
    // Rows that the network's strides do not divide are padded above the image.
    const int multiple = net->row_multiple();
    const int padded_rows = (image.rows + multiple - 1) / multiple * multiple;
    if (padded_rows != image.rows) {
      const std::size_t from = static_cast<std::size_t>(image.rows) * source.size();
      const std::size_t to = static_cast<std::size_t>(padded_rows) * source.size();
      std::vector<float> padded(kNetworkInputChannels * to, 0.0F);
      for (std::size_t k = 0; k < kNetworkInputChannels; ++k) {
        std::copy_n(planes.begin() + static_cast<std::ptrdiff_t>(k * from), from,
                    padded.begin() + static_cast<std::ptrdiff_t>(k * to));
      }
      planes.swap(padded);
    }
    if (cv::getNumThreads() != config.num_threads) cv::setNumThreads(config.num_threads);
    const std::vector<float> logits = net->Forward(planes, padded_rows, width);
    const std::size_t plane = static_cast<std::size_t>(padded_rows) * source.size();
    for (int row = 0; row < image.rows; ++row) {
      for (std::size_t c = 0; c < source.size(); ++c) {
        if (!writes[c]) continue;
        const std::size_t pixel = image.Index(row, source[c]);
        if (!InRange(image, pixel)) continue;
        const float* logit = logits.data() + static_cast<std::size_t>(row) * source.size() + c;
        float highest = logit[0];
        for (std::size_t k = 1; k < kClasses; ++k) highest = std::max(highest, logit[k * plane]);
        float sum = 0.0F;
        for (std::size_t k = 0; k < kClasses; ++k) sum += std::exp(logit[k * plane] - highest);
        const float wood = std::exp(logit[kWoodClass * plane] - highest) / sum;
        int best = 0;
        const bool far = image.range[pixel] > static_cast<float>(config.far_range_m);
        if (wood >= static_cast<float>(far ? config.far_wood_threshold : config.wood_threshold)) {
          best = kWoodClass;
        } else {
          for (int k = 1; k < kClasses; ++k) {
            if (k == kWoodClass) continue;
            if (logit[static_cast<std::size_t>(k) * plane] >
                logit[static_cast<std::size_t>(best) * plane]) {
              best = k;
            }
          }
        }
        scan->label[pixel] = LabelOfClass(best);
        scan->wood_probability[pixel] = wood;
      }
    }
  }
};

WoodSegmenter::WoodSegmenter(const WoodSegmenterConfig& config) : impl_(std::make_unique<Impl>()) {
  config.Validate();
  impl_->config = config;
  if (config.method != "network") return;
  impl_->net_path = config.weights.empty() ? ShippedWoodWeights() : config.weights;
  impl_->net.emplace(LoadNetwork(impl_->net_path));
}

WoodSegmenter::~WoodSegmenter() = default;
WoodSegmenter::WoodSegmenter(WoodSegmenter&&) noexcept = default;
WoodSegmenter& WoodSegmenter::operator=(WoodSegmenter&&) noexcept = default;

const WoodSegmenterConfig& WoodSegmenter::config() const { return impl_->config; }

LabelledScan WoodSegmenter::Segment(RangeImage image) {
  CheckImage(image);
  LabelledScan scan;
  scan.image = std::move(image);
  const std::size_t n = scan.image.size();
  scan.label.assign(n, Label::kNone);
  scan.wood_probability.assign(n, 0.0F);
  const std::optional<GroundPlane> ground = EstimateGroundPlane(scan.image, impl_->config.ground);

  // What neither method looks at: on the plane it is ground, elsewhere other.
  const float tolerance = static_cast<float>(impl_->config.ground.inlier_distance_m);
  const auto default_label = [&](std::size_t i) {
    // Far away the plane's tilt error and the terrain grow with the range.
    const float slack = tolerance + 0.01F * scan.image.range[i];
    return ground && std::abs(ground->Height(scan.image.point[i])) < slack ? Label::kGround
                                                                           : Label::kOther;
  };
  if (impl_->config.method == "geometric") {
    const std::vector<Label> labels =
        LabelGeometrically(scan.image, ground, impl_->config.geometric);
    for (std::size_t i = 0; i < n; ++i) {
      if (!scan.image.HasReturn(i)) continue;
      scan.label[i] = impl_->InRange(scan.image, i) ? labels[i] : default_label(i);
      scan.wood_probability[i] = scan.label[i] == Label::kWood ? kGeometricWoodProbability
                                                               : 1.0F - kGeometricWoodProbability;
    }
    return scan;
  }
  for (std::size_t i = 0; i < n; ++i) {
    if (scan.image.HasReturn(i)) scan.label[i] = default_label(i);
  }
  if (n == 0) return scan;
  if (scan.image.rows != impl_->last_rows || scan.image.cols != impl_->last_cols) {
    impl_->ChooseNetwork(scan.image.rows, scan.image.cols);
    impl_->last_rows = scan.image.rows;
    impl_->last_cols = scan.image.cols;
  }
  impl_->RunNetwork(&scan, ground);
  return scan;
}

}  // namespace dendro
