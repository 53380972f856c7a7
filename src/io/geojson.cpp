#include "dendro_slam/io/geojson.h"

#include <cmath>
#include <map>
#include <stdexcept>

#include <nlohmann/json.hpp>

#include "dendro_slam/topology/dendrometry.h"

namespace dendro {

namespace {

using Json = nlohmann::ordered_json;

constexpr double kDegree = M_PI / 180.0;
constexpr double kEquatorM = 6378137.0;                // WGS 84
constexpr double kEccentricity2 = 6.69437999014e-3;

double Rounded(double value, double scale) { return std::round(value * scale) / scale; }

Json Position(const MapPlacement& reference, const Eigen::Vector3d& p) {
  const PlacedPoint g = ToPlacedPoint(reference, p);
  // Nine decimals of a degree are a tenth of a millimetre.
  return {Rounded(g.longitude_deg, 1e9), Rounded(g.latitude_deg, 1e9), Rounded(g.altitude_m, 1e4)};
}

Json Figure(double value) { return Rounded(value, 1e6); }

}  // namespace

void MapPlacement::Validate() const {
  const auto require = [](bool good, const char* message) {
    if (!good) throw std::invalid_argument(message);
  };
  require(std::abs(latitude_deg) <= 89.0, "latitude_deg: must be from -89 to 89");
  require(std::abs(longitude_deg) <= 180.0, "longitude_deg: must be from -180 to 180");
  require(std::isfinite(altitude_m), "altitude_m: must be finite");
  require(std::isfinite(heading_deg), "heading_deg: must be finite");
  require(std::isfinite(position_sigma_m) && position_sigma_m >= 0.0,
          "position_sigma_m: must be 0 or positive");
  require(std::isfinite(heading_sigma_deg) && heading_sigma_deg >= 0.0,
          "heading_sigma_deg: must be 0 or positive");
}

PlacedPoint ToPlacedPoint(const MapPlacement& reference, const Eigen::Vector3d& p_map) {
  const double latitude = reference.latitude_deg * kDegree;
  const double w2 = 1.0 - kEccentricity2 * std::pow(std::sin(latitude), 2);
  const double normal_m = kEquatorM / std::sqrt(w2);
  const double meridian_m = normal_m * (1.0 - kEccentricity2) / w2;
  const double bearing = reference.heading_deg * kDegree;
  const double east = p_map.x() * std::sin(bearing) - p_map.y() * std::cos(bearing);
  const double north = p_map.x() * std::cos(bearing) + p_map.y() * std::sin(bearing);
  return {reference.longitude_deg + east / (normal_m * std::cos(latitude)) / kDegree,
          reference.latitude_deg + north / meridian_m / kDegree,
          reference.altitude_m + p_map.z()};
}

std::string ModelGeoJson(const TreeModel& model, const MapPlacement& reference) {
  reference.Validate();
  Json features = Json::array();
  for (const MapTree& t : model.trees) {
    const double swing = t.base.head<2>().norm() * reference.heading_sigma_deg * kDegree;
    Json p;
    p["kind"] = "tree";
    p["tree_id"] = t.id;
    p["dbh_m"] = t.dbh_m ? Figure(*t.dbh_m) : Json(nullptr);
    p["dbh_sigma_m"] = t.dbh_m ? Figure(t.dbh_sigma_m) : Json(nullptr);
    p["dbh_height_m"] = Figure(t.dbh_height_m);
    p["height_m"] = Figure(t.height_m);
    p["num_branches"] = t.branch_ids.empty() ? 0 : t.branch_ids.size() - 1;
    p["max_branch_order"] = t.max_branch_order;
    p["stem_volume_m3"] = Figure(t.stem_volume_m3);
    p["wood_volume_m3_above_min_radius"] = Figure(t.wood_volume_m3);
    p["min_radius_m"] = Figure(t.min_radius_m);
    p["volume_sigma_m3"] = Figure(t.volume_sigma_m3);
    p["lean_deg"] = Figure(t.lean_rad / kDegree);
    p["status"] = ToString(t.dbh_status);
    p["crown_volume_m3"] = t.crown ? Figure(t.crown->volume_m3) : Json(nullptr);
    p["crown_projected_area_m2"] = t.crown ? Figure(t.crown->projected_area_m2) : Json(nullptr);
    p["position_sigma_m"] = reference.position_sigma_m > 0.0 || swing > 0.0
                                ? Figure(std::hypot(reference.position_sigma_m, swing))
                                : Json(nullptr);
    features.push_back({{"type", "Feature"},
                        {"geometry", {{"type", "Point"}, {"coordinates", Position(reference, t.base)}}},
                        {"properties", std::move(p)}});
  }
  std::map<int, const MapCylinder*> cylinders;
  for (const MapCylinder& c : model.cylinders) cylinders[c.id] = &c;
  for (const MapBranch& b : model.branches) {
    Json line = Json::array();
    for (const int id : b.cylinder_ids) {
      const MapCylinder& c = *cylinders.at(id);
      if (line.empty()) line.push_back(Position(reference, c.start));
      line.push_back(Position(reference, c.end));
    }
    if (line.empty()) continue;
    Json p;
    p["kind"] = "branch";
    p["branch_id"] = b.id;
    p["tree_id"] = b.tree_id >= 0 ? Json(b.tree_id) : Json(nullptr);
    p["parent_branch_id"] = b.parent_id >= 0 ? Json(b.parent_id) : Json(nullptr);
    p["branch_order"] = b.order;
    p["base_diameter_m"] = Figure(2.0 * b.base_radius_m);
    p["base_diameter_sigma_m"] = Figure(2.0 * b.base_radius_sigma_m);
    p["length_m"] = Figure(b.length_m);
    features.push_back({{"type", "Feature"},
                        {"geometry", {{"type", "LineString"}, {"coordinates", std::move(line)}}},
                        {"properties", std::move(p)}});
  }
  Json document;
  document["type"] = "FeatureCollection";
  document["features"] = std::move(features);
  return document.dump(1) + "\n";
}

}  // namespace dendro
