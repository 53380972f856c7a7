#pragma once

namespace dendro::internal {

/// Partial Cholesky factorisation of a frontal matrix in place (lower triangle, column-major):
/// eliminates the first `frontal` of `size` columns, leaving
/// `[L11; L21]` in their columns and the Schur complement `A22 - L21 L21^T` in the rest.
/// @param A          Column-major, leading dimension `stride` >= size; only the lower triangle is used.
/// @param limits  Shape (frontal): a pivot must exceed its limit (and zero).
/// @return        -1, or the first column whose pivot does not.
int PartialCholesky(double* A, int stride, int size, int frontal, const double* limits);

}  // namespace dendro::internal
