#pragma once

#include <cmath>

namespace dendro::internal {

/// The coefficient c of `W^2` in the inverse Jacobians of SO(3), `I -+ W / 2 + c W^2`:
/// `(1 - x cot x) / theta^2` with `x = theta / 2`. The series is exact to rounding below 0.2 rad.
inline double InverseJacobianCoefficient(double theta2) {
  if (theta2 < 0.04) {
    return 1.0 / 12.0 +
           theta2 * (1.0 / 720.0 +
                     theta2 * (1.0 / 30240.0 + theta2 * (1.0 / 1209600.0 + theta2 / 47900160.0)));
  }
  const double theta = std::sqrt(theta2);
  return 1.0 / theta2 - 0.5 / (theta * std::tan(0.5 * theta));
}

}  // namespace dendro::internal
