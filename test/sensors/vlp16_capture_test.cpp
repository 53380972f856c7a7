#include <sys/stat.h>

#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include <gtest/gtest.h>

#include "dendro_slam/sensors/capture_reader.h"

// Real captures against what VeloView and MRPT made of them.
namespace dendro {
namespace {

std::string Path(const std::string& name) {
  return std::string(DENDRO_SHARED_DATA) + "/vlp16/" + name;
}

bool Exists(const std::string& path) {
  struct stat info;
  return stat(path.c_str(), &info) == 0;
}

#define SKIP_WITHOUT(path) \
  if (!Exists(path)) GTEST_SKIP() << "capture not found: " << path

std::vector<LidarScan> Scans(CaptureReader& reader) {
  std::vector<LidarScan> scans;
  while (std::optional<LidarScan> scan = reader.NextScan()) scans.push_back(std::move(*scan));
  return scans;
}

// VeloView's frame: x to the right at azimuth 90, y at azimuth 0.
Eigen::Vector3d InVeloViewFrame(const LidarPoint& point) {
  return {-point.position.y(), point.position.x(), point.position.z()};
}

TEST(VeloView90Deg, FramesAndPoints) {
  const std::string path = Path("veloview_vlp16_90deg_50frames.pcap");
  SKIP_WITHOUT(path);
  CaptureReader reader(path);
  const std::vector<LidarScan> scans = Scans(reader);
  ASSERT_EQ(scans.size(), 52U);
  EXPECT_EQ(scans[0].points.size(), 5736U);
  EXPECT_EQ(scans[2].points.size(), 13898U);
  ASSERT_EQ(scans[16].points.size(), 13860U);
  EXPECT_EQ(scans[51].points.size(), 274U);
  // VeloView 3.0 left out the vertical offset of the laser.
  const auto expect_point = [](const LidarPoint& point, const Eigen::Vector3d& expected,
                               float intensity, int laser) {
    Eigen::Vector3d p = InVeloViewFrame(point);
    p.z() -= vlp16::RingVerticalOffsetM(point.ring);
    EXPECT_LT((p - expected).norm(), 1e-3) << p.transpose();
    EXPECT_EQ(point.intensity, intensity);
    EXPECT_EQ(vlp16::LaserOfRing(point.ring), laser);
  };
  expect_point(scans[16].points.front(), {0.0801272, 6.04037, -1.61865}, 4.0F, 0);
  expect_point(scans[16].points.back(), {-0.0094354, 4.91462, 1.31687}, 29.0F, 15);

  // Its model byte says HDL-32E; the timing says VLP-16.
  EXPECT_EQ(reader.decoder().odd_factory_byte(), std::optional<std::uint8_t>(0x21));
  const Vlp16Counters& c = reader.decoder().counters();
  EXPECT_EQ(c.packets, 1902U);
  EXPECT_EQ(c.decoded, 1902U);
  EXPECT_EQ(c.foreign + c.truncated + c.duplicated + c.reordered + c.held, 0U);
  EXPECT_EQ(c.lost, 0U);
  EXPECT_EQ(c.bad_blocks, 0U);
  for (std::size_t i = 1; i + 1 < scans.size(); ++i) {
    EXPECT_NEAR(NsToSeconds(scans[i + 1].stamp_ns - scans[i].stamp_ns), 0.05, 0.003) << i;
  }
}

struct CsvPoint {
  int intensity;
  int laser;
  double azimuth_deg;
  double distance_m;
  double adjusted_us;
  double time_us;
};

// The gzipped CSV through the system's gzip.
std::vector<CsvPoint> ReadCsv(const std::string& path) {
  std::vector<CsvPoint> points;
  FILE* pipe = popen(("gzip -dc '" + path + "'").c_str(), "r");
  if (pipe == nullptr) return points;
  std::array<char, 512> line{};
  while (fgets(line.data(), static_cast<int>(line.size()), pipe) != nullptr) {
    double v[13];
    const char* at = line.data();
    int n = 0;
    for (; n < 13; ++n) {
      char* end = nullptr;
      v[n] = std::strtod(at, &end);
      if (end == at) break;
      at = *end == ',' ? end + 1 : end;
    }
    if (n < 13) continue;
    points.push_back({static_cast<int>(v[6]), static_cast<int>(v[7]), v[8] * 0.01, v[9], v[10],
                      v[11]});
  }
  pclose(pipe);
  return points;
}

TEST(GrapApple, EveryPointOfVeloView) {
  const std::string path = Path("grap_apple_20frames.pcap");
  SKIP_WITHOUT(path);
  CaptureReader reader(path);
  // All returns by laser and time of the hour.
  struct Decoded {
    double azimuth_deg;
    double distance_m;
    int intensity;
  };
  std::map<std::pair<int, std::int64_t>, Decoded> decoded;
  PcapReader pcap(path);
  Vlp16Decoder decoder;
  UdpPacket packet;
  std::vector<Vlp16Firing> firings;
  std::size_t returns = 0;
  while (pcap.Next(packet)) {
    if (packet.port != vlp16::kDataPort) continue;
    firings.clear();
    ASSERT_EQ(decoder.DecodeData(packet.payload.data(), packet.payload.size(), packet.stamp_ns,
                                 firings),
              Vlp16Decoder::Status::kDecoded);
    for (const Vlp16Firing& f : firings) {
      for (int laser = 0; laser < 16; ++laser) {
        const RawReturn& r = f.raw.strongest[static_cast<std::size_t>(laser)];
        if (r.range_m <= 0) continue;
        const double t = static_cast<double>(f.sensor_ns) + vlp16::LaserTimeS(laser) * 1e9;
        decoded[{laser, std::llround(t / 1000.0)}] = {
            vlp16::WrapAzimuthDeg(f.raw.azimuth_deg + f.rate_deg_per_s * vlp16::LaserTimeS(laser)),
            r.range_m, r.reflectivity};
        ++returns;
      }
    }
  }
  EXPECT_EQ(decoder.counters().packets, 1516U);
  EXPECT_EQ(decoded.size(), returns);
  EXPECT_FALSE(decoder.odd_factory_byte().has_value());

  for (const char* frame : {"frame_0000", "frame_0005", "frame_0010"}) {
    const std::string csv = Path(std::string("grap_apple_veloview_csv/") + frame + ".csv.gz");
    SKIP_WITHOUT(csv);
    const std::vector<CsvPoint> expected = ReadCsv(csv);
    ASSERT_GT(expected.size(), 10000U);
    double worst_azimuth = 0.0;
    double worst_time = 0.0;
    std::size_t missing = 0;
    for (const CsvPoint& point : expected) {
      // Times agree within 1 us, so at most the neighbouring microseconds hold it.
      const Decoded* found = nullptr;
      std::int64_t at = 0;
      for (const std::int64_t d : {0, -1, 1}) {
        at = std::llround(point.time_us) + d;
        const auto it = decoded.find({point.laser, at});
        if (it != decoded.end()) {
          found = &it->second;
          break;
        }
      }
      if (found == nullptr) {
        ++missing;
        continue;
      }
      EXPECT_NEAR(found->distance_m, point.distance_m, 1e-5);
      EXPECT_EQ(found->intensity, point.intensity);
      const double off = found->azimuth_deg - point.azimuth_deg;
      worst_azimuth = std::max(worst_azimuth, std::abs(off - 360.0 * std::round(off / 360.0)));
      worst_time = std::max(worst_time, std::abs(static_cast<double>(at) - point.time_us));
    }
    EXPECT_EQ(missing, 0U) << frame;
    EXPECT_LE(worst_azimuth, 0.03) << frame;
    EXPECT_LE(worst_time, 1.0) << frame;
    std::printf("%s: %zu points, azimuth within %.4f degrees, time within %.1f us\n", frame,
                expected.size(), worst_azimuth, worst_time);
    RecordProperty(std::string(frame) + "_worst_azimuth_deg", std::to_string(worst_azimuth));
  }
}

// VeloView leaves out the piece before the first cut, so its frame i is our scan i + 1.
TEST(GrapApple, ScansAreVeloViewsFrames) {
  const std::string path = Path("grap_apple_20frames.pcap");
  SKIP_WITHOUT(path);
  CaptureReader reader(path);
  const std::vector<LidarScan> scans = Scans(reader);
  ASSERT_EQ(scans.size(), 22U) << "20 revolutions and the pieces at both ends";
  for (const auto& [index, name] : std::map<std::size_t, std::string>{
           {0, "frame_0000"}, {5, "frame_0005"}, {10, "frame_0010"}}) {
    const std::string csv = Path("grap_apple_veloview_csv/" + name + ".csv.gz");
    SKIP_WITHOUT(csv);
    EXPECT_EQ(scans[index + 1].points.size(), ReadCsv(csv).size()) << name;
  }
}

TEST(GrapApple, FixesAndTheClockOfTheReceiver) {
  const std::string path = Path("grap_apple_20frames.pcap");
  SKIP_WITHOUT(path);
  Vlp16ClockConfig clock;
  clock.clock = "gps";
  CaptureReader reader(path, CaptureReaderConfig(), clock);
  CaptureStep step;
  int fixes = 0;
  std::int64_t first_scan = 0;
  while (reader.Next(step)) {
    if (!step.scans.empty() && first_scan == 0) first_scan = step.scans.front().stamp_ns;
    if (!step.fix) continue;
    ++fixes;
    EXPECT_TRUE(step.fix->valid);
    EXPECT_NEAR(step.fix->latitude_deg, 41.0 + 40.0133 / 60.0, 2e-5);
    EXPECT_NEAR(step.fix->longitude_deg, 27.4508 / 60.0, 2e-5);
    // The sentence is of the last full second or two.
    EXPECT_GT(step.fix->stamp_ns, step.fix->utc_ns);
    EXPECT_LT(step.fix->stamp_ns - step.fix->utc_ns, 2500000000LL);
  }
  EXPECT_EQ(fixes, 291);
  EXPECT_TRUE(reader.decoder().gps_locked());
  // 2018-08-01 08:03:10 UTC; the computer's clock was three seconds ahead.
  EXPECT_EQ(first_scan / 1000000000LL, 1533110590LL);
}

TEST(MrptGps, FourScansAndFixes) {
  const std::string path = Path("mrpt_vlp16_gps.pcap");
  SKIP_WITHOUT(path);
  CaptureReader reader(path);
  CaptureStep step;
  std::vector<LidarScan> scans;
  int fixes = 0;
  while (reader.Next(step)) {
    // MRPT hands out scans that a cut has ended, not the rest at the end of the file.
    if (step.is_data) {
      for (LidarScan& scan : step.scans) scans.push_back(std::move(scan));
    }
    if (!step.fix) continue;
    ++fixes;
    EXPECT_TRUE(step.fix->valid);
    EXPECT_NEAR(step.fix->latitude_deg, 36.0 + 49.7478558 / 60.0, 1e-6);
    EXPECT_NEAR(step.fix->longitude_deg, -(2.0 + 24.4542928 / 60.0), 1e-6);
    EXPECT_EQ(step.fix->utc_ns / 1000000000LL, 1453364282LL);  // 2016-01-21 08:18:02 UTC.
  }
  EXPECT_EQ(scans.size(), 4U);
  EXPECT_EQ(fixes, 57);
  EXPECT_EQ(reader.decoder().counters().decoded, 293U);
  EXPECT_EQ(reader.decoder().counters().lost, 0U);
  for (std::size_t i = 1; i < scans.size(); ++i) EXPECT_GT(scans[i].stamp_ns, scans[i - 1].stamp_ns);
}

TEST(Captures, RewindGivesTheSameScans) {
  const std::string path = Path("mrpt_vlp16_gps.pcap");
  SKIP_WITHOUT(path);
  CaptureReader reader(path);
  const std::vector<LidarScan> first = Scans(reader);
  reader.Rewind();
  const std::vector<LidarScan> second = Scans(reader);
  ASSERT_EQ(first.size(), second.size());
  for (std::size_t i = 0; i < first.size(); ++i) {
    EXPECT_EQ(first[i].stamp_ns, second[i].stamp_ns);
    ASSERT_EQ(first[i].points.size(), second[i].points.size());
  }
}

}  // namespace
}  // namespace dendro
