#include "dendro_slam/ros/markers.h"

#include <boost/make_shared.hpp>
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <iterator>
#include <set>
#include <utility>

#include "dendro_slam/ros/conversions.h"

namespace dendro_ros {
namespace {

constexpr int kSides = 20;

std_msgs::ColorRGBA ToColor(const dendro::Rgb& rgb, float alpha) {
  std_msgs::ColorRGBA color;
  color.r = static_cast<float>(rgb[0]) / 255.0F;
  color.g = static_cast<float>(rgb[1]) / 255.0F;
  color.b = static_cast<float>(rgb[2]) / 255.0F;
  color.a = alpha;
  return color;
}

geometry_msgs::Point ToPoint(const Eigen::Vector3d& p) {
  geometry_msgs::Point msg;
  msg.x = p.x();
  msg.y = p.y();
  msg.z = p.z();
  return msg;
}

visualization_msgs::Marker MakeMarker(std::int64_t stamp_ns,
                                      const std::string& frame_id,
                                      const char* ns,
                                      int id,
                                      std::int32_t type) {
  visualization_msgs::Marker marker;
  marker.header.stamp = ToRosTime(stamp_ns);
  marker.header.frame_id = frame_id;
  marker.ns = ns;
  marker.id = id;
  marker.type = type;
  marker.action = visualization_msgs::Marker::ADD;
  marker.pose.orientation.w = 1.0;
  marker.scale.x = marker.scale.y = marker.scale.z = 1.0;
  marker.color.r = marker.color.g = marker.color.b = marker.color.a = 1.0F;
  return marker;
}

visualization_msgs::Marker DeleteAll(std::int64_t stamp_ns, const std::string& frame_id) {
  visualization_msgs::Marker marker =
      MakeMarker(stamp_ns, frame_id, "", 0, visualization_msgs::Marker::CUBE);
  marker.action = visualization_msgs::Marker::DELETEALL;
  return marker;
}

visualization_msgs::Marker MeshMarker(const dendro::Mesh& mesh,
                                      float alpha,
                                      std::int64_t stamp_ns,
                                      const std::string& frame_id,
                                      const char* ns,
                                      int id) {
  visualization_msgs::Marker marker =
      MakeMarker(stamp_ns, frame_id, ns, id, visualization_msgs::Marker::TRIANGLE_LIST);
  marker.color.a = alpha;
  marker.points.reserve(3 * mesh.triangles.size());
  marker.colors.reserve(3 * mesh.triangles.size());
  for (const auto& triangle : mesh.triangles) {
    for (const std::int32_t vertex : triangle) {
      const auto v = static_cast<std::size_t>(vertex);
      marker.points.push_back(ToPoint(mesh.vertices[v]));
      marker.colors.push_back(ToColor(mesh.colors[v], alpha));
    }
  }
  return marker;
}

/// A cloud of x y z, packed rgb and one more int32.
class ColoredCloud {
 public:
  ColoredCloud(std::int64_t stamp_ns, const std::string& frame_id, const char* extra)
      : cloud_(boost::make_shared<sensor_msgs::PointCloud2>()) {
    cloud_->header.stamp = ToRosTime(stamp_ns);
    cloud_->header.frame_id = frame_id;
    std::uint32_t offset = 0;
    for (const char* name : {"x", "y", "z", "rgb", extra}) {
      sensor_msgs::PointField field;
      field.name = name;
      field.offset = offset;
      field.datatype =
          name == extra ? sensor_msgs::PointField::INT32 : sensor_msgs::PointField::FLOAT32;
      field.count = 1;
      cloud_->fields.push_back(field);
      offset += 4;
    }
    cloud_->point_step = offset;
    cloud_->height = 1;
    cloud_->is_dense = true;
    cloud_->is_bigendian = false;
  }

  void Add(const Eigen::Vector3f& p, const std::array<std::uint8_t, 3>& rgb, std::int32_t extra) {
    const std::uint32_t packed =
        (std::uint32_t{rgb[0]} << 16) | (std::uint32_t{rgb[1]} << 8) | std::uint32_t{rgb[2]};
    const std::size_t at = cloud_->data.size();
    cloud_->data.resize(at + cloud_->point_step);
    std::memcpy(&cloud_->data[at], p.data(), 12);
    std::memcpy(&cloud_->data[at + 12], &packed, 4);
    std::memcpy(&cloud_->data[at + 16], &extra, 4);
    ++cloud_->width;
  }

  sensor_msgs::PointCloud2Ptr Take() {
    cloud_->row_step = cloud_->width * cloud_->point_step;
    return cloud_;
  }

