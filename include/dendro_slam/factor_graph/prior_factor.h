#pragma once

#include "dendro_slam/factor_graph/factor.h"

namespace dendro {

/// Prior on one variable: `r = LocalCoordinates(mean, x)` (for a pose `Log(mean^-1 T)`).
/// T is Eigen::Isometry3d, Cylinder, Eigen::Vector3d or PointN.
template <class T>
class PriorFactor final : public TypedFactor<T> {
 public:
  /// @param noise  Of the tangent vector, dimension of T.
  /// @throws std::invalid_argument if the mean is not finite or the dimensions differ.
  PriorFactor(Key key, const T& mean, const NoiseModel& noise);

  const T& mean() const { return mean_; }
  void Evaluate(const Value* const* values, double* residual, double* jacobian) const override;

 private:
  const char* Kind() const override { return "prior"; }

  T mean_;
};

using PosePrior = PriorFactor<Eigen::Isometry3d>;
using CylinderPrior = PriorFactor<Cylinder>;
using PointPrior = PriorFactor<Eigen::Vector3d>;
using VectorPrior = PriorFactor<PointN>;

extern template class PriorFactor<Eigen::Isometry3d>;
extern template class PriorFactor<Cylinder>;
extern template class PriorFactor<Eigen::Vector3d>;
extern template class PriorFactor<PointN>;

}  // namespace dendro
