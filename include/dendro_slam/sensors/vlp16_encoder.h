#pragma once

#include <array>
#include <cstdint>

#include "dendro_slam/sensors/vlp16_model.h"

namespace dendro {

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

}  // namespace dendro
