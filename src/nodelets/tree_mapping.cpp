#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <utility>
#include <variant>

#include <nav_msgs/Odometry.h>
#include <nav_msgs/Path.h>
#include <nodelet/nodelet.h>
#include <pluginlib/class_list_macros.hpp>
#include <sensor_msgs/NavSatFix.h>
#include <sensor_msgs/PointCloud2.h>
#include <std_srvs/Trigger.h>
#include <tf2_ros/buffer.h>
#include <tf2_ros/transform_broadcaster.h>
#include <tf2_ros/transform_listener.h>

#include "dendro_slam/LoadMap.h"
#include "dendro_slam/SaveMap.h"
#include "dendro_slam/StageLatency.h"
#include "dendro_slam/mapping/pipeline.h"
#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/ros/latency_collector.h"
#include "dendro_slam/ros/map_frames.h"
#include "dendro_slam/ros/map_session.h"
#include "dendro_slam/ros/node_config.h"
#include "dendro_slam/ros/scan_gate.h"
#include "dendro_slam/ros/stage_diagnostics.h"
#include "dendro_slam/ros/stamp_join.h"
#include "dendro_slam/ros/worker.h"

namespace dendro_ros {

/// Cylinders and both odometries in; map, path, map -> odom and graph status out (stage 4).
class TreeMapping : public nodelet::Nodelet {
 private:
  using Cylinders = dendro_slam::ScanCylindersConstPtr;
  using Odometry = nav_msgs::OdometryConstPtr;
  struct IcpOdometry {
    Odometry msg;
  };
  struct RestoreSession {};
  using Fix = sensor_msgs::NavSatFixConstPtr;
  using WoodScan = sensor_msgs::PointCloud2ConstPtr;
  using Input = std::variant<Cylinders, Odometry, IcpOdometry, WoodScan, RestoreSession, Fix>;
  using CloudJoin = StampJoin<Eigen::Isometry3d, WoodScan>;
  struct WaitingScan {
    Cylinders cylinders;
    std::shared_ptr<const dendro::RelativeMotion> icp;  ///< Null: ICP found no motion.
  };

  void onInit() override {
    try {
      ros::NodeHandle& nh = getNodeHandle();
      ros::NodeHandle& private_nh = getPrivateNodeHandle();
      config_ = ReadConfig<TreeMappingNodeConfig>(ReadRosParams(private_nh), getName());
      diagnostics_ = std::make_unique<StageDiagnostics>(nh, getName(), "mapping");
      stage_ = std::make_unique<dendro::TreeMappingStage>(config_.stage);
      tf_listener_ = std::make_unique<tf2_ros::TransformListener>(tf_, nh, false);
      const auto capacity = static_cast<std::size_t>(config_.queue_size);
      join_.emplace(capacity, StampJoin<Cylinders, IcpOdometry>::Missing::kAccept);
      gate_.emplace(config_.stage.odometry_timeout_s,
                    capacity,
                    config_.stage.pose_buffer,
                    LidarMount(config_.lidar_mount, &tf_));
      map_ = nh.advertise<dendro_slam::TreeMap>("tree_map", 1, true);
      path_ = nh.advertise<nav_msgs::Path>("path", 1, true);
      status_ = private_nh.advertise<dendro_slam::GraphStatus>("graph_status", 100);
      if (!config_.session_directory.empty()) {
        session_.emplace(config_.session_directory, config_.session_id, config_.resume);
      }
      saved_ = ros::SteadyTime::now();
      worker_ =
          std::make_unique<Worker<Input>>(2 * capacity, [this](Input& input) { Work(input); });
      // First in the queue: scans wait behind it.
      if (session_ && session_->found()) worker_->Push(RestoreSession{}, false);
      latency_subscriber_ = nh.subscribe<dendro_slam::StageLatency>(
          "stage_latency", 1000, [this](const dendro_slam::StageLatencyConstPtr& latency) {
            latencies_.Add(*latency);
          });
      if (config_.stage.use_odometry) {
        odometry_subscriber_ = nh.subscribe<nav_msgs::Odometry>(
            "odometry", 1000, [this](const Odometry& msg) { worker_->Push(msg, false); });
      }
      if (config_.stage.use_icp) {
        icp_subscriber_ = nh.subscribe<nav_msgs::Odometry>(
            "icp_odometry", 1000, [this](const Odometry& msg) {
              worker_->Push(IcpOdometry{msg}, false);
            });
      }
      fix_subscriber_ = nh.subscribe<sensor_msgs::NavSatFix>(
          "fix", 100, [this](const Fix& msg) { worker_->Push(msg, false); });
      cloud_join_.emplace(capacity, CloudJoin::Missing::kDrop);
      if (config_.stage.map_cloud.enabled) {
        wood_scan_subscriber_ = nh.subscribe<sensor_msgs::PointCloud2>(
            "wood_scan", 100, [this](const WoodScan& msg) { worker_->Push(msg, false); });
      }
      cylinders_subscriber_ = nh.subscribe<dendro_slam::ScanCylinders>(
          "cylinders", 100, [this](const Cylinders& msg) {
            diagnostics_->Dropped("queue full", worker_->Push(msg, true));
          });
      save_ = private_nh.advertiseService("save_map", &TreeMapping::Save, this);
      load_ = private_nh.advertiseService("load_map", &TreeMapping::Load, this);
      reset_ = private_nh.advertiseService("reset", &TreeMapping::Reset, this);
    } catch (const std::exception& error) {
      NODELET_FATAL("%s", error.what());
      throw;
    }
  }

