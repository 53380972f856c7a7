#include "dendro_slam/topology/dendrometry.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <stdexcept>

namespace dendro {

namespace {

double RadiusAtStart(const MapCylinder& c) {
  return std::max(0.0, c.radius_m - 0.5 * c.taper_m_per_m * c.Length());
}

double RadiusAtEnd(const MapCylinder& c) {
  return std::max(0.0, c.radius_m + 0.5 * c.taper_m_per_m * c.Length());
}

// The entry with an id in a list sorted by id, or null.
template <class T>
const T* FindById(const std::vector<T>& sorted, int id) {
  const auto it = std::lower_bound(
      sorted.begin(), sorted.end(), id, [](const T& entry, int value) { return entry.id < value; });
  return it != sorted.end() && it->id == id ? &*it : nullptr;
}

// The trunk's cylinders from base to tip.
std::vector<const MapCylinder*> Stem(const TreeModel& model, const MapTree& tree) {
  std::vector<const MapCylinder*> stem;
  const MapBranch* trunk = FindById(model.branches, tree.trunk_branch_id);
  if (trunk == nullptr) return stem;
  for (const int id : trunk->cylinder_ids) {
    if (const MapCylinder* cylinder = FindById(model.cylinders, id)) stem.push_back(cylinder);
  }
  return stem;
}

double FrustumVolume(double length, double r0, double r1) {
  return M_PI * length / 3.0 * (r0 * r0 + r0 * r1 + r1 * r1);
}

}  // namespace

std::optional<StemDiameter> DiameterAtHeight(const TreeModel& model,
                                             const MapTree& tree,
                                             double height_m,
                                             double window_m,
                                             double max_gap_m) {
  // The radius of a cylinder holds along its whole length through its taper: every measured one
  // that reaches into the window is cut to it and speaks for the stretch that is left.
  double sw = 0.0, swx = 0.0, swxx = 0.0, swy = 0.0, swxy = 0.0, sws = 0.0;
  double below = -1e300, above = 1e300;
  bool covered = false;
  for (const MapCylinder* c : Stem(model, tree)) {
    if (c->status != FitStatus::kMeasured) continue;
    const double h0 = c->start.z() - tree.base.z(), h1 = c->end.z() - tree.base.z();
    if (!(h1 > h0)) continue;
    if (h0 <= height_m && height_m <= h1) covered = true;
    if (h1 <= height_m) below = std::max(below, h1);
    if (h0 >= height_m) above = std::min(above, h0);
    const double low = std::max(h0, height_m - window_m), high = std::min(h1, height_m + window_m);
    if (high <= low) continue;
    const double sigma = std::max(c->radius_sigma_m, 1e-5);
    for (const double x : {low, 0.5 * (low + high), high}) {
      const double weight = (high - low) / (sigma * sigma);
      const double y =
          RadiusAtStart(*c) + (x - h0) / (h1 - h0) * (RadiusAtEnd(*c) - RadiusAtStart(*c));
      const double dx = x - height_m;
      sw += weight;
      swx += weight * dx;
      swxx += weight * dx * dx;
      swy += weight * y;
      swxy += weight * dx * y;
      sws += weight * sigma;
    }
  }
  StemDiameter result;
  result.height_m = height_m;
  if (covered && sw > 0.0) {
    const double determinant = sw * swxx - swx * swx;
    const bool line = determinant > 1e-9 * sw * sw;
    const double radius = line ? (swxx * swy - swx * swxy) / determinant : swy / sw;
    result.diameter_m = 2.0 * radius;
    result.sigma_m = 2.0 * sws / sw;
    return result;
  }
  if (!(above - below <= max_gap_m)) return std::nullopt;
  // Not seen here, but close above and below: the line between the two ends.
  double r_below = 0.0, r_above = 0.0, s_below = 0.0, s_above = 0.0;
  for (const MapCylinder* c : Stem(model, tree)) {
    if (c->status != FitStatus::kMeasured) continue;
    if (c->end.z() - tree.base.z() == below) r_below = RadiusAtEnd(*c), s_below = c->radius_sigma_m;
    if (c->start.z() - tree.base.z() == above) {
      r_above = RadiusAtStart(*c);
      s_above = c->radius_sigma_m;
    }
  }
  const double f = above > below ? (height_m - below) / (above - below) : 0.5;
  result.diameter_m = 2.0 * ((1.0 - f) * r_below + f * r_above);
  // What a stem may do unseen between two places grows with the step between them.
  result.sigma_m = 2.0 * std::hypot((1.0 - f) * s_below + f * s_above,
                                    std::sqrt(f * (1.0 - f)) * std::abs(r_above - r_below));
  result.status = FitStatus::kInferred;
  return result;
}

std::vector<StemDiameter> StemTaper(const TreeModel& model, const MapTree& tree) {
  std::vector<StemDiameter> taper;
  for (const MapCylinder* c : Stem(model, tree)) {
    StemDiameter entry;
    entry.height_m = 0.5 * (c->start.z() + c->end.z()) - tree.base.z();
    entry.diameter_m = 2.0 * c->radius_m;
    entry.sigma_m = 2.0 * c->radius_sigma_m;
    entry.status = c->status;
    taper.push_back(entry);
  }
  return taper;
}

BranchMeasures MeasureBranch(const TreeModel& model, const MapBranch& branch) {
  BranchMeasures measures;
  bool seen = false;
  double walked = 0.0;
  const auto diameter = [](const MapCylinder& c, double f) {
    const double radius = c.radius_m + (f - 0.5) * c.taper_m_per_m * c.Length();
    return BranchDiameter{2.0 * std::max(0.0, radius), 2.0 * c.radius_sigma_m, c.status};
  };
  for (std::size_t i = 0; i < branch.cylinder_ids.size(); ++i) {
    const MapCylinder* c = FindById(model.cylinders, branch.cylinder_ids[i]);
    if (c == nullptr) throw std::out_of_range("a branch names a cylinder that is not in the model");
    const double length = c->Length(), half = 0.5 * branch.length_m - walked;
    if (i == 0) measures.base = diameter(*c, 0.0);
    if (half >= 0.0 && half <= length) {
      measures.middle = diameter(*c, length > 0.0 ? half / length : 0.5);
    }
    measures.tip = diameter(*c, 1.0);
    walked += length;
    if (c->status != FitStatus::kMeasured) {
      measures.inferred_length_m += length;
      continue;
    }
    measures.visible_arc_rad =
        seen ? std::min(measures.visible_arc_rad, c->visible_arc_rad) : c->visible_arc_rad;
    measures.num_scans = std::max(measures.num_scans, c->num_scans);
    seen = true;
  }
  return measures;
}

WoodVolume Volume(const TreeModel& model, const MapTree& tree, int order, double min_radius_m) {
  std::map<int, double> sigma_of_branch;
  WoodVolume result;
  for (const MapCylinder& c : model.cylinders) {
    if (c.tree_id != tree.id || (order >= 0 && c.branch_order != order)) continue;
    if (c.radius_m < min_radius_m) continue;
    result.volume_m3 += FrustumVolume(c.Length(), RadiusAtStart(c), RadiusAtEnd(c));
    sigma_of_branch[c.branch_id] += 2.0 * M_PI * c.radius_m * c.Length() * c.radius_sigma_m;
  }
  double variance = 0.0;
  for (const auto& [branch, sigma] : sigma_of_branch) variance += sigma * sigma;
  result.sigma_m3 = std::sqrt(variance);
  return result;
}

void MeasureTrees(double breast_height_m, double min_volume_radius_m, TreeModel* model) {
  for (MapTree& tree : model->trees) {
    tree.dbh_height_m = breast_height_m;
    tree.min_radius_m = min_volume_radius_m;
    const std::optional<StemDiameter> dbh = DiameterAtHeight(*model, tree, breast_height_m);
    if (dbh) {
      tree.dbh_m = dbh->diameter_m;
      // A base that is off by its sigma measures the stem that much higher or lower.
      const auto high = DiameterAtHeight(*model, tree, breast_height_m + tree.base_sigma_m);
      const auto low = DiameterAtHeight(*model, tree, breast_height_m - tree.base_sigma_m);
      const double step = high && low ? 0.5 * std::abs(high->diameter_m - low->diameter_m) : 0.0;
      tree.dbh_sigma_m = std::hypot(dbh->sigma_m, step);
      tree.dbh_status = dbh->status;
    } else {
      tree.dbh_status = FitStatus::kUnresolved;
      tree.dbh_m.reset();
      tree.dbh_sigma_m = 0.0;
    }
    tree.stem_volume_m3 = Volume(*model, tree, 0, min_volume_radius_m).volume_m3;
    const WoodVolume wood = Volume(*model, tree, -1, min_volume_radius_m);
    tree.wood_volume_m3 = wood.volume_m3;
    tree.volume_sigma_m3 = wood.sigma_m3;

    tree.height_m = 0.0;
    tree.max_branch_order = 0;
    tree.num_scans = 0;
    for (const MapCylinder& c : model->cylinders) {
      if (c.tree_id != tree.id) continue;
      tree.height_m =
          std::max({tree.height_m, c.start.z() - tree.base.z(), c.end.z() - tree.base.z()});
      tree.max_branch_order = std::max(tree.max_branch_order, c.branch_order);
      tree.num_scans = std::max(tree.num_scans, c.num_scans);
    }

    // Lean: from the stem's base to its tip. Coverage: the least seen measured part of the stem
    // that the DBH rests on, or of the whole stem where there is no DBH.
    const std::vector<const MapCylinder*> stem = Stem(*model, tree);
    if (stem.empty()) continue;
    const Eigen::Vector3d run = stem.back()->end - stem.front()->start;
    tree.lean_rad = std::atan2(run.head<2>().norm(), run.z());
    double arc = -1.0, arc_at_breast_height = -1.0;
    for (const MapCylinder* c : stem) {
      if (c->status != FitStatus::kMeasured) continue;
      const auto least = [&](double a) {
        return a < 0.0 ? c->visible_arc_rad : std::min(a, c->visible_arc_rad);
      };
      arc = least(arc);
      const double low = c->start.z() - tree.base.z(), high = c->end.z() - tree.base.z();
      if (low <= breast_height_m + 0.2 && high >= breast_height_m - 0.2) {
        arc_at_breast_height = least(arc_at_breast_height);
      }
    }
    tree.arc_coverage_rad = std::max(0.0, arc_at_breast_height >= 0.0 ? arc_at_breast_height : arc);
  }
}

}  // namespace dendro
