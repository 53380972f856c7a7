#pragma once

#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "dendro_slam/segmentation/safetensors.h"

namespace dendro {

/// One layer of the network, parsed from the weights' metadata entry `layers`.
///
/// The entry is a list of words separated by blanks, one per layer, fields separated by colons:
///   `stem:C:KHxKW:SHxSW`  convolution to C channels, kernel, stride, ReLU (RangeNet++'s input
///                         layer when the stride is 1 x 2)
///   `down:C:SHxSW`        ERFNet's downsampler: 3 x 3 convolution beside max pooling, ReLU
///   `nb:DHxDW`            ERFNet's non-bottleneck-1D block, dilation of its second half
///   `push`, `add`         keep a feature map; add the one kept last (the skip connection)
///   `conv:C:KHxKW`        convolution to C channels, ReLU
///   `grow:C:KHxKW:SHxSW`  convolution to C * SH * SW channels, ReLU, then every SH * SW channels are
///                         laid out as SH x SW pixels (sub-pixel convolution, Shi et al. 2016)
///   `last:K:KHxKW:SHxSW`  the same without ReLU, to the K class logits
///
/// @note Deviates: ERFNet enlarges by transposed convolutions, which take OpenCV several times as long.
struct ErfNetLayer {
  std::string type;
  int channels = 0;
  int kernel_h = 3, kernel_w = 3;
  int stride_h = 1, stride_w = 1;
  int dilation_h = 1, dilation_w = 1;
};

/// Parses the layer list. @throws WeightsError naming the word that is wrong.
std::vector<ErfNetLayer> ParseErfNetLayers(const std::string& text, const std::string& file_name);

/// An ERFNet (Romera et al. 2018) for range images, run by OpenCV's DNN module on the CPU.
///
/// The network is built layer by layer, convolutions (convolution.h) and enlarging as layers of our own,
/// from a safetensors file whose batch normalisations are folded into the convolutions (the pooling
/// half of a downsampler keeps its own scale and shift).
/// Owns one cv::dnn::Net; not thread-safe: one instance per thread. Stage 1.
class ErfNet {
 public:
  /// @throws WeightsError if the file describes no network this class can build, or tensors are
  ///   missing, left over or of another shape.
  explicit ErfNet(const TensorFile& weights);
  ~ErfNet();
  ErfNet(ErfNet&&) noexcept;
  ErfNet& operator=(ErfNet&&) noexcept;

  int input_channels() const { return input_channels_; }
  int classes() const { return classes_; }
  int row_multiple() const { return row_multiple_; }  ///< Rows must be a multiple of this.
  int col_multiple() const { return col_multiple_; }  ///< Columns must be a multiple of this.

  /// Class logits of one image.
  /// @param planes  input_channels x rows x cols floats, row-major.
  /// @return classes x rows x cols logits, row-major; owned by the caller.
  /// @throws std::invalid_argument if the size does not fit.
  std::vector<float> Forward(const std::vector<float>& planes, int rows, int cols);

  /// Name and wall time of every layer of the last pass [ms], for benchmarks. Layers that OpenCV
  /// fused into the one before take no time of their own.
  std::vector<std::pair<std::string, double>> LayerMilliseconds();

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
  int input_channels_ = 0;
  int classes_ = 0;
  int row_multiple_ = 1;
  int col_multiple_ = 1;
};

}  // namespace dendro
