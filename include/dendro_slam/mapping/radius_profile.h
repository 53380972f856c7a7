#pragma once

#include <vector>

#include "dendro_slam/mapping/landmark.h"

namespace dendro {

/// Settings of RadiusProfile.
struct RadiusProfileConfig {
  double knot_spacing_m = 0.25;     ///< Distance of the knots along the axis [m]. > 0.
  int direction_bins = 18;          ///< Viewing directions around the axis told apart. 1 to 36.
  double bin_sigma_rel = 0.009;     ///< Error that scans from one direction and distance share, as a
                                    ///< part of the radius. >= 0.
  double bin_sigma_m = 0.0004;      ///< The same, absolute [m]. >= 0.
  double common_sigma_rel = 0.001;  ///< Error that all scans share, as a part of the radius. >= 0.
  double common_sigma_m = 0.0002;      ///< The same, absolute [m]. >= 0.
  double outlier_sigma = 3.0;       ///< Observations farther from the profile lose weight. > 0.

  /// @throws std::invalid_argument naming the field.
  void Validate() const;

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("knot_spacing_m", knot_spacing_m);
    v("direction_bins", direction_bins);
    v("bin_sigma_rel", bin_sigma_rel);
    v("bin_sigma_m", bin_sigma_m);
    v("common_sigma_rel", common_sigma_rel);
    v("common_sigma_m", common_sigma_m);
    v("outlier_sigma", outlier_sigma);
  }
};

/// Radius of a landmark as a function along its axis.
///
/// A knot per `knot_spacing_m`, each a robust mean of the observations that cover it. Scans from
/// one side share their errors (the beam's footprint, the same occlusion), so the knot keeps a sum
/// per viewing direction and distance, and the variance of such a sum stops at `bin_sigma`: a
/// thousand scans from one side are worth a few, scans from all around keep improving. What every
/// scan shares (the lidar's scale) stops the whole at `common_sigma_rel`.
///
/// Positions are along the landmark's axis from its anchor. State is plain data, for files.
class RadiusProfile {
 public:
  static constexpr int kDistanceBins = 4;  ///< Below 3 m, 6 m, 12 m, and farther.

  /// Sums of the observations of one knot from one direction and distance.
  struct Bin {
    int index = 0;              ///< direction * kDistanceBins + distance.
    double weight = 0.0;        ///< Sum of 1 / sigma^2 [1/m^2].
    double weighted_radius = 0.0;  ///< Sum of radius / sigma^2 [1/m].
    int num_scans = 0;
  };
  struct Knot {
    int index = 0;              ///< At index * knot_spacing_m.
    std::vector<Bin> bins;      ///< Ascending in index.
    int num_scans = 0;
  };

  /// One fitted cylinder as the profile takes it.
  struct Observation {
    double s_start_m = 0.0;     ///< Ends along the axis.
    double s_end_m = 0.0;
    double s_anchor_m = 0.0;    ///< Where radius_m holds.
    double radius_m = 0.0;
    double radius_sigma_m = 0.0;
    double taper_m_per_m = 0.0;        ///< Along the landmark's axis.
    double taper_sigma_m_per_m = 0.0;
    double view_angle_rad = 0.0;       ///< Of the direction to the sensor, around the axis.
    double distance_m = 0.0;
  };

  /// Adds an observation to every knot that it covers (the nearest one if it covers none).
  void Add(const Observation& observation, const RadiusProfileConfig& config);

  /// The profile as knots with honest sigmas, ascending; empty when nothing was observed.
  std::vector<RadiusKnot> Knots(const RadiusProfileConfig& config) const;

  /// Adds the sums of another landmark's profile.
  /// @param offset_m   Position of the other's anchor along this axis.
  /// @param same_sign  False: the other's axis points the other way.
  /// @param turn_rad   Angle to add to the other's view angles.
  void Merge(const RadiusProfile& other,
             double offset_m,
             bool same_sign,
             double turn_rad,
             const RadiusProfileConfig& config);

  /// Keeps the knots from s_begin to s_end.
  void Crop(double s_begin_m, double s_end_m, const RadiusProfileConfig& config);

  const std::vector<Knot>& knots() const { return knots_; }
  void set_knots(std::vector<Knot> knots) { knots_ = std::move(knots); }

 private:
  std::vector<Knot> knots_;  // ascending in index
};

}  // namespace dendro
