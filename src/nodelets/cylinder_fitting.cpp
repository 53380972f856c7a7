#include <memory>
#include <optional>
#include <variant>

#include <nodelet/nodelet.h>
#include <pluginlib/class_list_macros.hpp>
#include <sensor_msgs/PointCloud2.h>
#include <visualization_msgs/MarkerArray.h>

#include "dendro_slam/cylinder_fitting/cylinder_fitter.h"
#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/ros/markers.h"
#include "dendro_slam/ros/node_config.h"
#include "dendro_slam/ros/stage_diagnostics.h"
#include "dendro_slam/ros/stamp_join.h"
#include "dendro_slam/ros/worker.h"

namespace dendro_ros {

/// Labelled scans and segments in, cylinders out (stage 3).
class CylinderFitting : public nodelet::Nodelet {
 private:
  using Scan = sensor_msgs::PointCloud2ConstPtr;
  using Segments = dendro_slam::SegmentsConstPtr;
  using Input = std::variant<Scan, Segments>;

  void onInit() override {
    try {
      ros::NodeHandle& nh = getNodeHandle();
      const auto config = ReadConfig<CylinderFittingNodeConfig>(
          ReadRosParams(getPrivateNodeHandle()), getName());
      diagnostics_ = std::make_unique<StageDiagnostics>(nh, getName(), "cylinder_fitting");
      fitter_.emplace(config.stage);
      const auto capacity = static_cast<std::size_t>(config.queue_size);
      join_.emplace(capacity, StampJoin<Scan, Segments>::Missing::kDrop);
      cylinders_ = nh.advertise<dendro_slam::ScanCylinders>("cylinders", 5);
      markers_ = nh.advertise<visualization_msgs::MarkerArray>("cylinder_markers", 2);
      worker_ =
          std::make_unique<Worker<Input>>(2 * capacity, [this](Input& input) { Work(input); });
      const auto push = [this](Input input) {
        diagnostics_->Dropped("queue full", worker_->Push(std::move(input), true));
      };
      scan_subscriber_ = nh.subscribe<sensor_msgs::PointCloud2>(
          "wood_scan", 100, [push](const Scan& scan) { push(scan); });
      segments_subscriber_ = nh.subscribe<dendro_slam::Segments>(
          "segments", 100, [push](const Segments& segments) { push(segments); });
    } catch (const std::exception& error) {
      NODELET_FATAL("%s", error.what());
      throw;
    }
  }

  void Work(Input& input) {
    if (const auto* scan = std::get_if<Scan>(&input)) {
      join_->AddFirst(ToNs((*scan)->header.stamp), *scan);
    } else {
      const auto& segments = std::get<Segments>(input);
      join_->AddSecond(ToNs(segments->header.stamp), segments);
    }
    diagnostics_->Dropped("without a partner", join_->TakeDropped());
    while (const auto joined = join_->Pop()) Fit(*joined->first, **joined->second);
  }

  void Fit(const sensor_msgs::PointCloud2& scan_msg, const dendro_slam::Segments& segments_msg) {
    if (cylinders_.getNumSubscribers() + markers_.getNumSubscribers() == 0) return;
    try {
      const Stopwatch watch;
      const dendro::LabelledScan scan = FromWoodScan(scan_msg, scan_subscriber_.getTopic());
      const std::vector<dendro::Segment> segments = FromMsg(segments_msg, scan.image.size());
      const std::vector<dendro::FittedCylinder> cylinders = fitter_->Fit(scan, segments);
      const std::int64_t stamp_ns = scan.image.stamp_ns;
      cylinders_.publish(ToMsg(
          cylinders, stamp_ns, scan_msg.header.frame_id, dendro::FitGroundPlane(scan)));
      double measured = 0;
      for (const auto& fit : cylinders) measured += fit.status == dendro::FitStatus::kMeasured;
      diagnostics_->Show("cylinders measured", measured);
      diagnostics_->Show("segments unresolved", static_cast<double>(cylinders.size()) - measured);
      diagnostics_->Processed(stamp_ns, watch.Seconds());
      if (markers_.getNumSubscribers() > 0) {
        markers_.publish(ScanCylinderMarkers(cylinders, stamp_ns, scan_msg.header.frame_id));
      }
    } catch (const std::exception& error) {
      diagnostics_->Dropped("unusable");
      diagnostics_->Problem(error.what());
      NODELET_ERROR_THROTTLE(5.0, "scan dropped: %s", error.what());
    }
  }

  std::unique_ptr<StageDiagnostics> diagnostics_;
  std::optional<dendro::CylinderFitter> fitter_;
  std::optional<StampJoin<Scan, Segments>> join_;
  ros::Publisher cylinders_;
  ros::Publisher markers_;
  ros::Subscriber scan_subscriber_;
  ros::Subscriber segments_subscriber_;
  std::unique_ptr<Worker<Input>> worker_;  // Last: its thread uses everything above.
};

}  // namespace dendro_ros

PLUGINLIB_EXPORT_CLASS(dendro_ros::CylinderFitting, nodelet::Nodelet)
