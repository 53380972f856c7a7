#include "dendro_slam/range_image/projector.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "dendro_slam/sensors/vlp16_model.h"

namespace dendro {

namespace {

using vlp16::kDegToRad;

constexpr double kBinDeg = 0.005;  // A packet's azimuths have 0.01 degrees.
constexpr int kBins = 72000;
constexpr int kSpeedSlots = 128;
// Azimuths on a column's border must not scatter over both columns by the rounding of floats.
constexpr double kBorderColumns = 0.002;
constexpr double kLagColumns = 0.3;   // How far a firing may lie beyond its column.
constexpr double kLongestStepS = 0.012;  // A quarter of a revolution at 1200 rpm.
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

// Difference brought into (-180, 180].
double WrapDifferenceDeg(double difference) {
  return difference - 360.0 * std::ceil((difference - 180.0) / 360.0);
}

}  // namespace

void ProjectorConfig::Validate() const {
  if (model != "vlp16" && model != "uniform") {
    throw std::invalid_argument("model must be vlp16 or uniform, not '" + model + "'");
  }
  if (model == "vlp16" && rows != vlp16::kLasers) {
    throw std::invalid_argument("rows must be 16 with the vlp16 model");
  }
  if (rows < 1 || rows > 1024) throw std::invalid_argument("rows must be in [1, 1024]");
  if (cols < 8 || cols > 20000) throw std::invalid_argument("cols must be in [8, 20000]");
  if (!(rpm >= 60.0 && rpm <= 6000.0)) throw std::invalid_argument("rpm must be in [60, 6000]");
  if (!(elevation_min_deg >= -90.0 && elevation_min_deg < elevation_max_deg)) {
    throw std::invalid_argument("elevation_min_deg must be in [-90, elevation_max_deg)");
  }
  if (!(elevation_max_deg <= 90.0)) {
    throw std::invalid_argument("elevation_max_deg must be at most 90");
  }
  if (!(min_range_m >= 0.0)) throw std::invalid_argument("min_range_m must be at least 0");
  if (!(max_range_m > min_range_m) || !std::isfinite(max_range_m)) {
    throw std::invalid_argument("max_range_m must be finite and above min_range_m");
  }
}

Projector::Projector(const ProjectorConfig& config) : config_(config) {
  config_.Validate();
  vlp16_ = config_.model == "vlp16";
}

double Projector::RowElevationDeg(int row) const {
  if (vlp16_) return vlp16::RingElevationDeg(row);
  if (config_.rows == 1) return 0.5 * (config_.elevation_min_deg + config_.elevation_max_deg);
  return config_.elevation_min_deg +
         row * (config_.elevation_max_deg - config_.elevation_min_deg) / (config_.rows - 1);
}

double Projector::BeamOriginZ(int row) const {
  return vlp16_ && config_.vertical_offsets ? vlp16::RingVerticalOffsetM(row) : 0.0;
}

double Projector::RowTimeS(int row) const { return vlp16_ ? vlp16::RingTimeS(row) : 0.0; }

int Projector::RowOf(const LidarPoint& point, bool has_ring) const {
  if (vlp16_ && has_ring) return point.ring < vlp16::kLasers ? point.ring : -1;
  const Eigen::Vector3d p = point.position.cast<double>();
  const double horizontal = std::hypot(p.x(), p.y());
  const double lowest = RowElevationDeg(0);
  const double step = config_.rows > 1 ? RowElevationDeg(1) - lowest
                                       : config_.elevation_max_deg - config_.elevation_min_deg;
  const auto row_at = [&](double origin_z) {
    return (std::atan2(p.z() - origin_z, horizontal) / kDegToRad - lowest) / step;
  };
  double row = row_at(0.0);
  // The beam's height depends on the ring that is sought; near the sensor it decides.
  if (vlp16_ && row > -3.0 && row < config_.rows + 2.0) {
    const int guess = std::clamp(static_cast<int>(std::lround(row)), 0, config_.rows - 1);
    row = row_at(BeamOriginZ(guess));
  }
  if (!(row >= -0.5 && row < config_.rows - 0.5)) return -1;
  return std::clamp(static_cast<int>(std::lround(row)), 0, config_.rows - 1);
}

void Projector::MeasurePoints(const LidarScan& scan) {
  work_.resize(scan.points.size());
  for (std::size_t i = 0; i < scan.points.size(); ++i) {
    const LidarPoint& point = scan.points[i];
    PointWork& work = work_[i];
    work = PointWork{0.0, 0.0F, -1, -1};
    if (!point.position.allFinite() || point.position.isZero(0.0F) ||
        (scan.has_time && !std::isfinite(point.time_s))) {
      ++report_.nan_points;
      continue;
    }
    const int row = RowOf(point, scan.has_ring);
    if (row >= 0) {
      const Eigen::Vector3d p = point.position.cast<double>();
      const double range = (p - Eigen::Vector3d(0.0, 0.0, BeamOriginZ(row))).norm();
      if (range >= config_.min_range_m && range <= config_.max_range_m) {
        work.row = row;
        work.range = static_cast<float>(range);
        work.azimuth_deg = vlp16::AzimuthDegOf(p.x(), p.y());
        continue;
      }
    }
    ++report_.out_of_image;
  }
}

// The head turns evenly, so azimuths at two moments less than half a revolution apart give its
// speed. The sum over many such steps is as exact as the whole sweep.
void Projector::EstimateSpeed(const LidarScan& scan) {
  rate_deg_per_s_ = vlp16::AzimuthRateDegPerS(config_.rpm);
  if (!report_.time_derived) {
    double begin = std::numeric_limits<double>::infinity();
    double end = -begin;
    for (std::size_t i = 0; i < work_.size(); ++i) {
      if (work_[i].row < 0) continue;
      begin = std::min(begin, static_cast<double>(scan.points[i].time_s));
      end = std::max(end, static_cast<double>(scan.points[i].time_s));
    }
    std::array<std::int32_t, kSpeedSlots> first;
    first.fill(-1);
    if (end > begin) {
      for (std::size_t i = 0; i < work_.size(); ++i) {
        if (work_[i].row < 0) continue;
        const double u = (scan.points[i].time_s - begin) / (end - begin);
        std::int32_t& slot = first[static_cast<std::size_t>(
            std::min(static_cast<int>(u * kSpeedSlots), kSpeedSlots - 1))];
        if (slot < 0) slot = static_cast<std::int32_t>(i);
      }
    }
    std::array<double, kSpeedSlots> angle;
    std::array<double, kSpeedSlots> duration;
    std::array<double, kSpeedSlots> rate;
    std::size_t steps = 0;
    std::int32_t previous = -1;
    for (const std::int32_t current : first) {
      if (current < 0) continue;
      if (previous >= 0) {
        const std::size_t a = static_cast<std::size_t>(previous);
        const std::size_t b = static_cast<std::size_t>(current);
        const double dt = static_cast<double>(scan.points[b].time_s) - scan.points[a].time_s;
        if (dt > 0.0 && dt < kLongestStepS) {
          angle[steps] = WrapDifferenceDeg(work_[b].azimuth_deg - work_[a].azimuth_deg);
          duration[steps] = dt;
          rate[steps] = angle[steps] / dt;
          ++steps;
        }
      }
      previous = current;
    }
    if (steps > 0) {
      std::array<double, kSpeedSlots> sorted = rate;
      const auto middle = sorted.begin() + static_cast<std::ptrdiff_t>(steps / 2);
      std::nth_element(sorted.begin(), middle,
                       sorted.begin() + static_cast<std::ptrdiff_t>(steps));
      double sum_angle = 0.0;
      double sum_duration = 0.0;
      for (std::size_t i = 0; i < steps; ++i) {
        if (std::abs(rate[i] - *middle) > 0.1 * std::abs(*middle)) continue;
        sum_angle += angle[i];
        sum_duration += duration[i];
      }
      const double estimate = sum_duration > 0.0 ? sum_angle / sum_duration : 0.0;
      // Far from what the sensor can do, the times are not firing times.
      if (estimate >= vlp16::AzimuthRateDegPerS(0.8 * vlp16::kMinRpm) &&
          estimate <= vlp16::AzimuthRateDegPerS(1.25 * vlp16::kMaxRpm)) {
        rate_deg_per_s_ = estimate;
      }
    }
  }
  report_.rpm = rate_deg_per_s_ / 6.0;
  pitch_deg_ = vlp16_ ? rate_deg_per_s_ * vlp16::kFiringPeriodS : 360.0 / config_.cols;
}

// Times from azimuths, for clouds without them. The sweep starts at the first return of the cloud;
// each row is unwrapped on its own, so that clouds ordered by ring work too.
void Projector::DeriveTimes(const LidarScan& scan) {
  time_s_.resize(scan.points.size());
  if (!report_.time_derived) {
    for (std::size_t i = 0; i < scan.points.size(); ++i) {
      time_s_[i] = static_cast<double>(scan.points[i].time_s);
    }
    return;
  }
  double start = std::numeric_limits<double>::quiet_NaN();
  std::array<double, 1024> last_of_row;
  last_of_row.fill(0.0);
  double end_angle = 0.0;
  for (std::size_t i = 0; i < work_.size(); ++i) {
    time_s_[i] = 0.0;
    if (work_[i].row < 0) continue;
    if (std::isnan(start)) start = work_[i].azimuth_deg;
    double& last = last_of_row[static_cast<std::size_t>(work_[i].row)];
    double step = std::fmod(work_[i].azimuth_deg - start - last, 360.0);
    if (step < -30.0) step += 360.0;   // A small step back is disorder, not a revolution.
    if (step >= 330.0) step -= 360.0;
    last += step;
    time_s_[i] = last / rate_deg_per_s_;
    end_angle = std::max(end_angle, last);
  }
  if (config_.untimed_stamp_at_end) {
    for (double& time : time_s_) time -= end_angle / rate_deg_per_s_;
  }
}

void Projector::GroupFirings() {
  bins_.assign(kBins, 0);
  for (PointWork& work : work_) {
    if (work.row < 0) continue;
    work.azimuth_deg =
        vlp16::WrapAzimuthDeg(work.azimuth_deg - rate_deg_per_s_ * RowTimeS(work.row));
    bins_[static_cast<std::size_t>(
        std::min(static_cast<int>(work.azimuth_deg / kBinDeg), kBins - 1))] = 1;
  }
  // Begin after a stretch without returns, so that no firing is cut at azimuth 0.
  const int half_pitch = std::max(1, static_cast<int>(0.5 * pitch_deg_ / kBinDeg));
  int begin = 0;
  for (int bin = 0, empty = 0; bin < kBins; ++bin) {
    empty = bins_[static_cast<std::size_t>(bin)] != 0 ? 0 : empty + 1;
    if (empty >= half_pitch) {
      begin = (bin + 1) % kBins;
      break;
    }
  }
  firings_.clear();
  int firing_begin = -kBins;
  for (int k = 0; k < kBins; ++k) {
    std::int32_t& bin = bins_[static_cast<std::size_t>((begin + k) % kBins)];
    if (bin == 0) continue;
    if (k - firing_begin > half_pitch) {
      firing_begin = k;
      firings_.push_back(Firing{0.0, 0.0, 0, 0});
    }
    bin = static_cast<std::int32_t>(firings_.size());
  }
  const double begin_deg = begin * kBinDeg;
  for (std::size_t i = 0; i < work_.size(); ++i) {
    PointWork& work = work_[i];
    if (work.row < 0) continue;
    const int bin = std::min(static_cast<int>(work.azimuth_deg / kBinDeg), kBins - 1);
    work.firing = bins_[static_cast<std::size_t>(bin)] - 1;
    Firing& firing = firings_[static_cast<std::size_t>(work.firing)];
    if (firing.count == 0) firing.time_s = time_s_[i] - RowTimeS(work.row);
    // Unwrapped from `begin`; the running sum becomes the mean below.
    firing.azimuth_deg += work.azimuth_deg + (bin < begin ? 360.0 : 0.0) - begin_deg;
    ++firing.count;
  }
  for (Firing& firing : firings_) {
    firing.azimuth_deg = firing.azimuth_deg / firing.count + begin_deg;
  }
  report_.firings = static_cast<int>(firings_.size());
}

// The uniform model: the occupied columns stand in for the firings.
void Projector::GroupColumns() {
  bins_.assign(static_cast<std::size_t>(config_.cols), 0);
  const auto column_of = [this](const PointWork& work) {
    return static_cast<std::size_t>(
        static_cast<int>(std::floor(work.azimuth_deg / pitch_deg_ + kBorderColumns)) %
        config_.cols);
  };
  for (const PointWork& work : work_) {
    if (work.row >= 0) bins_[column_of(work)] = 1;
  }
  firings_.clear();
  for (int c = 0; c < config_.cols; ++c) {
    std::int32_t& bin = bins_[static_cast<std::size_t>(c)];
    if (bin == 0) continue;
    firings_.push_back(Firing{(c + 0.5) * pitch_deg_, 0.0, 0, c});
    bin = static_cast<std::int32_t>(firings_.size());
  }
  for (std::size_t i = 0; i < work_.size(); ++i) {
    PointWork& work = work_[i];
    if (work.row < 0) continue;
    work.firing = bins_[column_of(work)] - 1;
    Firing& firing = firings_[static_cast<std::size_t>(work.firing)];
    if (firing.count++ == 0) firing.time_s = time_s_[i];
  }
}

void Projector::PlaceFirings() {
  const double per_deg = config_.cols / 360.0;
  for (std::size_t i = 0; i < firings_.size(); ++i) {
    Firing& firing = firings_[i];
    const double x = firing.azimuth_deg * per_deg;
    firing.col = static_cast<std::int32_t>(std::floor(x + kBorderColumns));
    if (i == 0) continue;
    // Where noise steps over a column, the firing takes it although it lies a little beyond; the
    // next column with two firings makes up for it.
    const Firing& before = firings_[i - 1];
    const bool consecutive = firing.azimuth_deg - before.azimuth_deg < 1.5 * pitch_deg_;
    if (consecutive && firing.col == before.col + 2 && x - firing.col < kLagColumns) --firing.col;
  }
}

void Projector::CompleteColumns() {
  const double width = 360.0 / config_.cols;
  columns_.resize(static_cast<std::size_t>(config_.cols));
  for (int c = 0; c < config_.cols; ++c) {
    columns_[static_cast<std::size_t>(c)] = Column{(c + 0.5) * width, 0.0, -1};
  }
  const int n = static_cast<int>(firings_.size());
  if (n == 0) return;
  const auto column = [this](int col) -> Column& {
    return columns_[static_cast<std::size_t>(((col % config_.cols) + config_.cols) %
                                             config_.cols)];
  };
  for (int i = 0; i < n; ++i) {
    const Firing& a = firings_[static_cast<std::size_t>(i)];
    const bool wraps = i + 1 == n;
    const Firing& b = firings_[static_cast<std::size_t>(wraps ? 0 : i + 1)];
    const int b_col = b.col + (wraps ? config_.cols : 0);
    const double gap = b.azimuth_deg + (wraps ? 360.0 : 0.0) - a.azimuth_deg;

    // Of two firings in one column, the one nearer to its centre is kept for the misses.
    const bool shared_before =
        i > 0 && firings_[static_cast<std::size_t>(i) - 1].col == a.col;
    const double centre = (a.col + 0.5) * width;
    Column& own = column(a.col);
    if (!shared_before || std::abs(a.azimuth_deg - centre) < std::abs(own.azimuth_deg - centre)) {
      own.azimuth_deg = a.azimuth_deg;
      own.time_s = a.time_s;
    }

    // The head fired steadily in between, whether or not something came back.
    const int steps = std::max(1, static_cast<int>(std::lround(gap / pitch_deg_)));
    const double step = gap / steps;
    for (int c = a.col + 1; c < b_col; ++c) {
      Column& missed = column(c);
      if (steps == 1) {
        missed.fill_from = ((c - a.col <= b_col - c ? a.col : b_col) % config_.cols +
                            config_.cols) % config_.cols;
        ++report_.filled_columns;
        continue;
      }
      const double from_a = ((c + 0.5) * width - a.azimuth_deg) / step;
      const int k = std::clamp(static_cast<int>(std::lround(from_a)), 1, steps - 1);
      missed.azimuth_deg = a.azimuth_deg + k * step;
      missed.time_s = 2 * k <= steps ? a.time_s + k * step / rate_deg_per_s_
                                     : b.time_s - (steps - k) * step / rate_deg_per_s_;
    }
  }
}

void Projector::FillImage(const LidarScan& scan, const SweepMotion* motion, RangeImage& out) {
  const std::size_t size =
      static_cast<std::size_t>(config_.rows) * static_cast<std::size_t>(config_.cols);
  out.stamp_ns = scan.stamp_ns;
  out.rows = config_.rows;
  out.cols = config_.cols;
  out.deskewed = motion != nullptr;
  out.point.assign(size, Eigen::Vector3f::Constant(kNan));
  out.range.assign(size, kNan);
  out.intensity.assign(size, 0.0F);
  out.time_s.resize(size);
  out.beam_origin.resize(size);
  out.beam_direction.resize(size);
  out.point_index.assign(size, -1);
  out.pixel_of_point.assign(scan.points.size(), -1);

  for (std::size_t i = 0; i < work_.size(); ++i) {
    const PointWork& work = work_[i];
    if (work.row < 0) continue;
    const int col = out.WrapColumn(firings_[static_cast<std::size_t>(work.firing)].col);
    const std::size_t pixel = out.Index(work.row, col);
    out.pixel_of_point[i] = static_cast<std::int32_t>(pixel);
    if (out.point_index[pixel] >= 0) {
      ++report_.hidden_points;
      if (work.range >= out.range[pixel]) continue;
    }
    out.point_index[pixel] = static_cast<std::int32_t>(i);
    out.range[pixel] = work.range;
  }

  for (int row = 0; row < config_.rows; ++row) {
    const double elevation = RowElevationDeg(row) * kDegToRad;
    const double cos_elevation = std::cos(elevation);
    const double sin_elevation = std::sin(elevation);
    const double delay = RowTimeS(row);
    const double turn = rate_deg_per_s_ * delay;
    const Eigen::Vector3d origin(0.0, 0.0, BeamOriginZ(row));
    for (int col = 0; col < config_.cols; ++col) {
      const Column& column = columns_[static_cast<std::size_t>(col)];
      const std::size_t pixel = out.Index(row, col);
      const std::int32_t index = out.point_index[pixel];
      Eigen::Vector3d direction;
      double time;
      if (index >= 0) {
        const LidarPoint& p = scan.points[static_cast<std::size_t>(index)];
        direction = (p.position.cast<double>() - origin).normalized();
        time = time_s_[static_cast<std::size_t>(index)];
        out.intensity[pixel] = p.intensity;
        out.point[pixel] = p.position;
      } else {
        const double azimuth = (column.azimuth_deg + turn) * kDegToRad;
        direction = {cos_elevation * std::cos(azimuth), -cos_elevation * std::sin(azimuth),
                     sin_elevation};
        time = column.time_s + delay;
      }
      out.time_s[pixel] = static_cast<float>(time);
      if (motion == nullptr) {
        out.beam_origin[pixel] = origin.cast<float>();
        out.beam_direction[pixel] = direction.cast<float>();
        continue;
      }
      const Eigen::Isometry3d T_stamp_t = motion->At(time);
      out.beam_origin[pixel] = (T_stamp_t * origin).cast<float>();
      out.beam_direction[pixel] = (T_stamp_t.linear() * direction).cast<float>();
      if (index >= 0) {
        out.point[pixel] = (T_stamp_t * out.point[pixel].cast<double>()).cast<float>();
      }
    }
  }

  for (int col = 0; col < config_.cols; ++col) {
    const int from = columns_[static_cast<std::size_t>(col)].fill_from;
    if (from < 0) continue;
    for (int row = 0; row < config_.rows; ++row) {
      const std::size_t target = out.Index(row, col);
      const std::size_t source = out.Index(row, from);
      out.point[target] = out.point[source];
      out.range[target] = out.range[source];
      out.intensity[target] = out.intensity[source];
      out.time_s[target] = out.time_s[source];
      out.beam_origin[target] = out.beam_origin[source];
      out.beam_direction[target] = out.beam_direction[source];
      out.point_index[target] = out.point_index[source];
    }
  }
}

void Projector::Project(const LidarScan& scan, const SweepMotion* motion, RangeImage& out) {
  report_ = ProjectionReport();
  report_.ring_derived = vlp16_ && !scan.has_ring;
  // Times that are all the same are no firing times.
  bool has_time = false;
  if (scan.has_time) {
    const std::pair<double, double> span = ScanTimeSpan(scan);
    has_time = span.second > span.first;
  }
  report_.time_derived = !has_time && !scan.points.empty();
  MeasurePoints(scan);
  EstimateSpeed(scan);
  DeriveTimes(scan);
  if (vlp16_) {
    GroupFirings();
    PlaceFirings();
  } else {
    GroupColumns();
  }
  CompleteColumns();
  FillImage(scan, motion, out);
}

RangeImage Projector::Project(const LidarScan& scan, const SweepMotion* motion) {
  RangeImage out;
  Project(scan, motion, out);
  return out;
}

}  // namespace dendro
