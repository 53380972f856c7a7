#include "dendro_slam/segmentation/convolution.h"

#include <algorithm>
#include <cstddef>
#include <random>
#include <stdexcept>
#include <vector>

#include <gtest/gtest.h>
#include <opencv2/core/utility.hpp>

namespace dendro {
namespace {

std::vector<float> Noise(std::size_t count, unsigned seed) {
  std::mt19937 rng(seed);
  std::normal_distribution<float> normal;
  std::vector<float> values(count);
  for (float& v : values) v = normal(rng);
  return values;
}

struct Case {
  ConvolutionShape shape;
  int rows, cols;
};

// Every shape of the network, and some that are odd in every way.
std::vector<Case> Cases() {
  return {{{14, 16, 3, 5, 1, 2, 1, 1, 1, 2}, 16, 200}, {{16, 16, 3, 3, 2, 2, 1, 1, 1, 1}, 16, 100},
          {{32, 32, 3, 1, 1, 1, 1, 1, 1, 0}, 8, 50},   {{32, 32, 1, 3, 1, 1, 1, 8, 0, 8}, 4, 49},
          {{8, 9, 3, 1, 1, 1, 4, 1, 4, 0}, 4, 31},     {{3, 17, 1, 1, 1, 1, 1, 1, 0, 0}, 5, 7},
          {{5, 4, 5, 7, 2, 3, 1, 1, 2, 3}, 7, 26},     {{2, 3, 3, 3, 2, 2, 2, 3, 1, 0}, 9, 23},
          {{1, 1, 3, 3, 1, 1, 1, 1, 2, 2}, 1, 1},      {{4, 8, 3, 3, 1, 1, 3, 2, 0, 0}, 7, 5},
          {{6, 30, 1, 3, 1, 1, 1, 16, 0, 16}, 2, 9}};
}

// The definition, in double precision.
double Expected(const Case& c,
                const std::vector<float>& in,
                const std::vector<float>& weights,
                int o,
                int y,
                int x) {
  const ConvolutionShape& s = c.shape;
  double sum = 0.0;
  for (int k = 0; k < s.inputs; ++k) {
    for (int i = 0; i < s.kernel_h; ++i) {
      for (int j = 0; j < s.kernel_w; ++j) {
        const int row = y * s.stride_h + i * s.dilation_h - s.pad_h;
        const int col = x * s.stride_w + j * s.dilation_w - s.pad_w;
        if (row < 0 || row >= c.rows || col < 0 || col >= c.cols) continue;
        sum += static_cast<double>(weights[static_cast<std::size_t>(
                   ((o * s.inputs + k) * s.kernel_h + i) * s.kernel_w + j)]) *
               in[static_cast<std::size_t>((k * c.rows + row) * c.cols + col)];
      }
    }
  }
  return sum;
}

std::vector<ConvolutionKernel> KernelsHere() {
  std::vector<ConvolutionKernel> kernels;
  for (const auto kernel :
       {ConvolutionKernel::kPlain, ConvolutionKernel::kAvx2, ConvolutionKernel::kAvx512}) {
    if (kernel <= FastestConvolutionKernel()) kernels.push_back(kernel);
  }
  return kernels;
}

TEST(Convolution, IsTheSumItIsDefinedAsOnEveryInstructionSet) {
  for (const Case& c : Cases()) {
    const ConvolutionShape& s = c.shape;
    const auto size = [](int a, int b, int d) {
      return static_cast<std::size_t>(a) * static_cast<std::size_t>(b) * static_cast<std::size_t>(d);
    };
    const std::vector<float> weights =
        Noise(size(s.inputs, s.outputs, s.kernel_h * s.kernel_w), 1);
    const std::vector<float> bias = Noise(static_cast<std::size_t>(s.outputs), 2);
    const std::vector<float> in = Noise(size(s.inputs, c.rows, c.cols), 3);
    const int rows = s.OutputRows(c.rows);
    const int cols = s.OutputCols(c.cols);
    const std::vector<float> summand = Noise(size(s.outputs, rows, cols), 4);
    for (const ConvolutionKernel kernel : KernelsHere()) {
      Convolution plain(s, weights.data(), bias.data(), false, kernel);
      Convolution relu(s, weights.data(), bias.data(), true, kernel);
      std::vector<float> out(summand.size());
      std::vector<float> out_relu(summand.size());
      plain.Run(in.data(), c.rows, c.cols, nullptr, out.data());
      relu.Run(in.data(), c.rows, c.cols, summand.data(), out_relu.data());
      std::size_t at = 0;
      for (int o = 0; o < s.outputs; ++o) {
        for (int y = 0; y < rows; ++y) {
          for (int x = 0; x < cols; ++x, ++at) {
            const double expected =
                Expected(c, in, weights, o, y, x) + bias[static_cast<std::size_t>(o)];
            ASSERT_NEAR(out[at], expected, 1e-4);
            ASSERT_NEAR(out_relu[at], std::max(0.0, expected + summand[at]), 1e-4);
          }
        }
      }
    }
  }
}

TEST(Convolution, AnotherImageLeavesNothingBehind) {
  const ConvolutionShape shape{3, 5, 3, 3, 1, 2, 1, 1, 1, 1};
  const std::vector<float> weights = Noise(3 * 5 * 9, 1);
  const std::vector<float> bias = Noise(5, 2);
  const std::vector<float> small = Noise(3 * 4 * 10, 3);
  const std::vector<float> large = Noise(3 * 6 * 90, 4);
  Convolution used(shape, weights.data(), bias.data(), true);
  Convolution fresh(shape, weights.data(), bias.data(), true);
  std::vector<float> first(5 * 4 * 5);
  std::vector<float> again(first.size());
  std::vector<float> other(5 * 6 * 45);
  used.Run(large.data(), 6, 90, nullptr, other.data());
  used.Run(small.data(), 4, 10, nullptr, again.data());
  fresh.Run(small.data(), 4, 10, nullptr, first.data());
  EXPECT_EQ(first, again);
}

TEST(Convolution, ThreadsChangeNothing) {
  const ConvolutionShape shape{8, 24, 3, 3, 1, 1, 1, 1, 1, 1};
  const std::vector<float> weights = Noise(8 * 24 * 9, 1);
  const std::vector<float> bias = Noise(24, 2);
  const std::vector<float> in = Noise(8 * 16 * 130, 3);
  Convolution convolution(shape, weights.data(), bias.data(), true);
  const int threads = cv::getNumThreads();
  std::vector<float> one(24 * 16 * 130);
  std::vector<float> four(one.size());
  cv::setNumThreads(1);
  convolution.Run(in.data(), 16, 130, nullptr, one.data());
  cv::setNumThreads(4);
  convolution.Run(in.data(), 16, 130, nullptr, four.data());
  cv::setNumThreads(threads);
  EXPECT_EQ(one, four);
}

TEST(Convolution, RefusesWhatDoesNotFit) {
  const std::vector<float> numbers(100);
  ConvolutionShape shape{1, 1, 3, 3, 1, 1, 1, 1, 0, 0};
  Convolution convolution(shape, numbers.data(), numbers.data(), false);
  std::vector<float> out(100);
  EXPECT_THROW(convolution.Run(numbers.data(), 2, 9, nullptr, out.data()), std::invalid_argument);
  EXPECT_THROW(convolution.Run(numbers.data(), 9, 2, nullptr, out.data()), std::invalid_argument);
  EXPECT_THROW(convolution.Run(numbers.data(), 0, 9, nullptr, out.data()), std::invalid_argument);
  shape.stride_w = 0;
  EXPECT_THROW(Convolution(shape, numbers.data(), numbers.data(), false), std::invalid_argument);
  shape.stride_w = 1;
  shape.pad_h = -1;
  EXPECT_THROW(Convolution(shape, numbers.data(), numbers.data(), false), std::invalid_argument);
}

}  // namespace
}  // namespace dendro
