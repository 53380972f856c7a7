#include "dendro_slam/ros/markers.h"

#include <boost/make_shared.hpp>
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <set>

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

visualization_msgs::MarkerArray MapMarkers(const dendro::TreeModel& model,
                                           const MapMarkerStyle& style,
                                           const std::string& frame_id) {
  constexpr float kAlpha = 0.9F;
  constexpr double kSkeletonWidthM = 0.02;
  constexpr double kLabelHeightM = 0.2;
  constexpr double kLabelGapM = 0.12;
  visualization_msgs::MarkerArray markers;
  markers.markers.push_back(DeleteAll(model.stamp_ns, frame_id));
  std::set<int> trees;
  for (const dendro::MapCylinder& cylinder : model.cylinders) trees.insert(cylinder.tree_id);
  for (const int tree : trees) {
    const dendro::Mesh mesh = dendro::TreeMesh(model, tree, style.color, kSides);
    // Ids of markers are not negative; -1 stands for what is attached to no tree.
    markers.markers.push_back(
        MeshMarker(mesh, kAlpha, model.stamp_ns, frame_id, "trees", tree + 1));
  }
  if (style.skeleton && !model.cylinders.empty()) {
    visualization_msgs::Marker skeleton = MakeMarker(
        model.stamp_ns, frame_id, "skeleton", 0, visualization_msgs::Marker::LINE_LIST);
    skeleton.scale.x = kSkeletonWidthM;
    for (const dendro::MapCylinder& cylinder : model.cylinders) {
      const auto color = ToColor(dendro::CylinderColor(cylinder, style.color), 1.0F);
      skeleton.points.push_back(ToPoint(cylinder.start));
      skeleton.points.push_back(ToPoint(cylinder.end));
      skeleton.colors.push_back(color);
      skeleton.colors.push_back(color);
    }
    markers.markers.push_back(skeleton);
  }
  if (style.labels) {
    for (const dendro::MapBranch& branch : model.branches) {
      visualization_msgs::Marker label = MakeMarker(model.stamp_ns,
                                                    frame_id,
                                                    "labels",
                                                    branch.id,
                                                    visualization_msgs::Marker::TEXT_VIEW_FACING);
      label.scale.z = kLabelHeightM;
      const Eigen::Vector3d at =
          (branch.parent_id < 0 ? 0.5 * (branch.base + branch.tip) : branch.tip) +
          Eigen::Vector3d::UnitZ() * (branch.middle_radius_m + kLabelGapM);
      label.pose.position = ToPoint(at);
      label.text = fmt::format("b{}  {:.1f} \u00b1 {:.1f} cm",
                               branch.id,
                               100.0 * branch.base_radius_m,
                               100.0 * branch.base_radius_sigma_m);
      markers.markers.push_back(label);
    }
  }
  return markers;
}

}  // namespace dendro_ros
