#include <cstdio>
#include <exception>
#include <vector>

#include "dendro_slam/sensors/capture_reader.h"

// Writes every return of a capture as rows of eight doubles, for comparison with other decoders:
// scan, sensor time past the hour [s], x y z in the sensor's frame [m], intensity, laser, 0.
int main(int argc, char** argv) {
  if (argc != 3) {
    std::fprintf(stderr, "usage: vlp16_dump CAPTURE.pcap OUT.bin\n");
    return 2;
  }
  try {
    dendro::Vlp16ClockConfig clock;
    clock.clock = "gps";
    dendro::CaptureReader reader(argv[1], dendro::CaptureReaderConfig(), clock);
    std::FILE* out = std::fopen(argv[2], "wb");
    if (out == nullptr) {
      std::perror(argv[2]);
      return 1;
    }
    double scans = 0.0;
    bool ok = true;
    while (const auto scan = reader.NextScan()) {
      const double begin = dendro::NsToSeconds(scan->stamp_ns % dendro::vlp16::kHourNs);
      for (const dendro::LidarPoint& p : scan->points) {
        const double row[8] = {scans,
                               begin + static_cast<double>(p.time_s),
                               static_cast<double>(p.position.x()),
                               static_cast<double>(p.position.y()),
                               static_cast<double>(p.position.z()),
                               static_cast<double>(p.intensity),
                               static_cast<double>(dendro::vlp16::LaserOfRing(p.ring)),
                               0.0};
        ok = ok && std::fwrite(row, sizeof(row), 1, out) == 1;
      }
      scans += 1.0;
    }
    ok = std::fclose(out) == 0 && ok;
    return ok ? 0 : 1;
  } catch (const std::exception& e) {
    std::fprintf(stderr, "vlp16_dump: %s\n", e.what());
    return 1;
  }
}
