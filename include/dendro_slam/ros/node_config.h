#pragma once

#include <stdexcept>
#include <string>

#include "dendro_slam/mapping/pipeline.h"
#include "dendro_slam/ros/lidar_mount.h"
#include "dendro_slam/ros/params.h"
#include "dendro_slam/sensors/scan_assembler.h"
#include "dendro_slam/sensors/vlp16_clock.h"
#include "dendro_slam/sim/imu_simulator.h"
#include "dendro_slam/sim/lidar_simulator.h"
#include "dendro_slam/sim/motion.h"

/// Parameters of the nodelets: those of the stage, and what only a node needs. map_bag reads the same
/// files.
namespace dendro_ros {

/// Refuses a queue that holds nothing.
inline void CheckQueueSize(int queue_size) {
  if (queue_size < 1) throw std::invalid_argument("queue_size must be at least 1");
}

struct WoodSegmentationNodeConfig {
  int queue_size = 20;        ///< Scans waiting at most; older ones are dropped and counted. >= 1.
  bool use_odometry = true;   ///< False: the sweep's motion stays in the scans.
  LidarMountConfig lidar_mount;
  dendro::WoodSegmentationConfig stage;

  void Validate() const {
    CheckQueueSize(queue_size);
    stage.Validate();
  }
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("queue_size", queue_size);
    v("use_odometry", use_odometry);
    v("lidar_mount", lidar_mount);
    stage.Visit(v);
  }
};

struct BranchSeparationNodeConfig {
  int queue_size = 20;  ///< Scans waiting at most; older ones are dropped and counted. >= 1.
  dendro::BranchSeparatorConfig stage;

  void Validate() const {
    CheckQueueSize(queue_size);
    stage.Validate();
  }
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("queue_size", queue_size);
    stage.Visit(v);
  }
};

struct CylinderFittingNodeConfig {
  int queue_size = 20;  ///< Scans waiting at most; older ones are dropped and counted. >= 1.
  dendro::CylinderFitterConfig stage;

  void Validate() const {
    CheckQueueSize(queue_size);
    stage.Validate();
  }
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("queue_size", queue_size);
    stage.Visit(v);
  }
};

struct WoodIcpNodeConfig {
  int queue_size = 20;                     ///< Scans waiting at most. >= 1.
  std::string odom_frame = "icp_odom";     ///< Frame of the chained pose.
  dendro::WoodIcpConfig stage;

  void Validate() const {
    CheckQueueSize(queue_size);
    stage.Validate();
  }
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("queue_size", queue_size);
    v("odom_frame", odom_frame);
    stage.Visit(v);
  }
};

struct TreeMappingNodeConfig {
  int queue_size = 20;                ///< Scans waiting at most; older ones are dropped. >= 1.
  std::string map_frame = "map";      ///< Frame of the map.
  std::string output_directory = "";  ///< Where save_map writes when its request names no folder.
  std::string session_directory = "";  ///< Folder where the map is kept against crashes: what was
                                       ///< mapped is written there scan by scan, and read again when
                                       ///< the process is started again; empty: nowhere.
  std::string session_id = "";  ///< Of this run: a map of the same run is gone on with at the start.
  bool resume = false;          ///< Go on with the map of an earlier run in that folder too: it is
                                ///< loaded, and used once the place is recognised.
  double autosave_s = 60.0;     ///< The map directory in that folder is written this often [s]. > 0.
  int path_max_poses = 5000;          ///< In the topic `path`; of a longer one every second, fourth, ... pose is
                                      ///< shown. The saved trajectory has all. >= 3.
  bool publish_tf = true;             ///< Publish map -> odom (map -> lidar without odometry).
  bool publish_odometry_tf = false;   ///< Publish odom -> body too, where nobody else does.
  LidarMountConfig lidar_mount;
  dendro::TreeMappingConfig stage;

  void Validate() const {
    CheckQueueSize(queue_size);
    if (map_frame.empty()) throw std::invalid_argument("map_frame must not be empty");
    if (!(autosave_s > 0.0)) throw std::invalid_argument("autosave_s must be positive");
    if (path_max_poses < 3) throw std::invalid_argument("path_max_poses must be at least 3");
    stage.Validate();
  }
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("queue_size", queue_size);
    v("map_frame", map_frame);
    v("output_directory", output_directory);
    v("session_directory", session_directory);
    v("session_id", session_id);
    v("resume", resume);
    v("autosave_s", autosave_s);
    v("path_max_poses", path_max_poses);
    v("publish_tf", publish_tf);
    v("publish_odometry_tf", publish_odometry_tf);
    v("lidar_mount", lidar_mount);
    stage.Visit(v);
  }
};

