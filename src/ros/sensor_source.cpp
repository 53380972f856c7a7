#include "dendro_slam/ros/sensor_source.h"

#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <charconv>
#include <chrono>
#include <cmath>
#include <cstring>
#include <deque>
#include <functional>
#include <map>
#include <mutex>
#include <optional>
#include <sstream>
#include <utility>

#include <boost/make_shared.hpp>
#include <diagnostic_msgs/DiagnosticArray.h>
#include <fmt/format.h>
#include <nav_msgs/Odometry.h>
#include <sensor_msgs/NavSatFix.h>
#include <std_msgs/String.h>
#include <topic_tools/shape_shifter.h>

#include "dendro_slam/GraphStatus.h"
#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/ros/holding_publisher.h"
#include "dendro_slam/ros/velodyne_msgs.h"
#include "dendro_slam/sensors/replay.h"
#include "dendro_slam/sensors/udp_source.h"
#include "dendro_slam/sensors/vlp16_decoder.h"

namespace dendro_ros {

namespace {

using Clock = std::chrono::steady_clock;

constexpr double kPollS = 0.005;        ///< Longest nap: what is late by this is not late.
constexpr double kReportEveryS = 1.0;
constexpr double kSilenceS = 2.0;       ///< A sensor that is on and says nothing for this long.
constexpr double kLongestTurnS = 0.25;  ///< Slower than 300 rpm: packets are sent on all the same.
constexpr std::size_t kMostPackets = 400;
/// A scan needs the poses before it, and the packet before it, whose last firings are its first.
constexpr std::int64_t kOverlapNs = 250000000;

std::int64_t ParseNs(const std::string& text, const char* field) {
  std::int64_t value = 0;
  const auto parsed = std::from_chars(text.data(), text.data() + text.size(), value);
  if (parsed.ec != std::errc() || parsed.ptr != text.data() + text.size()) {
    throw std::invalid_argument(std::string(field) + " must be whole nanoseconds, not '" + text + "'");
  }
  return value;
}

std::int64_t HostNs() {
  return std::chrono::duration_cast<std::chrono::nanoseconds>(
             std::chrono::system_clock::now().time_since_epoch())
      .count();
}

std::int64_t Ns(double s) { return static_cast<std::int64_t>(std::llround(s * 1e9)); }

sensor_msgs::NavSatFix ToFixMsg(const dendro::GnssFix& fix, std::int64_t stamp_ns) {
  sensor_msgs::NavSatFix msg;
  msg.header.stamp = ToRosTime(stamp_ns);
  msg.header.frame_id = "gps";
  msg.status.status =
      fix.valid ? sensor_msgs::NavSatStatus::STATUS_FIX : sensor_msgs::NavSatStatus::STATUS_NO_FIX;
  msg.status.service = sensor_msgs::NavSatStatus::SERVICE_GPS;
  msg.latitude = fix.latitude_deg;
  msg.longitude = fix.longitude_deg;
  msg.altitude = std::nan("");  // GPRMC has no height.
  return msg;
}

/// The tracker's confidence, 0 to 3, where the covariance is one that realsense2_camera writes
/// (0.01 * 10^(3 - confidence)); nothing for other trackers.
std::optional<int> ConfidenceOf(const nav_msgs::Odometry& odometry, double variance_high) {
  const double variance = odometry.pose.covariance[0];
  if (!(variance > 0.0)) return std::nullopt;
  const double steps = std::log10(variance / variance_high);
  const double whole = std::round(steps);
  if (std::abs(steps - whole) > 0.02 || whole < 0.0 || whole > 3.0) return std::nullopt;
  return 3 - static_cast<int>(whole);
}

/// The number that outlives its process: the last stamp a replay has published.
class Progress {
 public:
  explicit Progress(const std::string& path) {
    if (path.empty()) return;
    fd_ = ::open(path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0644);
    if (fd_ < 0) throw std::invalid_argument("progress: " + path + ": " + std::strerror(errno));
  }
  ~Progress() {
    if (fd_ >= 0) ::close(fd_);
  }
  Progress(const Progress&) = delete;
  Progress& operator=(const Progress&) = delete;