 private:
  sensor_msgs::PointCloud2Ptr cloud_;
};

}  // namespace

std::array<std::uint8_t, 3> LabelColor(dendro::Label label) {
  switch (label) {
    case dendro::Label::kGround:
      return {140, 125, 105};
    case dendro::Label::kWood:
      return {230, 159, 0};
    case dendro::Label::kLeaf:
      return {0, 158, 115};
    case dendro::Label::kOther:
      return {86, 180, 233};
    case dendro::Label::kNone:
      break;
  }
  return {30, 30, 30};
}

sensor_msgs::PointCloud2Ptr LabelCloud(const dendro::LabelledScan& scan,
                                       const std::string& frame_id) {
  ColoredCloud cloud(scan.image.stamp_ns, frame_id, "label");
  for (std::size_t i = 0; i < scan.image.size(); ++i) {
    if (!scan.image.HasReturn(i)) continue;
    cloud.Add(scan.image.point[i], LabelColor(scan.label[i]), static_cast<int>(scan.label[i]));
  }
  return cloud.Take();
}

sensor_msgs::PointCloud2Ptr SegmentCloud(const dendro::LabelledScan& scan,
                                         const std::vector<dendro::Segment>& segments,
                                         const std::string& frame_id) {
  ColoredCloud cloud(scan.image.stamp_ns, frame_id, "segment");
  for (const dendro::Segment& segment : segments) {
    const dendro::Rgb rgb = dendro::BranchColor(segment.id);
    for (const std::int32_t pixel : segment.pixels) {
      cloud.Add(scan.image.point[static_cast<std::size_t>(pixel)], rgb, segment.id);
    }
  }
  return cloud.Take();
}

visualization_msgs::MarkerArray ScanCylinderMarkers(
    const std::vector<dendro::FittedCylinder>& cylinders,
    std::int64_t stamp_ns,
    const std::string& frame_id) {
  constexpr float kAlpha = 0.55F;
  constexpr double kLineWidthM = 0.02;
  visualization_msgs::MarkerArray markers;
  markers.markers.push_back(DeleteAll(stamp_ns, frame_id));
  dendro::Mesh mesh;
  visualization_msgs::Marker axes =
      MakeMarker(stamp_ns, frame_id, "axes", 0, visualization_msgs::Marker::LINE_LIST);
  axes.scale.x = kLineWidthM;
  for (const dendro::FittedCylinder& fit : cylinders) {
    const Eigen::Vector3d start = fit.cylinder.point + fit.start_s_m * fit.cylinder.axis;
    const Eigen::Vector3d end = fit.cylinder.point + fit.end_s_m * fit.cylinder.axis;
    if (!start.allFinite() || !end.allFinite()) continue;
    const bool measured = fit.status == dendro::FitStatus::kMeasured;
    const dendro::Rgb rgb =
        measured ? dendro::BranchColor(fit.segment_id) : dendro::Rgb{128, 128, 128};
    axes.points.push_back(ToPoint(start));
    axes.points.push_back(ToPoint(end));
    axes.colors.push_back(ToColor(rgb, 1.0F));
    axes.colors.push_back(ToColor(rgb, 1.0F));
    if (!measured) continue;
    dendro::MapCylinder cylinder;
    cylinder.start = start;
    cylinder.end = end;
    cylinder.radius_m =
        fit.cylinder.radius() + fit.taper_m_per_m * 0.5 * (fit.start_s_m + fit.end_s_m);
    cylinder.taper_m_per_m = fit.taper_m_per_m;
    dendro::AppendFrustum(cylinder, rgb, kSides, &mesh);
  }
  if (!mesh.triangles.empty()) {
    markers.markers.push_back(MeshMarker(mesh, kAlpha, stamp_ns, frame_id, "cylinders", 0));
  }
  if (!axes.points.empty()) markers.markers.push_back(axes);
  return markers;
}

namespace {

/// Sides of a cylinder so that all of them stay below a number of triangles.
int SidesFor(std::size_t cylinders, int max_triangles) {
  constexpr int kMinSides = 6;
  const double each = 0.5 * max_triangles / static_cast<double>(std::max<std::size_t>(cylinders, 1));
  return std::clamp(static_cast<int>(each), kMinSides, kSides);
}

struct Label {
  std::string text;
  Eigen::Vector3d anchor = Eigen::Vector3d::Zero();   ///< What it names.
  Eigen::Vector2d outward = Eigen::Vector2d::Zero();  ///< Unit, away from the tree's axis.
  int id = 0;
};

/// The middle of the widest gap between the branches of a tree, seen from above: there a label of the
/// trunk stands in front of no other wood.
Eigen::Vector2d FreeDirection(const dendro::TreeModel& model, int tree_id, const Eigen::Vector2d& axis) {
  std::vector<double> angles;
  for (const dendro::MapBranch& branch : model.branches) {
    const Eigen::Vector2d run = branch.tip.head<2>() - axis;
    if (branch.tree_id != tree_id || branch.order != 1 || run.norm() < 0.1) continue;
    angles.push_back(std::atan2(run.y(), run.x()));
  }
  if (angles.empty()) return Eigen::Vector2d::UnitX();
  std::sort(angles.begin(), angles.end());
  double widest = 0.0, middle = 0.0;
  for (std::size_t i = 0; i < angles.size(); ++i) {
    const double next = i + 1 < angles.size() ? angles[i + 1] : angles.front() + 2.0 * M_PI;
    if (next - angles[i] <= widest) continue;
    widest = next - angles[i];
    middle = 0.5 * (angles[i] + next);
  }
  return {std::cos(middle), std::sin(middle)};
}

/// Heights in steps of a label's own, each given once.
class LabelHeights {
 public:
  explicit LabelHeights(double step_m) : step_m_(step_m) {}

