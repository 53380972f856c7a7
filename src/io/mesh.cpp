#include "dendro_slam/io/mesh.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <set>
#include <stdexcept>

#include <fmt/format.h>

#include "dendro_slam/geometry/cylinder.h"

namespace dendro {

namespace {

// Okabe and Ito 2008, "Color Universal Design"; black is left out, it is for the trunk's outline.
constexpr std::array<Rgb, 7> kOkabeIto = {Rgb{230, 159, 0},
                                          Rgb{86, 180, 233},
                                          Rgb{0, 158, 115},
                                          Rgb{240, 228, 66},
                                          Rgb{0, 114, 178},
                                          Rgb{213, 94, 0},
                                          Rgb{204, 121, 167}};
constexpr Rgb kTrunkColor = {120, 94, 66};
constexpr Rgb kInferredColor = {170, 170, 170};
// Cividis (Nunez et al. 2018) at 0, 0.25, 0.5, 0.75 and 1.
constexpr std::array<Rgb, 5> kCividis = {Rgb{0, 34, 78},
                                         Rgb{66, 78, 108},
                                         Rgb{124, 123, 120},
                                         Rgb{187, 174, 104},
                                         Rgb{255, 234, 70}};

std::uint8_t Mix(std::uint8_t a, std::uint8_t b, double f) {
  return static_cast<std::uint8_t>(std::lround((1.0 - f) * a + f * b));
}

Rgb Mix(const Rgb& a, const Rgb& b, double f) {
  return {Mix(a[0], b[0], f), Mix(a[1], b[1], f), Mix(a[2], b[2], f)};
}

template <class T>
void Append(std::string* out, T value) {
  char bytes[sizeof(T)];
  std::memcpy(bytes, &value, sizeof(T));
  out->append(bytes, sizeof(T));
}

}  // namespace

Rgb BranchColor(int branch_id) {
  if (branch_id < 0) return kInferredColor;
  const auto id = static_cast<std::size_t>(branch_id);
  const Rgb color = kOkabeIto[id % kOkabeIto.size()];
  const bool dark = (id / kOkabeIto.size()) % 2 == 1;
  return dark ? Mix(color, Rgb{0, 0, 0}, 0.4) : color;
}

Rgb OrderColor(int order) {
  if (order <= 0) return kTrunkColor;
  return kOkabeIto[static_cast<std::size_t>(order - 1) % kOkabeIto.size()];
}

Rgb SigmaColor(double relative_sigma, double max_relative) {
  const double f = std::clamp(relative_sigma / max_relative, 0.0, 1.0) * (kCividis.size() - 1);
  const auto low = std::min(static_cast<std::size_t>(f), kCividis.size() - 2);
  return Mix(kCividis[low], kCividis[low + 1], f - static_cast<double>(low));
}

Rgb CylinderColor(const MapCylinder& cylinder, MeshColor scheme) {
  const bool inferred = cylinder.status != FitStatus::kMeasured;
  switch (scheme) {
    case MeshColor::kBySigma:
      if (inferred || !(cylinder.radius_m > 0.0)) return kInferredColor;
      return SigmaColor(cylinder.radius_sigma_m / cylinder.radius_m);
    case MeshColor::kByOrder: {
      const Rgb color = OrderColor(cylinder.branch_order);
      return inferred ? Mix(color, Rgb{255, 255, 255}, 0.5) : color;
    }
    case MeshColor::kByBranch:
      break;
  }
  const Rgb color = BranchColor(cylinder.branch_id);
  return inferred ? Mix(color, Rgb{255, 255, 255}, 0.5) : color;
}

double StartRadius(const MapCylinder& cylinder) {
  return std::max(0.0, cylinder.radius_m - 0.5 * cylinder.taper_m_per_m * cylinder.Length());
}

double EndRadius(const MapCylinder& cylinder) {
  return std::max(0.0, cylinder.radius_m + 0.5 * cylinder.taper_m_per_m * cylinder.Length());
}

void AppendFrustum(
    const MapCylinder& cylinder, const Rgb& color, int sides, Mesh* mesh, bool caps) {
  if (sides < 3) throw std::invalid_argument("sides: a frustum needs at least 3");
  if (!(cylinder.Length() > 0.0)) return;
  const Eigen::Vector3d axis = cylinder.Axis();
  const Eigen::Matrix<double, 3, 2> basis = PerpendicularBasis(axis);
  const double r0 = StartRadius(cylinder), r1 = EndRadius(cylinder);
  const auto first = static_cast<std::int32_t>(mesh->vertices.size());
  for (int i = 0; i < sides; ++i) {
    const double angle = 2.0 * M_PI * i / sides;
    const Eigen::Vector3d direction =
        std::cos(angle) * basis.col(0) + std::sin(angle) * basis.col(1);
    mesh->vertices.push_back(cylinder.start + r0 * direction);
    mesh->vertices.push_back(cylinder.end + r1 * direction);
  }
  if (caps) {
    mesh->vertices.push_back(cylinder.start);
    mesh->vertices.push_back(cylinder.end);
  }
  mesh->colors.resize(mesh->vertices.size(), color);
  const std::int32_t bottom = first + 2 * sides, top = bottom + 1;
  for (int i = 0; i < sides; ++i) {
    const std::int32_t a = first + 2 * i, b = first + 2 * ((i + 1) % sides);
    mesh->triangles.push_back({a, b, b + 1});
    mesh->triangles.push_back({a, b + 1, a + 1});
    if (!caps) continue;
    mesh->triangles.push_back({bottom, b, a});
    mesh->triangles.push_back({top, a + 1, b + 1});
  }
}

Mesh ModelMesh(const TreeModel& model, MeshColor scheme, int sides) {
  Mesh mesh;
  for (const MapCylinder& cylinder : model.cylinders) {
    AppendFrustum(cylinder, CylinderColor(cylinder, scheme), sides, &mesh);
  }
  return mesh;
}

Mesh TreeMesh(
    const TreeModel& model, int tree_id, MeshColor scheme, int sides, bool inner_caps) {
  Mesh mesh;
  std::set<int> ends;
  if (!inner_caps) {
    for (const MapBranch& branch : model.branches) {
      if (branch.tree_id != tree_id || branch.cylinder_ids.empty()) continue;
      ends.insert(branch.cylinder_ids.front());
      ends.insert(branch.cylinder_ids.back());
    }
  }
  for (const MapCylinder& cylinder : model.cylinders) {
    if (cylinder.tree_id != tree_id) continue;
    const bool caps = inner_caps || ends.count(cylinder.id) > 0;
    AppendFrustum(cylinder, CylinderColor(cylinder, scheme), sides, &mesh, caps);
  }
  return mesh;
}

std::string MeshToPly(const Mesh& mesh) {
  std::string out = fmt::format(
      "ply\nformat binary_little_endian 1.0\n"
      "element vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
      "property uchar red\nproperty uchar green\nproperty uchar blue\n"
      "element face {}\nproperty list uchar int vertex_indices\nend_header\n",
      mesh.vertices.size(),
      mesh.triangles.size());
  out.reserve(out.size() + mesh.vertices.size() * 15 + mesh.triangles.size() * 13);
  for (std::size_t i = 0; i < mesh.vertices.size(); ++i) {
    for (int k = 0; k < 3; ++k) Append(&out, static_cast<float>(mesh.vertices[i][k]));
    for (const std::uint8_t channel : mesh.colors[i]) Append(&out, channel);
  }
  for (const auto& triangle : mesh.triangles) {
    Append(&out, std::uint8_t{3});
    for (const std::int32_t index : triangle) Append(&out, index);
  }
  return out;
}

}  // namespace dendro
