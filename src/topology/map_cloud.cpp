#include "dendro_slam/topology/map_cloud.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>
#include <unordered_map>

namespace dendro {

namespace {

using Eigen::Vector3d;

constexpr int kKeyBits = 21;
constexpr std::int64_t kKeyOffset = std::int64_t{1} << (kKeyBits - 1);
constexpr std::uint64_t kKeyMask = (std::uint64_t{1} << kKeyBits) - 1;

std::uint64_t PackKey(const std::int64_t cell[3]) {
  std::uint64_t key = 0;
  for (int k = 0; k < 3; ++k) {
    // Cells beyond a million edges share the outermost one: that far off nothing is mapped.
    const std::int64_t shifted = std::clamp<std::int64_t>(
        cell[k] + kKeyOffset, 0, static_cast<std::int64_t>(kKeyMask));
    key = (key << kKeyBits) | static_cast<std::uint64_t>(shifted);
  }
  return key;
}

std::uint64_t KeyOf(const Vector3d& p, double voxel_m) {
  std::int64_t cell[3];
  for (int k = 0; k < 3; ++k) cell[k] = static_cast<std::int64_t>(std::floor(p[k] / voxel_m));
  return PackKey(cell);
}

// The voxel of twice the edge that holds this one.
std::uint64_t CoarserKey(std::uint64_t key) {
  std::int64_t cell[3];
  for (int k = 2; k >= 0; --k) {
    const std::int64_t index = static_cast<std::int64_t>(key & kKeyMask) - kKeyOffset;
    cell[k] = index >> 1;  // floor: arithmetic shift
    key >>= kKeyBits;
  }
  return PackKey(cell);
}

// Finaliser of MurmurHash3 (Appleby, public domain): neighbouring voxels land far apart.
std::uint64_t Mix(std::uint64_t h) {
  h ^= h >> 33;
  h *= 0xff51afd7ed558ccdULL;
  h ^= h >> 33;
  h *= 0xc4ceb9fe1a85ec53ULL;
  h ^= h >> 33;
  return h;
}

void Require(bool good, const char* field, const char* rule) {
  if (!good) {
    throw std::invalid_argument(std::string("map_cloud/") + field + ": must be " + rule);
  }
}

// Cylinders by the cubes that they, grown by a reach, run through.
class CylinderGrid {
 public:
  CylinderGrid(const std::vector<MapCylinder>& cylinders, double reach_m, double cell_m)
      : cylinders_(cylinders), cell_m_(cell_m) {
    for (std::size_t i = 0; i < cylinders.size(); ++i) {
      const MapCylinder& c = cylinders[i];
      const double grow = reach_m + EndRadius(c, 0.0) + std::abs(EndRadius(c, 1.0));
      const Vector3d low = c.start.cwiseMin(c.end).array() - grow;
      const Vector3d high = c.start.cwiseMax(c.end).array() + grow;
      std::int64_t from[3], to[3], cell[3];
      for (int k = 0; k < 3; ++k) {
        from[k] = static_cast<std::int64_t>(std::floor(low[k] / cell_m));
        to[k] = static_cast<std::int64_t>(std::floor(high[k] / cell_m));
      }
      for (cell[0] = from[0]; cell[0] <= to[0]; ++cell[0]) {
        for (cell[1] = from[1]; cell[1] <= to[1]; ++cell[1]) {
          for (cell[2] = from[2]; cell[2] <= to[2]; ++cell[2]) {
            cells_[PackKey(cell)].push_back(static_cast<std::int32_t>(i));
          }
        }
      }
    }
  }

