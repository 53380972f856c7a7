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

double Rounded(double value, double scale) { return std::round(value * scale) / scale; }

Json Position(const Georeference& georeference, const Eigen::Vector3d& p) {
  const GeoPosition g = georeference.Locate(p);
  // Nine decimals of a degree are a tenth of a millimetre.
  Json position = {Rounded(g.longitude_deg, 1e9), Rounded(g.latitude_deg, 1e9)};
  if (g.altitude_m) position.push_back(Rounded(*g.altitude_m, 1e4));
  return position;
}

Json Figure(double value) { return Rounded(value, 1e6); }

void Validate(const Georeference& g) {
  const auto require = [](bool good, const char* message) {
    if (!good) throw std::invalid_argument(message);
  };
  require(std::abs(g.origin.latitude_deg) <= 89.0, "latitude_deg: must be from -89 to 89");
  require(std::abs(g.origin.longitude_deg) <= 180.0, "longitude_deg: must be from -180 to 180");
  require(std::isfinite(g.origin.altitude_m.value_or(0.0)), "altitude_m: must be finite");
  require(std::isfinite(g.heading_deg.value_or(0.0)), "heading_deg: must be finite");
  require(std::isfinite(g.horizontal_sigma_m) && g.horizontal_sigma_m >= 0.0,
          "horizontal_sigma_m: must be 0 or positive");
  require(std::isfinite(g.heading_sigma_deg) && g.heading_sigma_deg >= 0.0,
          "heading_sigma_deg: must be 0 or positive");
}

}  // namespace

std::string ModelGeoJson(const TreeModel& model, const Georeference& georeference) {
  Validate(georeference);
  Json features = Json::array();
  for (const MapTree& t : model.trees) {
    const double sigma = georeference.HorizontalSigma(t.base);
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
    p["position_sigma_m"] = sigma > 0.0 ? Figure(sigma) : Json(nullptr);
    features.push_back({{"type", "Feature"},
                        {"geometry",
                         {{"type", "Point"}, {"coordinates", Position(georeference, t.base)}}},
                        {"properties", std::move(p)}});
  }
  std::map<int, const MapCylinder*> cylinders;
  for (const MapCylinder& c : model.cylinders) cylinders[c.id] = &c;
  for (const MapBranch& b : model.branches) {
    Json line = Json::array();
    for (const int id : b.cylinder_ids) {
      const MapCylinder& c = *cylinders.at(id);
      if (line.empty()) line.push_back(Position(georeference, c.start));
      line.push_back(Position(georeference, c.end));
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
    Json geometry = nullptr;
    if (georeference.heading_deg) {
      geometry = {{"type", "LineString"}, {"coordinates", std::move(line)}};
    }
    features.push_back(
        {{"type", "Feature"}, {"geometry", std::move(geometry)}, {"properties", std::move(p)}});
  }
  Json document;
  document["type"] = "FeatureCollection";
  document["features"] = std::move(features);
  return document.dump(1) + "\n";
}

}  // namespace dendro
