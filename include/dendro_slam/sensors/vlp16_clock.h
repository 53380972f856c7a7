#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "dendro_slam/sensors/vlp16_packet.h"

namespace dendro {

struct Vlp16ClockConfig {
  std::string clock = "host";  ///< "host": stamps in the clock of the computer (or capture) that
                               ///< received the packets; "gps": the sensor's own time, which a
                               ///< GNSS receiver with PPS disciplines to UTC.
  double max_drift_ppm = 100.0;  ///< How fast the sensor's clock may run off the host's, [1e-6].

  void Validate() const;
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("clock", clock);
    v("max_drift_ppm", max_drift_ppm);
  }
};

/// Makes absolute stamps of the sensor's microseconds past the hour.
///
/// `host`: a packet arrives at least as long after its first firing as the packet lasts, so the
/// smallest difference between arrival and sensor time is the best offset; it may grow again by
/// the drift. `gps`: the hour is the one that brings the stamp nearest to the last valid fix whose
/// PPS was locked, or to the host's clock before there is one.
class Vlp16Clock {
 public:
  /// @throws std::invalid_argument naming the field.
  explicit Vlp16Clock(const Vlp16ClockConfig& config = Vlp16ClockConfig());

  /// Continues the time of the hour of the next data packet across its wrap.
  /// @return  Sensor time [ns], equal to the time of the hour plus whole hours.
  std::int64_t Unwrap(std::uint32_t time_of_hour_us);

  /// Absolute stamp of a sensor time, and learns from the packet's arrival.
  /// @param sensor_ns    Unwrapped time of the packet's first firing [ns].
  /// @param host_ns      Arrival in the host's clock [ns].
  /// @param duration_ns  How long the packet's firings last [ns].
  std::int64_t StampNs(std::int64_t sensor_ns, std::int64_t host_ns, std::int64_t duration_ns);

  /// Absolute stamp of a position packet; learns the hour from its fix (gps clock). Does not
  /// disturb the order of the data packets.
  std::int64_t OnPosition(const PositionPacket& packet, std::int64_t host_ns);

  /// Forgets everything: the host's clock jumped, or the sensor restarted.
  void Reset();

  /// True once a locked, valid fix has set the hour (gps clock only).
  bool gps_locked() const { return gps_locked_; }

 private:
  /// The sensor time nearest to the last one.
  std::int64_t Nearest(std::uint32_t time_of_hour_us) const;

  Vlp16ClockConfig config_;
  bool gps_;
  std::optional<std::int64_t> last_sensor_ns_;
  std::optional<std::int64_t> offset_ns_;  ///< Stamp minus sensor time.
  std::int64_t offset_host_ns_ = 0;        ///< When it was last updated.
  bool gps_locked_ = false;
};

}  // namespace dendro