  void Work(Input& input) {
    const std::lock_guard<std::mutex> lock(mutex_);
    try {
      if (const auto* odometry = std::get_if<Odometry>(&input)) {
        if (gate_->AddOdometry(**odometry) == GateEvent::kTimeJumpedBack) {
          TimeJumpedBack(odometry_subscriber_.getTopic());
        }
      } else if (std::holds_alternative<RestoreSession>(input)) {
        Restore();
      } else if (const auto* fix = std::get_if<Fix>(&input)) {
        const auto geo = FromMsg(**fix);
        if (geo && stage_->AddFix(*geo)) diagnostics_->Show("GNSS fixes", ++num_fixes_);
      } else if (const auto* icp = std::get_if<IcpOdometry>(&input)) {
        join_->AddSecond(ToNs(icp->msg->header.stamp), *icp);
      } else if (const auto* scan = std::get_if<WoodScan>(&input)) {
        cloud_join_->AddSecond(ToNs((*scan)->header.stamp), *scan);
      } else {
        AddCylinders(std::get<Cylinders>(input));
      }
      while (auto joined = join_->Pop()) AddJoined(joined->first, joined->second);
      diagnostics_->Dropped("queue full", join_->TakeDropped());
      while (const auto waiting = gate_->Pop()) Process(*waiting);
      while (const auto mapped = cloud_join_->Pop()) {
        stage_->AddPoints(FromWoodScan(**mapped->second, wood_scan_subscriber_.getTopic()),
                          mapped->first);
      }
    } catch (const std::exception& error) {
      diagnostics_->Dropped("unusable");
      diagnostics_->Problem(error.what());
      NODELET_ERROR_THROTTLE(5.0, "scan dropped: %s", error.what());
    }
  }

  void AddCylinders(const Cylinders& cylinders) {
    if (config_.stage.use_icp) {
      join_->AddFirst(ToNs(cylinders->header.stamp), cylinders);
    } else {
      AddToGate({cylinders, nullptr});
    }
  }

  void AddJoined(const Cylinders& cylinders, const std::optional<IcpOdometry>& icp) {
    WaitingScan scan{cylinders, nullptr};
    if (icp) {
      if (last_icp_) {
        if (const auto motion = MotionBetween(*last_icp_, *icp->msg)) {
          scan.icp = std::make_shared<const dendro::RelativeMotion>(*motion);
        }
      }
      last_icp_ = icp->msg;
    }
    AddToGate(std::move(scan));
  }

  void AddToGate(WaitingScan scan) {
    std::size_t dropped = 0;
    const std_msgs::Header header = scan.cylinders->header;
    const std::int64_t stamp_ns = ToNs(header.stamp);
    const GateEvent event =
        gate_->AddScan(stamp_ns, stamp_ns, header.frame_id, std::move(scan), &dropped);
    diagnostics_->Dropped("waiting for odometry", dropped);
    if (event == GateEvent::kTimeJumpedBack) TimeJumpedBack(cylinders_subscriber_.getTopic());
    if (event == GateEvent::kRefused) diagnostics_->Dropped("not in order");
  }

  void TimeJumpedBack(const std::string& topic) {
    NODELET_WARN("%s: time jumped back; the map starts anew", topic.c_str());
    Forget();
  }

  void Forget() {
    stage_->Reset();
    StartSessionAnew(nullptr);
    last_icp_.reset();
    cloud_join_.emplace(static_cast<std::size_t>(config_.queue_size), CloudJoin::Missing::kDrop);
    latencies_.Reset();
    diagnostics_->ResetCounts();
  }

  /// What the map goes on from is no longer what the session holds. Where that cannot be kept, mapping
  /// goes on without a session.
  void StartSessionAnew(const std::function<void(const std::string&)>& write_base) {
    if (!session_) return;
    try {
      session_->StartAnew(write_base);
    } catch (const std::exception& error) {
      session_.reset();
      diagnostics_->Problem(error.what());
      NODELET_ERROR("mapping goes on, but a crash would bring the map before it back: %s", error.what());
    }
  }

