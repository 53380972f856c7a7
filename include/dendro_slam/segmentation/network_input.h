#pragma once

#include <optional>
#include <vector>

#include "dendro_slam/range_image/range_image.h"
#include "dendro_slam/segmentation/ground_plane.h"

namespace dendro {

/// Number of planes the network sees per pixel.
inline constexpr int kNetworkInputChannels = 9;

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
/// A step towards a missing pixel counts as infinitely far (+1, and for 7 as 0).
///
/// @note Deviates: the thesis and RangeNet++ feed x, y, z (and intensity, range). Raw x and y
///   change when the sensor turns about its axis and tell centimetres apart only in the fourth
///   digit; here the same five quantities come as range, height and steps between neighbours,
///   which makes the labels independent of the azimuth of column 0.
///
/// @param columns  Source column of each column of the canvas; -1 leaves a column empty.
/// @return kNetworkInputChannels x image.rows x columns.size() floats, row-major.
std::vector<float> NetworkInput(const RangeImage& image,
                                const std::optional<GroundPlane>& ground,
                                const std::vector<int>& columns);

}  // namespace dendro
