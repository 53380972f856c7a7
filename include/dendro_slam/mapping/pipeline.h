#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include <Eigen/Geometry>

#include "dendro_slam/branch_separation/branch_separator.h"
#include "dendro_slam/cylinder_fitting/cylinder_fitter.h"
#include "dendro_slam/io/map_directory.h"
#include "dendro_slam/io/stage_timer.h"
#include "dendro_slam/mapping/georeference.h"
#include "dendro_slam/mapping/ground_surface.h"
#include "dendro_slam/mapping/mapper.h"
#include "dendro_slam/odometry/wood_icp.h"
#include "dendro_slam/range_image/projector.h"
#include "dendro_slam/segmentation/ground_plane.h"
#include "dendro_slam/segmentation/wood_segmenter.h"
#include "dendro_slam/sensors/pose_buffer.h"
#include "dendro_slam/topology/map_cloud.h"
#include "dendro_slam/topology/tree_topology.h"

namespace dendro {

/// Settings of the stage from a raw scan to a labelled one.
struct WoodSegmentationConfig {
  double odometry_timeout_s = 0.5;  ///< Scans go on without odometry after this silence [s]. > 0.
  ProjectorConfig projector;
  WoodSegmenterConfig segmenter;
  PoseBufferConfig pose_buffer;

  void Validate() const;
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("odometry_timeout_s", odometry_timeout_s);
    v("projector", projector);
    v("segmenter", segmenter);
    v("pose_buffer", pose_buffer);
  }
};

/// Settings of the stage from cylinders to the map.
struct TreeMappingConfig {
  bool use_odometry = true;         ///< False: ICP alone.
  bool use_icp = true;              ///< False: odometry alone.
  double odometry_timeout_s = 0.5;  ///< Scans go on without odometry after this silence [s]. > 0.
  MapperConfig mapper;
  TopologyConfig topology;
  MapCloudConfig map_cloud;
  PoseBufferConfig pose_buffer;
  GeoreferencerConfig georeference;

  void Validate() const;
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("use_odometry", use_odometry);
    v("use_icp", use_icp);
    v("odometry_timeout_s", odometry_timeout_s);
    v("mapper", mapper);
    v("topology", topology);
    v("map_cloud", map_cloud);
    v("pose_buffer", pose_buffer);
    v("georeference", georeference);
  }
};

/// Settings of the whole pipeline, a section per stage (and per nodelet).
struct PipelineConfig {
  WoodSegmentationConfig wood_segmentation;
  BranchSeparatorConfig branch_separation;
  CylinderFitterConfig cylinder_fitting;
  WoodIcpConfig wood_icp;
  TreeMappingConfig tree_mapping;

  /// @throws std::invalid_argument naming the field.
  void Validate() const;
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("wood_segmentation", wood_segmentation);
    v("branch_separation", branch_separation);
    v("cylinder_fitting", cylinder_fitting);
    v("wood_icp", wood_icp);
    v("tree_mapping", tree_mapping);
  }
};

/// Every setting as text, "section/key" to value, as a map file keeps it.
std::map<std::string, std::string> DescribeConfig(const PipelineConfig& config);
std::map<std::string, std::string> DescribeConfig(const TreeMappingConfig& config);

/// Stage 1 with what comes before it: the sweep's motion, the range image, the labels.
class WoodSegmentationStage {
 public:
  /// @throws std::invalid_argument for a bad configuration; WeightsError for bad weights.
  explicit WoodSegmentationStage(const WoodSegmentationConfig& config);

  /// @param poses         Odometry, or null.
  /// @param T_base_lidar  Mounting of the lidar on the odometry's body; used with `poses` only.
  LabelledScan Process(const LidarScan& scan,
                       const PoseBuffer* poses,
                       const Eigen::Isometry3d& T_base_lidar);

  /// Stamp up to which odometry is needed to remove the motion of a scan [ns].
  std::int64_t SweepEnd(const LidarScan& scan) const;

  const ProjectionReport& report() const { return projector_.report(); }

 private:
  /// Firing times, relative to the stamp, of a scan that does not tell them [s].
  std::pair<double, double> UntimedSpan() const;

  Projector projector_;
  WoodSegmenter segmenter_;
};

/// Stage 4 with what follows it: the factor graph, the topology, the map's files.
class TreeMappingStage {
 public:
  /// @throws std::invalid_argument for a bad configuration.
  explicit TreeMappingStage(const TreeMappingConfig& config);