  // The cylinder whose surface is nearest to p and not farther than `reach_m`, or null. Ties go to
  // the first.
  const MapCylinder* Nearest(const Vector3d& p, double reach_m) const {
    const auto it = cells_.find(KeyOf(p, cell_m_));
    if (it == cells_.end()) return nullptr;
    const MapCylinder* best = nullptr;
    double least = reach_m;
    for (const std::int32_t i : it->second) {
      const MapCylinder& c = cylinders_[static_cast<std::size_t>(i)];
      const double distance = DistanceToSurface(c, p);
      if (distance > least || (best != nullptr && distance >= least)) continue;
      least = distance;
      best = &c;
    }
    return best;
  }

 private:
  static double EndRadius(const MapCylinder& c, double f) {
    return std::max(0.0, c.radius_m + (f - 0.5) * c.taper_m_per_m * c.Length());
  }

  // Distance of a point to a frustum's mantle, its ends rounded off.
  static double DistanceToSurface(const MapCylinder& c, const Vector3d& p) {
    const Vector3d along = c.end - c.start;
    const double length2 = along.squaredNorm();
    const double f =
        length2 > 0.0 ? std::clamp((p - c.start).dot(along) / length2, 0.0, 1.0) : 0.0;
    return std::abs((p - c.start - f * along).norm() - EndRadius(c, f));
  }

