#include "dendro_slam/ros/rig_messages.h"

#include <boost/make_shared.hpp>

#include <cstring>

#include "dendro_slam/ros/conversions.h"

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
  auto cloud = boost::make_shared<sensor_msgs::PointCloud2>();
  cloud->header.stamp = ToRosTime(scan.scan.stamp_ns);
  cloud->header.frame_id = kLidarFrame;
  cloud->height = 1;
  cloud->width = static_cast<std::uint32_t>(scan.truth.size());
  const auto add = [&cloud](const char* name, std::uint32_t offset, std::uint8_t datatype) {
    sensor_msgs::PointField field;
    field.name = name;
    field.offset = offset;
    field.datatype = datatype;
    field.count = 1;
    cloud->fields.push_back(field);
  };
  add("label", 0, sensor_msgs::PointField::UINT8);
  add("branch", 1, sensor_msgs::PointField::INT16);
  add("tree", 3, sensor_msgs::PointField::INT16);
  cloud->point_step = 5;
  cloud->row_step = cloud->width * cloud->point_step;
  cloud->is_dense = true;
  cloud->data.resize(cloud->row_step);
  std::uint8_t* data = cloud->data.data();
  for (const dendro::PointTruth& truth : scan.truth) {
    data[0] = static_cast<std::uint8_t>(dendro::SurfaceLabel(truth.kind));
    std::memcpy(data + 1, &truth.branch_id, 2);
    std::memcpy(data + 3, &truth.tree_id, 2);
    data += cloud->point_step;
  }
  return cloud;
}

dendro_slam::TreeMapPtr RigMessages::TruthTrees(const dendro::Scene& scene, std::int64_t stamp_ns) {
  dendro::TreeModel model;
  model.stamp_ns = stamp_ns;
  int next_branch = 0;
  for (std::size_t t = 0; t < scene.trees.size(); ++t) {
    const int first_branch = next_branch;
    for (const dendro::SceneBranch& branch : scene.trees[t].branches) {
      dendro::MapBranch out;
      out.id = next_branch++;
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
    tree.trunk_branch_id = first_branch;
    model.trees.push_back(tree);
  }
  return ToMsg(model, kMapFrame);
}

}  // namespace dendro_ros
