#pragma once

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "dendro_slam/mapping/data_association.h"
#include "dendro_slam/mapping/mapper_io.h"
#include "dendro_slam/mapping/tree_map.h"
#include "dendro_slam/odometry/relative_motion.h"

namespace dendro {

/// Settings of Mapper.
struct MapperConfig {
  // Key frames: a scan becomes one when any threshold is passed.
  double key_frame_distance_m = 0.4;    ///< Travelled since the last one [m]. > 0.
  double key_frame_angle_deg = 10.0;    ///< Turned since the last one [deg]. > 0.
  double key_frame_time_s = 10.0;       ///< Passed since the last one [s]. > 0.
  int first_key_frames = 10;            ///< The first scans are all key frames: the map hangs on the first
                                        ///< pose, and the error of one scan would turn all of it. >= 1.

  // An hour of walking the same rows must not make the graph grow: where many key frames stand already,
  // a later one is taken out again once it is old.
  double key_frame_reach_m = 1.0;       ///< Distance within which key frames are counted [m]. > 0.
  int key_frames_in_reach = 6;          ///< Old key frames kept so close to each other; 0: all of them. >= 0.
  int key_frame_window = 100;           ///< The newest ones are always kept. >= 1.

  // Odometry. The messages' own covariances do not tell the drift. What of it changes slowly is a
  // variable of the graph (odometry_drift.h), learnt where much is in view.
  double vio_scale_sigma = 0.01;          ///< Length measured / true - 1. >= 0.
  double vio_drift_m_per_m = 0.006;       ///< Slow drift along each axis of the odometry's frame per metre
                                          ///< travelled. >= 0.
  double vio_drift_length_m = 50.0;       ///< Way over which the slow drift forgets its direction [m]. > 0.
  double vio_walk_m_per_sqrt_m = 0.008;   ///< Random walk per axis per root metre travelled. >= 0.
  double vio_walk_rad_per_sqrt_m = 0.0026;  ///< Random walk of the heading per root metre [rad]. >= 0.
  double vio_tilt_walk_rad_per_sqrt_m = 0.001;  ///< Of roll and pitch: gravity is seen [rad]. >= 0.
  double vio_sigma_m_per_m = 0.002;     ///< Drift per metre travelled that is not learnt, of one step. >= 0.
  double vio_sigma_per_rad = 0.005;     ///< Rotation drift per radian turned. >= 0.
  double vio_sigma_floor_rad = 0.0006;  ///< Of one step, per axis [rad]. > 0.
  double vio_sigma_floor_m = 0.0015;    ///< Of one step, per axis [m]. > 0.
  double icp_scale = 1.5;               ///< ICP's sigmas are multiplied by this. > 0.
  double odometry_gate_sigma = 4.0;     ///< VIO and ICP that differ by more are not both believed. > 0.
  double max_speed_mps = 15.0;          ///< A faster step is a jump, whatever else agrees [m/s]. > 0.
  double max_turn_rad_per_s = 8.0;      ///< A faster turn is a jump [rad/s]. > 0.
  double max_acceleration_mps2 = 12.0;  ///< A VIO step that needs more is tested against the map and
                                        ///< ICP [m/s^2]. > 0.
  double blind_sigma_m_per_s = 0.5;     ///< Motion with no odometry at all: sigma per second [m/s]. > 0.
  double blind_sigma_rad_per_s = 0.5;   ///< The same for rotation [rad/s]. > 0.

  // What holds the map upright: errors of neighbouring key frames are alike, so these are several times
  // the error of one.
  double gravity_sigma_deg = 0.3;       ///< Tilt that VIO reports, at one key frame [deg]; 0: not used. >= 0.
  double ground_sigma_m = 0.05;         ///< Height above the ground, at one key frame [m]; 0: not used. >= 0.
  double ground_sigma_deg = 2.0;        ///< Tilt of the ground, at one key frame [deg]. > 0.