  /// Takes one scan; at key frames the model is built anew.
  /// @param ground  The ground in the lidar frame, where the scan shows it (FitGroundPlane). Every tree
  ///                then stands on what was seen around it (GroundSurface); without it, its base is
  ///                the lowest wood seen.
  MapperResult Process(const MapperInput& input, const std::optional<GroundPlane>& ground);

  /// Takes the returns of a scan that Process has taken, where `map_cloud` is enabled; does nothing
  /// otherwise, and while a loaded map is not found again.
  void AddPoints(const LabelledScan& scan, const Eigen::Isometry3d& T_map_lidar);

  /// The map at the last key frame. Landmarks between key frames change in their extents and radii
  /// only; Files() has them.
  const TreeModel& model() const { return model_; }
  const Mapper& mapper() const { return mapper_; }

  /// Everything a map directory holds, of this moment; with `map_cloud` also the points and the
  /// crowns that they show.
  /// @param config  The settings to keep with the map, see DescribeConfig.
  MapFiles Files(const std::map<std::string, std::string>& config);

  /// Adds a GNSS fix in the clock of the scans; the map is laid over its fixes when its files are
  /// asked for. A loaded map keeps its place until fixes of this walk tell it better.
  bool AddFix(const GeoFix& fix) { return georeferencer_.Add(fix); }

  /// Starts anew on a saved map.
  /// @throws std::invalid_argument for a map that is not consistent; then nothing has changed.
  void Load(const MapFiles& files);
  void Reset();

 private:
  TreeMappingConfig config_;
  TreeModel BuildModel(std::int64_t stamp_ns);

  Mapper mapper_;
  TreeTopology topology_;
  MapCloud cloud_;
  TreeModel model_;
  Georeferencer georeferencer_;
  std::optional<Georeference> loaded_georeference_;
  GroundSurface ground_;
};

/// Result of one scan through all stages.
struct PipelineResult {
  LabelledScan scan;
  std::vector<Segment> segments;
  std::vector<FittedCylinder> cylinders;
  std::optional<RelativeMotion> icp;
  MapperResult mapping;
  bool had_odometry = false;  ///< The odometry told the pose at the stamp, and it was used.
};

/// The whole pipeline for one scan after the other, in the order of the nodelets and with their
/// inputs, so that a replay without a master gives the same map:
///
///     scan -> Projector -> WoodSegmenter -> BranchSeparator -> CylinderFitter -> Mapper -> TreeTopology
///                                       \-> WoodIcp -------------------------/
///
/// One thread; deterministic.
class Pipeline {
 public:
  /// @throws std::invalid_argument for a bad configuration; WeightsError for bad weights.
  explicit Pipeline(const PipelineConfig& config);

  /// Mounting of the lidar on the body whose pose the odometry gives; identity before.
  void SetMount(const Eigen::Isometry3d& T_base_lidar) { T_base_lidar_ = T_base_lidar; }
  /// Adds a pose of the odometry. Stamps ascend; others are refused.
  PoseBuffer::AddStatus AddOdometry(std::int64_t stamp_ns, const Eigen::Isometry3d& T_odom_base);
  /// Adds a GNSS fix in the clock of the scans. Stamps ascend; others are refused.
  bool AddFix(const GeoFix& fix) { return mapping_.AddFix(fix); }
  /// Stamp up to which odometry should be there before Process is called [ns].
  std::int64_t SweepEnd(const LidarScan& scan) const { return segmentation_.SweepEnd(scan); }

  PipelineResult Process(const LidarScan& scan);

  const TreeModel& model() const { return mapping_.model(); }
  const Mapper& mapper() const { return mapping_.mapper(); }
  const ProjectionReport& projection_report() const { return segmentation_.report(); }
  MapFiles Files() { return mapping_.Files(DescribeConfig(config_)); }
  void Load(const MapFiles& files) { mapping_.Load(files); }
  /// Forgets the map, the odometry and the last scan.
  void Reset();

  /// Durations of the stages so far.
  StageTimer& timer() { return timer_; }
  const StageTimer& timer() const { return timer_; }

 private:
  PipelineConfig config_;
  WoodSegmentationStage segmentation_;
  BranchSeparator separator_;
  CylinderFitter fitter_;
  WoodIcp icp_;
  TreeMappingStage mapping_;
  PoseBuffer sweep_poses_;
  PoseBuffer mapping_poses_;
  Eigen::Isometry3d T_base_lidar_ = Eigen::Isometry3d::Identity();
  StageTimer timer_;
};

}  // namespace dendro
