#include "dendro_slam/segmentation/erfnet.h"

#include <algorithm>
#include <cstring>
#include <set>
#include <sstream>
#include <stdexcept>

#include <fmt/format.h>
#include <opencv2/core/utility.hpp>
#include <opencv2/dnn.hpp>

#include "dendro_slam/segmentation/convolution.h"

namespace dendro {
namespace {

constexpr std::size_t kMaxLayers = 128;
constexpr int kMaxChannels = 1024;
constexpr int kMaxDilation = 64;

std::vector<std::string> Split(const std::string& text, char separator) {
  std::vector<std::string> parts;
  std::string part;
  std::istringstream stream(text);
  while (std::getline(stream, part, separator)) parts.push_back(part);
  return parts;
}

// A decimal number of one to four digits, or -1.
int ToInt(const std::string& text) {
  if (text.empty() || text.size() > 4) return -1;
  int value = 0;
  for (const char c : text) {
    if (c < '0' || c > '9') return -1;
    value = 10 * value + (c - '0');
  }
  return value;
}

// Lays the channels of a map out as pixels: channel (c * stride_h + i) * stride_w + j becomes rows
// i, i + stride_h, ... and columns j, j + stride_w, ... of channel c (PyTorch's PixelShuffle with a
// stride per axis). OpenCV can do it with Reshape and a five-dimensional Permute, at several times
// the cost of the convolution before it.
class InterleaveLayer : public cv::dnn::Layer {
 public:
  explicit InterleaveLayer(const cv::dnn::LayerParams& params)
      : stride_h_(params.get<int>("stride_h")), stride_w_(params.get<int>("stride_w")) {
    setParamsFrom(params);
  }
  static cv::Ptr<cv::dnn::Layer> Create(cv::dnn::LayerParams& params) {
    return cv::makePtr<InterleaveLayer>(params);
  }
  bool getMemoryShapes(const std::vector<cv::dnn::MatShape>& inputs,
                       int /*required_outputs*/,
                       std::vector<cv::dnn::MatShape>& outputs,
                       std::vector<cv::dnn::MatShape>& /*internals*/) const override {
    const cv::dnn::MatShape& in = inputs.at(0);
    outputs.assign(1, {in[0], in[1] / (stride_h_ * stride_w_), in[2] * stride_h_, in[3] * stride_w_});
    return false;  // Not in place.
  }
  void forward(cv::InputArrayOfArrays inputs,
               cv::OutputArrayOfArrays outputs,
               cv::OutputArrayOfArrays /*internals*/) override {
    std::vector<cv::Mat> in;
    std::vector<cv::Mat> out;
    inputs.getMatVector(in);
    outputs.getMatVector(out);
    const int height = in[0].size[2];
    const int width = in[0].size[3];
    const float* from = in[0].ptr<float>();
    const int channels = out[0].size[1];
    for (int c = 0; c < channels; ++c) {
      for (int i = 0; i < stride_h_; ++i) {
        for (int j = 0; j < stride_w_; ++j) {
          for (int y = 0; y < height; ++y, from += width) {
            float* to = out[0].ptr<float>(0, c) +
                        static_cast<std::ptrdiff_t>(y * stride_h_ + i) * width * stride_w_ + j;
            for (int x = 0; x < width; ++x) to[static_cast<std::ptrdiff_t>(x) * stride_w_] = from[x];
          }
        }
      }
    }
  }

