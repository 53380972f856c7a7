#include "dendro_slam/segmentation/geometric_wood.h"

#include <gtest/gtest.h>

#include "dendro_slam/segmentation/ground_plane.h"
#include "dendro_slam/segmentation/wood_segmenter.h"
#include "synthetic_scan.h"

namespace dendro {
namespace {

const std::vector<test::Stem> kStems = {
    {4.0, 0.2, 0.15, 6.0}, {-3.0, 5.0, 0.10, 5.0}, {2.0, -7.0, 0.25, 8.0}};

TEST(GroundPlane, FindsHeightAndNormalInAnyAttitude) {
  for (const double roll_deg : {0.0, 20.0, 90.0}) {
    const Eigen::Matrix3d rotation =
        Eigen::AngleAxisd(roll_deg * M_PI / 180.0, Eigen::Vector3d::UnitX()).toRotationMatrix();
    const test::SyntheticScan scan = test::MakeScan(kStems, 1.7, 0.01, 5, rotation);
    const auto ground = EstimateGroundPlane(scan.image, GroundPlaneConfig());
    ASSERT_TRUE(ground.has_value()) << roll_deg;
    EXPECT_NEAR(ground->offset, 1.7, 0.03) << roll_deg;
    const Eigen::Vector3d up = rotation.transpose() * Eigen::Vector3d::UnitZ();
    EXPECT_GT(ground->normal.cast<double>().dot(up), 0.9998) << roll_deg;
  }
}

TEST(GroundPlane, FoundFromHighAboveWhereAllOfItIsFar) {
  const test::SyntheticScan scan = test::MakeScan({{4.0, 0.2, 0.15, 9.0}}, 7.5, 0.01, 5);
  const auto ground = EstimateGroundPlane(scan.image, GroundPlaneConfig());
  ASSERT_TRUE(ground.has_value());
  EXPECT_NEAR(ground->offset, 7.5, 0.15);
  GroundPlaneConfig near_only;
  near_only.far_range_m = 0.0;
  EXPECT_FALSE(EstimateGroundPlane(scan.image, near_only).has_value());
}

TEST(GroundPlane, SaysNothingWithoutGround) {
  test::SyntheticScan scan = test::MakeScan(kStems, 2.0, 0.01, 5);
  for (std::size_t i = 0; i < scan.image.size(); ++i) {
    if (scan.truth[i] == Label::kGround) scan.image.point_index[i] = -1;
  }
  EXPECT_FALSE(EstimateGroundPlane(scan.image, GroundPlaneConfig()).has_value());
  EXPECT_FALSE(EstimateGroundPlane(test::EmptyImage(16, 1800), GroundPlaneConfig()).has_value());
}

TEST(GroundPlane, FitThroughLabelledReturnsInAnyAttitude) {
  for (const double roll_deg : {0.0, 20.0, 90.0}) {
    const Eigen::Matrix3d rotation =
        Eigen::AngleAxisd(roll_deg * M_PI / 180.0, Eigen::Vector3d::UnitX()).toRotationMatrix();
    const test::SyntheticScan synthetic = test::MakeScan(kStems, 1.7, 0.01, 5, rotation);
    LabelledScan scan;
    scan.image = synthetic.image;
    scan.label = synthetic.truth;
    const auto ground = FitGroundPlane(scan);
    ASSERT_TRUE(ground.has_value()) << roll_deg;
    EXPECT_NEAR(ground->offset, 1.7, 0.005) << roll_deg;
    const Eigen::Vector3d up = rotation.transpose() * Eigen::Vector3d::UnitZ();
    EXPECT_GT(ground->normal.cast<double>().dot(up), 0.99999) << roll_deg;
    for (Label& label : scan.label) {
      if (label == Label::kGround) label = Label::kOther;
    }
    EXPECT_FALSE(FitGroundPlane(scan).has_value());
  }
}

TEST(GeometricWood, BareStemsOnAPlane) {
  WoodSegmenterConfig config;
  config.method = "geometric";
  WoodSegmenter segmenter(config);
  const test::SyntheticScan scan = test::MakeScan(kStems, 1.7, 0.01, 11);
  const LabelledScan result = segmenter.Segment(scan.image);
  EXPECT_GT(test::WoodIou(result.label, scan.truth), 0.95);
  EXPECT_GT(test::Accuracy(result.label, scan.truth), 0.99);
}

TEST(GeometricWood, SensorOnItsSide) {
  WoodSegmenterConfig config;
  config.method = "geometric";
  WoodSegmenter segmenter(config);
  const Eigen::Matrix3d rotation =
      Eigen::AngleAxisd(M_PI / 2.0, Eigen::Vector3d::UnitX()).toRotationMatrix();
  const std::vector<test::Stem> stems = {{0.4, 3.0, 0.12, 5.0}, {-0.6, 3.5, 0.15, 5.0}};
  const test::SyntheticScan scan = test::MakeScan(stems, 1.7, 0.01, 11, rotation);
  const LabelledScan result = segmenter.Segment(scan.image);
  EXPECT_GT(test::WoodIou(result.label, scan.truth), 0.85);
}

TEST(GeometricWood, RollingTheScanRollsTheLabels) {
  const test::SyntheticScan scan = test::MakeScan(kStems, 1.7, 0.01, 3);
  const auto ground = EstimateGroundPlane(scan.image, GroundPlaneConfig());
  ASSERT_TRUE(ground);
  const std::vector<Label> labels =
      LabelGeometrically(scan.image, ground, GeometricWoodConfig());
  const RangeImage rolled = test::Rolled(scan.image, 777);
  GroundPlane turned = *ground;
  turned.normal = Eigen::AngleAxisf(static_cast<float>(2.0 * M_PI * 777 / 1800),
                                    Eigen::Vector3f::UnitZ()) * ground->normal;
  const std::vector<Label> rolled_labels =
      LabelGeometrically(rolled, turned, GeometricWoodConfig());
  std::size_t different = 0;
  for (int r = 0; r < 16; ++r) {
    for (int c = 0; c < 1800; ++c) {
      different += rolled_labels[rolled.Index(r, c)] !=
                   labels[rolled.Index(r, rolled.WrapColumn(c + 777))];
    }
  }
  // The cells of the local ground are not turned with the scan: a few returns at the foot may move.
  EXPECT_LT(different, 20U);
}

}  // namespace
}  // namespace dendro