  std::optional<std::int64_t> Read() const {
    std::int64_t value = 0;
    if (fd_ < 0 || ::pread(fd_, &value, sizeof(value), 0) != sizeof(value)) return std::nullopt;
    return value;
  }
  void Write(std::int64_t value) const {
    // A progress that is not kept costs repeated messages after a crash, which readers refuse.
    if (fd_ >= 0 && ::pwrite(fd_, &value, sizeof(value), 0) < 0) return;
  }

 private:
  int fd_ = -1;
};

/// Counts over the last two seconds.
class RateMeter {
 public:
  void Add(std::size_t count = 1) {
    counts_.emplace_back(Clock::now(), count);
    total_ += count;
  }
  double Hz() {
    const Clock::time_point now = Clock::now();
    while (!counts_.empty() && now - counts_.front().first > std::chrono::seconds(2)) {
      counts_.pop_front();
    }
    std::size_t sum = 0;
    for (const auto& entry : counts_) sum += entry.second;
    const double span_s =
        std::min(2.0, std::max(0.5, std::chrono::duration<double>(now - begin_).count()));
    return static_cast<double>(sum) / span_s;
  }
  std::size_t total() const { return total_; }
  double SilentS() const {
    const Clock::time_point last = counts_.empty() ? begin_ : counts_.back().first;
    return std::chrono::duration<double>(Clock::now() - last).count();
  }

 private:
  Clock::time_point begin_ = Clock::now();
  std::deque<std::pair<Clock::time_point, std::size_t>> counts_;
  std::size_t total_ = 0;
};

}  // namespace

void SensorSourceConfig::Validate() const {
  const auto require = [](bool holds, const std::string& what) {
    if (!holds) throw std::invalid_argument(what);
  };
  const bool replay = type == "vlp16_pcap" || type == "poses";
  require(replay || type == "vlp16_udp" || type == "topic",
          "type must be vlp16_udp, vlp16_pcap, poses or topic, not '" + type + "'");
  require(!topic.empty(), "topic must not be empty");
  require(!replay || !file.empty(), "file must not be empty");
  require(data_port >= 1 && data_port <= 65535, "data_port must be in [1, 65535]");
  require(position_port >= 0 && position_port <= 65535, "position_port must be in [0, 65535]");
  require(position_port != data_port, "position_port must differ from data_port");
  require(rate > 0.0 && rate <= 100.0, "rate must be in (0, 100]");
  require(stamps == "now" || stamps == "recorded", "stamps must be now or recorded");
  require(sigma_rotation_rad > 0.0, "sigma_rotation_rad must be positive");
  require(sigma_translation_m > 0.0, "sigma_translation_m must be positive");
  require(start_s >= 0.0, "start_s must not be negative");
  require(stop_s > start_s, "stop_s must be later than start_s");
  require(hold_s >= 0.0, "hold_s must not be negative");
  require(settle_s >= 0.0, "settle_s must not be negative");
  require(type != "topic" || !output.empty() || (faults.empty() && offset_s == 0.0),
          "output must name a topic where faults or an offset change the messages");
  require(output != topic, "output must differ from topic");
  ParseNs(started_ns, "started_ns");
  ParseNs(origin_ns, "origin_ns");
  for (const dendro::FaultConfig& fault : faults) fault.Validate();
}

class SensorSource::Impl {
 public:
  Impl(ros::NodeHandle nh, std::string name, const SensorSourceConfig& config)
      : nh_(nh),
        name_(std::move(name)),
        config_((config.Validate(), config)),
        faults_(config.faults, config.seed),
        progress_(config.progress),
        offset_ns_(Ns(config.offset_s)) {
    timing_.started_ns = ParseNs(config.started_ns, "started_ns");
    timing_.origin_ns = ParseNs(config.origin_ns, "origin_ns");
    timing_.rate = config.rate;
    timing_.stamps_now = config.stamps == "now";
    diagnostics_ = nh_.advertise<diagnostic_msgs::DiagnosticArray>("/diagnostics", 10);
    holding_.readers = config.readers;
    holding_.hold_s = config.hold_s;
    holding_.settle_s = config.settle_s;
    if (!config.released_on.empty()) {
      releases_ = nh_.subscribe(config.released_on, 10, &Impl::OnReleased, this);
    }
    if (!config.acknowledged_on.empty() && !config.readers.empty()) {
      holding_.acknowledger = config.acknowledged_by;
      acknowledgements_ = nh_.subscribe<dendro_slam::GraphStatus>(
          config.acknowledged_on, 100, [this](const dendro_slam::GraphStatusConstPtr& status) {
            acknowledged_ns_ = ToNs(status->header.stamp);
          });
    }
  }

