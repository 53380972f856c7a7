#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "dendro_slam/sensors/lidar_scan.h"
#include "dendro_slam/sensors/vlp16_decoder.h"

namespace dendro {

struct ScanAssemblerConfig {
  double cut_azimuth_deg = 0.0;  ///< A scan begins with the first block past it, in [0, 360).
  bool stamp_at_end = false;     ///< Stamp of the last firing instead of the first.
  std::string returns = "all";   ///< Of dual packets: "all" (both where they differ), "strongest"
                                 ///< or "last". Single packets hold what they hold.
  double min_range_m = 0.0;      ///< Nearer returns are left out [m]. >= 0.
  double max_range_m = 200.0;    ///< Farther returns are left out [m]. > min_range_m.
  double max_silence_s = 0.05;   ///< A longer gap between firings ends the scan [s]. > 0.

  void Validate() const;
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("cut_azimuth_deg", cut_azimuth_deg);
    v("stamp_at_end", stamp_at_end);
    v("returns", returns);
    v("min_range_m", min_range_m);
    v("max_range_m", max_range_m);
    v("max_silence_s", max_silence_s);
  }
};

/// Turns firings into scans: cuts at an azimuth, across the 360 degree wrap, and places each return
/// with the elevation, vertical offset, firing time and head speed of its laser. Points come in
/// firing order; the strongest return before the last. Only measured azimuths cut, never the
/// interpolated one of a block's second firing: that is how VeloView splits frames.
class ScanAssembler {
 public:
  /// @throws std::invalid_argument naming the field.
  explicit ScanAssembler(const ScanAssemblerConfig& config = ScanAssemblerConfig());

  /// Adds the next firing.
  /// @return  The scan that ended before it, if one did.
  std::optional<LidarScan> Add(const Vlp16Firing& firing);

  /// Ends the scan in progress.
  /// @return  It, if it holds any firing.
  std::optional<LidarScan> Flush();

 private:
  void AddReturn(int laser, const RawReturn& value, const Vlp16Firing& firing);

  ScanAssemblerConfig config_;
  bool has_firing_ = false;
  std::int64_t first_sensor_ns_ = 0;
  std::int64_t last_sensor_ns_ = 0;
  double last_azimuth_deg_ = 0.0;  ///< From the cut, in [0, 360).
  LidarScan scan_;
};

}  // namespace dendro
