// What a large map costs the viewer's nodelet: building its markers, their size on the wire, and what
// is left to do when nothing has changed.

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <ros/serialization.h>

#include <cmath>
#include <string>

#include "dendro_slam/ros/markers.h"
#include "measure.h"

namespace {

/// Trees of one trunk and branches all round, cylinders of 25 cm; ids ascend.
dendro::TreeModel Orchard(int cylinders, int trees) {
  constexpr int kPerBranch = 20;
  constexpr double kLengthM = 0.25;
  dendro::TreeModel model;
  for (int t = 0; t < trees; ++t) {
    dendro::MapTree tree;
    tree.id = t;
    tree.base = {4.0 * t, 0.0, 0.0};
    tree.trunk_branch_id = static_cast<int>(model.branches.size());
    tree.dbh_m = 0.3;
    const int branches = std::max(1, cylinders / trees / kPerBranch);
    for (int b = 0; b < branches; ++b) {
      dendro::MapBranch branch;
      branch.id = static_cast<int>(model.branches.size());
      branch.tree_id = t;
      branch.order = b == 0 ? 0 : 1;
      branch.parent_id = b == 0 ? -1 : tree.trunk_branch_id;
      const double turn = 2.4 * b;
      const Eigen::Vector3d direction =
          b == 0 ? Eigen::Vector3d(0, 0, 1)
                 : Eigen::Vector3d(std::cos(turn), std::sin(turn), 0.4).normalized();
      branch.base = tree.base + Eigen::Vector3d(0, 0, b == 0 ? 0.0 : 1.0 + 3.0 * b / branches);
      branch.tip = branch.base + kPerBranch * kLengthM * direction;
      branch.base_radius_m = b == 0 ? 0.15 : 0.05;
      for (int i = 0; i < kPerBranch; ++i) {
        dendro::MapCylinder c;
        c.id = static_cast<int>(model.cylinders.size());
        c.tree_id = t;
        c.branch_id = branch.id;
        c.branch_order = branch.order;
        c.position_in_branch = i;
        c.parent_id = i > 0 ? c.id - 1 : -1;
        c.start = branch.base + i * kLengthM * direction;
        c.end = c.start + kLengthM * direction;
        c.radius_m = branch.base_radius_m * (1.0 - 0.04 * i);
        c.radius_sigma_m = 0.001;
        branch.cylinder_ids.push_back(c.id);
        model.cylinders.push_back(c);
      }
      tree.branch_ids.push_back(branch.id);
      model.branches.push_back(branch);
    }
    model.trees.push_back(tree);
  }
  return model;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Cost of the markers of a large map"};
  int cylinders = 20000, trees = 1, repeats = 5;
  app.add_option("--cylinders", cylinders, "in the map")->check(CLI::Range(20, 1000000));
  app.add_option("--trees", trees, "that they belong to")->check(CLI::Range(1, 10000));
  app.add_option("--repeats", repeats, "means are over")->check(CLI::Range(1, 1000));
  CLI11_PARSE(app, argc, argv);
  dendro::TreeModel model = Orchard(cylinders, trees);
  const dendro_ros::MapMarkerStyle style;
  double build_s = 0.0, same_s = 0.0, change_s = 0.0;
  std::size_t bytes = 0, meshes = 0, triangles = 0, changed = 0;
  for (int k = 0; k < repeats; ++k) {
    dendro_ros::MarkerChanges changes;
    double start = dendro::measure::ThreadCpuSeconds();
    visualization_msgs::MarkerArray markers = dendro_ros::MapMarkers(model, style, "map");
    build_s += dendro::measure::ThreadCpuSeconds() - start;
    bytes = ros::serialization::serializationLength(markers);
    meshes = triangles = 0;
    for (const auto& marker : markers.markers) {
      if (marker.ns != "trees") continue;
      ++meshes;
      triangles += marker.points.size() / 3;
    }
    changes.Next(markers);
    start = dendro::measure::ThreadCpuSeconds();
    changed = changes.Next(dendro_ros::MapMarkers(model, style, "map")).markers.size();
    same_s += dendro::measure::ThreadCpuSeconds() - start;
    model.cylinders.front().radius_m += 0.001;
    start = dendro::measure::ThreadCpuSeconds();
    changes.Next(dendro_ros::MapMarkers(model, style, "map"));
    change_s += dendro::measure::ThreadCpuSeconds() - start;
  }
  fmt::print(
      "{} cylinders, {} trees: {} mesh markers, {} triangles, {:.1f} MB\n"
      "build {:.1f} ms; the same map again {:.1f} ms, {} markers to send; one radius changed {:.1f} ms "
      "(processor time, one thread)\n",
      model.cylinders.size(),
      trees,
      meshes,
      triangles,
      1e-6 * static_cast<double>(bytes),
      1e3 * build_s / repeats,
      1e3 * same_s / repeats,
      changed,
      1e3 * change_s / repeats);
  return 0;
}
