#pragma once

#include <string>

#include "dendro_slam/mapping/georeference.h"
#include "dendro_slam/mapping/tree_model.h"

namespace dendro {

/// GeoJSON (RFC 7946; longitude, latitude and, where known, altitude): a Point per tree with the figures
/// of trees.csv, and a LineString per branch with those of branches.csv, ids as in every other file.
///
/// `position_sigma_m` of a tree is the georeference's there (Georeference::HorizontalSigma), null when
/// that is 0, unknown. Without a heading every tree lies at the pivot, with a sigma of its distance from
/// it, and branches have no geometry (null).
/// @throws std::invalid_argument naming the field: latitude beyond 89 degrees (where east and north lose
///   their meaning), longitude beyond 180, a heading or a sigma that is not finite.
std::string ModelGeoJson(const TreeModel& model, const Georeference& georeference);

}  // namespace dendro
