#include "dendro_slam/io/map_directory.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <limits>
#include <optional>
#include <set>
#include <sstream>
#include <utility>

#include <boost/crc.hpp>
#include <fmt/format.h>
#include <nlohmann/json.hpp>

#include "dendro_slam/io/mesh.h"
#include "dendro_slam/io/point_files.h"
#include "dendro_slam/topology/dendrometry.h"

namespace dendro {

namespace {

using Json = nlohmann::ordered_json;

constexpr char kFormatName[] = "dendro_slam tree map";
constexpr int kFormatVersion = 1;
constexpr char kPointsFile[] = "points.ply";
constexpr double kDegPerRad = 180.0 / M_PI;

// -------------------------------------------------------------------------------------------
// Text
// -------------------------------------------------------------------------------------------

// Fixed decimals without a negative zero, so that equal maps are equal bytes.
std::string Num(double value, int decimals = 6) {
  std::string text = fmt::format("{:.{}f}", value, decimals);
  if (text[0] == '-' && text.find_first_not_of("-0.") == std::string::npos) text.erase(0, 1);
  return text;
}

std::string Optional(int id) { return id < 0 ? std::string() : std::to_string(id); }

std::string Vec(const Eigen::Vector3d& v) {
  return Num(v.x()) + ',' + Num(v.y()) + ',' + Num(v.z());
}

// Seconds with nanoseconds, exact.
std::string Stamp(std::int64_t ns) {
  const std::uint64_t magnitude =
      ns < 0 ? 0 - static_cast<std::uint64_t>(ns) : static_cast<std::uint64_t>(ns);
  return fmt::format(
      "{}{}.{:09d}", ns < 0 ? "-" : "", magnitude / 1000000000, magnitude % 1000000000);
}

// -------------------------------------------------------------------------------------------
// Files
// -------------------------------------------------------------------------------------------

[[noreturn]] void FailWrite(const std::string& path, int error) {
  throw MapFileError(fmt::format("cannot write {}: {}", path, std::strerror(error)));
}

void WriteSynced(const std::string& path, const std::string& content) {
  const int fd = ::open(path.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0644);
  if (fd < 0) FailWrite(path, errno);
  std::size_t done = 0;
  int error = 0;
  while (done < content.size() && error == 0) {
    const ssize_t written = ::write(fd, content.data() + done, content.size() - done);
    if (written > 0) {
      done += static_cast<std::size_t>(written);
    } else if (written == 0) {
      error = ENOSPC;
    } else if (errno != EINTR) {
      error = errno;
    }
  }
  if (error == 0 && ::fsync(fd) != 0 && errno != EINVAL) error = errno;
  if (::close(fd) != 0 && error == 0) error = errno;
  if (error != 0) {
    ::unlink(path.c_str());
    FailWrite(path, error);
  }
}

void SyncDirectory(const std::string& directory) {
  const int fd = ::open(directory.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  if (fd < 0) return;
  ::fsync(fd);
  ::close(fd);
}

std::string TemporaryName(const std::string& path) {
  return fmt::format("{}.tmp{}", path, ::getpid());
}

void MakeDirectory(const std::string& directory) {
  std::error_code error;
  std::filesystem::create_directories(directory, error);
  if (error) {
    throw MapFileError(fmt::format("cannot make directory {}: {}", directory, error.message()));
  }
  if (!std::filesystem::is_directory(directory)) {
    throw MapFileError(fmt::format("cannot write {}: not a directory", directory));
  }
}

// -------------------------------------------------------------------------------------------
// JSON, writing
// -------------------------------------------------------------------------------------------

double Finite(double value, const char* what, int id) {
  if (!std::isfinite(value)) {
    throw MapFileError(fmt::format("the map is not saved: {} {} is not finite", what, id));
  }
  return value;
}

Json VecJson(const Eigen::Vector3d& v, const char* what, int id) {
  return {Finite(v.x(), what, id), Finite(v.y(), what, id), Finite(v.z(), what, id)};
}

std::vector<double> UpperTriangle(const Matrix5d& covariance, const char* what, int id) {
  std::vector<double> values;
  for (int r = 0; r < 5; ++r) {
    for (int c = r; c < 5; ++c) values.push_back(Finite(covariance(r, c), what, id));
  }
  return values;
}

Json LandmarkJson(const Landmark& landmark) {
  const auto finite = [&](double v, const char* what) { return Finite(v, what, landmark.id); };
  Json j;
  j["id"] = landmark.id;
  j["confirmed"] = landmark.confirmed;
  j["axis"] = VecJson(landmark.cylinder.axis, "the axis of landmark", landmark.id);
  j["point"] = VecJson(landmark.cylinder.point, "the point of landmark", landmark.id);
  j["curvature"] = finite(landmark.cylinder.curvature, "the curvature of landmark");
  j["covariance_upper"] =
      UpperTriangle(landmark.covariance, "the covariance of landmark", landmark.id);
  j["s_min_m"] = finite(landmark.s_min_m, "s_min_m of landmark");
  j["s_max_m"] = finite(landmark.s_max_m, "s_max_m of landmark");
  j["s_min_sigma_m"] = finite(landmark.s_min_sigma_m, "s_min_sigma_m of landmark");
  j["s_max_sigma_m"] = finite(landmark.s_max_sigma_m, "s_max_sigma_m of landmark");
  j["profile"] = Json::array();
  for (const RadiusKnot& knot : landmark.profile) {
    j["profile"].push_back(
        {{"s_m", finite(knot.s_m, "the radius profile of landmark")},
         {"radius_m", finite(knot.radius_m, "the radius profile of landmark")},
         {"radius_sigma_m", finite(knot.radius_sigma_m, "the radius profile of landmark")},
         {"offset_m", VecJson(knot.offset_m, "the radius profile of landmark", landmark.id)},
         {"num_scans", knot.num_scans}});
  }
  j["num_scans"] = landmark.num_scans;
  j["num_points"] = landmark.num_points;
  j["arc_seen"] = landmark.arc_seen.to_string();
  j["mean_abs_deviation_m"] =
      finite(landmark.mean_abs_deviation_m, "mean_abs_deviation_m of landmark");
  return j;
}

// What the mapper keeps of a landmark beside what the map shows of it.
Json LandmarkStateJson(const LandmarkState& state) {
  const char* what = "the state of landmark";
  const auto finite = [&](double v) { return Finite(v, what, state.id); };
  Json j;
  j["id"] = state.id;
  j["confirmed"] = state.confirmed;
  j["axis"] = VecJson(state.line.axis, what, state.id);
  j["point"] = VecJson(state.line.point, what, state.id);
  j["curvature"] = finite(state.line.curvature);
  j["covariance_upper"] = UpperTriangle(state.covariance, what, state.id);
  j["knots"] = Json::array();
  for (const RadiusProfile::Knot& knot : state.profile.knots()) {
    Json bins = Json::array();
    for (const RadiusProfile::Bin& bin : knot.bins) {
      bins.push_back({bin.index, finite(bin.weight), finite(bin.weighted_radius), bin.num_scans});
    }
    j["knots"].push_back(
        {{"index", knot.index}, {"num_scans", knot.num_scans}, {"bins", std::move(bins)}});
  }
  j["bend_knots"] = Json::array();
  for (const BendProfile::Knot& knot : state.bend.knots()) {
    const Eigen::Matrix3d& J = knot.information;
    j["bend_knots"].push_back(
        {{"index", knot.index},
         {"information_upper",
          {finite(J(0, 0)), finite(J(0, 1)), finite(J(0, 2)), finite(J(1, 1)), finite(J(1, 2)),
           finite(J(2, 2))}},
         {"vector", VecJson(knot.vector, what, state.id)}});
  }
  j["first_cell"] = state.first_cell;
  j["coverage"] = state.coverage;
  j["end_sigma_m"] = finite(state.end_sigma_m);
  j["num_scans"] = state.num_scans;
  j["num_points"] = state.num_points;
  j["arc_seen"] = state.arc_seen.to_string();
  j["deviation_sum_m"] = finite(state.deviation_sum_m);
  j["first_scan"] = state.first_scan;
  j["last_scan"] = state.last_scan;
  return j;
}

// One key of the file's object on a line, one entry of a list of objects on a line: readable, and a
// change of one landmark is a change of one line.
std::string Pretty(const Json& json) {
  std::string out = "{";
  const char* separator = "\n";
  for (const auto& item : json.items()) {
    out += separator + Json(item.key()).dump() + ": ";
    separator = ",\n";
    if (item.value().is_array() && !item.value().empty() && item.value().front().is_object()) {
      const char* entry_separator = "[\n ";
      for (const Json& entry : item.value()) {
        out += entry_separator + entry.dump();
        entry_separator = ",\n ";
      }
      out += "]";
    } else {
      out += item.value().dump();
    }
  }
  return out + "\n}\n";
}

Json CylinderJson(const MapCylinder& c) {
  const auto finite = [&](double v) { return Finite(v, "a number of cylinder", c.id); };
  return {{"id", c.id},
          {"landmark_id", c.landmark_id},
          {"tree_id", c.tree_id},
          {"branch_id", c.branch_id},
          {"parent_id", c.parent_id},
          {"branch_order", c.branch_order},
          {"position_in_branch", c.position_in_branch},
          {"start", VecJson(c.start, "the start of cylinder", c.id)},
          {"end", VecJson(c.end, "the end of cylinder", c.id)},
          {"radius_m", finite(c.radius_m)},
          {"radius_sigma_m", finite(c.radius_sigma_m)},
          {"taper_m_per_m", finite(c.taper_m_per_m)},
          {"axis_sigma_rad", finite(c.axis_sigma_rad)},
          {"position_sigma_m", finite(c.position_sigma_m)},
          {"num_scans", c.num_scans},
          {"num_points", c.num_points},
          {"visible_arc_rad", finite(c.visible_arc_rad)},
          {"mean_abs_deviation_m", finite(c.mean_abs_deviation_m)},
          {"status", ToString(c.status)}};
}

Json GeoreferenceJson(const Georeference& g) {
  const auto finite = [&](double v) { return Finite(v, "a number of the georeference", 0); };
  const auto optional = [&](const std::optional<double>& v) { return v ? Json(finite(*v)) : Json(); };
  return {{"latitude_deg", finite(g.origin.latitude_deg)},
          {"longitude_deg", finite(g.origin.longitude_deg)},
          {"altitude_m", optional(g.origin.altitude_m)},
          {"heading_deg", optional(g.heading_deg)},
          {"heading_sigma_deg", finite(g.heading_sigma_deg)},
          {"horizontal_sigma_m", finite(g.horizontal_sigma_m)},
          {"vertical_sigma_m", finite(g.vertical_sigma_m)},
          {"pivot", {finite(g.pivot.x()), finite(g.pivot.y())}},
          {"num_fixes", g.num_fixes},
          {"num_outliers", g.num_outliers},
          {"residual_m", finite(g.residual_m)},
          {"span_m", finite(g.span_m)},
          {"note", g.note}};
}

Json GroundPatchJson(const GroundPatch& patch) {
  const auto finite = [](double v) { return Finite(v, "a number of the ground", 0); };
  return {{"count", patch.count},
          {"foot", {finite(patch.foot.x()), finite(patch.foot.y())}},
          {"z_m", finite(patch.z_m)},
          {"slope", {finite(patch.slope.x()), finite(patch.slope.y())}}};
}

Json BranchJson(const MapBranch& b) {
  const auto finite = [&](double v) { return Finite(v, "a number of branch", b.id); };
  return {{"id", b.id},
          {"tree_id", b.tree_id},
          {"parent_id", b.parent_id},
          {"order", b.order},
          {"cylinder_ids", b.cylinder_ids},
          {"base", VecJson(b.base, "the base of branch", b.id)},
          {"tip", VecJson(b.tip, "the tip of branch", b.id)},
          {"length_m", finite(b.length_m)},
          {"base_radius_m", finite(b.base_radius_m)},
          {"middle_radius_m", finite(b.middle_radius_m)},
          {"tip_radius_m", finite(b.tip_radius_m)},
          {"base_radius_sigma_m", finite(b.base_radius_sigma_m)},
          {"angle_rad", finite(b.angle_rad)},
          {"azimuth_rad", finite(b.azimuth_rad)},
          {"zenith_rad", finite(b.zenith_rad)},
          {"height_m", finite(b.height_m)}};
}

Json TreeJson(const MapTree& t) {
  const auto finite = [&](double v) { return Finite(v, "a number of tree", t.id); };
  Json crown = nullptr;
  if (t.crown) {
    crown = {{"volume_m3", finite(t.crown->volume_m3)},
             {"projected_area_m2", finite(t.crown->projected_area_m2)},
             {"hull_volume_m3", finite(t.crown->hull_volume_m3)},
             {"hull_area_m2", finite(t.crown->hull_area_m2)},
             {"base_height_m", finite(t.crown->base_height_m)},
             {"top_height_m", finite(t.crown->top_height_m)},
             {"alpha_m", finite(t.crown->alpha_m)},
             {"num_points", t.crown->num_points}};
  }
  return {{"id", t.id},
          {"trunk_branch_id", t.trunk_branch_id},
          {"branch_ids", t.branch_ids},
          {"base", VecJson(t.base, "the base of tree", t.id)},
          {"dbh_height_m", finite(t.dbh_height_m)},
          {"dbh_m", t.dbh_m ? Json(finite(*t.dbh_m)) : Json(nullptr)},
          {"dbh_sigma_m", finite(t.dbh_sigma_m)},
          {"dbh_status", ToString(t.dbh_status)},
          {"height_m", finite(t.height_m)},
          {"max_branch_order", t.max_branch_order},
          {"stem_volume_m3", finite(t.stem_volume_m3)},
          {"wood_volume_m3", finite(t.wood_volume_m3)},
          {"min_radius_m", finite(t.min_radius_m)},
          {"volume_sigma_m3", finite(t.volume_sigma_m3)},
          {"lean_rad", finite(t.lean_rad)},
          {"arc_coverage_rad", finite(t.arc_coverage_rad)},
          {"num_scans", t.num_scans},
          {"crown", std::move(crown)}};
}

Json TopologyJson(const TopologyState& state) {
  Json j;
  j["next_branch_id"] = state.next_branch_id;
  j["next_tree_id"] = state.next_tree_id;
  j["next_cylinder_id"] = state.next_cylinder_id;
  j["branch_of_landmark"] = Json::array();
  for (const auto& [landmark, branch] : state.branch_of_landmark) {
    j["branch_of_landmark"].push_back({landmark, branch});
  }
  j["tree_of_branch"] = Json::array();
  for (const auto& [branch, tree] : state.tree_of_branch)
    j["tree_of_branch"].push_back({branch, tree});
  j["sections"] = Json::array();
  for (const auto& [key, sections] : state.sections) {
    Json list = Json::array();
    for (const TopologyState::Section& section : sections) {
      list.push_back({{"id", section.id},
                      {"index", section.index},
                      {"branch_id", section.branch_id},
                      {"middle", VecJson(section.middle, "the middle of cylinder", section.id)}});
    }
    j["sections"].push_back({{"key", {key.first, key.second}}, {"cylinders", std::move(list)}});
  }
  j["origins"] = Json::array();
  for (const auto& [landmark, origin] : state.origins) {
    j["origins"].push_back(
        {{"landmark_id", landmark},
         {"point", VecJson(origin.point, "the origin of landmark", landmark)},
         {"direction", VecJson(origin.direction, "the origin of landmark", landmark)}});
  }
  return j;
}

// -------------------------------------------------------------------------------------------
// JSON, reading: every access names the field in its error
// -------------------------------------------------------------------------------------------

class Reader {
 public:
  Reader(const Json& json, const std::string& file, std::string path)
      : json_(json), file_(file), path_(std::move(path)) {}

  [[noreturn]] void Fail(const std::string& problem) const {
    throw MapFileError(
        fmt::format("{}: {} {}", file_, path_.empty() ? std::string("the file") : path_, problem));
  }

  Reader operator[](const char* key) const {
    const std::string path = path_.empty() ? std::string(key) : path_ + "." + key;
    if (!json_.is_object()) Fail("is not an object");
    const auto it = json_.find(key);
    if (it == json_.end()) Reader(json_, file_, path).Fail("is missing");
    return Reader(*it, file_, path);
  }

  Reader At(std::size_t index) const {
    return Reader(json_.at(index), file_, fmt::format("{}[{}]", path_, index));
  }

  std::size_t ArraySize() const {
    if (!json_.is_array()) Fail("is not a list");
    return json_.size();
  }

  // A key that older files lack.
  bool Has(const char* key) const {
    if (!json_.is_object()) Fail("is not an object");
    return json_.find(key) != json_.end();
  }

  void RequireSize(std::size_t size) const {
    if (ArraySize() != size) Fail(fmt::format("must hold {} entries", size));
  }

  bool IsNull() const { return json_.is_null(); }

  double Double() const {
    if (!json_.is_number()) Fail("is not a finite number");
    const double value = json_.get<double>();
    if (!std::isfinite(value)) Fail("is not a finite number");
    return value;
  }

  std::int64_t Int64() const {
    if (!json_.is_number_integer()) Fail("is not an integer");
    if (json_.is_number_unsigned() &&
        json_.get<std::uint64_t>() > static_cast<std::uint64_t>(INT64_MAX)) {
      Fail("is out of range");
    }
    return json_.get<std::int64_t>();
  }

  int Int() const {
    const std::int64_t value = Int64();
    if (value < INT32_MIN || value > INT32_MAX) Fail("is out of range");
    return static_cast<int>(value);
  }

  int NonNegative() const {
    const int value = Int();
    if (value < 0) Fail("is negative");
    return value;
  }

  bool Bool() const {
    if (!json_.is_boolean()) Fail("is not true or false");
    return json_.get<bool>();
  }

  std::string String() const {
    if (!json_.is_string()) Fail("is not a text");
    return json_.get<std::string>();
  }

  Eigen::Vector3d Vector() const {
    RequireSize(3);
    return {At(0).Double(), At(1).Double(), At(2).Double()};
  }

  Eigen::Vector3d UnitVector() const {
    const Eigen::Vector3d v = Vector();
    if (std::abs(v.norm() - 1.0) > 1e-6) Fail("is not a unit vector");
    return v;
  }

  std::vector<int> Ints() const {
    std::vector<int> values(ArraySize());
    for (std::size_t i = 0; i < values.size(); ++i) values[i] = At(i).Int();
    return values;
  }

  const Json& json() const { return json_; }

 private:
  const Json& json_;
  const std::string& file_;
  std::string path_;
};

Matrix5d ReadUpperTriangle(const Reader& j) {
  j.RequireSize(15);
  Matrix5d matrix;
  std::size_t k = 0;
  for (int r = 0; r < 5; ++r) {
    for (int c = r; c < 5; ++c, ++k) matrix(r, c) = matrix(c, r) = j.At(k).Double();
  }
  return matrix;
}

Cylinder ReadLine(const Reader& j) {
  Cylinder cylinder;
  cylinder.axis = j["axis"].UnitVector();
  cylinder.point = j["point"].Vector();
  cylinder.curvature = j["curvature"].Double();
  if (!(cylinder.curvature > 0.0)) j["curvature"].Fail("is not positive");
  return cylinder;
}

std::bitset<Landmark::kArcBins> ReadArc(const Reader& j) {
  const std::string arc = j.String();
  if (arc.size() != Landmark::kArcBins || arc.find_first_not_of("01") != std::string::npos) {
    j.Fail(fmt::format("must be {} digits 0 or 1", Landmark::kArcBins));
  }
  return std::bitset<Landmark::kArcBins>(arc);
}

std::vector<BendProfile::Knot> ReadBendKnots(const Reader& list) {
  std::vector<BendProfile::Knot> knots;
  const std::size_t count = list.ArraySize();
  for (std::size_t i = 0; i < count; ++i) {
    const Reader entry = list.At(i);
    BendProfile::Knot knot;
    knot.index = entry["index"].Int();
    if (!knots.empty() && knot.index <= knots.back().index) {
      entry["index"].Fail("is not in ascending order");
    }
    const Reader upper = entry["information_upper"];
    upper.RequireSize(6);
    std::size_t k = 0;
    for (int row = 0; row < 3; ++row) {
      for (int col = row; col < 3; ++col) {
        knot.information(row, col) = knot.information(col, row) = upper.At(k++).Double();
      }
    }
    knot.vector = entry["vector"].Vector();
    knots.push_back(knot);
  }
  return knots;
}

LandmarkState ReadLandmarkState(const Reader& j) {
  LandmarkState state;
  state.id = j["id"].NonNegative();
  state.confirmed = j["confirmed"].Bool();
  state.line = ReadLine(j);
  state.covariance = ReadUpperTriangle(j["covariance_upper"]);
  std::vector<RadiusProfile::Knot> knots;
  const Reader list = j["knots"];
  const std::size_t num_knots = list.ArraySize();
  for (std::size_t i = 0; i < num_knots; ++i) {
    const Reader entry = list.At(i);
    RadiusProfile::Knot knot;
    knot.index = entry["index"].Int();
    knot.num_scans = entry["num_scans"].NonNegative();
    const Reader bins = entry["bins"];
    const std::size_t num_bins = bins.ArraySize();
    for (std::size_t k = 0; k < num_bins; ++k) {
      const Reader values = bins.At(k);
      values.RequireSize(4);
      RadiusProfile::Bin bin{values.At(0).NonNegative(),
                             values.At(1).Double(),
                             values.At(2).Double(),
                             values.At(3).NonNegative()};
      if (!(bin.weight > 0.0)) values.At(1).Fail("is not positive");
      if (!knot.bins.empty() && bin.index <= knot.bins.back().index) {
        values.At(0).Fail("is not in ascending order");
      }
      knot.bins.push_back(bin);
    }
    if (!knots.empty() && knot.index <= knots.back().index) {
      entry["index"].Fail("is not in ascending order");
    }
    knots.push_back(std::move(knot));
  }
  state.profile.set_knots(std::move(knots));
  if (j.Has("bend_knots")) state.bend.set_knots(ReadBendKnots(j["bend_knots"]));
  state.first_cell = j["first_cell"].Int();
  state.coverage = j["coverage"].Ints();
  state.end_sigma_m = j["end_sigma_m"].Double();
  state.num_scans = j["num_scans"].NonNegative();
  state.num_points = j["num_points"].NonNegative();
  state.arc_seen = ReadArc(j["arc_seen"]);
  state.deviation_sum_m = j["deviation_sum_m"].Double();
  state.first_scan = j["first_scan"].Int64();
  state.last_scan = j["last_scan"].Int64();
  return state;
}

Landmark ReadLandmark(const Reader& j) {
  Landmark landmark;
  landmark.id = j["id"].NonNegative();
  landmark.confirmed = j["confirmed"].Bool();
  landmark.cylinder = ReadLine(j);
  landmark.covariance = ReadUpperTriangle(j["covariance_upper"]);
  landmark.s_min_m = j["s_min_m"].Double();
  landmark.s_max_m = j["s_max_m"].Double();
  if (landmark.s_max_m < landmark.s_min_m) j["s_max_m"].Fail("is below s_min_m");
  landmark.s_min_sigma_m = j["s_min_sigma_m"].Double();
  landmark.s_max_sigma_m = j["s_max_sigma_m"].Double();
  const Reader profile = j["profile"];
  const std::size_t knots = profile.ArraySize();
  for (std::size_t i = 0; i < knots; ++i) {
    RadiusKnot knot;
    knot.s_m = profile.At(i)["s_m"].Double();
    knot.radius_m = profile.At(i)["radius_m"].Double();
    knot.radius_sigma_m = profile.At(i)["radius_sigma_m"].Double();
    knot.num_scans = profile.At(i)["num_scans"].Int();
    if (profile.At(i).Has("offset_m")) knot.offset_m = profile.At(i)["offset_m"].Vector();
    if (!landmark.profile.empty() && knot.s_m < landmark.profile.back().s_m) {
      profile.At(i)["s_m"].Fail("is not in ascending order");
    }
    landmark.profile.push_back(knot);
  }
  landmark.num_scans = j["num_scans"].NonNegative();
  landmark.num_points = j["num_points"].NonNegative();
  landmark.arc_seen = ReadArc(j["arc_seen"]);
  landmark.mean_abs_deviation_m = j["mean_abs_deviation_m"].Double();
  return landmark;
}

FitStatus ReadStatus(const Reader& j) {
  const std::string text = j.String();
  for (const FitStatus status :
       {FitStatus::kMeasured, FitStatus::kUnresolved, FitStatus::kInferred}) {
    if (text == ToString(status)) return status;
  }
  j.Fail("is none of MEASURED, UNRESOLVED, INFERRED");
}

MapCylinder ReadCylinder(const Reader& j) {
  MapCylinder c;
  c.id = j["id"].NonNegative();
  c.landmark_id = j["landmark_id"].Int();
  c.tree_id = j["tree_id"].Int();
  c.branch_id = j["branch_id"].Int();
  c.parent_id = j["parent_id"].Int();
  c.branch_order = j["branch_order"].Int();
  c.position_in_branch = j["position_in_branch"].Int();
  c.start = j["start"].Vector();
  c.end = j["end"].Vector();
  c.radius_m = j["radius_m"].Double();
  c.radius_sigma_m = j["radius_sigma_m"].Double();
  c.taper_m_per_m = j["taper_m_per_m"].Double();
  c.axis_sigma_rad = j["axis_sigma_rad"].Double();
  c.position_sigma_m = j["position_sigma_m"].Double();
  c.num_scans = j["num_scans"].Int();
  c.num_points = j["num_points"].Int();
  c.visible_arc_rad = j["visible_arc_rad"].Double();
  c.mean_abs_deviation_m = j["mean_abs_deviation_m"].Double();
  c.status = ReadStatus(j["status"]);
  return c;
}

MapBranch ReadBranch(const Reader& j) {
  MapBranch b;
  b.id = j["id"].NonNegative();
  b.tree_id = j["tree_id"].Int();
  b.parent_id = j["parent_id"].Int();
  b.order = j["order"].Int();
  b.cylinder_ids = j["cylinder_ids"].Ints();
  b.base = j["base"].Vector();
  b.tip = j["tip"].Vector();
  b.length_m = j["length_m"].Double();
  b.base_radius_m = j["base_radius_m"].Double();
  b.middle_radius_m = j["middle_radius_m"].Double();
  b.tip_radius_m = j["tip_radius_m"].Double();
  b.base_radius_sigma_m = j["base_radius_sigma_m"].Double();
  b.angle_rad = j["angle_rad"].Double();
  b.azimuth_rad = j["azimuth_rad"].Double();
  b.zenith_rad = j["zenith_rad"].Double();
  b.height_m = j["height_m"].Double();
  return b;
}

MapTree ReadTree(const Reader& j) {
  MapTree t;
  t.id = j["id"].NonNegative();
  t.trunk_branch_id = j["trunk_branch_id"].Int();
  t.branch_ids = j["branch_ids"].Ints();
  t.base = j["base"].Vector();
  t.dbh_height_m = j["dbh_height_m"].Double();
  if (!j["dbh_m"].IsNull()) t.dbh_m = j["dbh_m"].Double();
  t.dbh_sigma_m = j["dbh_sigma_m"].Double();
  t.dbh_status = t.dbh_m ? FitStatus::kMeasured : FitStatus::kUnresolved;
  if (j.Has("dbh_status")) t.dbh_status = ReadStatus(j["dbh_status"]);
  t.height_m = j["height_m"].Double();
  t.max_branch_order = j["max_branch_order"].Int();
  t.stem_volume_m3 = j["stem_volume_m3"].Double();
  t.wood_volume_m3 = j["wood_volume_m3"].Double();
  t.min_radius_m = j["min_radius_m"].Double();
  t.volume_sigma_m3 = j["volume_sigma_m3"].Double();
  t.lean_rad = j["lean_rad"].Double();
  t.arc_coverage_rad = j["arc_coverage_rad"].Double();
  t.num_scans = j["num_scans"].Int();
  if (j.Has("crown") && !j["crown"].IsNull()) {
    const Reader c = j["crown"];
    MapCrown& crown = t.crown.emplace();
    crown.volume_m3 = c["volume_m3"].Double();
    crown.projected_area_m2 = c["projected_area_m2"].Double();
    crown.hull_volume_m3 = c["hull_volume_m3"].Double();
    crown.hull_area_m2 = c["hull_area_m2"].Double();
    crown.base_height_m = c["base_height_m"].Double();
    crown.top_height_m = c["top_height_m"].Double();
    crown.alpha_m = c["alpha_m"].Double();
    crown.num_points = c["num_points"].NonNegative();
  }
  return t;
}

Georeference ReadGeoreference(const Reader& j) {
  Georeference g;
  g.origin.latitude_deg = j["latitude_deg"].Double();
  g.origin.longitude_deg = j["longitude_deg"].Double();
  if (!j["altitude_m"].IsNull()) g.origin.altitude_m = j["altitude_m"].Double();
  if (!j["heading_deg"].IsNull()) g.heading_deg = j["heading_deg"].Double();
  g.heading_sigma_deg = j["heading_sigma_deg"].Double();
  g.horizontal_sigma_m = j["horizontal_sigma_m"].Double();
  g.vertical_sigma_m = j["vertical_sigma_m"].Double();
  const Reader pivot = j["pivot"];
  pivot.RequireSize(2);
  g.pivot = {pivot.At(0).Double(), pivot.At(1).Double()};
  g.num_fixes = j["num_fixes"].NonNegative();
  g.num_outliers = j["num_outliers"].NonNegative();
  g.residual_m = j["residual_m"].Double();
  g.span_m = j["span_m"].Double();
  g.note = j["note"].String();
  return g;
}

TopologyState ReadTopology(const Reader& j) {
  TopologyState state;
  state.next_branch_id = j["next_branch_id"].NonNegative();
  state.next_tree_id = j["next_tree_id"].NonNegative();
  state.next_cylinder_id = j["next_cylinder_id"].NonNegative();
  const auto read_pairs = [](const Reader& list, int next, std::map<int, int>* map) {
    const std::size_t size = list.ArraySize();
    for (std::size_t i = 0; i < size; ++i) {
      list.At(i).RequireSize(2);
      const int value = list.At(i).At(1).NonNegative();
      if (value >= next) list.At(i).Fail("names an id that was never given");
      (*map)[list.At(i).At(0).NonNegative()] = value;
    }
  };
  read_pairs(j["branch_of_landmark"], state.next_branch_id, &state.branch_of_landmark);
  read_pairs(j["tree_of_branch"], state.next_tree_id, &state.tree_of_branch);
  const Reader sections = j["sections"];
  const std::size_t size = sections.ArraySize();
  for (std::size_t i = 0; i < size; ++i) {
    const std::vector<int> key = sections.At(i)["key"].Ints();
    if (key.size() != 2) sections.At(i)["key"].Fail("must hold 2 entries");
    const Reader list = sections.At(i)["cylinders"];
    std::vector<TopologyState::Section>& target = state.sections[{key[0], key[1]}];
    const std::size_t count = list.ArraySize();
    for (std::size_t k = 0; k < count; ++k) {
      const int id = list.At(k)["id"].NonNegative();
      if (id >= state.next_cylinder_id) list.At(k)["id"].Fail("names an id that was never given");
      TopologyState::Section section{id, static_cast<int>(k), -1, list.At(k)["middle"].Vector()};
      if (list.At(k).Has("index")) section.index = list.At(k)["index"].Int();
      if (list.At(k).Has("branch_id")) section.branch_id = list.At(k)["branch_id"].Int();
      target.push_back(section);
    }
  }
  if (j.Has("origins")) {
    const Reader origins = j["origins"];
    const std::size_t num_origins = origins.ArraySize();
    for (std::size_t i = 0; i < num_origins; ++i) {
      const Reader origin = origins.At(i);
      state.origins[origin["landmark_id"].NonNegative()] = {origin["point"].Vector(),
                                                            origin["direction"].UnitVector()};
    }
  }
  return state;
}

std::string ReadFile(const std::string& path) {
  std::ifstream stream(path, std::ios::binary);
  if (!stream) throw MapFileError(fmt::format("cannot read {}: {}", path, std::strerror(errno)));
  std::ostringstream content;
  content << stream.rdbuf();
  if (stream.bad()) throw MapFileError(fmt::format("cannot read {}: input error", path));
  return content.str();
}

// "12.345678901" to nanoseconds without passing through a double.
std::optional<std::int64_t> ParseStamp(const std::string& text) {
  const std::size_t dot = text.find('.');
  const std::string whole = text.substr(0, dot);
  std::string fraction = dot == std::string::npos ? std::string() : text.substr(dot + 1);
  const bool negative = !whole.empty() && whole[0] == '-';
  const std::string digits = negative ? whole.substr(1) : whole;
  const auto numeric = [](const std::string& s) {
    return s.find_first_not_of("0123456789") == std::string::npos;
  };
  if (digits.empty() || digits.size() > 10 || !numeric(digits) || !numeric(fraction)) {
    return std::nullopt;
  }
  fraction.resize(9, '0');
  const std::int64_t ns = std::stoll(digits) * 1000000000 + std::stoll(fraction);
  return negative ? -ns : ns;
}

std::vector<StampedPose> ReadTrajectory(const std::string& path) {
  std::istringstream stream(ReadFile(path));
  std::vector<StampedPose> trajectory;
  std::string line;
  for (int number = 1; std::getline(stream, line); ++number) {
    if (line.empty() || line[0] == '#') continue;
    std::istringstream fields(line);
    std::string stamp;
    double v[7];
    fields >> stamp;
    for (double& value : v) fields >> value;
    const std::optional<std::int64_t> ns = ParseStamp(stamp);
    const Eigen::Quaterniond q(v[6], v[3], v[4], v[5]);
    if (!fields || !ns || !(std::abs(q.norm() - 1.0) < 1e-3)) {
      throw MapFileError(fmt::format(
          "{}: line {} is not 'stamp x y z qx qy qz qw' with a unit quaternion", path, number));
    }
    StampedPose pose;
    pose.stamp_ns = *ns;
    pose.T_map_lidar.linear() = q.normalized().toRotationMatrix();
    pose.T_map_lidar.translation() = Eigen::Vector3d(v[0], v[1], v[2]);
    trajectory.push_back(pose);
  }
  return trajectory;
}

}  // namespace

// ---------------------------------------------------------------------------------------------
// Contents
// ---------------------------------------------------------------------------------------------

std::string CylindersCsv(const TreeModel& model) {
  std::string out =
      "tree_id,branch_id,cylinder_id,parent_cylinder_id,branch_order,position_in_branch,"
      "start_x,start_y,start_z,end_x,end_y,end_z,axis_x,axis_y,axis_z,length_m,radius_m,"
      "radius_sigma_m,taper_m_per_m,axis_sigma_deg,position_sigma_m,num_scans,num_points,"
      "visible_arc_deg,mad_m,status\n";
  for (const MapCylinder& c : model.cylinders) {
    out += fmt::format("{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{}\n",
                       Optional(c.tree_id),
                       c.branch_id,
                       c.id,
                       Optional(c.parent_id),
                       c.branch_order,
                       c.position_in_branch,
                       Vec(c.start),
                       Vec(c.end),
                       Vec(c.Length() > 0.0 ? c.Axis() : Eigen::Vector3d::Zero()),
                       Num(c.Length()),
                       Num(c.radius_m),
                       Num(c.radius_sigma_m),
                       Num(c.taper_m_per_m),
                       Num(c.axis_sigma_rad * kDegPerRad, 4),
                       Num(c.position_sigma_m),
                       c.num_scans,
                       c.num_points,
                       Num(c.visible_arc_rad * kDegPerRad, 1),
                       Num(c.mean_abs_deviation_m),
                       ToString(c.status));
  }
  return out;
}

std::string BranchesCsv(const TreeModel& model) {
  std::map<int, std::pair<int, int>> counts;  // branch -> cylinders, of them measured
  for (const MapCylinder& c : model.cylinders) {
    ++counts[c.branch_id].first;
    if (c.status == FitStatus::kMeasured) ++counts[c.branch_id].second;
  }
  std::string out =
      "tree_id,branch_id,parent_branch_id,branch_order,num_cylinders,num_measured,"
      "base_x,base_y,base_z,tip_x,tip_y,tip_z,length_m,base_diameter_m,base_diameter_sigma_m,"
      "middle_diameter_m,tip_diameter_m,angle_deg,azimuth_deg,zenith_deg,height_m,"
      "middle_diameter_sigma_m,tip_diameter_sigma_m,base_status,middle_status,tip_status,"
      "inferred_length_m,visible_arc_deg,num_scans\n";
  for (const MapBranch& b : model.branches) {
    const auto [cylinders, measured] = counts[b.id];
    const BranchMeasures m = MeasureBranch(model, b);
    out += fmt::format("{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{}\n",
                       Optional(b.tree_id),
                       b.id,
                       Optional(b.parent_id),
                       b.order,
                       cylinders,
                       measured,
                       Vec(b.base),
                       Vec(b.tip),
                       Num(b.length_m),
                       Num(2.0 * b.base_radius_m),
                       Num(2.0 * b.base_radius_sigma_m),
                       Num(2.0 * b.middle_radius_m),
                       Num(2.0 * b.tip_radius_m),
                       b.parent_id >= 0 ? Num(b.angle_rad * kDegPerRad, 3) : std::string(),
                       Num(b.azimuth_rad * kDegPerRad, 3),
                       Num(b.zenith_rad * kDegPerRad, 3),
                       b.tree_id >= 0 ? Num(b.height_m) : std::string(),
                       Num(m.middle.sigma_m),
                       Num(m.tip.sigma_m),
                       ToString(m.base.status),
                       ToString(m.middle.status),
                       ToString(m.tip.status),
                       Num(m.inferred_length_m),
                       Num(m.visible_arc_rad * kDegPerRad, 1),
                       m.num_scans);
  }
  return out;
}

std::string TreesCsv(const TreeModel& model, const Georeference* georeference) {
  std::string out =
      "tree_id,x,y,z,dbh_m,dbh_sigma_m,dbh_height_m,height_m,num_branches,max_branch_order,"
      "stem_volume_m3,wood_volume_m3_above_min_radius,min_radius_m,volume_sigma_m3,lean_deg,"
      "arc_coverage_deg,num_scans,crown_volume_m3,crown_projected_area_m2,"
      "crown_base_height_m,crown_top_height_m,crown_alpha_m,crown_points,status";
  out += georeference != nullptr ? ",latitude_deg,longitude_deg,place_sigma_m\n" : "\n";
  const auto crown = [](const MapTree& t, double MapCrown::*figure) {
    return t.crown ? Num((*t.crown).*figure) : std::string();
  };
  for (const MapTree& t : model.trees) {
    const std::size_t branches = t.branch_ids.empty() ? 0 : t.branch_ids.size() - 1;
    std::string place;
    if (georeference != nullptr) {
      const GeoPosition at = georeference->Locate(t.base);
      place = fmt::format(",{},{},{}",
                          Num(at.latitude_deg, 8),
                          Num(at.longitude_deg, 8),
                          Num(georeference->HorizontalSigma(t.base), 2));
    }
    out += fmt::format("{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{}{}\n",
                       t.id,
                       Vec(t.base),
                       t.dbh_m ? Num(*t.dbh_m) : std::string(),
                       t.dbh_m ? Num(t.dbh_sigma_m) : std::string(),
                       Num(t.dbh_height_m, 4),
                       Num(t.height_m),
                       branches,
                       t.max_branch_order,
                       Num(t.stem_volume_m3),
                       Num(t.wood_volume_m3),
                       Num(t.min_radius_m),
                       Num(t.volume_sigma_m3),
                       Num(t.lean_rad * kDegPerRad, 3),
                       Num(t.arc_coverage_rad * kDegPerRad, 1),
                       t.num_scans,
                       crown(t, &MapCrown::volume_m3),
                       crown(t, &MapCrown::projected_area_m2),
                       crown(t, &MapCrown::base_height_m),
                       crown(t, &MapCrown::top_height_m),
                       crown(t, &MapCrown::alpha_m),
                       t.crown ? std::to_string(t.crown->num_points) : std::string(),
                       ToString(t.dbh_status),
                       place);
  }
  return out;
}

std::string TrajectoryTum(const std::vector<StampedPose>& trajectory) {
  std::string out;
  for (const StampedPose& pose : trajectory) {
    const Eigen::Vector3d t = pose.T_map_lidar.translation();
    Eigen::Quaterniond q(pose.T_map_lidar.rotation());
    if (q.w() < 0.0) q.coeffs() = -q.coeffs();
    out += fmt::format("{} {} {} {} {} {} {} {}\n",
                       Stamp(pose.stamp_ns),
                       Num(t.x(), 9),
                       Num(t.y(), 9),
                       Num(t.z(), 9),
                       Num(q.x(), 9),
                       Num(q.y(), 9),
                       Num(q.z(), 9),
                       Num(q.w(), 9));
  }
  return out;
}

std::string TimingJson(const StageTimer& timer) {
  const auto rounded = [](double ms) { return std::round(ms * 1000.0) / 1000.0; };
  Json j;
  j["stages"] = Json::object();
  for (const auto& [stage, summary] : timer.Summaries()) {
    j["stages"][stage] = {{"count", summary.count},
                          {"p50_ms", rounded(summary.p50_ms)},
                          {"p99_ms", rounded(summary.p99_ms)},
                          {"max_ms", rounded(summary.max_ms)},
                          {"total_ms", rounded(summary.total_ms)}};
  }
  j["data_duration_s"] = rounded(timer.data_duration_s());
  j["wall_duration_s"] = rounded(timer.wall_duration_s());
  j["realtime_factor"] = timer.wall_duration_s() > 0.0
                             ? Json(rounded(timer.data_duration_s() / timer.wall_duration_s()))
                             : Json(nullptr);
  return j.dump(2) + "\n";
}

// CRC-32 (ISO 3309) over a map file with its checksum left blank. A flipped bit may leave a number that
// looks like any other: nothing else would tell.
constexpr std::string_view kNoChecksum = "--------";
constexpr std::string_view kChecksumField = "\"checksum\": \"";

// Where the checksum stands in a map file, or npos.
std::size_t ChecksumPlace(const std::string& text) {
  const std::size_t field = text.find(kChecksumField);
  const std::size_t at = field + kChecksumField.size();
  if (field == std::string::npos || at + kNoChecksum.size() > text.size()) return std::string::npos;
  return at;
}

std::string WithChecksum(std::string text) {
  const std::size_t at = ChecksumPlace(text);
  if (at == std::string::npos) return text;
  text.replace(at, kNoChecksum.size(), kNoChecksum);
  boost::crc_32_type crc;
  crc.process_bytes(text.data(), text.size());
  text.replace(at, kNoChecksum.size(), fmt::format("{:08x}", crc.checksum()));
  return text;
}

std::string TreeMapJson(const MapFiles& files) {
  Json j;
  j["format"] = kFormatName;
  j["version"] = kFormatVersion;
  j["checksum"] = std::string(kNoChecksum);
  j["frame"] = files.frame;
  j["stamp_ns"] = files.model.stamp_ns;
  j["next_landmark_id"] = files.next_landmark_id;
  j["num_points"] = files.points.size();
  j["config"] = files.config;
  if (files.georeference) j["georeference"] = GeoreferenceJson(*files.georeference);
  j["trees"] = Json::array();
  for (const MapTree& tree : files.model.trees) j["trees"].push_back(TreeJson(tree));
  j["branches"] = Json::array();
  for (const MapBranch& branch : files.model.branches) j["branches"].push_back(BranchJson(branch));
  j["cylinders"] = Json::array();
  for (const MapCylinder& c : files.model.cylinders) j["cylinders"].push_back(CylinderJson(c));
  j["landmarks"] = Json::array();
  for (const Landmark& landmark : files.landmarks) j["landmarks"].push_back(LandmarkJson(landmark));
  j["topology"] = TopologyJson(files.topology);
  j["upright"] = files.snapshot.upright;
  if (files.snapshot.ground) j["ground"] = VecJson(*files.snapshot.ground, "the ground", 0);
  j["ground_patches"] = Json::array();
  for (const GroundPatch& patch : files.ground) j["ground_patches"].push_back(GroundPatchJson(patch));
  j["next_landmark_state_id"] = files.snapshot.next_landmark_id;
  j["landmark_states"] = Json::array();
  for (const LandmarkState& state : files.snapshot.landmarks) {
    j["landmark_states"].push_back(LandmarkStateJson(state));
  }
  return WithChecksum(Pretty(j));
}

// ---------------------------------------------------------------------------------------------
// Directory
// ---------------------------------------------------------------------------------------------

void WriteFileAtomically(const std::string& path, const std::string& content) {
  const std::string temporary = TemporaryName(path);
  WriteSynced(temporary, content);
  if (::rename(temporary.c_str(), path.c_str()) != 0) {
    const int error = errno;
    ::unlink(temporary.c_str());
    FailWrite(path, error);
  }
}

void SaveMap(const std::string& directory, const MapFiles& files, const StageTimer* timer) {
  std::vector<std::pair<std::string, std::string>> contents;
  contents.emplace_back("cylinders.csv", CylindersCsv(files.model));
  contents.emplace_back("branches.csv", BranchesCsv(files.model));
  contents.emplace_back(
      "trees.csv",
      TreesCsv(files.model, files.georeference ? &*files.georeference : nullptr));
  contents.emplace_back("trajectory.tum", TrajectoryTum(files.trajectory));
  contents.emplace_back("tree.ply", MeshToPly(ModelMesh(files.model, MeshColor::kByBranch)));
  if (!files.points.empty()) contents.emplace_back(kPointsFile, PointsToPly(files.points));
  if (timer != nullptr) contents.emplace_back("timing.json", TimingJson(*timer));
  contents.emplace_back("tree_map.json", TreeMapJson(files));

  MakeDirectory(directory);
  const std::filesystem::path root(directory);
  std::vector<std::string> temporaries;
  try {
    for (const auto& [name, content] : contents) {
      temporaries.push_back(TemporaryName((root / name).string()));
      WriteSynced(temporaries.back(), content);
    }
    for (std::size_t i = 0; i < contents.size(); ++i) {
      const std::string path = (root / contents[i].first).string();
      if (::rename(temporaries[i].c_str(), path.c_str()) != 0) FailWrite(path, errno);
    }
  } catch (const MapFileError&) {
    for (const std::string& temporary : temporaries) ::unlink(temporary.c_str());
    throw;
  }
  // Those of an older map do not belong to this one; LoadMap would not read them either.
  if (files.points.empty()) ::unlink((root / kPointsFile).c_str());
  SyncDirectory(directory);
}

MapFiles LoadMap(const std::string& directory) {
  const std::filesystem::path root(directory);
  const std::string file = (root / "tree_map.json").string();
  Json json;
  const std::string text = ReadFile(file);
  try {
    json = Json::parse(text);
  } catch (const Json::exception& error) {
    throw MapFileError(fmt::format("{}: the file is not JSON: {}", file, error.what()));
  }
  const Reader j(json, file, "");
  if (j["format"].String() != kFormatName)
    j["format"].Fail(fmt::format("is not '{}'", kFormatName));
  const int version = j["version"].Int();
  if (version != kFormatVersion) {
    j["version"].Fail(fmt::format("is {}, this program reads {}", version, kFormatVersion));
  }

  MapFiles files;
  files.frame = j["frame"].String();
  files.model.stamp_ns = j["stamp_ns"].Int64();
  files.next_landmark_id = j["next_landmark_id"].NonNegative();
  const Reader config = j["config"];
  if (!config.json().is_object()) config.Fail("is not an object");
  for (const auto& item : config.json().items()) {
    files.config[item.key()] = config[item.key().c_str()].String();
  }
  const auto read_list = [&](const char* key, auto read, auto* target) {
    const Reader list = j[key];
    const std::size_t size = list.ArraySize();
    std::set<int> ids;
    for (std::size_t i = 0; i < size; ++i) {
      target->push_back(read(list.At(i)));
      if (!ids.insert(target->back().id).second) list.At(i)["id"].Fail("is used twice");
    }
    return ids;
  };
  // Absent from maps without fixes, and from those of before.
  if (json.contains("georeference")) files.georeference = ReadGeoreference(j["georeference"]);
  read_list("trees", ReadTree, &files.model.trees);
  read_list("branches", ReadBranch, &files.model.branches);
  read_list("cylinders", ReadCylinder, &files.model.cylinders);
  const std::set<int> landmark_ids = read_list("landmarks", ReadLandmark, &files.landmarks);
  if (!landmark_ids.empty() && *landmark_ids.rbegin() >= files.next_landmark_id) {
    j["next_landmark_id"].Fail("is not above every landmark's id");
  }
  files.topology = ReadTopology(j["topology"]);
  files.snapshot.upright = j["upright"].Bool();
  if (j.Has("ground")) files.snapshot.ground = j["ground"].Vector();
  // Absent from maps of before.
  if (j.Has("ground_patches")) {
    const Reader patches = j["ground_patches"];
    for (std::size_t i = 0; i < patches.ArraySize(); ++i) {
      const Reader patch = patches.At(i);
      patch["foot"].RequireSize(2);
      patch["slope"].RequireSize(2);
      GroundPatch read;
      read.count = patch["count"].Int();
      if (read.count < 1) patch["count"].Fail("is not positive");
      read.foot = {patch["foot"].At(0).Double(), patch["foot"].At(1).Double()};
      read.z_m = patch["z_m"].Double();
      read.slope = {patch["slope"].At(0).Double(), patch["slope"].At(1).Double()};
      // Within the range of the cells' indices.
      if (read.foot.cwiseAbs().maxCoeff() > 1e9) patch["foot"].Fail("is out of range");
      files.ground.push_back(read);
    }
  }
  files.snapshot.next_landmark_id = j["next_landmark_state_id"].NonNegative();
  read_list("landmark_states", ReadLandmarkState, &files.snapshot.landmarks);
  // Last, so that a field that is wrong is named; absent from maps of before.
  if (json.contains("checksum") && WithChecksum(text) != text) {
    j["checksum"].Fail(
        "does not fit what the file says: it was damaged, take a copy of the map (or changed by hand: then "
        "take out the line \"checksum\")");
  }

  const std::filesystem::path trajectory = root / "trajectory.tum";
  if (std::filesystem::exists(trajectory)) files.trajectory = ReadTrajectory(trajectory.string());
  const std::int64_t num_points = j.Has("num_points") ? j["num_points"].Int64() : 0;
  if (num_points > 0) {
    const std::string points = (root / kPointsFile).string();
    files.points = PointsFromPly(ReadFile(points), points);
    if (static_cast<std::int64_t>(files.points.size()) != num_points) {
      throw MapFileError(fmt::format(
          "{}: holds {} points, {} says {}", points, files.points.size(), file, num_points));
    }
  }
  return files;
}

// ---------------------------------------------------------------------------------------------
// Scans
// ---------------------------------------------------------------------------------------------

namespace {

constexpr const char* kScanFiles[] = {"scan_cylinders.csv", "scan_labels.bin", "scan_segments.bin"};

template <class T>
void WriteLittleEndian(std::ofstream& stream, T value) {
  char bytes[sizeof(T)];
  auto bits = static_cast<std::make_unsigned_t<T>>(value);
  for (char& byte : bytes) {
    byte = static_cast<char>(bits & 0xff);
    if constexpr (sizeof(T) > 1) bits = static_cast<std::make_unsigned_t<T>>(bits >> 8);
  }
  stream.write(bytes, sizeof(T));
}

}  // namespace

void ScanWriter::Check(std::ofstream& stream, const std::string& name) {
  if (!stream) FailWrite((std::filesystem::path(directory_) / name).string(), errno);
}

ScanWriter::ScanWriter(const std::string& directory) : directory_(directory) {
  MakeDirectory(directory);
  std::ofstream* streams[] = {&cylinders_, &labels_, &segments_};
  for (int i = 0; i < 3; ++i) {
    const std::string path = (std::filesystem::path(directory) / kScanFiles[i]).string();
    streams[i]->open(TemporaryName(path), std::ios::binary | std::ios::trunc);
    Check(*streams[i], kScanFiles[i]);
  }
  cylinders_ << "stamp,segment,num_points,num_rings,distance_m,visible_arc_deg,"
                "axis_x,axis_y,axis_z,point_x,point_y,point_z,radius_m,"
                "sigma_axis_1_deg,sigma_axis_2_deg,sigma_position_1_m,sigma_position_2_m,"
                "sigma_radius_m,start_x,start_y,start_z,end_x,end_y,end_z,end_sigma_m,"
                "taper_m_per_m,mad_m,status,reason\n";
  labels_ << "DSLABEL1";
  segments_ << "DSSEGMT1";
}

ScanWriter::~ScanWriter() {
  if (finished_) return;
  for (const char* name : kScanFiles) {
    ::unlink(TemporaryName((std::filesystem::path(directory_) / name).string()).c_str());
  }
}

void ScanWriter::Add(const LabelledScan& scan,
                     const std::vector<Segment>& segments,
                     const std::vector<FittedCylinder>& cylinders) {
  const std::int64_t stamp = scan.image.stamp_ns;
  for (const FittedCylinder& fit : cylinders) {
    const bool measured = fit.status == FitStatus::kMeasured;
    const Eigen::Vector3d start = fit.cylinder.point + fit.start_s_m * fit.cylinder.axis;
    const Eigen::Vector3d end = fit.cylinder.point + fit.end_s_m * fit.cylinder.axis;
    const auto sigma = [&](int i) { return std::sqrt(std::max(0.0, fit.covariance(i, i))); };
    cylinders_ << fmt::format("{},{},{},{},{},{},",
                              Stamp(stamp),
                              fit.segment_id,
                              fit.num_points,
                              fit.num_rings,
                              Num(fit.distance_m),
                              Num(fit.visible_arc_rad * kDegPerRad, 2));
    if (measured) {
      cylinders_ << fmt::format("{},{},{},{},{},{},{},{},{},{},{},{},{},",
                                Vec(fit.cylinder.axis),
                                Vec(fit.cylinder.point),
                                Num(fit.cylinder.radius()),
                                Num(sigma(0) * kDegPerRad, 4),
                                Num(sigma(1) * kDegPerRad, 4),
                                Num(sigma(2)),
                                Num(sigma(3)),
                                Num(fit.radius_sigma_m()),
                                Vec(start),
                                Vec(end),
                                Num(fit.end_sigma_m),
                                Num(fit.taper_m_per_m),
                                Num(fit.mean_abs_deviation_m));
    } else {
      cylinders_ << std::string(21, ',');
    }
    cylinders_ << ToString(fit.status) << ',' << (measured ? "" : ToString(fit.reason)) << '\n';
  }
  Check(cylinders_, kScanFiles[0]);

  const std::vector<Label> labels = PointLabels(scan);
  WriteLittleEndian(labels_, stamp);
  WriteLittleEndian(labels_, static_cast<std::uint32_t>(labels.size()));
  for (const Label label : labels) WriteLittleEndian(labels_, static_cast<std::uint8_t>(label));
  Check(labels_, kScanFiles[1]);

  std::vector<std::int32_t> segment_of_pixel(scan.image.size(), -1);
  for (const Segment& segment : segments) {
    for (const std::int32_t pixel : segment.pixels) {
      segment_of_pixel[static_cast<std::size_t>(pixel)] = segment.id;
    }
  }
  WriteLittleEndian(segments_, stamp);
  WriteLittleEndian(segments_, static_cast<std::uint32_t>(scan.image.pixel_of_point.size()));
  for (const std::int32_t pixel : scan.image.pixel_of_point) {
    const std::int32_t id =
        pixel < 0 ? std::int32_t{-1} : segment_of_pixel[static_cast<std::size_t>(pixel)];
    WriteLittleEndian(segments_, id);
  }
  for (const std::int32_t pixel : scan.image.pixel_of_point) {
    const float range = pixel < 0 ? std::numeric_limits<float>::quiet_NaN()
                                  : scan.image.range[static_cast<std::size_t>(pixel)];
    std::uint32_t bits = 0;
    std::memcpy(&bits, &range, sizeof(bits));
    WriteLittleEndian(segments_, bits);
  }
  Check(segments_, kScanFiles[2]);
}

void ScanWriter::Finish() {
  std::ofstream* streams[] = {&cylinders_, &labels_, &segments_};
  for (int i = 0; i < 3; ++i) {
    streams[i]->close();
    Check(*streams[i], kScanFiles[i]);
  }
  for (const char* name : kScanFiles) {
    const std::string path = (std::filesystem::path(directory_) / name).string();
    if (::rename(TemporaryName(path).c_str(), path.c_str()) != 0) FailWrite(path, errno);
  }
  finished_ = true;
}

}  // namespace dendro
