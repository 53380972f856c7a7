#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>
#include <iostream>
#include <limits>
#include <map>
#include <random>
#include <set>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <Eigen/Geometry>
#include <fmt/format.h>
#include <nlohmann/json.hpp>

#include "dendro_slam/branch_separation/branch_separator.h"
#include "dendro_slam/range_image/projector.h"
#include "dendro_slam/sim/lidar_simulator.h"
#include "dendro_slam/sim/raycaster.h"
#include "dendro_slam/sim/scene.h"
#include "dendro_slam/sim/scene_generator.h"
#include "measure.h"

namespace {

/// Sums over scans. A branch is observable in a scan with at least `min_points` returns.
struct Score {
  long points = 0, pure = 0;
  long branch_points = 0, complete = 0;
  // Returns in a segment of another branch. `at_joints`: of its parent or child, where a pixel's width
  // on does not tell the two surfaces apart, so that whose it is is a matter of definition. Of the
  // others of its parent or child, `beside`: in rows that also hold returns of the segment's own
  // branch, `beyond`: in rows that do not.
  long at_joints = 0, beside = 0, beyond = 0, of_siblings = 0, of_strangers = 0;
  int branches = 0, pieces = 0, segments = 0, found = 0;
  double seconds = 0.0;

  void Add(const std::vector<dendro::Segment>& separated,
           const std::vector<int>& branch_of_pixel,
           const std::map<int, int>& parent_of,
           const std::function<bool(int branch, std::size_t pixel)>& at_surface,
           int cols,
           int min_points) {
    std::map<int, long> returns, own, segments_of;
    for (const int branch : branch_of_pixel) {
      if (branch >= 0) ++returns[branch];
    }
    for (const dendro::Segment& segment : separated) {
      std::map<int, long> votes;
      for (const std::int32_t p : segment.pixels) ++votes[branch_of_pixel[static_cast<std::size_t>(p)]];
      int winner = -1;
      long best = 0;
      for (const auto& [branch, count] : votes) {
        if (count > best) {
          best = count;
          winner = branch;
        }
      }
      std::set<int> own_rows;
      for (const std::int32_t p : segment.pixels) {
        if (branch_of_pixel[static_cast<std::size_t>(p)] == winner) own_rows.insert(p / cols);
      }
      for (const std::int32_t p : segment.pixels) {
        const int branch = branch_of_pixel[static_cast<std::size_t>(p)];
        if (branch == winner) continue;
        const int parent = parent_of.at(branch), winners_parent = parent_of.at(winner);
        if (parent != winner && winners_parent != branch) {
          ++(parent == winners_parent ? of_siblings : of_strangers);
        } else if (at_surface(winner, static_cast<std::size_t>(p))) {
          ++at_joints;
        } else {
          ++(own_rows.count(p / cols) > 0 ? beside : beyond);
        }
      }
      points += static_cast<long>(segment.pixels.size());
      pure += best;
      own[winner] += best;
      ++segments_of[winner];
    }
    segments += static_cast<int>(separated.size());
    for (const auto& [branch, count] : returns) {
      if (count < min_points) continue;
      ++branches;
      branch_points += count;
      complete += own[branch];
      pieces += static_cast<int>(segments_of[branch]);
      found += 2 * own[branch] >= count;
    }
  }
  nlohmann::json Json(int scans) const {
    const auto ratio = [](double a, double b) { return b > 0.0 ? nlohmann::json(a / b) : nlohmann::json(nullptr); };
    return {{"purity", ratio(static_cast<double>(pure), static_cast<double>(points))},
            {"completeness", ratio(static_cast<double>(complete), static_cast<double>(branch_points))},
            {"purity_joints_aside", ratio(static_cast<double>(pure + at_joints), static_cast<double>(points))},
            {"impure_at_joints", ratio(static_cast<double>(at_joints), static_cast<double>(points))},
            {"impure_beside_parent_or_child", ratio(static_cast<double>(beside), static_cast<double>(points))},
            {"impure_beyond_parent_or_child", ratio(static_cast<double>(beyond), static_cast<double>(points))},
            {"impure_siblings", ratio(static_cast<double>(of_siblings), static_cast<double>(points))},
            {"impure_strangers", ratio(static_cast<double>(of_strangers), static_cast<double>(points))},
            {"branches_found", ratio(found, branches)},
            {"pieces_per_branch", ratio(pieces, branches)},
            {"observable_branches", branches},
            {"segments", segments},
            {"ms_per_scan", ratio(1e3 * seconds, scans)}};
  }
};

/// Distance of a place from the surface of a branch, negative inside [m].
double SurfaceDistance(const dendro::SceneBranch& branch, const Eigen::Vector3d& place) {
  double nearest = std::numeric_limits<double>::infinity();
  for (std::size_t i = 1; i < branch.points.size(); ++i) {
    const auto& from = branch.points[i - 1];
    const auto& to = branch.points[i];
    const Eigen::Vector3d span = to.position - from.position;
    const double t =
        std::clamp((place - from.position).dot(span) / std::max(1e-12, span.squaredNorm()), 0.0, 1.0);
    const double radius = from.radius_m + t * (to.radius_m - from.radius_m);
    nearest = std::min(nearest, (place - from.position - t * span).norm() - radius);
  }
  return nearest;
}

}  // namespace

