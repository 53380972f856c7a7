#pragma once

#include <Eigen/Core>

#include "dendro_slam/geometry/cylinder.h"

namespace dendro::internal {

/// Cylinder::LocalCoordinates with its derivatives with respect to the other cylinder's axis and
/// anchor as they move in space.
struct CylinderLocal {
  Vector5d delta;
  Eigen::Vector3d axis;                   ///< The other axis, turned to agree with the reference's.
  Eigen::Matrix<double, 4, 3> J_axis;     ///< Rows axis, normal by d(axis above).
  Eigen::Matrix<double, 2, 3> J_point;    ///< Rows normal by d(point).
};

CylinderLocal LocalWithDerivatives(const Cylinder& reference, const Cylinder& other);

}  // namespace dendro::internal
