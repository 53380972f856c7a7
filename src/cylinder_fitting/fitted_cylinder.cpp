#include "dendro_slam/cylinder_fitting/fitted_cylinder.h"

#include <cmath>

namespace dendro {

const char* ToString(FitStatus status) {
  switch (status) {
    case FitStatus::kMeasured:
      return "MEASURED";
    case FitStatus::kUnresolved:
      return "UNRESOLVED";
    case FitStatus::kInferred:
      return "INFERRED";
  }
  return "UNRESOLVED";
}

const char* ToString(UnresolvedReason reason) {
  switch (reason) {
    case UnresolvedReason::kNone:
      return "";
    case UnresolvedReason::kTooFewPoints:
      return "too few points";
    case UnresolvedReason::kTooFewRings:
      return "too few rings";
    case UnresolvedReason::kNonFinite:
      return "non-finite input";
    case UnresolvedReason::kArcTooSmall:
      return "too little of the surface seen";
    case UnresolvedReason::kNotACylinder:
      return "not a cylinder";
    case UnresolvedReason::kRadiusOutOfRange:
      return "radius out of range";
    case UnresolvedReason::kUncertain:
      return "too uncertain";
    case UnresolvedReason::kNotConverged:
      return "fit did not converge";
  }
  return "";
}

double FittedCylinder::radius_sigma_m() const {
  const double r = cylinder.radius();
  return std::sqrt(covariance(4, 4)) * r * r;
}

}  // namespace dendro
