#include "dendro_slam/sensors/replay.h"

#include <filesystem>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "dendro_slam/sensors/pcap_writer.h"
#include "dendro_slam/sensors/scan_assembler.h"
#include "dendro_slam/sensors/vlp16_decoder.h"
#include "dendro_slam/sensors/vlp16_encoder.h"

namespace dendro {
namespace {

constexpr std::int64_t kStart = 1700003599900000000LL;  // 100 ms before a full hour of the sensor.

class Replay : public ::testing::Test {
 protected:
  void SetUp() override {
    folder_ = std::filesystem::temp_directory_path() /
              ("dendro_replay_" + std::to_string(::testing::UnitTest::GetInstance()->random_seed()) +
               "_" + ::testing::UnitTest::GetInstance()->current_test_info()->name());
    std::filesystem::create_directories(folder_);
  }
  void TearDown() override { std::filesystem::remove_all(folder_); }

  /// A capture of some revolutions at 600 rpm, every laser seeing a wall at 5 m.
  std::string Capture(double revolutions) {
    const std::string path = (folder_ / "a.pcap").string();
    PcapWriter writer(path);
    Vlp16Encoder encoder(ReturnMode::kStrongest);
    const int firings = static_cast<int>(revolutions * 0.1 / vlp16::kFiringPeriodS);
    for (int i = 0; i < firings; ++i) {
      RawFiring firing;
      firing.stamp_ns =
          kStart + static_cast<std::int64_t>(std::llround(i * vlp16::kFiringPeriodS * 1e9));
      firing.azimuth_deg = 3600.0 * i * vlp16::kFiringPeriodS;
      for (RawReturn& value : firing.strongest) value = {5.0F, 10};
      if (const auto packet = encoder.Add(firing)) {
        writer.Write(packet->stamp_ns, vlp16::kDataPort, packet->data.data(), packet->data.size());
      }
    }
    writer.Close();
    return path;
  }

