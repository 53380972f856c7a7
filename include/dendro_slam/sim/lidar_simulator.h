#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <limits>
#include <string>
#include <vector>

#include <Eigen/Geometry>

#include "dendro_slam/sensors/lidar_scan.h"
#include "dendro_slam/sensors/vlp16_encoder.h"
#include "dendro_slam/sim/raycaster.h"

namespace dendro {

struct FlightPath;

/// Every effect of the VLP-16 that the simulator models, each with its own switch.
struct LidarSimulatorConfig {
  double rpm = 600.0;                ///< Revolutions per minute, 300 to 1200 (manual).
  std::string return_mode = "strongest";  ///< strongest, last or dual (manual, section 6.2).
  int seed = 1;                      ///< Of every random effect.

  bool enable_range_noise = true;
  double range_sigma_m = 0.01;       ///< Gaussian, along the beam [m]: the data sheet's +-3 cm at three sigma.
  double range_uniform_m = 0.0;      ///< Half-width of an even error along the beam, beside the gaussian one [m]; 0.03 with range_sigma_m 0 is the thesis' noise.

  bool enable_laser_bias = false;
  double laser_bias_sigma_m = 0.005; ///< Sigma of the constant offset of each laser [m]; real units differ by millimetres to a centimetre between lasers (Glennie et al. 2016, VLP-16 calibration).

  bool enable_quantisation = true;   ///< Ranges in steps of 2 mm, as in the packets (manual).

  bool enable_footprint = true;      ///< Off: thin rays.
  double aperture_width_m = 0.0095;  ///< Horizontal size of the beam at the sensor [m] (manual).
  double aperture_height_m = 0.0127; ///< Vertical size of the beam at the sensor [m] (manual).
  double divergence_width_rad = 0.0030;   ///< Horizontal full-angle divergence [rad] (manual).
  double divergence_height_rad = 0.0015;  ///< Vertical full-angle divergence [rad] (manual).
  int sub_rays_width = 8;            ///< Sub-rays across the beam.
  int sub_rays_height = 3;           ///< Sub-rays along the beam's height.

  /// Surfaces of one beam closer than this along the beam give one echo, whose range is their mean
  /// weighted by energy (a mixed pixel) [m]. The pulse lasts 6 ns (data sheet), 0.9 m in range; two
  /// such pulses show two peaks from 0.85 of that on (Sparrow's criterion).
  double echo_separation_m = 0.76;

  bool enable_detection_limit = true;
  /// Smallest part of the footprint that must lie on the surfaces of an echo. The sensor adapts its
  /// laser power to the scene, so near by the limit is a part of the beam and not an energy. A fifth
  /// is this project's working value, not a figure of the maker.
  double detection_fraction = 0.2;
  /// Range at which a full, perpendicular target of 10 % reflectivity is detected half of the time
  /// [m]; the echo's energy falls with the square of the range. The data sheet promises 100 m
  /// without naming a target.
  double range_10_percent_m = 60.0;
  /// Width of the transition from no return to sure return, as sigma of the logarithm of both
  /// limits; 0 makes them hard.
  double detection_softness = 0.1;

  bool enable_dropouts = true;
  double dropout_probability = 0.002;  ///< Of a return that would be there, whatever its strength.

  bool enable_intensity_noise = true;
  double intensity_sigma = 0.06;     ///< Relative, gaussian: speckle and texture.

  double min_range_m = 0.5;          ///< Nearer surfaces give no return [m] (manual: 0.5 m reliable).
  double max_range_m = 100.0;        ///< Farther surfaces give no return [m] (data sheet).

