#include "dendro_slam/sensors/pose_stream.h"

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <optional>
#include <string_view>

namespace dendro {

namespace {

constexpr std::size_t kNone = static_cast<std::size_t>(-1);

[[noreturn]] void Fail(std::size_t line, const std::string& what) {
  throw PoseStreamError("line " + std::to_string(line) + ": " + what);
}

std::string_view Trim(std::string_view text) {
  const auto space = [](char c) { return c == ' ' || c == '\t' || c == '\r'; };
  while (!text.empty() && space(text.front())) text.remove_prefix(1);
  while (!text.empty() && space(text.back())) text.remove_suffix(1);
  return text;
}

// Extended precision keeps nanoseconds since 1970 exact.
long double Number(std::string_view text, std::size_t line) {
  text = Trim(text);
  long double value = 0.0L;
  const auto parsed = std::from_chars(text.data(), text.data() + text.size(), value);
  if (text.empty() || parsed.ec != std::errc() || parsed.ptr != text.data() + text.size() ||
      !std::isfinite(static_cast<double>(value))) {
    Fail(line, "'" + std::string(text) + "' is not a finite number");
  }
  return value;
}

std::vector<std::string_view> Split(std::string_view text, char separator) {
  std::vector<std::string_view> fields;
  for (;;) {
    const std::size_t at = text.find(separator);
    fields.push_back(Trim(text.substr(0, at)));
    if (at == std::string_view::npos) return fields;
    text.remove_prefix(at + 1);
  }
}

std::vector<std::string_view> SplitSpaces(std::string_view text) {
  std::vector<std::string_view> fields;
  text = Trim(text);
  while (!text.empty()) {
    const std::size_t at = text.find_first_of(" \t");
    fields.push_back(text.substr(0, at));
    if (at == std::string_view::npos) break;
    text = Trim(text.substr(at));
  }
  return fields;
}

std::string Lower(std::string_view text) {
  std::string out(text);
  for (char& c : out) c = c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c;
  return out;
}

std::int64_t StampNs(long double time, long double unit_s, std::size_t line) {
  const long double ns = time * unit_s * 1e9L;
  if (!(ns >= 0.0L && ns < 9.2e18L)) Fail(line, "time is out of range");
  return static_cast<std::int64_t>(std::llround(ns));
}

// v: t (3), q x y z w (4).
Eigen::Isometry3d Pose(const std::array<double, 7>& v, double tolerance, std::size_t line) {
  const Eigen::Quaterniond q(v[6], v[3], v[4], v[5]);
  if (std::abs(q.norm() - 1.0) > tolerance) Fail(line, "the quaternion is not of unit length");
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  T.linear() = q.normalized().toRotationMatrix();
  T.translation() = Eigen::Vector3d(v[0], v[1], v[2]);
  return T;
}

void Append(const StreamedPose& pose, std::size_t line, std::vector<StreamedPose>& poses) {
  if (!poses.empty() && pose.stamp_ns <= poses.back().stamp_ns) {
    Fail(line, "time does not grow");
  }
  poses.push_back(pose);
}

struct Columns {
  std::size_t time = kNone;
  long double unit_s = 0.0L;          ///< 0: told apart by size.
  std::size_t backup_time = kNone;    ///< rs-convert: backend, ms.
  std::array<std::size_t, 7> pose{};  ///< t, q x y z w.
  std::size_t confidence = kNone;
  std::size_t size = 0;
  bool rs_convert = false;
};

std::size_t Find(const std::vector<std::string>& names,
                 std::initializer_list<const char*> candidates) {
  for (const char* candidate : candidates) {
    const auto it = std::find(names.begin(), names.end(), candidate);
    if (it != names.end()) return static_cast<std::size_t>(it - names.begin());
  }
  return kNone;
}

// Nothing when the line is no header of a pose table.
std::optional<Columns> ParseHeader(const std::vector<std::string_view>& fields) {
  std::vector<std::string> names;
  for (const std::string_view field : fields) names.push_back(Lower(field));
  Columns columns;
  columns.size = names.size();
  columns.rs_convert = names[0] == "stream type";
  if (columns.rs_convert) {
    columns.time = Find(names, {"host timestamp(ms)", "host timestamp (ms)"});
    columns.backup_time = Find(names, {"backend timestamp(ms)", "backend timestamp (ms)"});
    columns.unit_s = 1e-3L;
  } else {
    columns.time = Find(names, {"timestamp", "time", "stamp", "t", "#timestamp", "# timestamp"});
  }
  columns.pose = {Find(names, {"t_x", "tx", "x", "px", "p_x"}),
                  Find(names, {"t_y", "ty", "y", "py", "p_y"}),
                  Find(names, {"t_z", "tz", "z", "pz", "p_z"}),
                  Find(names, {"r_x", "qx", "q_x", "rx"}),
                  Find(names, {"r_y", "qy", "q_y", "ry"}),
                  Find(names, {"r_z", "qz", "q_z", "rz"}),
                  Find(names, {"r_w", "qw", "q_w", "rw"})};
  columns.confidence = Find(names, {"tracker_confidence", "confidence"});
  if (columns.time == kNone) return std::nullopt;
  for (const std::size_t column : columns.pose) {
    if (column == kNone) return std::nullopt;
  }
  return columns;
}

// Seconds since 1970 have 10 digits for the next centuries, so thousands of them tell the unit.
long double UnitOf(long double time) {
  if (time < 1e11L) return 1.0L;
  if (time < 1e14L) return 1e-3L;
  if (time < 1e17L) return 1e-6L;
  return 1e-9L;
}

// p_ros = (-z, -x, y).
Eigen::Matrix3d RosAxes() {
  Eigen::Matrix3d R;
  R << 0, 0, -1, -1, 0, 0, 0, 1, 0;
  return R;
}

}  // namespace

Eigen::Vector3d RosFromRealSense(const Eigen::Vector3d& p) { return RosAxes() * p; }

Eigen::Isometry3d RosFromRealSense(const Eigen::Isometry3d& T) {
  const Eigen::Matrix3d R = RosAxes();
  Eigen::Isometry3d out = Eigen::Isometry3d::Identity();
  out.linear() = R * T.linear() * R.transpose();
  out.translation() = R * T.translation();
  return out;
}

std::vector<StreamedPose> ReadTumPoses(std::istream& in) {
  std::vector<StreamedPose> poses;
  std::string text;
  for (std::size_t line = 1; std::getline(in, text); ++line) {
    const std::string_view content = Trim(std::string_view(text).substr(0, text.find('#')));
    if (content.empty()) continue;
    const std::vector<std::string_view> fields = SplitSpaces(content);
    if (fields.size() != 8) Fail(line, "expected time tx ty tz qx qy qz qw");
    std::array<double, 7> v{};
    for (std::size_t i = 0; i < 7; ++i) v[i] = static_cast<double>(Number(fields[i + 1], line));
    StreamedPose pose;
    pose.stamp_ns = StampNs(Number(fields[0], line), 1.0L, line);
    pose.T_odom_camera = Pose(v, 1e-2, line);
    Append(pose, line, poses);
  }
  return poses;
}

std::vector<StreamedPose> ReadRealSensePoses(std::istream& in) {
  std::vector<StreamedPose> poses;
  std::optional<Columns> columns;
  bool found_header = false;
  long double unit_s = 0.0L;
  std::string text;
  for (std::size_t line = 1; std::getline(in, text); ++line) {
    const std::string_view content = Trim(text);
    if (content.empty()) continue;
    const std::vector<std::string_view> fields = Split(content, ',');
    const bool section = Lower(fields[0]) == "stream type";
    if (!found_header || section) {
      columns = ParseHeader(fields);
      found_header = found_header || columns.has_value();
      if (!columns && !section) Fail(line, "no header that names a time and the pose's columns");
      if (!found_header) found_header = section;
      continue;
    }
    if (!columns) continue;  // A section of another stream.
    if (columns->rs_convert && Lower(fields[0]) != "pose") continue;
    if (fields.size() != columns->size) {
      Fail(line, "expected " + std::to_string(columns->size) + " columns");
    }
    std::array<double, 7> v{};
    for (std::size_t i = 0; i < 7; ++i) {
      v[i] = static_cast<double>(Number(fields[columns->pose[i]], line));
    }
    long double time = Number(fields[columns->time], line);
    if (columns->rs_convert) {
      unit_s = columns->unit_s;
      if (time <= 0.0L && columns->backup_time != kNone) {
        time = Number(fields[columns->backup_time], line);
      }
      if (time <= 0.0L) Fail(line, "no time of the host");
    } else if (unit_s == 0.0L) {
      unit_s = UnitOf(time);
    }
    StreamedPose pose;
    pose.stamp_ns = StampNs(time, unit_s, line);
    // rs-convert rounds to three digits.
    pose.T_odom_camera = RosFromRealSense(Pose(v, 1e-2, line));
    if (columns->confidence != kNone) {
      const long double confidence = Number(fields[columns->confidence], line);
      if (!(confidence >= 0.0L && confidence <= 3.0L)) Fail(line, "confidence must be 0 to 3");
      pose.confidence = static_cast<int>(confidence);
    }
    Append(pose, line, poses);
  }
  if (poses.empty()) throw PoseStreamError("no poses in the stream");
  return poses;
}

Matrix6d PoseCovarianceFromConfidence(int confidence,
                                      double sigma_rotation_rad,
                                      double sigma_translation_m) {
  const double scale = std::pow(10.0, 3 - std::clamp(confidence, 0, 3));
  Matrix6d cov = Matrix6d::Zero();
  cov.diagonal().head<3>().setConstant(scale * sigma_rotation_rad * sigma_rotation_rad);
  cov.diagonal().tail<3>().setConstant(scale * sigma_translation_m * sigma_translation_m);
  return cov;
}

}  // namespace dendro
