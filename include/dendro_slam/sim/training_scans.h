#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "dendro_slam/range_image/projector.h"
#include "dendro_slam/range_image/range_image.h"
#include "dendro_slam/sim/lidar_simulator.h"
#include "dendro_slam/sim/scene.h"

namespace dendro {

/// A range image with the true class of every pixel.
struct TrainingScan {
  RangeImage image;
  std::vector<Label> truth;  ///< Of the nearest return of each pixel; kNone without a return.
  std::vector<float> wood_radius_m;  ///< Of the wood that each pixel met [m]; 0 where it met none.
  std::string kind;          ///< See TrainingKinds().
  std::uint64_t seed = 0;    ///< Of the scene.
};

/// Kinds of random scenes for training and scoring the segmentation:
///   thesis    one or two bare, stout trees on a plane, sensor upright, 3 to 8 m away
///   leafless  bare trees of all forms, rough ground, rocks, grass, walls, crates, pillars, people
///   leafy     the same, in leaf
///   tilted    any of these, the sensor mounted at a random angle, up to lying on its side
///   orchard   one or two rows of small trees, most of them in leaf, trellis posts in some
///   clutter   any of these, sensor upright, among pillars as thick as trunks, people and ends of walls
const std::vector<std::string>& TrainingKinds();

/// A random scene of a kind, a deterministic function of the seed. Reflectivities are drawn at
/// random too, so that nobody learns that bark has one brightness.
/// @throws std::invalid_argument for an unknown kind.
Scene RandomTrainingScene(const std::string& kind, std::uint64_t seed);

/// Scans of one random scene from random places around its trees (2 to 12 m away, 0.5 to 8 m above
/// the ground, never inside something), moving at up to 1 m/s, with all effects of the sensor.
/// @param count      Number of scans.
/// @param lidar      Sensor model; its seed is replaced by one drawn from `seed`.
/// @param projector  Size of the range image.
std::vector<TrainingScan> SimulateTrainingScans(const std::string& kind,
                                                std::uint64_t seed,
                                                int count,
                                                const LidarSimulatorConfig& lidar,
                                                const ProjectorConfig& projector);

/// The true class of every pixel of a projected scan.
/// @param truth  Per point of the cloud that the image was projected from.
std::vector<Label> PixelTruth(const RangeImage& image, const std::vector<PointTruth>& truth);

/// The true radius of the wood that every pixel met [m], 0 where it met none: tells which twigs are
/// too thin for the beam.
/// @param T_map_lidar  Pose of the lidar at the image's stamp.
std::vector<float> PixelWoodRadius(const RangeImage& image,
                                   const std::vector<PointTruth>& truth,
                                   const Scene& scene,
                                   const Eigen::Isometry3d& T_map_lidar);

}  // namespace dendro
