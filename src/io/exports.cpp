#include "dendro_slam/io/exports.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <map>
#include <stdexcept>
#include <utility>

#include <fmt/format.h>

#include "dendro_slam/geometry/cylinder.h"
#include "dendro_slam/io/mesh.h"
#include "dendro_slam/topology/dendrometry.h"

namespace dendro {

namespace {

using Eigen::Vector3d;

constexpr double kDegPerRad = 180.0 / M_PI;
constexpr double kLitres = 1000.0;

double FrustumVolume(const MapCylinder& c) {
  const double r0 = StartRadius(c), r1 = EndRadius(c);
  return M_PI * c.Length() / 3.0 * (r0 * r0 + r0 * r1 + r1 * r1);
}

double LateralArea(const MapCylinder& c) { return 2.0 * M_PI * c.radius_m * c.Length(); }

double Coverage(const MapCylinder& c) {
  return std::clamp(c.visible_arc_rad / (2.0 * M_PI), 0.0, 1.0);
}

const MapTree& FindTree(const TreeModel& model, int tree_id) {
  for (const MapTree& tree : model.trees) {
    if (tree.id == tree_id) return tree;
  }
  throw std::invalid_argument(fmt::format("the map has no tree {}", tree_id));
}

// -------------------------------------------------------------------------------------------
// MATLAB 5 files (MathWorks, "MAT-File Format", level 5): elements of a tag (type, bytes) and data
// padded to 8 bytes; a struct is a matrix element that holds its members' matrices.
// -------------------------------------------------------------------------------------------

constexpr std::uint32_t kMiInt8 = 1, kMiInt32 = 5, kMiUint32 = 6, kMiDouble = 9, kMiMatrix = 14;
constexpr std::uint32_t kMxStruct = 2, kMxDouble = 6;

template <class T>
void Append(std::string* out, T value) {
  char bytes[sizeof(T)];
  std::memcpy(bytes, &value, sizeof(T));
  out->append(bytes, sizeof(T));
}

std::string Element(std::uint32_t type, const std::string& data) {
  std::string out;
  Append(&out, type);
  Append(&out, static_cast<std::uint32_t>(data.size()));
  out += data;
  out.resize((out.size() + 7) / 8 * 8, '\0');
  return out;
}

std::string MatrixHeader(std::uint32_t matrix_class,
                         std::size_t rows,
                         std::size_t cols,
                         const std::string& name) {
  std::string flags, size;
  Append(&flags, matrix_class);
  Append(&flags, std::uint32_t{0});
  Append(&size, static_cast<std::int32_t>(rows));
  Append(&size, static_cast<std::int32_t>(cols));
  return Element(kMiUint32, flags) + Element(kMiInt32, size) + Element(kMiInt8, name);
}

// A matrix of doubles, row by row.
struct MatDouble {
  std::size_t cols = 1;
  std::vector<double> values;
};

std::string DoubleMatrix(const MatDouble& matrix) {
  const std::size_t rows = matrix.cols == 0 ? 0 : matrix.values.size() / matrix.cols;
  std::string data;
  for (std::size_t c = 0; c < matrix.cols; ++c) {
    for (std::size_t r = 0; r < rows; ++r) Append(&data, matrix.values[r * matrix.cols + c]);
  }
  return Element(kMiMatrix,
                 MatrixHeader(kMxDouble, rows, matrix.cols, "") + Element(kMiDouble, data));
}

// Members in order: name, encoded matrix.
using MatMembers = std::vector<std::pair<std::string, std::string>>;

std::string StructMatrix(const std::string& name, const MatMembers& members) {
  constexpr std::size_t kNameLength = 32;
  std::string names, length;
  for (const auto& member : members) {
    std::string padded = member.first;
    padded.resize(kNameLength, '\0');
    names += padded;
  }
  // The length of the names is a small element: type and size share a word.
  Append(&length, static_cast<std::uint32_t>(4 << 16) | kMiInt32);
  Append(&length, static_cast<std::uint32_t>(kNameLength));
  std::string body = MatrixHeader(kMxStruct, 1, 1, name) + length + Element(kMiInt8, names);
  for (const auto& member : members) body += member.second;
  return Element(kMiMatrix, body);
}

std::string Column(std::vector<double> values) { return DoubleMatrix({1, std::move(values)}); }
std::string Scalar(double value) { return DoubleMatrix({1, {value}}); }

// -------------------------------------------------------------------------------------------
// Crown: the convex hull seen from above of what is not trunk
// -------------------------------------------------------------------------------------------

double Cross(const Eigen::Vector2d& o, const Eigen::Vector2d& a, const Eigen::Vector2d& b) {
  return (a.x() - o.x()) * (b.y() - o.y()) - (a.y() - o.y()) * (b.x() - o.x());
}

// Andrew's monotone chain.
std::vector<Eigen::Vector2d> ConvexHull(std::vector<Eigen::Vector2d> points) {
  std::sort(points.begin(), points.end(), [](const auto& a, const auto& b) {
    return std::make_pair(a.x(), a.y()) < std::make_pair(b.x(), b.y());
  });
  if (points.size() < 3) return points;
  std::vector<Eigen::Vector2d> hull;
  for (int pass = 0; pass < 2; ++pass) {
    const std::size_t start = hull.size();
    for (const Eigen::Vector2d& p : points) {
      while (hull.size() >= start + 2 && Cross(hull[hull.size() - 2], hull.back(), p) <= 0.0)
        hull.pop_back();
      hull.push_back(p);
    }
    hull.pop_back();
    std::reverse(points.begin(), points.end());
  }
  return hull;
}

struct Crown {
  double diameter_mean = 0.0, diameter_max = 0.0, area = 0.0, base_height = 0.0, length = 0.0,
         ratio = 0.0;
};

Crown MeasureCrown(const OrderedTree& ordered) {
  Crown crown;
  std::vector<Eigen::Vector2d> points;
  double low = 1e300, high = -1e300;
  for (const OrderedTree::Entry& entry : ordered.cylinders) {
    const MapCylinder& c = *entry.cylinder;
    if (c.branch_order == 0) continue;
    for (const Vector3d& p : {c.start, c.end}) {
      points.push_back(p.head<2>());
      low = std::min(low, p.z());
      high = std::max(high, p.z());
    }
  }
  const std::vector<Eigen::Vector2d> hull = ConvexHull(points);
  if (hull.size() < 3) return crown;
  for (std::size_t i = 0; i < hull.size(); ++i) {
    const Eigen::Vector2d &a = hull[i], &b = hull[(i + 1) % hull.size()];
    crown.area += 0.5 * (a.x() * b.y() - a.y() * b.x());
  }
  constexpr int kDirections = 36;
  for (int k = 0; k < kDirections; ++k) {
    const double angle = M_PI * k / kDirections;
    const Eigen::Vector2d direction(std::cos(angle), std::sin(angle));
    double from = 1e300, to = -1e300;
    for (const Eigen::Vector2d& p : hull) {
      from = std::min(from, p.dot(direction));
      to = std::max(to, p.dot(direction));
    }
    crown.diameter_mean += (to - from) / kDirections;
  }
  for (const Eigen::Vector2d& a : hull) {
    for (const Eigen::Vector2d& b : hull)
      crown.diameter_max = std::max(crown.diameter_max, (a - b).norm());
  }
  crown.base_height = low - ordered.tree->base.z();
  crown.length = high - low;
  crown.ratio = ordered.tree->height_m > 0.0 ? crown.length / ordered.tree->height_m : 0.0;
  return crown;
}

}  // namespace

OrderedTree OrderTree(const TreeModel& model, int tree_id) {
  OrderedTree ordered;
  ordered.tree = &FindTree(model, tree_id);
  std::map<int, const MapCylinder*> cylinders;
  for (const MapCylinder& c : model.cylinders) cylinders[c.id] = &c;
  std::multimap<int, const MapBranch*> children;
  const MapBranch* trunk = nullptr;
  for (const MapBranch& branch : model.branches) {
    if (branch.tree_id != tree_id) continue;
    if (branch.id == ordered.tree->trunk_branch_id) {
      trunk = &branch;
    } else {
      children.emplace(branch.parent_id, &branch);
    }
  }
  if (trunk == nullptr) return ordered;
  ordered.branches.push_back(trunk);
  ordered.branch_parent.push_back(-1);
  // Breadth first: trunk, first order, second order, as TreeQSM numbers them.
  for (std::size_t i = 0; i < ordered.branches.size(); ++i) {
    const auto range = children.equal_range(ordered.branches[i]->id);
    for (auto it = range.first; it != range.second; ++it) {
      ordered.branches.push_back(it->second);
      ordered.branch_parent.push_back(static_cast<int>(i));
    }
  }
  std::map<int, int> index_of;
  for (std::size_t b = 0; b < ordered.branches.size(); ++b) {
    const std::vector<int>& ids = ordered.branches[b]->cylinder_ids;
    for (std::size_t k = 0; k < ids.size(); ++k) {
      OrderedTree::Entry entry;
      entry.cylinder = cylinders.at(ids[k]);
      const auto parent = index_of.find(entry.cylinder->parent_id);
      entry.parent = parent == index_of.end() ? -1 : parent->second;
      entry.branch = static_cast<int>(b);
      const int index = static_cast<int>(ordered.cylinders.size());
      if (k > 0) ordered.cylinders.back().extension = index;
      index_of[ids[k]] = index;
      ordered.cylinders.push_back(entry);
    }
  }
  return ordered;
}

int CountUnattached(const TreeModel& model) {
  return static_cast<int>(std::count_if(model.cylinders.begin(),
                                        model.cylinders.end(),
                                        [](const MapCylinder& c) { return c.tree_id < 0; }));
}

// ---------------------------------------------------------------------------------------------
// TreeQSM
// ---------------------------------------------------------------------------------------------

std::string TreeQsmMat(const TreeModel& model, int tree_id) {
  const OrderedTree ordered = OrderTree(model, tree_id);
  const MapTree& tree = *ordered.tree;
  std::vector<double> radius, length, parent, extension, added, unmodified, branch, coverage, mad,
      order, position;
  MatDouble start{3, {}}, axis{3, {}}, taper{0, {}};
  double volume[2] = {0.0, 0.0}, area[2] = {0.0, 0.0},
         total_length[2] = {0.0, 0.0};  // trunk, branches
  std::vector<double> branch_volume(ordered.branches.size(), 0.0),
      branch_area(ordered.branches.size(), 0.0);
  std::vector<double> stem_distance, stem_diameter;
  double dbh_qsm = 0.0, walked = 0.0;
  for (const OrderedTree::Entry& entry : ordered.cylinders) {
    const MapCylinder& c = *entry.cylinder;
    radius.push_back(c.radius_m);
    length.push_back(c.Length());
    const Vector3d direction = c.Axis();
    for (int k = 0; k < 3; ++k) {
      start.values.push_back(c.start[k]);
      axis.values.push_back(direction[k]);
    }
    parent.push_back(entry.parent + 1);
    extension.push_back(entry.extension + 1);
    added.push_back(c.status == FitStatus::kMeasured ? 0.0 : 1.0);
    unmodified.push_back(c.radius_m);
    branch.push_back(entry.branch + 1);
    coverage.push_back(Coverage(c));
    mad.push_back(c.mean_abs_deviation_m);
    order.push_back(c.branch_order);
    position.push_back(c.position_in_branch + 1);
    const int kind = entry.branch == 0 ? 0 : 1;
    volume[kind] += kLitres * FrustumVolume(c);
    area[kind] += LateralArea(c);
    total_length[kind] += c.Length();
    branch_volume[static_cast<std::size_t>(entry.branch)] += kLitres * FrustumVolume(c);
    branch_area[static_cast<std::size_t>(entry.branch)] += LateralArea(c);
    if (entry.branch == 0) {
      stem_distance.push_back(walked);
      stem_diameter.push_back(2.0 * StartRadius(c));
      if (dbh_qsm == 0.0 && walked + c.Length() >= 1.3) dbh_qsm = 2.0 * c.radius_m;
      walked += c.Length();
      if (entry.extension < 0) {
        stem_distance.push_back(walked);
        stem_diameter.push_back(2.0 * EndRadius(c));
      }
    }
  }
  taper.cols = stem_distance.size();
  taper.values = stem_distance;
  taper.values.insert(taper.values.end(), stem_diameter.begin(), stem_diameter.end());

  std::vector<double> b_order, b_parent, b_diameter, b_length, b_angle, b_height, b_azimuth,
      b_zenith;
  for (std::size_t i = 0; i < ordered.branches.size(); ++i) {
    const MapBranch& b = *ordered.branches[i];
    b_order.push_back(b.order);
    b_parent.push_back(ordered.branch_parent[i] + 1);
    b_diameter.push_back(2.0 * b.base_radius_m);
    b_length.push_back(b.length_m);
    b_angle.push_back(b.angle_rad * kDegPerRad);
    b_height.push_back(b.height_m);
    b_azimuth.push_back(b.azimuth_rad * kDegPerRad);
    b_zenith.push_back(b.zenith_rad * kDegPerRad);
  }
  const Crown crown = MeasureCrown(ordered);

  const MatMembers cylinder = {{"radius", Column(radius)},
                               {"length", Column(length)},
                               {"start", DoubleMatrix(start)},
                               {"axis", DoubleMatrix(axis)},
                               {"parent", Column(parent)},
                               {"extension", Column(extension)},
                               {"added", Column(added)},
                               {"UnmodRadius", Column(unmodified)},
                               {"branch", Column(branch)},
                               {"SurfCov", Column(coverage)},
                               {"mad", Column(mad)},
                               {"BranchOrder", Column(order)},
                               {"PositionInBranch", Column(position)}};
  const MatMembers branches = {{"order", Column(b_order)},
                               {"parent", Column(b_parent)},
                               {"diameter", Column(b_diameter)},
                               {"volume", Column(branch_volume)},
                               {"area", Column(branch_area)},
                               {"length", Column(b_length)},
                               {"angle", Column(b_angle)},
                               {"height", Column(b_height)},
                               {"azimuth", Column(b_azimuth)},
                               {"zenith", Column(b_zenith)}};
  const MatMembers treedata = {
      {"TotalVolume", Scalar(volume[0] + volume[1])},
      {"TrunkVolume", Scalar(volume[0])},
      {"BranchVolume", Scalar(volume[1])},
      {"TreeHeight", Scalar(tree.height_m)},
      {"TrunkLength", Scalar(total_length[0])},
      {"BranchLength", Scalar(total_length[1])},
      {"TotalLength", Scalar(total_length[0] + total_length[1])},
      {"NumberBranches", Scalar(std::max(0.0, static_cast<double>(ordered.branches.size()) - 1.0))},
      {"MaxBranchOrder", Scalar(tree.max_branch_order)},
      {"TrunkArea", Scalar(area[0])},
      {"BranchArea", Scalar(area[1])},
      {"TotalArea", Scalar(area[0] + area[1])},
      {"DBHqsm", Scalar(dbh_qsm)},
      {"DBHcyl", Scalar(tree.dbh_m.value_or(0.0))},
      {"CrownDiamAve", Scalar(crown.diameter_mean)},
      {"CrownDiamMax", Scalar(crown.diameter_max)},
      {"CrownAreaConv", Scalar(crown.area)},
      {"CrownBaseHeight", Scalar(crown.base_height)},
      {"CrownLength", Scalar(crown.length)},
      {"CrownRatio", Scalar(crown.ratio)},
      {"CrownVolumeConv", Scalar(0.0)},
      {"location", DoubleMatrix({3, {tree.base.x(), tree.base.y(), tree.base.z()}})},
      {"StemTaper", DoubleMatrix(taper)}};

  std::string header = "MATLAB 5.0 MAT-file, written by dendro_slam";
  header.resize(116, ' ');
  header.resize(124, '\0');
  Append(&header, std::uint16_t{0x0100});
  header += "IM";
  return header + StructMatrix("QSM",
                               {{"cylinder", StructMatrix("", cylinder)},
                                {"branch", StructMatrix("", branches)},
                                {"treedata", StructMatrix("", treedata)}});
}

std::string TreeQsmCylinderText(const TreeModel& model, int tree_id) {
  std::string out =
      "radius (m)\tlength "
      "(m)\tstart_point\taxis_direction\tparent\textension\tbranch\tbranch_order\t"
      "position_in_branch\tmad\tSurfCov\tadded\tUnmodRadius (m)\n";
  for (const OrderedTree::Entry& entry : OrderTree(model, tree_id).cylinders) {
    const MapCylinder& c = *entry.cylinder;
    const Vector3d axis = c.Axis();
    out += fmt::format(
        "{:.4f}\t{:.4f}\t{:.4f}\t{:.4f}\t{:.4f}\t{:.4f}\t{:.4f}\t{:.4f}\t{}\t{}\t{}\t{}\t{}\t{:.4f}"
        "\t{:.4f}\t{}\t"
        "{:.4f}\n",
        c.radius_m,
        c.Length(),
        c.start.x(),
        c.start.y(),
        c.start.z(),
        axis.x(),
        axis.y(),
        axis.z(),
        entry.parent + 1,
        entry.extension + 1,
        entry.branch + 1,
        c.branch_order,
        c.position_in_branch + 1,
        c.mean_abs_deviation_m,
        Coverage(c),
        c.status == FitStatus::kMeasured ? 0 : 1,
        c.radius_m);
  }
  return out;
}

// ---------------------------------------------------------------------------------------------
// SimpleForest, RayCloudTools, TreeLoc
// ---------------------------------------------------------------------------------------------

std::string SimpleForestCsv(const TreeModel& model, int tree_id) {
  const OrderedTree ordered = OrderTree(model, tree_id);
  const std::size_t n = ordered.cylinders.size();
  // Growth length: all wood that a cylinder carries, itself included. Reverse order: steps of
  // branching up to the farthest tip, 1 at the tips. A segment is the stretch of a branch between
  // two junctions.
  std::vector<double> growth(n, 0.0);
  std::vector<int> reverse(n, 1), children(n, 0), segment(n, 0), segment_parent;
  for (std::size_t i = n; i-- > 0;) {
    const OrderedTree::Entry& entry = ordered.cylinders[i];
    growth[i] += entry.cylinder->Length();
    if (entry.parent < 0) continue;
    const auto p = static_cast<std::size_t>(entry.parent);
    growth[p] += growth[i];
    ++children[p];
    const bool continues = ordered.cylinders[p].extension == static_cast<int>(i);
    reverse[p] = std::max(reverse[p], reverse[i] + (continues ? 0 : 1));
  }
  for (std::size_t i = 0; i < n; ++i) {
    const int p = ordered.cylinders[i].parent;
    if (p >= 0 && children[static_cast<std::size_t>(p)] == 1) {
      segment[i] = segment[static_cast<std::size_t>(p)];
      continue;
    }
    segment[i] = static_cast<int>(segment_parent.size());
    segment_parent.push_back(p < 0 ? -1 : segment[static_cast<std::size_t>(p)]);
  }
  std::string out =
      "ID,parentID,startX,startY,startZ,endX,endY,endZ,radius,length,growthLength,"
      "averagePointDistance,"
      "segmentID,parentSegmentID,branchOrder,reverseBranchOrder,branchID\n";
  for (std::size_t i = 0; i < n; ++i) {
    const OrderedTree::Entry& entry = ordered.cylinders[i];
    const MapCylinder& c = *entry.cylinder;
    out += fmt::format(
        "{},{},{:.6f},{:.6f},{:.6f},{:.6f},{:.6f},{:.6f},{:.6f},{:.6f},{:.6f},{:.6f},{},{},{},{},{}"
        "\n",
        i,
        entry.parent,
        c.start.x(),
        c.start.y(),
        c.start.z(),
        c.end.x(),
        c.end.y(),
        c.end.z(),
        c.radius_m,
        c.Length(),
        growth[i],
        c.mean_abs_deviation_m,
        segment[i],
        segment_parent[static_cast<std::size_t>(segment[i])],
        c.branch_order,
        reverse[i],
        c.branch_id);
  }
  return out;
}

std::string RayCloudTreeFile(const TreeModel& model) {
  // A segment's cylinder runs from its parent's point to its own. Our branches start at the
  // parent's surface, so the run from the parent's axis to there is part of their first segment.
  std::string out =
      "# tree structure file, written by dendro_slam\nx,y,z,radius,parent_id,section_id\n";
  for (const MapTree& tree : model.trees) {
    const OrderedTree ordered = OrderTree(model, tree.id);
    if (ordered.cylinders.empty()) continue;
    const MapCylinder& root = *ordered.cylinders.front().cylinder;
    std::string line = fmt::format("{:.6f},{:.6f},{:.6f},{:.6f},-1,-1",
                                   root.start.x(),
                                   root.start.y(),
                                   root.start.z(),
                                   StartRadius(root));
    for (const OrderedTree::Entry& entry : ordered.cylinders) {
      const MapCylinder& c = *entry.cylinder;
      line += fmt::format(", {:.6f},{:.6f},{:.6f},{:.6f},{},{}",
                          c.end.x(),
                          c.end.y(),
                          c.end.z(),
                          c.radius_m,
                          entry.parent + 1,
                          entry.branch);
    }
    out += line + "\n";
  }
  return out;
}

std::vector<std::pair<std::string, std::string>> TreeLocFiles(const MapFiles& files, int every) {
  if (every < 1) throw std::invalid_argument("every: must be at least 1");
  std::vector<std::pair<std::string, std::string>> out;
  std::string trajectory;
  int index = 0;
  for (std::size_t i = 0; i < files.trajectory.size();
       i += static_cast<std::size_t>(every), ++index) {
    const StampedPose& pose = files.trajectory[i];
    trajectory += TrajectoryTum({pose});
    const Eigen::Isometry3d T_lidar_map = pose.T_map_lidar.inverse();
    std::string table =
        "axis_00,axis_01,axis_02,axis_10,axis_11,axis_12,axis_20,axis_21,axis_22,location_x,"
        "location_y,"
        "location_z,dbh,dbh_approximation,score,reconstructed,number_clusters\n";
    for (const MapTree& tree : files.model.trees) {
      const OrderedTree ordered = OrderTree(files.model, tree.id);
      if (ordered.cylinders.empty()) continue;
      const MapCylinder* stem = nullptr;  // the stem at breast height, or its first measured part
      for (const OrderedTree::Entry& entry : ordered.cylinders) {
        const MapCylinder& c = *entry.cylinder;
        if (entry.branch != 0 || c.status != FitStatus::kMeasured) continue;
        if (stem == nullptr) stem = &c;
        if (c.start.z() - tree.base.z() <= tree.dbh_height_m) stem = &c;
      }
      if (stem == nullptr) stem = ordered.cylinders.front().cylinder;
      const Vector3d axis = T_lidar_map.linear() * stem->Axis();
      Eigen::Matrix3d rotation;
      rotation.leftCols<2>() = PerpendicularBasis(axis);
      rotation.col(2) = axis;
      const Vector3d location = T_lidar_map * tree.base;
      for (int r = 0; r < 3; ++r) {
        for (int c = 0; c < 3; ++c) table += fmt::format("{:.6f},", rotation(r, c));
      }
      table += fmt::format("{:.6f},{:.6f},{:.6f},{:.6f},{:.6f},{:.6f},{},{}\n",
                           location.x(),
                           location.y(),
                           location.z(),
                           tree.dbh_m.value_or(0.0),
                           2.0 * stem->radius_m,
                           std::clamp(tree.arc_coverage_rad / (2.0 * M_PI), 0.0, 1.0),
                           tree.dbh_m ? 1 : 0,
                           tree.branch_ids.size());
    }
    out.emplace_back(fmt::format("TreeManagerState_{}.csv", index), std::move(table));
  }
  out.emplace_back("trajectory.txt", std::move(trajectory));
  return out;
}

}  // namespace dendro