  void Run() {
    if (config_.type == "vlp16_udp") {
      RunUdp();
    } else if (config_.type == "vlp16_pcap") {
      RunCapture();
    } else if (config_.type == "poses") {
      RunPoses();
    } else {
      RunTopic();
    }
    Drain();
  }

 private:
  struct Late {
    std::int64_t release_ns;
    std::function<void()> send;
  };

  double ScriptS() const { return static_cast<double>(HostNs() - timing_.started_ns) * 1e-9; }
  bool On(double script_s) const { return script_s >= config_.start_s && script_s < config_.stop_s; }

  void OnReleased(const std_msgs::String& reader) {
    const std::lock_guard<std::mutex> lock(released_mutex_);
    released_ = reader.data;
  }

  /// What is due every few milliseconds, whatever the source.
  void Tick() {
    const std::int64_t now_ns = HostNs();
    while (!late_.empty() && late_.front().release_ns <= now_ns) {
      const std::function<void()> send = std::move(late_.front().send);
      late_.pop_front();
      send();
    }
    if (main_) {
      {
        const std::lock_guard<std::mutex> lock(released_mutex_);
        if (!released_.empty()) main_->Release(released_);
        if (!released_.empty() && fix_) fix_->Release(released_);
        released_.clear();
      }
      main_->Tick();
      if (acknowledged_ns_ > 0) main_->Acknowledge(acknowledged_ns_ - kOverlapNs);
    }
    if (fix_) fix_->Tick();
    Report(false);
  }

  /// Sends now, or after a delay; the order stays.
  void Send(std::int64_t delay_ns, std::function<void()> send) {
    if (delay_ns == 0 && late_.empty()) {
      send();
      return;
    }
    delayed_ += delay_ns > 0 ? 1 : 0;
    std::int64_t release_ns = HostNs() + delay_ns;
    if (!late_.empty()) release_ns = std::max(release_ns, late_.back().release_ns);
    late_.push_back({release_ns, std::move(send)});
  }

  /// Waits until a recorded stamp is due.
  /// @return  False when the source ends before: its time is over, or ROS shuts down.
  bool WaitFor(std::int64_t recorded_ns) {
    const double due_s = timing_.DueS(recorded_ns);
    while (ros::ok()) {
      Tick();
      const double wait_s = due_s - ScriptS();
      if (due_s >= config_.stop_s) return false;
      if (wait_s <= 0.0) return true;
      ros::WallDuration(std::min(wait_s, kPollS)).sleep();
    }
    return false;
  }

  // --- VLP-16 --------------------------------------------------------------------------------

  void AdvertiseLidar() {
    main_ = std::make_unique<HoldingPublisher>(
        nh_, HoldingPublisher::Options<VelodyneScan>(config_.topic, 500), holding_);
    if (config_.fix_topic.empty()) return;
    fix_ = std::make_unique<HoldingPublisher>(
        nh_, HoldingPublisher::Options<sensor_msgs::NavSatFix>(config_.fix_topic, 500), holding_);
  }

