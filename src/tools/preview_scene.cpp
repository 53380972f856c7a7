#include <cmath>
#include <cstdint>
#include <fstream>
#include <iostream>
#include <optional>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <Eigen/Geometry>

#include "dendro_slam/sim/flight_path.h"
#include "dendro_slam/sim/lidar_simulator.h"

namespace {

using dendro::SurfaceKind;

Eigen::Vector3d Colour(SurfaceKind kind) {
  switch (kind) {
    case SurfaceKind::kGround: return {0.76, 0.70, 0.55};
    case SurfaceKind::kTrunk: return {0.50, 0.34, 0.20};
    case SurfaceKind::kBranch: return {0.62, 0.45, 0.27};
    case SurfaceKind::kLeaf: return {0.30, 0.58, 0.25};
    case SurfaceKind::kObstacle: return {0.55, 0.57, 0.62};
    case SurfaceKind::kNone: break;
  }
  return {0.80, 0.88, 0.96};
}

/// A picture by the simulator's own ray caster, lit by the sun with shadows.
void Render(const dendro::Raycaster& raycaster,
            const Eigen::Vector3d& eye,
            const Eigen::Vector3d& target,
            int width,
            int height,
            const std::string& path) {
  const Eigen::Vector3d forward = (target - eye).normalized();
  const Eigen::Vector3d right = forward.cross(Eigen::Vector3d::UnitZ()).normalized();
  const Eigen::Vector3d up = right.cross(forward);
  const Eigen::Vector3d sun = Eigen::Vector3d(0.5, -0.35, 0.8).normalized();
  const double scale = std::tan(25.0 * M_PI / 180.0) / (0.5 * height);
  std::vector<std::uint8_t> pixels;
  pixels.reserve(static_cast<std::size_t>(3 * width * height));
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      Eigen::Vector3d colour = Eigen::Vector3d::Zero();
      for (int sample = 0; sample < 4; ++sample) {
        const double sx = x + 0.25 + 0.5 * (sample % 2) - 0.5 * width;
        const double sy = y + 0.25 + 0.5 * (sample / 2) - 0.5 * height;
        const Eigen::Vector3d d = (forward + scale * (sx * right - sy * up)).normalized();
        const std::optional<dendro::RayHit> hit = raycaster.Cast(eye, d, 300.0);
        if (!hit) {
          colour += Colour(SurfaceKind::kNone);
          continue;
        }
        const Eigen::Vector3d p = eye + (hit->range_m - 1e-4) * d + 1e-4 * hit->normal;
        const double cosine = std::max(0.0, hit->normal.dot(sun));
        const bool lit = cosine > 0.0 && !raycaster.Cast(p, sun, 100.0, 1e-3);
        const double haze = std::exp(-hit->range_m / 120.0);
        const Eigen::Vector3d shade = Colour(hit->kind) * (0.45 + (lit ? 0.55 * cosine : 0.0));
        colour += haze * shade + (1.0 - haze) * Colour(SurfaceKind::kNone);
      }
      for (int i = 0; i < 3; ++i) {
        pixels.push_back(static_cast<std::uint8_t>(std::lround(255.0 * std::min(1.0, std::pow(0.25 * colour[i], 0.8)))));
      }
    }
  }
  std::ofstream file(path, std::ios::binary);
  file << "P6\n" << width << " " << height << "\n255\n";
  file.write(reinterpret_cast<const char*>(pixels.data()), static_cast<std::streamsize>(pixels.size()));
  if (!file) throw dendro::SceneFileError(path + ": cannot be written");
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app(
      "Renders a picture of a scene (picture.ppm) and simulates one VLP-16 scan in it (scan.csv: x, y, z in the "
      "map frame, ring, intensity, range, thin_range, kind, tree, branch). scripts/draw_scene.py draws both.");
  std::string scene_file, path_file, output;
  std::vector<double> position = {4.5, -3.0, 1.5}, eye, target = {0.0, 0.0, 3.0};
  int scan_index = 0, width = 800, height = 800;
  dendro::LidarSimulatorConfig config;
  app.add_option("scene", scene_file, "Scene file (YAML)")->required();
  app.add_option("-o,--output", output, "Folder for the two files; must exist")->required();
  app.add_option("--position", position, "Where the lidar stands, upright [m]")->expected(3)->capture_default_str();
  app.add_option("--path", path_file, "Flight path instead of a fixed position");
  app.add_option("--scan", scan_index, "Revolution to simulate")->capture_default_str();
  app.add_option("--eye", eye, "Where the picture is taken from [m]")->expected(3);
  app.add_option("--look-at", target, "Centre of the picture [m]")->expected(3)->capture_default_str();
  app.add_option("--width", width, "Of the picture [pixels]")->capture_default_str();
  app.add_option("--height", height, "Of the picture [pixels]")->capture_default_str();
  config.Visit([&](const char* name, auto& value) {
    app.add_option("--lidar-" + std::string(name), value)->group("Lidar")->capture_default_str();
  });
  CLI11_PARSE(app, argc, argv);
  try {
    const dendro::Scene scene = dendro::LoadScene(scene_file);
    const dendro::Raycaster raycaster(scene);
    const auto vec = [](const std::vector<double>& v) { return Eigen::Vector3d(v[0], v[1], v[2]); };
    std::optional<dendro::FlightPath> path;
    if (!path_file.empty()) path = dendro::LoadFlightPath(path_file);
    const dendro::LidarSimulator simulator(raycaster, config, path ? path->start_stamp_ns : 0);
    dendro::LidarPoseFunction pose = [&](std::int64_t) {
      return Eigen::Isometry3d(Eigen::Translation3d(vec(position)));
    };
    if (path) pose = [&](std::int64_t stamp_ns) { return path->LidarPose(stamp_ns); };
    const dendro::SimulatedScan scan = simulator.SimulateScan(scan_index, pose);
    std::ofstream file(output + "/scan.csv");
    file << "x,y,z,ring,intensity,range,thin_range,kind,tree,branch\n";
    for (std::size_t i = 0; i < scan.scan.points.size(); ++i) {
      const dendro::LidarPoint& p = scan.scan.points[i];
      const dendro::PointTruth& t = scan.truth[i];
      const auto stamp = scan.scan.stamp_ns + std::llround(static_cast<double>(p.time_s) * 1e9);
      const Eigen::Vector3d q = pose(stamp) * p.position.cast<double>();
      file << q.x() << ',' << q.y() << ',' << q.z() << ',' << p.ring << ',' << p.intensity << ','
           << p.position.norm() << ',' << t.thin_range_m << ',' << dendro::SurfaceKindName(t.kind) << ','
           << t.tree_id << ',' << t.branch_id << '\n';
    }
    if (!file) throw dendro::SceneFileError(output + "/scan.csv: cannot be written");
    if (eye.empty()) eye = {1.9 * position[0], 1.9 * position[1], position[2] + 1.5};
    Render(raycaster, vec(eye), vec(target), width, height, output + "/picture.ppm");
  } catch (const std::exception& e) {
    std::cerr << "preview_scene: " << e.what() << "\n";
    return 1;
  }
  return 0;
}
