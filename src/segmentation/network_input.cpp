#include "dendro_slam/segmentation/network_input.h"

#include <algorithm>
#include <cmath>

#include "dendro_slam/segmentation/line_support.h"

namespace dendro {
namespace {

constexpr double kPi = 3.14159265358979323846;

constexpr std::size_t kFirstLinePlane = 14;
constexpr float kBareGround = 0.12F;  // Nearer than this to the ground plane no line is looked for [m].

float Squash(float step, float scale) { return step / (std::abs(step) + scale); }

float Horizontal(const Eigen::Vector3f& p) { return std::hypot(p.x(), p.y()); }

// Mean angle between neighbouring rows.
float RowGap(const RangeImage& image) {
  if (image.rows < 2 || image.cols < 1) return 0.0F;
  const float cosine = image.beam_direction[image.Index(0, 0)].dot(
      image.beam_direction[image.Index(image.rows - 1, 0)]);
  return std::acos(std::clamp(cosine, -1.0F, 1.0F)) / static_cast<float>(image.rows - 1);
}

// Neighbouring returns of a row that lie on one surface, and what the planes say of them.
struct Run {
  float width = 0.0F;
  float brightness = 0.0F;
  float bulge = 0.0F;
  float slant = 0.0F;
  float roughness = 0.0F;
};

// The run of `count` returns of `row` from column `first` on, across azimuth 0 if need be.
Run DescribeRun(const RangeImage& image, int row, int first, int count) {
  const auto pixel = [&](int k) {
    const int col = first + k;
    return image.Index(row, col < image.cols ? col : col - image.cols);
  };
  double sum_range = 0.0;
  double sum_intensity = 0.0;
  for (int k = 0; k < count; ++k) {
    sum_range += image.range[pixel(k)];
    sum_intensity += image.intensity[pixel(k)];
  }
  const double mean_range = sum_range / count;
  Run run;
  const double width = 2.0 * kPi / image.cols * sum_range;
  run.width = static_cast<float>(0.25 * std::log2(std::max(width, 1e-3) / 0.1));
  run.brightness = static_cast<float>(sum_intensity / count / 128.0 - 0.5);
  if (count < 2 || count > image.cols / 8) return run;
  // Line and parabola over u in (-1/2, 1/2): u and u^2 - mean(u^2) are orthogonal.
  const auto place = [count](int k) { return (k - 0.5 * (count - 1)) / count; };
  double uu = 0.0;
  double u_range = 0.0;
  for (int k = 0; k < count; ++k) {
    const double u = place(k);
    uu += u * u;
    u_range += u * (image.range[pixel(k)] - mean_range);
  }
  const double mean_uu = uu / count;
  double vv = 0.0;
  double v_range = 0.0;
  for (int k = 0; k < count; ++k) {
    const double v = place(k) * place(k) - mean_uu;
    vv += v * v;
    v_range += v * (image.range[pixel(k)] - mean_range);
  }
  const double line = count >= 3 ? u_range / uu : 0.0;
  const double parabola = count >= 4 ? v_range / vv : 0.0;
  double squares = 0.0;
  for (int k = 0; k < count; ++k) {
    const double u = place(k);
    const double rest =
        image.range[pixel(k)] - mean_range - line * u - parabola * (u * u - mean_uu);
    squares += rest * rest;
  }
  run.bulge = Squash(static_cast<float>(0.25 * parabola), 0.05F);
  run.slant = Squash(static_cast<float>(std::abs(line)), 0.2F);
  run.roughness = Squash(static_cast<float>(std::sqrt(squares / count)), 0.01F);
  return run;
}

// The runs of a row and for every column the number of its run, -1 where there is no return.
// Where the row begins makes no difference.
void FindRuns(const RangeImage& image, int row, std::vector<Run>* runs, std::vector<int>* run_of) {
  const int cols = image.cols;
  runs->clear();
  run_of->assign(static_cast<std::size_t>(cols), -1);
  const auto has = [&](std::size_t i) { return image.HasReturn(i) && image.range[i] > 0.0F; };
  const auto joined = [&](int col) {  // Is the pixel one run with the next?
    const std::size_t i = image.Index(row, col);
    const std::size_t next = image.Index(row, col + 1 < cols ? col + 1 : 0);
    if (!has(i) || !has(next)) return false;
    const float column_width =
        static_cast<float>(2.0 * kPi) / static_cast<float>(cols) * image.range[i];
    return std::abs(image.range[next] - image.range[i]) <= 0.05F + 2.0F * column_width;
  };
  int start = 0;  // The first column of a run, or any if the whole row is one.
  while (start < cols && joined(start > 0 ? start - 1 : cols - 1)) ++start;
  if (start == cols) start = 0;
  for (int k = 0; k < cols;) {
    const int first = (start + k) % cols;
    if (!has(image.Index(row, first))) {
      ++k;
      continue;
    }
    int count = 1;
    while (k + count < cols && joined((first + count - 1) % cols)) ++count;
    for (int j = 0; j < count; ++j) {
      (*run_of)[static_cast<std::size_t>((first + j) % cols)] = static_cast<int>(runs->size());
    }
    runs->push_back(DescribeRun(image, row, first, count));
    k += count;
  }
}

}  // namespace

std::vector<float> NetworkInput(const RangeImage& image,
                                const std::optional<GroundPlane>& ground,
                                const std::vector<int>& columns) {
  const std::size_t width = columns.size();
  const std::size_t plane = static_cast<std::size_t>(image.rows) * width;
  std::vector<float> planes(kNetworkInputChannels * plane, 0.0F);
  const auto has = [&](std::size_t i) { return image.HasReturn(i) && image.range[i] > 0.0F; };
  LineSupportInput lines;
  lines.rows = image.rows;
  lines.cols = image.cols;
  lines.row_gap_rad = RowGap(image);
  lines.range.assign(image.size(), 0.0F);
  lines.log_width.assign(image.size(), 0.0F);
  lines.wanted.assign(image.size(), 0);
  std::vector<Run> runs;
  std::vector<int> run_of;
  for (int row = 0; row < image.rows; ++row) {
    FindRuns(image, row, &runs, &run_of);
    for (int col = 0; col < image.cols; ++col) {
      const std::size_t pixel = image.Index(row, col);
      if (!has(pixel)) continue;
      lines.range[pixel] = image.range[pixel];
      lines.log_width[pixel] =
          4.0F * runs[static_cast<std::size_t>(run_of[static_cast<std::size_t>(col)])].width;
    }
    for (std::size_t c = 0; c < width; ++c) {
      if (columns[c] < 0) continue;
      const std::size_t pixel = image.Index(row, columns[c]);
      if (!has(pixel)) continue;
      float* out = planes.data() + static_cast<std::size_t>(row) * width + c;
      const Eigen::Vector3f& p = image.point[pixel];
      const float range = image.range[pixel];
      out[0] = 1.0F;
      out[plane] = 0.5F * std::log2(range / 4.0F);
      out[2 * plane] = image.intensity[pixel] / 128.0F - 0.5F;
      if (ground) {
        out[3 * plane] = std::clamp(0.5F * ground->Height(p), -1.0F, 3.0F);
        const Eigen::Vector3f& beam = image.beam_direction[pixel];
        out[4 * plane] = ground->normal.dot(beam);
        // Columns go clockwise seen from above.
        const float horizontal = std::max(Horizontal(beam), 1e-3F);
        out[8 * plane] =
            (ground->normal.x() * beam.y() - ground->normal.y() * beam.x()) / horizontal;
      }
      const std::size_t next = image.Index(row, image.WrapColumn(columns[c] + 1));
      out[5 * plane] = has(next) ? Squash(image.range[next] - range, 0.1F) : 1.0F;
      out[6 * plane] = 1.0F;
      if (row + 1 < image.rows) {
        const std::size_t above = image.Index(row + 1, columns[c]);
        if (has(above)) {
          out[6 * plane] = Squash(Horizontal(image.point[above]) - Horizontal(p), 0.2F);
          out[7 * plane] = Squash(image.point[above].z() - p.z(), 0.2F);
        }
      }
      const Run& run =
          runs[static_cast<std::size_t>(run_of[static_cast<std::size_t>(columns[c])])];
      out[9 * plane] = run.width;
      out[10 * plane] = run.brightness;
      out[11 * plane] = run.bulge;
      out[12 * plane] = run.slant;
      out[13 * plane] = run.roughness;
      lines.wanted[pixel] = !ground || std::abs(ground->Height(p)) >= kBareGround;
    }
  }
  const std::vector<float> support = LineSupport(lines);
  for (std::size_t k = 0; k < kLineSupportPlanes; ++k) {
    for (int row = 0; row < image.rows; ++row) {
      const float* from = support.data() + k * image.size() + image.Index(row, 0);
      float* to = planes.data() + (kFirstLinePlane + k) * plane + static_cast<std::size_t>(row) * width;
      for (std::size_t c = 0; c < width; ++c) {
        if (columns[c] >= 0) to[c] = from[columns[c]];
      }
    }
  }
  return planes;
}

}  // namespace dendro