  /// @param stamp_ns     Under which it is published.
  /// @param recorded_ns  In the recording; equal to stamp_ns for a live sensor.
  void OnData(const dendro::UdpPacket& packet, std::int64_t stamp_ns, std::int64_t recorded_ns) {
    const dendro::FaultVerdict fault = faults_.At(ScriptS(), static_cast<std::uint64_t>(recorded_ns));
    if (fault.lost) {
      ++lost_by_fault_;
      return;
    }
    stamp_ns += fault.stamp_shift_ns;
    firings_.clear();
    decoder_.DecodeData(packet.payload.data(), packet.payload.size(), stamp_ns, firings_);
    packet_rate_.Add();
    if (packet.payload.size() != dendro::vlp16::kDataPacketBytes) return;
    if (!scan_) scan_ = boost::make_shared<VelodyneScan>();
    if (scan_->packets.empty()) {
      scan_->header.stamp = ToRosTime(stamp_ns);
      scan_->header.frame_id = config_.frame;
      scan_begin_ = Clock::now();
    }
    VelodynePacket& out = scan_->packets.emplace_back();
    out.stamp = ToRosTime(stamp_ns);
    std::copy(packet.payload.begin(), packet.payload.end(), out.data.begin());
    delay_ns_ = fault.delay_ns;
    last_recorded_ns_ = recorded_ns;
    if (cutter_.Add(packet.payload.data()) || scan_->packets.size() >= kMostPackets) SendScan();
  }

  void SendScan() {
    if (!scan_ || scan_->packets.empty()) return;
    const VelodyneScan::ConstPtr scan = std::move(scan_);
    scan_.reset();
    const std::int64_t recorded_ns = last_recorded_ns_;
    const std::int64_t until_ns = ToNs(scan->packets.back().stamp);
    Send(delay_ns_, [this, scan, recorded_ns, until_ns] {
      rate_.Add();
      main_->Publish<VelodyneScan>(
          scan, until_ns, [this, recorded_ns] { progress_.Write(recorded_ns); });
    });
  }

  /// A sensor that has stopped turning, or was cut off, leaves no complete revolution.
  void SendOldScan() {
    if (!scan_ || scan_->packets.empty()) return;
    if (Clock::now() - scan_begin_ > std::chrono::duration<double>(kLongestTurnS)) SendScan();
  }

  void OnPosition(const dendro::UdpPacket& packet, std::int64_t stamp_ns, std::int64_t key) {
    const auto fix = decoder_.DecodePosition(packet.payload.data(), packet.payload.size(), stamp_ns);
    if (!fix || !fix_) return;
    const dendro::FaultVerdict fault = faults_.At(ScriptS(), static_cast<std::uint64_t>(key));
    if (fault.lost) return;
    const auto msg = boost::make_shared<const sensor_msgs::NavSatFix>(
        ToFixMsg(*fix, fix->stamp_ns + fault.stamp_shift_ns));
    valid_fixes_ += fix->valid ? 1 : 0;
    Send(fault.delay_ns, [this, msg] { fix_->Publish<sensor_msgs::NavSatFix>(msg, 0); });
  }

  void RunUdp() {
    dendro::UdpSourceConfig udp;
    udp.address = config_.address;
    udp.sender = config_.sender;
    udp.port = config_.data_port;
    udp.inherited_fd = config_.data_fd;
    dendro::UdpSource data(udp);
    std::optional<dendro::UdpSource> position;
    if (config_.position_port > 0) {
      udp.port = config_.position_port;
      udp.inherited_fd = config_.position_fd;
      position.emplace(udp);
    }
    AdvertiseLidar();
    dendro::UdpPacket packet;
    while (ros::ok() && ScriptS() < config_.stop_s) {
      // Everything that waits is taken before the next look at the clock.
      for (int burst = 0; burst < 1000; ++burst) {
        if (!data.Receive(packet, burst == 0 ? kPollS : 0.0)) break;
        const std::int64_t stamp_ns = packet.stamp_ns + offset_ns_;
        if (On(ScriptS())) OnData(packet, stamp_ns, stamp_ns);
      }
      while (position && position->Receive(packet, 0.0)) {
        const std::int64_t stamp_ns = packet.stamp_ns + offset_ns_;
        if (On(ScriptS())) OnPosition(packet, stamp_ns, stamp_ns);
      }
      socket_dropped_ = data.dropped();
      other_senders_ = data.other_senders();
      SendOldScan();
      Tick();
    }
    SendScan();
  }

