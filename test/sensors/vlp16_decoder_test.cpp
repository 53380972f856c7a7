#include "dendro_slam/sensors/vlp16_decoder.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "dendro_slam/sensors/capture_reader.h"
#include "dendro_slam/sensors/pcap_writer.h"
#include "dendro_slam/sensors/scan_assembler.h"
#include "dendro_slam/sensors/vlp16_encoder.h"

namespace dendro {
namespace {

constexpr std::int64_t kSecond = 1000000000LL;
// 2024-05-01 09:59:59.9 UTC: the hour wraps during the tests.
constexpr std::int64_t kStart = 1714557599LL * kSecond + 900000000LL;

std::int64_t FiringNs(int n) {
  return static_cast<std::int64_t>(std::llround(n * vlp16::kFiringPeriodS * 1e9));
}

RawFiring MakeFiring(int n, double rpm, std::mt19937& rng, double start_deg = 300.0) {
  RawFiring f;
  f.stamp_ns = kStart + FiringNs(n);
  f.azimuth_deg = start_deg + n * vlp16::FiringPitchDeg(rpm);
  std::uniform_real_distribution<float> range(0.5F, 130.0F);
  std::uniform_int_distribution<int> byte(0, 255);
  for (std::size_t laser = 0; laser < vlp16::kLasers; ++laser) {
    const int kind = byte(rng) % 4;
    if (kind == 0) continue;
    const RawReturn near{range(rng), static_cast<std::uint8_t>(byte(rng))};
    RawReturn far = near;
    if (kind > 1 && near.range_m < 100.0F) {
      far = {near.range_m + 1.0F, static_cast<std::uint8_t>(byte(rng))};
    }
    f.strongest[laser] = kind == 3 ? far : near;
    f.last[laser] = far;
  }
  return f;
}

std::vector<Vlp16Encoder::Packet> Packets(ReturnMode mode, double rpm, int count,
                                          std::vector<RawFiring>* truth = nullptr,
                                          std::uint8_t factory = vlp16::kFactoryByte) {
  std::mt19937 rng(11);
  Vlp16Encoder encoder(mode, factory);
  std::vector<Vlp16Encoder::Packet> packets;
  for (int n = 0; static_cast<int>(packets.size()) < count; ++n) {
    const RawFiring f = MakeFiring(n, rpm, rng);
    if (truth != nullptr) truth->push_back(f);
    if (const auto packet = encoder.Add(f)) packets.push_back(*packet);
  }
  return packets;
}

Vlp16Decoder::Status Decode(Vlp16Decoder& decoder, const Vlp16Encoder::Packet& packet,
                            std::vector<Vlp16Firing>& firings) {
  return decoder.DecodeData(packet.data.data(), packet.data.size(), packet.stamp_ns, firings);
}

double AngleOff(double a, double b) {
  const double d = a - b;
  return std::abs(d - 360.0 * std::round(d / 360.0));
}

TEST(Encoder, BytesByHand) {
  Vlp16Encoder encoder(ReturnMode::kStrongest);
  RawFiring f;
  f.stamp_ns = 7200LL * kSecond + 1234567LL * 1000LL;
  f.azimuth_deg = 359.999;
  f.strongest[0] = {1.0F, 50};
  f.strongest[15] = {131.07F, 255};
  f.strongest[14] = {200.0F, 9};  // Does not fit: no return.
  std::optional<Vlp16Encoder::Packet> packet;
  for (int i = 0; i < 24; ++i) {
    EXPECT_FALSE(packet.has_value());
    packet = encoder.Add(f);
  }
  ASSERT_TRUE(packet.has_value());
  const auto& d = packet->data;
  EXPECT_EQ(d[0], 0xFF);
  EXPECT_EQ(d[1], 0xEE);
  EXPECT_EQ(d[2] | d[3] << 8, 0) << "360.00 wraps to 0";
  EXPECT_EQ(d[4] | d[5] << 8, 500);
  EXPECT_EQ(d[6], 50);
  EXPECT_EQ(d[4 + 14 * 3] | d[5 + 14 * 3] << 8, 0);
  EXPECT_EQ(d[4 + 15 * 3] | d[5 + 15 * 3] << 8, 65535);
  EXPECT_EQ(d[1200] | d[1201] << 8 | d[1202] << 16, 1234567);
  EXPECT_EQ(d[1204], 0x37);
  EXPECT_EQ(d[1205], 0x22);
  RawFiring bad;
  bad.azimuth_deg = std::nan("");
  EXPECT_THROW(encoder.Add(bad), std::invalid_argument);
}

class RoundTrip : public ::testing::TestWithParam<std::tuple<ReturnMode, double>> {};

TEST_P(RoundTrip, FiringsComeBack) {
  const ReturnMode mode = std::get<0>(GetParam());
  const double rpm = std::get<1>(GetParam());
  std::vector<RawFiring> truth;
  const auto packets = Packets(mode, rpm, 400, &truth);
  Vlp16Decoder decoder;
  std::vector<Vlp16Firing> firings;
  for (const auto& packet : packets) {
    ASSERT_EQ(Decode(decoder, packet, firings), Vlp16Decoder::Status::kDecoded);
  }
  ASSERT_EQ(firings.size(), truth.size());
  double azimuth = 0.0;
  double laser_azimuth = 0.0;
  double range = 0.0;
  double time = 0.0;
  const auto compare = [&](const RawReturn& a, const RawReturn& b) {
    range = std::max(range, static_cast<double>(std::abs(a.range_m - b.range_m)));
    EXPECT_EQ(a.reflectivity, b.reflectivity);
  };
  for (std::size_t i = 0; i < truth.size(); ++i) {
    const Vlp16Firing& f = firings[i];
    azimuth = std::max(azimuth, AngleOff(f.raw.azimuth_deg, truth[i].azimuth_deg));
    laser_azimuth = std::max(
        laser_azimuth,
        AngleOff(f.raw.azimuth_deg + f.rate_deg_per_s * vlp16::LaserTimeS(15),
                 truth[i].azimuth_deg + vlp16::AzimuthRateDegPerS(rpm) * vlp16::LaserTimeS(15)));
    time = std::max(time, std::abs(static_cast<double>(f.raw.stamp_ns - truth[i].stamp_ns)));
    EXPECT_EQ(f.mode, mode);
    for (std::size_t laser = 0; laser < vlp16::kLasers; ++laser) {
      const RawReturn none;
      compare(f.raw.strongest[laser],
              mode == ReturnMode::kLast ? none : truth[i].strongest[laser]);
      compare(f.raw.last[laser], mode == ReturnMode::kStrongest ? none : truth[i].last[laser]);
    }
  }
  EXPECT_LE(range, 0.001 + 1e-5);
  EXPECT_LE(azimuth, 0.0125);
  EXPECT_LE(laser_azimuth, 0.02);
  EXPECT_LE(time, 1000.0) << "across the hour, with the host's clock";
  EXPECT_EQ(decoder.counters().lost, 0U);
  EXPECT_EQ(decoder.counters().clock_jumps, 0U);
  EXPECT_EQ(decoder.counters().bad_blocks, 0U);
}

INSTANTIATE_TEST_SUITE_P(ModesAndSpeeds, RoundTrip,
                         ::testing::Combine(::testing::Values(ReturnMode::kStrongest,
                                                              ReturnMode::kLast,
                                                              ReturnMode::kDual),
                                            ::testing::Values(300.0, 600.0, 1200.0)));

TEST(ScanAssembler, PointsAndCuts) {
  const double rpm = 600.0;
  std::vector<RawFiring> truth;
  const auto packets = Packets(ReturnMode::kDual, rpm, 480, &truth);  // 3.2 revolutions.
  ScanAssemblerConfig config;
  config.cut_azimuth_deg = 90.0;
  ScanAssembler assembler(config);
  Vlp16Decoder decoder;
  std::vector<Vlp16Firing> firings;
  for (const auto& packet : packets) Decode(decoder, packet, firings);
  std::vector<LidarScan> scans;
  for (const Vlp16Firing& f : firings) {
    if (auto scan = assembler.Add(f)) scans.push_back(*scan);
  }
  if (auto scan = assembler.Flush()) scans.push_back(*scan);
  EXPECT_FALSE(assembler.Flush().has_value());
  ASSERT_EQ(scans.size(), 4U);

  // Every true return, in order, at its place.
  std::size_t scan = 0;
  std::size_t index = 0;
  double off_m = 0.0;
  double off_deg = 0.0;
  double off_s = 0.0;
  for (const RawFiring& f : truth) {
    for (int laser = 0; laser < vlp16::kLasers; ++laser) {
      const RawReturn& a = f.strongest[static_cast<std::size_t>(laser)];
      const RawReturn& b = f.last[static_cast<std::size_t>(laser)];
      const bool two = std::lround(a.range_m * 500) != std::lround(b.range_m * 500) ||
                       a.reflectivity != b.reflectivity;
      for (int k = 0; k < 2; ++k) {
        const RawReturn& r = k == 0 ? a : b;
        if (r.range_m <= 0.0F || (k == 1 && !two)) continue;
        while (scan < scans.size() && index == scans[scan].points.size()) {
          ++scan;
          index = 0;
        }
        ASSERT_LT(scan, scans.size());
        const LidarPoint& p = scans[scan].points[index++];
        const double azimuth =
            f.azimuth_deg + vlp16::AzimuthRateDegPerS(rpm) * vlp16::LaserTimeS(laser);
        const Eigen::Vector3d from_origin =
            p.position.cast<double>() - vlp16::BeamOrigin(laser);
        off_m = std::max(off_m, std::abs(from_origin.norm() - r.range_m));
        off_deg = std::max(
            off_deg, std::acos(std::min(1.0, from_origin.normalized().dot(
                                                 vlp16::BeamDirection(laser, azimuth)))) /
                         vlp16::kDegToRad);
        off_s = std::max(off_s, std::abs(NsToSeconds(scans[scan].stamp_ns - f.stamp_ns) +
                                         static_cast<double>(p.time_s) -
                                         vlp16::LaserTimeS(laser)));
        EXPECT_EQ(p.ring, vlp16::RingOfLaser(laser));
        EXPECT_EQ(p.intensity, r.reflectivity);
      }
    }
  }
  EXPECT_EQ(scan, scans.size() - 1);
  EXPECT_EQ(index, scans.back().points.size());
  EXPECT_LE(off_m, 0.002);
  EXPECT_LE(off_deg, 0.02);
  EXPECT_LE(off_s, 1e-6);

  for (std::size_t i = 1; i < scans.size(); ++i) {
    const LidarPoint& first = scans[i].points.front();
    EXPECT_NEAR(vlp16::AzimuthDegOf(first.position.x(), first.position.y()), 90.0, 0.7);
    if (i + 1 < scans.size()) {
      EXPECT_NEAR(NsToSeconds(scans[i + 1].stamp_ns - scans[i].stamp_ns), 0.1, 2e-4);
    }
  }
}

TEST(ScanAssembler, StampAtTheEndAndChoiceOfReturns) {
  const auto packets = Packets(ReturnMode::kDual, 600.0, 40);
  Vlp16Decoder decoder;
  std::vector<Vlp16Firing> firings;
  for (const auto& packet : packets) Decode(decoder, packet, firings);
  const auto assemble = [&](ScanAssemblerConfig config) {
    config.cut_azimuth_deg = 200.0;
    ScanAssembler assembler(config);
    for (const Vlp16Firing& f : firings) EXPECT_FALSE(assembler.Add(f).has_value());
    return *assembler.Flush();
  };
  ScanAssemblerConfig config;
  const LidarScan start = assemble(config);
  config.stamp_at_end = true;
  const LidarScan end = assemble(config);
  ASSERT_EQ(start.points.size(), end.points.size());
  EXPECT_NEAR(NsToSeconds(end.stamp_ns - firings.back().raw.stamp_ns), 0.0, 1e-6);
  for (std::size_t i = 0; i < start.points.size(); ++i) {
    EXPECT_NEAR(NsToSeconds(end.stamp_ns - start.stamp_ns) + end.points[i].time_s,
                start.points[i].time_s, 1e-8);
  }
  EXPECT_GT(start.points.back().time_s, 0.02F);
  EXPECT_LT(end.points.front().time_s, -0.02F);

  config.returns = "strongest";
  const std::size_t strongest = assemble(config).points.size();
  config.returns = "last";
  const std::size_t last = assemble(config).points.size();
  EXPECT_EQ(strongest, last) << "every laser that saw something sends both";
  EXPECT_GT(start.points.size(), last + last / 8);
  EXPECT_LT(start.points.size(), 2 * last);
  config.returns = "both";
  EXPECT_THROW(ScanAssembler{config}, std::invalid_argument);
}

TEST(ScanAssembler, ASilenceEndsTheScan) {
  ScanAssembler assembler;
  Vlp16Firing f;
  f.raw.azimuth_deg = 10.0;
  f.raw.strongest[0].range_m = 5.0F;
  EXPECT_FALSE(assembler.Add(f).has_value());
  f.sensor_ns = f.raw.stamp_ns = kSecond;
  f.raw.azimuth_deg = 20.0;
  const auto scan = assembler.Add(f);
  ASSERT_TRUE(scan.has_value());
  EXPECT_EQ(scan->points.size(), 1U);
}

TEST(Decoder, CountsWhatGoesWrong) {
  const auto packets = Packets(ReturnMode::kStrongest, 600.0, 30);
  Vlp16Decoder decoder;
  std::vector<Vlp16Firing> firings;
  using S = Vlp16Decoder::Status;
  EXPECT_EQ(Decode(decoder, packets[0], firings), S::kDecoded);
  EXPECT_EQ(Decode(decoder, packets[0], firings), S::kDuplicated);
  EXPECT_EQ(Decode(decoder, packets[1], firings), S::kDecoded);
  EXPECT_EQ(Decode(decoder, packets[4], firings), S::kDecoded);   // 2 and 3 are missing.
  EXPECT_EQ(Decode(decoder, packets[3], firings), S::kReordered);
  EXPECT_EQ(Decode(decoder, packets[1], firings), S::kDuplicated);
  EXPECT_EQ(decoder.DecodeData(packets[5].data.data(), 1205, 0, firings), S::kTruncated);
  EXPECT_EQ(decoder.DecodeData(nullptr, 0, 0, firings), S::kTruncated);
  std::vector<std::uint8_t> longer(packets[5].data.begin(), packets[5].data.end());
  longer.push_back(0);
  EXPECT_EQ(decoder.DecodeData(longer.data(), longer.size(), 0, firings), S::kForeign);
  Vlp16Encoder::Packet odd = packets[5];
  odd.data[1204] = 0x3A;
  EXPECT_EQ(Decode(decoder, odd, firings), S::kForeign);
  odd = packets[5];
  odd.data[1205] = 0x24;
  EXPECT_EQ(Decode(decoder, odd, firings), S::kForeign);
  odd = packets[5];
  odd.data.fill(0);
  odd.data[1204] = 0x37;
  odd.data[1205] = 0x22;
  EXPECT_EQ(Decode(decoder, odd, firings), S::kForeign);
  const std::size_t before = firings.size();
  EXPECT_EQ(before, 3U * 24U);
  odd = packets[5];
  odd.data[300] = 0;     // Block 3 has lost its flag.
  odd.data[703] = 0xFF;  // Block 7 points beyond the circle.
  EXPECT_EQ(Decode(decoder, odd, firings), S::kDecoded);
  EXPECT_EQ(firings.size() - before, 20U);

  const Vlp16Counters& c = decoder.counters();
  EXPECT_EQ(c.packets, 13U);
  EXPECT_EQ(c.decoded, 4U);
  EXPECT_EQ(c.duplicated, 2U);
  EXPECT_EQ(c.reordered, 1U);
  EXPECT_EQ(c.lost, 2U);
  EXPECT_EQ(c.truncated, 2U);
  EXPECT_EQ(c.foreign, 4U);
  EXPECT_EQ(c.bad_blocks, 2U);
  EXPECT_EQ(c.decoded + c.truncated + c.foreign + c.duplicated + c.reordered + c.held, c.packets);
}

TEST(Decoder, AJumpOfTheSensorsClockStartsAnew) {
  auto packets = Packets(ReturnMode::kStrongest, 600.0, 20);
  Vlp16Decoder decoder;
  std::vector<Vlp16Firing> firings;
  for (int i = 0; i < 10; ++i) Decode(decoder, packets[static_cast<std::size_t>(i)], firings);
  const std::int64_t before = firings.back().raw.stamp_ns;
  // The sensor restarts its hour; the computer's clock goes on.
  std::uint32_t us = 100000017;
  for (std::size_t i = 10; i < 20; ++i, us += 1327) {
    for (int b = 0; b < 4; ++b) {
      packets[i].data[1200 + static_cast<std::size_t>(b)] =
          static_cast<std::uint8_t>(us >> (8 * b) & 0xFF);
    }
    EXPECT_EQ(Decode(decoder, packets[i], firings), Vlp16Decoder::Status::kDecoded);
  }
  EXPECT_EQ(decoder.counters().clock_jumps, 1U);
  EXPECT_EQ(firings.size(), 20U * 24U);
  EXPECT_NEAR(NsToSeconds(firings[240].raw.stamp_ns - before), vlp16::kFiringPeriodS, 2e-6);
}

TEST(Decoder, JudgesAnOddModelByItsTiming) {
  for (const ReturnMode mode : {ReturnMode::kStrongest, ReturnMode::kDual}) {
    const auto packets = Packets(mode, 600.0, 10, nullptr, 0x21);
    Vlp16Decoder decoder;
    std::vector<Vlp16Firing> firings;
    EXPECT_EQ(Decode(decoder, packets[0], firings), Vlp16Decoder::Status::kHeld);
    EXPECT_EQ(decoder.counters().held, 1U);
    EXPECT_TRUE(firings.empty());
    // One packet may be lost while judging.
    EXPECT_EQ(Decode(decoder, packets[2], firings), Vlp16Decoder::Status::kDecoded);
    EXPECT_EQ(firings.size(), 2U * static_cast<std::size_t>(vlp16::FiringsPerPacket(mode)));
    EXPECT_LT(firings.front().raw.stamp_ns, firings.back().raw.stamp_ns);
    EXPECT_EQ(decoder.odd_factory_byte(), std::optional<std::uint8_t>(0x21));
    for (std::size_t i = 3; i < 10; ++i) {
      EXPECT_EQ(Decode(decoder, packets[i], firings), Vlp16Decoder::Status::kDecoded);
    }
    EXPECT_EQ(decoder.counters().decoded, 9U);
    EXPECT_EQ(decoder.counters().held, 0U);
    EXPECT_EQ(decoder.counters().packets, 9U);
  }
}

TEST(Decoder, RefusesOtherModelsByTheirTiming) {
  // HDL-32E: a packet lasts 552.96 us; VLP-32C: 663.552 us in single mode; also with packets lost.
  for (const double period_us : {552.96, 663.552}) {
    for (const int stride : {1, 2, 3}) {
      const double rate = 3600.0;
      Vlp16Decoder decoder;
      std::vector<Vlp16Firing> firings;
      for (int n = 0; n < 40; n += stride) {
        Vlp16Encoder::Packet packet;
        packet.stamp_ns = static_cast<std::int64_t>(n * period_us * 1e3);
        for (std::size_t block = 0; block < 12; ++block) {
          const double t = (n + static_cast<double>(block) / 12.0) * period_us * 1e-6;
          const auto azimuth = static_cast<unsigned>(std::lround(t * rate * 100.0)) % 36000U;
          std::uint8_t* b = packet.data.data() + 100 * block;
          b[0] = 0xFF;
          b[1] = 0xEE;
          b[2] = static_cast<std::uint8_t>(azimuth & 0xFF);
          b[3] = static_cast<std::uint8_t>(azimuth >> 8);
          b[5] = 10;
        }
        const auto us = static_cast<std::uint32_t>(std::lround(n * period_us));
        for (int b = 0; b < 4; ++b) {
          packet.data[1200 + static_cast<std::size_t>(b)] =
              static_cast<std::uint8_t>(us >> (8 * b) & 0xFF);
        }
        packet.data[1204] = 0x37;
        packet.data[1205] = 0x21;
        EXPECT_EQ(Decode(decoder, packet, firings), Vlp16Decoder::Status::kHeld)
            << period_us << " every " << stride;
      }
      EXPECT_TRUE(firings.empty());
      EXPECT_EQ(decoder.counters().held, 1U);
      EXPECT_EQ(decoder.counters().foreign + 1, decoder.counters().packets);
    }
  }
}

TEST(Clock, HostOffsetIgnoresJitterAndFollowsDrift) {
  Vlp16Clock clock;
  std::mt19937 rng(3);
  std::exponential_distribution<double> late(1.0 / 2e6);  // 2 ms mean.
  constexpr std::int64_t kDuration = 1327104;
  const double drift = 20e-6;
  double worst = 0.0;
  for (int n = 0; n < 40000; ++n) {
    const std::int64_t truth = kStart + n * kDuration;
    const double sensor_s = (n * kDuration * 1e-9) * (1.0 - drift);
    const std::int64_t sensor = clock.Unwrap(static_cast<std::uint32_t>(
        static_cast<std::int64_t>(3599e6 + sensor_s * 1e6) % 3600000000LL));
    const std::int64_t host = truth + kDuration + static_cast<std::int64_t>(late(rng));
    const std::int64_t stamp = clock.StampNs(sensor, host, kDuration);
    if (n > 2000) worst = std::max(worst, std::abs(static_cast<double>(stamp - truth)));
  }
  EXPECT_LT(worst, 0.3e6) << "2 ms of jitter leave less than 0.3 ms";
}

TEST(Clock, GpsHourFromTheFixAlsoAroundTheWrap) {
  Vlp16ClockConfig config;
  config.clock = "gps";
  for (const double toh_s : {0.2, 1800.0, 3599.5}) {
    Vlp16Clock clock(config);
    PositionPacket packet;
    packet.time_of_hour_us = static_cast<std::uint32_t>(toh_s * 1e6);
    packet.pps = PpsStatus::kLocked;
    packet.fix = GnssFix();
    packet.fix->valid = true;
    const std::int64_t hour = 1714554000LL * kSecond;  // A full hour.
    // The sentence is a second old, so it may be of the hour before.
    packet.fix->utc_ns = hour + static_cast<std::int64_t>((toh_s - 1.2) * 1e9);
    const std::int64_t expected = hour + static_cast<std::int64_t>(toh_s * 1e9);
    // The computer's clock is three hours off.
    EXPECT_EQ(clock.OnPosition(packet, expected + 3 * vlp16::kHourNs), expected);
    EXPECT_TRUE(clock.gps_locked());
    const std::int64_t sensor = clock.Unwrap(packet.time_of_hour_us);
    EXPECT_EQ(clock.StampNs(sensor, expected + 3 * vlp16::kHourNs, 0), expected);
    // On across the wrap.
    std::int64_t last = expected;
    for (int i = 1; i <= 4000; ++i) {
      const auto us = static_cast<std::uint32_t>(
          (packet.time_of_hour_us + static_cast<std::uint64_t>(i) * 1000000U) % 3600000000U);
      const std::int64_t stamp = clock.StampNs(clock.Unwrap(us), 0, 0);
      EXPECT_EQ(stamp - last, kSecond);
      last = stamp;
    }
  }
}

TEST(Clock, UnlockedPpsDoesNotSetTheHour) {
  Vlp16ClockConfig config;
  config.clock = "gps";
  Vlp16Clock clock(config);
  PositionPacket packet;
  packet.pps = PpsStatus::kSynchronizing;
  packet.fix = GnssFix();
  packet.fix->valid = true;
  clock.OnPosition(packet, kStart);
  EXPECT_FALSE(clock.gps_locked());
  config.clock = "ntp";
  EXPECT_THROW(Vlp16Clock{config}, std::invalid_argument);
}

TEST(Rmc, ByHand) {
  const auto fix = ParseRmc("$GPRMC,080309,A,4140.0133,N,00027.4508,E,000.0,052.7,010818,000.2,W,A*05");
  ASSERT_TRUE(fix.has_value());
  EXPECT_TRUE(fix->valid);
  EXPECT_NEAR(fix->latitude_deg, 41.666888333, 1e-8);
  EXPECT_NEAR(fix->longitude_deg, 0.457513333, 1e-8);
  EXPECT_NEAR(fix->course_deg, 52.7, 1e-12);
  EXPECT_EQ(fix->utc_ns, 1533110589LL * kSecond);
  EXPECT_FALSE(ParseRmc("$GPRMC,080309,A,4140.0133,N,00027.4508,E,000.0,052.7,010818,000.2,W,A*06"));
  EXPECT_FALSE(ParseRmc(""));
  EXPECT_FALSE(ParseRmc("$GPGGA,1*00"));
  EXPECT_FALSE(ParseRmc("$GPRMC,*4B"));
  EXPECT_FALSE(ParseRmc("$GPRMC,080309,A,4140.0133"));
}

TEST(PositionPackets, RoundTrip) {
  std::mt19937 rng(5);
  std::uniform_real_distribution<double> u(-1.0, 1.0);
  for (int i = 0; i < 500; ++i) {
    GnssFix fix;
    fix.valid = i % 5 != 0;
    fix.latitude_deg = 90.0 * u(rng);
    fix.longitude_deg = 180.0 * u(rng);
    fix.speed_mps = 20.0 * std::abs(u(rng));
    fix.course_deg = 180.0 * u(rng) + 180.0;
    fix.utc_ns = 951782400LL * kSecond + i * 1717171LL * kSecond + 250000000LL;
    const std::int64_t stamp = fix.utc_ns + 1300000000LL;
    const auto bytes = EncodePositionPacket(fix, stamp, PpsStatus::kLocked);
    const auto packet = ParsePositionPacket(bytes.data(), bytes.size());
    ASSERT_TRUE(packet.has_value());
    EXPECT_EQ(packet->pps, PpsStatus::kLocked);
    EXPECT_EQ(packet->time_of_hour_us, (stamp / 1000) % 3600000000LL);
    ASSERT_TRUE(packet->fix.has_value()) << packet->sentence;
    EXPECT_EQ(packet->fix->valid, fix.valid);
    EXPECT_EQ(packet->fix->utc_ns, fix.utc_ns) << packet->sentence;
    EXPECT_NEAR(packet->fix->latitude_deg, fix.latitude_deg, 2e-9);
    EXPECT_NEAR(packet->fix->longitude_deg, fix.longitude_deg, 2e-9);
    EXPECT_NEAR(packet->fix->speed_mps, fix.speed_mps, 3e-4);
    EXPECT_FALSE(ParsePositionPacket(bytes.data(), 511).has_value());
  }
}

void ExpectSound(const std::vector<Vlp16Firing>& firings) {
  for (const Vlp16Firing& f : firings) {
    ASSERT_TRUE(f.raw.azimuth_deg >= 0.0 && f.raw.azimuth_deg < 360.0);
    ASSERT_TRUE(f.rate_deg_per_s >= 0.0 && f.rate_deg_per_s < 12000.0);
    for (std::size_t l = 0; l < vlp16::kLasers; ++l) {
      ASSERT_TRUE(f.raw.strongest[l].range_m >= 0.0F && f.raw.strongest[l].range_m < 131.08F);
      ASSERT_TRUE(f.raw.last[l].range_m >= 0.0F && f.raw.last[l].range_m < 131.08F);
    }
  }
}

// Noise and damaged packets: nothing may be read outside (run with the address sanitizer), the
// counters must add up, and what is decoded must be sound.
TEST(Decoder, RandomAndDamagedPackets) {
  const auto sound = Packets(ReturnMode::kDual, 600.0, 50);
  std::mt19937 rng(99);
  std::uniform_int_distribution<int> byte(0, 255);
  std::uniform_int_distribution<int> position(0, 1205);
  Vlp16Decoder decoder;
  ScanAssembler assembler;
  std::vector<Vlp16Firing> firings;
  std::uint64_t given = 0;
  for (int i = 0; i < 20000; ++i) {
    std::vector<std::uint8_t> bytes;
    const int kind = i % 4;
    if (kind == 0) {
      bytes.resize(static_cast<std::size_t>(position(rng)) + 1);
      for (auto& b : bytes) b = static_cast<std::uint8_t>(byte(rng));
    } else {
      const auto& p = sound[static_cast<std::size_t>(i) % sound.size()];
      bytes.assign(p.data.begin(), p.data.end());
      const int changes = kind == 1 ? 1 : 30;
      for (int k = 0; k < changes; ++k) {
        bytes[static_cast<std::size_t>(position(rng))] = static_cast<std::uint8_t>(byte(rng));
      }
      if (kind == 3) bytes[1200 + static_cast<std::size_t>(i % 6)] ^= 0x55;
      if (i % 97 == 0) bytes.resize(static_cast<std::size_t>(position(rng)));
    }
    firings.clear();
    // An exact copy on the heap, so that the sanitizer sees every byte beyond.
    const std::vector<std::uint8_t> exact(bytes);
    decoder.DecodeData(exact.data(), exact.size(), kStart + i * 663552LL, firings);
    ++given;
    ExpectSound(firings);
    for (const Vlp16Firing& f : firings) {
      if (const auto scan = assembler.Add(f)) {
        for (const LidarPoint& p : scan->points) {
          ASSERT_TRUE(p.position.allFinite());
          ASSERT_LT(p.ring, 16);
        }
      }
    }
    std::vector<std::uint8_t> nmea(512);
    for (auto& b : nmea) b = static_cast<std::uint8_t>(byte(rng));
    if (i % 2 == 0) {
      const std::string text = "$GPRMC,080309,A,4140.0133,N,00027.4508,E,000.0,052.7,010818,,,A*2F";
      std::copy(text.begin(), text.end(), nmea.begin() + 206);
      nmea[206 + static_cast<std::size_t>(byte(rng)) % text.size()] =
          static_cast<std::uint8_t>(byte(rng));
      nmea[201] = 0;
    }
    decoder.DecodePosition(nmea.data(), nmea.size(), kStart);
  }
  const Vlp16Counters& c = decoder.counters();
  EXPECT_EQ(c.packets, given);
  EXPECT_EQ(c.decoded + c.truncated + c.foreign + c.duplicated + c.reordered + c.held, c.packets);
  EXPECT_EQ(c.positions + c.bad_positions, given);
  EXPECT_GT(c.decoded, 1000U);
}

TEST(Pcap, RoundTripAndDamage) {
  const std::string path = ::testing::TempDir() + "dendro_pcap_test.pcap";
  const auto packets = Packets(ReturnMode::kStrongest, 600.0, 20);
  const std::vector<std::uint8_t> tiny = {1, 2, 3};
  {
    PcapWriter writer(path);
    for (const auto& p : packets) {
      writer.Write(p.stamp_ns, vlp16::kDataPort, p.data.data(), p.data.size());
    }
    writer.Write(packets.back().stamp_ns, 77, tiny.data(), tiny.size());
    writer.Write(packets.back().stamp_ns, 78, nullptr, 0);
    EXPECT_THROW(writer.Write(-1, 77, tiny.data(), tiny.size()), PcapError);
    writer.Close();
    EXPECT_THROW(writer.Write(1, 77, tiny.data(), tiny.size()), PcapError);
  }
  PcapReader reader(path);
  UdpPacket packet;
  for (const auto& p : packets) {
    ASSERT_TRUE(reader.Next(packet));
    EXPECT_EQ(packet.stamp_ns, p.stamp_ns);
    EXPECT_EQ(packet.port, vlp16::kDataPort);
    EXPECT_TRUE(std::equal(packet.payload.begin(), packet.payload.end(), p.data.begin(),
                           p.data.end()));
  }
  ASSERT_TRUE(reader.Next(packet));
  EXPECT_EQ(packet.payload, tiny);
  ASSERT_TRUE(reader.Next(packet));
  EXPECT_TRUE(packet.payload.empty());
  EXPECT_FALSE(reader.Next(packet));
  EXPECT_FALSE(reader.cut_short());
  EXPECT_EQ(reader.skipped_frames(), 0U);

  // The last record cut by a power failure.
  std::string bytes;
  {
    std::ifstream in(path, std::ios::binary);
    bytes.assign(std::istreambuf_iterator<char>(in), {});
  }
  {
    std::ofstream out(path, std::ios::binary);
    out.write(bytes.data(), static_cast<std::streamsize>(24 + 10 * (16 + 42 + 1206) + 100));
  }
  PcapReader cut(path);
  int read = 0;
  while (cut.Next(packet)) ++read;
  EXPECT_EQ(read, 10);
  EXPECT_TRUE(cut.cut_short());
  EXPECT_FALSE(cut.Next(packet));

  {
    std::ofstream out(path, std::ios::binary);
    out << "this is no capture at all, but long enough for a header";
  }
  try {
    PcapReader bad(path);
    FAIL() << "opened a text file";
  } catch (const PcapError& e) {
    EXPECT_NE(std::string(e.what()).find(path), std::string::npos) << e.what();
  }
  std::remove(path.c_str());
  EXPECT_THROW(PcapReader("/nonexistent/x.pcap"), PcapError);
  EXPECT_THROW(PcapWriter("/nonexistent/x.pcap"), PcapError);
}

TEST(CaptureReader, PlaysWhatWasWritten) {
  const std::string path = ::testing::TempDir() + "dendro_capture_test.pcap";
  const auto packets = Packets(ReturnMode::kDual, 600.0, 480);
  GnssFix fix;
  fix.valid = true;
  fix.latitude_deg = 50.5;
  fix.utc_ns = kStart;
  {
    PcapWriter writer(path);
    for (std::size_t i = 0; i < packets.size(); ++i) {
      writer.Write(packets[i].stamp_ns, vlp16::kDataPort, packets[i].data.data(),
                   packets[i].data.size());
      if (i % 100 != 0) continue;
      const auto p = EncodePositionPacket(fix, packets[i].stamp_ns, PpsStatus::kLocked);
      writer.Write(packets[i].stamp_ns, vlp16::kPositionPort, p.data(), p.size());
    }
  }
  CaptureReader reader(path);
  CaptureStep step;
  int scans = 0;
  int fixes = 0;
  while (reader.Next(step)) {
    scans += static_cast<int>(step.scans.size());
    if (step.fix) {
      ++fixes;
      EXPECT_NEAR(NsToSeconds(step.fix->stamp_ns - step.packet.stamp_ns), 0.0, 1e-6);
    }
  }
  EXPECT_EQ(scans, 5) << "from 300 degrees on: a rest, three revolutions, and a piece";
  EXPECT_EQ(fixes, 5);
  CaptureReaderConfig config;
  config.data_port = 0;
  EXPECT_THROW(CaptureReader(path, config), std::invalid_argument);
  std::remove(path.c_str());
}

}  // namespace
}  // namespace dendro