  // Observations.
  double observation_scale = 1.5;       ///< The fits' sigmas are multiplied by this. > 0.
  double observation_axis_floor_deg = 0.5;  ///< Added to the axis' sigma [deg]: branches bend. >= 0.
  double observation_offset_floor_m = 0.002;  ///< Added to the line's sigma [m]. >= 0.
  // What the scans of one landmark have in common (it bends, its bark is uneven, all see the same side) does
  // not average out: taken for independent, the axes of a trunk that leans by a few degrees are a compass
  // that turns the map. So a factor of the graph carries more than the error of one scan.
  double observation_axis_shared_deg = 1.0;    ///< Added to the axis' sigma in the graph [deg]. >= 0.
  double observation_offset_shared_m = 0.004;  ///< Added to the line's sigma in the graph [m]. >= 0.
  double robust_width = 1.5;            ///< Cylinder factors: residuals beyond this many sigmas lose
                                        ///< weight (Huber). > 0.
  double min_fill = 0.65;               ///< A fit is not mapped when fewer of the beams that should have met
                                        ///< the surface seen returned from it: several twigs, no branch. In [0, 1).
  double column_step_deg = 0.2;         ///< Of the lidar, for that: between two beams of one ring [deg]. > 0.
  double nearby_radius_m = 30.0;        ///< Landmarks farther away are not looked for [m]. > 0.
  int nearby_max = 400;                 ///< Nor more than so many of the nearest in the map, and so many of
                                        ///< the nearest candidates: a bound on the time of a scan. >= 1.
  int nearby_exact = 48;                ///< Covariances computed anew at a key frame; those of the others grow
                                        ///< by what is not known of the way between, and come next. >= 1.
  double min_radius_m = 0.003;          ///< Thinner fits are not mapped [m]. > 0.
  double max_radius_sigma_rel = 0.5;    ///< Fits that know their radius worse are not mapped. > 0.

  // Finding a loaded map again.
  double relocalize_axis_deg = 6.0;     ///< Tolerance on the axes [deg]. > 0.
  double relocalize_offset_m = 0.15;    ///< Tolerance on the lines [m]. > 0.
  double relocalize_radius_ratio = 1.35;  ///< Tolerance on the radii. > 1.
  int relocalize_min_matches = 3;       ///< Landmarks that must agree. >= 2.
  double relocalize_tilt_deg = 10.0;    ///< With odometry both maps are upright to within this [deg]. > 0.
  int relocalize_every_key_frames = 4;  ///< How often it is tried. >= 1.
  int relocalize_max_scans = 3000;      ///< Scans kept until it succeeds; older ones are dropped. >= 10.

  DataAssociationConfig association;
  TreeMapConfig tree_map;
  RadiusProfileConfig radius_profile;

  /// @throws std::invalid_argument naming the field.
  void Validate() const;

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("key_frame_distance_m", key_frame_distance_m);
    v("key_frame_angle_deg", key_frame_angle_deg);
    v("key_frame_time_s", key_frame_time_s);
    v("first_key_frames", first_key_frames);
    v("key_frame_reach_m", key_frame_reach_m);
    v("key_frames_in_reach", key_frames_in_reach);
    v("key_frame_window", key_frame_window);
    v("vio_scale_sigma", vio_scale_sigma);
    v("vio_drift_m_per_m", vio_drift_m_per_m);
    v("vio_drift_length_m", vio_drift_length_m);
    v("vio_walk_m_per_sqrt_m", vio_walk_m_per_sqrt_m);
    v("vio_walk_rad_per_sqrt_m", vio_walk_rad_per_sqrt_m);
    v("vio_tilt_walk_rad_per_sqrt_m", vio_tilt_walk_rad_per_sqrt_m);
    v("vio_sigma_m_per_m", vio_sigma_m_per_m);
    v("vio_sigma_per_rad", vio_sigma_per_rad);
    v("vio_sigma_floor_rad", vio_sigma_floor_rad);
    v("vio_sigma_floor_m", vio_sigma_floor_m);
    v("icp_scale", icp_scale);
    v("odometry_gate_sigma", odometry_gate_sigma);
    v("max_speed_mps", max_speed_mps);
    v("max_turn_rad_per_s", max_turn_rad_per_s);
    v("max_acceleration_mps2", max_acceleration_mps2);
    v("blind_sigma_m_per_s", blind_sigma_m_per_s);
    v("blind_sigma_rad_per_s", blind_sigma_rad_per_s);
    v("gravity_sigma_deg", gravity_sigma_deg);
    v("ground_sigma_m", ground_sigma_m);
    v("ground_sigma_deg", ground_sigma_deg);
    v("observation_scale", observation_scale);
    v("observation_axis_floor_deg", observation_axis_floor_deg);
    v("observation_offset_floor_m", observation_offset_floor_m);
    v("observation_axis_shared_deg", observation_axis_shared_deg);
    v("observation_offset_shared_m", observation_offset_shared_m);
    v("robust_width", robust_width);
    v("min_fill", min_fill);
    v("column_step_deg", column_step_deg);
    v("nearby_radius_m", nearby_radius_m);
    v("nearby_max", nearby_max);
    v("nearby_exact", nearby_exact);
    v("min_radius_m", min_radius_m);
    v("max_radius_sigma_rel", max_radius_sigma_rel);
    v("relocalize_axis_deg", relocalize_axis_deg);
    v("relocalize_offset_m", relocalize_offset_m);
    v("relocalize_radius_ratio", relocalize_radius_ratio);
    v("relocalize_min_matches", relocalize_min_matches);
    v("relocalize_tilt_deg", relocalize_tilt_deg);
    v("relocalize_every_key_frames", relocalize_every_key_frames);
    v("relocalize_max_scans", relocalize_max_scans);
    association.Visit(v);
    tree_map.Visit(v);
    radius_profile.Visit(v);
  }
};