struct MapVisualizationNodeConfig {
  // All but the last three may be changed while the node runs (rosparam set).
  std::string color = "branch";  ///< Colour of the cylinders: branch, order or sigma.
  bool labels = true;            ///< DBH of every tree, radius of its branches with sigma, in cm.
  bool skeleton = true;          ///< Centre lines.
  bool updates = true;           ///< Flash the cylinders that the last scan observed.
  double alpha = 0.9;            ///< Opacity of the cylinders; 0: not drawn. 0 to 1.
  double label_height_m = 0.15;  ///< Height of the letters [m]. > 0.
  double label_min_radius_m = 0.02;  ///< Branches thinner at their base go without a label [m]. >= 0.
  int max_triangles = 400000;    ///< Big maps get cylinders with fewer sides. >= 1000.
  std::string tree_frame = "tree";     ///< Frame in the middle of the first tree, for a view's camera.
  std::string icp_frame = "icp_odom";  ///< Frame of the ICP odometry, shown from where the map begins.

  void Validate() const {
    if (color != "branch" && color != "order" && color != "sigma") {
      throw std::invalid_argument("color must be branch, order or sigma, got '" + color + "'");
    }
    if (!(alpha >= 0.0 && alpha <= 1.0)) throw std::invalid_argument("alpha must be from 0 to 1");
    if (!(label_height_m > 0.0)) throw std::invalid_argument("label_height_m must be positive");
    if (!(label_min_radius_m >= 0.0)) throw std::invalid_argument("label_min_radius_m must be >= 0");
    if (max_triangles < 1000) throw std::invalid_argument("max_triangles must be at least 1000");
  }
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("color", color);
    v("labels", labels);
    v("skeleton", skeleton);
    v("updates", updates);
    v("alpha", alpha);
    v("label_height_m", label_height_m);
    v("label_min_radius_m", label_min_radius_m);
    v("max_triangles", max_triangles);
    v("tree_frame", tree_frame);
    v("icp_frame", icp_frame);
  }
  bool operator==(const MapVisualizationNodeConfig& o) const {
    return color == o.color && labels == o.labels && skeleton == o.skeleton &&
           updates == o.updates && alpha == o.alpha && label_height_m == o.label_height_m &&
           label_min_radius_m == o.label_min_radius_m &&
           max_triangles == o.max_triangles;
  }
};

struct Vlp16DecoderNodeConfig {
  int queue_size = 50;             ///< Packet messages waiting at most. >= 1.
  std::string frame = "velodyne";  ///< Frame of the clouds where the packets name none.
  dendro::Vlp16ClockConfig clock;
  dendro::ScanAssemblerConfig assembler;

  void Validate() const {
    CheckQueueSize(queue_size);
    clock.Validate();
    assembler.Validate();
  }
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("queue_size", queue_size);
    v("frame", frame);
    v("clock", clock);
    v("assembler", assembler);
  }
};

struct LidarSimulatorNodeConfig {
  std::string scene = "";      ///< Scene file; empty: nothing is simulated.
  std::string path = "";       ///< Flight-path file.
  std::string pose_source = "path";  ///< path, or topic: fly to the poses (geometry_msgs/PoseStamped of
                                     ///< base_link in the map) that come on `pose`, from the path's start.
  std::string odometry = "";   ///< t265, mavros or none; empty: as the path says.
  int seed = 1;                ///< Of every random effect.
  double rate = 1.0;           ///< Speed; 1 is real time. > 0.
  bool publish_clock = false;  ///< Publish /clock with the simulated time.
  bool publish_imu = false;    ///< Publish imu/data_raw.
  dendro::FollowerConfig follower;
  dendro::ImuSimulatorConfig imu;
  dendro::LidarSimulatorConfig lidar;

  void Validate() const {
    if (!(rate > 0.0)) throw std::invalid_argument("rate must be positive");
    if (scene.empty() != path.empty()) {
      throw std::invalid_argument("scene and path must be given together");
    }
    if (pose_source != "path" && pose_source != "topic") {
      throw std::invalid_argument("pose_source must be path or topic, got '" + pose_source + "'");
    }
    follower.Validate();
    imu.Validate();
    lidar.Validate();
  }
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("scene", scene);
    v("path", path);
    v("pose_source", pose_source);
    v("odometry", odometry);
    v("seed", seed);
    v("rate", rate);
    v("publish_clock", publish_clock);
    v("publish_imu", publish_imu);
    v("follower", follower);
    v("imu", imu);
    v("lidar", lidar);
  }
};

/// All of them, a section per nodelet: what one configuration file may hold.
struct NodesConfig {
  WoodSegmentationNodeConfig wood_segmentation;
  BranchSeparationNodeConfig branch_separation;
  CylinderFittingNodeConfig cylinder_fitting;
  WoodIcpNodeConfig wood_icp;
  TreeMappingNodeConfig tree_mapping;
  MapVisualizationNodeConfig map_visualization;

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("wood_segmentation", wood_segmentation);
    v("branch_separation", branch_separation);
    v("cylinder_fitting", cylinder_fitting);
    v("wood_icp", wood_icp);
    v("tree_mapping", tree_mapping);
    v("map_visualization", map_visualization);
  }

  dendro::PipelineConfig Pipeline() const {
    return {wood_segmentation.stage,
            branch_separation.stage,
            cylinder_fitting.stage,
            wood_icp.stage,
            tree_mapping.stage};
  }
};

}  // namespace dendro_ros
