#pragma once

#include <cstdint>
#include <fstream>
#include <string>
#include <vector>

#include "dendro_slam/sim/lidar_simulator.h"
#include "dendro_slam/sim/scene.h"

namespace dendro {

/// Writes the truth of a simulated flight into a folder:
///
/// - `scene.yaml`: the scene, as LoadScene reads it;
/// - `trajectory.tum`: `stamp x y z qx qy qz qw` of T_map_lidar at the stamp of every scan, the stamp
///   in seconds with nine decimals;
/// - `hits.csv`: `stamp,tree,branch,hits` — returns per scan, tree and branch (trunk included), the
///   stamp in seconds with nine decimals; only rows with hits;
/// - `labels.bin`: little-endian, the 8 bytes `DSTRUTH1`, then per scan `int64 stamp_ns,
///   uint32 count, count x uint8 label` (enum Label: 1 ground, 2 wood, 3 leaf, 4 other),
///   `count x int16 branch id, count x int16 tree id` (-1 where there is none), in the cloud's order.
///   Predicted labels have the same layout with the magic `DSLABEL1` and no ids.
class TruthWriter {
 public:
  /// Creates the folder if needed.
  /// @param with_labels  False for long flights: no labels.bin (0.5 GB per hour and 1000 returns).
  /// @throws SceneFileError  If a file cannot be written.
  TruthWriter(const std::string& folder, const Scene& scene, bool with_labels = true);
  ~TruthWriter();

  /// @param with_hits  False: no rows in hits.csv.
  void AddScan(const SimulatedScan& scan, bool with_hits = true);

  /// Closes the files. @throws SceneFileError  If something could not be written.
  void Finish();

 private:
  std::string folder_;
  bool with_labels_;
  std::ofstream trajectory_;
  std::ofstream hits_;
  std::ofstream labels_;
};

/// Returns that one scan has on one branch.
struct BranchHits {
  std::int16_t tree_id = -1;
  std::int16_t branch_id = -1;
  std::uint32_t hits = 0;
};

/// Returns per tree and branch (trunk included), ascending; only those with hits.
std::vector<BranchHits> CountBranchHits(const SimulatedScan& scan);

/// One scan of a `labels.bin` (or of predicted labels: the ids are empty then).
struct ScanLabels {
  std::int64_t stamp_ns = 0;
  std::vector<std::uint8_t> label;
  std::vector<std::int16_t> branch_id;
  std::vector<std::int16_t> tree_id;
};

/// Reads `labels.bin` or `scan_labels.bin`.
/// @throws SceneFileError  Wrong magic or a truncated file.
std::vector<ScanLabels> ReadScanLabels(const std::string& path);

}  // namespace dendro
