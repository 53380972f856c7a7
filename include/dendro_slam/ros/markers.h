#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include <sensor_msgs/PointCloud2.h>
#include <visualization_msgs/MarkerArray.h>

#include "dendro_slam/branch_separation/segment.h"
#include "dendro_slam/cylinder_fitting/fitted_cylinder.h"
#include "dendro_slam/io/mesh.h"
#include "dendro_slam/mapping/tree_model.h"
#include "dendro_slam/range_image/range_image.h"

/// What rviz shows. Colours are safe for colour-blind readers (Okabe and Ito's palette).
namespace dendro_ros {

/// Colour of a class: ground grey-brown, wood orange, leaf green, other blue, none dark grey.
std::array<std::uint8_t, 3> LabelColor(dendro::Label label);

/// The returns of a scan coloured by label: fields x y z and packed rgb (rviz: RGB8).
sensor_msgs::PointCloud2Ptr LabelCloud(const dendro::LabelledScan& scan,
                                       const std::string& frame_id);

/// The returns of the segments, one colour per segment: fields x y z, rgb and segment (int32).
sensor_msgs::PointCloud2Ptr SegmentCloud(const dendro::LabelledScan& scan,
                                         const std::vector<dendro::Segment>& segments,
                                         const std::string& frame_id);

/// The measured cylinders of one scan as half-transparent frusta, coloured by segment, with their
/// axes; unresolved ones as thin grey axes only. Begins with a marker that deletes those of the last scan.
visualization_msgs::MarkerArray ScanCylinderMarkers(
    const std::vector<dendro::FittedCylinder>& cylinders,
    std::int64_t stamp_ns,
    const std::string& frame_id);

/// What the map's markers show.
struct MapMarkerStyle {
  dendro::MeshColor color = dendro::MeshColor::kByBranch;
  bool labels = true;    ///< "b3 8.1 +- 0.2 cm" at the middle of every branch.
  bool skeleton = true;  ///< Centre lines of the branches.
};

/// The map: one triangle mesh per tree (one for what is attached to none), the centre lines, and a
/// label per branch with its base radius +- sigma in cm. Begins with a marker that deletes the last
/// map's.
visualization_msgs::MarkerArray MapMarkers(const dendro::TreeModel& model,
                                           const MapMarkerStyle& style,
                                           const std::string& frame_id);

}  // namespace dendro_ros