  bool record_all_beams = false;     ///< Fill SimulatedScan::beams: truth also of beams that missed.

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("rpm", rpm);
    v("return_mode", return_mode);
    v("seed", seed);
    v("enable_range_noise", enable_range_noise);
    v("range_sigma_m", range_sigma_m);
    v("range_uniform_m", range_uniform_m);
    v("enable_laser_bias", enable_laser_bias);
    v("laser_bias_sigma_m", laser_bias_sigma_m);
    v("enable_quantisation", enable_quantisation);
    v("enable_footprint", enable_footprint);
    v("aperture_width_m", aperture_width_m);
    v("aperture_height_m", aperture_height_m);
    v("divergence_width_rad", divergence_width_rad);
    v("divergence_height_rad", divergence_height_rad);
    v("sub_rays_width", sub_rays_width);
    v("sub_rays_height", sub_rays_height);
    v("echo_separation_m", echo_separation_m);
    v("enable_detection_limit", enable_detection_limit);
    v("detection_fraction", detection_fraction);
    v("range_10_percent_m", range_10_percent_m);
    v("detection_softness", detection_softness);
    v("enable_dropouts", enable_dropouts);
    v("dropout_probability", dropout_probability);
    v("enable_intensity_noise", enable_intensity_noise);
    v("intensity_sigma", intensity_sigma);
    v("min_range_m", min_range_m);
    v("max_range_m", max_range_m);
    v("record_all_beams", record_all_beams);
  }

  /// @throws std::invalid_argument  Naming the field.
  void Validate() const;
};

/// Truth of one return (or one beam).
struct PointTruth {
  SurfaceKind kind = SurfaceKind::kNone;  ///< Surface that gave most of the echo's energy.
  std::int16_t tree_id = -1;
  std::int16_t branch_id = -1;
  float thin_range_m = std::numeric_limits<float>::quiet_NaN();  ///< Noise-free range of the central
                                                                 ///< ray; NaN where it meets nothing.
};

/// One revolution, with its truth.
struct SimulatedScan {
  LidarScan scan;                       ///< In firing order, then laser order, as the driver gives it.
  std::vector<PointTruth> truth;        ///< Per point of `scan`.
  std::vector<RawFiring> firings;       ///< The same revolution for the packet encoder.
  std::vector<PointTruth> beams;        ///< Per firing and laser (16 * firings), if recorded.
  Eigen::Isometry3d T_map_lidar = Eigen::Isometry3d::Identity();  ///< At the scan's stamp.
};

/// Pose of the lidar as a function of the stamp [ns]; must be callable from several threads.
using LidarPoseFunction = std::function<Eigen::Isometry3d(std::int64_t stamp_ns)>;

/// A Velodyne VLP-16 in a scene.
///
/// Firing sequences follow each other every 55.296 us from `start_stamp_ns` on, where the azimuth is
/// zero; a scan is one revolution, cut where the azimuth passes zero. Each firing is cast from the
/// pose of its own time, so a moving sensor gives the sweep its distortion. The beam is a rectangle
/// of sub-rays; their hits are grouped into echoes, weighted by reflectivity, incidence and 1/range^2.
/// Random numbers are a function of (seed, firing, laser): the same bytes whatever the order of calls
/// and the number of threads. Const and thread-safe.
class LidarSimulator {
 public:
  /// @param raycaster  Must outlive this object.
  /// @throws std::invalid_argument  From LidarSimulatorConfig::Validate.
  LidarSimulator(const Raycaster& raycaster,
                 const LidarSimulatorConfig& config,
                 std::int64_t start_stamp_ns = 0);

  /// Revolution number `scan_index` (from 0).
  SimulatedScan SimulateScan(int scan_index, const LidarPoseFunction& T_map_lidar) const;

  /// A revolution from a sensor that stands still.
  SimulatedScan SimulateScan(int scan_index, const Eigen::Isometry3d& T_map_lidar) const;

  /// Stamp of the first firing of a revolution [ns].
  std::int64_t ScanStamp(int scan_index) const;

  /// Number of whole revolutions in a duration.
  int NumScans(double duration_s) const;

  const LidarSimulatorConfig& config() const { return config_; }

 private:
  std::int64_t FirstFiring(int scan_index) const;

  const Raycaster& raycaster_;
  LidarSimulatorConfig config_;
  std::int64_t start_stamp_ns_;
  std::array<double, 16> laser_bias_m_{};
};

/// Simulates the whole flight, several scans at a time, and hands the scans over in order.
/// @param threads   At least 1; the result does not depend on it.
/// @param consumer  Called once per scan from the calling thread, in order; false stops.
void SimulateFlight(const LidarSimulator& simulator,
                    const FlightPath& path,
                    int threads,
                    const std::function<bool(int scan_index, const SimulatedScan& scan)>& consumer);

}  // namespace dendro