 private:
  int stride_h_, stride_w_;
};

// A convolution (see convolution.h), with the sum with a second input and the ReLU that may follow it.
class ConvolutionLayer : public cv::dnn::Layer {
 public:
  explicit ConvolutionLayer(const cv::dnn::LayerParams& params)
      : convolution_(ShapeOf(params), params.blobs.at(0).ptr<float>(),
                     params.blobs.at(1).ptr<float>(), params.get<bool>("relu")) {
    setParamsFrom(params);
  }
  static cv::Ptr<cv::dnn::Layer> Create(cv::dnn::LayerParams& params) {
    return cv::makePtr<ConvolutionLayer>(params);
  }
  bool getMemoryShapes(const std::vector<cv::dnn::MatShape>& inputs,
                       int /*required_outputs*/,
                       std::vector<cv::dnn::MatShape>& outputs,
                       std::vector<cv::dnn::MatShape>& /*internals*/) const override {
    const ConvolutionShape& shape = convolution_.shape();
    const cv::dnn::MatShape& in = inputs.at(0);
    outputs.assign(
        1, {in[0], shape.outputs, shape.OutputRows(in[2]), shape.OutputCols(in[3])});
    return false;  // Not in place.
  }
  void forward(cv::InputArrayOfArrays inputs,
               cv::OutputArrayOfArrays outputs,
               cv::OutputArrayOfArrays /*internals*/) override {
    std::vector<cv::Mat> in;
    std::vector<cv::Mat> out;
    inputs.getMatVector(in);
    outputs.getMatVector(out);
    convolution_.Run(in[0].ptr<float>(), in[0].size[2], in[0].size[3],
                     in.size() > 1 ? in[1].ptr<float>() : nullptr, out[0].ptr<float>());
  }

 private:
  static ConvolutionShape ShapeOf(const cv::dnn::LayerParams& params) {
    ConvolutionShape shape;
    shape.outputs = params.blobs.at(0).size[0];
    shape.inputs = params.blobs.at(0).size[1];
    shape.kernel_h = params.get<int>("kernel_h");
    shape.kernel_w = params.get<int>("kernel_w");
    shape.stride_h = params.get<int>("stride_h");
    shape.stride_w = params.get<int>("stride_w");
    shape.dilation_h = params.get<int>("dilation_h");
    shape.dilation_w = params.get<int>("dilation_w");
    shape.pad_h = params.get<int>("pad_h");
    shape.pad_w = params.get<int>("pad_w");
    return shape;
  }

  Convolution convolution_;
};

constexpr const char* kInterleave = "DendroInterleave";
constexpr const char* kConvolution = "DendroConvolution";

void RegisterLayers() {
  // OpenCV's table of layer types is global and guards itself; a type may be registered once.
  static const bool registered = [] {
    cv::dnn::LayerFactory::registerLayer(kInterleave, InterleaveLayer::Create);
    cv::dnn::LayerFactory::registerLayer(kConvolution, ConvolutionLayer::Create);
    return true;
  }();
  static_cast<void>(registered);
}

// Adds layers to a cv::dnn::Net one by one and keeps track of which tensors were used.
class Builder {
 public:
  Builder(const TensorFile& weights, cv::dnn::Net* net) : weights_(weights), net_(net) {}

  int Add(const std::string& name,
          const std::string& type,
          cv::dnn::LayerParams params,
          const std::vector<int>& inputs) {
    params.name = name;
    params.type = type;
    const int id = net_->addLayer(name, type, params);
    for (std::size_t i = 0; i < inputs.size(); ++i) {
      net_->connect(inputs[i], 0, id, static_cast<int>(i));
    }
    return id;
  }

  int Relu(const std::string& name, int input) { return Add(name, "ReLU", {}, {input}); }

  int Interleave(const std::string& name, int input, int stride_h, int stride_w) {
    cv::dnn::LayerParams params;
    params.set("stride_h", stride_h);
    params.set("stride_w", stride_w);
    return Add(name, kInterleave, params, {input});
  }

  struct Window {
    int kernel_h = 1, kernel_w = 1, stride_h = 1, stride_w = 1, pad_h = 0, pad_w = 0;
    int dilation_h = 1, dilation_w = 1;
  };

  static void SetWindow(const Window& window, cv::dnn::LayerParams* params) {
    params->set("kernel_h", window.kernel_h);
    params->set("kernel_w", window.kernel_w);
    params->set("stride_h", window.stride_h);
    params->set("stride_w", window.stride_w);
    params->set("pad_h", window.pad_h);
    params->set("pad_w", window.pad_w);
    params->set("dilation_h", window.dilation_h);
    params->set("dilation_w", window.dilation_w);
  }

