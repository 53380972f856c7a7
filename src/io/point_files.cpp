#include "dendro_slam/io/point_files.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <stdexcept>

#include <fmt/format.h>

#include "dendro_slam/io/map_directory.h"

namespace dendro {

namespace {

constexpr std::size_t kPlyPointSize = 3 * 8 + 1 + 2 * 4;

// LAS 1.4: sizes that the standard fixes.
constexpr std::uint16_t kLasHeaderSize = 375;
constexpr std::uint16_t kLasVlrHeaderSize = 54;
constexpr std::uint16_t kLasExtraFieldSize = 192;
constexpr std::uint16_t kLasPointSize = 30 + 2 * 4;
constexpr double kLasStepM = 1e-4;
constexpr std::uint8_t kLasWood = 64, kLasHighVegetation = 5;

template <class T>
void Append(std::string* out, T value) {
  char bytes[sizeof(T)];
  std::memcpy(bytes, &value, sizeof(T));
  out->append(bytes, sizeof(T));
}

void AppendPadded(std::string* out, std::string text, std::size_t size) {
  text.resize(size, '\0');
  *out += text;
}

template <class T>
T Take(const char** at) {
  T value;
  std::memcpy(&value, *at, sizeof(T));
  *at += sizeof(T);
  return value;
}

std::string PlyHeader(std::size_t count) {
  return fmt::format(
      "ply\nformat binary_little_endian 1.0\n"
      "comment dendro_slam points; label: 2 wood, 3 leaf; ids: -1 none\n"
      "element vertex {}\nproperty double x\nproperty double y\nproperty double z\n"
      "property uchar label\nproperty int tree_id\nproperty int branch_id\nend_header\n",
      count);
}

// "Extra Bytes" entry of one int32 (type 6).
void AppendExtraField(std::string* out, const char* name, const char* description) {
  Append(out, std::uint16_t{0});  // reserved
  Append(out, std::uint8_t{6});   // data type: long
  Append(out, std::uint8_t{0});   // options: no range, no scale
  AppendPadded(out, name, 32);
  AppendPadded(out, "", 4 + 5 * 24);  // unused; no-data, minimum, maximum, scale, offset
  AppendPadded(out, description, 32);
}

}  // namespace

std::string PointsToPly(const std::vector<CloudPoint>& points) {
  std::string out = PlyHeader(points.size());
  out.reserve(out.size() + points.size() * kPlyPointSize);
  for (const CloudPoint& point : points) {
    for (int k = 0; k < 3; ++k) Append(&out, point.position[k]);
    Append(&out, static_cast<std::uint8_t>(point.label));
    Append(&out, static_cast<std::int32_t>(point.tree_id));
    Append(&out, static_cast<std::int32_t>(point.branch_id));
  }
  return out;
}

std::vector<CloudPoint> PointsFromPly(const std::string& content, const std::string& name) {
  // The header holds nothing but the count; the body's size must agree with it.
  const std::size_t overhead = PlyHeader(0).size() - 1;
  const std::size_t key = content.find("element vertex ");
  std::size_t count = 0;
  if (key != std::string::npos && key < overhead) {
    for (std::size_t i = key + 15; i < content.size() && content[i] >= '0' && content[i] <= '9' &&
                                   count <= content.size();
         ++i) {
      count = 10 * count + static_cast<std::size_t>(content[i] - '0');
    }
  }
  const std::string header = PlyHeader(count);
  if (content.compare(0, header.size(), header) != 0) {
    throw MapFileError(fmt::format("{}: is not a file of points of this program", name));
  }
  if (content.size() != header.size() + count * kPlyPointSize) {
    throw MapFileError(fmt::format(
        "{}: must hold {} points, its size says otherwise: it was cut off or changed", name, count));
  }
  std::vector<CloudPoint> points(count);
  const char* at = content.data() + header.size();
  for (CloudPoint& point : points) {
    for (int k = 0; k < 3; ++k) point.position[k] = Take<double>(&at);
    const auto label = Take<std::uint8_t>(&at);
    point.tree_id = Take<std::int32_t>(&at);
    point.branch_id = Take<std::int32_t>(&at);
    point.label = static_cast<Label>(label);
    if ((point.label != Label::kWood && point.label != Label::kLeaf) ||
        !point.position.allFinite()) {
      throw MapFileError(fmt::format(
          "{}: point {} is neither wood nor leaf, or not finite", name, &point - points.data()));
    }
  }
  return points;
}

std::string PointsToLas(const std::vector<CloudPoint>& points, const Eigen::Vector3d& offset) {
  constexpr double kMaxOffsetM = 2e5;
  Eigen::Vector3d low = Eigen::Vector3d::Constant(points.empty() ? 0.0 : 1e300), high = -low;
  for (const CloudPoint& point : points) {
    if (!((point.position).cwiseAbs().maxCoeff() <= kMaxOffsetM)) {
      throw std::invalid_argument("a point is not finite or too far from the offset for LAS");
    }
    low = low.cwiseMin(point.position);
    high = high.cwiseMax(point.position);
  }
  const std::uint16_t vlr_size = 2 * kLasExtraFieldSize;
  const std::uint32_t data_offset = kLasHeaderSize + kLasVlrHeaderSize + vlr_size;

  std::string out = "LASF";
  Append(&out, std::uint16_t{0});       // file source
  Append(&out, std::uint16_t{1 << 4});  // global encoding: WKT, as point format 6 demands
  AppendPadded(&out, "", 16);           // project GUID
  Append(&out, std::uint8_t{1});
  Append(&out, std::uint8_t{4});
  AppendPadded(&out, "dendro_slam", 32);
  AppendPadded(&out, "dendro_slam export_map", 32);
  Append(&out, std::uint16_t{0});  // day and year of creation: same map, same bytes
  Append(&out, std::uint16_t{0});
  Append(&out, kLasHeaderSize);
  Append(&out, data_offset);
  Append(&out, std::uint32_t{1});  // variable length records
  Append(&out, std::uint8_t{6});   // point format
  Append(&out, kLasPointSize);
  AppendPadded(&out, "", 4 + 5 * 4);  // counts of LAS 1.2: 0 for formats from 6 on
  for (int k = 0; k < 3; ++k) Append(&out, kLasStepM);
  for (int k = 0; k < 3; ++k) Append(&out, offset[k]);
  for (int k = 0; k < 3; ++k) {
    Append(&out, offset[k] + high[k]);
    Append(&out, offset[k] + low[k]);
  }
  AppendPadded(&out, "", 8 + 8 + 4);  // no waveforms, no extended records
  Append(&out, static_cast<std::uint64_t>(points.size()));
  Append(&out, static_cast<std::uint64_t>(points.size()));  // all are first returns
  AppendPadded(&out, "", 14 * 8);

  Append(&out, std::uint16_t{0});
  AppendPadded(&out, "LASF_Spec", 16);
  Append(&out, std::uint16_t{4});  // Extra Bytes
  Append(&out, vlr_size);
  AppendPadded(&out, "Extra Bytes", 32);
  AppendExtraField(&out, "tree_id", "tree of the map, -1 none");
  AppendExtraField(&out, "branch_id", "branch of the map, -1 none");

  out.reserve(out.size() + points.size() * kLasPointSize);
  for (const CloudPoint& point : points) {
    for (int k = 0; k < 3; ++k) {
      Append(&out, static_cast<std::int32_t>(std::lround(point.position[k] / kLasStepM)));
    }
    Append(&out, std::uint16_t{0});    // intensity
    Append(&out, std::uint8_t{0x11});  // return 1 of 1
    Append(&out, std::uint8_t{0});     // no flags
    Append(&out, point.label == Label::kWood ? kLasWood : kLasHighVegetation);
    AppendPadded(&out, "", 1 + 2 + 2 + 8);  // user data, scan angle, point source, time
    Append(&out, static_cast<std::int32_t>(point.tree_id));
    Append(&out, static_cast<std::int32_t>(point.branch_id));
  }
  return out;
}

}  // namespace dendro
