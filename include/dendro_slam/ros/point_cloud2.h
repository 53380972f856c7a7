#pragma once

#include <stdexcept>
#include <string>

#include <sensor_msgs/PointCloud2.h>

#include "dendro_slam/sensors/lidar_scan.h"

namespace dendro_ros {

/// A cloud that cannot be read. The message names the topic, the field and what to change.
class PointCloud2Error : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// Byte layout of the fields of one cloud, found by name once per cloud.
class FieldReader {
 public:
  /// @param topic  Named in errors.
  /// @throws PointCloud2Error  A missing or unreadable field, or a field outside the point.
  FieldReader(const sensor_msgs::PointCloud2& cloud, const std::string& topic, const char* name);

  /// The value of this field in the point that starts at `point`.
  double Read(const std::uint8_t* point) const;
  std::uint8_t datatype() const { return datatype_; }

 private:
  std::size_t offset_ = 0;
  std::uint8_t datatype_ = 0;
};

/// Throws PointCloud2Error unless the sizes that the cloud states fit each other and its data.
void CheckLayout(const sensor_msgs::PointCloud2& cloud, const std::string& topic);
/// True when the cloud has a field of that name.
bool HasField(const sensor_msgs::PointCloud2& cloud, const char* name);

/// Any VLP-16 cloud: organised (also one row per firing, width 16) or not, with x y z as float32 or
/// float64, `intensity`, `ring`, and the firing time as `time`, `t`, `timestamp` or `offset_time`.
///
/// A floating time is in seconds, an integer time in nanoseconds; a floating time beyond 1e6 is taken
/// as absolute and the cloud's stamp is subtracted. Missing ring or time are marked in the result
/// and derived from the geometry downstream; missing intensity is 0. NaN points are kept (they keep
/// the cloud's order). An empty cloud is an empty scan.
/// @throws PointCloud2Error  No x, y or z; sizes that do not fit the data; big-endian.
dendro::LidarScan ReadPointCloud2(const sensor_msgs::PointCloud2& cloud, const std::string& topic);

/// A cloud as velodyne_pointcloud writes it: unorganised, x y z intensity float32, ring uint16, time
/// float32 [s], 22 bytes per point.
sensor_msgs::PointCloud2Ptr ToVelodyneCloud(const dendro::LidarScan& scan,
                                            const std::string& frame_id);

}  // namespace dendro_ros
