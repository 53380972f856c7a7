#pragma once

#include <cstdint>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace dendro {

/// A scan organised by ring and azimuth, with the motion of the sweep removed.
///
/// Row r is ring r (row 0 the lowest beam); column c covers azimuths [c, c+1) * 360 / cols degrees,
/// clockwise seen from above as a VLP-16 turns, azimuth 0 along +x. A column is one firing of all
/// rings, placed by the azimuth at which it starts (see Projector). Pixel (r, c) is at index
/// `r * cols + c` of every vector. All geometry is in the lidar frame at `stamp_ns`.
///
/// A pixel without a return has NaN `point` and `range`, `point_index` -1, but still a valid beam
/// (origin and direction): stage 3 uses the beams that missed.
struct RangeImage {
  std::int64_t stamp_ns = 0;                    ///< Stamp of the scan [ns].
  int rows = 0;                                 ///< Number of rings.
  int cols = 0;                                 ///< Number of azimuth columns.
  std::vector<Eigen::Vector3f> point;           ///< Return [m].
  std::vector<float> range;                     ///< Measured range along the beam [m].
  std::vector<float> intensity;                 ///< 0 to 255; 0 where missing.
  std::vector<float> time_s;                    ///< Firing time relative to the stamp [s].
  std::vector<Eigen::Vector3f> beam_origin;     ///< Optical centre when the pixel was fired [m].
  std::vector<Eigen::Vector3f> beam_direction;  ///< Unit direction of the beam.
  std::vector<std::int32_t> point_index;        ///< Index of the return in the source cloud, or -1.
  std::vector<std::int32_t> pixel_of_point;     ///< Per source point its pixel, or -1 (NaN point).
  bool deskewed = false;                        ///< True when odometry removed the sweep's motion.

  std::size_t Index(int row, int col) const {
    return static_cast<std::size_t>(row) * static_cast<std::size_t>(cols) +
           static_cast<std::size_t>(col);
  }
  std::size_t size() const { return point.size(); }
  bool HasReturn(std::size_t pixel) const { return point_index[pixel] >= 0; }
  /// Column index brought into [0, cols): the image wraps at 360 degrees.
  int WrapColumn(int col) const { return ((col % cols) + cols) % cols; }
};

/// Semantic classes of stage 1. Wood is trunk and branch.
enum class Label : std::uint8_t { kNone = 0, kGround = 1, kWood = 2, kLeaf = 3, kOther = 4 };

/// Stage 1's result: a range image with a wood probability and a class per pixel.
struct LabelledScan {
  RangeImage image;
  std::vector<float> wood_probability;  ///< In [0, 1] per pixel; 0 where there is no return.
  std::vector<Label> label;             ///< Per pixel; kNone where there is no return.

  bool IsWood(std::size_t pixel) const { return label[pixel] == Label::kWood; }
};

/// A column that what is seen singles out, wherever azimuth 0 lies: the one with the largest sum of
/// ranges. What starts there instead of at column 0 gives the same for a sensor mounted or started at
/// another azimuth. 0 for an image without returns.
int ReferenceColumn(const RangeImage& image);

/// Label of every source point in the cloud's order: the label of its pixel (several returns in one
/// pixel share it), kNone for points that could not be projected.
std::vector<Label> PointLabels(const LabelledScan& scan);

}  // namespace dendro
