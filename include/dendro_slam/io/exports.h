#pragma once

#include <string>
#include <utility>
#include <vector>

#include "dendro_slam/io/map_directory.h"
#include "dendro_slam/mapping/tree_model.h"

/// A map in the formats of other people's tools. One file holds one tree, because their readers
/// need one connected structure; what is attached to no tree is left out and counted.
///
/// All expect a model of TreeTopology::Build.
namespace dendro {

/// One tree in the order that the other formats want: branch after branch, parents before children,
/// a branch's cylinders one after another from base to tip.
struct OrderedTree {
  struct Entry {
    const MapCylinder* cylinder = nullptr;
    int parent = -1;     ///< Index into `cylinders`; -1 for the root.
    int extension = -1;  ///< Index of the cylinder that continues the branch; -1 at its tip.
    int branch = 0;      ///< Index into `branches`.
  };
  const MapTree* tree = nullptr;
  std::vector<Entry> cylinders;
  std::vector<const MapBranch*> branches;  ///< 0 is the trunk.
  std::vector<int> branch_parent;          ///< Index into `branches`; -1 for the trunk.
};

/// @throws std::invalid_argument  If the model has no such tree.
OrderedTree OrderTree(const TreeModel& model, int tree_id);

/// Number of cylinders of the model that belong to no tree.
int CountUnattached(const TreeModel& model);

/// TreeQSM's result as a MATLAB 5 file (little-endian, not compressed): the struct `QSM` with the
/// members `cylinder`, `branch`, `treedata` (litres, metres, degrees; indices from 1, 0 for none),
/// as R packages (rTwig, ITSMe, aRchi) and MATLAB read it. Crown measures that need leaves are 0.
/// DBHcyl is the map's DBH at its own breast height, or 0 where it was not seen.
std::string TreeQsmMat(const TreeModel& model, int tree_id);

/// TreeQSM's `cylinder_<name>.txt`: tab separated, 17 columns under 13 header names.
std::string TreeQsmCylinderText(const TreeModel& model, int tree_id);

/// SimpleForest's table (metres; ids from 0, the root's parent is -1).
std::string SimpleForestCsv(const TreeModel& model, int tree_id);

/// RayCloudTools' tree file: all trees, one line each.
std::string RayCloudTreeFile(const TreeModel& model);

/// TreeLoc's files, as (name, content): `trajectory.txt` and one `TreeManagerState_<idx>.csv` per
/// pose, with the trees in that pose's frame.
/// @param every  Only every n-th pose is a key frame. >= 1.
std::vector<std::pair<std::string, std::string>> TreeLocFiles(const MapFiles& files, int every = 1);

}  // namespace dendro
