// A VLP-16 in dual-return mode over loopback UDP into the decoder: what is lost, what it costs.

#include <arpa/inet.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <nlohmann/json.hpp>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "dendro_slam/sensors/scan_assembler.h"
#include "dendro_slam/sensors/udp_source.h"
#include "dendro_slam/sensors/vlp16_decoder.h"
#include "dendro_slam/sensors/vlp16_encoder.h"
#include "dendro_slam/sim/lidar_simulator.h"
#include "dendro_slam/sim/scene.h"
#include "measure.h"

namespace {

using dendro::ReturnMode;
using Clock = std::chrono::steady_clock;

struct Options {
  std::string scene;
  double seconds = 60.0;
  double burst_seconds = 2.0;
  double burst_factor = 3.0;
  double max_core_percent = 10.0;
  int receive_buffer_bytes = dendro::UdpSourceConfig().receive_buffer_bytes;
};

/// Endless packets: simulated revolutions over and over, with time and azimuth going on.
class PacketStream {
 public:
  PacketStream(std::vector<dendro::RawFiring> firings, std::int64_t start_ns)
      : firings_(std::move(firings)), start_ns_(start_ns), encoder_(ReturnMode::kDual) {}

  const dendro::Vlp16Encoder::Packet& Next() {
    const auto period_ns = static_cast<std::int64_t>(std::llround(dendro::vlp16::kFiringPeriodS * 1e9));
    for (;;) {
      dendro::RawFiring firing = firings_[static_cast<std::size_t>(index_) % firings_.size()];
      firing.stamp_ns = start_ns_ + index_ * period_ns;
      firing.azimuth_deg = dendro::vlp16::WrapAzimuthDeg(static_cast<double>(index_) *
                                                         dendro::vlp16::FiringPitchDeg(600.0));
      ++index_;
      if (auto packet = encoder_.Add(firing)) {
        packet_ = *packet;
        return packet_;
      }
    }
  }

 private:
  std::vector<dendro::RawFiring> firings_;
  std::int64_t start_ns_;
  std::int64_t index_ = 0;
  dendro::Vlp16Encoder encoder_;
  dendro::Vlp16Encoder::Packet packet_;
};

/// Sends packets to a local port, from a process of its own so that its work is not counted.
class Sender {
 public:
  Sender(int port, const std::vector<dendro::RawFiring>& firings)
      : stream_(firings, 1714557600LL * 1000000000LL), fd_(socket(AF_INET, SOCK_DGRAM, 0)) {
    if (fd_ < 0) throw std::runtime_error(std::string("socket: ") + std::strerror(errno));
    to_.sin_family = AF_INET;
    to_.sin_port = htons(static_cast<std::uint16_t>(port));
    to_.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  }
  ~Sender() { close(fd_); }
  Sender(const Sender&) = delete;
  Sender& operator=(const Sender&) = delete;

  void Send(std::uint64_t count, double rate_hz) {
    const Clock::time_point begin = Clock::now();
    for (std::uint64_t i = 0; i < count; ++i) {
      std::this_thread::sleep_until(
          begin + std::chrono::duration_cast<Clock::duration>(
                      std::chrono::duration<double>(static_cast<double>(i) / rate_hz)));
      const auto& packet = stream_.Next();
      if (sendto(fd_, packet.data.data(), packet.data.size(), 0,
                 reinterpret_cast<const sockaddr*>(&to_), sizeof(to_)) < 0) {
        throw std::runtime_error(std::string("send: ") + std::strerror(errno));
      }
    }
  }

 private:
  PacketStream stream_;
  int fd_;
  sockaddr_in to_{};
};

/// What arrived of a stretch.
struct Result {
  std::uint64_t sent = 0;
  std::uint64_t received = 0;
  std::uint64_t dropped_by_socket = 0;  ///< As the kernel counts.
  std::uint64_t lost = 0;               ///< As the decoder sees in the timestamps.
  std::uint64_t scans = 0;
  std::uint64_t points = 0;
  double wall_s = 0.0;
  double cpu_s = 0.0;
};

/// One process tells another that something is done.
class Signal {
 public:
  Signal() {
    if (pipe(ends_) != 0) throw std::runtime_error(std::string("pipe: ") + std::strerror(errno));
  }
  ~Signal() {
    close(ends_[0]);
    close(ends_[1]);
  }
  Signal(const Signal&) = delete;
  Signal& operator=(const Signal&) = delete;

