#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <utility>
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
  bool labels = true;            ///< DBH of every tree, base radius of its branches, in cm.
  bool skeleton = true;          ///< Centre lines of the branches and where they leave their parents.
  double alpha = 0.9;            ///< Opacity of the cylinders, 0 (not drawn) to 1.
  double label_height_m = 0.15;  ///< Height of the letters [m]. > 0.
  double label_min_radius_m = 0.02;  ///< Thinner branches go without a label: a crown of twigs would be
                                     ///< covered by them [m]. >= 0.
  int max_triangles = 400000;    ///< Big maps get fewer sides per cylinder to stay below this.
};

/// The map: one triangle mesh and one set of centre lines per tree (and for what is attached to
/// none), and labels: "tree 0: DBH 52.5 +- 0.3 cm", "b3: 8.1 +- 0.2 cm" (base radius).
///
/// Labels of one tree stand at different heights, at least one and a quarter of their own height
/// apart, so that none covers another from wherever one looks at the tree from the side; a thin line
/// leads to the place that is meant. Thick and low-order branches come first; a branch that finds no
/// free height near it has no label. Begins with a marker that deletes the last map's.
visualization_msgs::MarkerArray MapMarkers(const dendro::TreeModel& model,
                                           const MapMarkerStyle& style,
                                           const std::string& frame_id);

/// The cylinders of the landmarks that a scan has just observed, a little thicker than they are;
/// they go out after `lifetime_s`.
visualization_msgs::MarkerArray UpdateMarkers(const dendro::TreeModel& model,
                                              const std::vector<int>& landmark_ids,
                                              std::int64_t stamp_ns,
                                              const std::string& frame_id,
                                              double lifetime_s = 0.4);

/// What a viewer must be sent to go from one set of markers to the next: only those that changed,
/// and deletions of those that are gone. A big map then costs what has changed of it.
class MarkerChanges {
 public:
  /// @param markers  All that is to be seen now; an initial DELETEALL is allowed.
  /// @return `markers` as they are the first time (and after Forget), the difference later.
  visualization_msgs::MarkerArray Next(visualization_msgs::MarkerArray markers);
  /// The next set is given whole: a viewer that knows nothing has come.
  void Forget() { shown_.reset(); }

 private:
  /// Fingerprints of what is shown, by name space and id.
  std::optional<std::map<std::pair<std::string, int>, std::uint64_t>> shown_;
};

}  // namespace dendro_ros
