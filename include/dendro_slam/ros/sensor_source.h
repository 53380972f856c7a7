#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include <ros/node_handle.h>

#include "dendro_slam/sensors/fault_plan.h"
#include "dendro_slam/sensors/vlp16_packet.h"

namespace dendro_ros {

/// One sensor of the rig, live or recorded, as `driver_bridge` starts it. Times of the script are
/// seconds since `started_ns`; nanoseconds are text because YAML's whole numbers are too small.
struct SensorSourceConfig {
  std::string type = "";       ///< vlp16_udp, vlp16_pcap, poses or topic.
  std::string topic = "";      ///< What it publishes: packets or odometry; of type topic: what it
                               ///< listens to.
  std::string output = "";     ///< Of type topic: where messages are passed on; empty: only watched.
  std::string fix_topic = "";  ///< Positions of the receiver at the lidar; empty: not published.
  std::string frame = "velodyne";   ///< Frame of the lidar, or of the body whose pose is told.
  std::string odom_frame = "odom";  ///< Frame that the poses are given in.

  std::string address = "0.0.0.0";  ///< vlp16_udp: local address to listen on.
  std::string sender = "";          ///< vlp16_udp: only packets from this address; empty: from any.
  int data_port = dendro::vlp16::kDataPort;          ///< UDP port of the data packets.
  int position_port = dendro::vlp16::kPositionPort;  ///< UDP port of the positions; 0: none.
  int data_fd = -1;      ///< Socket inherited from the parent; -1: one is bound.
  int position_fd = -1;  ///< Socket inherited from the parent; -1: one is bound.

  std::string file = "";        ///< vlp16_pcap, poses: the recording.
  std::string format = "auto";  ///< poses: tum, realsense, or auto.
  double rate = 1.0;            ///< Speed of the replay. > 0.
  bool repeat = false;          ///< Begin again at the end.
  std::string stamps = "now";   ///< "now": moved to the time of the replay; "recorded": kept.
  double sigma_rotation_rad = 0.1;  ///< poses: at full confidence; 0.1 as realsense2_camera [rad].
  double sigma_translation_m = 0.1;  ///< poses: at full confidence; 0.1 as realsense2_camera [m].

  std::string started_ns = "0";  ///< Script time 0 in the computer's clock [ns since 1970].
  std::string origin_ns = "0";   ///< Recorded stamp (with offset) played at script time 0 [ns].
  double offset_s = 0.0;         ///< Added to the sensor's stamps [s].
  double start_s = 0.0;          ///< Silent before [s of script time].
  double stop_s = 1e9;           ///< Ends then [s of script time]. > start_s.
  std::vector<dendro::FaultConfig> faults;
  int seed = 1;  ///< Of the faults.

  std::vector<std::string> readers;  ///< Nodes that must not miss a message while they are restarted.
  double hold_s = 10.0;              ///< They are waited for at most this long [s].
  double settle_s = 1.0;             ///< And given this time after they came back [s].
  std::string acknowledged_by = "";  ///< The reader that maps: it is sent again what died with it.
  std::string acknowledged_on = "";  ///< Its dendro_slam/GraphStatus topic; empty: nothing is kept.
  std::string released_on = "";  ///< std_msgs/String topic that names a reader which is gone on
                                 ///< purpose and not to be waited for; empty: none.
  std::string progress = "";  ///< File that remembers how far a replay is, across restarts.

  /// @throws std::invalid_argument naming the field.
  void Validate() const;
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("type", type);
    v("topic", topic);
    v("output", output);
    v("fix_topic", fix_topic);
    v("frame", frame);
    v("odom_frame", odom_frame);
    v("address", address);
    v("sender", sender);
    v("data_port", data_port);
    v("position_port", position_port);
    v("data_fd", data_fd);
    v("position_fd", position_fd);
    v("file", file);
    v("format", format);
    v("rate", rate);
    v("repeat", repeat);
    v("stamps", stamps);
    v("sigma_rotation_rad", sigma_rotation_rad);
    v("sigma_translation_m", sigma_translation_m);
    v("started_ns", started_ns);
    v("origin_ns", origin_ns);
    v("offset_s", offset_s);
    v("start_s", start_s);
    v("stop_s", stop_s);
    v("faults", faults);
    v("seed", seed);
    v("readers", readers);
    v("hold_s", hold_s);
    v("settle_s", settle_s);
    v("acknowledged_by", acknowledged_by);
    v("acknowledged_on", acknowledged_on);
    v("released_on", released_on);
    v("progress", progress);
  }
};

/// Runs one sensor until its recording or its time ends, or ROS shuts down. Publishes packets
/// (velodyne_msgs/VelodyneScan, a revolution each) and fixes, or odometry, or passes a topic on, with
/// the faults of the script; and once a second on /diagnostics its rate, losses and confidence.
class SensorSource {
 public:
  /// @throws std::invalid_argument, PcapError, PoseStreamError, UdpError: one line for the user.
  SensorSource(ros::NodeHandle nh, std::string name, const SensorSourceConfig& config);
  ~SensorSource();

  /// Needs a spinner beside it for the callbacks of connections.
  void Run();

 private:
  class Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace dendro_ros
