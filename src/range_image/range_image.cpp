#include "dendro_slam/range_image/range_image.h"

#include <cmath>

namespace dendro {

int ReferenceColumn(const RangeImage& image) {
  int best = 0;
  double largest = 0.0;
  for (int col = 0; col < image.cols; ++col) {
    double sum = 0.0;
    for (int row = 0; row < image.rows; ++row) {
      const std::size_t i = image.Index(row, col);
      if (image.HasReturn(i) && std::isfinite(image.range[i])) sum += image.range[i];
    }
    if (sum > largest) {
      largest = sum;
      best = col;
    }
  }
  return best;
}

std::vector<Label> PointLabels(const LabelledScan& scan) {
  std::vector<Label> labels(scan.image.pixel_of_point.size(), Label::kNone);
  for (std::size_t i = 0; i < labels.size(); ++i) {
    const std::int32_t pixel = scan.image.pixel_of_point[i];
    if (pixel >= 0) labels[i] = scan.label[static_cast<std::size_t>(pixel)];
  }
  return labels;
}

}  // namespace dendro
