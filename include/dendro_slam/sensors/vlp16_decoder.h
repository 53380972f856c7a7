#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <optional>
#include <vector>

#include "dendro_slam/sensors/vlp16_clock.h"
#include "dendro_slam/sensors/vlp16_packet.h"

namespace dendro {

/// One firing as decoded. `raw.last` is filled in last and dual mode, `raw.strongest` in strongest
/// and dual mode; where a laser saw one return only, dual mode sends it in both.
struct Vlp16Firing {
  RawFiring raw;                ///< Azimuth in [0, 360), absolute stamp.
  std::int64_t sensor_ns = 0;   ///< Same moment in the sensor's own clock, hours unwrapped [ns].
  double rate_deg_per_s = 0.0;  ///< Speed of the head around this firing.
  ReturnMode mode = ReturnMode::kStrongest;
  bool starts_block = true;     ///< Its azimuth was measured; a block's second is interpolated.
};

/// What became of the packets. Every packet given counts once in `packets` and once in
/// decoded, truncated, foreign, duplicated, reordered or held.
struct Vlp16Counters {
  std::uint64_t packets = 0;
  std::uint64_t decoded = 0;
  std::uint64_t truncated = 0;   ///< Shorter than their kind.
  std::uint64_t foreign = 0;     ///< Not of a VLP-16: size, flags, mode, model or timing.
  std::uint64_t duplicated = 0;  ///< Timestamp seen already.
  std::uint64_t reordered = 0;   ///< Came after a later one: dropped, its sweep has moved on.
  std::uint64_t held = 0;        ///< Waits for the next packet to show whether it is a VLP-16's.
  std::uint64_t lost = 0;        ///< Missing between the timestamps of two packets.
  std::uint64_t bad_blocks = 0;  ///< Blocks without their flag or with an impossible azimuth.
  std::uint64_t clock_jumps = 0;  ///< The sensor's time jumped: it restarted or found its PPS.
  std::uint64_t positions = 0;      ///< Position packets decoded (not in `packets`).
  std::uint64_t bad_positions = 0;  ///< Position packets of a wrong size or with no sound sentence.
};

/// Decodes data and position packets of a VLP-16.
///
/// Never reads outside the bytes given, never throws on them, and holds at most one packet. The
/// factory byte is not trusted alone: 0x22 is a VLP-16, 0x24 (Puck Hi-Res) has other elevations
/// and is refused; any other, as 0x21 on real VLP-16 captures, is judged by the time between two
/// packets, 1327.104 us (663.552 us in dual mode), which no other model has.
class Vlp16Decoder {
 public:
  enum class Status {
    kDecoded,
    kHeld,        ///< Model not yet known; comes with the next packet.
    kTruncated,
    kForeign,
    kDuplicated,
    kReordered
  };

  /// @throws std::invalid_argument naming the field.
  explicit Vlp16Decoder(const Vlp16ClockConfig& clock = Vlp16ClockConfig());

  /// Decodes a data packet.
  /// @param data, size  UDP payload.
  /// @param host_ns     When it was received [ns].
  /// @param firings     Its firings are appended, in order.
  Status DecodeData(const std::uint8_t* data,
                    std::size_t size,
                    std::int64_t host_ns,
                    std::vector<Vlp16Firing>& firings);

  /// Decodes a position packet.
  /// @return  The fix with its stamp, valid or not, when the packet holds a sound RMC sentence.
  std::optional<GnssFix> DecodePosition(const std::uint8_t* data,
                                        std::size_t size,
                                        std::int64_t host_ns);

  /// Forgets clock and order of the packets (the source began anew), keeps the counters.
  void Reset();

  const Vlp16Counters& counters() const { return counters_; }
  /// The factory byte of a source that was accepted by its timing although it is not 0x22.
  std::optional<std::uint8_t> odd_factory_byte() const { return odd_factory_byte_; }
  bool gps_locked() const { return clock_.gps_locked(); }

 private:
  struct Header {
    std::uint32_t time_of_hour_us;
    ReturnMode mode;
    std::uint8_t factory;
  };
  void Unpack(const std::uint8_t* data,
              const Header& header,
              std::int64_t host_ns,
              std::vector<Vlp16Firing>& firings);
  /// @return  kDecoded when the packet is next in order.
  Status CheckOrder(const Header& header);

  Vlp16Clock clock_;
  Vlp16Counters counters_;
  std::optional<std::uint8_t> odd_factory_byte_;

  std::vector<std::uint8_t> held_;  ///< Empty, or one packet of an unjudged model.
  std::int64_t held_host_ns_ = 0;

  std::deque<std::uint32_t> recent_us_;  ///< Timestamps of the last packets, newest at the back.
};

/// Reads a position packet.
/// @return  Nothing when the size is wrong.
std::optional<PositionPacket> ParsePositionPacket(const std::uint8_t* data, std::size_t size);

/// Reads an RMC sentence of any talker ("$GPRMC,...*hh").
/// @return  Nothing when its checksum, its fields or its date are wrong.
std::optional<GnssFix> ParseRmc(const std::string& sentence);

}  // namespace dendro
