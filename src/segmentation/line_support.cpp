#include "dendro_slam/segmentation/line_support.h"

#include <algorithm>
#include <array>
#include <cmath>

namespace dendro {
namespace {

constexpr double kPi = 3.14159265358979323846;
constexpr float kNone = 1000.0F;  // Range of a pixel without a return [m].
constexpr int kReach = 3;         // Rows looked at above and below.
constexpr std::size_t kLanes = 16;  // Pixels of a row that are worked on together.

// Ranges and widths with `kReach` rows and `margin` columns more on every side.
struct Padded {
  std::size_t stride = 0;
  std::vector<float> range, width;
};

Padded Pad(const LineSupportInput& input, int margin) {
  Padded padded;
  const auto rows = static_cast<std::size_t>(input.rows);
  const auto cols = static_cast<std::size_t>(input.cols);
  padded.stride = cols + 2 * static_cast<std::size_t>(margin) + kLanes;
  padded.range.assign((rows + 2 * kReach) * padded.stride, kNone);
  padded.width.assign(padded.range.size(), 99.0F);
  for (std::size_t row = 0; row < rows; ++row) {
    float* range = padded.range.data() + (row + kReach) * padded.stride;
    float* width = padded.width.data() + (row + kReach) * padded.stride;
    for (int k = -margin; k < input.cols + margin; ++k) {
      const std::size_t col = static_cast<std::size_t>(((k % input.cols) + input.cols) % input.cols);
      const float value = input.range[row * cols + col];
      if (!(value > 0.0F && value < kNone)) continue;
      range[k + margin] = value;
      width[k + margin] = input.log_width[row * cols + col];
    }
  }
  return padded;
}

using Lanes = std::array<float, kLanes>;

struct Block {
  Lanes best, rows, bend, depth, slope, likeness, sum;
};

// All slopes for kLanes pixels of a row; `range` and `width` point at the first of them in a padded image.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
__attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#endif
void TrySlopes(const float* range,
               const float* width,
               std::ptrdiff_t stride,
               int rows_below,
               int rows_above,
               int steepest,
               float row_gap,
               float col_gap,
               Block* block) {
  Lanes R, W, gap, tolerance, inverse;
  for (std::size_t i = 0; i < kLanes; ++i) {
    R[i] = range[i];
    W[i] = width[i];
    gap[i] = R[i] * row_gap;
    tolerance[i] = 0.03F + 0.004F * R[i];
    inverse[i] = 1.0F / R[i];
    block->best[i] = -99.0F;
    block->sum[i] = 0.0F;
  }
  for (int dc = -steepest; dc <= steepest; ++dc) {
    const float angle = row_gap * row_gap + static_cast<float>(dc * dc) * col_gap * col_gap;
    // The neighbouring rows: the return nearest in range of three columns.
    std::array<Lanes, 2> next, next_width, least;
    for (int side = 0; side < 2; ++side) {
      const int k = side == 0 ? 1 : -1;
      Lanes& v = next[static_cast<std::size_t>(side)];
      Lanes& w = next_width[static_cast<std::size_t>(side)];
      Lanes& low = least[static_cast<std::size_t>(side)];
      const float* r = range + k * (stride + dc);
      const float* u = width + k * (stride + dc);
      for (std::size_t i = 0; i < kLanes; ++i) {
        const float a = r[static_cast<std::ptrdiff_t>(i) - 1];
        const float b = r[i];
        const float c = r[i + 1];
        const float da = std::abs(a - R[i]);
        const float db = std::abs(b - R[i]);
        const float dd = std::abs(c - R[i]);
        float nearest = a;
        float nearest_width = u[static_cast<std::ptrdiff_t>(i) - 1];
        float d = da;
        nearest = db < d ? b : nearest;
        nearest_width = db < d ? u[i] : nearest_width;
        d = db < d ? db : d;
        nearest = dd < d ? c : nearest;
        nearest_width = dd < d ? u[i + 1] : nearest_width;
        v[i] = nearest;
        w[i] = nearest_width;
        low[i] = std::min(std::min(a, b), c);
      }
    }
    Lanes depth, curve, bend, score, rows, unlike;
    Lanes followed;  // Not 0 where a return in a neighbouring row gives the line a direction.
    for (std::size_t i = 0; i < kLanes; ++i) {
      const float limit = 2.0F * gap[i] + tolerance[i];
      const float up = std::abs(next[0][i] - R[i]) < limit ? 1.0F : 0.0F;
      const float down = std::abs(next[1][i] - R[i]) < limit ? 1.0F : 0.0F;
      const float both = up * down;
      const float one = up > 0.0F ? next[0][i] - R[i] : down > 0.0F ? R[i] - next[1][i] : 0.0F;
      const float s = both > 0.0F ? 0.5F * (next[0][i] - next[1][i]) : one;
      curve[i] = R[i] * angle + 2.0F * s * s * inverse[i];
      const float t = both > 0.0F ? std::abs(next[0][i] + next[1][i] - 2.0F * R[i] - curve[i]) : 0.0F;
      const float straight = t < 2.0F * tolerance[i] ? 1.0F : 0.0F;
      const float hit_up = up * straight;
      const float hit_down = down * straight;
      const float hidden_up = least[0][i] < R[i] - 3.0F * gap[i] ? 0.0F : -1.0F;
      const float hidden_down = least[1][i] < R[i] - 3.0F * gap[i] ? 0.0F : -1.0F;
      depth[i] = s;
      bend[i] = t;
      score[i] = (rows_above >= 1 ? (hit_up > 0.0F ? 1.0F : hidden_up) : 0.0F) +
                 (rows_below >= 1 ? (hit_down > 0.0F ? 1.0F : hidden_down) : 0.0F);
      rows[i] = hit_up + hit_down;
      unlike[i] = hit_up * std::min(std::abs(next_width[0][i] - W[i]), 3.0F) +
                  hit_down * std::min(std::abs(next_width[1][i] - W[i]), 3.0F);
      followed[i] = up + down;
    }
    for (const int k : {2, -2, 3, -3}) {
      const bool inside = k > 0 ? k <= rows_above : -k <= rows_below;
      if (!inside) continue;
      const float* r = range + k * (stride + dc);
      const float* u = width + k * (stride + dc);
      const float steps = static_cast<float>(k);
      const float wider = 1.0F + 0.3F * std::abs(steps);
      for (std::size_t i = 0; i < kLanes; ++i) {
        const float expected = R[i] + steps * depth[i] + 0.5F * steps * steps * curve[i];
        const float close = tolerance[i] * wider;
        const float a = r[static_cast<std::ptrdiff_t>(i) - 1];
        const float b = r[i];
        const float c = r[i + 1];
        const float low = std::min(std::min(a, b), c);
        const float wa = std::abs(a - expected) < close
                             ? std::abs(u[static_cast<std::ptrdiff_t>(i) - 1] - W[i])
                             : 1e6F;
        const float wb = std::abs(b - expected) < close ? std::abs(u[i] - W[i]) : 1e6F;
        const float wc = std::abs(c - expected) < close ? std::abs(u[i + 1] - W[i]) : 1e6F;
        const float likest = std::min(std::min(wa, wb), wc);
        const float hit = likest < 1e5F && followed[i] > 0.0F ? 1.0F : 0.0F;
        const float missed = low < expected - tolerance[i] ? 0.0F : -1.0F;
        score[i] += hit > 0.0F ? 1.0F : missed;
        rows[i] += hit;
        unlike[i] += hit > 0.0F ? std::min(likest, 3.0F) : 0.0F;
      }
    }
    const float slope = static_cast<float>(dc) / static_cast<float>(steepest);
    for (std::size_t i = 0; i < kLanes; ++i) {
      const float mean = unlike[i] / std::max(rows[i], 1.0F);
      const float rank = score[i] - 0.3F * mean - 5.0F * bend[i];
      const bool better = rank > block->best[i];
      block->best[i] = better ? rank : block->best[i];
      block->rows[i] = better ? rows[i] : block->rows[i];
      block->bend[i] = better ? bend[i] : block->bend[i];
      block->depth[i] = better ? depth[i] : block->depth[i];
      block->slope[i] = better ? slope : block->slope[i];
      block->likeness[i] = better ? mean : block->likeness[i];
      block->sum[i] += score[i];
    }
  }
  for (std::size_t i = 0; i < kLanes; ++i) {
    block->bend[i] /= tolerance[i];
    block->depth[i] /= gap[i];
  }
}

}  // namespace

std::vector<float> LineSupport(const LineSupportInput& input) {
  const auto cols = static_cast<std::size_t>(input.cols);
  const std::size_t plane = static_cast<std::size_t>(input.rows) * cols;
  std::vector<float> out(kLineSupportPlanes * plane, 0.0F);
  if (input.rows < 2 || !(input.row_gap_rad > 0.0F)) return out;
  if (std::find(input.wanted.begin(), input.wanted.end(), 1) == input.wanted.end()) return out;
  const float col_gap = static_cast<float>(2.0 * kPi / input.cols);
  const int steepest = std::clamp(static_cast<int>(std::lround(1.2F * input.row_gap_rad / col_gap)), 1, 12);
  const int margin = std::max(kReach * steepest + 1, static_cast<int>(kLanes));
  const Padded padded = Pad(input, margin);
  Block block;
  for (int row = 0; row < input.rows; ++row) {
    const std::size_t first = static_cast<std::size_t>(row) * cols;
    for (std::size_t col = 0; col < cols;) {
      if (!input.wanted[first + col]) {
        ++col;
        continue;
      }
      const std::size_t from = static_cast<std::size_t>(row + kReach) * padded.stride +
                               static_cast<std::size_t>(margin) + col;
      TrySlopes(padded.range.data() + from, padded.width.data() + from,
                static_cast<std::ptrdiff_t>(padded.stride), row, input.rows - 1 - row, steepest,
                input.row_gap_rad, col_gap, &block);
      const std::size_t count = std::min(kLanes, cols - col);
      const float slopes = static_cast<float>(2 * steepest + 1);
      for (std::size_t i = 0; i < count; ++i) {
        if (!input.wanted[first + col + i]) continue;
        const std::array<float, kLineSupportPlanes> values = {
            block.best[i] / 3.0F, block.rows[i] / 3.0F, block.bend[i],    block.depth[i],
            block.slope[i],       block.likeness[i],    block.sum[i] / (3.0F * slopes)};
        for (std::size_t k = 0; k < values.size(); ++k) {
          out[k * plane + first + col + i] = std::clamp(values[k], -5.0F, 5.0F);
        }
      }
      col += count;
    }
  }
  return out;
}

}  // namespace dendro