  void RunCapture() {
    dendro::CaptureReplay replay(
        config_.file, config_.data_port, config_.position_port, config_.repeat);
    const auto resume = progress_.Read();
    if (resume) replay.SkipTo(*resume - offset_ns_);
    AdvertiseLidar();
    dendro::UdpPacket packet;
    while (ros::ok() && replay.Next(packet)) {
      const std::int64_t recorded_ns = packet.stamp_ns + offset_ns_;
      if (timing_.DueS(recorded_ns) < config_.start_s) continue;
      if (!WaitFor(recorded_ns)) break;
      const std::int64_t stamp_ns = timing_.StampNs(recorded_ns);
      if (packet.port == config_.data_port) {
        OnData(packet, stamp_ns, recorded_ns);
      } else {
        OnPosition(packet, stamp_ns, recorded_ns);
      }
    }
    SendScan();
  }

  // --- Poses ---------------------------------------------------------------------------------

  void RunPoses() {
    dendro::PoseReplay replay(dendro::ReadPoseFile(config_.file, config_.format), config_.repeat);
    const auto resume = progress_.Read();
    if (resume) replay.SkipTo(*resume - offset_ns_);
    main_ = std::make_unique<HoldingPublisher>(
        nh_, HoldingPublisher::Options<nav_msgs::Odometry>(config_.topic, 5000), holding_);
    while (ros::ok()) {
      std::optional<dendro::StreamedPose> pose = replay.Next();
      if (!pose) break;
      pose->stamp_ns += offset_ns_;
      if (timing_.DueS(pose->stamp_ns) < config_.start_s) continue;
      if (!WaitFor(pose->stamp_ns)) break;
      OnPose(*pose);
    }
  }

  void OnPose(const dendro::StreamedPose& pose) {
    const dendro::FaultVerdict fault =
        faults_.At(ScriptS(), static_cast<std::uint64_t>(pose.stamp_ns));
    if (fault.lost) {
      ++lost_by_fault_;
      return;
    }
    const auto msg = boost::make_shared<nav_msgs::Odometry>();
    msg->header.stamp = ToRosTime(timing_.StampNs(pose.stamp_ns) + fault.stamp_shift_ns);
    msg->header.frame_id = config_.odom_frame;
    msg->child_frame_id = config_.frame;
    msg->pose = ToMsg(fault.T_jump * pose.T_odom_camera,
                      dendro::PoseCovarianceFromConfidence(pose.confidence,
                                                           config_.sigma_rotation_rad,
                                                           config_.sigma_translation_m));
    msg->twist.covariance[0] = -1.0;  // Not known.
    confidence_ = pose.confidence;
    const std::int64_t recorded_ns = pose.stamp_ns;
    Send(fault.delay_ns, [this, msg, recorded_ns] {
      rate_.Add();
      main_->Publish<nav_msgs::Odometry>(msg, ToNs(msg->header.stamp), [this, recorded_ns] {
        progress_.Write(recorded_ns);
      });
    });
  }

  // --- Topics --------------------------------------------------------------------------------

  void RunTopic() {
    ros::Subscriber subscriber = nh_.subscribe<topic_tools::ShapeShifter>(
        config_.topic,
        5000,
        [this](const topic_tools::ShapeShifter::ConstPtr& msg) {
          const std::lock_guard<std::mutex> lock(topic_mutex_);
          topic_queue_.push_back(msg);
        });
    while (ros::ok() && ScriptS() < config_.stop_s) {
      std::deque<topic_tools::ShapeShifter::ConstPtr> messages;
      {
        const std::lock_guard<std::mutex> lock(topic_mutex_);
        messages.swap(topic_queue_);
      }
      for (const auto& msg : messages) {
        if (On(ScriptS())) OnMessage(msg);
      }
      Tick();
      ros::WallDuration(0.002).sleep();
    }
  }

