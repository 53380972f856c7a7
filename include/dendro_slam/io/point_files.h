#pragma once

#include <string>
#include <vector>

#include "dendro_slam/topology/map_cloud.h"

/// The points of a map as files.
namespace dendro {

/// PLY, binary little-endian: x y z (double), label (uchar, as Label), tree_id and branch_id (int;
/// -1 none). What `points.ply` in a map directory is.
std::string PointsToPly(const std::vector<CloudPoint>& points);

/// Reads what PointsToPly writes.
/// @param name  File name for messages.
/// @throws MapFileError  One line: the file and what is wrong.
std::vector<CloudPoint> PointsFromPly(const std::string& content, const std::string& name);

/// LAS 1.4 (ASPRS, R15), point format 6, with tree_id and branch_id (int32, -1 none) as extra bytes.
/// Coordinates in steps of 0.1 mm from the offset. Classification: 64 wood, 5 (high vegetation)
/// leaf; LAS has no class for wood, and those from 64 on are the user's. No time and no intensity.
///
/// Written by hand: PDAL is not in Debian 12, LASlib neither, and the fixed part of the format that
/// one such file needs is less code than a binding to either.
///
/// @param offset  Added by the reader to every coordinate [m].
/// @throws std::invalid_argument  For points that are not finite or more than 200 km from the
/// offset.
std::string PointsToLas(const std::vector<CloudPoint>& points,
                        const Eigen::Vector3d& offset = Eigen::Vector3d::Zero());

}  // namespace dendro
