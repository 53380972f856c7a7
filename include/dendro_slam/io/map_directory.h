#pragma once

#include <cstdint>
#include <fstream>
#include <map>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include <Eigen/Geometry>

#include "dendro_slam/branch_separation/segment.h"
#include "dendro_slam/cylinder_fitting/fitted_cylinder.h"
#include "dendro_slam/io/stage_timer.h"
#include "dendro_slam/mapping/georeference.h"
#include "dendro_slam/mapping/ground_surface.h"
#include "dendro_slam/mapping/landmark.h"
#include "dendro_slam/mapping/mapper.h"
#include "dendro_slam/mapping/tree_model.h"
#include "dendro_slam/odometry/relative_motion.h"
#include "dendro_slam/range_image/range_image.h"
#include "dendro_slam/topology/map_cloud.h"
#include "dendro_slam/topology/tree_topology.h"

namespace dendro {

/// A map file or directory that cannot be written or read. what() is one line for the user.
class MapFileError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// Everything a map directory holds.
struct MapFiles {
  TreeModel model;
  std::vector<Landmark> landmarks;  ///< As people read them; candidates too.
  MapSnapshot snapshot;             ///< What Mapper::Load needs so that a loaded map goes on:
                                    ///< tree_map.json holds it complete (every LandmarkState).
  int next_landmark_id = 0;
  TopologyState topology;
  std::vector<GroundPatch> ground;      ///< Below the trees; without it breast height is not known again.
  std::vector<StampedPose> trajectory;  ///< Ascending stamps.
  std::vector<CloudPoint> points;       ///< Empty unless they were gathered (MapCloud).
  std::string frame = "map";
  std::optional<Georeference> georeference;  ///< Where the map lies on the earth, if there were fixes.
  std::map<std::string, std::string> config;  ///< "section/key" to value, as the run used it.
};

/// Writes `tree_map.json`, `cylinders.csv`, `branches.csv`, `trees.csv`, `trajectory.tum`,
/// `tree.ply`, with points `points.ply` and, with a timer, `timing.json` into `directory` (made if
/// missing).
///
/// Every file is first written completely under a temporary name in the same directory and synced
/// to disk; only when all are there are they renamed, tree_map.json last. If anything fails (disk
/// full, no permission) the temporary files are removed and the map that was there stays whole.
/// Same input, same bytes: only timing.json differs between two runs.
/// @throws MapFileError  One line: file, and the reason the system gave.
void SaveMap(const std::string& directory,
             const MapFiles& files,
             const StageTimer* timer = nullptr);

/// Reads a map directory's `tree_map.json` (which alone holds the map), its trajectory and its points.
/// @throws MapFileError  One line: file, field and what is wrong (missing, wrong type, not finite,
///                       a newer format than this program knows).
MapFiles LoadMap(const std::string& directory);

/// The contents of the single files, for programs that want one of them.
std::string TreeMapJson(const MapFiles& files);
std::string CylindersCsv(const TreeModel& model);
std::string BranchesCsv(const TreeModel& model);
/// @param georeference  Adds columns with the latitude and longitude of every tree, and their sigma.
std::string TreesCsv(const TreeModel& model, const Georeference* georeference = nullptr);
std::string TrajectoryTum(const std::vector<StampedPose>& trajectory);
std::string TimingJson(const StageTimer& timer);

/// Writes one file completely or not at all: temporary name, sync, rename.
/// @throws MapFileError
void WriteFileAtomically(const std::string& path, const std::string& content);

/// Writes what single scans gave: `scan_cylinders.csv` (one row per segment), `scan_labels.bin` and
/// `scan_segments.bin`, streamed scan by scan.
///
/// scan_labels.bin: magic "DSLABEL1", then per scan int64 stamp_ns, uint32 count, count x uint8
/// Label in the order of the source cloud. scan_segments.bin: magic "DSSEGMT1", then per scan int64
/// stamp_ns, uint32 count, count x int32 segment id (-1 none), count x float32 range [m] (NaN where
/// the point could not be projected). All little-endian.
class ScanWriter {
 public:
  /// @throws MapFileError
  explicit ScanWriter(const std::string& directory);
  ScanWriter(const ScanWriter&) = delete;
  ScanWriter& operator=(const ScanWriter&) = delete;
  ~ScanWriter();

  /// @param segments   Stage 2's result for this scan.
  /// @param cylinders  Stage 3's result, any order, segment_id naming the segment.
  /// @throws MapFileError
  void Add(const LabelledScan& scan,
           const std::vector<Segment>& segments,
           const std::vector<FittedCylinder>& cylinders);

  /// Renames the files to their final names. Without it they are removed at destruction.
  /// @throws MapFileError
  void Finish();

 private:
  void Check(std::ofstream& stream, const std::string& name);

  std::string directory_;
  std::ofstream cylinders_, labels_, segments_;
  bool finished_ = false;
};

}  // namespace dendro