  void Process(const WaitingScan& scan) {
    const Stopwatch watch;
    const std_msgs::Header& header = scan.cylinders->header;
    dendro::MapperInput input;
    input.stamp_ns = ToNs(header.stamp);
    input.cylinders = FromMsg(*scan.cylinders);
    if (scan.icp) input.icp = *scan.icp;
    std::optional<Eigen::Isometry3d> T_odom_body;
    if (gate_->poses() != nullptr) T_odom_body = gate_->poses()->Lookup(input.stamp_ns);
    if (T_odom_body) input.T_odom_lidar = *T_odom_body * gate_->T_body_lidar();
    const dendro::MapperResult result = stage_->Process(input, GroundFromMsg(*scan.cylinders));
    KeepInSession(input, *scan.cylinders, result.is_key_frame);
    if (config_.stage.map_cloud.enabled) {
      cloud_join_->AddFirst(input.stamp_ns, result.T_map_lidar);
    }
    diagnostics_->Processed(input.stamp_ns, watch.Seconds());
    if (!result.warning.empty()) NODELET_WARN_THROTTLE(5.0, "%s", result.warning.c_str());
    // WoodSegmentation needs the same transform and says on the console what is missing.
    if (!gate_->mount_error().empty()) diagnostics_->Problem(gate_->mount_error());
    PublishStatus(result, input, watch.Seconds());
    if (config_.publish_tf) PublishTransforms(result, header, T_odom_body);
    if (result.is_key_frame) PublishMap();
  }

  /// Maps again what the process that died had mapped.
  void Restore() {
    const Stopwatch watch;
    if (session_->HasBase()) stage_->Load(dendro::LoadMap(session_->base_directory()));
    const std::size_t scans = session_->ForEach([this](const dendro_slam::MappedScan& scan) {
      stage_->Process(FromMsg(scan), GroundFromMsg(scan.cylinders));
    });
    if (!session_->same_run()) {
      // The odometry has begun anew elsewhere: the place must be recognised first.
      const dendro::MapFiles files = stage_->Files(DescribeConfig(config_.stage));
      StartSessionAnew([&files](const std::string& directory) { dendro::SaveMap(directory, files); });
      stage_->Load(files);
    }
    diagnostics_->Show("scans restored", static_cast<double>(scans));
    NODELET_WARN("the map of %zu scans in %s was restored in %.1f s",
                 scans,
                 config_.session_directory.c_str(),
                 watch.Seconds());
    PublishMap();
  }

  void KeepInSession(const dendro::MapperInput& input,
                     const dendro_slam::ScanCylinders& cylinders,
                     bool is_key_frame) {
    if (!session_) return;
    try {
      session_->Append(ToMappedScan(input, cylinders));
      if (!is_key_frame || (ros::SteadyTime::now() - saved_).toSec() < config_.autosave_s) return;
      saved_ = ros::SteadyTime::now();
      SaveTo(session_->map_directory());
    } catch (const std::exception& error) {
      diagnostics_->Problem(error.what());
      NODELET_ERROR("mapping goes on, but a crash would lose the map from here on: %s", error.what());
    }
  }

  dendro::MapFiles SaveTo(const std::string& directory) {
    dendro::MapFiles files = stage_->Files(DescribeConfig(config_.stage));
    files.frame = config_.map_frame;
    const dendro::StageTimer timer = latencies_.Timer();
    dendro::SaveMap(directory, files, &timer);
    return files;
  }

  void PublishStatus(const dendro::MapperResult& result,
                     const dendro::MapperInput& input,
                     double latency_s) {
    const dendro_slam::GraphStatusPtr status = ToMsg(result, config_.map_frame);
    status->used_odometry = input.T_odom_lidar.has_value() && !result.odometry_rejected;
    status->used_icp = input.icp.has_value();
    if (result.is_key_frame) {
      num_landmarks_ = static_cast<int>(stage_->mapper().Landmarks().size());
      num_all_landmarks_ = static_cast<int>(stage_->mapper().AllLandmarks().size());
    }
    status->num_landmarks = num_landmarks_;
    status->num_candidates = num_all_landmarks_ - num_landmarks_;
    status->latency = latency_s;
    status->scans_mapped = diagnostics_->processed();
    status->scans_dropped = latencies_.dropped();
    diagnostics_->Show("landmarks", num_landmarks_);
    diagnostics_->Show("key frames", stage_->mapper().num_key_frames());
    diagnostics_->Show("error", result.error_after);
    status_.publish(status);
  }

