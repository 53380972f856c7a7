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
constexpr int kSolveColumns = 4;  // Columns of a conditional that share the loads of x.

// The inner kernels, for one instruction set.
struct Kernels {
  // A(i, j) -= sum over k in [k0, k1) of A(i, k) A(j, k), for the lower triangle of the columns
  // [j0, j1) down to row `size`; may overwrite the upper triangle.
  void (*update)(double* A, std::size_t ld, int size, int k0, int k1, int j0, int j1);
  // Eliminates the columns [k0, k1) within themselves; the failing column or -1.
  int (*eliminate)(double* A, std::size_t ld, int size, int k0, int k1, const double* limits);
  // sums[c] = sum over i in [0, n) of L(i, c) x(i) for kSolveColumns columns.
  void (*dots)(const double* L, std::size_t ld, int n, const double* x, double* sums);
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

void DotsPlain(const double* L, std::size_t ld, int n, const double* x, double* sums) {
  double sum[kSolveColumns] = {};
  for (int i = 0; i < n; ++i) {
    for (int c = 0; c < kSolveColumns; ++c) sum[c] += L[static_cast<std::size_t>(c) * ld + i] * x[i];
  }
  for (int c = 0; c < kSolveColumns; ++c) sums[c] = sum[c];
}

#ifdef DENDRO_X86_KERNELS

__attribute__((target("avx2,fma"))) void DotsAvx2(const double* L,
                                                   std::size_t ld,
                                                   int n,
                                                   const double* x,
                                                   double* sums) {
  __m256d s0 = _mm256_setzero_pd(), s1 = s0, s2 = s0, s3 = s0;
  __m256d t0 = s0, t1 = s0, t2 = s0, t3 = s0;
  const double* l1 = L + ld;
  const double* l2 = l1 + ld;
  const double* l3 = l2 + ld;
  int i = 0;
  for (; i + 8 <= n; i += 8) {
    const __m256d a = _mm256_loadu_pd(x + i);
    const __m256d b = _mm256_loadu_pd(x + i + 4);
    s0 = _mm256_fmadd_pd(_mm256_loadu_pd(L + i), a, s0);
    t0 = _mm256_fmadd_pd(_mm256_loadu_pd(L + i + 4), b, t0);
    s1 = _mm256_fmadd_pd(_mm256_loadu_pd(l1 + i), a, s1);
    t1 = _mm256_fmadd_pd(_mm256_loadu_pd(l1 + i + 4), b, t1);
    s2 = _mm256_fmadd_pd(_mm256_loadu_pd(l2 + i), a, s2);
    t2 = _mm256_fmadd_pd(_mm256_loadu_pd(l2 + i + 4), b, t2);
    s3 = _mm256_fmadd_pd(_mm256_loadu_pd(l3 + i), a, s3);
    t3 = _mm256_fmadd_pd(_mm256_loadu_pd(l3 + i + 4), b, t3);
  }
  alignas(32) double lanes[4];
  const auto reduce = [&lanes](__m256d u, __m256d v)
                          __attribute__((target("avx2,fma"), always_inline)) {
    _mm256_store_pd(lanes, _mm256_add_pd(u, v));
    return (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]);
  };
  sums[0] = reduce(s0, t0);
  sums[1] = reduce(s1, t1);
  sums[2] = reduce(s2, t2);
  sums[3] = reduce(s3, t3);
  for (; i < n; ++i) {
    sums[0] += L[i] * x[i];
    sums[1] += l1[i] * x[i];
    sums[2] += l2[i] * x[i];
    sums[3] += l3[i] * x[i];
  }
}

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
    return {UpdateAvx2, EliminateAvx2, DotsAvx2};
  }
#endif
  return {UpdatePlain, EliminatePlain, DotsPlain};
}

const Kernels& ChosenKernels() {
  static const Kernels kernels = ChooseKernels();
  return kernels;
}

}  // namespace

int PartialCholesky(double* A, int stride, int size, int frontal, const double* limits) {
  const Kernels& kernels = ChosenKernels();
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

void SolveConditional(const double* L, int frontal, int separator, double* x) {
  const Kernels& kernels = ChosenKernels();
  const int rhs = frontal + separator;
  const auto ld = static_cast<std::size_t>(rhs) + 1;
  int j = frontal;
  for (; j >= kSolveColumns; j -= kSolveColumns) {
    const int first = j - kSolveColumns;
    const double* block = L + static_cast<std::size_t>(first) * ld;
    double sums[kSolveColumns];
    kernels.dots(block + j, ld, rhs - j, x + j, sums);
    for (int c = kSolveColumns - 1; c >= 0; --c) {
      const double* column = block + static_cast<std::size_t>(c) * ld + first;
      double sum = sums[c];
      for (int i = c + 1; i < kSolveColumns; ++i) sum += column[i] * x[first + i];
      x[first + c] = (column[rhs - first] - sum) / column[c];
    }
  }
  for (--j; j >= 0; --j) {
    const double* column = L + static_cast<std::size_t>(j) * ld;
    double sum = 0.0;
    for (int i = j + 1; i < rhs; ++i) sum += column[i] * x[i];
    x[j] = (column[rhs] - sum) / column[j];
  }
}

}  // namespace dendro::internal
