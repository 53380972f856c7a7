#include "dendro_slam/ros/conversions.h"

#include <boost/make_shared.hpp>
#include <fmt/format.h>
#include <sensor_msgs/image_encodings.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>

#include "dendro_slam/ros/markers.h"
#include "dendro_slam/ros/point_cloud2.h"

namespace dendro_ros {
namespace {

using dendro::Matrix6d;

geometry_msgs::Point ToPoint(const Eigen::Vector3d& p) {
  geometry_msgs::Point msg;
  msg.x = p.x();
  msg.y = p.y();
  msg.z = p.z();
  return msg;
}

Eigen::Vector3d ToEigen(const geometry_msgs::Point& p) { return {p.x, p.y, p.z}; }

Eigen::Isometry3d MakePose(const Eigen::Vector3d& t, const Eigen::Quaterniond& q, const char* what) {
  constexpr double kNormTolerance = 0.01;
  if (!t.allFinite() || !q.coeffs().allFinite()) {
    throw std::invalid_argument(fmt::format("{}: a number that is not finite", what));
  }
  if (std::abs(q.norm() - 1.0) > kNormTolerance) {
    throw std::invalid_argument(
        fmt::format("{}: the quaternion's norm is {:.3g}, expected 1", what, q.norm()));
  }
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  T.linear() = q.normalized().toRotationMatrix();
  T.translation() = t;
  return T;
}

/// d_ros = J d_tangent, see ToFixedAxesCovariance.
Matrix6d FixedAxesJacobian(const Eigen::Isometry3d& T) {
  Matrix6d J = Matrix6d::Zero();
  J.topRightCorner<3, 3>() = T.linear();
  J.bottomLeftCorner<3, 3>() = T.linear();
  return J;
}

template <class Array>
void CopyRowMajor(const Matrix6d& matrix, Array& array) {
  for (int r = 0; r < 6; ++r) {
    for (int c = 0; c < 6; ++c) array[static_cast<std::size_t>(6 * r + c)] = matrix(r, c);
  }
}

template <class Array>
Matrix6d FromRowMajor(const Array& array) {
  Matrix6d matrix;
  for (int r = 0; r < 6; ++r) {
    for (int c = 0; c < 6; ++c) matrix(r, c) = array[static_cast<std::size_t>(6 * r + c)];
  }
  return matrix;
}

/// Rotation first to translation first and back, without a change of axes (twists).
Matrix6d SwapHalves(const Matrix6d& matrix) {
  Matrix6d swapped;
  swapped.topLeftCorner<3, 3>() = matrix.bottomRightCorner<3, 3>();
  swapped.topRightCorner<3, 3>() = matrix.bottomLeftCorner<3, 3>();
  swapped.bottomLeftCorner<3, 3>() = matrix.topRightCorner<3, 3>();
  swapped.bottomRightCorner<3, 3>() = matrix.topLeftCorner<3, 3>();
  return swapped;
}

/// Layout of the wood scan, in the order of its fields.
struct WoodScanPoint {
  float x, y, z;
  float intensity;
  float range;
  float wood_probability;
  float time;
  float vp_x, vp_y, vp_z;
  float dir_x, dir_y, dir_z;
  std::int32_t point_index;
  std::uint16_t ring;
  std::uint8_t label;
  std::uint8_t deskewed;
};
static_assert(sizeof(WoodScanPoint) == 60, "the fields of the wood scan are packed");

struct FieldSpec {
  const char* name;
  std::uint32_t offset;
  std::uint8_t datatype;
};

constexpr std::array<FieldSpec, 17> kWoodScanFields = {{
    {"x", offsetof(WoodScanPoint, x), sensor_msgs::PointField::FLOAT32},
    {"y", offsetof(WoodScanPoint, y), sensor_msgs::PointField::FLOAT32},
    {"z", offsetof(WoodScanPoint, z), sensor_msgs::PointField::FLOAT32},
    {"intensity", offsetof(WoodScanPoint, intensity), sensor_msgs::PointField::FLOAT32},
    {"range", offsetof(WoodScanPoint, range), sensor_msgs::PointField::FLOAT32},
    {"wood_probability", offsetof(WoodScanPoint, wood_probability), sensor_msgs::PointField::FLOAT32},
    {"time", offsetof(WoodScanPoint, time), sensor_msgs::PointField::FLOAT32},
    {"vp_x", offsetof(WoodScanPoint, vp_x), sensor_msgs::PointField::FLOAT32},
    {"vp_y", offsetof(WoodScanPoint, vp_y), sensor_msgs::PointField::FLOAT32},
    {"vp_z", offsetof(WoodScanPoint, vp_z), sensor_msgs::PointField::FLOAT32},
    {"dir_x", offsetof(WoodScanPoint, dir_x), sensor_msgs::PointField::FLOAT32},
    {"dir_y", offsetof(WoodScanPoint, dir_y), sensor_msgs::PointField::FLOAT32},
    {"dir_z", offsetof(WoodScanPoint, dir_z), sensor_msgs::PointField::FLOAT32},
    {"point_index", offsetof(WoodScanPoint, point_index), sensor_msgs::PointField::INT32},
    {"ring", offsetof(WoodScanPoint, ring), sensor_msgs::PointField::UINT16},
    {"label", offsetof(WoodScanPoint, label), sensor_msgs::PointField::UINT8},
    {"deskewed", offsetof(WoodScanPoint, deskewed), sensor_msgs::PointField::UINT8},
}};

nav_msgs::Odometry IcpOdometryBase(std::int64_t stamp_ns,
                                   const Eigen::Isometry3d& T_icp_lidar,
                                   const std::string& frame_id,
                                   const std::string& child_frame_id) {
  nav_msgs::Odometry msg;
  msg.header.stamp = ToRosTime(stamp_ns);
  msg.header.frame_id = frame_id;
  msg.child_frame_id = child_frame_id;
  msg.pose.pose = ToMsg(T_icp_lidar);
  return msg;
}

}  // namespace

std::int64_t ToNs(const ros::Time& stamp) {
  return static_cast<std::int64_t>(stamp.sec) * 1000000000 + stamp.nsec;
}

ros::Time ToRosTime(std::int64_t stamp_ns) {
  if (stamp_ns < 0 || stamp_ns / 1000000000 > std::numeric_limits<std::uint32_t>::max()) {
    throw std::invalid_argument(fmt::format("stamp {} ns cannot be a ROS time", stamp_ns));
  }
  return {static_cast<std::uint32_t>(stamp_ns / 1000000000),
          static_cast<std::uint32_t>(stamp_ns % 1000000000)};
}

geometry_msgs::Pose ToMsg(const Eigen::Isometry3d& T) {
  const Eigen::Quaterniond q(T.linear());
  geometry_msgs::Pose msg;
  msg.position = ToPoint(T.translation());
  msg.orientation.x = q.x();
  msg.orientation.y = q.y();
  msg.orientation.z = q.z();
  msg.orientation.w = q.w();
  return msg;
}

Eigen::Isometry3d FromMsg(const geometry_msgs::Pose& pose) {
  const auto& q = pose.orientation;
  return MakePose(ToEigen(pose.position), {q.w, q.x, q.y, q.z}, "pose");
}

geometry_msgs::Transform ToTransformMsg(const Eigen::Isometry3d& T) {
  const geometry_msgs::Pose pose = ToMsg(T);
  geometry_msgs::Transform msg;
  msg.translation.x = pose.position.x;
  msg.translation.y = pose.position.y;
  msg.translation.z = pose.position.z;
  msg.rotation = pose.orientation;
  return msg;
}

Eigen::Isometry3d FromMsg(const geometry_msgs::Transform& transform) {
  const auto& t = transform.translation;
  const auto& q = transform.rotation;
  return MakePose({t.x, t.y, t.z}, {q.w, q.x, q.y, q.z}, "transform");
}

Matrix6d ToFixedAxesCovariance(const Eigen::Isometry3d& T, const Matrix6d& tangent) {
  const Matrix6d J = FixedAxesJacobian(T);
  return J * tangent * J.transpose();
}

Matrix6d ToTangentCovariance(const Eigen::Isometry3d& T, const Matrix6d& fixed_axes) {
  const Matrix6d J = FixedAxesJacobian(T);  // Orthonormal: its inverse is its transpose.
  return J.transpose() * fixed_axes * J;
}

geometry_msgs::PoseWithCovariance ToMsg(const Eigen::Isometry3d& T, const Matrix6d& covariance) {
  geometry_msgs::PoseWithCovariance msg;
  msg.pose = ToMsg(T);
  CopyRowMajor(ToFixedAxesCovariance(T, covariance), msg.covariance);
  return msg;
}

OdometryPose FromMsg(const nav_msgs::Odometry& odometry) {
  OdometryPose result;
  result.stamp_ns = ToNs(odometry.header.stamp);
  result.T_odom_child = FromMsg(odometry.pose.pose);
  result.covariance =
      ToTangentCovariance(result.T_odom_child, FromRowMajor(odometry.pose.covariance));
  return result;
}

std::optional<dendro::GeoFix> FromMsg(const sensor_msgs::NavSatFix& fix) {
  if (fix.status.status < sensor_msgs::NavSatStatus::STATUS_FIX) return std::nullopt;
  dendro::GeoFix out;
  out.stamp_ns = ToNs(fix.header.stamp);
  out.latitude_deg = fix.latitude;
  out.longitude_deg = fix.longitude;
  if (std::isfinite(fix.altitude)) out.altitude_m = fix.altitude;
  if (fix.position_covariance_type != sensor_msgs::NavSatFix::COVARIANCE_TYPE_UNKNOWN) {
    // East, north, up on the diagonal.
    out.horizontal_sigma_m =
        std::sqrt(0.5 * (fix.position_covariance[0] + fix.position_covariance[4]));
    out.vertical_sigma_m = std::sqrt(fix.position_covariance[8]);
  }
  return out;
}

nav_msgs::Odometry ToIcpOdometry(const dendro::RelativeMotion& motion,
                                 const Eigen::Isometry3d& T_icp_lidar,
                                 const std::string& frame_id,
                                 const std::string& child_frame_id) {
  nav_msgs::Odometry msg =
      IcpOdometryBase(motion.to_stamp_ns, T_icp_lidar, frame_id, child_frame_id);
  const double dt = dendro::NsToSeconds(motion.to_stamp_ns - motion.from_stamp_ns);
  const dendro::Vector6d twist = dendro::LogSe3(motion.T_from_to) / dt;
  msg.twist.twist.angular.x = twist[0];
  msg.twist.twist.angular.y = twist[1];
  msg.twist.twist.angular.z = twist[2];
  msg.twist.twist.linear.x = twist[3];
  msg.twist.twist.linear.y = twist[4];
  msg.twist.twist.linear.z = twist[5];
  CopyRowMajor(SwapHalves(motion.covariance) / (dt * dt), msg.twist.covariance);
  CopyRowMajor(ToFixedAxesCovariance(T_icp_lidar, motion.covariance), msg.pose.covariance);
  return msg;
}

nav_msgs::Odometry ToIcpOdometryWithoutMotion(std::int64_t stamp_ns,
                                              const Eigen::Isometry3d& T_icp_lidar,
                                              const std::string& frame_id,
                                              const std::string& child_frame_id) {
  nav_msgs::Odometry msg = IcpOdometryBase(stamp_ns, T_icp_lidar, frame_id, child_frame_id);
  msg.twist.covariance[0] = -1.0;
  return msg;
}

std::optional<dendro::RelativeMotion> MotionBetween(const nav_msgs::Odometry& previous,
                                                    const nav_msgs::Odometry& current) {
  if (current.twist.covariance[0] < 0.0) return std::nullopt;
  dendro::RelativeMotion motion;
  motion.from_stamp_ns = ToNs(previous.header.stamp);
  motion.to_stamp_ns = ToNs(current.header.stamp);
  const double dt = dendro::NsToSeconds(motion.to_stamp_ns - motion.from_stamp_ns);
  if (!(dt > 0.0)) return std::nullopt;
  motion.T_from_to = dendro::NormalizedSe3(FromMsg(previous.pose.pose).inverse() *
                                           FromMsg(current.pose.pose));
  motion.covariance = SwapHalves(FromRowMajor(current.twist.covariance)) * (dt * dt);
  return motion;
}

sensor_msgs::PointCloud2Ptr ToWoodScan(const dendro::LabelledScan& scan,
                                       const std::string& frame_id) {
  const dendro::RangeImage& image = scan.image;
  auto cloud = boost::make_shared<sensor_msgs::PointCloud2>();
  cloud->header.stamp = ToRosTime(image.stamp_ns);
  cloud->header.frame_id = frame_id;
  cloud->height = static_cast<std::uint32_t>(image.rows);
  cloud->width = static_cast<std::uint32_t>(image.cols);
  for (const FieldSpec& spec : kWoodScanFields) {
    sensor_msgs::PointField field;
    field.name = spec.name;
    field.offset = spec.offset;
    field.datatype = spec.datatype;
    field.count = 1;
    cloud->fields.push_back(field);
  }
  cloud->is_bigendian = false;
  cloud->is_dense = false;
  cloud->point_step = sizeof(WoodScanPoint);
  cloud->row_step = cloud->point_step * cloud->width;
  cloud->data.resize(std::size_t{cloud->row_step} * cloud->height);
  std::uint8_t* data = cloud->data.data();
  for (std::size_t i = 0; i < image.size(); ++i, data += sizeof(WoodScanPoint)) {
    const WoodScanPoint point = {image.point[i].x(),
                                 image.point[i].y(),
                                 image.point[i].z(),
                                 image.intensity[i],
                                 image.range[i],
                                 scan.wood_probability[i],
                                 image.time_s[i],
                                 image.beam_origin[i].x(),
                                 image.beam_origin[i].y(),
                                 image.beam_origin[i].z(),
                                 image.beam_direction[i].x(),
                                 image.beam_direction[i].y(),
                                 image.beam_direction[i].z(),
                                 image.point_index[i],
                                 static_cast<std::uint16_t>(i / static_cast<std::size_t>(image.cols)),
                                 static_cast<std::uint8_t>(scan.label[i]),
                                 static_cast<std::uint8_t>(image.deskewed)};
    std::memcpy(data, &point, sizeof(point));
  }
  return cloud;
}

dendro::LabelledScan FromWoodScan(const sensor_msgs::PointCloud2& cloud, const std::string& topic) {
  CheckLayout(cloud, topic);
  if (cloud.point_step != sizeof(WoodScanPoint)) {
    throw PointCloud2Error(fmt::format(
        "{}: point_step {} is not that of a wood scan ({}); is the topic remapped to another cloud?",
        topic,
        cloud.point_step,
        sizeof(WoodScanPoint)));
  }
  for (const FieldSpec& spec : kWoodScanFields) {
    const auto field = std::find_if(cloud.fields.begin(), cloud.fields.end(), [&](const auto& f) {
      return f.name == spec.name;
    });
    if (field == cloud.fields.end() || field->offset != spec.offset ||
        field->datatype != spec.datatype) {
      throw PointCloud2Error(
          fmt::format("{}: field '{}' is not that of a wood scan", topic, spec.name));
    }
  }
  dendro::LabelledScan scan;
  dendro::RangeImage& image = scan.image;
  image.stamp_ns = ToNs(cloud.header.stamp);
  image.rows = static_cast<int>(cloud.height);
  image.cols = static_cast<int>(cloud.width);
  const std::size_t count = std::size_t{cloud.width} * cloud.height;
  image.point.resize(count);
  image.range.resize(count);
  image.intensity.resize(count);
  image.time_s.resize(count);
  image.beam_origin.resize(count);
  image.beam_direction.resize(count);
  image.point_index.resize(count);
  scan.wood_probability.resize(count);
  scan.label.resize(count);
  std::size_t i = 0;
  std::int32_t last_index = -1;
  for (std::size_t row = 0; row < cloud.height; ++row) {
    const std::uint8_t* data = cloud.data.data() + row * cloud.row_step;
    for (std::size_t col = 0; col < cloud.width; ++col, ++i, data += sizeof(WoodScanPoint)) {
      WoodScanPoint point;
      std::memcpy(&point, data, sizeof(point));
      image.point[i] = {point.x, point.y, point.z};
      image.range[i] = point.range;
      image.intensity[i] = point.intensity;
      image.time_s[i] = point.time;
      image.beam_origin[i] = {point.vp_x, point.vp_y, point.vp_z};
      image.beam_direction[i] = {point.dir_x, point.dir_y, point.dir_z};
      image.point_index[i] = point.point_index;
      scan.wood_probability[i] = point.wood_probability;
      if (point.label > static_cast<std::uint8_t>(dendro::Label::kOther)) {
        throw PointCloud2Error(fmt::format("{}: unknown label {}", topic, int{point.label}));
      }
      scan.label[i] = static_cast<dendro::Label>(point.label);
      image.deskewed = point.deskewed != 0;
      last_index = std::max(last_index, point.point_index);
    }
  }
  image.pixel_of_point.assign(static_cast<std::size_t>(last_index + 1), -1);
  for (std::size_t pixel = 0; pixel < count; ++pixel) {
    if (image.point_index[pixel] >= 0) {
      image.pixel_of_point[static_cast<std::size_t>(image.point_index[pixel])] =
          static_cast<std::int32_t>(pixel);
    }
  }
  return scan;
}

sensor_msgs::ImagePtr ToRangeImageMsg(const dendro::RangeImage& image, const std::string& frame_id) {
  constexpr float kUnitsPerMetre = 100.0F;
  auto msg = boost::make_shared<sensor_msgs::Image>();
  msg->header.stamp = ToRosTime(image.stamp_ns);
  msg->header.frame_id = frame_id;
  msg->height = static_cast<std::uint32_t>(image.rows);
  msg->width = static_cast<std::uint32_t>(image.cols);
  msg->encoding = sensor_msgs::image_encodings::MONO16;
  msg->is_bigendian = 0;
  msg->step = 2 * msg->width;
  msg->data.resize(std::size_t{msg->step} * msg->height);
  std::uint8_t* out = msg->data.data();
  for (int row = image.rows - 1; row >= 0; --row) {
    for (int col = 0; col < image.cols; ++col, out += 2) {
      const std::size_t pixel = image.Index(row, col);
      const float units = image.HasReturn(pixel) ? image.range[pixel] * kUnitsPerMetre : 0.0F;
      const auto value = static_cast<std::uint16_t>(std::clamp(units, 0.0F, 65535.0F));
      std::memcpy(out, &value, 2);
    }
  }
  return msg;
}

sensor_msgs::ImagePtr ToLabelImageMsg(const dendro::LabelledScan& scan,
                                      const std::string& frame_id) {
  const dendro::RangeImage& image = scan.image;
  auto msg = boost::make_shared<sensor_msgs::Image>();
  msg->header.stamp = ToRosTime(image.stamp_ns);
  msg->header.frame_id = frame_id;
  msg->height = static_cast<std::uint32_t>(image.rows);
  msg->width = static_cast<std::uint32_t>(image.cols);
  msg->encoding = sensor_msgs::image_encodings::RGB8;
  msg->is_bigendian = 0;
  msg->step = 3 * msg->width;
  msg->data.reserve(std::size_t{msg->step} * msg->height);
  for (int row = image.rows - 1; row >= 0; --row) {
    for (int col = 0; col < image.cols; ++col) {
      for (const std::uint8_t channel : LabelColor(scan.label[image.Index(row, col)])) {
        msg->data.push_back(channel);
      }
    }
  }
  return msg;
}

dendro_slam::SegmentsPtr ToMsg(const std::vector<dendro::Segment>& segments,
                               std::int64_t stamp_ns,
                               const std::string& frame_id) {
  auto msg = boost::make_shared<dendro_slam::Segments>();
  msg->header.stamp = ToRosTime(stamp_ns);
  msg->header.frame_id = frame_id;
  msg->segments.reserve(segments.size());
  for (const dendro::Segment& segment : segments) {
    dendro_slam::Segment out;
    out.id = segment.id;
    out.pixels = segment.pixels;
    msg->segments.push_back(std::move(out));
  }
  return msg;
}

std::vector<dendro::Segment> FromMsg(const dendro_slam::Segments& segments, std::size_t num_pixels) {
  std::vector<dendro::Segment> result;
  result.reserve(segments.segments.size());
  for (const dendro_slam::Segment& segment : segments.segments) {
    for (const std::int32_t pixel : segment.pixels) {
      if (pixel < 0 || static_cast<std::size_t>(pixel) >= num_pixels) {
        throw std::invalid_argument(
            fmt::format("segment {}: pixel {} is outside the scan", segment.id, pixel));
      }
    }
    result.push_back({segment.id, segment.pixels});
  }
  return result;
}

dendro_slam::ScanCylindersPtr ToMsg(const std::vector<dendro::FittedCylinder>& cylinders,
                                    std::int64_t stamp_ns,
                                    const std::string& frame_id,
                                    const std::optional<dendro::GroundPlane>& ground) {
  auto msg = boost::make_shared<dendro_slam::ScanCylinders>();
  if (ground) {
    msg->has_ground = true;
    msg->ground_normal.x = ground->normal.x();
    msg->ground_normal.y = ground->normal.y();
    msg->ground_normal.z = ground->normal.z();
    msg->ground_offset = ground->offset;
  }
  msg->header.stamp = ToRosTime(stamp_ns);
  msg->header.frame_id = frame_id;
  msg->cylinders.reserve(cylinders.size());
  for (const dendro::FittedCylinder& in : cylinders) {
    dendro_slam::Cylinder out;
    out.segment_id = in.segment_id;
    out.status = static_cast<std::uint8_t>(in.status);
    out.reason = static_cast<std::uint8_t>(in.reason);
    out.axis.x = in.cylinder.axis.x();
    out.axis.y = in.cylinder.axis.y();
    out.axis.z = in.cylinder.axis.z();
    out.point = ToPoint(in.cylinder.point);
    out.curvature = in.cylinder.curvature;
    for (int r = 0; r < 5; ++r) {
      for (int c = 0; c < 5; ++c) {
        out.covariance[static_cast<std::size_t>(5 * r + c)] = in.covariance(r, c);
      }
    }
    out.radius_sigma = in.radius_sigma_m();
    out.taper = in.taper_m_per_m;
    out.taper_sigma = in.taper_sigma_m_per_m;
    out.taper_estimated = in.taper_estimated;
    for (int k = 0; k < 4; ++k) {
      out.bend_information[static_cast<std::size_t>(k)] = in.bend_information(k / 2, k % 2);
    }
    for (int k = 0; k < 2; ++k) out.bend_vector[static_cast<std::size_t>(k)] = in.bend_vector[k];
    out.start_s = in.start_s_m;
    out.end_s = in.end_s_m;
    out.end_sigma = in.end_sigma_m;
    out.num_points = in.num_points;
    out.num_rings = in.num_rings;
    out.distance = in.distance_m;
    out.visible_arc = in.visible_arc_rad;
    out.mean_abs_deviation = in.mean_abs_deviation_m;
    msg->cylinders.push_back(out);
  }
  return msg;
}

std::optional<dendro::GroundPlane> GroundFromMsg(const dendro_slam::ScanCylinders& cylinders) {
  if (!cylinders.has_ground) return std::nullopt;
  dendro::GroundPlane ground;
  ground.normal = Eigen::Vector3d(cylinders.ground_normal.x,
                                  cylinders.ground_normal.y,
                                  cylinders.ground_normal.z)
                      .cast<float>();
  ground.offset = static_cast<float>(cylinders.ground_offset);
  if (!ground.normal.allFinite() || !std::isfinite(ground.offset)) {
    throw std::invalid_argument("the ground of the scan is not finite");
  }
  return ground;
}

dendro_slam::MappedScan ToMappedScan(const dendro::MapperInput& input,
                                     const dendro_slam::ScanCylinders& cylinders) {
  // 3 x 4, row by row, so that the bits stay.
  const auto rows = [](const Eigen::Isometry3d& T) {
    std::vector<double> values;
    for (int i = 0; i < 12; ++i) values.push_back(T(i / 4, i % 4));
    return values;
  };
  dendro_slam::MappedScan msg;
  msg.cylinders = cylinders;
  if (input.T_odom_lidar) msg.lidar_in_odometry = rows(*input.T_odom_lidar);
  if (input.icp) {
    msg.icp_motion = rows(input.icp->T_from_to);
    msg.icp_from_ns = input.icp->from_stamp_ns;
    for (int i = 0; i < 36; ++i) msg.icp_covariance.push_back(input.icp->covariance(i / 6, i % 6));
  }
  return msg;
}

dendro::MapperInput FromMsg(const dendro_slam::MappedScan& scan) {
  const auto transform = [](const std::vector<double>& values) {
    if (values.size() != 12) throw std::invalid_argument("a transform must have 12 numbers");
    Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
    for (int i = 0; i < 12; ++i) T(i / 4, i % 4) = values[static_cast<std::size_t>(i)];
    return T;
  };
  dendro::MapperInput input;
  input.stamp_ns = ToNs(scan.cylinders.header.stamp);
  input.cylinders = FromMsg(scan.cylinders);
  if (!scan.lidar_in_odometry.empty()) input.T_odom_lidar = transform(scan.lidar_in_odometry);
  if (!scan.icp_motion.empty()) {
    if (scan.icp_covariance.size() != 36) {
      throw std::invalid_argument("a covariance must have 36 numbers");
    }
    dendro::RelativeMotion motion;
    motion.from_stamp_ns = scan.icp_from_ns;
    motion.to_stamp_ns = input.stamp_ns;
    motion.T_from_to = transform(scan.icp_motion);
    for (int i = 0; i < 36; ++i) {
      motion.covariance(i / 6, i % 6) = scan.icp_covariance[static_cast<std::size_t>(i)];
    }
    input.icp = motion;
  }
  return input;
}

std::vector<dendro::FittedCylinder> FromMsg(const dendro_slam::ScanCylinders& cylinders) {
  std::vector<dendro::FittedCylinder> result;
  result.reserve(cylinders.cylinders.size());
  for (const dendro_slam::Cylinder& in : cylinders.cylinders) {
    if (in.status > dendro_slam::Cylinder::INFERRED ||
        in.reason > dendro_slam::Cylinder::REASON_NOT_CONVERGED) {
      throw std::invalid_argument(
          fmt::format("cylinder of segment {}: unknown status or reason", in.segment_id));
    }
    dendro::FittedCylinder out;
    out.segment_id = in.segment_id;
    out.status = static_cast<dendro::FitStatus>(in.status);
    out.reason = static_cast<dendro::UnresolvedReason>(in.reason);
    out.cylinder.axis = {in.axis.x, in.axis.y, in.axis.z};
    out.cylinder.point = ToEigen(in.point);
    out.cylinder.curvature = in.curvature;
    for (int r = 0; r < 5; ++r) {
      for (int c = 0; c < 5; ++c) {
        out.covariance(r, c) = in.covariance[static_cast<std::size_t>(5 * r + c)];
      }
    }
    out.taper_m_per_m = in.taper;
    out.taper_sigma_m_per_m = in.taper_sigma;
    out.taper_estimated = in.taper_estimated != 0;
    for (int k = 0; k < 4; ++k) {
      out.bend_information(k / 2, k % 2) = in.bend_information[static_cast<std::size_t>(k)];
    }
    for (int k = 0; k < 2; ++k) out.bend_vector[k] = in.bend_vector[static_cast<std::size_t>(k)];
    out.start_s_m = in.start_s;
    out.end_s_m = in.end_s;
    out.end_sigma_m = in.end_sigma;
    out.num_points = in.num_points;
    out.num_rings = in.num_rings;
    out.distance_m = in.distance;
    out.visible_arc_rad = in.visible_arc;
    out.mean_abs_deviation_m = in.mean_abs_deviation;
    const bool finite = out.cylinder.axis.allFinite() && out.cylinder.point.allFinite() &&
                        std::isfinite(out.cylinder.curvature) && out.covariance.allFinite() &&
                        std::isfinite(out.start_s_m) && std::isfinite(out.end_s_m);
    if (out.status == dendro::FitStatus::kMeasured && !finite) {
      throw std::invalid_argument(
          fmt::format("cylinder of segment {}: a number that is not finite", in.segment_id));
    }
    result.push_back(out);
  }
  return result;
}

dendro_slam::TreeMapPtr ToMsg(const dendro::TreeModel& model, const std::string& frame_id) {
  auto msg = boost::make_shared<dendro_slam::TreeMap>();
  msg->header.stamp = ToRosTime(model.stamp_ns);
  msg->header.frame_id = frame_id;
  for (const dendro::MapCylinder& in : model.cylinders) {
    dendro_slam::MapCylinder out;
    out.id = in.id;
    out.landmark_id = in.landmark_id;
    out.tree_id = in.tree_id;
    out.branch_id = in.branch_id;
    out.parent_id = in.parent_id;
    out.branch_order = in.branch_order;
    out.position_in_branch = in.position_in_branch;
    out.start = ToPoint(in.start);
    out.end = ToPoint(in.end);
    out.radius = in.radius_m;
    out.radius_sigma = in.radius_sigma_m;
    out.taper = in.taper_m_per_m;
    out.axis_sigma = in.axis_sigma_rad;
    out.position_sigma = in.position_sigma_m;
    out.num_scans = in.num_scans;
    out.num_points = in.num_points;
    out.visible_arc = in.visible_arc_rad;
    out.mean_abs_deviation = in.mean_abs_deviation_m;
    out.status = static_cast<std::uint8_t>(in.status);
    msg->cylinders.push_back(out);
  }
  for (const dendro::MapBranch& in : model.branches) {
    dendro_slam::MapBranch out;
    out.id = in.id;
    out.tree_id = in.tree_id;
    out.parent_id = in.parent_id;
    out.order = in.order;
    out.cylinder_ids = in.cylinder_ids;
    out.base = ToPoint(in.base);
    out.tip = ToPoint(in.tip);
    out.length = in.length_m;
    out.base_radius = in.base_radius_m;
    out.middle_radius = in.middle_radius_m;
    out.tip_radius = in.tip_radius_m;
    out.base_radius_sigma = in.base_radius_sigma_m;
    out.angle = in.angle_rad;
    out.azimuth = in.azimuth_rad;
    out.zenith = in.zenith_rad;
    out.height = in.height_m;
    msg->branches.push_back(std::move(out));
  }
  for (const dendro::MapTree& in : model.trees) {
    dendro_slam::MapTree out;
    out.id = in.id;
    out.trunk_branch_id = in.trunk_branch_id;
    out.branch_ids = in.branch_ids;
    out.base = ToPoint(in.base);
    out.dbh_height = in.dbh_height_m;
    out.dbh_seen = in.dbh_m.has_value();
    out.dbh = in.dbh_m.value_or(0.0);
    out.dbh_sigma = in.dbh_sigma_m;
    out.height = in.height_m;
    out.max_branch_order = in.max_branch_order;
    out.stem_volume = in.stem_volume_m3;
    out.wood_volume = in.wood_volume_m3;
    out.min_radius = in.min_radius_m;
    out.volume_sigma = in.volume_sigma_m3;
    out.lean = in.lean_rad;
    out.arc_coverage = in.arc_coverage_rad;
    out.num_scans = in.num_scans;
    msg->trees.push_back(std::move(out));
  }
  return msg;
}

dendro::TreeModel FromMsg(const dendro_slam::TreeMap& map) {
  dendro::TreeModel model;
  model.stamp_ns = ToNs(map.header.stamp);
  for (const dendro_slam::MapCylinder& in : map.cylinders) {
    dendro::MapCylinder out;
    out.id = in.id;
    out.landmark_id = in.landmark_id;
    out.tree_id = in.tree_id;
    out.branch_id = in.branch_id;
    out.parent_id = in.parent_id;
    out.branch_order = in.branch_order;
    out.position_in_branch = in.position_in_branch;
    out.start = ToEigen(in.start);
    out.end = ToEigen(in.end);
    out.radius_m = in.radius;
    out.radius_sigma_m = in.radius_sigma;
    out.taper_m_per_m = in.taper;
    out.axis_sigma_rad = in.axis_sigma;
    out.position_sigma_m = in.position_sigma;
    out.num_scans = in.num_scans;
    out.num_points = in.num_points;
    out.visible_arc_rad = in.visible_arc;
    out.mean_abs_deviation_m = in.mean_abs_deviation;
    out.status = static_cast<dendro::FitStatus>(in.status);
    model.cylinders.push_back(out);
  }
  for (const dendro_slam::MapBranch& in : map.branches) {
    dendro::MapBranch out;
    out.id = in.id;
    out.tree_id = in.tree_id;
    out.parent_id = in.parent_id;
    out.order = in.order;
    out.cylinder_ids = in.cylinder_ids;
    out.base = ToEigen(in.base);
    out.tip = ToEigen(in.tip);
    out.length_m = in.length;
    out.base_radius_m = in.base_radius;
    out.middle_radius_m = in.middle_radius;
    out.tip_radius_m = in.tip_radius;
    out.base_radius_sigma_m = in.base_radius_sigma;
    out.angle_rad = in.angle;
    out.azimuth_rad = in.azimuth;
    out.zenith_rad = in.zenith;
    out.height_m = in.height;
    model.branches.push_back(std::move(out));
  }
  for (const dendro_slam::MapTree& in : map.trees) {
    dendro::MapTree out;
    out.id = in.id;
    out.trunk_branch_id = in.trunk_branch_id;
    out.branch_ids = in.branch_ids;
    out.base = ToEigen(in.base);
    out.dbh_height_m = in.dbh_height;
    if (in.dbh_seen) out.dbh_m = in.dbh;
    out.dbh_sigma_m = in.dbh_sigma;
    out.height_m = in.height;
    out.max_branch_order = in.max_branch_order;
    out.stem_volume_m3 = in.stem_volume;
    out.wood_volume_m3 = in.wood_volume;
    out.min_radius_m = in.min_radius;
    out.volume_sigma_m3 = in.volume_sigma;
    out.lean_rad = in.lean;
    out.arc_coverage_rad = in.arc_coverage;
    out.num_scans = in.num_scans;
    model.trees.push_back(std::move(out));
  }
  return model;
}

dendro_slam::GraphStatusPtr ToMsg(const dendro::MapperResult& result, const std::string& frame_id) {
  auto msg = boost::make_shared<dendro_slam::GraphStatus>();
  msg->header.stamp = ToRosTime(result.stamp_ns);
  msg->header.frame_id = frame_id;
  msg->pose = ToMsg(result.T_map_lidar, result.pose_covariance);
  msg->is_key_frame = result.is_key_frame;
  for (const dendro::ObservationVerdict& in : result.observations) {
    dendro_slam::ObservationVerdict out;
    out.segment_id = in.segment_id;
    out.landmark_id = in.landmark_id;
    out.is_new = in.is_new;
    msg->observations.push_back(out);
  }
  msg->error_before = result.error_before;
  msg->error_after = result.error_after;
  msg->damping = result.damping;
  msg->variables_relinearized = result.variables_relinearized;
  msg->variables_reeliminated = result.variables_reeliminated;
  msg->odometry_rejected = result.odometry_rejected;
  msg->warning = result.warning;
  return msg;
}

}  // namespace dendro_ros
