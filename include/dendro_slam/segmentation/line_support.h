#pragma once

#include <vector>

namespace dendro {

/// Number of planes LineSupport() writes.
inline constexpr int kLineSupportPlanes = 7;

/// Ranges of a scan as LineSupport() reads them. Row-major, rows x cols.
struct LineSupportInput {
  int rows = 0, cols = 0;
  float row_gap_rad = 0.0F;           ///< Angle between neighbouring rows.
  std::vector<float> range;           ///< [m]; 0 where there is no return.
  std::vector<float> log_width;       ///< log2 of the width [m] of the run of each return.
  std::vector<char> wanted;           ///< Where planes are wanted; elsewhere they are 0.
};

/// How well a straight, thin object through each return goes on in the three rows above and below.
///
/// Every slope in the image is tried, from straight up to 1.2 rows sideways a row. The returns nearest
/// in range in the next rows give the slope in depth, and a straight line is straight in 1 / range, so
/// that the second difference of the range r over steps of the angle d is r d^2 + 2 (dr)^2 / r. A row
/// in which a return lies on the line counts +1, one in which something nearer hides the line 0, one
/// whose beam passed through -1: a branch goes on or is hidden, a leaf ends. Planes, for the slope with
/// the highest sum less 0.3 of plane 5 and 5 / m of the second difference:
///
///   0 support     that value / 3
///   1 rows        rows with a return on the line / 3
///   2 bend        second difference in range between the neighbouring rows / (3 cm + 0.4 % of the range),
///                 0 if one of them has no return near by
///   3 depth       step in range a row / distance of rows
///   4 slope       columns a row / the steepest tried
///   5 likeness    mean |log2 of the ratio of run widths| of the returns on the line, at most 3
///   6 elsewhere   mean sum over all slopes / 3
///
/// Each within [-5, 5]; all 0 for an image of one row. Columns wrap; rows outside of the image do not count.
/// @return kLineSupportPlanes x rows x cols.
std::vector<float> LineSupport(const LineSupportInput& input);

}  // namespace dendro
