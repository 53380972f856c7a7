#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <vector>

#include "dendro_slam/sensors/vlp16_packet.h"

namespace dendro {

/// Packs firings as a VLP-16 does: data packets of 1206 bytes, all three return modes.
///
/// Feed every firing in order, also those without any return; the packet's single timestamp and
/// azimuths presume the steady clock of 55.296 us. Ranges are rounded to 2 mm, azimuths to 0.01
/// degrees, times to 1 us. The second firing of each block has no azimuth of its own in a packet.
/// Dual mode sends each pair of firings in two blocks, the last returns first, then the strongest.
class Vlp16Encoder {
 public:
  struct Packet {
    std::int64_t stamp_ns = 0;  ///< When the last firing of the packet is over [ns].
    std::array<std::uint8_t, vlp16::kDataPacketBytes> data{};
  };

  explicit Vlp16Encoder(ReturnMode mode, std::uint8_t factory_byte = vlp16::kFactoryByte);

  /// Adds a firing.
  /// @return  The packet that it completes, if it does.
  /// @throws std::invalid_argument when its azimuth is not finite or its stamp negative.
  std::optional<Packet> Add(const RawFiring& firing);

  /// Drops the firings of an unfinished packet.
  void Clear();

 private:
  ReturnMode mode_;
  int firings_ = 0;
  Packet packet_;
};

/// Packs a fix as the sensor forwards it: 512 bytes with a GPRMC sentence.
/// @param fix          Position; `utc_ns` gives the sentence's time and date.
/// @param stamp_ns     The sensor's clock; its time of the hour goes into the packet [ns].
/// @param pps          State of the pulse per second.
std::array<std::uint8_t, vlp16::kPositionPacketBytes> EncodePositionPacket(const GnssFix& fix,
                                                                           std::int64_t stamp_ns,
                                                                           PpsStatus pps);

}  // namespace dendro