  void Give() const {
    if (write(ends_[1], "x", 1) != 1) throw std::runtime_error("the other process is gone");
  }
  /// @return  Whether it came in time.
  bool Wait(int timeout_ms) const {
    pollfd end{ends_[0], POLLIN, 0};
    return poll(&end, 1, timeout_ms) == 1;
  }

 private:
  int ends_[2];
};

/// Sends `count` packets and decodes what comes, then one more: the kernel tells of its drops along
/// with a packet.
/// @param stall  Nobody reads until all have been sent.
Result Stretch(const Options& options,
               const std::vector<dendro::RawFiring>& firings,
               std::uint64_t count,
               double rate_hz,
               bool stall) {
  dendro::UdpSourceConfig config;
  config.address = "127.0.0.1";
  config.port = 0;
  config.receive_buffer_bytes = options.receive_buffer_bytes;
  dendro::UdpSource source(config);
  const Signal all_sent;
  const Signal all_read;
  constexpr int kPatienceMs = 60000;
  const pid_t child = fork();
  if (child < 0) throw std::runtime_error(std::string("fork: ") + std::strerror(errno));
  if (child == 0) {
    try {
      Sender sender(source.port(), firings);
      sender.Send(count, rate_hz);
      all_sent.Give();
      if (!all_read.Wait(kPatienceMs)) _exit(1);
      sender.Send(1, rate_hz);
    } catch (const std::exception& error) {
      fmt::print(stderr, "packet_benchmark: {}\n", error.what());
      _exit(1);
    }
    _exit(0);
  }

  Result result;
  result.sent = count + 1;
  dendro::Vlp16Decoder decoder;
  dendro::ScanAssembler assembler;
  std::vector<dendro::Vlp16Firing> decoded;
  dendro::UdpPacket packet;
  const auto read_all = [&](double timeout_s) {
    while (source.Receive(packet, timeout_s)) {
      decoded.clear();
      decoder.DecodeData(packet.payload.data(), packet.payload.size(), packet.stamp_ns, decoded);
      for (const dendro::Vlp16Firing& firing : decoded) {
        if (const auto scan = assembler.Add(firing)) {
          ++result.scans;
          result.points += scan->points.size();
        }
      }
    }
  };
  const int sending_ms = static_cast<int>(1e3 * static_cast<double>(count) / rate_hz) + kPatienceMs;
  if (stall && !all_sent.Wait(sending_ms)) throw std::runtime_error("the sending process failed");
  const double cpu_begin = dendro::measure::ProcessCpuSeconds();
  const Clock::time_point begin = Clock::now();
  while (!all_sent.Wait(0)) read_all(0.2);
  read_all(0.0);
  all_read.Give();
  read_all(0.5);
  result.wall_s = std::chrono::duration<double>(Clock::now() - begin).count();
  result.cpu_s = dendro::measure::ProcessCpuSeconds() - cpu_begin;
  result.received = source.received();
  result.dropped_by_socket = source.dropped();
  result.lost = decoder.counters().lost;
  int status = 0;
  waitpid(child, &status, 0);
  if (status != 0) throw std::runtime_error("the sending process failed");
  return result;
}

nlohmann::json ToJson(const Result& r) {
  return {{"sent", r.sent},       {"received", r.received},
          {"dropped_by_socket", r.dropped_by_socket},
          {"lost", r.lost},       {"scans", r.scans},
          {"points", r.points},   {"wall_s", r.wall_s},
          {"cpu_s", r.cpu_s}};
}

bool Run(const Options& options) {
  const dendro::Scene scene = dendro::LoadScene(options.scene);
  const dendro::Raycaster raycaster(scene);
  dendro::LidarSimulatorConfig lidar;
  lidar.return_mode = "dual";
  const dendro::LidarSimulator simulator(raycaster, lidar);
  std::vector<dendro::RawFiring> firings;
  Eigen::Isometry3d pose = Eigen::Isometry3d::Identity();
  pose.translation() = Eigen::Vector3d(-4.0, 1.0, 1.5);
  constexpr int kRevolutions = 3;
  for (int i = 0; i < kRevolutions; ++i) {
    const auto scan = simulator.SimulateScan(i, pose);
    firings.insert(firings.end(), scan.firings.begin(), scan.firings.end());
  }

  const double rate_hz = 1.0 / dendro::vlp16::PacketPeriodS(ReturnMode::kDual);
  const double burst_hz = options.burst_factor * rate_hz;
  const auto packets = [](double seconds, double hz) {
    return static_cast<std::uint64_t>(std::llround(seconds * hz));
  };
  const Result steady = Stretch(options, firings, packets(options.seconds, rate_hz), rate_hz, false);
  const double core_percent = 100.0 * steady.cpu_s / (static_cast<double>(steady.sent) / rate_hz);
  const Result burst =
      Stretch(options, firings, packets(options.burst_seconds, burst_hz), burst_hz, false);

  // What the socket can hold is found by filling it while nobody reads; then once more with nine
  // tenths of that.
  const auto too_many = static_cast<std::uint64_t>(options.receive_buffer_bytes) / 512;
  const Result overflow = Stretch(options, firings, too_many, 20.0 * burst_hz, true);
  const std::uint64_t capacity = overflow.received - 1;
  const Result held = Stretch(options, firings, capacity * 9 / 10, burst_hz, true);

  const bool nothing_lost = steady.received == steady.sent && steady.lost == 0;
  const bool cheap = core_percent < options.max_core_percent;
  const bool burst_held = burst.received == burst.sent && burst.lost == 0 &&
                          held.received == held.sent && held.lost == 0;
  const bool rest_counted = overflow.dropped_by_socket > 0 &&
                            overflow.received + overflow.dropped_by_socket == overflow.sent &&
                            overflow.lost == overflow.dropped_by_socket;
  const nlohmann::json out = {
      {"packets_per_s", rate_hz},
      {"steady", ToJson(steady)},
      {"core_percent", core_percent},
      {"burst_factor", options.burst_factor},
      {"burst", ToJson(burst)},
      {"burst_while_nobody_reads", ToJson(held)},
      {"socket_holds_packets", capacity},
      {"overflow", ToJson(overflow)},
      {"nothing_lost", nothing_lost},
      {"cheap_enough", cheap},
      {"burst_held", burst_held},
      {"rest_counted", rest_counted},
  };
  fmt::print("{}\n", out.dump(2));
  return nothing_lost && cheap && burst_held && rest_counted;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app(
      "Sends simulated dual-return packets over loopback UDP at the sensor's rate of 1508 a second and "
      "decodes them into scans, then in bursts. Prints one JSON object; fails when a packet is lost "
      "that the socket could hold, when a loss is not counted, or when it takes too much of a core");
  Options options;
  app.add_option("SCENE", options.scene, "scene file (YAML)")->required();
  app.add_option("--seconds", options.seconds, "at the sensor's rate [s]")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  app.add_option("--burst-seconds", options.burst_seconds, "at the burst's rate [s]")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  app.add_option("--burst-factor", options.burst_factor, "rate of a burst over the sensor's")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  app.add_option("--max-core-percent", options.max_core_percent,
                 "CPU time allowed for receiving and decoding [% of one core]")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  app.add_option("--receive-buffer", options.receive_buffer_bytes, "asked of the kernel [bytes]")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  CLI11_PARSE(app, argc, argv);
  try {
    return Run(options) ? 0 : 1;
  } catch (const std::exception& error) {
    fmt::print(stderr, "packet_benchmark: {}\n", error.what());
    return 2;
  }
}
