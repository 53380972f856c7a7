#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "dendro_slam/odometry/relative_motion.h"

namespace dendro {

/// A GNSS fix, WGS 84.
struct GeoFix {
  std::int64_t stamp_ns = 0;    ///< In the clock of the scans [ns].
  double latitude_deg = 0.0;    ///< North positive.
  double longitude_deg = 0.0;   ///< East positive.
  std::optional<double> altitude_m;  ///< Above the ellipsoid [m]; a GPRMC sentence has none.
  /// Standard deviation of each horizontal axis and of the altitude [m]; absent when the receiver does
  /// not say.
  std::optional<double> horizontal_sigma_m;
  std::optional<double> vertical_sigma_m;
};

/// A place on the earth, WGS 84.
struct GeoPosition {
  double latitude_deg = 0.0;
  double longitude_deg = 0.0;
  std::optional<double> altitude_m;  ///< Above the ellipsoid [m].
};

/// Where the map lies on the earth: approximate, as good as the fixes of a walk are.
struct Georeference {
  GeoPosition origin;            ///< Of the map's origin.
  /// Of the map's x axis, clockwise from true north, [0, 360) [deg]; absent when the walk was too short
  /// to tell it. Then a point of the map is within its distance from `pivot` of where it is put.
  std::optional<double> heading_deg;
  double heading_sigma_deg = 180.0;
  double horizontal_sigma_m = 0.0;  ///< Of each horizontal axis, at the pivot [m].
  double vertical_sigma_m = 0.0;    ///< Of the origin's altitude, when there is one [m].
  Eigen::Vector2d pivot = Eigen::Vector2d::Zero();  ///< Mean of the fixes' places in the map [m]: known best.
  int num_fixes = 0;             ///< Used.
  int num_outliers = 0;          ///< Of them, contradicted by the rest.
  double residual_m = 0.0;       ///< RMS distance of the others from the walk [m].
  double span_m = 0.0;           ///< Extent of the walk while there were fixes (RMS about the pivot) [m].
  std::string note;              ///< What is not known and why, in words; empty when all is known.

  /// Place of a point of the map [m]. Without a heading the pivot's.
  GeoPosition Locate(const Eigen::Vector3d& p_map) const;
  /// Standard deviation of each horizontal axis there: the pivot's, and the heading's with the distance
  /// from it [m].
  double HorizontalSigma(const Eigen::Vector3d& p_map) const;
};

struct GeoreferencerConfig {
  double default_sigma_m = 3.0;   ///< Of a fix whose receiver does not say, each horizontal axis [m]. > 0.
  double min_sigma_m = 0.01;      ///< Receivers that promise more are not believed [m]. > 0.
  double correlation_s = 20.0;    ///< A receiver's error lasts: all fixes from this long before to as long
                                  ///< after count as one [s]. > 0.
  double max_heading_sigma_deg = 10.0;  ///< A heading less sure than this is not given [deg]. > 0.
  int min_fixes = 3;              ///< Fewer give no georeference. >= 1.
  double antenna_x_m = 0.0;       ///< Antenna in the lidar's frame [m].
  double antenna_y_m = 0.0;       ///< Antenna in the lidar's frame [m].
  double antenna_z_m = 0.0;       ///< Antenna in the lidar's frame [m].

  /// @throws std::invalid_argument naming the field.
  void Validate() const;
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("default_sigma_m", default_sigma_m);
    v("min_sigma_m", min_sigma_m);
    v("correlation_s", correlation_s);
    v("max_heading_sigma_deg", max_heading_sigma_deg);
    v("min_fixes", min_fixes);
    v("antenna_x_m", antenna_x_m);
    v("antenna_y_m", antenna_y_m);
    v("antenna_z_m", antenna_z_m);
  }
};

/// Lays the walk over its GNSS fixes.
///
/// The map stands upright, so three unknowns remain in the plane, heading and position, with the map's
/// own scale: `min sum w_i |e_i - (R(psi) p_i + t)|^2`, p_i the antenna in the map at the fix' stamp,
/// e_i the fix in a local tangent plane (east, north). Solved by iteratively reweighted least squares
/// with Cauchy weights, from the best of 72 headings, so that single fixes far off have no say. The
/// covariance is scaled by the residuals and by the correlation of neighbouring fixes. The altitude is
/// the weighted mean difference of those fixes that have one.
class Georeferencer {
 public:
  /// @throws std::invalid_argument naming the field.
  explicit Georeferencer(const GeoreferencerConfig& config = GeoreferencerConfig());

  /// Adds a fix; stamps ascend.
  /// @return  False for one that is not on the earth, not finite, or not later than the one before.
  bool Add(const GeoFix& fix);

  /// Lays the walk over the fixes.
  /// @param trajectory  T_map_lidar, ascending stamps.
  /// @return  Nothing when fewer than `min_fixes` fixes lie within the trajectory's time.
  std::optional<Georeference> Solve(const std::vector<StampedPose>& trajectory) const;

  std::size_t num_fixes() const { return fixes_.size(); }
  void Clear() { fixes_.clear(); }

 private:
  GeoreferencerConfig config_;
  std::vector<GeoFix> fixes_;
};

}  // namespace dendro