  // @param summand  Layer whose output is added before the ReLU, or -1.
  int Convolution(const std::string& name,
                  int input,
                  int in,
                  int out,
                  const Window& window,
                  bool relu,
                  int summand = -1) {
    cv::dnn::LayerParams params;
    SetWindow(window, &params);
    params.set("relu", relu);
    params.blobs.push_back(Blob(name + ".weight", {out, in, window.kernel_h, window.kernel_w}));
    params.blobs.push_back(Blob(name + ".bias", {out}));
    std::vector<int> inputs = {input};
    if (summand >= 0) inputs.push_back(summand);
    return Add(name, kConvolution, params, inputs);
  }

  int Pool(const std::string& name, int input, int channels, int stride_h, int stride_w) {
    cv::dnn::LayerParams params;
    Window window;
    window.kernel_h = window.stride_h = stride_h;
    window.kernel_w = window.stride_w = stride_w;
    SetWindow(window, &params);
    params.set("pool", "max");
    params.set("ceil_mode", false);
    const int pooled = Add(name + ".max", "Pooling", params, {input});
    // The batch normalisation behind a pooling has no convolution to fold into.
    cv::dnn::LayerParams scale;
    scale.set("axis", 1);
    scale.set("bias_term", true);
    scale.blobs.push_back(Blob(name + ".weight", {channels}));
    scale.blobs.push_back(Blob(name + ".bias", {channels}));
    return Add(name, "Scale", scale, {pooled});
  }

  bool AllUsed() const { return used_.size() == weights_.tensors().size(); }

 private:
  cv::Mat Blob(const std::string& name, const std::vector<int>& shape) {
    const Tensor& tensor = weights_.Get(name, shape);
    used_.insert(name);
    // OpenCV keeps a reference to the data of a blob, so it gets a copy of its own.
    std::vector<int> sizes = shape;
    if (sizes.size() == 1) sizes.insert(sizes.begin(), 1);
    cv::Mat blob(sizes, CV_32F);
    std::memcpy(blob.ptr<float>(), tensor.values.data(), tensor.values.size() * sizeof(float));
    return blob;
  }

