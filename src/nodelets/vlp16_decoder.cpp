#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <nodelet/nodelet.h>
#include <pluginlib/class_list_macros.hpp>
#include <sensor_msgs/PointCloud2.h>

#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/ros/node_config.h"
#include "dendro_slam/ros/point_cloud2.h"
#include "dendro_slam/ros/stage_diagnostics.h"
#include "dendro_slam/ros/velodyne_msgs.h"
#include "dendro_slam/ros/worker.h"
#include "dendro_slam/sensors/scan_assembler.h"
#include "dendro_slam/sensors/vlp16_decoder.h"

namespace dendro_ros {

/// VLP-16 packets in, clouds as velodyne_pointcloud writes them out.
class Vlp16Decoder : public nodelet::Nodelet {
 private:
  using Input = VelodyneScan::ConstPtr;

  void onInit() override {
    try {
      ros::NodeHandle& nh = getNodeHandle();
      config_ =
          ReadConfig<Vlp16DecoderNodeConfig>(ReadRosParams(getPrivateNodeHandle()), getName());
      diagnostics_ = std::make_unique<StageDiagnostics>(nh, getName(), "");
      decoder_.emplace(config_.clock);
      assembler_.emplace(config_.assembler);
      points_ = nh.advertise<sensor_msgs::PointCloud2>("velodyne_points", 10);
      worker_ = std::make_unique<Worker<Input>>(static_cast<std::size_t>(config_.queue_size),
                                                [this](Input& packets) { Work(*packets); });
      subscriber_ = nh.subscribe<VelodyneScan>(
          "velodyne_packets", 1000, [this](const VelodyneScan::ConstPtr& packets) {
            diagnostics_->Dropped("queue full", worker_->Push(packets, true));
          });
    } catch (const std::exception& error) {
      NODELET_FATAL("%s", error.what());
      throw;
    }
  }

  void Work(const VelodyneScan& message) {
    if (points_.getNumSubscribers() == 0) return;
    try {
      for (const VelodynePacket& packet : message.packets) Decode(packet, message.header.frame_id);
      const dendro::Vlp16Counters& counters = decoder_->counters();
      diagnostics_->Show("packets", static_cast<double>(counters.packets));
      diagnostics_->Show("packets lost", static_cast<double>(counters.lost));
      diagnostics_->Show("packets foreign", static_cast<double>(counters.foreign));
      diagnostics_->Show("packets truncated", static_cast<double>(counters.truncated));
      diagnostics_->Show("packets duplicated", static_cast<double>(counters.duplicated));
      diagnostics_->Show("packets reordered", static_cast<double>(counters.reordered));
      diagnostics_->Show("blocks damaged", static_cast<double>(counters.bad_blocks));
      diagnostics_->Show("clock jumps", static_cast<double>(counters.clock_jumps));
      if (decoder_->odd_factory_byte() && !said_odd_factory_byte_) {
        said_odd_factory_byte_ = true;
        NODELET_WARN("%s: the packets name model 0x%02x, their timing is a VLP-16's: decoded as such",
                     subscriber_.getTopic().c_str(),
                     *decoder_->odd_factory_byte());
      }
      if (counters.packets > 0 && counters.foreign == counters.packets) {
        NODELET_ERROR_THROTTLE(10.0,
                               "%s: the packets are not those of a VLP-16",
                               subscriber_.getTopic().c_str());
      }
    } catch (const std::exception& error) {
      diagnostics_->Problem(error.what());
      NODELET_ERROR_THROTTLE(5.0, "packets dropped: %s", error.what());
    }
  }

  void Decode(const VelodynePacket& packet, const std::string& frame_id) {
    const Stopwatch watch;
    firings_.clear();
    decoder_->DecodeData(packet.data.data(), packet.data.size(), ToNs(packet.stamp), firings_);
    for (const dendro::Vlp16Firing& firing : firings_) {
      const auto scan = assembler_->Add(firing);
      if (!scan) continue;
      points_.publish(ToVelodyneCloud(*scan, frame_id.empty() ? config_.frame : frame_id));
      diagnostics_->Processed(scan->stamp_ns, watch.Seconds());
    }
  }

  Vlp16DecoderNodeConfig config_;
  std::unique_ptr<StageDiagnostics> diagnostics_;
  std::optional<dendro::Vlp16Decoder> decoder_;
  std::optional<dendro::ScanAssembler> assembler_;
  std::vector<dendro::Vlp16Firing> firings_;
  bool said_odd_factory_byte_ = false;
  ros::Publisher points_;
  ros::Subscriber subscriber_;
  std::unique_ptr<Worker<Input>> worker_;  // Last: its thread uses everything above.
};

}  // namespace dendro_ros

PLUGINLIB_EXPORT_CLASS(dendro_ros::Vlp16Decoder, nodelet::Nodelet)
