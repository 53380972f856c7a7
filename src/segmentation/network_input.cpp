#include "dendro_slam/segmentation/network_input.h"

#include <algorithm>
#include <cmath>

namespace dendro {
namespace {

float Squash(float step, float scale) { return step / (std::abs(step) + scale); }

float Horizontal(const Eigen::Vector3f& p) { return std::hypot(p.x(), p.y()); }

}  // namespace

std::vector<float> NetworkInput(const RangeImage& image,
                                const std::optional<GroundPlane>& ground,
                                const std::vector<int>& columns) {
  const std::size_t width = columns.size();
  const std::size_t plane = static_cast<std::size_t>(image.rows) * width;
  std::vector<float> planes(kNetworkInputChannels * plane, 0.0F);
  const auto has = [&](std::size_t i) { return image.HasReturn(i) && image.range[i] > 0.0F; };
  for (int row = 0; row < image.rows; ++row) {
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
    }
  }
  return planes;
}

}  // namespace dendro
