#include <sys/mman.h>
#include <unistd.h>

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <string>

#include "dendro_slam/sensors/capture_reader.h"

// Fuzz target: the input is a capture file (pcap or pcapng), read through to its scans and fixes.
// The file lives in memory, so an input costs no disk access.

namespace {

void Require(bool condition) {
  if (!condition) std::abort();
}

// A file without a place on any disk, and a path to it.
class MemoryFile {
 public:
  MemoryFile() : fd_(memfd_create("capture", 0)), path_("/proc/self/fd/" + std::to_string(fd_)) {
    Require(fd_ >= 0);
  }
  const std::string& Hold(const std::uint8_t* data, std::size_t size) {
    Require(ftruncate(fd_, 0) == 0);
    Require(pwrite(fd_, data, size, 0) == static_cast<ssize_t>(size));
    return path_;
  }

 private:
  int fd_;
  std::string path_;
};

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  static MemoryFile file;
  try {
    dendro::CaptureReader reader(file.Hold(data, size));
    dendro::CaptureStep step;
    while (reader.Next(step)) {
      Require(step.packet.payload.size() <= size);
      for (const dendro::LidarScan& scan : step.scans) {
        for (const dendro::LidarPoint& p : scan.points) {
          Require(std::isfinite(p.position.x()) && std::isfinite(p.position.y()) &&
                  std::isfinite(p.position.z()) && p.ring < dendro::vlp16::kLasers);
        }
      }
      if (step.fix) {
        Require(std::abs(step.fix->latitude_deg) <= 90.0 &&
                std::abs(step.fix->longitude_deg) <= 180.0);
      }
    }
    const dendro::Vlp16Counters& c = reader.decoder().counters();
    Require(c.decoded + c.truncated + c.foreign + c.duplicated + c.reordered + c.held == c.packets);
  } catch (const dendro::PcapError&) {
    // What a damaged file is answered with.
  }
  return 0;
}