  void PublishTransforms(const dendro::MapperResult& result,
                         const std_msgs::Header& header,
                         const std::optional<Eigen::Isometry3d>& T_odom_body) {
    MapFrames frames{config_.map_frame, gate_->odom_frame(), gate_->body_frame(), header.frame_id};
    const std::string trouble = frames.Trouble(T_odom_body.has_value());
    if (!trouble.empty()) NODELET_WARN_ONCE("%s", trouble.c_str());
    broadcaster_.sendTransform(frames.Transforms(header.stamp,
                                                 result.T_map_lidar,
                                                 stage_->mapper().T_map_odom(),
                                                 T_odom_body,
                                                 config_.publish_odometry_tf,
                                                 tf_));
  }

  void PublishMap() {
    map_.publish(ToMsg(stage_->model(), config_.map_frame));
    if (path_.getNumSubscribers() > 0) {
      const auto most = static_cast<std::size_t>(config_.path_max_poses);
      path_.publish(ToPathMsg(stage_->mapper().ThinnedTrajectory(most), config_.map_frame));
    }
  }

  bool Save(dendro_slam::SaveMap::Request& request, dendro_slam::SaveMap::Response& response) {
    std::string directory = request.directory;
    if (directory.empty()) directory = config_.output_directory;
    if (directory.empty() && session_) directory = session_->map_directory();
    if (directory.empty()) {
      response.message = "no directory: name one in the request or set output_directory";
      return true;
    }
    const std::lock_guard<std::mutex> lock(mutex_);
    try {
      const dendro::MapFiles files = SaveTo(directory);
      PublishMap();
      response.success = true;
      response.message = "map of " + std::to_string(files.model.branches.size()) +
                         " branches saved in " + directory;
      NODELET_INFO("%s", response.message.c_str());
    } catch (const std::exception& error) {
      response.message = error.what();
      NODELET_ERROR("map not saved: %s", error.what());
    }
    return true;
  }

  bool Load(dendro_slam::LoadMap::Request& request, dendro_slam::LoadMap::Response& response) {
    const std::lock_guard<std::mutex> lock(mutex_);
    try {
      const dendro::MapFiles files = dendro::LoadMap(request.directory);
      // The running map is given up last, when nothing can fail any more.
      auto loaded = std::make_unique<dendro::TreeMappingStage>(config_.stage);
      loaded->Load(files);
      if (session_) {
        session_->StartAnew(
            [&files](const std::string& directory) { dendro::SaveMap(directory, files); });
      }
      stage_ = std::move(loaded);
      PublishMap();
      response.success = true;
      response.message = "map of " + std::to_string(stage_->model().branches.size()) +
                         " branches loaded from " + request.directory;
      NODELET_INFO("%s", response.message.c_str());
    } catch (const std::exception& error) {
      response.message = std::string("not loaded, the running map stays: ") + error.what();
      NODELET_ERROR("map %s", response.message.c_str());
    }
    return true;
  }

  bool Reset(std_srvs::Trigger::Request&, std_srvs::Trigger::Response& response) {
    const std::lock_guard<std::mutex> lock(mutex_);
    Forget();
    PublishMap();
    response.success = true;
    response.message = "the map is empty";
    NODELET_INFO("reset: the map is empty");
    return true;
  }

  TreeMappingNodeConfig config_;
  std::unique_ptr<StageDiagnostics> diagnostics_;
  LatencyCollector latencies_{"mapping"};
  std::mutex mutex_;  ///< Of everything below that both the worker and the services use.
  std::unique_ptr<dendro::TreeMappingStage> stage_;
  tf2_ros::Buffer tf_;
  std::unique_ptr<tf2_ros::TransformListener> tf_listener_;
  tf2_ros::TransformBroadcaster broadcaster_;
  std::optional<StampJoin<Cylinders, IcpOdometry>> join_;
  std::optional<ScanGate<WaitingScan>> gate_;
  /// Poses of mapped scans with their returns, for the map's points.
  std::optional<CloudJoin> cloud_join_;
  Odometry last_icp_;
  int num_landmarks_ = 0;
  int num_all_landmarks_ = 0;
  int num_fixes_ = 0;
  ros::Publisher map_;
  ros::Publisher path_;
  ros::Publisher status_;
  ros::Subscriber latency_subscriber_;
  ros::Subscriber odometry_subscriber_;
  ros::Subscriber icp_subscriber_;
  ros::Subscriber fix_subscriber_;
  ros::Subscriber cylinders_subscriber_;
  ros::Subscriber wood_scan_subscriber_;
  ros::ServiceServer save_;
  ros::ServiceServer load_;
  ros::ServiceServer reset_;
  std::optional<MapSession> session_;
  ros::SteadyTime saved_;
  std::unique_ptr<Worker<Input>> worker_;  // Last: its thread uses everything above.
};

}  // namespace dendro_ros

PLUGINLIB_EXPORT_CLASS(dendro_ros::TreeMapping, nodelet::Nodelet)