  /// The free height nearest to the wanted one, if it is not too far off.
  std::optional<double> Take(double wanted_m) {
    constexpr int kFarthest = 6;
    const int middle = static_cast<int>(std::lround(wanted_m / step_m_));
    for (int off = 0; off <= kFarthest; ++off) {
      for (const int slot : {middle + off, middle - off}) {
        if (taken_.insert(slot).second) return slot * step_m_;
      }
    }
    return std::nullopt;
  }

 private:
  double step_m_;
  std::set<int> taken_;
};

/// The labels of a tree (-1: of what is attached to none), the most important first.
std::vector<Label> LabelsOf(const dendro::TreeModel& model, int tree_id, double min_radius_m) {
  Eigen::Vector2d axis = Eigen::Vector2d::Zero();
  for (const dendro::MapTree& tree : model.trees) {
    if (tree.id == tree_id) axis = tree.base.head<2>();
  }
  const Eigen::Vector2d free = FreeDirection(model, tree_id, axis);
  std::vector<const dendro::MapBranch*> branches;
  for (const dendro::MapBranch& branch : model.branches) {
    if (branch.tree_id == tree_id) branches.push_back(&branch);
  }
  std::stable_sort(branches.begin(), branches.end(), [](const auto* a, const auto* b) {
    return std::make_pair(a->order, -a->base_radius_m) < std::make_pair(b->order, -b->base_radius_m);
  });
  std::vector<Label> labels;
  for (const dendro::MapBranch* branch : branches) {
    Label label;
    label.id = branch->id;
    const auto tree = std::find_if(model.trees.begin(), model.trees.end(), [&](const auto& t) {
      return t.trunk_branch_id == branch->id;
    });
    if (tree != model.trees.end() && tree->dbh_m) {
      label.anchor = tree->base + Eigen::Vector3d::UnitZ() * tree->dbh_height_m;
      label.outward = free;
      label.text = fmt::format("tree {}: DBH {:.1f} \u00b1 {:.1f} cm",
                               tree->id,
                               100.0 * *tree->dbh_m,
                               100.0 * tree->dbh_sigma_m);
    } else {
      if (branch->order > 0 && branch->base_radius_m < min_radius_m) continue;
      // At its free end, where a line to the label crosses no other wood.
      label.anchor = branch->order == 0 ? 0.5 * (branch->base + branch->tip) : branch->tip;
      const Eigen::Vector2d run = label.anchor.head<2>() - axis;
      label.outward = branch->order == 0 || run.norm() < 0.1 ? free : Eigen::Vector2d(run.normalized());
      label.text = fmt::format("b{}: {:.1f} \u00b1 {:.1f} cm",
                               branch->id,
                               100.0 * branch->base_radius_m,
                               100.0 * branch->base_radius_sigma_m);
    }
    labels.push_back(std::move(label));
  }
  return labels;
}

void AppendLabels(const dendro::TreeModel& model,
                  int tree_id,
                  const MapMarkerStyle& style,
                  const std::string& frame_id,
                  visualization_msgs::MarkerArray* markers) {
  constexpr double kStep = 1.25;        // of a label's height
  constexpr double kOutward = 2.0;      // of a label's height
  constexpr double kHalfLetter = 0.28;  // half a letter's width, of its height
  constexpr double kLeaderWidthM = 0.006;
  const std_msgs::ColorRGBA soft = ToColor({200, 200, 200}, 0.8F);
  visualization_msgs::Marker leaders = MakeMarker(model.stamp_ns,
                                                  frame_id,
                                                  "label_lines",
                                                  tree_id + 1,
                                                  visualization_msgs::Marker::LINE_LIST);
  leaders.scale.x = kLeaderWidthM;
  leaders.color = soft;
  LabelHeights heights(kStep * style.label_height_m);
  for (const Label& label : LabelsOf(model, tree_id, style.label_min_radius_m)) {
    const std::optional<double> height = heights.Take(label.anchor.z() + style.label_height_m);
    if (!height) continue;
    // Beyond the wood by half its own width: its letters stand before the background, not on wood.
    const double half_width =
        kHalfLetter * static_cast<double>(label.text.size()) * style.label_height_m;
    Eigen::Vector3d at = label.anchor;
    at.head<2>() += (kOutward * style.label_height_m + half_width) * label.outward;
    at.z() = *height;
    visualization_msgs::Marker text = MakeMarker(model.stamp_ns,
                                                 frame_id,
                                                 "labels",
                                                 label.id,
                                                 visualization_msgs::Marker::TEXT_VIEW_FACING);
    text.scale.z = style.label_height_m;
    text.pose.position = ToPoint(at);
    text.text = label.text;
    markers->markers.push_back(text);
    leaders.points.push_back(ToPoint(label.anchor));
    // Up to the letters, not through them.
    at.head<2>() -= half_width * label.outward;
    leaders.points.push_back(ToPoint(at));
  }
  if (!leaders.points.empty()) markers->markers.push_back(std::move(leaders));
}

/// Centre lines of a tree, and from every branch's base to its parent's axis.
visualization_msgs::Marker Skeleton(const dendro::TreeModel& model,
                                    int tree_id,
                                    const MapMarkerStyle& style,
                                    const std::string& frame_id) {
  constexpr double kSkeletonWidthM = 0.02;
  visualization_msgs::Marker skeleton = MakeMarker(
      model.stamp_ns, frame_id, "skeleton", tree_id + 1, visualization_msgs::Marker::LINE_LIST);
  skeleton.scale.x = kSkeletonWidthM;
  const auto add = [&](const Eigen::Vector3d& a,
                       const Eigen::Vector3d& b,
                       const std_msgs::ColorRGBA& color) {
    skeleton.points.push_back(ToPoint(a));
    skeleton.points.push_back(ToPoint(b));
    skeleton.colors.push_back(color);
    skeleton.colors.push_back(color);
  };
  for (const dendro::MapCylinder& cylinder : model.cylinders) {
    if (cylinder.tree_id != tree_id) continue;
    const auto color = ToColor(dendro::CylinderColor(cylinder, style.color), 1.0F);
    add(cylinder.start, cylinder.end, color);
    if (cylinder.position_in_branch > 0 || cylinder.parent_id < 0) continue;
    const auto parent = std::lower_bound(
        model.cylinders.begin(),
        model.cylinders.end(),
        cylinder.parent_id,
        [](const dendro::MapCylinder& c, int id) { return c.id < id; });
    if (parent == model.cylinders.end() || parent->id != cylinder.parent_id) continue;
    const double along =
        std::clamp((cylinder.start - parent->start).dot(parent->Axis()), 0.0, parent->Length());
    add(parent->start + along * parent->Axis(), cylinder.start, color);
  }
  return skeleton;
}

/// 64-bit FNV-1a (Fowler, Noll, Vo), word by word.
class Fingerprint {
 public:
  template <class T>
  void Add(const T* data, std::size_t count) {
    const char* bytes = reinterpret_cast<const char*>(data);
    std::size_t left = count * sizeof(T);
    for (; left >= 8; left -= 8, bytes += 8) {
      std::uint64_t word;
      std::memcpy(&word, bytes, 8);
      Mix(word);
    }
    for (; left > 0; --left, ++bytes) Mix(static_cast<unsigned char>(*bytes));
  }
  std::uint64_t value() const { return hash_; }

