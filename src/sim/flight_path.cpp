#include "dendro_slam/sim/flight_path.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <functional>
#include <optional>
#include <sstream>

#include <fmt/format.h>

#include "counter_rng.h"
#include "dendro_slam/sim/scene.h"
#include "yaml_reader.h"

namespace dendro {
namespace {

constexpr double kDegree = M_PI / 180.0;
constexpr double kKnotPeriodS = 0.05;
constexpr double kLongestS = 86400.0;  ///< Nobody flies for longer than a day.

/// A place at a time, and how far the rig is leaned back there.
struct TimedPoint {
  double time_s;
  Eigen::Vector3d position;
  double tilt_rad = 0.0;
};

/// The way-points before smoothing, linear in between, at rest outside.
class RawPath {
 public:
  explicit RawPath(double hover_s) : time_s_(hover_s) {}

  void Add(const Eigen::Vector3d& p, double speed_mps, double tilt_rad = 0.0) {
    if (points_.empty()) {
      points_.push_back({time_s_, p, tilt_rad});
      return;
    }
    const double length = (p - points_.back().position).norm();
    if (length < 1e-9) return;
    time_s_ += length / speed_mps;
    points_.push_back({time_s_, p, tilt_rad});
  }

  double end_s() const { return time_s_; }

  /// Position, and the tilt as the fourth number.
  Eigen::Vector4d At(double t) const {
    const auto whole = [](const TimedPoint& p) {
      return Eigen::Vector4d(p.position.x(), p.position.y(), p.position.z(), p.tilt_rad);
    };
    if (t <= points_.front().time_s) return whole(points_.front());
    if (t >= points_.back().time_s) return whole(points_.back());
    const auto after = std::upper_bound(points_.begin(), points_.end(), t,
                                        [](double time, const TimedPoint& p) { return time < p.time_s; });
    const TimedPoint& b = *after;
    const TimedPoint& a = *(after - 1);
    return whole(a) + (t - a.time_s) / (b.time_s - a.time_s) * (whole(b) - whole(a));
  }

 private:
  double time_s_;
  std::vector<TimedPoint> points_;
};

/// The raw path smoothed by a uniform cubic B-spline whose control points lie on it: twice
/// continuously differentiable, corners are rounded over about `spacing_s` before and after.
Eigen::Vector4d Smooth(const RawPath& raw, double spacing_s, double t) {
  const double x = t / spacing_s;
  const double i = std::floor(x);
  const double u = x - i;
  const double b0 = (1 - u) * (1 - u) * (1 - u) / 6.0;
  const double b1 = (3 * u * u * u - 6 * u * u + 4) / 6.0;
  const double b2 = (-3 * u * u * u + 3 * u * u + 3 * u + 1) / 6.0;
  const double b3 = u * u * u / 6.0;
  return b0 * raw.At((i - 1) * spacing_s) + b1 * raw.At(i * spacing_s) + b2 * raw.At((i + 1) * spacing_s) +
         b3 * raw.At((i + 2) * spacing_s);
}

Eigen::Isometry3d ReadTransform(const YamlMap& map) {
  map.AllowOnly({"position", "rpy_deg"});
  const Eigen::Vector3d rpy = map.Vector("rpy_deg", Eigen::Vector3d::Zero()) * kDegree;
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  T.translation() = map.Vector("position", Eigen::Vector3d::Zero());
  T.linear() = (Eigen::AngleAxisd(rpy.z(), Eigen::Vector3d::UnitZ()) *
                Eigen::AngleAxisd(rpy.y(), Eigen::Vector3d::UnitY()) *
                Eigen::AngleAxisd(rpy.x(), Eigen::Vector3d::UnitX()))
                   .toRotationMatrix();
  return T;
}

/// Slow sway of roll and pitch, as a hovering drone has it.
struct Wobble {
  double roll_deg = 0.0, pitch_deg = 0.0, period_s = 4.0;
  std::uint64_t seed = 1;