  void OnMessage(const topic_tools::ShapeShifter::ConstPtr& in) {
    if (config_.output.empty()) {
      rate_.Add();
      ReadConfidence(*in);
      return;
    }
    const dendro::FaultVerdict fault = faults_.At(ScriptS(), key_++);
    if (fault.lost) {
      ++lost_by_fault_;
      return;
    }
    topic_tools::ShapeShifter::ConstPtr out = in;
    if (in->getDataType() == ros::message_traits::datatype<nav_msgs::Odometry>()) {
      const auto odometry = in->instantiate<nav_msgs::Odometry>();
      confidence_ = ConfidenceOf(*odometry, kRealsenseVariance);
      odometry->header.stamp =
          ToRosTime(ToNs(odometry->header.stamp) + offset_ns_ + fault.stamp_shift_ns);
      if (!fault.T_jump.isApprox(Eigen::Isometry3d::Identity(), 0.0)) {
        odometry->pose.pose = ToMsg(fault.T_jump * FromMsg(odometry->pose.pose));
      }
      out = Shifted(*in, *odometry);
    } else if (offset_ns_ + fault.stamp_shift_ns != 0) {
      out = WithStampMoved(*in, offset_ns_ + fault.stamp_shift_ns);
    }
    if (!main_) {
      ros::AdvertiseOptions options(config_.output,
                                    5000,
                                    in->getMD5Sum(),
                                    in->getDataType(),
                                    in->getMessageDefinition());
      main_ = std::make_unique<HoldingPublisher>(nh_, options, holding_);
    }
    // Without a stamp nobody can say that he is done with it.
    const std::int64_t until_ns = BeginsWithHeader(*out) ? StampNs(Bytes(*out)) : 0;
    Send(fault.delay_ns, [this, out, until_ns] {
      rate_.Add();
      main_->Publish<topic_tools::ShapeShifter>(out, until_ns);
    });
  }

  void ReadConfidence(const topic_tools::ShapeShifter& msg) {
    if (msg.getDataType() != ros::message_traits::datatype<nav_msgs::Odometry>()) return;
    confidence_ = ConfidenceOf(*msg.instantiate<nav_msgs::Odometry>(), kRealsenseVariance);
  }

  static topic_tools::ShapeShifter::Ptr FromBytes(const topic_tools::ShapeShifter& like,
                                                  std::vector<std::uint8_t>& bytes) {
    const auto out = boost::make_shared<topic_tools::ShapeShifter>();
    out->morph(like.getMD5Sum(), like.getDataType(), like.getMessageDefinition(), "0");
    ros::serialization::IStream stream(bytes.data(), static_cast<std::uint32_t>(bytes.size()));
    out->read(stream);
    return out;
  }

  static topic_tools::ShapeShifter::Ptr Shifted(const topic_tools::ShapeShifter& like,
                                                const nav_msgs::Odometry& odometry) {
    std::vector<std::uint8_t> bytes(ros::serialization::serializationLength(odometry));
    ros::serialization::OStream stream(bytes.data(), static_cast<std::uint32_t>(bytes.size()));
    ros::serialization::serialize(stream, odometry);
    return FromBytes(like, bytes);
  }

  static bool BeginsWithHeader(const topic_tools::ShapeShifter& msg) {
    // The first field of the definition, past its comments.
    std::istringstream definition(msg.getMessageDefinition());
    std::string type;
    for (std::string line; std::getline(definition, line);) {
      std::istringstream words(line.substr(0, line.find('#')));
      if (words >> type) break;
    }
    return (type == "Header" || type == "std_msgs/Header") && msg.size() >= kHeaderBytes;
  }

