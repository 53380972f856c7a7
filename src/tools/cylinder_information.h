#pragma once

#include <Eigen/Core>

#include "dendro_slam/geometry/cylinder.h"
#include "dendro_slam/range_image/range_image.h"
#include "dendro_slam/sim/lidar_simulator.h"

namespace dendro {

/// Fisher information of one scan about a straight cylinder of known length in an empty world, from the
/// simulator's sensor model alone (no part of stage 3): every beam either gives no return or a range
/// with gaussian noise; the probability of a return follows from the part of the footprint on the
/// cylinder, with the simulator's soft limit. Expected over returns and noise, at the truth,
/// by central differences.
///
/// Coordinates: [turn about the side, turn about the view (rad); shift along the side, along the view
/// (m); radius (m)], where the view is the direction from the sensor to the axis, across the axis, and
/// the side is across both. In this frame scans from anywhere can be averaged: by van Trees' inequality
/// the inverse of the mean information bounds the mean square error over many views of every
/// estimator.
/// @param image          Beams of every pixel; returns are not looked at.
/// @param half_length_m  Of the cylinder, from its anchor both ways.
Matrix5d CylinderInformation(const RangeImage& image,
                             const Cylinder& truth,
                             double half_length_m,
                             const LidarSimulatorConfig& lidar,
                             double range_sigma_m);

/// Probability of a return and its expected range, for one beam (exposed to be checked against the
/// simulator).
struct BeamExpectation {
  double part = 0.0;     ///< Part of the footprint on the cylinder.
  double range_m = 0.0;  ///< Mean over that part, weighted by the cosine of incidence.
};
BeamExpectation ExpectBeam(const Cylinder& cylinder,
                           const Eigen::Vector3d& origin,
                           const Eigen::Vector3d& direction,
                           const LidarSimulatorConfig& lidar);

}  // namespace dendro