  const TensorFile& weights_;
  cv::dnn::Net* net_;
  std::set<std::string> used_;
};

}  // namespace

std::vector<ErfNetLayer> ParseErfNetLayers(const std::string& text, const std::string& file_name) {
  std::vector<ErfNetLayer> layers;
  std::istringstream stream(text);
  std::string word;
  while (stream >> word) {
    const auto fail = [&](const char* reason) {
      throw WeightsError(fmt::format("weights file '{}': layer {} '{}' {}", file_name,
                                     layers.size(), word.substr(0, 40), reason));
    };
    if (layers.size() >= kMaxLayers) fail("is one too many");
    const std::vector<std::string> fields = Split(word, ':');
    ErfNetLayer layer;
    layer.type = fields[0];
    const auto pair = [&](std::size_t field, int* h, int* w, int limit) {
      const std::vector<std::string> parts = Split(fields[field], 'x');
      if (parts.size() != 2) fail("needs a pair like 1x2");
      *h = ToInt(parts[0]);
      *w = ToInt(parts[1]);
      if (*h < 1 || *w < 1 || *h > limit || *w > limit) fail("has a number out of range");
    };
    const auto want = [&](std::size_t count) {
      if (fields.size() != count) fail("has a wrong number of fields");
    };
    const auto channels = [&]() {
      layer.channels = ToInt(fields[1]);
      if (layer.channels < 1 || layer.channels > kMaxChannels) fail("has a bad channel count");
    };
    const auto want_odd_kernel = [&]() {
      if (layer.kernel_h % 2 == 0 || layer.kernel_w % 2 == 0) fail("needs an odd kernel");
    };
    if (layer.type == "stem" || layer.type == "grow" || layer.type == "last") {
      want(4);
      channels();
      pair(2, &layer.kernel_h, &layer.kernel_w, 9);
      pair(3, &layer.stride_h, &layer.stride_w, 2);
      want_odd_kernel();
    } else if (layer.type == "conv") {
      want(3);
      channels();
      pair(2, &layer.kernel_h, &layer.kernel_w, 9);
      want_odd_kernel();
    } else if (layer.type == "down") {
      want(3);
      channels();
      pair(2, &layer.stride_h, &layer.stride_w, 2);
    } else if (layer.type == "nb") {
      want(2);
      pair(1, &layer.dilation_h, &layer.dilation_w, kMaxDilation);
    } else if (layer.type == "push" || layer.type == "add") {
      want(1);
    } else {
      fail("is of an unknown type");
    }
    layers.push_back(layer);
  }
  return layers;
}

struct ErfNet::Impl {
  cv::dnn::Net net;
};

ErfNet::ErfNet(const TensorFile& weights) : impl_(std::make_unique<Impl>()) {
  const auto fail = [&](const std::string& reason) {
    throw WeightsError(fmt::format("weights file '{}': {}", weights.name(), reason));
  };
  if (weights.Metadata("format") != "dendro_erfnet_1") {
    fail("is not of format dendro_erfnet_1: another architecture");
  }
  input_channels_ = ToInt(weights.Metadata("input_channels"));
  if (input_channels_ < 1 || input_channels_ > 64) fail("has a bad input_channels");
  const std::vector<ErfNetLayer> layers =
      ParseErfNetLayers(weights.Metadata("layers"), weights.name());
  if (layers.empty() || layers.back().type != "last") fail("does not end in a 'last' layer");
  RegisterLayers();

  struct Shape {
    int id, channels, scale_h, scale_w;  // Scale: how many input pixels one pixel stands for.
  };
  Builder builder(weights, &impl_->net);
  Shape at{0, input_channels_, 1, 1};
  std::vector<Shape> kept;
  for (std::size_t i = 0; i < layers.size(); ++i) {
    const ErfNetLayer& layer = layers[i];
    const std::string name = fmt::format("{:02d}", i);
    Builder::Window window;
    window.kernel_h = layer.kernel_h;
    window.kernel_w = layer.kernel_w;
    window.stride_h = layer.stride_h;
    window.stride_w = layer.stride_w;
    window.pad_h = layer.kernel_h / 2;
    window.pad_w = layer.kernel_w / 2;
    if (layer.type == "stem" || layer.type == "conv") {
      const int conv =
          builder.Convolution(name + ".conv", at.id, at.channels, layer.channels, window, true);
      at = {conv, layer.channels, at.scale_h * layer.stride_h, at.scale_w * layer.stride_w};
    } else if (layer.type == "down") {
      if (layer.channels <= at.channels) fail(fmt::format("layer {} must add channels", i));
      const int added = layer.channels - at.channels;
      const int conv = builder.Convolution(name + ".conv", at.id, at.channels, added, window, false);
      const int pool =
          builder.Pool(name + ".pool", at.id, at.channels, layer.stride_h, layer.stride_w);
      cv::dnn::LayerParams concat;
      concat.set("axis", 1);
      const int joined = builder.Add(name + ".concat", "Concat", concat, {conv, pool});
      at = {builder.Relu(name + ".relu", joined), layer.channels, at.scale_h * layer.stride_h,
            at.scale_w * layer.stride_w};
    } else if (layer.type == "nb") {
      const auto column = [](int dilation) {
        Builder::Window w;
        w.kernel_h = 3;
        w.dilation_h = w.pad_h = dilation;
        return w;
      };
      const auto row = [](int dilation) {
        Builder::Window w;
        w.kernel_w = 3;
        w.dilation_w = w.pad_w = dilation;
        return w;
      };
      const int c = at.channels;
      int id = builder.Convolution(name + ".conv1", at.id, c, c, column(1), true);
      id = builder.Convolution(name + ".conv2", id, c, c, row(1), true);
      id = builder.Convolution(name + ".conv3", id, c, c, column(layer.dilation_h), true);
      at.id = builder.Convolution(name + ".conv4", id, c, c, row(layer.dilation_w), true, at.id);
    } else if (layer.type == "push") {
      kept.push_back(at);
    } else if (layer.type == "add") {
      if (kept.empty() || kept.back().channels != at.channels ||
          kept.back().scale_h != at.scale_h || kept.back().scale_w != at.scale_w) {
        fail(fmt::format("layer {} adds a feature map of another size", i));
      }
      cv::dnn::LayerParams sum;
      sum.set("operation", "sum");
      at.id = builder.Add(name + ".add", "Eltwise", sum, {at.id, kept.back().id});
      kept.pop_back();
    } else {  // grow, last
      if (at.scale_h % layer.stride_h != 0 || at.scale_w % layer.stride_w != 0) {
        fail(fmt::format("layer {} enlarges past the input", i));
      }
      const int copies = layer.stride_h * layer.stride_w;
      window.stride_h = window.stride_w = 1;
      int id = builder.Convolution(name + ".conv", at.id, at.channels, layer.channels * copies,
                                   window, layer.type == "grow");
      if (copies > 1) id = builder.Interleave(name + ".pixels", id, layer.stride_h, layer.stride_w);
      at = {id, layer.channels, at.scale_h / layer.stride_h, at.scale_w / layer.stride_w};
    }
    row_multiple_ = std::max(row_multiple_, at.scale_h);
    col_multiple_ = std::max(col_multiple_, at.scale_w);
  }
  if (at.scale_h != 1 || at.scale_w != 1) fail("does not return to the size of the input");
  if (!builder.AllUsed()) fail("holds tensors that its layers do not use: another architecture");
  classes_ = at.channels;
  impl_->net.setPreferableBackend(cv::dnn::DNN_BACKEND_OPENCV);
  impl_->net.setPreferableTarget(cv::dnn::DNN_TARGET_CPU);
}

ErfNet::~ErfNet() = default;
ErfNet::ErfNet(ErfNet&&) noexcept = default;
ErfNet& ErfNet::operator=(ErfNet&&) noexcept = default;

std::vector<float> ErfNet::Forward(const std::vector<float>& planes, int rows, int cols) {
  if (rows < 1 || cols < 1 || rows % row_multiple_ != 0 || cols % col_multiple_ != 0) {
    throw std::invalid_argument(fmt::format("rows x cols {} x {} must be multiples of {} and {}",
                                            rows, cols, row_multiple_, col_multiple_));
  }
  const std::size_t pixels = static_cast<std::size_t>(rows) * static_cast<std::size_t>(cols);
  if (planes.size() != pixels * static_cast<std::size_t>(input_channels_)) {
    throw std::invalid_argument("planes has the wrong size");
  }
  // The net only reads its input; Mat has no constructor for constant data.
  const cv::Mat input(std::vector<int>{1, input_channels_, rows, cols},
                      CV_32F,
                      const_cast<float*>(planes.data()));
  impl_->net.setInput(input);
  const cv::Mat output = impl_->net.forward();
  // forward() returns memory that the next call overwrites: copy.
  const float* values = output.ptr<float>();
  return std::vector<float>(values, values + pixels * static_cast<std::size_t>(classes_));
}

std::vector<std::pair<std::string, double>> ErfNet::LayerMilliseconds() {
  std::vector<double> ticks;
  impl_->net.getPerfProfile(ticks);
  const std::vector<cv::String> names = impl_->net.getLayerNames();
  std::vector<std::pair<std::string, double>> times;
  for (std::size_t i = 0; i < names.size() && i < ticks.size(); ++i) {
    times.emplace_back(names[i], 1e3 * ticks[i] / cv::getTickFrequency());
  }
  return times;
}

}  // namespace dendro
