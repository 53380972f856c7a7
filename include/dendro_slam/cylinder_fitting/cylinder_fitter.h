#pragma once

#include <optional>
#include <vector>

#include "dendro_slam/branch_separation/segment.h"
#include "dendro_slam/cylinder_fitting/fitted_cylinder.h"
#include "dendro_slam/range_image/range_image.h"

namespace dendro {

/// Settings of stage 3. The beam defaults are the VLP-16's data sheet.
struct CylinderFitterConfig {
  bool marshall_only = false;  ///< Stop after the thesis' fit (eq. 4.2, corrected); for comparison.

  int min_points = 8;          ///< Fewer returns: UNRESOLVED. >= 6.
  int min_rings = 3;           ///< Fewer rings on wood thicker than a twig: UNRESOLVED. >= 2.
  double twig_radius_m = 0.03; ///< Wood up to this radius needs two rings: its silhouettes tell it [m]. >= 0.
  double min_radius_m = 0.003; ///< Thinner: UNRESOLVED [m]. > 0.
  double max_radius_m = 0.8;   ///< Thicker: UNRESOLVED [m]. > min_radius_m.
  double min_visible_arc_deg = 60.0;       ///< Less surface seen: UNRESOLVED [deg]. > 0.
  double max_radius_sigma_ratio = 0.4;     ///< Largest sigma_r / r of a measurement. > 0.
  double max_axis_sigma_deg = 12.0;        ///< Largest sigma of the axis direction [deg]. > 0.
  double max_residual_sigma_m = 0.024;     ///< More scatter along the beam: not a cylinder [m]. > 0.

  double range_sigma_m = 0.012;       ///< Expected range noise [m]. > 0.
  double range_sigma_weight = 8.0;    ///< Worth of that expectation, in returns. >= 0.
  double taper_sigma_m_per_m = 0.02;  ///< Prior of dr/ds [m/m]. > 0.
  double bend_sigma_per_m = 0.15;     ///< Prior of the axis' curvature, in each direction [1/m]. > 0.

  double beam_exit_horizontal_m = 0.0095;      ///< Width of the beam as it leaves [m]. >= 0.
  double beam_exit_vertical_m = 0.0127;        ///< Height of the beam as it leaves [m]. >= 0.
  double beam_divergence_horizontal_rad = 3.0e-3;  ///< Full divergence in azimuth [rad]. >= 0.
  double beam_divergence_vertical_rad = 1.5e-3;    ///< Full divergence in elevation [rad]. >= 0.
  double detection_fraction = 0.2;  ///< Share of the footprint that makes a return. (0, 1).
  double echo_separation_m = 0.76;  ///< Surfaces nearer to each other give one mixed return [m]. >= 0.
  double detection_sigma = 0.025;       ///< Of detection_fraction from beam to beam: a silhouette is known to this part of the beam's width. > 0.
  double detection_bias_sigma = 0.010;  ///< Of detection_fraction, common to all edges of a segment. > 0.
  double ring_bias_sigma_m = 0.0;   ///< Offset of a laser's ranges against the others' [m]. >= 0.

  /// Error of the odometry over a revolution [m]: where one begins, the two halves of a branch are seen
  /// that far apart in time. >= 0.
  double revolution_sigma_m = 0.007;

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("marshall_only", marshall_only);
    v("min_points", min_points);
    v("min_rings", min_rings);
    v("twig_radius_m", twig_radius_m);
    v("min_radius_m", min_radius_m);
    v("max_radius_m", max_radius_m);
    v("min_visible_arc_deg", min_visible_arc_deg);
    v("max_radius_sigma_ratio", max_radius_sigma_ratio);
    v("max_axis_sigma_deg", max_axis_sigma_deg);
    v("max_residual_sigma_m", max_residual_sigma_m);
    v("range_sigma_m", range_sigma_m);
    v("range_sigma_weight", range_sigma_weight);
    v("taper_sigma_m_per_m", taper_sigma_m_per_m);
    v("bend_sigma_per_m", bend_sigma_per_m);
    v("beam_exit_horizontal_m", beam_exit_horizontal_m);
    v("beam_exit_vertical_m", beam_exit_vertical_m);
    v("beam_divergence_horizontal_rad", beam_divergence_horizontal_rad);
    v("beam_divergence_vertical_rad", beam_divergence_vertical_rad);
    v("detection_fraction", detection_fraction);
    v("echo_separation_m", echo_separation_m);
    v("detection_sigma", detection_sigma);
    v("detection_bias_sigma", detection_bias_sigma);
    v("ring_bias_sigma_m", ring_bias_sigma_m);
    v("revolution_sigma_m", revolution_sigma_m);
  }

  /// @throws std::invalid_argument naming the field that is out of its range.
  void Validate() const;
};

/// Stage 3: a cylinder (with taper, ends and a calibrated covariance) for every segment.
///
/// Ring centres give the start, Ceres' Levenberg-Marquardt minimises Marshall's distance (thesis
/// eq. 4.2 with its missing `+ rho`) on five free parameters, and the result is finished with what
/// the sensor really measures: the range along the beam, averaged over the part of the footprint
/// that meets the surface, and the silhouette bracketed by the last beam that hits and the first
/// that misses. The axis may bend and the radius taper; the cylinder reported has the radius of the
/// middle and the straight line amid the bent axis. A segment that cannot hold a radius is UNRESOLVED
/// with the reason.
///
/// @note Deviates: the thesis stops at eq. 4.2, which is biased by several per cent (one-sided
///       view, noise along the beam, a footprint wider than the column spacing).
class CylinderFitter {
 public:
  explicit CylinderFitter(const CylinderFitterConfig& config = {});

  /// Fits every segment; the result has one entry per segment in the same order.
  /// @throws std::invalid_argument when a segment names a pixel outside the image.
  std::vector<FittedCylinder> Fit(const LabelledScan& scan,
                                  const std::vector<Segment>& segments) const;

  /// Fits one segment. Never throws for bad geometry: it reports UNRESOLVED and why.
  FittedCylinder FitSegment(const LabelledScan& scan, const Segment& segment) const;

  /// Where the fit of a segment starts: the axis along the centres of its rings, the radius from its
  /// width across the view. For pictures and for those who want to know what the fit moved.
  /// @return Nothing for segments that are too small to be fitted.
  /// @throws std::invalid_argument when the segment names a pixel outside the image.
  std::optional<Cylinder> Initial(const LabelledScan& scan, const Segment& segment) const;

  const CylinderFitterConfig& config() const { return config_; }

 private:
  CylinderFitterConfig config_;
};

}  // namespace dendro