  const std::vector<MapCylinder>& cylinders_;
  double cell_m_;
  std::unordered_map<std::uint64_t, std::vector<std::int32_t>> cells_;
};

}  // namespace

void MapCloudConfig::Validate() const {
  Require(wood_voxel_m > 0.0, "wood_voxel_m", "positive");
  Require(leaf_voxel_m > 0.0, "leaf_voxel_m", "positive");
  Require(max_range_m > 0.0, "max_range_m", "positive");
  Require(max_points >= 1000, "max_points", "at least 1000");
  Require(wood_reach_m > 0.0, "wood_reach_m", "positive");
  Require(leaf_reach_m > 0.0, "leaf_reach_m", "positive");
  Require(crown_alpha_m > 0.0, "crown_alpha_m", "positive");
}

MapCloud::MapCloud(const MapCloudConfig& config) : config_(config) {
  config.Validate();
  Reset();
}

void MapCloud::Reset() {
  stamps_ns_.clear();
  for (Grid* grid : {&wood_, &leaf_}) {
    grid->voxel_m = grid == &wood_ ? config_.wood_voxel_m : config_.leaf_voxel_m;
    grid->entries.clear();
    grid->slots.assign(1024, -1);
  }
}

void MapCloud::Add(const LabelledScan& scan, const Eigen::Isometry3d& T_map_lidar) {
  const int index = static_cast<int>(stamps_ns_.size());
  stamps_ns_.push_back(scan.image.stamp_ns);
  for (std::size_t i = 0; i < scan.image.size(); ++i) {
    const Label label = scan.label[i];
    if (label != Label::kWood && label != Label::kLeaf) continue;
    const Eigen::Vector3f& p = scan.image.point[i];
    if (!(scan.image.range[i] <= config_.max_range_m) || !p.allFinite()) continue;
    Insert(T_map_lidar * p.cast<double>(), p, index, label == Label::kWood ? &wood_ : &leaf_);
  }
}

void MapCloud::Insert(const Vector3d& p_map, const Eigen::Vector3f& point, int scan, Grid* grid) {
  const std::uint64_t key = KeyOf(p_map, grid->voxel_m);
  std::size_t mask = grid->slots.size() - 1;
  std::size_t slot = Mix(key) & mask;
  for (; grid->slots[slot] >= 0; slot = (slot + 1) & mask) {
    if (grid->entries[static_cast<std::size_t>(grid->slots[slot])].key == key) return;
  }
  if (grid->entries.size() >= static_cast<std::size_t>(config_.max_points)) {
    Coarsen(grid);
    Insert(p_map, point, scan, grid);
    return;
  }
  grid->slots[slot] = static_cast<std::int32_t>(grid->entries.size());
  grid->entries.push_back({key, point, scan});
  if (2 * grid->entries.size() < grid->slots.size()) return;
  grid->slots.assign(2 * grid->slots.size(), -1);
  mask = grid->slots.size() - 1;
  for (std::size_t i = 0; i < grid->entries.size(); ++i) {
    slot = Mix(grid->entries[i].key) & mask;
    while (grid->slots[slot] >= 0) slot = (slot + 1) & mask;
    grid->slots[slot] = static_cast<std::int32_t>(i);
  }
}

void MapCloud::Coarsen(Grid* grid) const {
  grid->voxel_m *= 2.0;
  std::fill(grid->slots.begin(), grid->slots.end(), -1);
  const std::size_t mask = grid->slots.size() - 1;
  std::size_t kept = 0;
  for (std::size_t i = 0; i < grid->entries.size(); ++i) {
    Entry entry = grid->entries[i];
    entry.key = CoarserKey(entry.key);
    std::size_t slot = Mix(entry.key) & mask;
    bool known = false;
    for (; grid->slots[slot] >= 0 && !known; slot = (slot + 1) & mask) {
      known = grid->entries[static_cast<std::size_t>(grid->slots[slot])].key == entry.key;
    }
    if (known) continue;
    grid->slots[slot] = static_cast<std::int32_t>(kept);
    grid->entries[kept++] = entry;
  }
  grid->entries.resize(kept);
}

std::vector<CloudPoint> MapCloud::Points(const std::vector<StampedPose>& trajectory) const {
  std::vector<const Eigen::Isometry3d*> poses(stamps_ns_.size(), nullptr);
  for (std::size_t i = 0; i < stamps_ns_.size(); ++i) {
    const auto it = std::lower_bound(
        trajectory.begin(),
        trajectory.end(),
        stamps_ns_[i],
        [](const StampedPose& pose, std::int64_t stamp) { return pose.stamp_ns < stamp; });
    if (it != trajectory.end() && it->stamp_ns == stamps_ns_[i]) poses[i] = &it->T_map_lidar;
  }
  std::vector<CloudPoint> points;
  points.reserve(size());
  for (const Grid* grid : {&wood_, &leaf_}) {
    for (const Entry& entry : grid->entries) {
      CloudPoint point;
      point.label = grid == &wood_ ? Label::kWood : Label::kLeaf;
      point.position = entry.point.cast<double>();
      if (entry.scan >= 0) {
        const Eigen::Isometry3d* pose = poses[static_cast<std::size_t>(entry.scan)];
        if (pose == nullptr) continue;
        point.position = *pose * point.position;
      }
      points.push_back(point);
    }
  }
  return points;
}

void MapCloud::Restore(const std::vector<CloudPoint>& points) {
  Reset();
  for (const CloudPoint& point : points) {
    Insert(point.position,
           point.position.cast<float>(),
           -1,
           point.label == Label::kWood ? &wood_ : &leaf_);
  }
}

void AssignPoints(const TreeModel& model,
                  double wood_reach_m,
                  double leaf_reach_m,
                  std::vector<CloudPoint>* points) {
  if (points->empty()) return;
  const bool leaves = std::any_of(points->begin(), points->end(), [](const CloudPoint& p) {
    return p.label == Label::kLeaf;
  });
  const CylinderGrid wood(model.cylinders, wood_reach_m, std::max(0.25, 2.0 * wood_reach_m));
  const std::vector<MapCylinder> none;
  const CylinderGrid leaf(
      leaves ? model.cylinders : none, leaf_reach_m, std::max(0.5, leaf_reach_m));
  for (CloudPoint& point : *points) {
    const bool is_wood = point.label == Label::kWood;
    const MapCylinder* nearest = is_wood ? wood.Nearest(point.position, wood_reach_m)
                                         : leaf.Nearest(point.position, leaf_reach_m);
    point.tree_id = nearest != nullptr ? nearest->tree_id : -1;
    point.branch_id = nearest != nullptr && is_wood ? nearest->branch_id : -1;
  }
}

}  // namespace dendro
