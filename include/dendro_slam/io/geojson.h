#pragma once

#include <string>

#include "dendro_slam/mapping/tree_model.h"

namespace dendro {

/// Where the map's frame lies on the earth (WGS 84).
struct MapPlacement {
  double latitude_deg = 0.0;   ///< Of the map's origin, north positive.
  double longitude_deg = 0.0;  ///< Of the map's origin, east positive.
  double altitude_m = 0.0;     ///< Of the map's origin above the ellipsoid.
  double heading_deg = 90.0;   ///< Bearing of the map's x axis, clockwise from true north.
  double position_sigma_m = 0.0;    ///< Of the origin, per horizontal axis; 0 unknown.
  double heading_sigma_deg = 0.0;   ///< 0 unknown.

  /// @throws std::invalid_argument naming the field: latitude beyond 89 degrees (where east and
  /// north lose their meaning), longitude beyond 180, anything that is not finite.
  void Validate() const;
};

/// A place of the map on the earth.
struct PlacedPoint {
  double longitude_deg, latitude_deg, altitude_m;
};

/// By the radii of curvature of the ellipsoid at the origin: to a millimetre within a kilometre of
/// it.
PlacedPoint ToPlacedPoint(const MapPlacement& reference, const Eigen::Vector3d& p_map);

/// GeoJSON (RFC 7946; longitude, latitude, altitude): a Point per tree with the figures of trees.csv,
/// and a LineString per branch with those of branches.csv, ids as in every other file. A tree's
/// `position_sigma_m` grows with its distance from the origin by the heading's.
std::string ModelGeoJson(const TreeModel& model, const MapPlacement& reference);

}  // namespace dendro