  std::filesystem::path folder_;
};

TEST(ReplayTiming, StampsMoveAndRatesScale) {
  ReplayTiming timing;
  timing.started_ns = 5000000000;
  timing.origin_ns = 1000000000;
  timing.rate = 2.0;
  EXPECT_DOUBLE_EQ(timing.DueS(4000000000), 1.5);
  EXPECT_EQ(timing.StampNs(4000000000), 8000000000);
  timing.stamps_now = false;
  EXPECT_EQ(timing.StampNs(4000000000), 4000000000);
}

TEST_F(Replay, LapsOfACaptureAreOneUnbrokenStream) {
  const std::string path = Capture(3.25);
  std::size_t packets_per_lap = CaptureSpan(path, 2368, 8308).count;
  EXPECT_GT(packets_per_lap, 200U);
  CaptureReplay replay(path, 2368, 8308, true);
  Vlp16Decoder decoder;
  ScanAssembler assembler;
  std::vector<Vlp16Firing> firings;
  UdpPacket packet;
  std::int64_t last_ns = 0;
  std::int64_t last_stamp = 0;
  for (std::size_t i = 0; i < 3 * packets_per_lap; ++i) {
    ASSERT_TRUE(replay.Next(packet));
    if (i > 0) {
      EXPECT_NEAR(static_cast<double>(packet.stamp_ns - last_ns), 1327104.0, 1000.0) << i;
    }
    last_ns = packet.stamp_ns;
    firings.clear();
    decoder.DecodeData(packet.payload.data(), packet.payload.size(), packet.stamp_ns, firings);
    for (const Vlp16Firing& firing : firings) {
      EXPECT_GT(firing.raw.stamp_ns, last_stamp);
      last_stamp = firing.raw.stamp_ns;
    }
  }
  // The hour of the sensor wraps in the first lap.
  EXPECT_EQ(decoder.counters().decoded, 3 * packets_per_lap);
  EXPECT_EQ(decoder.counters().lost, 0U);
  EXPECT_EQ(decoder.counters().clock_jumps, 0U);
}

TEST_F(Replay, GoesOnBehindAStampInAnyLap) {
  const std::string path = Capture(2.0);
  CaptureReplay whole(path, 2368, 8308, true);
  std::vector<UdpPacket> packets(1200);
  for (UdpPacket& packet : packets) ASSERT_TRUE(whole.Next(packet));
  for (const std::size_t at : {0U, 10U, 149U, 150U, 151U, 500U, 1100U}) {
    CaptureReplay resumed(path, 2368, 8308, true);
    resumed.SkipTo(packets[at].stamp_ns);
    UdpPacket packet;
    for (std::size_t i = at + 1; i < at + 20; ++i) {
      ASSERT_TRUE(resumed.Next(packet));
      EXPECT_EQ(packet.stamp_ns, packets[i].stamp_ns) << at;
      EXPECT_EQ(packet.payload, packets[i].payload) << at;
    }
  }
}

TEST_F(Replay, EndsOnceAndNamesAnEmptyPort) {
  const std::string path = Capture(1.0);
  CaptureReplay once(path, 2368, 8308, false);
  UdpPacket packet;
  std::size_t count = 0;
  while (once.Next(packet)) ++count;
  EXPECT_EQ(count, CaptureSpan(path, 2368, 8308).count);
  EXPECT_THROW(CaptureSpan(path, 2369, 0), PcapError);
}

TEST(PoseReplay, ALapBeginsWhereTheLastOneEnded) {
  std::vector<StreamedPose> poses(3);
  for (std::size_t i = 0; i < 3; ++i) {
    poses[i].stamp_ns = 1000000000 + static_cast<std::int64_t>(i) * 100000000;
    poses[i].T_odom_camera.translation() = Eigen::Vector3d(1.0 + static_cast<double>(i), 0, 0);
  }
  poses[2].T_odom_camera.linear() =
      Eigen::AngleAxisd(M_PI / 2, Eigen::Vector3d::UnitZ()).matrix();
  PoseReplay replay(poses, true);
  std::vector<StreamedPose> out;
  for (int i = 0; i < 7; ++i) out.push_back(*replay.Next());
  for (std::size_t i = 1; i < out.size(); ++i) {
    EXPECT_EQ(out[i].stamp_ns - out[i - 1].stamp_ns, 100000000);
  }
  EXPECT_TRUE(out[3].T_odom_camera.isApprox(out[2].T_odom_camera, 1e-12));
  // After the quarter turn the second lap goes along y.
  EXPECT_TRUE(out[4].T_odom_camera.translation().isApprox(Eigen::Vector3d(3, 1, 0), 1e-12));
  PoseReplay resumed(poses, true);
  resumed.SkipTo(out[4].stamp_ns);
  const StreamedPose next = *resumed.Next();
  EXPECT_EQ(next.stamp_ns, out[5].stamp_ns);
  EXPECT_TRUE(next.T_odom_camera.isApprox(out[5].T_odom_camera, 1e-12));
  PoseReplay once(poses, false);
  once.SkipTo(out[4].stamp_ns);
  EXPECT_FALSE(once.Next().has_value());
}

TEST_F(Replay, PoseFilesAreToldApart) {
  const auto write = [this](const char* name, const std::string& text) {
    std::ofstream(folder_ / name) << text;
    return (folder_ / name).string();
  };
  const std::string tum = write("a.txt", "# t x y z q\n1.0 1 2 3 0 0 0 1\n");
  const std::string realsense =
      write("b.csv", "time,x,y,z,qx,qy,qz,qw,tracker_confidence\n1.0,0,0,-1,0,0,0,1,2\n");
  EXPECT_EQ(ReadPoseFile(tum, "auto")[0].T_odom_camera.translation(), Eigen::Vector3d(1, 2, 3));
  const auto poses = ReadPoseFile(realsense, "auto");
  EXPECT_EQ(poses[0].T_odom_camera.translation(), Eigen::Vector3d(1, 0, 0));
  EXPECT_EQ(poses[0].confidence, 2);
  try {
    ReadPoseFile(write("c.txt", "1.0 1 2\n"), "auto");
    FAIL();
  } catch (const PoseStreamError& error) {
    EXPECT_NE(std::string(error.what()).find("c.txt: line 1"), std::string::npos);
  }
  EXPECT_THROW(ReadPoseFile(tum, "csv"), std::invalid_argument);
  EXPECT_THROW(ReadPoseFile((folder_ / "none").string(), "auto"), PoseStreamError);
}

TEST_F(Replay, AMessageCompletesExactlyOneScan) {
  // Packets are sent on when the azimuth has wrapped; a decoder then has the whole scan.
  CaptureReplay replay(Capture(5.4), 2368, 8308, false);
  Vlp16Decoder decoder;
  ScanAssembler assembler;
  RevolutionCutter cutter;
  std::vector<Vlp16Firing> firings;
  UdpPacket packet;
  int scans = 0;
  int messages = 0;
  while (replay.Next(packet)) {
    firings.clear();
    decoder.DecodeData(packet.payload.data(), packet.payload.size(), packet.stamp_ns, firings);
    for (const Vlp16Firing& firing : firings) scans += assembler.Add(firing).has_value() ? 1 : 0;
    if (!cutter.Add(packet.payload.data())) continue;
    ++messages;
    EXPECT_EQ(scans, messages);
  }
  EXPECT_EQ(messages, 5);
}

}  // namespace
}  // namespace dendro
