#include "dendro_slam/segmentation/convolution.h"

#include <algorithm>
#include <cstring>
#include <stdexcept>

#include <opencv2/core/utility.hpp>

#if defined(__x86_64__) && defined(__GNUC__)
#define DENDRO_X86_KERNELS 1
#endif

namespace dendro {
namespace {

constexpr int kBlock = 8;  // Output channels of a tile.

// What a tile of kBlock output channels by some columns of one row is computed from.
struct Tile {
  const float* in;  // First channel, first row that lies in the image, first column.
  std::ptrdiff_t channel_stride, row_stride;
  const std::ptrdiff_t* tap;  // Offset per column of the kernel.
  int channels, rows, taps;
  const float* weights;  // Of that row of the kernel.
  std::ptrdiff_t weights_channel_stride;
  const float* bias;
  const float* summand;  // Or null.
  float* out;
  std::ptrdiff_t out_stride;  // From channel to channel, of summand too.
  int outputs, columns;       // That count; the tile may be larger than what is left.
  bool relu;
};

#define DENDRO_INLINE inline __attribute__((always_inline))

// kBlockPart output channels, from `first` in the block on, by kVectors vectors of columns, in registers.
// summand (or null) and out may be the same.
template <typename Vector, int kVectors, int kBlockPart>
DENDRO_INLINE void ComputePart(
    const Tile& tile, int first, const float* summand, float* out, std::ptrdiff_t stride) {
  constexpr int kLanes = sizeof(Vector) / sizeof(float);
  Vector sum[kBlockPart][kVectors];
#pragma GCC unroll 8
  for (int o = 0; o < kBlockPart; ++o) {
#pragma GCC unroll 8
    for (int v = 0; v < kVectors; ++v) sum[o][v] = Vector{} + tile.bias[first + o];
  }
  for (int c = 0; c < tile.channels; ++c) {
    const float* weights = tile.weights + c * tile.weights_channel_stride + first;
    for (int i = 0; i < tile.rows; ++i) {
      const float* row = tile.in + c * tile.channel_stride + i * tile.row_stride;
      for (int j = 0; j < tile.taps; ++j, weights += kBlock) {
        Vector in[kVectors];
#pragma GCC unroll 8
        for (int v = 0; v < kVectors; ++v) {
          std::memcpy(&in[v], row + tile.tap[j] + v * kLanes, sizeof(Vector));
        }
#pragma GCC unroll 8
        for (int o = 0; o < kBlockPart; ++o) {
#pragma GCC unroll 8
          for (int v = 0; v < kVectors; ++v) sum[o][v] += weights[o] * in[v];
        }
      }
    }
  }
#pragma GCC unroll 8
  for (int o = 0; o < kBlockPart; ++o) {
#pragma GCC unroll 8
    for (int v = 0; v < kVectors; ++v) {
      const std::ptrdiff_t at = (first + o) * stride + v * kLanes;
      if (summand) {
        Vector other;
        std::memcpy(&other, summand + at, sizeof(Vector));
        sum[o][v] += other;
      }
      if (tile.relu) sum[o][v] = sum[o][v] > 0.0F ? sum[o][v] : Vector{};
      std::memcpy(out + at, &sum[o][v], sizeof(Vector));
    }
  }
}

template <typename Vector, int kVectors, int kBlockPart>
DENDRO_INLINE void ComputeTile(const Tile& tile) {
  constexpr int kColumns = kVectors * static_cast<int>(sizeof(Vector) / sizeof(float));
  static_assert(kBlock % kBlockPart == 0);
  if (tile.columns == kColumns && tile.outputs == kBlock) {
    for (int first = 0; first < kBlock; first += kBlockPart) {
      ComputePart<Vector, kVectors, kBlockPart>(tile, first, tile.summand, tile.out, tile.out_stride);
    }
    return;
  }
  // At the edges a whole tile goes beside the map, and what counts of it into the map.
  alignas(64) float buffer[kBlock * kColumns] = {};
  if (tile.summand) {
    for (int o = 0; o < tile.outputs; ++o) {
      const float* from = tile.summand + o * tile.out_stride;
      for (int x = 0; x < tile.columns; ++x) buffer[o * kColumns + x] = from[x];
    }
  }
  for (int first = 0; first < kBlock; first += kBlockPart) {
    ComputePart<Vector, kVectors, kBlockPart>(tile, first, tile.summand ? buffer : nullptr, buffer,
                                              kColumns);
  }
  for (int o = 0; o < tile.outputs; ++o) {
    float* to = tile.out + o * tile.out_stride;
    for (int x = 0; x < tile.columns; ++x) to[x] = buffer[o * kColumns + x];
  }
}

// 16 registers of 4 numbers: the plain instruction set of x86-64, or whatever another has.
using Vector4 = float __attribute__((vector_size(16)));
void ComputePlain(const Tile& tile) { ComputeTile<Vector4, 2, 4>(tile); }

#ifdef DENDRO_X86_KERNELS
// 12 sums, 3 inputs and a weight in 16 registers of 8 numbers.
using Vector8 = float __attribute__((vector_size(32)));
__attribute__((target("avx2,fma"))) void ComputeAvx2(const Tile& tile) {
  ComputeTile<Vector8, 3, 4>(tile);
}
// 24 sums, 3 inputs and a weight in 32 registers of 16 numbers.
using Vector16 = float __attribute__((vector_size(64)));
__attribute__((target("avx512f"))) void ComputeAvx512(const Tile& tile) {
  ComputeTile<Vector16, 3, 8>(tile);
}
#endif

struct KernelTable {
  void (*compute)(const Tile& tile);
  int columns;  // Of a tile.
};

KernelTable TableOf(ConvolutionKernel kernel) {
#ifdef DENDRO_X86_KERNELS
  if (kernel == ConvolutionKernel::kAvx512) return {ComputeAvx512, 48};
  if (kernel == ConvolutionKernel::kAvx2) return {ComputeAvx2, 24};
#endif
  static_cast<void>(kernel);
  return {ComputePlain, 8};
}

bool Has(ConvolutionKernel kernel) {
#ifdef DENDRO_X86_KERNELS
  if (kernel == ConvolutionKernel::kAvx512) return __builtin_cpu_supports("avx512f") != 0;
  if (kernel == ConvolutionKernel::kAvx2) {
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  }
#endif
  return kernel == ConvolutionKernel::kPlain;
}

}  // namespace

ConvolutionKernel FastestConvolutionKernel() {
  for (const auto kernel : {ConvolutionKernel::kAvx512, ConvolutionKernel::kAvx2}) {
    if (Has(kernel)) return kernel;
  }
  return ConvolutionKernel::kPlain;
}

Convolution::Convolution(const ConvolutionShape& shape,
                         const float* weights,
                         const float* bias,
                         bool relu,
                         ConvolutionKernel kernel)
    : shape_(shape), relu_(relu), kernel_(kernel) {
  for (const int size : {shape.inputs, shape.outputs, shape.kernel_h, shape.kernel_w, shape.stride_h,
                         shape.stride_w, shape.dilation_h, shape.dilation_w}) {
    if (size < 1) throw std::invalid_argument("convolution: sizes must be >= 1");
  }
  if (shape.pad_h < 0 || shape.pad_w < 0) {
    throw std::invalid_argument("convolution: padding must be >= 0");
  }
  if (!Has(kernel)) throw std::invalid_argument("convolution: not on this processor");
  const int blocks = (shape.outputs + kBlock - 1) / kBlock;
  const std::size_t taps = static_cast<std::size_t>(shape.inputs) *
                           static_cast<std::size_t>(shape.kernel_h * shape.kernel_w);
  weights_.assign(static_cast<std::size_t>(blocks) * taps * kBlock, 0.0F);
  bias_.assign(static_cast<std::size_t>(blocks * kBlock), 0.0F);
  for (int o = 0; o < shape.outputs; ++o) {
    float* block = weights_.data() + static_cast<std::size_t>(o / kBlock) * taps * kBlock;
    for (std::size_t k = 0; k < taps; ++k) {
      block[k * kBlock + static_cast<std::size_t>(o % kBlock)] =
          weights[static_cast<std::size_t>(o) * taps + k];
    }
    bias_[static_cast<std::size_t>(o)] = bias[o];
  }
}

void Convolution::CopyPadded(const float* in, int rows, int cols) {
  const ConvolutionShape& s = shape_;
  // The last column that an output or the image itself needs; a map narrower than a tile is widened.
  const int width = std::max(s.OutputCols(cols), TableOf(kernel_).columns);
  pitch_ = std::max(width + (s.kernel_w - 1) * s.dilation_w / s.stride_w + 1,
                    (s.pad_w + cols) / s.stride_w + 1);
  const std::ptrdiff_t count = static_cast<std::ptrdiff_t>(s.inputs) * rows;
  padded_.resize(static_cast<std::size_t>(count * s.stride_w * pitch_));
  for (int j = 0; j < s.kernel_w; ++j) {
    const int at = j * s.dilation_w;
    tap_[static_cast<std::size_t>(j)] = at % s.stride_w * pitch_ + at / s.stride_w;
  }
  for (std::ptrdiff_t r = 0; r < count; ++r) {
    const float* from = in + r * cols;
    for (int phase = 0; phase < s.stride_w; ++phase) {
      // Padded column phase + k stride is the input's column phase + k stride - pad.
      float* to = padded_.data() + (r * s.stride_w + phase) * pitch_;
      std::ptrdiff_t k = std::max(0, (s.pad_w - phase + s.stride_w - 1) / s.stride_w);
      std::fill_n(to, k, 0.0F);
      std::ptrdiff_t x = phase + k * s.stride_w - s.pad_w;
      if (s.stride_w == 1) {
        std::memcpy(to + k, from, static_cast<std::size_t>(cols) * sizeof(float));
        k += cols;
      } else {
        for (; x < cols; x += s.stride_w) to[k++] = from[x];
      }
      std::fill_n(to + k, pitch_ - k, 0.0F);
    }
  }
}

void Convolution::Run(const float* in, int rows, int cols, const float* summand, float* out) {
  const ConvolutionShape& s = shape_;
  if (rows < 1 || cols < 1 || rows + 2 * s.pad_h < s.dilation_h * (s.kernel_h - 1) + 1 ||
      cols + 2 * s.pad_w < s.dilation_w * (s.kernel_w - 1) + 1) {
    throw std::invalid_argument("convolution: the image is smaller than the kernel");
  }
  const KernelTable kernel = TableOf(kernel_);
  const int out_rows = s.OutputRows(rows);
  const int out_cols = s.OutputCols(cols);
  const float* source = in;
  tap_.assign(static_cast<std::size_t>(s.kernel_w), 0);
  // A kernel one column wide reads the image where it lies.
  if (s.kernel_w == 1 && s.stride_w == 1 && s.pad_w == 0 && out_cols >= kernel.columns) {
    pitch_ = cols;
  } else {
    CopyPadded(in, rows, cols);
    source = padded_.data();
  }
  const std::ptrdiff_t row_pitch = s.stride_w * pitch_;
  const std::ptrdiff_t taps = static_cast<std::ptrdiff_t>(s.kernel_h) * s.kernel_w;
  cv::parallel_for_(cv::Range(0, out_rows), [&](const cv::Range& range) {
    for (int y = range.start; y < range.end; ++y) {
      // Rows of the kernel that lie in the image: the others would add zeros.
      const int top = y * s.stride_h - s.pad_h;
      const int i0 = top >= 0 ? 0 : (-top + s.dilation_h - 1) / s.dilation_h;
      const int below = (rows - top + s.dilation_h - 1) / s.dilation_h;  // First that is below.
      const int i1 = std::min(s.kernel_h, below);
      Tile tile{};
      tile.channel_stride = rows * row_pitch;
      tile.row_stride = s.dilation_h * row_pitch;
      tile.tap = tap_.data();
      tile.channels = s.inputs;
      tile.rows = std::max(0, i1 - i0);
      tile.taps = s.kernel_w;
      tile.weights_channel_stride = taps * kBlock;
      tile.out_stride = static_cast<std::ptrdiff_t>(out_rows) * out_cols;
      tile.relu = relu_;
      const float* row = source + (tile.rows > 0 ? (top + i0 * s.dilation_h) * row_pitch : 0);
      for (int begin = 0; begin < out_cols; begin += kernel.columns) {
        // The last tile is moved back to end with the row; what it shares with the one before comes
        // out the same again.
        const int x = std::max(0, std::min(begin, out_cols - kernel.columns));
        tile.in = row + x;
        tile.columns = std::min(kernel.columns, out_cols);
        for (int o = 0; o < s.outputs; o += kBlock) {
          tile.outputs = std::min(kBlock, s.outputs - o);
          tile.weights = weights_.data() + o * s.inputs * taps +
                         static_cast<std::ptrdiff_t>(i0) * s.kernel_w * kBlock;
          tile.bias = bias_.data() + o;
          const std::ptrdiff_t at = o * tile.out_stride + static_cast<std::ptrdiff_t>(y) * out_cols + x;
          tile.summand = summand ? summand + at : nullptr;
          tile.out = out + at;
          kernel.compute(tile);
        }
      }
    }
  });
}

}  // namespace dendro
