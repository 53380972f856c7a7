#pragma once

#include <optional>
#include <vector>

#include "dendro_slam/range_image/range_image.h"
#include "dendro_slam/segmentation/ground_plane.h"

namespace dendro {

/// Number of planes the network sees per pixel.
inline constexpr int kNetworkInputChannels = 21;
/// Name of this set of planes in weights files and training data.
inline constexpr const char* kNetworkInputVersion = "dendro_range_planes_4";

/// Range, position and intensity of a scan as the network's input planes, each about in [-1, 1]:
///
///   0 mask        1 where there is a return, else 0; all other planes are 0 where it is 0
///   1 range       log2(range / 4 m) / 2
///   2 intensity   intensity / 128 - 0.5
///   3 height      height over the ground plane / 2 m, within [-1, 3]; 0 if no ground was found
///   4 up          component of the beam along the ground's normal; 0 if no ground was found
///   5 lateral     d / (|d| + 0.1 m), d the step in range to the next column
///   6 vertical    d / (|d| + 0.2 m), d the step in horizontal distance to the next row
///   7 rise        d / (|d| + 0.2 m), d the step in z to the next row
///   8 side        component of the direction to the next column along the ground's normal: with `up`
///                 it tells which way a stem runs through the image of a tilted sensor; 0 if no ground
///
/// Of the run that the pixel belongs to, that is of the neighbouring returns of its row between which
/// the range steps by less than 5 cm and two widths of a column:
///
///   9 width       log2(width / 0.1 m) / 4, the width being returns x range x 2 pi / columns
///  10 brightness  mean intensity / 128 - 0.5
///  11 bulge       b / (|b| + 0.05 m), b how much farther the ends are than the middle by the best
///                 parabola: the depth of the arc for a stem; 0 below four returns
///  12 slant       s / (s + 0.2 m), s the difference in range between the ends by the best line; 0 below
///                 three returns
///  13 roughness   e / (e + 0.01 m), e the root mean square distance from that line and parabola
///
/// 11 to 13 are 0 for runs over more than an eighth of the turn (ground and walls). A leaf is narrow,
/// flat and slanting, wood is narrow and round or goes on: a look at the whole run tells them apart
/// where the few columns of one convolution cannot.
///
///  14 to 20      whether a thin straight thing goes on in the rows above and below, see LineSupport(); 0
///               for returns within 12 cm of the ground plane
///
/// A step towards a missing pixel counts as infinitely far (+1, and for 7 as 0).
///
/// @note Deviates: the thesis and RangeNet++ feed x, y, z (and intensity, range). Raw x and y
///   change when the sensor turns about its axis and tell centimetres apart only in the fourth
///   digit; here the same five quantities come as range, height, steps between neighbours and the
///   shape of runs, which makes the labels independent of the azimuth of column 0.
///
/// @param columns  Source column of each column of the canvas; -1 leaves a column empty.
/// @return kNetworkInputChannels x image.rows x columns.size() floats, row-major.
std::vector<float> NetworkInput(const RangeImage& image,
                                const std::optional<GroundPlane>& ground,
                                const std::vector<int>& columns);

}  // namespace dendro
