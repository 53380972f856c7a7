#include "dendro_slam/branch_separation/branch_separator.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>

namespace dendro {
namespace {

constexpr double kDegree = 0.017453292519943295;
// How many rows back a trunk's direction and width are read from.
constexpr std::size_t kHistoryRows = 4;

void Require(bool ok, const char* field, const char* rule) {
  if (!ok) {
    throw std::invalid_argument(std::string("BranchSeparatorConfig.") + field + " must be " + rule);
  }
}

// A stretch of wood within one row. Columns are unwrapped: `last` may pass the image's width.
struct Run {
  int row = 0;
  int first = 0;
  int last = 0;
  std::vector<std::int32_t> pixels;  // In column order.
  Eigen::Vector3d centre = Eigen::Vector3d::Zero();
  double range = 0.0;
  int width() const { return last - first + 1; }
};

// What a track is expected to show in a row, in unwrapped columns.
struct Expectation {
  double centre = 0.0;
  double width = 0.0;
  double range = 0.0;
  int rows = 0;  // Rows of history behind it.
  double left() const { return centre - 0.5 * (width - 1.0); }
  double right() const { return centre + 0.5 * (width - 1.0); }
};

// A growing instance: its runs, one or more per row, rows ascending.
struct Track {
  std::vector<Run> runs;
  int last_row() const { return runs.back().row; }
};

class Separation {
 public:
  Separation(const LabelledScan& scan, const BranchSeparatorConfig& config)
      : scan_(scan), image_(scan.image), config_(config) {
    column_angle_ = image_.cols > 0 ? 2.0 * M_PI / image_.cols : 0.0;
    max_run_tan_ = std::tan(config.max_incidence_deg * kDegree);
    max_row_tan_ = std::tan(config.max_row_tilt_deg * kDegree);
  }

  std::vector<Segment> Adaptive();
  std::vector<Segment> Thesis() const;

 private:
  bool Usable(std::size_t pixel) const {
    return scan_.IsWood(pixel) && image_.HasReturn(pixel) && image_.point[pixel].allFinite();
  }
  Eigen::Vector3d Point(std::int32_t pixel) const {
    return image_.point[static_cast<std::size_t>(pixel)].cast<double>();
  }
  double Range(std::int32_t pixel) const {
    const auto i = static_cast<std::size_t>(pixel);
    return (image_.point[i] - image_.beam_origin[i]).cast<double>().norm();
  }
  std::int32_t Pixel(int row, int unwrapped_col) const {
    return static_cast<std::int32_t>(image_.Index(row, image_.WrapColumn(unwrapped_col)));
  }
  // d_thresh between two returns of one row, `gap` columns apart.
  double Threshold(double range, int gap) const {
    if (!config_.adaptive_threshold) return config_.constant_threshold_m;
    const double lateral = range * column_angle_ * gap;
    const double along = 4.0 * config_.range_sigma_m + lateral * max_run_tan_;
    return std::hypot(lateral, along);
  }
  void Summarise(Run* run) const;
  std::vector<Run> RunsOfRow(int row) const;
  // Spacing in space between two rows at a range, near a column.
  double RowSpacing(int row_a, int row_b, int col, double range) const;
  int Align(int column, double reference) const {
    const double turns = std::round((reference - column) / image_.cols);
    return column + static_cast<int>(turns) * image_.cols;
  }
  Expectation Expect(const Track& track, int row) const;
  double MinDistance(const Run& a, const Run& b) const;
  Run Shifted(const Run& run, double reference) const;
  Run Part(const Run& run, int first, int last) const;
  std::vector<Run> CutAtForks(std::vector<Run> runs, int row) const;
  bool CloserBeside(const Run& run, int side) const;
  bool BoundedByCloser(const Run& run) const { return CloserBeside(run, -1) || CloserBeside(run, 1); }
  bool WasHidden(const Track& track, int side) const;
  bool WasHidden(const Track& track) const { return WasHidden(track, -1) || WasHidden(track, 1); }
  bool HiddenBetween(const Run& a, const Run& b) const;
  void Assign(std::vector<Run> runs, int row);
  void ReleaseExcess();
  void CutTrack(const std::vector<Run>& runs, std::vector<std::vector<Run>>* pieces) const;