int main(int argc, char** argv) {
  int scenes = 12, views = 3, min_points = 30;
  unsigned seed = 50000;
  std::string scene_file;
  bool json = false;
  CLI::App app(
      "Scores branch separation on simulated scans with true labels: purity, completeness and pieces "
      "per branch of this package and of the thesis' Algorithms 1 and 2, in the same run.");
  app.add_option("--scenes", scenes, "Generated scenes")->check(CLI::PositiveNumber);
  app.add_option("--views", views, "Scans per scene")->check(CLI::PositiveNumber);
  app.add_option("--min-points", min_points, "Returns that make a branch observable");
  app.add_option("--seed", seed, "Of the first scene; training uses lower ones");
  app.add_option("--scene", scene_file, "A scene file instead of generated ones")
      ->check(CLI::ExistingFile);
  app.add_flag("--json", json, "JSON without the per-scene lines");
  CLI11_PARSE(app, argc, argv);
  try {
    const dendro::BranchSeparator separator;
    dendro::BranchSeparatorConfig thesis_config;
    thesis_config.thesis_mode = true;
    const dendro::BranchSeparator thesis(thesis_config);
    Score ours, theirs;
    int scans = 0;
    for (int s = 0; s < (scene_file.empty() ? scenes : 1); ++s) {
      dendro::Scene scene;
      if (scene_file.empty()) {
        dendro::SceneGeneratorConfig generator;
        generator.num_trees = 1 + s % 3;
        scene = dendro::GenerateScene(generator, seed + static_cast<unsigned>(s));
      } else {
        scene = dendro::LoadScene(scene_file);
      }
      std::map<int, int> parent_of;
      for (std::size_t t = 0; t < scene.trees.size(); ++t) {
        for (const dendro::SceneBranch& b : scene.trees[t].branches) {
          const int first = static_cast<int>(t) * 10000;
          parent_of[first + b.id] = b.parent < 0 ? -1 - static_cast<int>(t) : first + b.parent;
        }
      }
      const dendro::Raycaster raycaster(scene);
      const dendro::LidarSimulator simulator(raycaster, dendro::LidarSimulatorConfig());
      std::mt19937 rng(seed + static_cast<unsigned>(s));
      std::uniform_real_distribution<double> u(0.0, 1.0);
      for (int v = 0; v < views; ++v) {
        const double azimuth = 2.0 * M_PI * u(rng), distance = 3.0 + 4.0 * u(rng);
        const Eigen::Vector3d root = scene.trees.front().branches.front().points.front().position;
        Eigen::Isometry3d pose = Eigen::Isometry3d::Identity();
        pose.translation() = root + Eigen::Vector3d(distance * std::cos(azimuth),
                                                    distance * std::sin(azimuth), 1.0 + 3.0 * u(rng));
        pose.linear() =
            Eigen::AngleAxisd(2.0 * M_PI * u(rng), Eigen::Vector3d::UnitZ()).toRotationMatrix();
        const dendro::SimulatedScan simulated = simulator.SimulateScan(v, pose);
        dendro::Projector projector;
        dendro::LabelledScan scan;
        scan.image = projector.Project(simulated.scan, nullptr);
        scan.label.assign(scan.image.size(), dendro::Label::kNone);
        scan.wood_probability.assign(scan.image.size(), 0.0F);
        std::vector<int> branch(scan.image.size(), -1);
        for (std::size_t i = 0; i < scan.image.size(); ++i) {
          if (!scan.image.HasReturn(i)) continue;
          const dendro::PointTruth& truth =
              simulated.truth[static_cast<std::size_t>(scan.image.point_index[i])];
          scan.label[i] = dendro::SurfaceLabel(truth.kind);
          if (scan.IsWood(i)) branch[i] = truth.tree_id * 10000 + truth.branch_id;
        }
        // A column's spacing and the noise of a range leave this much open.
        const auto at_surface = [&](int which, std::size_t pixel) {
          const auto& tree = scene.trees[static_cast<std::size_t>(which / 10000)];
          const Eigen::Vector3d place = pose * scan.image.point[pixel].cast<double>();
          const double open = static_cast<double>(scan.image.range[pixel]) * 2.0 * M_PI / scan.image.cols + 0.03;
          return std::any_of(tree.branches.begin(), tree.branches.end(), [&](const auto& b) {
            return b.id == which % 10000 && SurfaceDistance(b, place) < open;
          });
        };
        double begin = dendro::measure::ThreadCpuSeconds();
        const std::vector<dendro::Segment> mine = separator.Separate(scan);
        ours.seconds += dendro::measure::ThreadCpuSeconds() - begin;
        begin = dendro::measure::ThreadCpuSeconds();
        const std::vector<dendro::Segment> counted = thesis.Separate(scan);
        theirs.seconds += dendro::measure::ThreadCpuSeconds() - begin;
        ours.Add(mine, branch, parent_of, at_surface, scan.image.cols, min_points);
        theirs.Add(counted, branch, parent_of, at_surface, scan.image.cols, min_points);
        ++scans;
        if (!json) {
          Score one;
          one.Add(mine, branch, parent_of, at_surface, scan.image.cols, min_points);
          fmt::print("scene {} view {}: {} segments, {} branches, purity {:.3f}, completeness {:.3f}\n",
                     seed + static_cast<unsigned>(s), v, mine.size(), one.branches,
                     one.points > 0 ? static_cast<double>(one.pure) / static_cast<double>(one.points) : NAN,
                     one.branch_points > 0
                         ? static_cast<double>(one.complete) / static_cast<double>(one.branch_points)
                         : NAN);
        }
      }
    }
    std::cout << nlohmann::json{{"scans", scans},
                                {"adaptive", ours.Json(scans)},
                                {"thesis_mode", theirs.Json(scans)}}
                     .dump(2)
              << "\n";
  } catch (const std::exception& e) {
    std::cerr << "separation_benchmark: " << e.what() << "\n";
    return 1;
  }
  return 0;
}
