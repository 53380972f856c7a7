#pragma once

#include <cstddef>

namespace dendro::internal {

/// Rows and columns of zeros that a frontal matrix needs beyond its size, so that the kernels work
/// on whole tiles.
constexpr int kFrontPadding = 12;

/// Leading dimension (and number of columns to allocate) for a frontal matrix of `size` columns.
inline int FrontStride(int size) { return (size + kFrontPadding + 3) / 4 * 4; }

/// Partial Cholesky factorisation of a frontal matrix in place (lower triangle, column-major):
/// eliminates the first `frontal` of `size` columns, leaving `[L11; L21]` in their columns and the
/// Schur complement `A22 - L21 L21^T` in the rest.
///
/// Blocked; the inner products run on register tiles, with AVX2 where the processor has it. The
/// kernels are chosen once, so a machine gives the same bits every time.
/// @param A       Column-major, shape (stride, stride), stride = FrontStride(size); the lower triangle's
///                rows and columns beyond `size` are zero. What is above the diagonal is overwritten
///                and has no influence.
/// @param limits  Shape (frontal): a pivot must exceed its limit (and zero).
/// @return        -1, or the first column whose pivot does not.
int PartialCholesky(double* A, int stride, int size, int frontal, const double* limits);

/// Solves `L11^T x_f = d - L21^T x_s` of one conditional.
/// @param L  `[L11; L21; d^T]`, column-major, shape (frontal + separator + 1, frontal).
/// @param x  In: x_s in the entries from `frontal` on; out: x_f before them.
void SolveConditional(const double* L, int frontal, int separator, double* x);

}  // namespace dendro::internal