  const LabelledScan& scan_;
  const RangeImage& image_;
  const BranchSeparatorConfig& config_;
  double column_angle_ = 0.0;
  double max_run_tan_ = 0.0;
  double max_row_tan_ = 0.0;
  std::vector<Track> tracks_;
};

void Separation::Summarise(Run* run) const {
  run->centre.setZero();
  run->range = 0.0;
  for (const std::int32_t pixel : run->pixels) {
    run->centre += Point(pixel);
    run->range += Range(pixel);
  }
  const double n = static_cast<double>(run->pixels.size());
  run->centre /= n;
  run->range /= n;
}

// The thesis' two pointers (Algorithm 2), with a tolerance to missing pixels and the wrap-around.
std::vector<Run> Separation::RunsOfRow(int row) const {
  std::vector<Run> runs;
  const int reach = config_.max_missing_pixels + 1;
  for (int c = 0; c < image_.cols; ++c) {
    const std::int32_t pixel = Pixel(row, c);
    if (!Usable(static_cast<std::size_t>(pixel))) continue;
    bool same = false;
    if (!runs.empty() && c - runs.back().last <= reach) {
      const std::int32_t previous = runs.back().pixels.back();
      const double threshold =
          Threshold(std::min(Range(previous), Range(pixel)), c - runs.back().last);
      same = (Point(previous) - Point(pixel)).norm() < threshold;
    }
    if (!same) {
      runs.emplace_back();
      runs.back().row = row;
      runs.back().first = c;
    }
    runs.back().last = c;
    runs.back().pixels.push_back(pixel);
  }
  if (runs.size() > 1) {  // Column 0 continues the last column.
    Run& tail = runs.back();
    Run& head = runs.front();
    const int gap = head.first + image_.cols - tail.last;
    if (gap <= reach) {
      const double threshold =
          Threshold(std::min(Range(tail.pixels.back()), Range(head.pixels.front())), gap);
      if ((Point(tail.pixels.back()) - Point(head.pixels.front())).norm() < threshold) {
        tail.last = head.last + image_.cols;
        tail.pixels.insert(tail.pixels.end(), head.pixels.begin(), head.pixels.end());
        runs.erase(runs.begin());
      }
    }
  }
  for (Run& run : runs) Summarise(&run);
  return runs;
}

double Separation::RowSpacing(int row_a, int row_b, int col, double range) const {
  const Eigen::Vector3f& a = image_.beam_direction[static_cast<std::size_t>(Pixel(row_a, col))];
  const Eigen::Vector3f& b = image_.beam_direction[static_cast<std::size_t>(Pixel(row_b, col))];
  const double angle = static_cast<double>((a - b).norm());
  return std::isfinite(angle) ? range * angle : 0.0;
}

Expectation Separation::Expect(const Track& track, int row) const {
  // Extents per row, newest first, in the columns of the newest.
  double row_of[kHistoryRows] = {}, first[kHistoryRows] = {}, last[kHistoryRows] = {},
         range[kHistoryRows] = {};
  std::size_t n = 0;
  const double reference = 0.5 * (track.runs.back().first + track.runs.back().last);
  for (auto it = track.runs.rbegin(); it != track.runs.rend(); ++it) {
    const int shift = Align(it->first, reference) - it->first;
    if (n > 0 && row_of[n - 1] == it->row) {
      first[n - 1] = std::min(first[n - 1], static_cast<double>(it->first + shift));
      last[n - 1] = std::max(last[n - 1], static_cast<double>(it->last + shift));
      range[n - 1] = std::min(range[n - 1], it->range);
      continue;
    }
    if (n == kHistoryRows) break;
    row_of[n] = it->row;
    first[n] = it->first + shift;
    last[n] = it->last + shift;
    range[n] = it->range;
    ++n;
  }
  double mean_row = 0.0, mean_col = 0.0, mean_range = 0.0;
  for (std::size_t i = 0; i < n; ++i) {
    mean_row += row_of[i];
    mean_col += 0.5 * (first[i] + last[i]);
    mean_range += range[i];
  }
  const double count = static_cast<double>(n);
  mean_row /= count;
  mean_col /= count;
  mean_range /= count;
  double rr = 0.0, rc = 0.0, rd = 0.0;
  double widths[kHistoryRows] = {};
  for (std::size_t i = 0; i < n; ++i) {
    const double dr = row_of[i] - mean_row;
    rr += dr * dr;
    rc += dr * (0.5 * (first[i] + last[i]) - mean_col);
    rd += dr * (range[i] - mean_range);
    widths[i] = last[i] - first[i] + 1.0;
  }
  std::sort(widths, widths + n);
  Expectation e;
  e.rows = static_cast<int>(n);
  e.width = n % 2 == 1 ? widths[n / 2] : 0.5 * (widths[n / 2 - 1] + widths[n / 2]);
  e.centre = mean_col + (rr > 0.0 ? rc / rr * (row - mean_row) : 0.0);
  e.range = mean_range + (rr > 0.0 ? rd / rr * (row - mean_row) : 0.0);
  return e;
}

double Separation::MinDistance(const Run& a, const Run& b) const {
  double best = std::numeric_limits<double>::infinity();
  for (const std::int32_t p : a.pixels) {
    const Eigen::Vector3d point = Point(p);
    for (const std::int32_t q : b.pixels) {
      best = std::min(best, (point - Point(q)).squaredNorm());
    }
  }
  return std::sqrt(best);
}

Run Separation::Shifted(const Run& run, double reference) const {
  Run out = run;
  out.first = Align(run.first, reference - 0.5 * (run.last - run.first));
  out.last = out.first + run.last - run.first;
  return out;
}

Run Separation::Part(const Run& run, int first, int last) const {
  Run part;
  part.row = run.row;
  part.first = std::numeric_limits<int>::max();
  for (const std::int32_t pixel : run.pixels) {
    const int col =
        run.first + image_.WrapColumn(static_cast<int>(pixel) % image_.cols - run.first);
    if (col < first || col > last) continue;
    part.first = std::min(part.first, col);
    part.last = col;
    part.pixels.push_back(pixel);
  }
  if (!part.pixels.empty()) Summarise(&part);
  return part;
}

// Where a branch leaves or joins a trunk both are one run. The trunk's own columns are known from
// the rows below, so the run is cut there.
std::vector<Run> Separation::CutAtForks(std::vector<Run> runs, int row) const {
  std::vector<Run> out;
  for (Run& run : runs) {
    struct Inside {
      Expectation e;
      const Track* track;
    };
    std::vector<Inside> inside;
    for (const Track& track : tracks_) {
      if (track.last_row() < row - 1 - config_.max_missing_rows) continue;
      Expectation e = Expect(track, row);
      if (e.rows < 2) continue;
      const double centre = 0.5 * (run.first + run.last);
      e.centre += std::round((centre - e.centre) / image_.cols) * image_.cols;
      const double overlap = std::min(e.right(), static_cast<double>(run.last)) -
                             std::max(e.left(), static_cast<double>(run.first)) + 1.0;
      const double spacing = RowSpacing(row, track.last_row(), run.first, run.range);
      const bool deep = std::abs(e.range - run.range) >
                        spacing * max_row_tan_ + 4.0 * config_.range_sigma_m + e.width * 0.5 *
                        run.range * column_angle_;
      if (overlap < 0.5 * e.width || deep) continue;
      inside.push_back({e, &track});
    }
    if (inside.empty()) {
      out.push_back(std::move(run));
      continue;
    }
    std::sort(inside.begin(), inside.end(),
              [](const Inside& a, const Inside& b) { return a.e.centre < b.e.centre; });
    double expected_width = 0.0;
    for (const Inside& i : inside) expected_width += i.e.width;
    std::vector<int> cuts;  // A cut c separates columns c-1 and c.
    const bool wide = run.width() > config_.fork_width_ratio * expected_width;
    const int excess_left = static_cast<int>(std::floor(inside.front().e.left() - 1.0)) - run.first;
    const int excess_right = run.last - static_cast<int>(std::ceil(inside.back().e.right() + 1.0));
    // What a nearer branch uncovers row by row is no fork: neither the ends of the rows before were the
    // track's own nor was its course.
    if (wide && excess_left >= config_.fork_min_excess_pixels && !WasHidden(*inside.front().track)) {
      cuts.push_back(run.first + excess_left);
    }
    for (std::size_t i = 1; i < inside.size(); ++i) {
      // Two sides of one trunk that come together where a nearer branch ends.
      if (WasHidden(*inside[i - 1].track, 1) && WasHidden(*inside[i].track, -1)) continue;
      const int cut =
          static_cast<int>(std::lround(0.5 * (inside[i - 1].e.right() + inside[i].e.left()) + 0.5));
      if (cut > run.first && cut <= run.last && (cuts.empty() || cut > cuts.back())) {
        cuts.push_back(cut);
      }
    }
    if (wide && excess_right >= config_.fork_min_excess_pixels && !WasHidden(*inside.back().track)) {
      const int cut = run.last - excess_right + 1;
      if (cuts.empty() || cut > cuts.back()) cuts.push_back(cut);
    }
    int first = run.first;
    for (const int cut : cuts) {
      Run part = Part(run, first, cut - 1);
      if (!part.pixels.empty()) out.push_back(std::move(part));
      first = cut;
    }
    if (cuts.empty()) {
      out.push_back(std::move(run));
    } else {
      Run part = Part(run, first, run.last);
      if (!part.pixels.empty()) out.push_back(std::move(part));
    }
  }
  return out;
}

// True when a nearer surface may hide the rest of the run on a side: -1 before its first column, 1
// behind its last.
bool Separation::CloserBeside(const Run& run, int side) const {
  const std::int32_t beside = Pixel(run.row, side < 0 ? run.first - 1 : run.last + 1);
  const auto pixel = static_cast<std::size_t>(beside);
  return image_.HasReturn(pixel) && image_.point[pixel].allFinite() &&
         Range(beside) < run.range - 4.0 * config_.range_sigma_m;
}

// True when one of the rows that Expect() reads from was hidden on a side: its end there is not the
// track's.
bool Separation::WasHidden(const Track& track, int side) const {
  std::size_t rows = 0;
  for (auto it = track.runs.rbegin(); it != track.runs.rend(); ++it) {
    rows += it == track.runs.rbegin() || std::prev(it)->row != it->row;
    if (rows > kHistoryRows) break;
    if (CloserBeside(*it, side)) return true;
  }
  return false;
}

// True when nearer surfaces fill most of the gap between two runs of one row: behind them the two
// may be one. A gap that shows the background is one between two branches.
bool Separation::HiddenBetween(const Run& a, const Run& b) const {
  const Run& left = a.first < b.first ? a : b;
  const Run& right = a.first < b.first ? b : a;
  const double nearer = std::min(left.range, right.range) - 4.0 * config_.range_sigma_m;
  int hidden = 0;
  for (int col = left.last + 1; col < right.first; ++col) {
    const std::int32_t pixel = Pixel(a.row, col);
    const auto i = static_cast<std::size_t>(pixel);
    hidden += image_.HasReturn(i) && image_.point[i].allFinite() && Range(pixel) < nearer;
  }
  return hidden > 0 && 2 * hidden >= right.first - left.last - 1;
}

void Separation::Assign(std::vector<Run> runs, int row) {
  struct Match {
    double cost;
    std::size_t track;
    std::size_t run;
  };
  std::vector<Match> matches;
  std::vector<Expectation> expectations(tracks_.size());
  std::vector<char> active(tracks_.size(), 0);
  for (std::size_t t = 0; t < tracks_.size(); ++t) {
    const Track& track = tracks_[t];
    if (track.last_row() < row - 1 - config_.max_missing_rows) continue;
    active[t] = 1;
    expectations[t] = Expect(track, row);
    const Expectation& e = expectations[t];
    for (std::size_t i = 0; i < runs.size(); ++i) {
      const Run run = Shifted(runs[i], e.centre);
      const double pixel_m = run.range * column_angle_;
      const double spacing = RowSpacing(row, track.last_row(), run.first, run.range);
      const double noise = 4.0 * config_.range_sigma_m;
      const double limit = std::hypot(spacing, spacing * max_row_tan_) + noise;
      if ((run.centre - track.runs.back().centre).norm() >
          limit + pixel_m * (run.width() + track.runs.back().width())) {
        continue;
      }
      if (MinDistance(run, track.runs.back()) > limit) continue;
      const double across = pixel_m * std::abs(0.5 * (run.first + run.last) - e.centre);
      const double along = std::abs(run.range - e.range);
      const double wider = pixel_m * std::abs(run.width() - e.width);
      const bool hidden = BoundedByCloser(run);
      if (e.rows >= 3 && !hidden) {
        // A trunk that is well known does not jump aside, and does not turn into its branch.
        if (across > 0.5 * pixel_m * e.width + 0.7 * spacing) continue;
        if (e.width >= 6.0 && run.width() < 0.5 * e.width) continue;
      }
      matches.push_back({std::hypot(across, along) + 0.5 * wider, t, i});
    }
  }
  std::stable_sort(matches.begin(), matches.end(),
                   [](const Match& a, const Match& b) { return a.cost < b.cost; });
  std::vector<char> run_used(runs.size(), 0);
  std::vector<char> track_used(tracks_.size(), 0);
  for (const Match& m : matches) {
    if (run_used[m.run] || track_used[m.track]) continue;
    run_used[m.run] = 1;
    track_used[m.track] = 1;
    tracks_[m.track].runs.push_back(Shifted(runs[m.run], expectations[m.track].centre));
  }
  // A trunk hidden in its middle shows two runs in one row; both lie where it is expected.
  for (std::size_t i = 0; i < runs.size(); ++i) {
    if (run_used[i]) continue;
    for (std::size_t t = 0; t < active.size(); ++t) {
      if (!active[t] || !track_used[t] || expectations[t].rows < 2) continue;
      const Expectation& e = expectations[t];
      const Run run = Shifted(runs[i], e.centre);
      if (run.first < e.left() - 1.5 || run.last > e.right() + 1.5) continue;
      const double pixel_m = run.range * column_angle_;
      if (std::abs(run.range - e.range) > 4.0 * config_.range_sigma_m + 0.5 * e.width * pixel_m) {
        continue;
      }
      if (!HiddenBetween(tracks_[t].runs.back(), run)) continue;
      tracks_[t].runs.push_back(run);
      run_used[i] = 1;
      break;
    }
  }
  for (std::size_t i = 0; i < runs.size(); ++i) {
    if (run_used[i]) continue;
    tracks_.emplace_back();
    tracks_.back().runs.push_back(std::move(runs[i]));
  }
}

// Where a branch begins, its first returns hang on its parent's run; rows before and after show how
// wide the parent is and where. What sticks out goes to the branch that goes on there.
void Separation::ReleaseExcess() {
  constexpr int kWindow = 3;
  std::vector<Run> released;
  for (Track& track : tracks_) {
    std::vector<Run>& runs = track.runs;
    const auto count = static_cast<int>(runs.size());
    std::vector<std::pair<int, int>> kept(runs.size());  // First and last column.
    for (int i = 0; i < count; ++i) {
      const Run& run = runs[static_cast<std::size_t>(i)];
      kept[static_cast<std::size_t>(i)] = {run.first, run.last};
      double width[2 * kWindow], centre[2 * kWindow], row[2 * kWindow];
      int n = 0;
      bool alone = true;
      for (int k = std::max(0, i - kWindow); k <= std::min(count - 1, i + kWindow); ++k) {
        if (k == i) continue;
        const Run& other = runs[static_cast<std::size_t>(k)];
        if (other.row == run.row) alone = false;
        if (BoundedByCloser(other)) continue;  // It does not show how wide it is.
        width[n] = other.width() * other.range / run.range;
        centre[n] = 0.5 * (other.first + other.last);
        row[n] = other.row;
        ++n;
      }
      if (n < 2 || !alone) continue;
      double part[2 * kWindow];
      std::copy(width, width + n, part);
      std::nth_element(part, part + n / 2, part + n);
      const double usual =
          n % 2 == 1 ? part[n / 2] : 0.5 * (*std::max_element(part, part + n / 2) + part[n / 2]);
      if (run.width() < config_.excess_width_ratio * usual) continue;
      // The line through the centres of the rows of usual width with the least median distance.
      double best = std::numeric_limits<double>::infinity(), expected = 0.0;
      for (int a = 0; a < n; ++a) {
        for (int b = a + 1; b < n; ++b) {
          if (row[a] == row[b] || width[a] > 1.3 * usual || width[b] > 1.3 * usual) continue;
          const double slope = (centre[b] - centre[a]) / (row[b] - row[a]);
          double off[2 * kWindow];
          for (int k = 0; k < n; ++k) {
            off[k] = std::abs(centre[k] - centre[a] - slope * (row[k] - row[a]));
          }
          std::nth_element(off, off + n / 2, off + n);
          // Of equals the pair around this row.
          const double cost = off[n / 2] + 0.01 * std::abs(row[a] + row[b] - 2.0 * run.row);
          if (cost >= best) continue;
          best = cost;
          expected = centre[a] + slope * (run.row - row[a]);
        }
      }
      if (!(best < 0.5 * usual + 1.0)) continue;
      const int least = config_.excess_min_pixels;
      const int left = static_cast<int>(std::floor(expected - 0.5 * (usual - 1.0) - 0.5));
      const int right = static_cast<int>(std::ceil(expected + 0.5 * (usual - 1.0) + 0.5));
      if (left - run.first >= least && left < run.last) kept[static_cast<std::size_t>(i)].first = left;
      if (run.last - right >= least && right > run.first) kept[static_cast<std::size_t>(i)].second = right;
    }
    for (int i = 0; i < count; ++i) {
      const auto k = static_cast<std::size_t>(i);
      const Run run = runs[k];
      const auto [first, last] = kept[k];
      if (first == run.first && last == run.last) continue;
      Run middle = Part(run, first, last);
      if (middle.pixels.empty()) continue;
      for (Run part : {Part(run, run.first, first - 1), Part(run, last + 1, run.last)}) {
        if (!part.pixels.empty()) released.push_back(std::move(part));
      }
      runs[k] = std::move(middle);
    }
  }
  for (Run& part : released) {
    // The nearest branch that ends in the row before or begins in the row after.
    Track* owner = nullptr;
    double nearest = std::numeric_limits<double>::infinity();
    bool at_end = false;
    for (Track& track : tracks_) {
      for (const bool end : {true, false}) {
        const Run& other = end ? track.runs.back() : track.runs.front();
        const int step = end ? part.row - other.row : other.row - part.row;
        if (step < 1 || step > 1 + config_.max_missing_rows) continue;
        const double spacing = RowSpacing(part.row, other.row, part.first, part.range);
        const double limit =
            std::hypot(spacing, spacing * max_row_tan_) + 4.0 * config_.range_sigma_m;
        const double distance = MinDistance(part, other);
        if (distance > limit || distance >= nearest) continue;
        nearest = distance;
        owner = &track;
        at_end = end;
      }
    }
    if (owner == nullptr) {
      tracks_.emplace_back();
      tracks_.back().runs.push_back(std::move(part));
    } else if (at_end) {
      owner->runs.push_back(Shifted(part, 0.5 * (owner->runs.back().first + owner->runs.back().last)));
    } else {
      owner->runs.insert(
          owner->runs.begin(),
          Shifted(part, 0.5 * (owner->runs.front().first + owner->runs.front().last)));
    }
  }
}

// Cuts a chain of runs until every piece is short and straight enough for one cone.
void Separation::CutTrack(const std::vector<Run>& runs, std::vector<std::vector<Run>>* pieces) const {
  // One node per row.
  std::vector<std::size_t> begin;
  std::vector<Eigen::Vector3d> node;
  std::vector<double> half_width;
  for (std::size_t i = 0; i < runs.size(); ++i) {
    if (begin.empty() || runs[begin.back()].row != runs[i].row) {
      begin.push_back(i);
      node.push_back(runs[i].centre);
      half_width.push_back(0.5 * runs[i].width() * runs[i].range * column_angle_);
    } else {
      node.back() = 0.5 * (node.back() + runs[i].centre);
      half_width.back() = std::max(half_width.back(),
                                   0.5 * runs[i].width() * runs[i].range * column_angle_);
    }
  }
  const auto rows = static_cast<int>(node.size());
  const int keep = config_.min_rows_per_piece;
  std::size_t cut = 0;
  if (rows >= 2 * keep) {
    const Eigen::Vector3d chord = node.back() - node.front();
    const double length = chord.norm();
    double worst = 0.0;
    std::vector<double> widths = half_width;
    std::nth_element(widths.begin(), widths.begin() + rows / 2, widths.end());
    const double allowed =
        std::max(config_.max_bow_m, 0.3 * widths[static_cast<std::size_t>(rows / 2)]);
    if (length > 0.0) {
      for (int i = keep; i <= rows - keep; ++i) {
        const auto k = static_cast<std::size_t>(i);
        const double bow = (node[k] - node.front()).cross(chord).norm() / length;
        if (bow > worst) {
          worst = bow;
          cut = k;
        }
      }
    }
    if (worst <= allowed) {
      cut = 0;
      if (length > config_.max_length_m) {
        // The row nearest to the middle of the stretch.
        const Eigen::Vector3d middle = 0.5 * (node.front() + node.back());
        double best = std::numeric_limits<double>::infinity();
        for (int i = keep; i <= rows - keep; ++i) {
          const double d = (node[static_cast<std::size_t>(i)] - middle).norm();
          if (d < best) {
            best = d;
            cut = static_cast<std::size_t>(i);
          }
        }
      }
    }
  }
  if (cut == 0) {
    pieces->push_back(runs);
    return;
  }
  const auto middle = runs.begin() + static_cast<std::ptrdiff_t>(begin[cut]);
  CutTrack(std::vector<Run>(runs.begin(), middle), pieces);
  CutTrack(std::vector<Run>(middle, runs.end()), pieces);
}

std::vector<Segment> Finish(std::vector<Segment> segments, int min_points) {
  for (Segment& s : segments) std::sort(s.pixels.begin(), s.pixels.end());
  segments.erase(std::remove_if(segments.begin(), segments.end(),
                                [&](const Segment& s) {
                                  return static_cast<int>(s.pixels.size()) < min_points;
                                }),
                 segments.end());
  std::sort(segments.begin(), segments.end(), [](const Segment& a, const Segment& b) {
    return a.pixels.front() < b.pixels.front();
  });
  for (std::size_t i = 0; i < segments.size(); ++i) segments[i].id = static_cast<int>(i);
  return segments;
}

std::vector<Segment> Separation::Adaptive() {
  for (int row = 0; row < image_.rows; ++row) {
    std::vector<Run> runs = RunsOfRow(row);
    if (runs.empty()) continue;
    Assign(CutAtForks(std::move(runs), row), row);
  }
  ReleaseExcess();
  std::vector<Segment> segments;
  std::vector<std::vector<Run>> pieces;
  for (const Track& track : tracks_) {
    pieces.clear();
    CutTrack(track.runs, &pieces);
    for (const std::vector<Run>& piece : pieces) {
      segments.emplace_back();
      for (const Run& run : piece) {
        segments.back().pixels.insert(segments.back().pixels.end(), run.pixels.begin(),
                                      run.pixels.end());
      }
    }
  }
  return Finish(std::move(segments), std::max(1, config_.min_points));
}

// Algorithms 1 and 2 as printed: identity is the count within the row.
std::vector<Segment> Separation::Thesis() const {
  const auto is_new = [&](std::int32_t pt1, std::int32_t pt2) {
    if (pt2 < 0) return false;
    if (pt1 < 0) return true;
    return (Point(pt1) - Point(pt2)).norm() >= config_.constant_threshold_m;
  };
  const auto at = [&](int row, int col) -> std::int32_t {
    const std::size_t pixel = image_.Index(row, col);
    return Usable(pixel) ? static_cast<std::int32_t>(pixel) : -1;
  };
  std::vector<Segment> segments;
  std::size_t queue_begin = 0;  // The queue holds queue_begin, queue_begin + 1, ...
  int previous_count = 0;
  for (int row = 0; row < image_.rows; ++row) {
    int count = 0;
    std::int32_t pt1 = -1;
    for (int c = 0; c < image_.cols; ++c) {
      const std::int32_t pt2 = at(row, c);
      if (is_new(pt1, pt2)) ++count;
      pt1 = pt2;
    }
    if (count == 0) continue;
    if (count != previous_count) {
      queue_begin = segments.size();
      segments.resize(segments.size() + static_cast<std::size_t>(count));
      previous_count = count;
    }
    std::size_t next = queue_begin;
    pt1 = -1;
    for (int c = 0; c < image_.cols; ++c) {
      const std::int32_t pt2 = at(row, c);
      if (is_new(pt1, pt2)) ++next;
      if (pt2 >= 0) segments[next - 1].pixels.push_back(pt2);
      pt1 = pt2;
    }
  }
  return Finish(std::move(segments), 1);
}

}  // namespace

void BranchSeparatorConfig::Validate() const {
  const auto positive = [](double v) { return std::isfinite(v) && v > 0.0; };
  Require(positive(constant_threshold_m), "constant_threshold_m", "> 0");
  Require(std::isfinite(range_sigma_m) && range_sigma_m >= 0.0, "range_sigma_m", ">= 0");
  Require(positive(max_incidence_deg) && max_incidence_deg < 90.0, "max_incidence_deg", "in (0, 90)");
  Require(positive(max_row_tilt_deg) && max_row_tilt_deg < 90.0, "max_row_tilt_deg", "in (0, 90)");
  Require(max_missing_pixels >= 0, "max_missing_pixels", ">= 0");
  Require(max_missing_rows >= 0, "max_missing_rows", ">= 0");
  Require(std::isfinite(fork_width_ratio) && fork_width_ratio > 1.0, "fork_width_ratio", "> 1");
  Require(fork_min_excess_pixels >= 1, "fork_min_excess_pixels", ">= 1");
  Require(std::isfinite(excess_width_ratio) && excess_width_ratio > 1.0, "excess_width_ratio", "> 1");
  Require(excess_min_pixels >= 1, "excess_min_pixels", ">= 1");
  Require(positive(max_length_m), "max_length_m", "> 0");
  Require(positive(max_bow_m), "max_bow_m", "> 0");
  Require(min_rows_per_piece >= 1, "min_rows_per_piece", ">= 1");
  Require(min_points >= 1, "min_points", ">= 1");
}

BranchSeparator::BranchSeparator(const BranchSeparatorConfig& config) : config_(config) {
  config_.Validate();
}

std::vector<Segment> BranchSeparator::Separate(const LabelledScan& scan) const {
  const RangeImage& image = scan.image;
  const std::size_t size = static_cast<std::size_t>(std::max(0, image.rows)) *
                           static_cast<std::size_t>(std::max(0, image.cols));
  if (image.rows < 0 || image.cols < 0 || image.point.size() != size ||
      image.point_index.size() != size || image.beam_origin.size() != size ||
      image.beam_direction.size() != size || scan.label.size() != size) {
    throw std::invalid_argument("LabelledScan: every per-pixel vector must hold rows * cols entries");
  }
  Separation separation(scan, config_);
  return config_.thesis_mode ? separation.Thesis() : separation.Adaptive();
}

}  // namespace dendro
