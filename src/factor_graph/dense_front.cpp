#include "dense_front.h"

#include <algorithm>
#include <cmath>

#include <Eigen/Core>

namespace dendro::internal {

namespace {

using Stride = Eigen::OuterStride<>;
using Block = Eigen::Map<Eigen::MatrixXd, 0, Stride>;

constexpr int kPanel = 32;

}  // namespace

int PartialCholesky(double* A, int stride, int size, int frontal, const double* limits) {
  for (int k = 0; k < frontal; k += kPanel) {
    const int width = std::min(kPanel, frontal - k);
    for (int j = 0; j < width; ++j) {
      double* column = A + static_cast<long>(k + j) * stride + k;
      const double pivot = column[j];
      if (!(pivot > limits[k + j]) || !(pivot > 0.0)) return k + j;
      const double inverse = 1.0 / std::sqrt(pivot);
      const int below = size - k;
      for (int i = j; i < below; ++i) column[i] *= inverse;
      for (int c = j + 1; c < width; ++c) {
        double* target = A + static_cast<long>(k + c) * stride + k;
        const double factor = column[c];
        for (int i = c; i < below; ++i) target[i] -= factor * column[i];
      }
    }
    const int rest = size - k - width;
    if (rest > 0) {
      const Block L21(A + static_cast<long>(k) * stride + k + width, rest, width, Stride(stride));
      Block A22(A + static_cast<long>(k + width) * stride + k + width, rest, rest, Stride(stride));
      A22.selfadjointView<Eigen::Lower>().rankUpdate(L21, -1.0);
    }
  }
  return -1;
}

}  // namespace dendro::internal
