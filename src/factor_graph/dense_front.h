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
/// @param A       Column-major, shape (stride, stride), stride = FrontStride(size); rows and columns
///                beyond `size` are zero. The upper triangle is overwritten.
/// @param limits  Shape (frontal): a pivot must exceed its limit (and zero).
/// @return        -1, or the first column whose pivot does not.
int PartialCholesky(double* A, int stride, int size, int frontal, const double* limits);

}  // namespace dendro::internal
