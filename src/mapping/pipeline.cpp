#include "dendro_slam/mapping/pipeline.h"

#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <stdexcept>
#include <type_traits>
#include <utility>

#include "dendro_slam/sensors/deskew.h"
#include "dendro_slam/topology/crown.h"

namespace dendro {
namespace {

void CheckTimeout(const char* section, double timeout_s) {
  if (!(timeout_s > 0.0)) {
    throw std::invalid_argument(
        fmt::format("{}: odometry_timeout_s must be positive, got {}", section, timeout_s));
  }
}

/// Collects a config struct as text; nested structs become part of the key.
struct ConfigDescriber {
  std::map<std::string, std::string>& out;
  std::string prefix;

  template <class T>
  void operator()(const char* key, T& value) {
    const std::string name = prefix + key;
    if constexpr (std::is_same_v<T, bool>) {
      out[name] = value ? "true" : "false";
    } else if constexpr (std::is_arithmetic_v<T> || std::is_same_v<T, std::string>) {
      out[name] = fmt::format("{}", value);
    } else {
      value.Visit(ConfigDescriber{out, name + "/"});
    }
  }
};

class Stopwatch {
 public:
  /// Milliseconds since the last call (or construction).
  double Lap() {
    const auto now = std::chrono::steady_clock::now();
    const double ms = std::chrono::duration<double, std::milli>(now - last_).count();
    last_ = now;
    return ms;
  }

