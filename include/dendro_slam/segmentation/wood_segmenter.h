#pragma once

#include <memory>
#include <string>

#include "dendro_slam/range_image/range_image.h"
#include "dendro_slam/segmentation/geometric_wood.h"
#include "dendro_slam/segmentation/ground_plane.h"

namespace dendro {

/// Parameters of stage 1.
struct WoodSegmenterConfig {
  std::string method = "network";  ///< "network", or "geometric" which needs no weights.
  std::string weights = "";        ///< Weights file; empty: the shipped one for about this size of image.
  double min_range_m = 0.4;        ///< Nearer returns are of the carrier: `other` [m]. >= 0.
  double max_range_m = 30.0;       ///< Farther returns are ground or other, never wood [m].
  double wood_threshold = 0.5;     ///< Wood if its probability is at least this. In (0, 1).
  double far_range_m = 8.0;        ///< Farther returns are wood from `far_wood_threshold` on [m]. > 0.
  double far_wood_threshold = 0.2; ///< What lies far is few pixels, and missed for good if missed. In (0, 1).
  int margin_columns = 32;         ///< Context on both sides of an occupied sector. >= 0.
  bool skip_bare_ground = true;    ///< Do not run the network on columns of nothing but ground.
  int num_threads = 1;             ///< Threads of the network; the setting is OpenCV's. >= 1.
  GroundPlaneConfig ground;        ///< Keys prefixed `ground_plane_`.
  GeometricWoodConfig geometric;   ///< Keys prefixed `geometric_`.

  void Validate() const;
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("method", method);
    v("weights", weights);
    v("min_range_m", min_range_m);
    v("max_range_m", max_range_m);
    v("wood_threshold", wood_threshold);
    v("far_range_m", far_range_m);
    v("far_wood_threshold", far_wood_threshold);
    v("margin_columns", margin_columns);
    v("skip_bare_ground", skip_bare_ground);
    v("num_threads", num_threads);
    ground.Visit([&v](const char* key, auto& value) {
      v((std::string("ground_plane_") + key).c_str(), value);
    });
    geometric.Visit([&v](const char* key, auto& value) {
      v((std::string("geometric_") + key).c_str(), value);
    });
  }
};

/// The weights the package ships for range images of about this size, in the source tree or where it
/// is installed: `erfnet_wood` was trained on 16 x 1800, `erfnet_wood_32x360` on 32 x 360.
/// @throws WeightsError if they are in neither place.
std::string ShippedWoodWeights(int rows = 16, int cols = 1800);

/// Stage 1: tells wood from ground, leaves and everything else in a range image.
///
/// `network` runs an ERFNet (see erfnet.h) on the columns that hold something other than bare
/// ground within range, with a margin of neighbouring columns (across azimuth 0 too). `geometric`
/// needs no weights. Owns the network; one instance per thread. A network sees patterns of pixels, so
/// that one trained on another size of image than the scan's finds next to nothing.
class WoodSegmenter {
 public:
  /// @throws std::invalid_argument naming a bad field; WeightsError for a bad weights file.
  explicit WoodSegmenter(const WoodSegmenterConfig& config);
  ~WoodSegmenter();
  WoodSegmenter(WoodSegmenter&&) noexcept;
  WoodSegmenter& operator=(WoodSegmenter&&) noexcept;

  /// Labels a range image; the image is moved into the result, not copied.
  /// @throws std::invalid_argument if the image's vectors do not have rows x cols entries;
  ///   WeightsError if the first image needs shipped weights that cannot be used.
  LabelledScan Segment(RangeImage image);

  const WoodSegmenterConfig& config() const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace dendro
