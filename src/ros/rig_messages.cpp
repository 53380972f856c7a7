#include "dendro_slam/ros/rig_messages.h"

#include <boost/make_shared.hpp>

#include <algorithm>
#include <cstring>
#include <initializer_list>

#include "dendro_slam/ros/conversions.h"
#include "dendro_slam/sim/truth_writer.h"

namespace dendro_ros {
namespace {

geometry_msgs::TransformStamped Transform(std::int64_t stamp_ns,
                                          const std::string& parent,
                                          const std::string& child,
                                          const Eigen::Isometry3d& T_parent_child) {
  geometry_msgs::TransformStamped msg;
  msg.header.stamp = ToRosTime(stamp_ns);
  msg.header.frame_id = parent;
  msg.child_frame_id = child;
  msg.transform = ToTransformMsg(T_parent_child);
  return msg;
}

struct Field {
  const char* name;
  std::uint8_t datatype;
  std::uint32_t bytes;
};

/// A cloud of packed rows without coordinates, zeroed.
sensor_msgs::PointCloud2Ptr PackedCloud(std::int64_t stamp_ns,
                                        std::size_t rows,
                                        std::initializer_list<Field> fields) {
  auto cloud = boost::make_shared<sensor_msgs::PointCloud2>();
  cloud->header.stamp = ToRosTime(stamp_ns);
  cloud->header.frame_id = RigMessages::kLidarFrame;
  cloud->height = 1;
  cloud->width = static_cast<std::uint32_t>(rows);
  for (const Field& field : fields) {
    sensor_msgs::PointField out;
    out.name = field.name;
    out.offset = cloud->point_step;
    out.datatype = field.datatype;
    out.count = 1;
    cloud->fields.push_back(out);
    cloud->point_step += field.bytes;
  }
  cloud->row_step = cloud->width * cloud->point_step;
  cloud->is_dense = true;
  cloud->data.resize(cloud->row_step);
  return cloud;
}

}  // namespace

RigMessages::RigMessages(const dendro::FlightPath& path) : path_(path) {
  const std::string& model = path.odometry.model;
  t265_ = model == "t265";
  child_frame_ = t265_ ? "camera_pose_frame" : kBaseFrame;
  if (t265_) odometry_topic_ = "/camera/odom/sample";
  if (model == "mavros") odometry_topic_ = "/mavros/local_position/odom";
}

tf2_msgs::TFMessage RigMessages::StaticTransforms() const {
  tf2_msgs::TFMessage msg;
  const std::int64_t stamp_ns = path_.start_stamp_ns;
  msg.transforms.push_back(Transform(stamp_ns, kBaseFrame, kLidarFrame, path_.T_base_lidar));
  if (t265_) {
    msg.transforms.push_back(
        Transform(stamp_ns, child_frame_, kBaseFrame, path_.T_base_camera.inverse()));
  }
  return msg;
}

Eigen::Isometry3d RigMessages::ChildPose(const dendro::OdometrySample& sample) const {
  return t265_ ? sample.T_odom_base * path_.T_base_camera : sample.T_odom_base;
}

nav_msgs::Odometry RigMessages::Odometry(const dendro::OdometrySample& sample) const {
  nav_msgs::Odometry msg;
  msg.header.stamp = ToRosTime(sample.stamp_ns);
  msg.header.frame_id = kOdomFrame;
  msg.child_frame_id = child_frame_;
  msg.pose.pose = ToMsg(ChildPose(sample));
  Eigen::Vector3d angular = sample.twist.head<3>();
  Eigen::Vector3d linear = sample.twist.tail<3>();
  if (t265_) {
    linear += angular.cross(path_.T_base_camera.translation());
    angular = path_.T_base_camera.linear().transpose() * angular;
    linear = path_.T_base_camera.linear().transpose() * linear;
  }
  msg.twist.twist.angular.x = angular.x();
  msg.twist.twist.angular.y = angular.y();
  msg.twist.twist.angular.z = angular.z();
  msg.twist.twist.linear.x = linear.x();
  msg.twist.twist.linear.y = linear.y();
  msg.twist.twist.linear.z = linear.z();
  for (int i = 0; i < 36; ++i) {
    const auto at = static_cast<std::size_t>(i);
    msg.pose.covariance[at] = sample.pose_covariance(i / 6, i % 6);
    msg.twist.covariance[at] = sample.twist_covariance(i / 6, i % 6);
  }
  return msg;
}

tf2_msgs::TFMessage RigMessages::OdometryTransform(const dendro::OdometrySample& sample) const {
  tf2_msgs::TFMessage msg;
  msg.transforms.push_back(
      Transform(sample.stamp_ns, kOdomFrame, child_frame_, ChildPose(sample)));
  return msg;
}

sensor_msgs::Imu RigMessages::Imu(const dendro::ImuSample& sample, const dendro::ImuSimulatorConfig& config) {
  sensor_msgs::Imu msg;
  msg.header.stamp = ToRosTime(sample.stamp_ns);
  msg.header.frame_id = kBaseFrame;
  msg.orientation_covariance[0] = -1.0;  // No orientation (sensor_msgs/Imu).
  msg.angular_velocity.x = sample.angular_velocity_rps.x();
  msg.angular_velocity.y = sample.angular_velocity_rps.y();
  msg.angular_velocity.z = sample.angular_velocity_rps.z();
  msg.linear_acceleration.x = sample.specific_force_mps2.x();
  msg.linear_acceleration.y = sample.specific_force_mps2.y();
  msg.linear_acceleration.z = sample.specific_force_mps2.z();
  const double gyro_variance = config.GyroSigmaRps() * config.GyroSigmaRps();
  const double accel_variance = config.AccelSigmaMps2() * config.AccelSigmaMps2();
  for (const std::size_t i : {0U, 4U, 8U}) {
    msg.angular_velocity_covariance[i] = gyro_variance;
    msg.linear_acceleration_covariance[i] = accel_variance;
  }
  return msg;
}

geometry_msgs::PoseStamped RigMessages::TruthLidarPose(const dendro::SimulatedScan& scan) {
  geometry_msgs::PoseStamped msg;
  msg.header.stamp = ToRosTime(scan.scan.stamp_ns);
  msg.header.frame_id = kMapFrame;
  msg.pose = ToMsg(scan.T_map_lidar);
  return msg;
}

sensor_msgs::PointCloud2Ptr RigMessages::TruthLabels(const dendro::SimulatedScan& scan) {
  auto cloud = PackedCloud(scan.scan.stamp_ns,
                           scan.truth.size(),
                           {{"label", sensor_msgs::PointField::UINT8, 1},
                            {"branch", sensor_msgs::PointField::INT16, 2},
                            {"tree", sensor_msgs::PointField::INT16, 2}});
  std::uint8_t* data = cloud->data.data();
  for (const dendro::PointTruth& truth : scan.truth) {
    data[0] = static_cast<std::uint8_t>(dendro::SurfaceLabel(truth.kind));
    std::memcpy(data + 1, &truth.branch_id, 2);
    std::memcpy(data + 3, &truth.tree_id, 2);
    data += cloud->point_step;
  }
  return cloud;
}

sensor_msgs::PointCloud2Ptr RigMessages::TruthHits(const dendro::SimulatedScan& scan) {
  const std::vector<dendro::BranchHits> hits = dendro::CountBranchHits(scan);
  auto cloud = PackedCloud(scan.scan.stamp_ns,
                           hits.size(),
                           {{"tree", sensor_msgs::PointField::INT16, 2},
                            {"branch", sensor_msgs::PointField::INT16, 2},
                            {"hits", sensor_msgs::PointField::UINT32, 4}});
  std::uint8_t* data = cloud->data.data();
  for (const dendro::BranchHits& branch : hits) {
    std::memcpy(data, &branch.tree_id, 2);
    std::memcpy(data + 2, &branch.branch_id, 2);
    std::memcpy(data + 4, &branch.hits, 4);
    data += cloud->point_step;
  }
  return cloud;
}

dendro_slam::TreeMapPtr RigMessages::TruthTrees(const dendro::Scene& scene, std::int64_t stamp_ns) {
  dendro::TreeModel model;
  model.stamp_ns = stamp_ns;
  int first_branch = 0;
  for (std::size_t t = 0; t < scene.trees.size(); ++t) {
    int largest_id = -1;
    for (const dendro::SceneBranch& branch : scene.trees[t].branches) {
      dendro::MapBranch out;
      out.id = first_branch + branch.id;
      largest_id = std::max(largest_id, branch.id);
      out.tree_id = static_cast<int>(t);
      if (branch.parent >= 0) out.parent_id = first_branch + branch.parent;
      out.base = branch.points.front().position;
      out.tip = branch.points.back().position;
      out.length_m = branch.Length();
      out.base_radius_m = branch.points.front().radius_m;
      out.tip_radius_m = branch.points.back().radius_m;
      for (std::size_t i = 0; i + 1 < branch.points.size(); ++i) {
        const dendro::BranchPoint& a = branch.points[i];
        const dendro::BranchPoint& b = branch.points[i + 1];
        const double length = (b.position - a.position).norm();
        if (!(length > 0.0)) continue;
        dendro::MapCylinder cylinder;
        cylinder.id = static_cast<int>(model.cylinders.size());
        cylinder.tree_id = out.tree_id;
        cylinder.branch_id = out.id;
        cylinder.position_in_branch = static_cast<int>(out.cylinder_ids.size());
        cylinder.start = a.position;
        cylinder.end = b.position;
        cylinder.radius_m = 0.5 * (a.radius_m + b.radius_m);
        cylinder.taper_m_per_m = (b.radius_m - a.radius_m) / length;
        out.cylinder_ids.push_back(cylinder.id);
        model.cylinders.push_back(cylinder);
      }
      model.branches.push_back(out);
    }
    dendro::MapTree tree;
    tree.id = static_cast<int>(t);
    for (const dendro::SceneBranch& branch : scene.trees[t].branches) {
      if (branch.parent >= 0) continue;
      tree.trunk_branch_id = first_branch + branch.id;
      break;
    }
    model.trees.push_back(tree);
    first_branch += largest_id + 1;
  }
  std::sort(model.branches.begin(), model.branches.end(),
            [](const dendro::MapBranch& a, const dendro::MapBranch& b) { return a.id < b.id; });
  return ToMsg(model, kMapFrame);
}

}  // namespace dendro_ros