  double At(double t, int axis) const {
    CounterRng rng(seed, static_cast<std::uint64_t>(axis), 0x30bb1e);
    // Two waves whose periods have no common multiple.
    const double a = std::sin(2.0 * M_PI * (t / period_s + rng.Uniform()));
    const double b = std::sin(2.0 * M_PI * (t / (0.618 * period_s) + rng.Uniform()));
    return (axis == 0 ? roll_deg : pitch_deg) * kDegree * (0.6 * a + 0.4 * b);
  }
};

/// The body's motion in the step of a walking person.
struct Gait {
  double step_hz = 1.9, bob_m = 0.02, sway_m = 0.025, roll_deg = 1.0, pitch_deg = 1.0;
};

std::vector<double> Positive(const YamlMap& map, const std::string& key) {
  std::vector<double> values = map.Numbers(key);
  if (values.empty()) map.Fail(key, "expected at least one number");
  return values;
}

double PositiveNumber(const YamlMap& map, const std::string& key) {
  const double value = map.Number(key);
  if (value <= 0.0) map.Fail(key, "expected a number > 0");
  return value;
}

Eigen::Vector2d ReadCentre(const YamlMap& map) {
  if (!map.Has("centre")) return Eigen::Vector2d::Zero();
  const std::vector<double> c = map.Numbers("centre");
  if (c.size() != 2) map.Fail("centre", "expected two numbers [x, y]");
  return {c[0], c[1]};
}

/// Keys that every type has.
const std::vector<std::string> kCommonKeys = {"type",       "duration_s", "start_stamp_s",
                                              "extrinsics", "odometry",   "origin"};
/// Keys of every type that is made here (all but poses).
const std::vector<std::string> kMotionKeys = {"speed_mps", "look_at", "yaw",     "hover_s",
                                              "corner_s",  "wobble"};

void Allow(const YamlMap& map, bool motion, const std::vector<std::string>& own) {
  std::vector<std::string> keys = kCommonKeys;
  if (motion) keys.insert(keys.end(), kMotionKeys.begin(), kMotionKeys.end());
  keys.insert(keys.end(), own.begin(), own.end());
  map.AllowOnly(keys);
}

void AddSpiral(const YamlMap& map,
               double radius_from,
               double radius_to,
               double z_from,
               double z_to,
               double speed,
               RawPath* raw) {
  const Eigen::Vector2d centre = ReadCentre(map);
  const double mean_lap = M_PI * (radius_from + radius_to);
  double laps = 1.0;
  if (map.Has("laps")) {
    laps = PositiveNumber(map, "laps");
  } else if (map.Has("duration_s")) {
    laps = PositiveNumber(map, "duration_s") * speed / mean_lap;
  }
  if (laps * mean_lap / speed > kLongestS) map.Fail("laps", "the flight would take more than a day; expected fewer");
  const double start = map.Number("start_deg", 0.0) * kDegree;
  const int steps = std::max(16, static_cast<int>(std::ceil(laps * 180.0)));
  for (int i = 0; i <= steps; ++i) {
    const double u = static_cast<double>(i) / steps;
    const double angle = start + 2.0 * M_PI * laps * u;
    const double radius = radius_from + u * (radius_to - radius_from);
    raw->Add({centre.x() + radius * std::cos(angle), centre.y() + radius * std::sin(angle),
              z_from + u * (z_to - z_from)},
             speed);
  }
}

std::vector<TimedPose> ReadTum(const YamlMap& map, const std::string& path) {
  std::ifstream file(path);
  if (!file) map.Fail("file", fmt::format("{}: cannot be read: {}", path, std::strerror(errno)));
  std::vector<TimedPose> poses;
  std::string line;
  int number = 0;
  long double first = 0.0L;
  while (std::getline(file, line)) {
    ++number;
    const std::size_t begin = line.find_first_not_of(" \t\r");
    if (begin == std::string::npos || line[begin] == '#') continue;
    std::istringstream words(line);
    long double stamp = 0.0L;
    double x, y, z, qx, qy, qz, qw;
    if (!(words >> stamp >> x >> y >> z >> qx >> qy >> qz >> qw)) {
      map.Fail("file", fmt::format("{}: line {}: expected stamp x y z qx qy qz qw", path, number));
    }
    if (!(std::max({std::abs(x), std::abs(y), std::abs(z)}) <= 1e9)) {
      map.Fail("file", fmt::format("{}: line {}: a position is out of this world", path, number));
    }
    const Eigen::Quaterniond q(qw, qx, qy, qz);
    if (std::abs(q.norm() - 1.0) > 0.01) {
      map.Fail("file", fmt::format("{}: line {}: the quaternion is not of unit length", path, number));
    }
    if (poses.empty()) first = stamp;
    TimedPose pose;
    pose.time_s = static_cast<double>(stamp - first);
    if (!poses.empty() && pose.time_s <= poses.back().time_s) {
      map.Fail("file", fmt::format("{}: line {}: stamps must ascend", path, number));
    }
    pose.T_map_base.linear() = q.normalized().toRotationMatrix();
    pose.T_map_base.translation() = Eigen::Vector3d(x, y, z);
    poses.push_back(pose);
  }
  if (poses.size() < 2) map.Fail("file", path + ": expected at least two poses");
  return poses;
}

}  // namespace

Eigen::Isometry3d FlightPath::LidarPose(std::int64_t stamp_ns) const {
  return trajectory.Pose(static_cast<double>(stamp_ns - start_stamp_ns) * 1e-9) * T_base_lidar;
}

GnssFix FlightPath::Fix(std::int64_t stamp_ns) const {
  constexpr std::int64_t kSecondNs = 1000000000;
  GnssFix fix;
  fix.stamp_ns = stamp_ns / kSecondNs * kSecondNs;
  fix.utc_ns = fix.stamp_ns;
  fix.valid = true;
  const double time_s = static_cast<double>(fix.stamp_ns - start_stamp_ns) * 1e-9;
  const Eigen::Isometry3d T_map_base = trajectory.Pose(time_s);
  const Eigen::Vector3d velocity = T_map_base.linear() * trajectory.Twist(time_s).tail<3>();
  // Radii of curvature of the WGS 84 ellipsoid along the meridian and across it.
  constexpr double kSemiMajorM = 6378137.0, kFlattening = 1.0 / 298.257223563;
  constexpr double kEccentricity2 = kFlattening * (2.0 - kFlattening);
  const double latitude = origin_latitude_deg * kDegree;
  const double w2 = 1.0 - kEccentricity2 * std::pow(std::sin(latitude), 2);
  const double meridian_m = kSemiMajorM * (1.0 - kEccentricity2) / (w2 * std::sqrt(w2));
  const double normal_m = kSemiMajorM / std::sqrt(w2);
  const Eigen::Vector3d p = T_map_base.translation();
  fix.latitude_deg = origin_latitude_deg + p.y() / meridian_m / kDegree;
  fix.longitude_deg = origin_longitude_deg + p.x() / (normal_m * std::cos(latitude)) / kDegree;
  fix.speed_mps = velocity.head<2>().norm();
  fix.course_deg = fix.speed_mps > 1e-6 ? std::atan2(velocity.x(), velocity.y()) / kDegree : 0.0;
  return fix;
}

FlightPath ParseFlightPath(const std::string& text, const std::string& name) {
  const YamlMap map = YamlMap::Parse(text, name);
  const std::string type = map.String("type");
  std::vector<TimedPose> knots;
  double path_end_s = 0.0;

  if (type == "poses") {
    Allow(map, false, {"file"});
    const std::filesystem::path file = std::filesystem::path(name).parent_path() / map.String("file");
    knots = ReadTum(map, file.string());
    path_end_s = knots.back().time_s;
  } else {
    const bool known = type == "quadrangle" || type == "circle" || type == "helix" ||
                       type == "conical_helix" || type == "walk";
    if (!known) map.Fail("type", "expected quadrangle, circle, helix, conical_helix, walk or poses");
    if (type == "quadrangle") Allow(map, true, {"centre", "side_m", "corners", "altitudes_m"});
    if (type == "circle") Allow(map, true, {"centre", "radius_m", "altitude_m", "laps", "start_deg"});
    if (type == "helix") Allow(map, true, {"centre", "radius_m", "altitudes_m", "laps", "start_deg"});
    if (type == "conical_helix") Allow(map, true, {"centre", "radii_m", "altitudes_m", "laps", "start_deg"});
    if (type == "walk") Allow(map, true, {"waypoints", "gait", "tilt_deg"});

    const double speed = PositiveNumber(map, "speed_mps");
    const double hover = map.Number("hover_s", 1.0);
    if (hover < 0.0) map.Fail("hover_s", "expected a time >= 0 [s]");
    const double corner = map.Number("corner_s", type == "quadrangle" ? 0.7 : 0.3);
    if (corner <= 0.0) map.Fail("corner_s", "expected a time > 0 [s]");

    RawPath raw(hover);
    if (type == "quadrangle") {
      std::vector<Eigen::Vector2d> corners;
      if (map.Has("corners") == map.Has("side_m")) map.Fail("corners", "expected either corners or side_m");
      if (map.Has("corners")) {
        if (map.Has("centre")) map.Fail("centre", "expected with side_m only");
        for (const std::vector<double>& row : map.Rows("corners", 2)) corners.emplace_back(row[0], row[1]);
        if (corners.size() < 3) map.Fail("corners", "expected at least three corners [x, y]");
      } else {
        const Eigen::Vector2d c = ReadCentre(map);
        const double h = 0.5 * PositiveNumber(map, "side_m");
        for (const auto& s : {Eigen::Vector2d(1, -1), Eigen::Vector2d(1, 1), Eigen::Vector2d(-1, 1),
                              Eigen::Vector2d(-1, -1)}) {
          corners.emplace_back(c + h * s);
        }
      }
      for (const double z : Positive(map, "altitudes_m")) {
        for (std::size_t i = 0; i <= corners.size(); ++i) {
          const Eigen::Vector2d& c = corners[i % corners.size()];
          raw.Add({c.x(), c.y(), z}, speed);
        }
      }
    } else if (type == "circle") {
      const double r = PositiveNumber(map, "radius_m");
      const double z = map.Number("altitude_m");
      AddSpiral(map, r, r, z, z, speed, &raw);
    } else if (type == "helix" || type == "conical_helix") {
      const std::vector<double> z = map.Numbers("altitudes_m");
      if (z.size() != 2) map.Fail("altitudes_m", "expected two numbers [from, to]");
      std::vector<double> r;
      if (type == "helix") {
        r.assign(2, PositiveNumber(map, "radius_m"));
      } else {
        r = map.Numbers("radii_m");
        if (r.size() != 2 || r[0] <= 0.0 || r[1] <= 0.0) map.Fail("radii_m", "expected two numbers [from, to] > 0");
      }
      AddSpiral(map, r[0], r[1], z[0], z[1], speed, &raw);
    } else {
      const auto rows = map.Rows("waypoints", 3);
      if (rows.size() < 2) map.Fail("waypoints", "expected at least two way-points [x, y, z]");
      std::vector<double> tilt_deg(rows.size(), 0.0);
      if (map.Has("tilt_deg")) tilt_deg = map.Numbers("tilt_deg");
      if (tilt_deg.size() != rows.size()) map.Fail("tilt_deg", "expected one angle for every way-point [deg]");
      for (std::size_t i = 0; i < rows.size(); ++i) {
        if (!(std::abs(tilt_deg[i]) <= 80.0)) map.Fail("tilt_deg", "expected -80 to 80 [deg]");
        raw.Add({rows[i][0], rows[i][1], rows[i][2]}, speed, tilt_deg[i] * kDegree);
      }
    }
    path_end_s = raw.end_s() + hover;
    if (path_end_s > kLongestS) {
      map.Fail("speed_mps", fmt::format("the path would take {:.0f} s; expected at most a day", path_end_s));
    }

    Wobble wobble;
    if (map.Has("wobble")) {
      const YamlMap w = map.Map("wobble");
      w.AllowOnly({"roll_deg", "pitch_deg", "period_s", "seed"});
      wobble.roll_deg = w.Number("roll_deg", 0.0);
      wobble.pitch_deg = w.Number("pitch_deg", 0.0);
      wobble.period_s = w.Number("period_s", wobble.period_s);
      if (wobble.period_s <= 0.0) w.Fail("period_s", "expected a time > 0 [s]");
      wobble.seed = w.Seed("seed", 1);
    }
    std::optional<Gait> gait;
    if (type == "walk") {
      gait = Gait();
      if (map.Has("gait")) {
        const YamlMap g = map.Map("gait");
        g.AllowOnly({"step_hz", "bob_m", "sway_m", "roll_deg", "pitch_deg"});
        gait->step_hz = g.Number("step_hz", gait->step_hz);
        gait->bob_m = g.Number("bob_m", gait->bob_m);
        gait->sway_m = g.Number("sway_m", gait->sway_m);
        gait->roll_deg = g.Number("roll_deg", gait->roll_deg);
        gait->pitch_deg = g.Number("pitch_deg", gait->pitch_deg);
        if (gait->step_hz <= 0.0) g.Fail("step_hz", "expected a frequency > 0 [Hz]");
      }
    }
    if (map.Has("look_at") == map.Has("yaw")) map.Fail("yaw", "expected either look_at or yaw");
    std::optional<Eigen::Vector3d> look_at;
    bool along = false;
    double fixed_yaw = 0.0;
    if (map.Has("look_at")) {
      look_at = map.Vector("look_at");
    } else if (map.String("yaw") == "along") {
      along = true;
    } else {
      fixed_yaw = map.Number("yaw") * kDegree;
    }

    const int count = static_cast<int>(std::ceil(path_end_s / kKnotPeriodS)) + 1;
    double yaw = fixed_yaw;
    if (along) {
      // The first direction in which the path goes anywhere.
      for (int i = 0; i < count; ++i) {
        const Eigen::Vector4d v = Smooth(raw, corner, (i + 1) * kKnotPeriodS) - Smooth(raw, corner, i * kKnotPeriodS);
        if (v.head<2>().norm() > 0.2 * speed * kKnotPeriodS) {
          yaw = std::atan2(v.y(), v.x());
          break;
        }
      }
    }
    for (int i = 0; i < count; ++i) {
      const double t = i * kKnotPeriodS;
      const Eigen::Vector4d place = Smooth(raw, corner, t);
      Eigen::Vector3d p = place.head<3>();
      const Eigen::Vector4d v =
          (Smooth(raw, corner, t + 0.5 * kKnotPeriodS) - Smooth(raw, corner, t - 0.5 * kKnotPeriodS)) /
          kKnotPeriodS;
      const double horizontal = v.head<2>().norm();
      // Leaning back turns the nose up, against the positive pitch.
      double roll = wobble.At(t, 0), pitch = wobble.At(t, 1) - place[3];
      if (gait) {
        // The gait fades in and out with the speed.
        const double strength = std::min(1.0, horizontal / speed);
        const double phase = 2.0 * M_PI * gait->step_hz * t;
        p.z() += strength * gait->bob_m * std::sin(phase);
        if (horizontal > 1e-6) {
          const Eigen::Vector2d left(-v.y() / horizontal, v.x() / horizontal);
          p.head<2>() += strength * gait->sway_m * std::sin(0.5 * phase) * left;
        }
        roll += strength * gait->roll_deg * kDegree * std::sin(0.5 * phase + 0.4);
        pitch += strength * gait->pitch_deg * kDegree * std::sin(phase + 1.1);
      }
      if (look_at) {
        const Eigen::Vector2d d = look_at->head<2>() - p.head<2>();
        if (d.norm() > 1e-6) yaw = std::atan2(d.y(), d.x());
      } else if (along && horizontal > 0.2 * speed) {
        yaw = std::atan2(v.y(), v.x());
      }
      TimedPose pose;
      pose.time_s = t;
      pose.T_map_base.translation() = p;
      pose.T_map_base.linear() = (Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()) *
                                  Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitY()) *
                                  Eigen::AngleAxisd(roll, Eigen::Vector3d::UnitX()))
                                     .toRotationMatrix();
      knots.push_back(pose);
    }
  }

  FlightPath path{"", Trajectory(std::move(knots)), 0.0, 0, Eigen::Isometry3d::Identity(),
                  Eigen::Isometry3d::Identity(), {}};
  path.name = std::filesystem::path(name).stem().string();
  path.duration_s = path_end_s;
  if (map.Has("duration_s")) path.duration_s = PositiveNumber(map, "duration_s");
  if (path.duration_s > kLongestS) map.Fail("duration_s", "expected at most a day, 86400 [s]");
  const int start_s = map.Integer("start_stamp_s", 1600000000);
  if (start_s < 0) map.Fail("start_stamp_s", "expected a whole number of seconds >= 0");
  path.start_stamp_ns = static_cast<std::int64_t>(start_s) * 1000000000;
  if (map.Has("extrinsics")) {
    const YamlMap e = map.Map("extrinsics");
    e.AllowOnly({"base_to_lidar", "base_to_camera"});
    if (e.Has("base_to_lidar")) path.T_base_lidar = ReadTransform(e.Map("base_to_lidar"));
    if (e.Has("base_to_camera")) path.T_base_camera = ReadTransform(e.Map("base_to_camera"));
  }
  if (map.Has("origin")) {
    const YamlMap o = map.Map("origin");
    o.AllowOnly({"latitude_deg", "longitude_deg"});
    path.origin_latitude_deg = o.Number("latitude_deg");
    path.origin_longitude_deg = o.Number("longitude_deg");
    if (std::abs(path.origin_latitude_deg) > 89.0) o.Fail("latitude_deg", "expected -89 to 89 [deg]");
    if (std::abs(path.origin_longitude_deg) > 180.0) o.Fail("longitude_deg", "expected -180 to 180 [deg]");
  }
  if (map.Has("odometry")) {
    const YamlMap o = map.Map("odometry");
    o.Read(&path.odometry);
    try {
      path.odometry.Validate();
    } catch (const std::invalid_argument& e) {
      map.Fail("odometry", e.what());
    }
  }
  return path;
}

FlightPath LoadFlightPath(const std::string& path) {
  std::ifstream file(path);
  if (!file) throw SceneFileError(fmt::format("{}: cannot be read: {}", path, std::strerror(errno)));
  std::ostringstream text;
  text << file.rdbuf();
  return ParseFlightPath(text.str(), path);
}

}  // namespace dendro
