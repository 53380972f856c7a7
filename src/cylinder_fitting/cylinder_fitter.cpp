#include "dendro_slam/cylinder_fitting/cylinder_fitter.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "dendro_slam/cylinder_fitting/beam_model.h"
#include "dendro_slam/cylinder_fitting/marshall_fit.h"
#include "dendro_slam/geometry/cylinder.h"

namespace dendro {
namespace {

constexpr double kDegree = 0.017453292519943295;
constexpr int kMaxIterations = 16;
// Iterations whose scale is the median's; then it is the weighted mean's and the anchor stays.
constexpr int kSettling = 3;
// Squared length of the last step in standard deviations.
constexpr double kConverged = 1e-3;
constexpr double kLargestCycle = 25.0;
// Sweeps of expectation propagation while the estimate still moves far, and later at most; and the
// change of a message's share in its posterior precision below which they end.
constexpr int kFirstSweeps = 3;
constexpr int kMostSweeps = 12;
constexpr double kSettledMessage = 1e-3;
// Scatter, in units of the largest of a cylinder, at which no more iterations are spent.
constexpr double kHopeless = 1.5;
// A footprint of thin rays still leaves the silhouette this uncertain a width [m].
constexpr double kThinnestBeam = 1e-3;
// Thin wood of few rings needs some length to be told from a joint.
constexpr double kThinM = 0.06;
constexpr int kFewRings = 6;
constexpr double kShortest = 4.0;  // Length over radius.
// Returns of one branch farther apart in time lie on both sides of where a revolution begins.
constexpr float kLongSight_s = 0.02F;
// Sine of the angle to the axis from which two neighbours see the silhouette and not an end.
constexpr double kLeastCrossing = 0.25;
// Rings lie ten times as far apart as columns. Where columns see the silhouette, a neighbour in another
// ring only repeats what limb and miss have told already, as if it were news.
constexpr double kLeastCrossingOfRings = 0.968;  // sqrt(1 - kLeastCrossing^2)
// Returns at the sensor and beyond this are none, nor are beams that start there [m].
constexpr double kNearest = 1e-3;
constexpr float kFarthest = 1e3F;

// The state of the final estimator: the bent cone's tangent space and the error of the share of a
// beam that makes a return, which shifts all edges by that part of the beam's width.
constexpr int kStates = 9;
constexpr int kRadius = 4;
constexpr int kSlope = 5;
constexpr int kBend = 6;
constexpr int kShare = 8;
using StateVector = Eigen::Matrix<double, kStates, 1>;
using StateMatrix = Eigen::Matrix<double, kStates, kStates>;

void Require(bool ok, const char* field, const char* rule) {
  if (!ok) {
    throw std::invalid_argument(std::string("CylinderFitterConfig.") + field + " must be " + rule);
  }
}

struct Beam {
  Eigen::Vector3d origin, direction, point;
  double range = 0.0;
  double half_horizontal = 0.0, half_vertical = 0.0;  // Footprint at the surface.
  int row = 0;
};

// A silhouette crossing: a beam that hit and its neighbour that missed.
struct Edge {
  Beam hit, miss;
  double competing = 0.0;  // See DetectionOffset.
  bool across_rings = false;
};

// A linear observation `low <= g . x <= high` of the state, whose ends are known to sigma.
struct Interval {
  StateVector g;
  double low, high, sigma;
  // Gaussian message of expectation propagation, in natural parameters of g . x from the middle of
  // the interval, so that it stays right when the estimate, from which x is counted, moves.
  double precision = 0.0, shift = 0.0;
  bool fresh = true;     // It has no message yet.
  std::size_t edge = 0;  // Which one of SegmentFit::edges_.
  double middle() const { return 0.5 * (low + high); }
};

struct Posterior {
  StateVector mean = StateVector::Zero();
  StateMatrix covariance = StateMatrix::Identity();
};

double NormalPdf(double x) { return 0.3989422804014327 * std::exp(-0.5 * x * x); }
double NormalCdf(double x) { return 0.5 * std::erfc(-x * 0.7071067811865476); }

// Gaussian times intervals, by expectation propagation: every interval is replaced by the Gaussian
// that has the same moments in the company of all others. Brackets that coincide (a vertical
// trunk's edges in neighbouring rings) so count once, and brackets that are staggered narrow each
// other down, which treating each as an independent error of spacing/sqrt(12) would get wrong both
// ways. An interval may be false (a leaf, a knot) with probability `outlier`.
Posterior Propagate(const StateMatrix& information,
                    const StateVector& vector,
                    double outlier,
                    int max_sweeps,
                    std::vector<Interval>* intervals) {
  Posterior out;
  out.covariance = information.ldlt().solve(StateMatrix::Identity());
  out.mean = out.covariance * vector;
  if (intervals->empty()) return out;
  // Start with every bracket believed, as a uniform error within it; a thin branch's ranges alone
  // may lie so far off that each bracket by itself would look false.
  for (Interval& i : *intervals) {
    if (!i.fresh) continue;
    const double half = 0.5 * (i.high - i.low);
    i.precision = 1.0 / (half * half / 3.0 + i.sigma * i.sigma);
    i.shift = 0.0;
    i.fresh = false;
  }
  const auto sum = [&]() {
    StateMatrix precision = information;
    StateVector natural = vector;
    for (const Interval& i : *intervals) {
      precision.noalias() += (i.precision * i.g).lazyProduct(i.g.transpose());
      natural += (i.shift + i.precision * i.middle()) * i.g;
    }
    out.covariance = precision.ldlt().solve(StateMatrix::Identity());
    out.mean = out.covariance.lazyProduct(natural);
  };
  sum();
  for (int sweep = 0; sweep < max_sweeps; ++sweep) {
    double change = 0.0;
    for (Interval& i : *intervals) {
      const StateVector Cg = out.covariance.lazyProduct(i.g);
      const double v = i.g.dot(Cg);
      const double middle = i.middle();
      const double m = i.g.dot(out.mean) - middle;
      const double cavity_precision = 1.0 / v - i.precision;
      if (!(cavity_precision > 1e-9 / v)) continue;
      const double vc = 1.0 / cavity_precision;
      const double mc = vc * (m / v - i.shift);
      // Moments of the noisy edge within the bracket, then of the edge itself.
      const double total = vc + i.sigma * i.sigma;
      const double s = std::sqrt(total);
      const double half = 0.5 * (i.high - i.low);
      const double a = (-half - mc) / s;
      const double b = (half - mc) / s;
      const double inside = NormalCdf(b) - NormalCdf(a);
      double mean = mc, variance = vc;
      const double mass = (1.0 - outlier) * inside;
      if (mass > 1e-12) {
        const double pa = NormalPdf(a), pb = NormalPdf(b);
        const double first = (pa - pb) / inside;
        const double second = 1.0 + (a * pa - b * pb) / inside - first * first;
        const double gain = vc / total;
        const double box_mean = mc + gain * s * first;
        const double box_variance = vc - gain * vc * (1.0 - std::max(0.0, second));
        const double w = mass / (mass + outlier);
        mean = w * box_mean + (1.0 - w) * mc;
        variance = w * (box_variance + (box_mean - mean) * (box_mean - mean)) +
                   (1.0 - w) * (vc + (mc - mean) * (mc - mean));
      }
      const double precision_new = std::max(0.0, 1.0 / variance - cavity_precision);
      const double shift_new = precision_new > 0.0 ? mean * (precision_new + cavity_precision) -
                                                         mc * cavity_precision
                                                   : 0.0;
      const double d_precision = 0.8 * (precision_new - i.precision);
      const double d_shift = 0.8 * (shift_new - i.shift);
      const double denominator = 1.0 + d_precision * v;
      if (!(denominator > 1e-9)) continue;
      i.precision += d_precision;
      i.shift += d_shift;
      out.mean += Cg * ((d_shift - d_precision * m) / denominator);
      out.covariance.noalias() -= (Cg * (d_precision / denominator)).lazyProduct(Cg.transpose());
      change = std::max(change, std::abs(d_precision) * v);
    }
    if (change < kSettledMessage) break;
  }
  sum();  // Rank-one updates drift.
  return out;
}

struct Estimate {
  BentCone cone;
  double share_error = 0.0;
  StateMatrix covariance = StateMatrix::Identity();
  std::vector<double> weights;  // Per beam.
  std::vector<double> residuals;
  double sigma = 0.0;           // Scatter along the beam [m].
  int edges = 0, edges_violated = 0;
  bool converged = false;
};

// Only neighbours across the axis see the silhouette; one along it sees an end.
bool IsAcross(const Edge& edge, const BeamOnCone& hit, const BeamOnCone& miss) {
  const double apart = edge.hit.range * (edge.miss.direction - edge.hit.direction).norm();
  const double least = edge.across_rings ? kLeastCrossingOfRings : kLeastCrossing;
  return std::abs(miss.offset - hit.offset) >= least * apart;
}

double Median(std::vector<double> values) {
  if (values.empty()) return 0.0;
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

// Full weight near, none far: a leaf is not a large error of a trunk.
double RobustWeight(double ratio) {
  constexpr double kFull = 2.5, kNone = 5.0;
  const double x = std::abs(ratio);
  if (x <= kFull) return 1.0;
  if (x >= kNone) return 0.0;
  return 0.5 * (1.0 + std::cos(M_PI * (x - kFull) / (kNone - kFull)));
}

class SegmentFit {
 public:
  SegmentFit(const LabelledScan& scan, const Segment& segment, const CylinderFitterConfig& config)
      : scan_(scan), image_(scan.image), segment_(segment), config_(config) {}

  FittedCylinder Fit();
  std::optional<Cylinder> Initial();

 private:
  bool Collect();
  void CollectEdges();
  void TryEdge(std::size_t pixel, int row, int col, int d_row, int d_col);
  bool InSegment(std::size_t pixel) const {
    return std::binary_search(segment_.pixels.begin(), segment_.pixels.end(),
                              static_cast<std::int32_t>(pixel));
  }
  // A direction that is one, from a place that is no farther than a range can be.
  bool IsBeam(std::size_t pixel) const {
    return std::abs(image_.beam_direction[pixel].squaredNorm() - 1.0F) < 1e-3F &&
           image_.beam_origin[pixel].squaredNorm() < kFarthest * kFarthest;
  }
  Beam BeamAt(std::size_t pixel, double range) const;
  Eigen::Vector3d RingAxis() const;
  std::optional<Cone> FromWidth(const Eigen::Vector3d& axis) const;
  Cone StartFrom(const Eigen::Vector3d& axis, double* cost) const;
  std::optional<Cone> Start() const;
  Footprint FootprintOf(const Cone& cone, const Beam& beam) const {
    return FootprintOnCone(cone.axis, beam.direction, Eigen::Vector3d::UnitZ(),
                           beam.half_horizontal, beam.half_vertical);
  }
  void Recentre(BentCone* cone, const std::vector<double>& weights) const;
  void Linearise(Estimate* estimate,
                 bool rescale,
                 StateMatrix* information,
                 StateVector* vector,
                 std::vector<Interval>* intervals) const;
  Estimate Refine(const Cone& start) const;
  bool SeesASide(const BentCone& cone) const;
  void Report(const Estimate& estimate, FittedCylinder* out) const;

  const LabelledScan& scan_;
  const RangeImage& image_;
  const Segment& segment_;
  const CylinderFitterConfig& config_;
  std::vector<Beam> beams_;
  std::vector<Edge> edges_;
  std::vector<Edge> backed_edges_;  // The same before a wall or a hedge so close that both mix.
  std::vector<Edge> hidden_edges_;  // Where the segment ends and this surface, other wood close behind it or
                                    // something nearer goes on.
  Eigen::Vector3d origin_ = Eigen::Vector3d::Zero();  // Mean optical centre.
  Eigen::Vector3d centroid_ = Eigen::Vector3d::Zero();
  double bright_ = 0.0;  // Intensity of a full hit.
  float first_time_s_ = 0.0F, last_time_s_ = 0.0F;  // Of the returns.
  int num_rings_ = 0;
  int non_finite_ = 0;
};

Beam SegmentFit::BeamAt(std::size_t pixel, double range) const {
  Beam beam;
  beam.origin = image_.beam_origin[pixel].cast<double>();
  beam.direction = image_.beam_direction[pixel].cast<double>();
  beam.range = range;
  beam.half_horizontal =
      0.5 * (config_.beam_exit_horizontal_m + range * config_.beam_divergence_horizontal_rad);
  beam.half_vertical =
      0.5 * (config_.beam_exit_vertical_m + range * config_.beam_divergence_vertical_rad);
  beam.row = static_cast<int>(pixel) / image_.cols;
  return beam;
}

bool SegmentFit::Collect() {
  std::vector<double> intensities;
  int last_row = -1;
  for (const std::int32_t index : segment_.pixels) {
    const auto pixel = static_cast<std::size_t>(index);
    const Eigen::Vector3f& p = image_.point[pixel];
    const Eigen::Vector3f& o = image_.beam_origin[pixel];
    if (!image_.HasReturn(pixel) || !p.allFinite() || !o.allFinite()) {
      ++non_finite_;
      continue;
    }
    const Eigen::Vector3d ray = (p - o).cast<double>();
    const double range = ray.norm();
    if (!(range > kNearest) || !(range < kFarthest) || !IsBeam(pixel)) {
      ++non_finite_;
      continue;
    }
    Beam beam = BeamAt(pixel, range);
    beam.direction = ray / range;
    beam.point = p.cast<double>();
    if (beam.row != last_row) ++num_rings_;
    last_row = beam.row;
    const float time_s = image_.time_s.size() == image_.size() ? image_.time_s[pixel] : 0.0F;
    first_time_s_ = beams_.empty() ? time_s : std::min(first_time_s_, time_s);
    last_time_s_ = beams_.empty() ? time_s : std::max(last_time_s_, time_s);
    beams_.push_back(beam);
    centroid_ += beam.point;
    origin_ += beam.origin;
    if (image_.intensity.size() == image_.size()) {
      intensities.push_back(static_cast<double>(image_.intensity[pixel]));
    }
  }
  if (beams_.empty()) return false;
  centroid_ /= static_cast<double>(beams_.size());
  origin_ /= static_cast<double>(beams_.size());
  if (!intensities.empty()) {
    const auto upper =
        intensities.begin() + static_cast<std::ptrdiff_t>(intensities.size() * 3 / 4);
    std::nth_element(intensities.begin(), upper, intensities.end());
    bright_ = *upper;
  }
  return true;
}

void SegmentFit::TryEdge(std::size_t pixel, int row, int col, int d_row, int d_col) {
  const int next_row = row + d_row;
  if (next_row < 0 || next_row >= image_.rows) return;
  const std::size_t next = image_.Index(next_row, image_.WrapColumn(col + d_col));
  if (InSegment(next)) return;
  // A pixel between pixels of the segment is a hole, from whichever side it is come to.
  const auto between = [&](int step_row, int step_col) {
    for (const int way : {-1, 1}) {
      const int other_row = next_row + way * step_row;
      if (other_row < 0 || other_row >= image_.rows ||
          !InSegment(image_.Index(other_row, image_.WrapColumn(col + d_col + way * step_col)))) {
        return false;
      }
    }
    return true;
  };
  if (between(0, 1) || between(1, 0)) return;
  if (!IsBeam(next)) return;
  const double range =
      static_cast<double>((image_.point[pixel] - image_.beam_origin[pixel]).norm());
  Edge edge;
  edge.hit = BeamAt(pixel, range);
  edge.miss = BeamAt(next, range);
  edge.across_rings = d_row != 0;
  if (image_.HasReturn(next)) {
    const double behind =
        static_cast<double>((image_.point[next] - image_.beam_origin[next]).norm());
    // A nearer surface hides the silhouette; one close behind mixes with it.
    if (!(behind > range + std::max(config_.echo_separation_m, 6.0 * config_.range_sigma_m))) {
      const bool backed = behind > range + 6.0 * config_.range_sigma_m &&
                          scan_.label.size() == image_.size() && !scan_.IsWood(next);
      (backed ? backed_edges_ : hidden_edges_).push_back(edge);
      return;
    }
    const double brightness = image_.intensity.size() == image_.size()
                                  ? static_cast<double>(image_.intensity[next])
                                  : 0.0;
    const double relative = brightness > 0.0 && bright_ > 0.0 ? brightness / bright_ : 1.0;
    edge.competing = relative * range * range / (behind * behind);
  }
  edges_.push_back(edge);
}

void SegmentFit::CollectEdges() {
  for (const std::int32_t index : segment_.pixels) {
    const auto pixel = static_cast<std::size_t>(index);
    if (!image_.HasReturn(pixel) || !image_.point[pixel].allFinite() || !IsBeam(pixel)) continue;
    const int row = index / image_.cols;
    const int col = index % image_.cols;
    TryEdge(pixel, row, col, 0, -1);
    TryEdge(pixel, row, col, 0, 1);
    TryEdge(pixel, row, col, -1, 0);
    TryEdge(pixel, row, col, 1, 0);
  }
}

Eigen::Vector3d PrincipalDirection(const std::vector<Eigen::Vector3d>& points) {
  Eigen::Vector3d mean = Eigen::Vector3d::Zero();
  for (const Eigen::Vector3d& p : points) mean += p;
  mean /= static_cast<double>(points.size());
  Eigen::Matrix3d scatter = Eigen::Matrix3d::Zero();
  for (const Eigen::Vector3d& p : points) scatter += (p - mean) * (p - mean).transpose();
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solver(scatter);
  return solver.eigenvectors().col(2);
}

// The direction along which the centres of the rings, the means of their returns, are spread.
Eigen::Vector3d SegmentFit::RingAxis() const {
  std::vector<Eigen::Vector3d> centres;
  int count = 0;
  for (std::size_t i = 0; i < beams_.size(); ++i) {
    if (i == 0 || beams_[i].row != beams_[i - 1].row) {
      if (count > 0) centres.back() /= count;
      centres.push_back(Eigen::Vector3d::Zero());
      count = 0;
    }
    centres.back() += beams_[i].point;
    ++count;
  }
  centres.back() /= count;
  return PrincipalDirection(centres);
}

// A cone along an axis, its radius from the width across the view; nothing when looked at end-on.
std::optional<Cone> SegmentFit::FromWidth(const Eigen::Vector3d& axis) const {
  Eigen::Vector3d view = centroid_ - origin_;
  view -= view.dot(axis) * axis;
  const double distance = view.norm();
  if (!(distance > 1e-3)) return std::nullopt;
  Cone cone;
  cone.axis = axis;
  view /= distance;
  const Eigen::Vector3d side = axis.cross(view);
  std::vector<double> across;
  across.reserve(beams_.size());
  for (const Beam& b : beams_) across.push_back((b.point - centroid_).dot(side));
  std::sort(across.begin(), across.end());
  const std::size_t trim = across.size() / 20;
  double half = 0.5 * (across[across.size() - 1 - trim] - across[trim]);
  half = std::clamp(half, config_.min_radius_m, 0.8 * distance);
  // The mean depth of a half circle seen from its side is pi/4 of its radius.
  cone.radius = half;
  cone.point = centroid_ + view * (0.785 * half) +
               side * (0.5 * (across[across.size() - 1 - trim] + across[trim]));
  return cone;
}

// The same, finished by Marshall's fit.
Cone SegmentFit::StartFrom(const Eigen::Vector3d& axis, double* cost) const {
  const std::optional<Cone> from_width = FromWidth(axis);
  if (!from_width) {
    *cost = std::numeric_limits<double>::infinity();
    Cone cone;
    cone.axis = axis;
    cone.point = centroid_;
    return cone;
  }
  Cone cone = *from_width;
  const double half = cone.radius;
  std::vector<Eigen::Vector3d> points;
  points.reserve(beams_.size());
  for (const Beam& b : beams_) points.push_back(b.point);
  const Cylinder first{cone.axis, cone.point, 1.0 / cone.radius};
  std::optional<Cylinder> fit;
  for (int pass = 0; pass < 2 && points.size() >= 6; ++pass) {
    fit = FitMarshall(points, origin_, fit ? *fit : first);
    if (!fit) break;
    // Points far off are leaves or mixed returns: once more without them.
    std::vector<double> distances;
    for (const Eigen::Vector3d& p : points) distances.push_back(std::abs(fit->Distance(p)));
    const double limit = std::max(4.0 * 1.4826 * Median(distances), 2.0 * config_.range_sigma_m);
    std::vector<Eigen::Vector3d> near;
    for (std::size_t i = 0; i < points.size(); ++i) {
      if (distances[i] <= limit) near.push_back(points[i]);
    }
    if (near.size() == points.size()) break;
    points.swap(near);
  }
  const auto accept = [&](const Cylinder& c) {
    const double r = c.radius();
    return r > 0.4 * half && r < 4.0 * half + 0.05 && std::abs(c.axis.dot(axis)) > 0.7;
  };
  if (fit && (config_.marshall_only || accept(*fit))) {
    cone.axis = fit->axis.dot(axis) < 0.0 ? Eigen::Vector3d(-fit->axis) : fit->axis;
    cone.point = fit->point;
    cone.radius = fit->radius();
  }
  const Cylinder c{cone.axis, cone.point, 1.0 / cone.radius};
  std::vector<double> distances;
  for (const Beam& b : beams_) distances.push_back(std::abs(c.Distance(b.point)));
  *cost = Median(distances) + 0.01 * std::abs(std::log(cone.radius / half));
  return cone;
}

std::optional<Cone> SegmentFit::Start() const {
  std::vector<Eigen::Vector3d> all;
  for (const Beam& b : beams_) all.push_back(b.point);
  double cost_rings = 0.0, cost_all = 0.0;
  const Cone rings = StartFrom(RingAxis(), &cost_rings);
  const Eigen::Vector3d major = PrincipalDirection(all);
  // Two starts only where they differ: a trunk's rings point along it, a level branch's do not.
  if (std::abs(major.dot(rings.axis)) > 0.9) {
    return std::isfinite(cost_rings) ? std::optional<Cone>(rings) : std::nullopt;
  }
  const Cone along = StartFrom(major, &cost_all);
  if (!std::isfinite(std::min(cost_rings, cost_all))) return std::nullopt;
  return cost_rings <= cost_all ? rings : along;
}

// Moves the anchor to the middle of the stretch that holds the returns.
void SegmentFit::Recentre(BentCone* cone, const std::vector<double>& weights) const {
  double low = std::numeric_limits<double>::infinity(), high = -low;
  for (std::size_t i = 0; i < beams_.size(); ++i) {
    if (!weights.empty() && weights[i] < 0.5) continue;
    const double s = (beams_[i].point - cone->middle.point).dot(cone->middle.axis);
    low = std::min(low, s);
    high = std::max(high, s);
  }
  if (!(low <= high)) return;
  cone->middle = cone->Touching(0.5 * (low + high));
  cone->bend -= cone->bend.dot(cone->middle.axis) * cone->middle.axis;
}

void SegmentFit::Linearise(Estimate* estimate,
                           bool rescale,
                           StateMatrix* information,
                           StateVector* vector,
                           std::vector<Interval>* intervals) const {
  const BentCone& bent = estimate->cone;
  const std::size_t n = beams_.size();
  std::vector<BentCone::Tangent> jacobians(n);
  estimate->residuals.assign(n, 0.0);
  estimate->weights.assign(n, 0.0);
  std::vector<double> magnitudes;
  std::vector<double> stations(n);
  for (std::size_t i = 0; i < n; ++i) {
    const Beam& beam = beams_[i];
    BentCone::TouchJacobian touching;
    stations[i] = bent.StationOf(beam.origin, beam.direction);
    const Cone cone = bent.Touching(stations[i], &touching);
    const BeamOnCone located = LocateBeam(cone, beam.origin, beam.direction);
    if (!located.valid) continue;
    const RangePrediction predicted = PredictRange(located, FootprintOf(cone, beam));
    estimate->residuals[i] = beam.range - predicted.range;
    jacobians[i] = touching.transpose() * predicted.jacobian;
    estimate->weights[i] = 1.0;
    magnitudes.push_back(std::abs(estimate->residuals[i]));
  }
  const double scale =
      rescale ? std::max(1.4826 * Median(magnitudes), 0.7 * config_.range_sigma_m)
              : estimate->sigma;
  double sum = config_.range_sigma_weight * config_.range_sigma_m * config_.range_sigma_m;
  double count = config_.range_sigma_weight;
  double used = 0.0;
  double first_station = std::numeric_limits<double>::infinity(), last_station = -first_station;
  for (std::size_t i = 0; i < n; ++i) {
    if (estimate->weights[i] == 0.0) continue;
    const double w = RobustWeight(estimate->residuals[i] / scale);
    if (w >= 0.5) {
      first_station = std::min(first_station, stations[i]);
      last_station = std::max(last_station, stations[i]);
    }
    estimate->weights[i] = w;
    sum += w * estimate->residuals[i] * estimate->residuals[i];
    used += w;
  }
  count += std::max(0.0, used - 5.0);
  estimate->sigma = std::sqrt(sum / std::max(1.0, count));

  information->setZero();
  vector->setZero();
  const double inverse = 1.0 / (estimate->sigma * estimate->sigma);
  const double ring_variance = config_.ring_bias_sigma_m * config_.ring_bias_sigma_m;
  // A laser's offset is common to its ring: sigma^2 I + b^2 1 1^T per ring, inverted by Woodbury.
  BentCone::Tangent ring_jacobian = BentCone::Tangent::Zero();
  double ring_residual = 0.0, ring_weight = 0.0;
  const auto close_ring = [&]() {
    if (ring_variance > 0.0 && ring_weight > 0.0) {
      const double gain =
          ring_variance * inverse * inverse / (1.0 + ring_variance * inverse * ring_weight);
      information->topLeftCorner<8, 8>() -= gain * ring_jacobian * ring_jacobian.transpose();
      vector->head<8>() -= gain * ring_residual * ring_jacobian;
    }
    ring_jacobian.setZero();
    ring_residual = ring_weight = 0.0;
  };
  for (std::size_t i = 0; i < n; ++i) {
    if (i > 0 && beams_[i].row != beams_[i - 1].row) close_ring();
    const double w = estimate->weights[i];
    if (w == 0.0) continue;
    const BentCone::Tangent& J = jacobians[i];
    information->topLeftCorner<8, 8>() += (w * inverse) * J * J.transpose();
    vector->head<8>() += (w * inverse * estimate->residuals[i]) * J;
    ring_jacobian += w * J;
    ring_residual += w * estimate->residuals[i];
    ring_weight += w;
  }
  close_ring();
  const double slope_information = 1.0 / (config_.taper_sigma_m_per_m * config_.taper_sigma_m_per_m);
  (*information)(kSlope, kSlope) += slope_information;
  (*vector)[kSlope] -= slope_information * bent.middle.slope;
  const double bend_information = 1.0 / (config_.bend_sigma_per_m * config_.bend_sigma_per_m);
  information->diagonal().segment<2>(kBend).array() += bend_information;
  vector->segment<2>(kBend) -=
      bend_information * PerpendicularBasis(bent.middle.axis).transpose() * bent.bend;
  const double share_information =
      1.0 / (config_.detection_bias_sigma * config_.detection_bias_sigma);
  (*information)(kShare, kShare) += share_information;
  (*vector)[kShare] -= share_information * estimate->share_error;
  // A vague prior keeps degenerate geometry solvable; what it alone holds ends as UNRESOLVED.
  const double length = 1.0;
  for (int k = 0; k < 2; ++k) (*information)(k, k) += 1.0;
  for (int k = 2; k < 5; ++k) (*information)(k, k) += 1.0 / (length * length);

  // Messages are kept from iteration to iteration; both lists are in the order of the edges.
  std::vector<Interval> before;
  before.swap(*intervals);
  auto known = before.begin();
  estimate->edges = estimate->edges_violated = 0;
  for (std::size_t e = 0; e < edges_.size(); ++e) {
    const Edge& edge = edges_[e];
    BentCone::TouchJacobian touching;
    const Cone cone =
        bent.Touching(bent.StationOf(edge.hit.origin, edge.hit.direction), &touching);
    const BeamOnCone hit = LocateBeam(cone, edge.hit.origin, edge.hit.direction);
    const BeamOnCone miss = LocateBeam(cone, edge.miss.origin, edge.miss.direction);
    if (!hit.valid || !miss.valid) continue;
    const double side = miss.offset > hit.offset ? 1.0 : -1.0;
    if (!IsAcross(edge, hit, miss) || side * miss.offset < 0.0) continue;
    // Beyond the stretch that is seen, a beam may miss because the branch ends there.
    const double spacing = edge.hit.range * 2.0 * M_PI / image_.cols;
    const double beyond = bent.StationOf(edge.miss.origin, edge.miss.direction);
    if (beyond < first_station - spacing || beyond > last_station + spacing) continue;
    double hit_Y = 1.0, miss_Y = 1.0;
    const Footprint footprint = FootprintOf(cone, edge.hit);
    const double beam_width = std::max(2.0 * footprint.half_width_m, kThinnestBeam);
    const double hit_edge = DetectionOffset(hit.silhouette, hit.sin_angle, footprint,
                                            config_.detection_fraction, edge.competing, &hit_Y);
    const double miss_edge =
        DetectionOffset(miss.silhouette, miss.sin_angle, FootprintOf(cone, edge.miss),
                        config_.detection_fraction, edge.competing, &miss_Y);
    // Both beams see the same crossing; the mean of the two distances moves with the state.
    Interval interval;
    interval.g.setZero();
    const Vector6d moved = 0.5 * (hit_Y * hit.d_silhouette - side * hit.d_offset +
                                  miss_Y * miss.d_silhouette - side * miss.d_offset);
    interval.g.head<8>() = touching.transpose() * moved;
    interval.g[kShare] = beam_width;
    const double shift = beam_width * estimate->share_error;
    const double low = side * hit.offset - hit_edge - shift;
    const double high = side * miss.offset - miss_edge - shift;
    if (!(low < high)) continue;
    interval.low = low;
    interval.high = high;
    interval.sigma = beam_width * config_.detection_sigma;
    ++estimate->edges;
    const double slack =
        6.0 * beam_width * std::hypot(config_.detection_sigma, config_.detection_bias_sigma);
    if (low > slack || high < -slack) ++estimate->edges_violated;
    interval.edge = e;
    while (known != before.end() && known->edge < e) ++known;
    if (known != before.end() && known->edge == e) {
      interval.precision = known->precision;
      interval.shift = known->shift;
      interval.fresh = known->fresh;
    }
    intervals->push_back(interval);
  }
}

Estimate SegmentFit::Refine(const Cone& start) const {
  constexpr double kOutlier = 0.02;
  Estimate estimate;
  estimate.cone.middle = start;
  Recentre(&estimate.cone, {});
  StateMatrix information;
  StateVector vector;
  std::vector<Interval> intervals;
  for (int iteration = 0; iteration < kMaxIterations; ++iteration) {
    const bool settling = iteration < kSettling;
    if (settling) intervals.clear();
    Linearise(&estimate, settling, &information, &vector, &intervals);
    const Posterior posterior = Propagate(information, vector, kOutlier,
                                          settling ? kFirstSweeps : kMostSweeps, &intervals);
    if (!posterior.mean.allFinite() || !posterior.covariance.allFinite()) return estimate;
    estimate.covariance = posterior.covariance;
    if (iteration >= 2 * kSettling &&
        estimate.sigma > kHopeless * config_.max_residual_sigma_m) {
      estimate.converged = true;  // On what is not a cylinder.
      break;
    }
    StateVector step = posterior.mean;
    const double statistical = step.dot(posterior.covariance.ldlt().solve(step));
    // Returns at the very limb enter and leave: shorter steps end such a cycle.
    double shrink = iteration < 2 * kSettling ? 1.0 : 0.5;
    shrink = std::min(shrink, 0.3 / std::max(1e-12, step.head<2>().norm()));
    shrink = std::min(shrink, 0.3 / std::max(1e-12, step.segment<2>(2).norm()));
    shrink = std::min(shrink, 0.4 * estimate.cone.middle.radius / std::max(1e-12, std::abs(step[kRadius])));
    step *= shrink;
    estimate.cone = estimate.cone.Retract(step.head<8>());
    estimate.share_error += step[kShare];
    if (iteration < kSettling) Recentre(&estimate.cone, estimate.weights);
    if (iteration >= kSettling && statistical < kConverged) {
      estimate.converged = true;
      break;
    }
    // An edge that is as likely false as true makes two solutions take turns. Both are near: the
    // distance between them becomes part of the uncertainty.
    if (iteration == kMaxIterations - 1 && statistical < kLargestCycle) {
      estimate.covariance += step * step.transpose();
      estimate.converged = true;
    }
  }
  return estimate;
}

// True when on one side at least most of the segment's ends look past it. With the same surface or a nearer
// one beside it on both, what looks like a limb is where the segment was cut: a strip of a trunk passes for
// a thin stem.
bool SegmentFit::SeesASide(const BentCone& bent) const {
  int seen[2] = {}, ends[2] = {};
  const auto count = [&](const std::vector<Edge>& edges, int one) {
    for (const Edge& edge : edges) {
      const Cone cone = bent.Touching(bent.StationOf(edge.hit.origin, edge.hit.direction));
      const BeamOnCone hit = LocateBeam(cone, edge.hit.origin, edge.hit.direction);
      const BeamOnCone miss = LocateBeam(cone, edge.miss.origin, edge.miss.direction);
      if (!hit.valid || !miss.valid || !IsAcross(edge, hit, miss)) continue;
      const std::size_t side = miss.offset > hit.offset ? 1 : 0;
      seen[side] += one;
      ++ends[side];
    }
  };
  // Mixed returns at both limbs leave nothing of what is only a few columns wide.
  constexpr double kWideColumns = 10.0;
  const double columns = 2.0 * bent.middle.radius / ((centroid_ - origin_).norm() * 2.0 * M_PI / image_.cols);
  count(edges_, 1);
  count(backed_edges_, columns >= kWideColumns ? 1 : 0);
  count(hidden_edges_, 0);
  return 2 * seen[0] > ends[0] || 2 * seen[1] > ends[1];
}

void SegmentFit::Report(const Estimate& estimate, FittedCylinder* out) const {
  const BentCone& bent = estimate.cone;
  const Cone& cone = bent.middle;
  double low = std::numeric_limits<double>::infinity(), high = -low;
  double arc_low = low, arc_high = -low;
  double deviation = 0.0;
  int last_row = -1;
  for (std::size_t i = 0; i < beams_.size(); ++i) {
    if (estimate.weights[i] < 0.5) continue;
    const Beam& beam = beams_[i];
    ++out->num_points;
    if (beam.row != last_row) ++out->num_rings;
    last_row = beam.row;
    deviation += std::abs(estimate.residuals[i]);
    const double s = (beam.point - cone.point).dot(cone.axis);
    low = std::min(low, s);
    high = std::max(high, s);
    const BeamOnCone located = LocateBeam(bent.Touching(bent.StationOf(beam.origin, beam.direction)),
                                          beam.origin, beam.direction);
    if (!located.valid) continue;
    const double angle = std::asin(std::clamp(located.offset / located.silhouette, -1.0, 1.0));
    arc_low = std::min(arc_low, angle);
    arc_high = std::max(arc_high, angle);
  }
  if (out->num_points > 0) {
    out->start_s_m = low;
    out->end_s_m = high;
    out->mean_abs_deviation_m = deviation / out->num_points;
    out->visible_arc_rad = std::max(0.0, arc_high - arc_low);
  }

  // The straight line with the least mean square distance from the bent axis: half of the mean of s^2.
  const double lift = out->num_points > 0 ? (low * low + low * high + high * high) / 6.0 : 0.0;
  out->cylinder.axis = cone.axis;
  out->cylinder.point = cone.point + lift * bent.bend;
  out->cylinder.curvature = 1.0 / cone.radius;
  Eigen::Matrix<double, 5, kStates> to_cylinder = Eigen::Matrix<double, 5, kStates>::Zero();
  to_cylinder.leftCols<4>().setIdentity();
  to_cylinder.block<2, 2>(2, kBend) = lift * Eigen::Matrix2d::Identity();
  to_cylinder(4, kRadius) = -1.0 / (cone.radius * cone.radius);
  out->covariance = to_cylinder * estimate.covariance * to_cylinder.transpose();
  out->covariance = 0.5 * (out->covariance + out->covariance.transpose()).eval();
  if (last_time_s_ - first_time_s_ > kLongSight_s) {
    // One side was seen a revolution after the other: what the odometry errs in between moves one
    // silhouette, and with it the radius and the position by half of that.
    const double half = 0.5 * config_.revolution_sigma_m;
    out->covariance.diagonal().segment<2>(2).array() += half * half;
    out->covariance(4, 4) += half * half * std::pow(cone.radius, -4.0);
  }
  // What the returns say of the bend, the prior taken out.
  const Eigen::Matrix2d bend_precision =
      estimate.covariance.block<2, 2>(kBend, kBend).inverse();
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> bend(
      bend_precision - Eigen::Matrix2d::Identity() /
                           (config_.bend_sigma_per_m * config_.bend_sigma_per_m));
  out->bend_information = bend.eigenvectors() * bend.eigenvalues().cwiseMax(0.0).asDiagonal() *
                          bend.eigenvectors().transpose();
  out->bend_vector = bend_precision * PerpendicularBasis(cone.axis).transpose() * bent.bend;
  out->taper_m_per_m = cone.slope;
  out->taper_sigma_m_per_m = std::sqrt(estimate.covariance(kSlope, kSlope));
  out->taper_estimated = out->taper_sigma_m_per_m < 0.5 * config_.taper_sigma_m_per_m;
  if (!out->taper_estimated) out->taper_m_per_m = 0.0;

  out->distance_m = (out->cylinder.point - origin_).norm();
  // The true end lies anywhere up to the next beam along the axis.
  const Eigen::Vector3d view = (out->cylinder.point - origin_).normalized();
  const Eigen::Vector3d across = Eigen::Vector3d::UnitZ().cross(view);
  const double level = std::min(1.0, std::abs(cone.axis.dot(across.normalized())));
  const double steep = std::sqrt(std::max(0.0, 1.0 - level * level));
  const double column_step = out->distance_m * 2.0 * M_PI / image_.cols;
  double ring_step = column_step;
  if (out->num_rings > 1) {
    ring_step = std::max(column_step, (high - low) / (out->num_rings - 1));
  }
  out->end_sigma_m = (steep > 0.5 ? ring_step : column_step) / std::sqrt(3.0);
}

std::optional<Cylinder> SegmentFit::Initial() {
  Collect();
  if (static_cast<int>(beams_.size()) < config_.min_points || num_rings_ < 2) return std::nullopt;
  const std::optional<Cone> cone = FromWidth(RingAxis());
  if (!cone) return std::nullopt;
  return Cylinder{cone->axis, cone->point, 1.0 / cone->radius};
}

FittedCylinder SegmentFit::Fit() {
  FittedCylinder out;
  out.segment_id = segment_.id;
  out.covariance = 1e6 * Matrix5d::Identity();
  const auto unresolved = [&](UnresolvedReason reason) {
    out.status = FitStatus::kUnresolved;
    out.reason = reason;
    return out;
  };
  Collect();
  out.num_points = static_cast<int>(beams_.size());
  out.num_rings = num_rings_;
  if (out.num_points > 0) {
    out.cylinder.point = centroid_;
    out.cylinder.curvature = 1.0 / config_.min_radius_m;
    out.distance_m = (centroid_ - origin_).norm();
  }
  if (out.num_points < config_.min_points) {
    return unresolved(non_finite_ > 0 ? UnresolvedReason::kNonFinite
                                      : UnresolvedReason::kTooFewPoints);
  }
  const auto too_few_rings = [&](int rings, double radius) {
    return rings < (radius <= config_.twig_radius_m ? 2 : config_.min_rings);
  };
  if (too_few_rings(num_rings_, 0.0)) return unresolved(UnresolvedReason::kTooFewRings);
  const std::optional<Cone> start = Start();
  // Far from a twig: no need to finish it.
  constexpr double kStartFactor = 2.0;
  if (start && too_few_rings(num_rings_, start->radius / kStartFactor)) {
    return unresolved(UnresolvedReason::kTooFewRings);
  }
  if (!start) return unresolved(UnresolvedReason::kNotConverged);

  Estimate estimate;
  if (config_.marshall_only) {
    estimate.cone.middle = *start;
    Recentre(&estimate.cone, {});
    StateMatrix information;
    StateVector vector;
    std::vector<Interval> intervals;
    Linearise(&estimate, true, &information, &vector, &intervals);
    estimate.covariance = information.ldlt().solve(StateMatrix::Identity());
    estimate.edges = estimate.edges_violated = 0;
    estimate.converged = true;
  } else {
    CollectEdges();
    estimate = Refine(*start);
  }
  const double r = estimate.cone.middle.radius;
  const bool finite = estimate.cone.middle.axis.allFinite() &&
                      estimate.cone.middle.point.allFinite() && std::isfinite(r) && estimate.covariance.allFinite() &&
                      estimate.covariance.diagonal().minCoeff() > 0.0;
  if (!finite) return unresolved(UnresolvedReason::kNotConverged);
  if (!(r >= config_.min_radius_m) || !(r <= config_.max_radius_m)) {
    return unresolved(UnresolvedReason::kRadiusOutOfRange);
  }
  out.num_points = out.num_rings = 0;
  Report(estimate, &out);
  if (!estimate.converged) return unresolved(UnresolvedReason::kNotConverged);
  if (out.num_points < config_.min_points) return unresolved(UnresolvedReason::kNotACylinder);
  if (too_few_rings(out.num_rings, r)) return unresolved(UnresolvedReason::kTooFewRings);
  if (estimate.sigma > config_.max_residual_sigma_m ||
      3 * out.num_points < 2 * static_cast<int>(beams_.size()) ||
      (estimate.edges >= 4 && 3 * estimate.edges_violated > estimate.edges)) {
    return unresolved(UnresolvedReason::kNotACylinder);
  }
  if (out.visible_arc_rad < config_.min_visible_arc_deg * kDegree ||
      (!config_.marshall_only && !SeesASide(estimate.cone))) {
    return unresolved(UnresolvedReason::kArcTooSmall);
  }
  // A few rings on something thin and hardly longer than wide: a joint of twigs or a leaf. A short stem
  // and the elbow of a thick arm are wood.
  if (r < kThinM && out.num_rings < kFewRings && out.end_s_m - out.start_s_m < kShortest * r) {
    return unresolved(UnresolvedReason::kNotACylinder);
  }
  const double axis_sigma = std::sqrt(std::max(estimate.covariance(0, 0), estimate.covariance(1, 1)));
  if (out.radius_sigma_m() > config_.max_radius_sigma_ratio * r ||
      axis_sigma > config_.max_axis_sigma_deg * kDegree) {
    return unresolved(UnresolvedReason::kUncertain);
  }
  out.status = FitStatus::kMeasured;
  out.reason = UnresolvedReason::kNone;
  return out;
}

}  // namespace

void CylinderFitterConfig::Validate() const {
  const auto positive = [](double v) { return std::isfinite(v) && v > 0.0; };
  const auto not_negative = [](double v) { return std::isfinite(v) && v >= 0.0; };
  Require(min_points >= 6, "min_points", ">= 6");
  Require(min_rings >= 2, "min_rings", ">= 2");
  Require(std::isfinite(twig_radius_m) && twig_radius_m >= 0.0, "twig_radius_m", ">= 0");
  Require(positive(min_radius_m), "min_radius_m", "> 0");
  Require(std::isfinite(max_radius_m) && max_radius_m > min_radius_m, "max_radius_m",
          "> min_radius_m");
  Require(positive(min_visible_arc_deg), "min_visible_arc_deg", "> 0");
  Require(positive(max_radius_sigma_ratio), "max_radius_sigma_ratio", "> 0");
  Require(positive(max_axis_sigma_deg), "max_axis_sigma_deg", "> 0");
  Require(positive(max_residual_sigma_m), "max_residual_sigma_m", "> 0");
  Require(positive(range_sigma_m), "range_sigma_m", "> 0");
  Require(not_negative(range_sigma_weight), "range_sigma_weight", ">= 0");
  Require(positive(taper_sigma_m_per_m), "taper_sigma_m_per_m", "> 0");
  Require(positive(bend_sigma_per_m), "bend_sigma_per_m", "> 0");
  Require(not_negative(beam_exit_horizontal_m), "beam_exit_horizontal_m", ">= 0");
  Require(not_negative(beam_exit_vertical_m), "beam_exit_vertical_m", ">= 0");
  Require(not_negative(beam_divergence_horizontal_rad), "beam_divergence_horizontal_rad", ">= 0");
  Require(not_negative(beam_divergence_vertical_rad), "beam_divergence_vertical_rad", ">= 0");
  Require(positive(detection_fraction) && detection_fraction < 1.0, "detection_fraction",
          "in (0, 1)");
  Require(not_negative(echo_separation_m), "echo_separation_m", ">= 0");
  Require(positive(detection_sigma), "detection_sigma", "> 0");
  Require(positive(detection_bias_sigma), "detection_bias_sigma", "> 0");
  Require(not_negative(revolution_sigma_m), "revolution_sigma_m", ">= 0");
  Require(not_negative(ring_bias_sigma_m), "ring_bias_sigma_m", ">= 0");
}

CylinderFitter::CylinderFitter(const CylinderFitterConfig& config) : config_(config) {
  config_.Validate();
}

static void CheckPixels(const LabelledScan& scan, const Segment& segment) {
  for (const std::int32_t pixel : segment.pixels) {
    if (pixel < 0 || static_cast<std::size_t>(pixel) >= scan.image.size()) {
      throw std::invalid_argument("Segment.pixels: index outside the range image");
    }
  }
}

std::vector<FittedCylinder> CylinderFitter::Fit(const LabelledScan& scan,
                                                const std::vector<Segment>& segments) const {
  std::vector<FittedCylinder> cylinders;
  cylinders.reserve(segments.size());
  for (const Segment& segment : segments) cylinders.push_back(FitSegment(scan, segment));
  return cylinders;
}

FittedCylinder CylinderFitter::FitSegment(const LabelledScan& scan, const Segment& segment) const {
  CheckPixels(scan, segment);
  return SegmentFit(scan, segment, config_).Fit();
}

std::optional<Cylinder> CylinderFitter::Initial(const LabelledScan& scan,
                                                const Segment& segment) const {
  CheckPixels(scan, segment);
  return SegmentFit(scan, segment, config_).Initial();
}

}  // namespace dendro
