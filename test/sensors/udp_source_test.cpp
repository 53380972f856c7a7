#include "dendro_slam/sensors/udp_source.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <unistd.h>

#include <chrono>
#include <cstdio>
#include <cstring>
#include <ctime>
#include <random>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include <gtest/gtest.h>

#include "dendro_slam/sensors/scan_assembler.h"
#include "dendro_slam/sensors/vlp16_encoder.h"

namespace dendro {
namespace {

class Sender {
 public:
  explicit Sender(int port) : fd_(socket(AF_INET, SOCK_DGRAM, 0)) {
    to_.sin_family = AF_INET;
    to_.sin_port = htons(static_cast<std::uint16_t>(port));
    inet_pton(AF_INET, "127.0.0.1", &to_.sin_addr);
  }
  ~Sender() { close(fd_); }
  void Send(const void* data, std::size_t size) const {
    ASSERT_EQ(sendto(fd_, data, size, 0, reinterpret_cast<const sockaddr*>(&to_), sizeof(to_)),
              static_cast<ssize_t>(size));
  }

 private:
  int fd_;
  sockaddr_in to_{};
};

UdpSourceConfig Loopback() {
  UdpSourceConfig config;
  config.address = "127.0.0.1";
  config.port = 0;
  return config;
}

double CpuSeconds() {
  timespec t{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return static_cast<double>(t.tv_sec) + 1e-9 * static_cast<double>(t.tv_nsec);
}

TEST(UdpSource, ReceivesWithStampAndTimesOut) {
  UdpSource source(Loopback());
  EXPECT_GT(source.port(), 0);
  EXPECT_GT(source.buffer_bytes(), 0);
  UdpPacket packet;
  const auto begin = std::chrono::steady_clock::now();
  EXPECT_FALSE(source.Receive(packet, 0.05));
  EXPECT_GE(std::chrono::steady_clock::now() - begin, std::chrono::milliseconds(45));
  EXPECT_FALSE(source.Receive(packet, 0.0));
  const std::string text = "hello";
  Sender(source.port()).Send(text.data(), text.size());
  ASSERT_TRUE(source.Receive(packet, 2.0));
  EXPECT_EQ(std::string(packet.payload.begin(), packet.payload.end()), text);
  EXPECT_EQ(packet.port, source.port());
  EXPECT_NEAR(static_cast<double>(packet.stamp_ns) * 1e-9, static_cast<double>(std::time(nullptr)),
              5.0);
  EXPECT_EQ(source.received(), 1U);
}

TEST(UdpSource, IgnoresOtherSenders) {
  UdpSourceConfig config = Loopback();
  config.sender = "192.0.2.1";
  UdpSource source(config);
  Sender(source.port()).Send("x", 1);
  UdpPacket packet;
  EXPECT_FALSE(source.Receive(packet, 0.1));
  EXPECT_EQ(source.other_senders(), 1U);
  EXPECT_EQ(source.received(), 0U);
}

TEST(UdpSource, CountsWhatTheBufferCannotHold) {
  UdpSourceConfig config = Loopback();
  config.receive_buffer_bytes = 50000;
  UdpSource source(config);
  const Sender sender(source.port());
  std::vector<std::uint8_t> data(vlp16::kDataPacketBytes);
  constexpr int kSent = 500;
  for (int i = 0; i < kSent; ++i) sender.Send(data.data(), data.size());
  UdpPacket packet;
  while (source.Receive(packet, 0.0)) {
  }
  // The kernel tells the number of drops along with the next datagram.
  sender.Send(data.data(), data.size());
  ASSERT_TRUE(source.Receive(packet, 2.0));
  EXPECT_GT(source.dropped(), 0U);
  EXPECT_EQ(source.received() + source.dropped(), static_cast<std::uint64_t>(kSent) + 1);
}

TEST(UdpSource, Errors) {
  UdpSource first(Loopback());
  UdpSourceConfig config = Loopback();
  config.port = first.port();
  try {
    UdpSource second(config);
    FAIL() << "bound a port twice";
  } catch (const UdpError& e) {
    EXPECT_NE(std::string(e.what()).find(std::to_string(config.port)), std::string::npos);
  }
  config.port = 70000;
  EXPECT_THROW(UdpSource{config}, std::invalid_argument);
  config = Loopback();
  config.address = "localhost";
  EXPECT_THROW(UdpSource{config}, std::invalid_argument);
}

// Two seconds of dual-return packets at the sensor's rate through the socket into scans.
TEST(UdpSource, DualReturnStreamArrivesWhole) {
  UdpSource source(Loopback());
  Vlp16Encoder encoder(ReturnMode::kDual);
  std::vector<Vlp16Encoder::Packet> packets;
  std::mt19937 rng(4);
  std::uniform_real_distribution<float> range(1.0F, 50.0F);
  constexpr std::size_t kPackets = 3016;  // Two seconds.
  for (int n = 0; packets.size() < kPackets; ++n) {
    RawFiring f;
    f.stamp_ns = static_cast<std::int64_t>(n * vlp16::kFiringPeriodS * 1e9);
    f.azimuth_deg = n * vlp16::FiringPitchDeg(600.0);
    for (std::size_t l = 0; l < vlp16::kLasers; ++l) {
      f.strongest[l] = {range(rng), 10};
      f.last[l] = {f.strongest[l].range_m + 1.0F, 20};
    }
    if (const auto packet = encoder.Add(f)) packets.push_back(*packet);
  }
  std::thread thread([&] {
    const Sender sender(source.port());
    const auto begin = std::chrono::steady_clock::now();
    for (std::size_t i = 0; i < packets.size(); ++i) {
      std::this_thread::sleep_until(begin + std::chrono::nanoseconds(663552LL * static_cast<long>(i)));
      sender.Send(packets[i].data.data(), packets[i].data.size());
    }
  });
  Vlp16Decoder decoder;
  ScanAssembler assembler;
  std::vector<Vlp16Firing> firings;
  UdpPacket packet;
  std::size_t received = 0;
  std::size_t points = 0;
  int scans = 0;
  const double cpu_begin = CpuSeconds();
  while (received < kPackets && source.Receive(packet, 5.0)) {
    ++received;
    firings.clear();
    decoder.DecodeData(packet.payload.data(), packet.payload.size(), packet.stamp_ns, firings);
    for (const Vlp16Firing& f : firings) {
      if (const auto scan = assembler.Add(f)) {
        ++scans;
        points += scan->points.size();
      }
    }
  }
  const double cpu = CpuSeconds() - cpu_begin;
  thread.join();
  EXPECT_EQ(received, kPackets);
  EXPECT_EQ(source.dropped(), 0U);
  EXPECT_EQ(decoder.counters().lost, 0U);
  EXPECT_EQ(decoder.counters().decoded, kPackets);
  EXPECT_EQ(scans, 20);
  EXPECT_NEAR(static_cast<double>(points), 20 * 1808.4 * 32, 2000);
  const double share = cpu / (static_cast<double>(kPackets) * 663.552e-6);
  std::printf("decoding takes %.1f %% of one core\n", 100.0 * share);
  RecordProperty("core_percent", static_cast<int>(100.0 * share));
}

}  // namespace
}  // namespace dendro
