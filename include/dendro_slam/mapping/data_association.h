#pragma once

#include <vector>

#include "dendro_slam/cylinder_fitting/fitted_cylinder.h"
#include "dendro_slam/geometry/se3.h"
#include "dendro_slam/mapping/landmark.h"

namespace dendro {

/// Settings of the data association.
struct DataAssociationConfig {
  double gate_sigma = 3.5;          ///< Gate on each whitened residual's equivalent, in sigmas of the
                                    ///< chi-squared distribution's normal counterpart. > 0.
  double max_axis_angle_deg = 20.0; ///< Axes farther apart never match [deg]. In (0, 90).
  double max_offset_m = 0.5;        ///< Axis lines farther apart never match [m]. > 0.
  double max_offset_radii = 1.0;    ///< The same as a multiple of the landmark's radius (plus the
                                    ///< sigmas); the smaller of both rules. > 0.
  double extent_tolerance_m = 0.10; ///< Extents may miss each other by this much [m]. >= 0.
  double max_radius_ratio = 1.6;    ///< Radii farther apart than this factor never match, unless
                                    ///< their sigmas allow it. > 1.
  double axis_sigma_floor_deg = 1.0;  ///< Bent branches: added to the axis' sigma [deg]. >= 0.
  double max_reach_m = 1.0;           ///< An observation whose middle is farther than this from the middle
                                      ///< of a landmark, along its axis, belongs to another piece of a
                                      ///< trunk or branch: those bend [m]. > 0.
  double offset_sigma_floor_m = 0.01; ///< Bent branches: added to the line's sigma [m]. >= 0.

  /// @throws std::invalid_argument naming the field.
  void Validate() const;

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("gate_sigma", gate_sigma);
    v("max_axis_angle_deg", max_axis_angle_deg);
    v("max_offset_m", max_offset_m);
    v("max_offset_radii", max_offset_radii);
    v("extent_tolerance_m", extent_tolerance_m);
    v("max_radius_ratio", max_radius_ratio);
    v("axis_sigma_floor_deg", axis_sigma_floor_deg);
    v("max_reach_m", max_reach_m);
    v("offset_sigma_floor_m", offset_sigma_floor_m);
  }
};

/// A fitted cylinder and the landmark it belongs to.
struct Match {
  int observation = 0;      ///< Index into the scan's cylinders.
  int landmark = 0;         ///< Index into the landmarks.
  double mahalanobis2 = 0.0;  ///< Squared, of the four line residuals under the joint covariance.
};

/// Line residual of an observation against a landmark, measured at the middle of their overlap.
struct LineResidual {
  Eigen::Vector4d residual = Eigen::Vector4d::Zero();  ///< Axis (2, rad), offset (2, m), in the
                                                       ///< observation's tangent coordinates.
  Eigen::Matrix4d covariance = Eigen::Matrix4d::Zero();  ///< Of the residual.
  Eigen::Matrix<double, 4, 6> J_pose = Eigen::Matrix<double, 4, 6>::Zero();  ///< Of the residual for
                                                       ///< the pose's right tangent.
  double overlap_m = 0.0;    ///< Length of the common extent; negative is a gap.
  double angle_rad = 0.0;    ///< Between the axes, without sign.
  double offset_m = 0.0;     ///< Between the lines at the overlap's middle.
  double radius_m = 0.0;     ///< Of the observation at the overlap's middle.
  double landmark_radius_m = 0.0;
  double radius_difference_sigma_m = 0.0;
};

/// The line residual with its joint covariance of pose, landmark and fit.
/// @param observation      In the lidar frame.
/// @param landmark         In the map frame.
/// @param T_map_lidar      Predicted pose.
/// @param pose_covariance  Of the pose's right tangent.
LineResidual ComputeLineResidual(const FittedCylinder& observation,
                                 const Landmark& landmark,
                                 const Eigen::Isometry3d& T_map_lidar,
                                 const Matrix6d& pose_covariance,
                                 const DataAssociationConfig& config);

/// Mutual best matches between a scan's cylinders and the landmarks under a Mahalanobis gate with the
/// joint covariance of pose, landmark and fit (math.md, "Data association").
///
/// Extents must overlap (within a tolerance), so two collinear branches with a gap stay two. Radii
/// are compared where the two overlap, on the landmark's profile, so a taper is no reason to refuse.
/// Only measured cylinders take part. After the mutual best matches, a landmark may take further
/// observations that overlap none of those it already has (a trunk cut in two by an occlusion), and
/// no observation is given to two landmarks.
/// @return Ascending in observation.
std::vector<Match> Associate(const std::vector<FittedCylinder>& observations,
                             const std::vector<const Landmark*>& landmarks,
                             const Eigen::Isometry3d& T_map_lidar,
                             const Matrix6d& pose_covariance,
                             const DataAssociationConfig& config);

}  // namespace dendro
