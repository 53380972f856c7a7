#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "dendro_slam/mapping/tree_model.h"

namespace dendro {

using Rgb = std::array<std::uint8_t, 3>;

/// Triangles with one colour per vertex, metres.
struct Mesh {
  std::vector<Eigen::Vector3d> vertices;
  std::vector<Rgb> colors;                             ///< One per vertex.
  std::vector<std::array<std::int32_t, 3>> triangles;  ///< Counter-clockwise seen from outside.
};

enum class MeshColor { kByBranch, kByOrder, kBySigma };

/// Colour of a branch: Okabe and Ito's palette, safe for colour-blind readers, by id; every second
/// round of its seven colours is darker.
Rgb BranchColor(int branch_id);
/// Colour of a branch order (0 trunk).
Rgb OrderColor(int order);
/// Colour of a relative radius sigma on the cividis scale, 0 to `max_relative` (grey for inferred).
Rgb SigmaColor(double relative_sigma, double max_relative = 0.2);
/// Colour of one cylinder under a scheme; INFERRED ones are paler.
Rgb CylinderColor(const MapCylinder& cylinder, MeshColor scheme);

/// Radius of a cylinder at its start (base end) and end (tip end), from its taper, never below
/// zero.
double StartRadius(const MapCylinder& cylinder);
double EndRadius(const MapCylinder& cylinder);

/// The closed surface of one cylinder as a frustum, appended to a mesh.
/// @param sides  Number of sides of its polygon, >= 3.
/// @param caps  False: the mantle only, for frusta whose ends touch others.
void AppendFrustum(
    const MapCylinder& cylinder, const Rgb& color, int sides, Mesh* mesh, bool caps = true);

/// Every cylinder of the model (or of one tree; -1 for what is attached to none).
Mesh ModelMesh(const TreeModel& model, MeshColor scheme, int sides = 12);
/// @param inner_caps  False: no caps where one cylinder of a branch touches the next; they cannot be
///                    seen.
Mesh TreeMesh(const TreeModel& model,
              int tree_id,
              MeshColor scheme,
              int sides = 12,
              bool inner_caps = true);

/// The mesh as a binary little-endian PLY file's content: vertices (float x y z, uchar red green
/// blue), faces.
std::string MeshToPly(const Mesh& mesh);

}  // namespace dendro
