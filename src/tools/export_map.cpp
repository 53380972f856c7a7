// A map directory in the formats of other people's tools.

#include <cstdio>
#include <exception>
#include <filesystem>
#include <string>
#include <utility>
#include <vector>

#include <fmt/format.h>
#include <CLI/CLI.hpp>

#include "dendro_slam/io/exports.h"
#include "dendro_slam/io/geojson.h"
#include "dendro_slam/io/map_directory.h"
#include "dendro_slam/io/mesh.h"
#include "dendro_slam/io/point_files.h"

namespace {

namespace fs = std::filesystem;
using namespace dendro;

// "out.csv" for one tree, "out_3.csv" for the third of several.
std::string NameOfTree(const std::string& output, int tree_id, bool several) {
  if (!several) return output;
  const fs::path path(output);
  return (path.parent_path() /
          fmt::format("{}_{}{}", path.stem().string(), tree_id, path.extension().string()))
      .string();
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app(
      "Writes a map directory in the formats of other tools. Formats with one tree per file add "
      "the "
      "tree's id to the name where the map holds several.");
  std::string map_dir, format, output;
  int tree = -1, every = 10;
  app.add_option("MAP_DIR", map_dir, "Map directory of map_bag or of the save service")->required();
  app.add_option(
         "-f,--format",
         format,
         "treeqsm-mat, treeqsm-txt, simpleforest, raycloudtools, treeloc (a folder), ply-branch, "
         "ply-order, ply-sigma, las or ply-points (wood and leaf points, where the map was made with "
         "map_cloud/enabled), geojson (of a map with GNSS fixes, or with --georeference), json, csv (a folder with our own tables)")
      ->required()
      ->check(CLI::IsMember({"treeqsm-mat",
                             "treeqsm-txt",
                             "simpleforest",
                             "raycloudtools",
                             "treeloc",
                             "ply-branch",
                             "ply-order",
                             "ply-sigma",
                             "las",
                             "geojson",
                             "ply-points",
                             "json",
                             "csv"}));
  app.add_option("-o,--output", output, "File (or folder) to write")->required();
  app.add_option("--tree", tree, "Only this tree (formats with one tree per file)");
  app.add_option("--every", every, "treeloc: every n-th pose is a key frame")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  std::vector<double> georeference;
  app.add_option("--georeference",
                 georeference,
                 "geojson: latitude and longitude of the map's origin [deg], bearing of its x axis "
                 "clockwise from north [deg], and its altitude [m] (0); without it the map's own, from "
                 "its fixes")
      ->expected(3, 4)
      ->delimiter(',');
  CLI11_PARSE(app, argc, argv);

  try {
    const MapFiles files = LoadMap(map_dir);
    const TreeModel& model = files.model;
    std::vector<std::pair<std::string, std::string>> outputs;
    bool leaves_out = false;
    const auto one_per_tree = [&](auto make) {
      leaves_out = true;
      std::vector<int> ids;
      for (const MapTree& t : model.trees) {
        if (tree < 0 || t.id == tree) ids.push_back(t.id);
      }
      if (ids.empty()) {
        throw MapFileError(tree < 0 ? fmt::format("{} holds no tree", map_dir)
                                    : fmt::format("{} holds no tree {}", map_dir, tree));
      }
      for (const int id : ids)
        outputs.emplace_back(NameOfTree(output, id, ids.size() > 1), make(model, id));
    };
    const auto into_folder = [&](const std::vector<std::pair<std::string, std::string>>& contents) {
      fs::create_directories(output);
      for (const auto& [name, content] : contents)
        outputs.emplace_back((fs::path(output) / name).string(), content);
    };
    if (format == "treeqsm-mat") one_per_tree(TreeQsmMat);
    if (format == "treeqsm-txt") one_per_tree(TreeQsmCylinderText);
    if (format == "simpleforest") one_per_tree(SimpleForestCsv);
    if (format == "raycloudtools") {
      leaves_out = true;
      outputs.emplace_back(output, RayCloudTreeFile(model));
    }
    if (format == "treeloc") into_folder(TreeLocFiles(files, every));
    if (format == "csv") {
      into_folder({{"cylinders.csv", CylindersCsv(model)},
                   {"branches.csv", BranchesCsv(model)},
                   {"trees.csv", TreesCsv(model, files.georeference ? &*files.georeference : nullptr)}});
    }
    if (format == "ply-branch")
      outputs.emplace_back(output, MeshToPly(ModelMesh(model, MeshColor::kByBranch)));
    if (format == "ply-order")
      outputs.emplace_back(output, MeshToPly(ModelMesh(model, MeshColor::kByOrder)));
    if (format == "ply-sigma")
      outputs.emplace_back(output, MeshToPly(ModelMesh(model, MeshColor::kBySigma)));
    if (format == "las" || format == "ply-points") {
      outputs.emplace_back(output,
                           format == "las" ? PointsToLas(files.points) : PointsToPly(files.points));
      if (files.points.empty()) {
        fmt::print(stderr,
                   "export_map: {} holds no points: it was made without map_cloud/enabled\n",
                   map_dir);
      }
    }
    if (format == "geojson") {
      if (georeference.empty() && !files.georeference) {
        throw MapFileError(
            "geojson: the map does not say where it lies; give --georeference "
            "LATITUDE,LONGITUDE,HEADING[,ALTITUDE]");
      }
      Georeference place;
      if (georeference.empty()) {
        place = *files.georeference;
      } else {
        place.origin.latitude_deg = georeference[0];
        place.origin.longitude_deg = georeference[1];
        place.heading_deg = georeference[2];
        place.heading_sigma_deg = 0.0;
        place.origin.altitude_m = georeference.size() > 3 ? georeference[3] : 0.0;
      }
      if (!place.note.empty()) fmt::print(stderr, "export_map: {}\n", place.note);
      outputs.emplace_back(output, ModelGeoJson(model, place));
    }
    if (format == "json") outputs.emplace_back(output, TreeMapJson(files));
    for (const auto& [path, content] : outputs) WriteFileAtomically(path, content);
    const int unattached = CountUnattached(model);
    fmt::print("{} file{} written", outputs.size(), outputs.size() == 1 ? "" : "s");
    if (leaves_out && unattached > 0) {
      fmt::print("; {} cylinders that are attached to no tree are left out", unattached);
    }
    fmt::print("\n");
  } catch (const std::exception& error) {
    fmt::print(stderr, "export_map: {}\n", error.what());
    return 2;
  }
  return 0;
}
