#pragma once

#include <cstddef>
#include <vector>

namespace dendro {

/// Sizes of a convolution; all at least 1 (padding at least 0).
struct ConvolutionShape {
  int inputs = 1, outputs = 1;  ///< Channels.
  int kernel_h = 1, kernel_w = 1;
  int stride_h = 1, stride_w = 1;
  int dilation_h = 1, dilation_w = 1;
  int pad_h = 0, pad_w = 0;  ///< Zeros around the image on either side.

  int OutputRows(int rows) const {
    return (rows + 2 * pad_h - dilation_h * (kernel_h - 1) - 1) / stride_h + 1;
  }
  int OutputCols(int cols) const {
    return (cols + 2 * pad_w - dilation_w * (kernel_w - 1) - 1) / stride_w + 1;
  }
};

/// Instruction sets the convolution is written for.
enum class ConvolutionKernel { kPlain, kAvx2, kAvx512 };

/// The best one that this processor has.
ConvolutionKernel FastestConvolutionKernel();

/// A convolution of one image with few rows, optionally followed by the sum with another map and by
/// a ReLU:
///
///   out(o, y, x) = max(0, b(o) + r(o, y, x) + sum over c, i, j of
///                         w(o, c, i, j) in(c, y sh + i dh - ph, x sw + j dw - pw))
///
/// OpenCV's own convolution lays the input out anew for every tap and takes dot products, which for the
/// narrow layers of this network costs as much as the products: here a block of output channels
/// by columns stays in registers and the input is read where it lies. Sums run in the same order
/// whatever the number of threads; they may differ in the last bits between instruction sets.
class Convolution {
 public:
  /// @param weights  outputs x inputs x kernel_h x kernel_w, row-major.
  /// @param bias     One per output.
  /// @throws std::invalid_argument if sizes do not fit, or this processor lacks the kernel.
  Convolution(const ConvolutionShape& shape,
              const float* weights,
              const float* bias,
              bool relu,
              ConvolutionKernel kernel = FastestConvolutionKernel());

  /// @param in       inputs x rows x cols, row-major.
  /// @param summand  Null, or a map of the output's size added before the ReLU.
  /// @param out      outputs x OutputRows(rows) x OutputCols(cols); must overlap neither.
  /// @throws std::invalid_argument if the image is smaller than the kernel.
  void Run(const float* in, int rows, int cols, const float* summand, float* out);

  const ConvolutionShape& shape() const { return shape_; }

 private:
  void CopyPadded(const float* in, int rows, int cols);

  ConvolutionShape shape_;
  bool relu_;
  ConvolutionKernel kernel_;
  std::vector<float> weights_;  // Blocks of outputs: block, input, i, j, output in the block.
  std::vector<float> bias_;     // Filled up to whole blocks.
  // The input with zeros beside it. A stride s along the columns splits every row into s rows of
  // every s-th column, so that neighbouring outputs read neighbouring numbers.
  std::vector<float> padded_;
  std::ptrdiff_t pitch_ = 0;         // Numbers per such row.
  std::vector<std::ptrdiff_t> tap_;  // Where the row of column tap j starts.
};

}  // namespace dendro
