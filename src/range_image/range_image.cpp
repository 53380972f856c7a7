#include "dendro_slam/range_image/range_image.h"

namespace dendro {

std::vector<Label> PointLabels(const LabelledScan& scan) {
  std::vector<Label> labels(scan.image.pixel_of_point.size(), Label::kNone);
  for (std::size_t i = 0; i < labels.size(); ++i) {
    const std::int32_t pixel = scan.image.pixel_of_point[i];
    if (pixel >= 0) labels[i] = scan.label[static_cast<std::size_t>(pixel)];
  }
  return labels;
}

}  // namespace dendro