 private:
  void Mix(std::uint64_t word) {
    hash_ = (hash_ ^ word) * 0x100000001b3ULL;
    hash_ ^= hash_ >> 29;
  }
  std::uint64_t hash_ = 0xcbf29ce484222325ULL;
};

/// What is seen of a marker, its stamp left out.
std::uint64_t FingerprintOf(const visualization_msgs::Marker& marker) {
  Fingerprint fingerprint;
  const double numbers[] = {static_cast<double>(marker.type),
                            marker.pose.position.x,
                            marker.pose.position.y,
                            marker.pose.position.z,
                            marker.scale.x,
                            marker.scale.z,
                            marker.color.a};
  fingerprint.Add(numbers, std::size(numbers));
  fingerprint.Add(marker.text.data(), marker.text.size());
  for (const geometry_msgs::Point& p : marker.points) {
    const double xyz[] = {p.x, p.y, p.z};
    fingerprint.Add(xyz, 3);
  }
  for (const std_msgs::ColorRGBA& c : marker.colors) {
    const float rgba[] = {c.r, c.g, c.b, c.a};
    fingerprint.Add(rgba, 4);
  }
  return fingerprint.value();
}

}  // namespace

visualization_msgs::MarkerArray MapMarkers(const dendro::TreeModel& model,
                                           const MapMarkerStyle& style,
                                           const std::string& frame_id) {
  visualization_msgs::MarkerArray markers;
  markers.markers.push_back(DeleteAll(model.stamp_ns, frame_id));
  std::set<int> trees;
  for (const dendro::MapCylinder& cylinder : model.cylinders) trees.insert(cylinder.tree_id);
  const int sides = SidesFor(model.cylinders.size(), style.max_triangles);
  for (const int tree : trees) {
    // Ids of markers are not negative; -1 stands for what is attached to no tree.
    if (style.alpha > 0.0) {
      const dendro::Mesh mesh = dendro::TreeMesh(model, tree, style.color, sides, false);
      markers.markers.push_back(MeshMarker(mesh,
                                           static_cast<float>(style.alpha),
                                           model.stamp_ns,
                                           frame_id,
                                           "trees",
                                           tree + 1));
    }
    if (style.skeleton) markers.markers.push_back(Skeleton(model, tree, style, frame_id));
    if (style.labels) AppendLabels(model, tree, style, frame_id, &markers);
  }
  return markers;
}

visualization_msgs::MarkerArray UpdateMarkers(const dendro::TreeModel& model,
                                              const std::vector<int>& landmark_ids,
                                              std::int64_t stamp_ns,
                                              const std::string& frame_id,
                                              double lifetime_s) {
  constexpr double kThickerM = 0.01;
  constexpr float kAlpha = 0.45F;
  constexpr dendro::Rgb kFlash = {255, 255, 255};
  visualization_msgs::MarkerArray markers;
  const std::set<int> observed(landmark_ids.begin(), landmark_ids.end());
  dendro::Mesh mesh;
  for (dendro::MapCylinder cylinder : model.cylinders) {
    if (cylinder.landmark_id < 0 || observed.count(cylinder.landmark_id) == 0) continue;
    cylinder.radius_m += kThickerM;
    dendro::AppendFrustum(cylinder, kFlash, kSides, &mesh, false);
  }
  if (mesh.triangles.empty()) return markers;
  markers.markers.push_back(MeshMarker(mesh, kAlpha, stamp_ns, frame_id, "updates", 0));
  markers.markers.back().lifetime = ros::Duration(lifetime_s);
  return markers;
}

visualization_msgs::MarkerArray MarkerChanges::Next(visualization_msgs::MarkerArray markers) {
  std::map<std::pair<std::string, int>, std::uint64_t> now;
  visualization_msgs::MarkerArray changed;
  for (visualization_msgs::Marker& marker : markers.markers) {
    if (marker.action != visualization_msgs::Marker::ADD) continue;
    const std::pair<std::string, int> name(marker.ns, marker.id);
    const std::uint64_t fingerprint = FingerprintOf(marker);
    now.emplace(name, fingerprint);
    if (!shown_) continue;
    const auto before = shown_->find(name);
    if (before == shown_->end() || before->second != fingerprint) {
      changed.markers.push_back(std::move(marker));
    }
  }
  if (!shown_) {
    shown_ = std::move(now);
    return markers;
  }
  for (const auto& [name, fingerprint] : *shown_) {
    if (now.count(name) > 0) continue;
    visualization_msgs::Marker gone;
    gone.ns = name.first;
    gone.id = name.second;
    gone.action = visualization_msgs::Marker::DELETE;
    if (!markers.markers.empty()) gone.header = markers.markers.front().header;
    changed.markers.push_back(std::move(gone));
  }
  shown_ = std::move(now);
  return changed;
}

}  // namespace dendro_ros
