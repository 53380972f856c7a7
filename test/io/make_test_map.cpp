// Writes a map directory for the tests of the exports: make_test_map DIR small|one|empty|big|tall

#include <cmath>
#include <cstdio>
#include <string>

#include "../topology/landmark_maker.h"
#include "dendro_slam/geometry/cylinder.h"
#include "dendro_slam/io/map_directory.h"
#include "dendro_slam/topology/crown.h"

int main(int argc, char** argv) {
  using namespace dendro;
  using test::MakeLandmark;
  if (argc != 3) return 2;
  const std::string kind = argv[2];
  MapFiles files;
  const auto add_tree = [&](double x, double y, int branches) {
    const auto add = [&](const Eigen::Vector3d& a, const Eigen::Vector3d& b, double r0, double r1) {
      const Eigen::Vector3d o(x, y, 0.0);
      files.landmarks.push_back(
          MakeLandmark(static_cast<int>(files.landmarks.size()), a + o, b + o, r0, r1));
    };
    add({0, 0, 0}, {0, 0, 5}, 0.2, 0.1);
    for (int i = 0; i < branches; ++i) {
      const double angle = 2.4 * i, z = 1.5 + 3.0 * i / branches;
      const Eigen::Vector3d d(std::cos(angle), std::sin(angle), 0.4);
      const Eigen::Vector3d base(0, 0, z);
      add(base + 0.25 * d, base + 1.6 * d, 0.05, 0.03);
    }
  };
  if (kind == "small") {
    add_tree(0, 0, 4);
    // A twig on the first branch, away from its middle line.
    files.landmarks.push_back(MakeLandmark(50, {1.0, 0.08, 1.9}, {1.0, 0.9, 2.0}, 0.015, 0.012));
    add_tree(8, 3, 2);
    files.landmarks.back().id = 60;
    files.landmarks.push_back(MakeLandmark(99, {4, -4, 4}, {5, -4, 4.2}, 0.02, 0.02));
  } else if (kind == "one") {
    files.landmarks = {MakeLandmark(0, {0, 0, 0}, {0, 0, 0.2}, 0.1, 0.1)};
  } else if (kind == "big") {
    for (int i = 0; i < 240; ++i) add_tree(8.0 * (i % 16), 8.0 * (i / 16), 10);
  } else if (kind == "tall") {
    // Ten thousand cylinders on one tree.
    files.landmarks.push_back(MakeLandmark(0, {0, 0, 0}, {0, 0, 100}, 1.0, 0.2));
    for (int i = 0; i < 150; ++i) {
      const Eigen::Vector3d d(std::cos(2.4 * i), std::sin(2.4 * i), 0.4);
      const Eigen::Vector3d base(0, 0, 5.0 + 0.6 * i);
      files.landmarks.push_back(MakeLandmark(1 + i, base + 1.1 * d, base + 16.1 * d, 0.1, 0.03));
    }
  } else if (kind != "empty") {
    return 2;
  }
  for (std::size_t i = 0; i < files.landmarks.size(); ++i)
    files.landmarks[i].id = static_cast<int>(i);
  files.next_landmark_id = static_cast<int>(files.landmarks.size());
  TreeTopology topology{TopologyConfig()};
  files.model = topology.Build(files.landmarks, 1000);
  files.topology = topology.state();
  for (int i = 0; i < 21; ++i) {
    StampedPose pose;
    pose.stamp_ns = 1000000000LL + 100000000LL * i;
    pose.T_map_lidar.linear() =
        Eigen::AngleAxisd(0.1 * i, Eigen::Vector3d::UnitZ()).toRotationMatrix();
    pose.T_map_lidar.translation() = Eigen::Vector3d(4.0, -2.0 + 0.1 * i, 1.5);
    files.trajectory.push_back(pose);
  }
  // Twenty points on every cylinder, and a crown of leaves half a metre round every branch's tip.
  const auto add_point = [&](const Eigen::Vector3d& position, Label label) {
    files.points.emplace_back();
    files.points.back().position = position;
    files.points.back().label = label;
  };
  if (kind == "small" || kind == "big" || kind == "tall") {
    for (const MapCylinder& c : files.model.cylinders) {
      const auto basis = PerpendicularBasis(c.Axis());
      for (int i = 0; i < 20; ++i) {
        const double f = (i + 0.5) / 20.0, angle = 2.4 * i;
        const double radius = c.radius_m + (f - 0.5) * c.taper_m_per_m * c.Length();
        add_point(c.start + f * (c.end - c.start) +
                      radius * (basis.col(0) * std::cos(angle) + basis.col(1) * std::sin(angle)),
                  Label::kWood);
      }
    }
  }
  if (kind == "small") {
    for (const MapBranch& b : files.model.branches) {
      if (b.order == 0 || b.tree_id < 0) continue;
      for (int i = 0; i < 500; ++i) {
        const double z = 1.0 - 2.0 * (i + 0.5) / 500.0, angle = 2.399963 * i;
        const double r = std::sqrt(1.0 - z * z);
        const double depth = 0.5 * std::cbrt(((7 * i) % 500 + 0.5) / 500.0);
        add_point(b.tip + depth * Eigen::Vector3d(r * std::cos(angle), r * std::sin(angle), z),
                  Label::kLeaf);
      }
    }
  }
  AssignPoints(files.model, 0.06, 1.0, &files.points);
  MeasureCrowns(files.points, 0.5, &files.model);
  try {
    SaveMap(argv[1], files);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "make_test_map: %s\n", error.what());
    return 1;
  }
  std::printf("%zu cylinders\n", files.model.cylinders.size());
  return 0;
}