/// Everything needed to go on with a map in a later session. Plain data, for files.
struct MapSnapshot {
  int next_landmark_id = 0;
  bool upright = false;                  ///< The map's z axis is up (odometry was there at the start).
  /// The ground as z over x and y (z, dz/dx, dz/dy); absent when no scan showed any.
  std::optional<Eigen::Vector3d> ground;
  std::vector<LandmarkState> landmarks;  ///< Ascending in id; candidates included.
};

/// Stage 4's facade: one synchronised scan in, one result out.
///
/// Owns the factor graph (key-frame poses and landmark lines), the landmarks and the trajectory.
/// Per scan: predict the pose from the covariance-weighted mean of VIO and ICP, associate the
/// cylinders, refine the pose on them, and at key frames add a pose node, its two between-factors
/// and one factor per cylinder, and update the incremental solver. Scans between key frames get
/// their pose the same way and still widen extents and radius profiles.
///
/// The map frame is the odometry frame at the first scan with odometry (so z is up if it is there),
/// or the first lidar pose without odometry. Deterministic; one thread; not thread-safe.
class Mapper {
 public:
  /// @throws std::invalid_argument for a bad configuration.
  explicit Mapper(MapperConfig config = {});
  ~Mapper();
  Mapper(Mapper&&) noexcept;
  Mapper& operator=(Mapper&&) noexcept;

  /// Takes one scan. Stamps must ascend; a scan that is not later than the one before is refused
  /// (MapperResult::warning says so) and changes nothing. Call Reset() when the data starts anew.
  MapperResult AddScan(const MapperInput& input);

  /// The confirmed landmarks, ascending in id, in the map frame. Pieces of one trunk or branch end
  /// where the next one begins.
  std::vector<Landmark> Landmarks() const;
  /// The same with the candidates.
  std::vector<Landmark> AllLandmarks() const;
  /// Poses of all scans with the graph's present estimate.
  std::vector<StampedPose> Trajectory() const;
  /// At most so many of them (3 where fewer are asked for): every one, or every second, fourth, ... from the first on, and the last.
  /// The same poses are in it until their number doubles.
  std::vector<StampedPose> ThinnedTrajectory(std::size_t most) const;
  /// Correction of the odometry at the last scan that had odometry; identity before.
  Eigen::Isometry3d T_map_odom() const;
  int num_key_frames() const;
  /// Of those, how many are still in the graph.
  int num_kept_key_frames() const;
  /// A loaded map has not been found again yet: results are in a frame of their own.
  bool relocalizing() const;

  /// State of the map, for saving.
  MapSnapshot Snapshot() const;
  /// Starts anew on a loaded map. The pose is unknown until the cylinders are recognised.
  /// @throws std::invalid_argument for a snapshot that is not finite or whose ids are not ascending.
  void Load(const MapSnapshot& snapshot);

  /// Forgets everything.
  void Reset();

  const MapperConfig& config() const;

 private:
  class Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace dendro
