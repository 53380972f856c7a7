#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>

#include "dendro_slam/sensors/vlp16_model.h"

/// What travels in the packets of a VLP-16 (user manual 63-9243, chapter 9).
namespace dendro {

/// Byte 1204 of a data packet.
enum class ReturnMode : std::uint8_t { kStrongest = 0x37, kLast = 0x38, kDual = 0x39 };

namespace vlp16 {

constexpr std::size_t kDataPacketBytes = 1206;
constexpr std::size_t kPositionPacketBytes = 512;
constexpr std::uint16_t kDataPort = 2368;
constexpr std::uint16_t kPositionPort = 8308;
constexpr int kBlocks = 12;              ///< Data blocks in a packet, two firings each.
constexpr std::uint8_t kFactoryByte = 0x22;  ///< Byte 1205: Puck and Puck LITE.
constexpr std::int64_t kHourNs = 3600LL * 1000000000LL;

/// Firings in one data packet: 24, or 12 in dual mode, where each is sent twice.
constexpr int FiringsPerPacket(ReturnMode mode) { return mode == ReturnMode::kDual ? 12 : 24; }
/// Time between two packets [s]: 1.327 ms, or 0.664 ms in dual mode.
constexpr double PacketPeriodS(ReturnMode mode) { return FiringsPerPacket(mode) * kFiringPeriodS; }

}  // namespace vlp16

/// One return as the sensor measures it, before it is packed.
struct RawReturn {
  float range_m = 0.0F;           ///< Along the beam [m]; 0 where nothing came back.
  std::uint8_t reflectivity = 0;  ///< Calibrated reflectivity, 0 to 255.
};

/// One firing sequence of a VLP-16: all 16 lasers, by laser number (firing order, not ring).
struct RawFiring {
  std::int64_t stamp_ns = 0;  ///< Start of the firing (laser 0 fires) [ns].
  double azimuth_deg = 0.0;   ///< Azimuth of the head at that time [deg], any revolution.
  std::array<RawReturn, vlp16::kLasers> strongest;  ///< Strongest return of each laser.
  std::array<RawReturn, vlp16::kLasers> last;       ///< Farthest return of each laser.
};

/// A position fix from the receiver beside the sensor. GPRMC has no height.
struct GnssFix {
  std::int64_t stamp_ns = 0;   ///< In the clock of the scans [ns].
  std::int64_t utc_ns = 0;     ///< Time of the fix since 1970, UTC, as the receiver says [ns].
  bool valid = false;          ///< The receiver's status is A.
  double latitude_deg = 0.0;   ///< North positive, WGS 84.
  double longitude_deg = 0.0;  ///< East positive.
  double speed_mps = 0.0;      ///< Over ground; 0 where the sentence has none.
  double course_deg = 0.0;     ///< Clockwise from true north; 0 where the sentence has none.
};

/// State of the pulse per second, byte 202 of a position packet.
enum class PpsStatus : std::uint8_t { kAbsent = 0, kSynchronizing = 1, kLocked = 2, kError = 3 };

/// Content of a position packet.
struct PositionPacket {
  std::uint32_t time_of_hour_us = 0;  ///< The sensor's clock when it was sent [us].
  PpsStatus pps = PpsStatus::kAbsent;
  std::string sentence;               ///< NMEA sentence as received, without its line end.
  std::optional<GnssFix> fix;  ///< From a sound RMC sentence; stamp_ns is 0 here.
};

}  // namespace dendro
