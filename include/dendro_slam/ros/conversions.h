#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include <geometry_msgs/PoseWithCovariance.h>
#include <geometry_msgs/TransformStamped.h>
#include <geometry_msgs/TwistWithCovariance.h>
#include <nav_msgs/Odometry.h>
#include <ros/time.h>
#include <sensor_msgs/Image.h>
#include <sensor_msgs/NavSatFix.h>
#include <sensor_msgs/PointCloud2.h>

#include "dendro_slam/GraphStatus.h"
#include "dendro_slam/MappedScan.h"
#include "dendro_slam/ScanCylinders.h"
#include "dendro_slam/segmentation/ground_plane.h"
#include "dendro_slam/Segments.h"
#include "dendro_slam/TreeMap.h"
#include "dendro_slam/branch_separation/segment.h"
#include "dendro_slam/cylinder_fitting/fitted_cylinder.h"
#include "dendro_slam/mapping/georeference.h"
#include "dendro_slam/mapping/mapper_io.h"
#include "dendro_slam/mapping/tree_model.h"
#include "dendro_slam/odometry/relative_motion.h"
#include "dendro_slam/range_image/range_image.h"

/// The only place where core types become messages and back. No function here computes anything
/// beyond a change of convention.
namespace dendro_ros {

/// Nanoseconds since the epoch of a ROS stamp.
std::int64_t ToNs(const ros::Time& stamp);
/// The ROS stamp of nanoseconds since the epoch.
/// @throws std::invalid_argument  Negative, or later than a ROS stamp can say (year 2106).
ros::Time ToRosTime(std::int64_t stamp_ns);

geometry_msgs::Pose ToMsg(const Eigen::Isometry3d& T);
/// @throws std::invalid_argument  Not finite, or a quaternion whose norm is not 1 within 1 %.
Eigen::Isometry3d FromMsg(const geometry_msgs::Pose& pose);
geometry_msgs::Transform ToTransformMsg(const Eigen::Isometry3d& T);
/// @throws std::invalid_argument  As for a pose.
Eigen::Isometry3d FromMsg(const geometry_msgs::Transform& transform);

/// Covariance of a pose in ROS' convention from ours.
///
/// Ours is that of the right tangent [omega; rho] at T. geometry_msgs/PoseWithCovariance orders
/// (x, y, z, rotation about X, Y, Z) with fixed axes, the parent's: dt = R rho, dtheta = R omega,
/// so `C_ros = J C J^T` with J = [0 R; R 0].
/// @return Shape (6, 6), translation first.
dendro::Matrix6d ToFixedAxesCovariance(const Eigen::Isometry3d& T, const dendro::Matrix6d& tangent);
/// Inverse of ToFixedAxesCovariance.
dendro::Matrix6d ToTangentCovariance(const Eigen::Isometry3d& T, const dendro::Matrix6d& fixed_axes);

/// @param covariance  Of the right tangent [omega; rho] at T.
geometry_msgs::PoseWithCovariance ToMsg(const Eigen::Isometry3d& T,
                                        const dendro::Matrix6d& covariance);

/// A pose of an odometry stream.
struct OdometryPose {
  std::int64_t stamp_ns = 0;
  Eigen::Isometry3d T_odom_child = Eigen::Isometry3d::Identity();
  dendro::Matrix6d covariance = dendro::Matrix6d::Zero();  ///< Right tangent, rotation first.
};
/// @throws std::invalid_argument  The pose is not finite or not a rigid motion.
OdometryPose FromMsg(const nav_msgs::Odometry& odometry);

/// A fix of a GNSS receiver.
/// @return  Nothing when the receiver has no fix.
std::optional<dendro::GeoFix> FromMsg(const sensor_msgs::NavSatFix& fix);

/// The chained pose of the lidar as stage 1.5 (ICP) publishes it.
///
/// The pose is the chain of all motions so far, so that rviz can draw it; the twist is the mean
/// motion of the last step in the lidar's own frame, `Log(T_from_to) / dt`, with the covariance of
/// the step over dt^2. A step without a motion keeps the pose and has `twist.covariance[0] = -1`.
/// @param T_icp_lidar  Chained pose at `motion.to_stamp_ns`.
nav_msgs::Odometry ToIcpOdometry(const dendro::RelativeMotion& motion,
                                 const Eigen::Isometry3d& T_icp_lidar,
                                 const std::string& frame_id,
                                 const std::string& child_frame_id);
/// The same for a scan to which no motion could be found.
nav_msgs::Odometry ToIcpOdometryWithoutMotion(std::int64_t stamp_ns,
                                              const Eigen::Isometry3d& T_icp_lidar,
                                              const std::string& frame_id,
                                              const std::string& child_frame_id);
/// The motion between two successive messages of ToIcpOdometry; none when `current` has no motion.
std::optional<dendro::RelativeMotion> MotionBetween(const nav_msgs::Odometry& previous,
                                                    const nav_msgs::Odometry& current);

/// The labelled scan as an organised cloud that rviz shows as it is: one point per pixel, fields
/// x y z intensity range wood_probability time vp_x vp_y vp_z dir_x dir_y dir_z (float32),
/// point_index (int32), ring (uint16), label and deskewed (uint8). `vp` is the origin and `dir` the
/// direction of the beam, also where nothing came back (x y z are NaN there).
sensor_msgs::PointCloud2Ptr ToWoodScan(const dendro::LabelledScan& scan,
                                       const std::string& frame_id);
/// Inverse of ToWoodScan. `image.pixel_of_point` holds the one point of each pixel.
/// @throws PointCloud2Error  Not a cloud that ToWoodScan made; names the topic and the field.
dendro::LabelledScan FromWoodScan(const sensor_msgs::PointCloud2& cloud, const std::string& topic);

/// The range image for viewing: mono16, one unit per centimetre, 0 where nothing came back, the
/// highest ring in the first row.
sensor_msgs::ImagePtr ToRangeImageMsg(const dendro::RangeImage& image, const std::string& frame_id);
/// The labels for viewing: rgb8 in the colours of the markers, the highest ring in the first row.
sensor_msgs::ImagePtr ToLabelImageMsg(const dendro::LabelledScan& scan,
                                      const std::string& frame_id);

dendro_slam::SegmentsPtr ToMsg(const std::vector<dendro::Segment>& segments,
                               std::int64_t stamp_ns,
                               const std::string& frame_id);
/// @param num_pixels  Size of the scan the segments index into.
/// @throws std::invalid_argument  A pixel outside the scan.
std::vector<dendro::Segment> FromMsg(const dendro_slam::Segments& segments, std::size_t num_pixels);

/// @param ground  The ground in the lidar frame, if the scan shows it.
dendro_slam::ScanCylindersPtr ToMsg(const std::vector<dendro::FittedCylinder>& cylinders,
                                    std::int64_t stamp_ns,
                                    const std::string& frame_id,
                                    const std::optional<dendro::GroundPlane>& ground = std::nullopt);
/// @throws std::invalid_argument  A value that is not finite.
std::optional<dendro::GroundPlane> GroundFromMsg(const dendro_slam::ScanCylinders& cylinders);
/// @throws std::invalid_argument  A value that is not finite, or an unknown status.
std::vector<dendro::FittedCylinder> FromMsg(const dendro_slam::ScanCylinders& cylinders);

/// What the mapper is given for a scan, to be kept; bit by bit the same when it comes back.
/// @param cylinders  The message that `input.cylinders` was made of.
dendro_slam::MappedScan ToMappedScan(const dendro::MapperInput& input,
                                     const dendro_slam::ScanCylinders& cylinders);
/// @throws std::invalid_argument  An array of the wrong size, or as for the cylinders.
dendro::MapperInput FromMsg(const dendro_slam::MappedScan& scan);

dendro_slam::TreeMapPtr ToMsg(const dendro::TreeModel& model, const std::string& frame_id);
dendro::TreeModel FromMsg(const dendro_slam::TreeMap& map);

/// The part of the status that one result of the mapper knows.
dendro_slam::GraphStatusPtr ToMsg(const dendro::MapperResult& result, const std::string& frame_id);

}  // namespace dendro_ros
