#pragma once

#include <optional>
#include <vector>

#include "dendro_slam/mapping/tree_model.h"

/// Measures of trees from their cylinders. The lists of a model are sorted by id, as TreeTopology
/// builds them.
namespace dendro {

/// Diameter of a stem at one height.
struct StemDiameter {
  double height_m = 0.0;  ///< Above the tree's base [m].
  double diameter_m = 0.0;
  double sigma_m = 0.0;                     ///< Standard deviation of the diameter [m].
  FitStatus status = FitStatus::kMeasured;  ///< kInferred where it lies in a bridged gap.
};

/// Diameter of a branch at one place.
struct BranchDiameter {
  double diameter_m = 0.0;
  double sigma_m = 0.0;                     ///< Standard deviation of the diameter [m].
  FitStatus status = FitStatus::kInferred;  ///< Of the cylinder that lies there.
};

/// What the cylinders of a branch tell beside MapBranch.
struct BranchMeasures {
  BranchDiameter base, middle, tip;
  double visible_arc_rad = 0.0;    ///< Least of the measured cylinders.
  int num_scans = 0;               ///< Most of the measured cylinders.
  double inferred_length_m = 0.0;  ///< Bridged, not seen.
};

/// @throws std::out_of_range  If the branch names a cylinder that the model does not hold.
BranchMeasures MeasureBranch(const TreeModel& model, const MapBranch& branch);

/// Wood volume with its uncertainty.
struct WoodVolume {
  double volume_m3 = 0.0;
  double sigma_m3 = 0.0;
};

/// Diameter of a tree's trunk at a height above its base: the straight line r(h) through the
/// trunk's measured cylinders within `window_m` above and below, weighted by their sigmas; where
/// there are none, interpolated between the nearest measured ones if they are at most `max_gap_m`
/// apart.
///
/// Errors of neighbouring cylinders are common (same scans, same side), so the sigma is the
/// weighted mean of theirs and does not shrink with their number.
///
/// @return Nothing where the trunk was not seen around that height.
std::optional<StemDiameter> DiameterAtHeight(const TreeModel& model,
                                             const MapTree& tree,
                                             double height_m,
                                             double window_m = 0.2,
                                             double max_gap_m = 1.0);

/// Taper curve of a tree's trunk: one entry per cylinder, base to tip.
std::vector<StemDiameter> StemTaper(const TreeModel& model, const MapTree& tree);

/// Volume of conical frusta, `pi L / 3 (r0^2 + r0 r1 + r1^2)`, of one branch order (or all for -1),
/// from cylinders of at least `min_radius_m`. Sigmas add linearly within a branch, where errors are
/// common, and in quadrature between branches.
WoodVolume Volume(const TreeModel& model, const MapTree& tree, int order, double min_radius_m);

/// Fills the measures of every tree of the model: DBH, volumes, height seen, lean, coverage.
/// Trees, branches and cylinders must be joined already; `base` of each tree set.
void MeasureTrees(double breast_height_m, double min_volume_radius_m, TreeModel* model);

}  // namespace dendro
