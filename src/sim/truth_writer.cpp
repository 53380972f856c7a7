#include "dendro_slam/sim/truth_writer.h"

#include <cstring>
#include <filesystem>
#include <map>

#include <fmt/format.h>

namespace dendro {
namespace {

static_assert(sizeof(std::int64_t) == 8 && sizeof(std::int16_t) == 2, "fixed layout");

template <class T>
void Write(std::ofstream* file, const T& value) {
  file->write(reinterpret_cast<const char*>(&value), sizeof(value));
}

template <class T>
void WriteAll(std::ofstream* file, const std::vector<T>& values) {
  file->write(reinterpret_cast<const char*>(values.data()),
              static_cast<std::streamsize>(values.size() * sizeof(T)));
}

std::string StampText(std::int64_t stamp_ns) {
  return fmt::format("{}.{:09}", stamp_ns / 1000000000, stamp_ns % 1000000000);
}

}  // namespace

std::vector<BranchHits> CountBranchHits(const SimulatedScan& scan) {
  std::map<std::pair<std::int16_t, std::int16_t>, std::uint32_t> hits;
  for (const PointTruth& truth : scan.truth) {
    if (truth.branch_id >= 0) ++hits[{truth.tree_id, truth.branch_id}];
  }
  std::vector<BranchHits> out;
  for (const auto& [key, count] : hits) out.push_back({key.first, key.second, count});
  return out;
}

TruthWriter::TruthWriter(const std::string& folder, const Scene& scene, bool with_labels)
    : folder_(folder), with_labels_(with_labels) {
  std::error_code error;
  std::filesystem::create_directories(folder, error);
  if (error) throw SceneFileError(fmt::format("{}: cannot be created: {}", folder, error.message()));
  SaveScene(scene, folder + "/scene.yaml");
  const auto open = [&](std::ofstream* file, const char* name, std::ios::openmode mode) {
    file->open(folder + "/" + name, mode);
    if (!*file) {
      throw SceneFileError(fmt::format("{}/{}: cannot be written: {}", folder, name, std::strerror(errno)));
    }
  };
  open(&trajectory_, "trajectory.tum", std::ios::out);
  open(&hits_, "hits.csv", std::ios::out);
  hits_ << "stamp,tree,branch,hits\n";
  if (!with_labels_) return;
  open(&labels_, "labels.bin", std::ios::out | std::ios::binary);
  labels_.write("DSTRUTH1", 8);
}

TruthWriter::~TruthWriter() = default;

void TruthWriter::AddScan(const SimulatedScan& scan, bool with_hits) {
  const std::string stamp = StampText(scan.scan.stamp_ns);
  const Eigen::Vector3d t = scan.T_map_lidar.translation();
  Eigen::Quaterniond q(scan.T_map_lidar.linear());
  if (q.w() < 0.0) q.coeffs() = -q.coeffs();
  trajectory_ << fmt::format("{} {:.9f} {:.9f} {:.9f} {:.12f} {:.12f} {:.12f} {:.12f}\n", stamp, t.x(), t.y(),
                             t.z(), q.x(), q.y(), q.z(), q.w());
  if (with_hits) {
    for (const BranchHits& row : CountBranchHits(scan)) {
      hits_ << fmt::format("{},{},{},{}\n", stamp, row.tree_id, row.branch_id, row.hits);
    }
  }
  if (!with_labels_) return;
  std::vector<std::uint8_t> label;
  std::vector<std::int16_t> branch, tree;
  for (const PointTruth& truth : scan.truth) {
    label.push_back(static_cast<std::uint8_t>(SurfaceLabel(truth.kind)));
    branch.push_back(truth.branch_id);
    tree.push_back(truth.tree_id);
  }
  Write(&labels_, scan.scan.stamp_ns);
  Write(&labels_, static_cast<std::uint32_t>(label.size()));
  WriteAll(&labels_, label);
  WriteAll(&labels_, branch);
  WriteAll(&labels_, tree);
}

void TruthWriter::Finish() {
  for (auto [file, name] : {std::pair(&trajectory_, "trajectory.tum"), std::pair(&hits_, "hits.csv"),
                            std::pair(&labels_, "labels.bin")}) {
    if (file == &labels_ && !with_labels_) continue;
    file->close();
    if (!*file) throw SceneFileError(fmt::format("{}/{}: could not be written", folder_, name));
  }
}

std::vector<ScanLabels> ReadScanLabels(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw SceneFileError(fmt::format("{}: cannot be read: {}", path, std::strerror(errno)));
  char magic[8] = {};
  file.read(magic, 8);
  const bool truth = std::memcmp(magic, "DSTRUTH1", 8) == 0;
  if (!file || (!truth && std::memcmp(magic, "DSLABEL1", 8) != 0)) {
    throw SceneFileError(fmt::format("{}: expected a file that starts with DSTRUTH1 or DSLABEL1", path));
  }
  std::vector<ScanLabels> scans;
  while (true) {
    ScanLabels scan;
    std::uint32_t count = 0;
    file.read(reinterpret_cast<char*>(&scan.stamp_ns), sizeof(scan.stamp_ns));
    if (file.gcount() == 0) break;
    file.read(reinterpret_cast<char*>(&count), sizeof(count));
    const auto read = [&](auto* values) {
      values->resize(count);
      file.read(reinterpret_cast<char*>(values->data()),
                static_cast<std::streamsize>(count * sizeof((*values)[0])));
    };
    if (!file || count > 100000000U) {
      throw SceneFileError(fmt::format("{}: scan {} is damaged", path, scans.size()));
    }
    read(&scan.label);
    if (truth) {
      read(&scan.branch_id);
      read(&scan.tree_id);
    }
    if (!file) throw SceneFileError(fmt::format("{}: the file ends inside scan {}", path, scans.size()));
    scans.push_back(std::move(scan));
  }
  return scans;
}

}  // namespace dendro
