#include "dendro_slam/segmentation/wood_segmenter.h"

#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "dendro_slam/segmentation/safetensors.h"
#include "dendro_slam/sim/flight_path.h"
#include "dendro_slam/sim/raycaster.h"
#include "dendro_slam/sim/scene.h"
#include "dendro_slam/sim/training_scans.h"
#include "synthetic_scan.h"

namespace dendro {
namespace {

LidarSimulatorConfig Lidar() {
  LidarSimulatorConfig lidar;
  lidar.sub_rays_width = 5;
  lidar.sub_rays_height = 2;
  return lidar;
}

struct Scores {
  double wood_iou, accuracy, recall;
};

// Scores over scans of scenes whose seeds were never trained on (training uses seeds below 5000000,
// its held-out set among them).
Scores ScoreOn(WoodSegmenter& segmenter,
               const std::string& kind,
               int scenes,
               int scans_per_scene,
               const ProjectorConfig& projector = ProjectorConfig()) {
  std::vector<Label> labels;
  std::vector<Label> truth;
  for (int scene = 0; scene < scenes; ++scene) {
    for (TrainingScan& scan : SimulateTrainingScans(
             kind, 7000000U + static_cast<unsigned>(scene), scans_per_scene, Lidar(), projector)) {
      const LabelledScan result = segmenter.Segment(std::move(scan.image));
      labels.insert(labels.end(), result.label.begin(), result.label.end());
      truth.insert(truth.end(), scan.truth.begin(), scan.truth.end());
    }
  }
  double both = 0, wood = 0;
  for (std::size_t i = 0; i < truth.size(); ++i) {
    wood += truth[i] == Label::kWood;
    both += truth[i] == Label::kWood && labels[i] == Label::kWood;
  }
  EXPECT_GT(wood, 500.0) << kind;
  return {test::WoodIou(labels, truth), test::Accuracy(labels, truth), both / wood};
}

TEST(WoodSegmenterNetwork, ThesisScenes) {
  WoodSegmenter segmenter{WoodSegmenterConfig()};
  const Scores scores = ScoreOn(segmenter, "thesis", 4, 2);
  EXPECT_GT(scores.wood_iou, 0.96);
  EXPECT_GT(scores.accuracy, 0.99);
  EXPECT_GT(scores.recall, 0.97);
}

TEST(WoodSegmenterNetwork, ThesisFlight) {
  const std::string config = std::string(DENDRO_SOURCE_DIR) + "/config/";
  const Scene scene = LoadScene(config + "scenes/thesis_tree.yaml");
  const FlightPath path = LoadFlightPath(config + "paths/thesis_quadrangle.yaml");
  const Raycaster raycaster(scene);
  const LidarSimulator simulator(raycaster, Lidar(), path.start_stamp_ns);
  WoodSegmenter segmenter{WoodSegmenterConfig()};
  Projector projector;
  std::vector<Label> labels;
  std::vector<Label> truth;
  for (int i = 20; i < simulator.NumScans(path.duration_s); i += 160) {
    const SimulatedScan simulated =
        simulator.SimulateScan(i, [&path](std::int64_t t) { return path.LidarPose(t); });
    RangeImage image = projector.Project(simulated.scan, nullptr);
    const std::vector<Label> expected = PixelTruth(image, simulated.truth);
    const LabelledScan result = segmenter.Segment(std::move(image));
    labels.insert(labels.end(), result.label.begin(), result.label.end());
    truth.insert(truth.end(), expected.begin(), expected.end());
  }
  EXPECT_GT(test::WoodIou(labels, truth), 0.95);
  EXPECT_GT(test::Accuracy(labels, truth), 0.995);
}

TEST(WoodSegmenterNetwork, LeaflessScenes) {
  WoodSegmenter segmenter{WoodSegmenterConfig()};
  const Scores scores = ScoreOn(segmenter, "leafless", 4, 2);
  EXPECT_GT(scores.wood_iou, 0.95);
  EXPECT_GT(scores.accuracy, 0.98);
}

TEST(WoodSegmenterNetwork, TiltedScenes) {
  WoodSegmenter segmenter{WoodSegmenterConfig()};
  const Scores scores = ScoreOn(segmenter, "tilted", 8, 1);
  EXPECT_GT(scores.wood_iou, 0.5);
  EXPECT_GT(scores.accuracy, 0.97);
}

// The thesis' size of image has weights of its own, chosen without being asked for.
TEST(WoodSegmenterNetwork, ThesisImage) {
  ProjectorConfig projector;
  projector.model = "uniform";
  projector.rows = 32;
  projector.cols = 360;
  WoodSegmenter segmenter{WoodSegmenterConfig()};
  const Scores scores = ScoreOn(segmenter, "thesis", 4, 2, projector);
  EXPECT_GT(scores.wood_iou, 0.9);
  EXPECT_GT(scores.accuracy, 0.98);
}

TEST(WoodSegmenterNetwork, ScenesInLeafBeatTheGeometricFallback) {
  WoodSegmenter segmenter{WoodSegmenterConfig()};
  WoodSegmenterConfig fallback;
  fallback.method = "geometric";
  WoodSegmenter geometric(fallback);
  const Scores scores = ScoreOn(segmenter, "leafy", 8, 1);
  EXPECT_GT(scores.wood_iou, 0.5);
  EXPECT_GT(scores.wood_iou, ScoreOn(geometric, "leafy", 8, 1).wood_iou + 0.1);
}

TEST(WoodSegmenterGeometric, ThesisScenes) {
  WoodSegmenterConfig config;
  config.method = "geometric";
  WoodSegmenter segmenter(config);
  const Scores scores = ScoreOn(segmenter, "thesis", 4, 2);
  EXPECT_GT(scores.wood_iou, 0.80);
  EXPECT_GT(scores.recall, 0.90);
}

TEST(WoodSegmenterNetwork, RollingTheScanRollsTheLabels) {
  WoodSegmenter segmenter{WoodSegmenterConfig()};
  // Not a multiple of the network's stride, and some bring a tree across azimuth 0. Only rounding of
  // the turned points may tell them apart.
  for (const unsigned seed : {7100000U, 7100001U, 7100002U, 7100003U, 7100004U}) {
    const TrainingScan scan =
        SimulateTrainingScans("leafy", seed, 1, Lidar(), ProjectorConfig()).front();
    const LabelledScan straight = segmenter.Segment(scan.image);
    for (const int k : {333, 905, 1799}) {
      double different = 0.0;
      double returns = 0.0;
      const LabelledScan rolled = segmenter.Segment(test::Rolled(scan.image, k));
      for (int r = 0; r < rolled.image.rows; ++r) {
        for (int c = 0; c < rolled.image.cols; ++c) {
          const std::size_t i = rolled.image.Index(r, c);
          if (!rolled.image.HasReturn(i)) continue;
          returns += 1.0;
          const std::size_t j = rolled.image.Index(r, rolled.image.WrapColumn(c + k));
          different += rolled.label[i] != straight.label[j] ? 1.0 : 0.0;
        }
      }
      EXPECT_GT(returns, 1000.0) << seed;
      EXPECT_LE(different, 0.001 * returns) << seed << " rolled by " << k;
    }
  }
}

TEST(WoodSegmenterNetwork, FarReturnsHaveAThresholdOfTheirOwn) {
  WoodSegmenterConfig config;
  config.wood_threshold = 0.6;
  config.far_range_m = 9.0;
  config.far_wood_threshold = 0.2;
  WoodSegmenter segmenter(config);
  int between = 0;
  for (const unsigned seed : {7400000U, 7400001U, 7400002U, 7400003U}) {
    const TrainingScan scan =
        SimulateTrainingScans("leafy", seed, 1, Lidar(), ProjectorConfig()).front();
    const LabelledScan result = segmenter.Segment(scan.image);
    for (std::size_t i = 0; i < result.label.size(); ++i) {
      if (!scan.image.HasReturn(i)) continue;
      const float range = scan.image.range[i];
      const float probability = result.wood_probability[i];
      ASSERT_EQ(result.IsWood(i), probability >= (range > 9.0F ? 0.2F : 0.6F))
          << range << " " << probability;
      between += range > 9.0F && probability >= 0.2F && probability < 0.6F;
    }
  }
  EXPECT_GT(between, 0);
}

TEST(WoodSegmenterNetwork, SameInputSameBytesAlsoWithTwoThreads) {
  const TrainingScan scan =
      SimulateTrainingScans("leafless", 7200000U, 1, Lidar(), ProjectorConfig()).front();
  WoodSegmenterConfig config;
  WoodSegmenter one(config);
  config.num_threads = 2;
  WoodSegmenter two(config);
  const LabelledScan a = one.Segment(scan.image);
  const LabelledScan b = two.Segment(scan.image);
  const LabelledScan c = one.Segment(scan.image);
  EXPECT_EQ(a.label, b.label);
  EXPECT_EQ(a.wood_probability, c.wood_probability);
  EXPECT_EQ(a.wood_probability, b.wood_probability);
}

TEST(WoodSegmenterNetwork, SectorsGiveWhatTheWholeImageGives) {
  const TrainingScan scan =
      SimulateTrainingScans("leafless", 7300000U, 1, Lidar(), ProjectorConfig()).front();
  WoodSegmenterConfig config;
  WoodSegmenter sectors(config);
  config.skip_bare_ground = false;
  config.margin_columns = 900;
  WoodSegmenter whole(config);
  const LabelledScan a = sectors.Segment(scan.image);
  const LabelledScan b = whole.Segment(scan.image);
  std::size_t returns = 0;
  std::size_t different = 0;
  for (std::size_t i = 0; i < a.label.size(); ++i) {
    if (!scan.image.HasReturn(i)) continue;
    ++returns;
    different += (a.label[i] == Label::kWood) != (b.label[i] == Label::kWood);
  }
  EXPECT_LT(static_cast<double>(different), 0.005 * static_cast<double>(returns));
}

class BothMethods : public ::testing::TestWithParam<std::string> {
 protected:
  WoodSegmenter Make() const {
    WoodSegmenterConfig config;
    config.method = GetParam();
    return WoodSegmenter(config);
  }
};
INSTANTIATE_TEST_SUITE_P(Methods, BothMethods, ::testing::Values("network", "geometric"));

TEST_P(BothMethods, ImageWithoutReturns) {
  WoodSegmenter segmenter = Make();
  const LabelledScan result = segmenter.Segment(test::EmptyImage(16, 1800));
  ASSERT_EQ(result.label.size(), 28800U);
  for (std::size_t i = 0; i < result.label.size(); ++i) {
    ASSERT_EQ(result.label[i], Label::kNone);
    ASSERT_EQ(result.wood_probability[i], 0.0F);
  }
}

TEST_P(BothMethods, ImageWithoutPixels) {
  WoodSegmenter segmenter = Make();
  EXPECT_TRUE(segmenter.Segment(RangeImage()).label.empty());
}

TEST_P(BothMethods, LabelsOnlyReturnsAndMovesTheImage) {
  WoodSegmenter segmenter = Make();
  test::SyntheticScan scan =
      test::MakeScan({{4.0, 0.2, 0.15, 6.0}, {-3.0, 5.0, 0.10, 5.0}}, 1.7, 0.01, 11);
  const Eigen::Vector3f* memory = scan.image.point.data();
  const LabelledScan result = segmenter.Segment(std::move(scan.image));
  EXPECT_EQ(result.image.point.data(), memory);
  for (std::size_t i = 0; i < result.label.size(); ++i) {
    ASSERT_EQ(result.label[i] == Label::kNone, !result.image.HasReturn(i));
    ASSERT_GE(result.wood_probability[i], 0.0F);
    ASSERT_LE(result.wood_probability[i], 1.0F);
  }
  EXPECT_GT(test::WoodIou(result.label, scan.truth), 0.9);
}

TEST_P(BothMethods, OtherSizesOfImage) {
  WoodSegmenter segmenter = Make();
  for (const auto& [rows, cols] : std::vector<std::pair<int, int>>{{32, 360}, {15, 901}, {1, 8}}) {
    const test::SyntheticScan scan = test::MakeScan({{4.0, 0.2, 0.15, 6.0}}, 1.7, 0.01, 11,
                                                    Eigen::Matrix3d::Identity(), rows, cols);
    EXPECT_EQ(segmenter.Segment(scan.image).label.size(), static_cast<std::size_t>(rows * cols));
  }
}

TEST_P(BothMethods, RefusesAnImageThatContradictsItself) {
  WoodSegmenter segmenter = Make();
  RangeImage image = test::EmptyImage(16, 1800);
  image.range.pop_back();
  EXPECT_THROW(segmenter.Segment(std::move(image)), std::invalid_argument);
}

TEST(WoodSegmenter, RefusesBadConfigurationNamingTheField) {
  const auto expect = [](const WoodSegmenterConfig& config, const std::string& field) {
    try {
      WoodSegmenter segmenter(config);
      ADD_FAILURE() << field;
    } catch (const std::invalid_argument& error) {
      EXPECT_NE(std::string(error.what()).find(field), std::string::npos) << error.what();
    }
  };
  WoodSegmenterConfig config;
  config.method = "magic";
  expect(config, "method");
  config = {};
  config.max_range_m = std::numeric_limits<double>::quiet_NaN();
  expect(config, "max_range_m");
  config = {};
  config.wood_threshold = 1.5;
  expect(config, "wood_threshold");
  config = {};
  config.far_range_m = std::numeric_limits<double>::quiet_NaN();
  expect(config, "far_range_m");
  config = {};
  config.far_wood_threshold = 0.0;
  expect(config, "far_wood_threshold");
  config = {};
  config.num_threads = 0;
  expect(config, "num_threads");
  config = {};
  config.ground.inlier_distance_m = -1.0;
  expect(config, "inlier_distance_m");
}

TEST(WoodSegmenter, ShippedWeightsFollowTheImage) {
  const auto name = [](int rows, int cols) {
    const std::string path = ShippedWoodWeights(rows, cols);
    return path.substr(path.rfind('/') + 1);
  };
  EXPECT_EQ(name(16, 1800), "erfnet_wood.safetensors");
  EXPECT_EQ(name(16, 900), "erfnet_wood.safetensors");
  EXPECT_EQ(name(16, 3600), "erfnet_wood.safetensors");
  EXPECT_EQ(name(32, 360), "erfnet_wood_32x360.safetensors");
  EXPECT_EQ(name(32, 512), "erfnet_wood_32x360.safetensors");
}

TEST(WoodSegmenter, RefusesWeightsOfAnotherNetwork) {
  WoodSegmenterConfig config;
  config.weights = "/nonexistent.safetensors";
  EXPECT_THROW(WoodSegmenter{config}, WeightsError);
  config.weights =
      std::string(DENDRO_SOURCE_DIR) + "/test/segmentation/data/erfnet_fixture_io.safetensors";
  EXPECT_THROW(WoodSegmenter{config}, WeightsError);
}

}  // namespace
}  // namespace dendro
