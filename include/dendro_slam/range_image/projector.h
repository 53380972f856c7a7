#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "dendro_slam/range_image/range_image.h"
#include "dendro_slam/sensors/deskew.h"
#include "dendro_slam/sensors/lidar_scan.h"

namespace dendro {

struct ProjectorConfig {
  std::string model = "vlp16";  ///< "vlp16": 16 rings with their timing and vertical offsets;
                                ///< "uniform": equal elevation steps, any number of rows.
  int rows = 16;                ///< Rings; 16 with the vlp16 model. > 0.
  int cols = 1800;              ///< Columns per revolution: 1800 at 600 rpm, 900 at 1200. >= 8.
  double rpm = 600.0;           ///< Nominal speed; used where a scan does not show its own [1/min].
  double elevation_min_deg = -15.0;  ///< Centre of row 0, uniform model only [deg].
  double elevation_max_deg = 15.0;   ///< Centre of the last row, uniform model only [deg].
  bool vertical_offsets = true;  ///< The cloud's beams start at the lasers' heights (velodyne's
                                 ///< calibration); false: all start at the origin. vlp16 only.
  bool untimed_stamp_at_end = false;  ///< A scan without times is stamped at its end, not its start.
  double min_range_m = 0.1;           ///< Nearer returns are dropped [m]. >= 0.
  double max_range_m = 150.0;         ///< Farther returns are dropped [m]. > min_range_m.

  void Validate() const;
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("model", model);
    v("rows", rows);
    v("cols", cols);
    v("rpm", rpm);
    v("elevation_min_deg", elevation_min_deg);
    v("elevation_max_deg", elevation_max_deg);
    v("vertical_offsets", vertical_offsets);
    v("untimed_stamp_at_end", untimed_stamp_at_end);
    v("min_range_m", min_range_m);
    v("max_range_m", max_range_m);
  }
};

/// What the last projection had to derive or drop.
struct ProjectionReport {
  bool ring_derived = false;  ///< The scan had no rings: taken from the elevation.
  bool time_derived = false;  ///< The scan had no times: taken from the azimuth.
  int nan_points = 0;         ///< Not finite, or at range zero: skipped.
  int out_of_image = 0;       ///< Outside the rings or the range limits: skipped.
  int hidden_points = 0;      ///< Behind a nearer return of the same pixel.
  int firings = 0;            ///< Firings with at least one return (vlp16 model).
  int filled_columns = 0;     ///< Columns that no firing met, filled from their neighbour.
  double rpm = 0.0;           ///< Speed seen in the scan's times, else the nominal one [1/min].
};

/// Organises a cloud as a range image and removes the motion of the sweep.
///
/// The rings of a VLP-16 do not fire at once and its firings (0.19907 degrees apart at 600 rpm,
/// 1808.4 a revolution) do not match columns of 0.2 degrees. Binning each return by its own azimuth
/// would tear a firing apart and, as the azimuth is noisy, leave columns empty that look like beams
/// that met nothing: false evidence for stage 3. So the vlp16 model bins whole **firings**:
///
/// 1. each return's azimuth is taken back to the start of its firing (the head's speed, seen in the
///    scan's times, times the laser's delay);
/// 2. returns within half a firing pitch are one firing, whatever the order of the cloud;
/// 3. a firing goes to the column of its mean azimuth, or to the one before where noise has stepped
///    over that by less than 0.3 columns. About 8 columns per revolution hold two firings at
///    600 rpm; there the nearer return of each pixel wins;
/// 4. a column between two consecutive firings that none of them met (the sensor turns faster than
///    the columns) repeats the nearer neighbour, returns and misses alike: `filled_columns`;
/// 5. a pixel without a return gets the beam its laser really fired: the azimuth of the column's
///    firing if any laser saw something in it, else counted on from the nearest firing.
///
/// The uniform model (other sensors, or the thesis' 32 x 360) bins each return by its own azimuth
/// and elevation; beams of missing pixels point at the pixel's centre.
///
/// Stage 1's input. One instance per thread (it keeps its work space); about 3 ms per scan.
/// @note Deviates: the thesis projects to 32 x 360 (section 4.1), which a VLP-16 cannot fill.
class Projector {
 public:
  /// @throws std::invalid_argument naming the field.
  explicit Projector(const ProjectorConfig& config = ProjectorConfig());

  /// Projects a scan.
  /// @param scan    Returns in the lidar frame at their firing times.
  /// @param motion  Motion of the sweep, or null: then points stay as measured and the image says
  ///                `deskewed = false`.
  RangeImage Project(const LidarScan& scan, const SweepMotion* motion);

  /// The same into an image whose memory is used again.
  void Project(const LidarScan& scan, const SweepMotion* motion, RangeImage& out);

  const ProjectionReport& report() const { return report_; }
  const ProjectorConfig& config() const { return config_; }

  /// Elevation of a row's beams [deg].
  double RowElevationDeg(int row) const;

 private:
  struct PointWork {
    double azimuth_deg;   ///< Of the return itself, then of its firing's start (vlp16).
    float range;          ///< From the beam's origin [m].
    std::int32_t row;     ///< -1: not projected.
    std::int32_t firing;  ///< Index into firings_.
  };
  struct Firing {
    double azimuth_deg;  ///< Unwrapped, ascending [deg].
    double time_s;       ///< Start [s].
    std::int32_t count;  ///< Returns.
    std::int32_t col;    ///< Unwrapped column.
  };
  struct Column {
    double azimuth_deg;      ///< Of the head when laser 0 fires.
    double time_s;           ///< Of that moment [s].
    std::int32_t fill_from;  ///< Column that this one repeats, or -1.
  };

  double BeamOriginZ(int row) const;
  double RowTimeS(int row) const;
  int RowOf(const LidarPoint& point, bool has_ring) const;
  void MeasurePoints(const LidarScan& scan);
  void EstimateSpeed(const LidarScan& scan);
  void DeriveTimes(const LidarScan& scan);
  void GroupFirings();
  void GroupColumns();
  void PlaceFirings();
  void CompleteColumns();
  void FillImage(const LidarScan& scan, const SweepMotion* motion, RangeImage& out);

  ProjectorConfig config_;
  bool vlp16_;
  ProjectionReport report_;
  double rate_deg_per_s_ = 0.0;
  double pitch_deg_ = 0.0;  ///< Between firings; between columns in the uniform model.
  std::vector<PointWork> work_;
  std::vector<double> time_s_;
  std::vector<std::int32_t> bins_;
  std::vector<Firing> firings_;
  std::vector<Column> columns_;
};

}  // namespace dendro
