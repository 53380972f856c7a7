#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include <Eigen/Core>

namespace dendro {

struct TriangleMesh {
  std::vector<Eigen::Vector3d> vertices;
  std::vector<std::array<std::uint32_t, 3>> triangles;
};

/// Reads a PLY (ascii or binary little-endian) or OBJ file; polygons are cut into triangle fans.
/// @throws SceneFileError  Naming the file, the line and what is expected.
TriangleMesh ReadMeshFile(const std::string& path);

/// Reads the points of a text file with `x y z` per line (separated by blanks, tabs, commas or
/// semicolons; further columns ignored, lines starting with # or a letter skipped), or of a PLY.
/// @throws SceneFileError
std::vector<Eigen::Vector3d> ReadPointFile(const std::string& path);

}  // namespace dendro
