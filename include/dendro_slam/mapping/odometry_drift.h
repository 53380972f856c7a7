#pragma once

#include <Eigen/Geometry>

#include "dendro_slam/factor_graph/factor.h"

/// Visual-inertial odometry drifts slowly: its scale is off by about the same for minutes, and so is
/// the direction in which it slides. Where little is in view that is most of its error; where much is
/// in view it can be learnt.
namespace dendro {

/// A drift is a PointN of four: how much too long each way comes out, and how far the pose slides
/// along x, y and z of the odometry's frame, in metres per kDriftWayM of way.
inline constexpr double kDriftWayM = 10.0;
inline constexpr int kDriftDimension = 4;

/// What a motion's translation [m] has too much per unit of the drift: for a measured motion m of the
/// odometry, `m.translation() - DriftJacobian(...) * drift` is the one without it.
/// @param T_from_to_measured  Motion of the lidar as the odometry has it, in the frame where it begins [m].
/// @param R_odom_from         Attitude there in the odometry's own frame.
/// @return  Shape (3, 4): scale [m], then sliding along x, y, z, each per kDriftWayM of way.
Eigen::Matrix<double, 3, kDriftDimension> DriftJacobian(const Eigen::Isometry3d& T_from_to_measured,
                                                        const Eigen::Matrix3d& R_odom_from);

/// Relative motion between two poses as a drifting odometry measures it: a BetweenFactor on the
/// motion without the drift.
class DriftingMotionFactor final
    : public TypedFactor<Eigen::Isometry3d, Eigen::Isometry3d, PointN> {
 public:
  /// @param T_from_to    Measured motion, drift included.
  /// @param R_odom_from  Attitude of the odometry where the motion begins.
  /// @param noise        Of what is left, in the right tangent [omega; rho], dimension 6.
  /// @throws std::invalid_argument if something is not finite or the dimension is not 6.
  DriftingMotionFactor(Key from,
                       Key to,
                       Key drift,
                       const Eigen::Isometry3d& T_from_to,
                       const Eigen::Matrix3d& R_odom_from,
                       const NoiseModel& noise);

  /// The measured motion without a drift.
  Eigen::Isometry3d Without(const PointN& drift) const;
  void Evaluate(const Value* const* values, double* residual, double* jacobian) const override;

 private:
  const char* Kind() const override { return "drifting motion"; }

  Eigen::Isometry3d T_from_to_;
  Eigen::Matrix<double, 3, kDriftDimension> J_drift_;
};

/// How a drift changes over a piece of way: a Gauss-Markov process, `r = later - keep * earlier`,
/// shape (4).
class DriftChangeFactor final : public TypedFactor<PointN, PointN> {
 public:
  /// @param keep   What is left of each coordinate after the way, in [0, 1].
  /// @param noise  Dimension 4.
  /// @throws std::invalid_argument if the dimension differs or a share is not in [0, 1].
  DriftChangeFactor(Key earlier, Key later, const Eigen::Vector4d& keep, const NoiseModel& noise);
  void Evaluate(const Value* const* values, double* residual, double* jacobian) const override;

 private:
  const char* Kind() const override { return "change of drift"; }

  Eigen::Vector4d keep_;
};

}  // namespace dendro
