#include "dendro_slam/mapping/landmark.h"

namespace dendro {

namespace {

// Linear interpolation of one field of the profile, constant beyond its ends.
double Interpolate(const std::vector<RadiusKnot>& profile, double s, double RadiusKnot::*field) {
  if (profile.empty()) return 0.0;
  if (s <= profile.front().s_m) return profile.front().*field;
  for (std::size_t i = 1; i < profile.size(); ++i) {
    if (s > profile[i].s_m) continue;
    const double span = profile[i].s_m - profile[i - 1].s_m;
    const double f = span > 0.0 ? (s - profile[i - 1].s_m) / span : 1.0;
    return (1.0 - f) * (profile[i - 1].*field) + f * (profile[i].*field);
  }
  return profile.back().*field;
}

}  // namespace

double Landmark::RadiusAt(double s_m) const { return Interpolate(profile, s_m, &RadiusKnot::radius_m); }

double Landmark::RadiusSigmaAt(double s_m) const {
  return Interpolate(profile, s_m, &RadiusKnot::radius_sigma_m);
}

}  // namespace dendro