 private:
  std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

}  // namespace

void WoodSegmentationConfig::Validate() const {
  CheckTimeout("wood_segmentation", odometry_timeout_s);
  projector.Validate();
  segmenter.Validate();
  pose_buffer.Validate();
}

void TreeMappingConfig::Validate() const {
  CheckTimeout("tree_mapping", odometry_timeout_s);
  mapper.Validate();
  topology.Validate();
  map_cloud.Validate();
  pose_buffer.Validate();
  georeference.Validate();
}

void PipelineConfig::Validate() const {
  wood_segmentation.Validate();
  branch_separation.Validate();
  cylinder_fitting.Validate();
  wood_icp.Validate();
  tree_mapping.Validate();
}

std::map<std::string, std::string> DescribeConfig(const PipelineConfig& config) {
  std::map<std::string, std::string> text;
  PipelineConfig copy = config;
  copy.Visit(ConfigDescriber{text, ""});
  return text;
}

std::map<std::string, std::string> DescribeConfig(const TreeMappingConfig& config) {
  std::map<std::string, std::string> text;
  TreeMappingConfig copy = config;
  copy.Visit(ConfigDescriber{text, "tree_mapping/"});
  return text;
}

WoodSegmentationStage::WoodSegmentationStage(const WoodSegmentationConfig& config)
    : projector_(config.projector), segmenter_(config.segmenter) {
  config.Validate();
}

LabelledScan WoodSegmentationStage::Process(const LidarScan& scan,
                                            const PoseBuffer* poses,
                                            const Eigen::Isometry3d& T_base_lidar) {
  std::optional<SweepMotion> motion;
  if (poses != nullptr && !poses->empty()) {
    motion = MakeSweepMotion(*poses, T_base_lidar, scan, UntimedSpan());
  }
  return segmenter_.Segment(projector_.Project(scan, motion ? &*motion : nullptr));
}

std::int64_t WoodSegmentationStage::SweepEnd(const LidarScan& scan) const {
  const double end_s = scan.has_time ? ScanTimeSpan(scan).second : UntimedSpan().second;
  return scan.stamp_ns + static_cast<std::int64_t>(std::max(0.0, end_s) * 1e9);
}

std::pair<double, double> WoodSegmentationStage::UntimedSpan() const {
  const double turn_s = 60.0 / projector_.config().rpm;
  if (projector_.config().untimed_stamp_at_end) return {-turn_s, 0.0};
  return {0.0, turn_s};
}

TreeMappingStage::TreeMappingStage(const TreeMappingConfig& config)
    : config_((config.Validate(), config)),
      mapper_(config.mapper),
      topology_(config.topology),
      cloud_(config.map_cloud),
      georeferencer_(config.georeference) {}

MapperResult TreeMappingStage::Process(const MapperInput& input,
                                       const std::optional<GroundPlane>& ground) {
  MapperInput with_ground = input;
  with_ground.ground = ground;
  MapperResult result = mapper_.AddScan(with_ground);
  if (ground && !mapper_.relocalizing()) ground_.Add(*ground, result.T_map_lidar);
  if (result.is_key_frame) model_ = BuildModel(result.stamp_ns);
  return result;
}

void TreeMappingStage::AddPoints(const LabelledScan& scan, const Eigen::Isometry3d& T_map_lidar) {
  if (config_.map_cloud.enabled && !mapper_.relocalizing()) cloud_.Add(scan, T_map_lidar);
}

TreeModel TreeMappingStage::BuildModel(std::int64_t stamp_ns) {
  return topology_.Build(mapper_.Landmarks(), stamp_ns, [this](const Eigen::Vector2d& place) {
    return ground_.At(place);
  });
}

MapFiles TreeMappingStage::Files(const std::map<std::string, std::string>& config) {
  MapFiles files;
  files.trajectory = mapper_.Trajectory();
  const std::int64_t stamp_ns =
      files.trajectory.empty() ? model_.stamp_ns : files.trajectory.back().stamp_ns;
  model_ = BuildModel(stamp_ns);
  files.points = cloud_.Points(files.trajectory);
  AssignPoints(
      model_, config_.map_cloud.wood_reach_m, config_.map_cloud.leaf_reach_m, &files.points);
  MeasureCrowns(files.points, config_.map_cloud.crown_alpha_m, &model_);
  files.model = model_;
  files.landmarks = mapper_.AllLandmarks();
  files.snapshot = mapper_.Snapshot();
  files.next_landmark_id = files.snapshot.next_landmark_id;
  files.topology = topology_.state();
  files.ground = ground_.Patches();
  files.config = config;
  files.georeference = georeferencer_.Solve(files.trajectory);
  const bool loaded_is_better =
      loaded_georeference_ &&
      (!files.georeference ||
       loaded_georeference_->heading_sigma_deg < files.georeference->heading_sigma_deg);
  if (loaded_is_better) files.georeference = loaded_georeference_;
  return files;
}

void TreeMappingStage::Load(const MapFiles& files) {
  Mapper loaded(config_.mapper);
  loaded.Load(files.snapshot);
  mapper_ = std::move(loaded);
  topology_.Restore(files.topology);
  georeferencer_.Clear();
  loaded_georeference_ = files.georeference;
  cloud_.Restore(files.points);
  ground_.Restore(files.ground);
  model_ = BuildModel(files.model.stamp_ns);
}

void TreeMappingStage::Reset() {
  mapper_.Reset();
  topology_.Reset();
  georeferencer_.Clear();
  loaded_georeference_.reset();
  cloud_.Reset();
  model_ = TreeModel();
  ground_.Clear();
}

Pipeline::Pipeline(const PipelineConfig& config)
    : config_(config),
      segmentation_(config.wood_segmentation),
      separator_(config.branch_separation),
      fitter_(config.cylinder_fitting),
      icp_(config.wood_icp),
      mapping_(config.tree_mapping),
      sweep_poses_(config.wood_segmentation.pose_buffer),
      mapping_poses_(config.tree_mapping.pose_buffer) {}

PoseBuffer::AddStatus Pipeline::AddOdometry(std::int64_t stamp_ns,
                                            const Eigen::Isometry3d& T_odom_base) {
  mapping_poses_.Add(stamp_ns, T_odom_base);
  return sweep_poses_.Add(stamp_ns, T_odom_base);
}

PipelineResult Pipeline::Process(const LidarScan& scan) {
  PipelineResult result;
  Stopwatch total;
  Stopwatch stage;
  result.scan = segmentation_.Process(scan, &sweep_poses_, T_base_lidar_);
  timer_.Add("segmentation", stage.Lap());
  result.segments = separator_.Separate(result.scan);
  timer_.Add("branch_separation", stage.Lap());
  result.cylinders = fitter_.Fit(result.scan, result.segments);
  timer_.Add("cylinder_fitting", stage.Lap());
  const std::optional<GroundPlane> ground = FitGroundPlane(result.scan);
  timer_.Add("ground_plane", stage.Lap());
  if (config_.tree_mapping.use_icp) result.icp = icp_.AddScan(result.scan, std::nullopt);
  timer_.Add("icp", stage.Lap());

  MapperInput input;
  input.stamp_ns = scan.stamp_ns;
  input.cylinders = result.cylinders;
  input.icp = result.icp;
  const auto T_odom_base = mapping_poses_.Lookup(scan.stamp_ns);
  if (T_odom_base && config_.tree_mapping.use_odometry) {
    input.T_odom_lidar = *T_odom_base * T_base_lidar_;
    result.had_odometry = true;
  }
  stage.Lap();
  result.mapping = mapping_.Process(input, ground);
  mapping_.AddPoints(result.scan, result.mapping.T_map_lidar);
  timer_.Add("mapping", stage.Lap());
  timer_.Add("total", total.Lap());
  return result;
}

void Pipeline::Reset() {
  icp_.Reset();
  mapping_.Reset();
  sweep_poses_.Clear();
  mapping_poses_.Clear();
}

}  // namespace dendro
