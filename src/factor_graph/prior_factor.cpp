#include "dendro_slam/factor_graph/prior_factor.h"

#include <stdexcept>

namespace dendro {

template <class T>
PriorFactor<T>::PriorFactor(Key key, const T& mean, const NoiseModel& noise)
    : TypedFactor<T>(noise, key), mean_(mean) {
  const Value value = mean;
  if (!IsValid(value)) {
    throw std::invalid_argument("prior of " + KeyName(key) + ": the mean is not a valid value");
  }
  if (noise.dimension() != TangentDimension(value)) {
    throw std::invalid_argument("prior of " + KeyName(key) + ": the noise has dimension " +
                                std::to_string(noise.dimension()) + ", the variable " +
                                std::to_string(TangentDimension(value)));
  }
}

template <class T>
void PriorFactor<T>::Evaluate(const Value* const* values, double* residual, double* jacobian) const {
  const Value mean = mean_;
  LocalCoordinates(mean, *values[0], residual);
  if (jacobian != nullptr) LocalCoordinatesJacobian(mean, *values[0], jacobian);
}

template class PriorFactor<Eigen::Isometry3d>;
template class PriorFactor<Cylinder>;
template class PriorFactor<Eigen::Vector3d>;
template class PriorFactor<PointN>;

}  // namespace dendro
