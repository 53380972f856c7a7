#include "dense_front.h"

#include <algorithm>
#include <cmath>

#if defined(__x86_64__) && defined(__GNUC__)
#define DENDRO_X86_KERNELS 1
#include <immintrin.h>
#endif

namespace dendro::internal {

namespace {

constexpr int kPanel = 48;    // Columns whose update of the rest is delayed into one product.
constexpr int kSubPanel = 8;  // Columns eliminated one by one.
constexpr int kTileRows = 12;
constexpr int kTileColumns = 4;

// The two inner kernels, for one instruction set.
struct Kernels {
  // A(i, j) -= sum over k in [k0, k1) of A(i, k) A(j, k), for the lower triangle of the columns
  // [j0, j1) down to row `size`; may overwrite the upper triangle.
  void (*update)(double* A, std::size_t ld, int size, int k0, int k1, int j0, int j1);
  // Eliminates the columns [k0, k1) within themselves; the failing column or -1.
  int (*eliminate)(double* A, std::size_t ld, int size, int k0, int k1, const double* limits);
};

inline __attribute__((always_inline)) int EliminateColumns(double* A,
                                                           std::size_t ld,
                                                           int size,
                                                           int k0,
                                                           int k1,
                                                           const double* limits) {
  for (int k = k0; k < k1; ++k) {
    double* __restrict column = A + static_cast<std::size_t>(k) * ld;
    const double pivot = column[k];
    if (!(pivot > limits[k]) || !(pivot > 0.0)) return k;
    const double inverse = 1.0 / std::sqrt(pivot);
    for (int i = k; i < size; ++i) column[i] *= inverse;
    for (int c = k + 1; c < k1; ++c) {
      double* __restrict target = A + static_cast<std::size_t>(c) * ld;
      const double factor = column[c];
      for (int i = c; i < size; ++i) target[i] -= factor * column[i];
    }
  }
  return -1;
}

int EliminatePlain(double* A, std::size_t ld, int size, int k0, int k1, const double* limits) {
  return EliminateColumns(A, ld, size, k0, k1, limits);
}

void UpdatePlain(double* A, std::size_t ld, int size, int k0, int k1, int j0, int j1) {
  constexpr int kRows = 4;
  constexpr int kColumns = 2;
  for (int j = j0; j < j1; j += kColumns) {
    const int columns = std::min(kColumns, j1 - j);
    for (int i = j; i < size; i += kRows) {
      double sum[kColumns][kRows] = {};
      for (int k = k0; k < k1; ++k) {
        const double* a = A + static_cast<std::size_t>(k) * ld + i;
        const double* b = A + static_cast<std::size_t>(k) * ld + j;
        for (int c = 0; c < kColumns; ++c) {
          for (int r = 0; r < kRows; ++r) sum[c][r] += a[r] * b[c];
        }
      }
      for (int c = 0; c < columns; ++c) {
        double* target = A + static_cast<std::size_t>(j + c) * ld + i;
        for (int r = 0; r < kRows; ++r) target[r] -= sum[c][r];
      }
    }
  }
}

#ifdef DENDRO_X86_KERNELS

__attribute__((target("avx2,fma"))) int EliminateAvx2(double* A,
                                                       std::size_t ld,
                                                       int size,
                                                       int k0,
                                                       int k1,
                                                       const double* limits) {
  for (int k = k0; k < k1; ++k) {
    double* column = A + static_cast<std::size_t>(k) * ld;
    const double pivot = column[k];
    if (!(pivot > limits[k]) || !(pivot > 0.0)) return k;
    const __m256d inverse = _mm256_set1_pd(1.0 / std::sqrt(pivot));
    for (int i = k; i < size; i += 4) {
      _mm256_storeu_pd(column + i, _mm256_mul_pd(_mm256_loadu_pd(column + i), inverse));
    }
    for (int c = k + 1; c < k1; ++c) {
      double* target = A + static_cast<std::size_t>(c) * ld;
      const __m256d factor = _mm256_set1_pd(column[c]);
      for (int i = c; i < size; i += 4) {
        _mm256_storeu_pd(target + i, _mm256_fnmadd_pd(factor,
                                                      _mm256_loadu_pd(column + i),
                                                      _mm256_loadu_pd(target + i)));
      }
    }
  }
  return -1;
}

// Register tile of 12 rows by 4 columns: 12 accumulators, 3 loads and 4 broadcasts per step.
__attribute__((target("avx2,fma"))) void UpdateAvx2(double* A,
                                                     std::size_t ld,
                                                     int size,
                                                     int k0,
                                                     int k1,
                                                     int j0,
                                                     int j1) {
  for (int j = j0; j < j1; j += kTileColumns) {
    const int columns = std::min(kTileColumns, j1 - j);
    int i = j;
    for (; i < size; i += kTileRows) {
      __m256d s00 = _mm256_setzero_pd(), s01 = s00, s02 = s00;
      __m256d s10 = s00, s11 = s00, s12 = s00;
      __m256d s20 = s00, s21 = s00, s22 = s00;
      __m256d s30 = s00, s31 = s00, s32 = s00;
      const double* a = A + static_cast<std::size_t>(k0) * ld + i;
      const double* b = A + static_cast<std::size_t>(k0) * ld + j;
      for (int k = k0; k < k1; ++k, a += ld, b += ld) {
        const __m256d a0 = _mm256_loadu_pd(a);
        const __m256d a1 = _mm256_loadu_pd(a + 4);
        const __m256d a2 = _mm256_loadu_pd(a + 8);
        __m256d x = _mm256_broadcast_sd(b);
        s00 = _mm256_fmadd_pd(a0, x, s00);
        s01 = _mm256_fmadd_pd(a1, x, s01);
        s02 = _mm256_fmadd_pd(a2, x, s02);
        x = _mm256_broadcast_sd(b + 1);
        s10 = _mm256_fmadd_pd(a0, x, s10);
        s11 = _mm256_fmadd_pd(a1, x, s11);
        s12 = _mm256_fmadd_pd(a2, x, s12);
        x = _mm256_broadcast_sd(b + 2);
        s20 = _mm256_fmadd_pd(a0, x, s20);
        s21 = _mm256_fmadd_pd(a1, x, s21);
        s22 = _mm256_fmadd_pd(a2, x, s22);
        x = _mm256_broadcast_sd(b + 3);
        s30 = _mm256_fmadd_pd(a0, x, s30);
        s31 = _mm256_fmadd_pd(a1, x, s31);
        s32 = _mm256_fmadd_pd(a2, x, s32);
      }
      double* t = A + static_cast<std::size_t>(j) * ld + i;
      const auto subtract = [](double* out, __m256d x0, __m256d x1, __m256d x2)
                                __attribute__((target("avx2,fma"), always_inline)) {
        _mm256_storeu_pd(out, _mm256_sub_pd(_mm256_loadu_pd(out), x0));
        _mm256_storeu_pd(out + 4, _mm256_sub_pd(_mm256_loadu_pd(out + 4), x1));
        _mm256_storeu_pd(out + 8, _mm256_sub_pd(_mm256_loadu_pd(out + 8), x2));
      };
      subtract(t, s00, s01, s02);
      if (columns > 1) subtract(t + ld, s10, s11, s12);
      if (columns > 2) subtract(t + 2 * ld, s20, s21, s22);
      if (columns > 3) subtract(t + 3 * ld, s30, s31, s32);
    }
  }
}

#endif

Kernels ChooseKernels() {
#ifdef DENDRO_X86_KERNELS
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) {
    return {UpdateAvx2, EliminateAvx2};
  }
#endif
  return {UpdatePlain, EliminatePlain};
}

}  // namespace

int PartialCholesky(double* A, int stride, int size, int frontal, const double* limits) {
  static const Kernels kernels = ChooseKernels();
  const auto ld = static_cast<std::size_t>(stride);
  for (int k = 0; k < frontal; k += kPanel) {
    const int panel_end = std::min(frontal, k + kPanel);
    for (int s = k; s < panel_end; s += kSubPanel) {
      const int end = std::min(panel_end, s + kSubPanel);
      const int failed = kernels.eliminate(A, ld, size, s, end, limits);
      if (failed >= 0) return failed;
      if (end < panel_end) kernels.update(A, ld, size, s, end, end, panel_end);
    }
    if (panel_end < size) kernels.update(A, ld, size, k, panel_end, panel_end, size);
  }
  return -1;
}

}  // namespace dendro::internal