  static std::vector<std::uint8_t> Bytes(const topic_tools::ShapeShifter& msg) {
    std::vector<std::uint8_t> bytes(msg.size());
    ros::serialization::OStream stream(bytes.data(), static_cast<std::uint32_t>(bytes.size()));
    msg.write(stream);
    return bytes;
  }

  /// Of a message that begins with a header: sequence number, seconds, nanoseconds.
  static std::int64_t StampNs(const std::vector<std::uint8_t>& bytes) {
    std::uint32_t stamp[2];
    std::memcpy(stamp, bytes.data() + kStampAt, sizeof(stamp));
    return ToNs(ros::Time(stamp[0], stamp[1]));
  }

  /// A message of any type that begins with a header, its stamp moved.
  static topic_tools::ShapeShifter::Ptr WithStampMoved(const topic_tools::ShapeShifter& in,
                                                       std::int64_t shift_ns) {
    if (!BeginsWithHeader(in)) {
      throw std::invalid_argument(in.getDataType() + " has no header whose stamp could be moved");
    }
    std::vector<std::uint8_t> bytes = Bytes(in);
    const ros::Time moved = ToRosTime(StampNs(bytes) + shift_ns);
    const std::uint32_t stamp[2] = {moved.sec, moved.nsec};
    std::memcpy(bytes.data() + kStampAt, stamp, sizeof(stamp));
    return FromBytes(in, bytes);
  }

  // --- The end, and what is told meanwhile -----------------------------------------------------

  /// Sends what is still held back or delayed; ROS then needs a moment to hand it out.
  void Drain() {
    while (ros::ok() && (!late_.empty() || (main_ && main_->held() > 0))) {
      Tick();
      ros::WallDuration(kPollS).sleep();
    }
    ended_ = true;
    Report(true);
    if (ros::ok()) ros::WallDuration(0.5).sleep();
  }

  void Report(bool now) {
    const Clock::time_point time = Clock::now();
    if (!now && time - reported_ < std::chrono::duration<double>(kReportEveryS)) return;
    reported_ = time;
    diagnostic_msgs::DiagnosticStatus status;
    status.name = name_;
    status.hardware_id = "dendro_slam";
    const auto add = [&status](const std::string& key, const std::string& value) {
      diagnostic_msgs::KeyValue pair;
      pair.key = key;
      pair.value = value;
      status.values.push_back(pair);
    };
    const auto count = [&add](const std::string& key, std::uint64_t value) {
      add(key, std::to_string(value));
    };
    const dendro::Vlp16Counters& counters = decoder_.counters();
    const bool lidar = config_.type == "vlp16_udp" || config_.type == "vlp16_pcap";
    add("type", config_.type);
    count("messages", rate_.total());
    add("rate [Hz]", fmt::format("{:.1f}", rate_.Hz()));
    count("dropped by fault", lost_by_fault_);
    count("delayed by fault", delayed_);
    const std::size_t held = main_ ? main_->held() : 0;
    count("held back", held);
    if (lidar) {
      add("packets [1/s]", fmt::format("{:.0f}", packet_rate_.Hz()));
      count("packets", counters.packets);
      // By the timestamps, so those that the socket dropped are among them.
      count("packets lost", counters.lost);
      count("packets dropped by the socket", socket_dropped_);
      count("packets truncated", counters.truncated);
      count("packets foreign", counters.foreign);
      count("packets duplicated", counters.duplicated);
      count("packets reordered", counters.reordered);
      count("packets of other senders", other_senders_);
      count("fixes", counters.positions);
      count("fixes valid", valid_fixes_);
      add("gps clock", decoder_.gps_locked() ? "locked" : "not locked");
    }
    if (confidence_) add("confidence", std::to_string(*confidence_));
    Judge(status, held);
    diagnostic_msgs::DiagnosticArray array;
    array.header.stamp = ros::Time::now();
    array.status.push_back(status);
    diagnostics_.publish(array);
    lost_before_ = counters.lost;
  }

  void Judge(diagnostic_msgs::DiagnosticStatus& status, std::size_t held) {
    using Status = diagnostic_msgs::DiagnosticStatus;
    const dendro::Vlp16Counters& counters = decoder_.counters();
    const double script_s = ScriptS();
    const bool lidar = config_.type == "vlp16_udp" || config_.type == "vlp16_pcap";
    const auto say = [&status](unsigned char level, const std::string& text) {
      if (level < status.level || !status.message.empty()) return;
      status.level = level;
      status.message = text;
    };
    status.level = Status::OK;
    if (ended_) return say(Status::OK, "ended");
    if (script_s < config_.start_s) return say(Status::OK, "not yet on");
    if (held > 0) {
      std::string names;
      for (const std::string& name : main_->MissingReaders()) names += " " + name;
      if (!names.empty()) return say(Status::WARN, "waits for" + names);
    }
    if (lidar && counters.packets > 0 && counters.foreign == counters.packets) {
      return say(Status::ERROR, "the packets are not those of a VLP-16");
    }
    const double silent_s = lidar ? packet_rate_.SilentS() : rate_.SilentS();
    if (silent_s > kSilenceS && script_s - config_.start_s > kSilenceS) {
      return say(Status::ERROR, fmt::format("silent for {:.0f} s", silent_s));
    }
    if (counters.lost > lost_before_) say(Status::WARN, "loses packets");
    if (confidence_ && *confidence_ <= 1) say(Status::WARN, "tracker is not confident");
    if (status.message.empty()) status.message = "running";
  }

  static constexpr std::size_t kStampAt = 4;  ///< Of a header in a message, behind the sequence.
  static constexpr std::size_t kHeaderBytes = 16;
  static constexpr double kRealsenseVariance = 0.01;  ///< realsense2_camera at confidence 3.

  ros::NodeHandle nh_;
  const std::string name_;
  const SensorSourceConfig config_;
  const dendro::FaultPlan faults_;
  const Progress progress_;
  const std::int64_t offset_ns_;
  dendro::ReplayTiming timing_;
  HoldingConfig holding_;
  std::atomic<std::int64_t> acknowledged_ns_{0};  ///< The last scan that was mapped.
  ros::Publisher diagnostics_;
  ros::Subscriber acknowledgements_;
  std::mutex released_mutex_;
  std::string released_;
  ros::Subscriber releases_;
  std::unique_ptr<HoldingPublisher> main_;
  std::unique_ptr<HoldingPublisher> fix_;
  std::deque<Late> late_;

  dendro::Vlp16Decoder decoder_;  ///< For the clock of the fixes and the counts.
  std::vector<dendro::Vlp16Firing> firings_;
  dendro::RevolutionCutter cutter_;
  VelodyneScan::Ptr scan_;
  Clock::time_point scan_begin_;
  std::int64_t delay_ns_ = 0;
  std::int64_t last_recorded_ns_ = 0;

  std::mutex topic_mutex_;
  std::deque<topic_tools::ShapeShifter::ConstPtr> topic_queue_;
  std::uint64_t key_ = 0;

  RateMeter rate_;
  RateMeter packet_rate_;
  std::uint64_t lost_by_fault_ = 0;
  std::uint64_t delayed_ = 0;
  std::uint64_t socket_dropped_ = 0;
  std::uint64_t other_senders_ = 0;
  std::uint64_t valid_fixes_ = 0;
  std::uint64_t lost_before_ = 0;
  std::optional<int> confidence_;
  bool ended_ = false;
  Clock::time_point reported_ = Clock::now();
};

SensorSource::SensorSource(ros::NodeHandle nh, std::string name, const SensorSourceConfig& config)
    : impl_(std::make_unique<Impl>(nh, std::move(name), config)) {}

SensorSource::~SensorSource() = default;

void SensorSource::Run() { impl_->Run(); }

}  // namespace dendro_ros
