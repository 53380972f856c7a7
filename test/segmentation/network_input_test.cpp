#include "dendro_slam/segmentation/network_input.h"

#include <cmath>
#include <numeric>
#include <optional>
#include <vector>

#include <Eigen/Dense>
#include <gtest/gtest.h>

#include "synthetic_scan.h"

namespace dendro {
namespace {

constexpr int kRows = 16;
constexpr int kCols = 720;

// The inside of a sphere of 5 m, in every pixel but one.
RangeImage Sphere() {
  RangeImage image = test::EmptyImage(kRows, kCols);
  for (std::size_t i = 0; i < image.size(); ++i) {
    image.point_index[i] = static_cast<int>(i);
    image.range[i] = 5.0F;
    image.point[i] = 5.0F * image.beam_direction[i];
    image.intensity[i] = 64.0F;
  }
  const std::size_t hole = image.Index(8, 100);
  image.point_index[hole] = -1;
  return image;
}

std::vector<int> AllColumns() {
  std::vector<int> columns(kCols);
  std::iota(columns.begin(), columns.end(), 0);
  return columns;
}

class Planes {
 public:
  Planes(const RangeImage& image, const std::optional<GroundPlane>& ground)
      : values_(NetworkInput(image, ground, AllColumns())) {}
  float At(int plane, int row, int col) const {
    return values_[static_cast<std::size_t>((plane * kRows + row) * kCols + col)];
  }

 private:
  std::vector<float> values_;
};

TEST(NetworkInput, TellsWhichWayIsUpInTheImageOfATiltedSensor) {
  GroundPlane ground;
  ground.normal = Eigen::Vector3f(0.6F, -0.64F, 0.48F).normalized();
  ground.offset = 1.5F;
  const RangeImage image = Sphere();
  const Planes planes(image, ground);
  const double step = 2.0 * M_PI / kCols;
  for (int row = 0; row < kRows; ++row) {
    const double elevation = (-15.0 + 30.0 * row / (kRows - 1)) * M_PI / 180.0;
    for (int col = 1; col + 1 < kCols; ++col) {
      if (row == 8 && std::abs(col - 100) <= 1) continue;
      ASSERT_NEAR(planes.At(4, row, col), ground.normal.dot(image.beam_direction[image.Index(row, col)]),
                  1e-6);
      // The slope of plane `up` along the columns, per angle on the sphere.
      const double slope = (planes.At(4, row, col + 1) - planes.At(4, row, col - 1)) /
                           (2.0 * step * std::cos(elevation));
      ASSERT_NEAR(planes.At(8, row, col), slope, 1e-4) << row << " " << col;
    }
  }
}

TEST(NetworkInput, UprightSensorSeesNothingSideways) {
  GroundPlane ground;
  ground.offset = 1.5F;
  const Planes planes(Sphere(), ground);
  for (int row = 0; row < kRows; ++row) {
    for (int col = 0; col < kCols; ++col) ASSERT_NEAR(planes.At(8, row, col), 0.0F, 1e-6F);
  }
}

TEST(NetworkInput, MissingPixelIsZeroAndFarForItsNeighbours) {
  GroundPlane ground;
  ground.offset = 1.5F;
  const Planes planes(Sphere(), ground);
  for (int k = 0; k < kNetworkInputChannels; ++k) EXPECT_EQ(planes.At(k, 8, 100), 0.0F);
  EXPECT_EQ(planes.At(5, 8, 99), 1.0F);
  EXPECT_EQ(planes.At(6, 7, 100), 1.0F);
  EXPECT_EQ(planes.At(7, 7, 100), 0.0F);
  EXPECT_EQ(planes.At(5, 8, 98), 0.0F);
  EXPECT_NEAR(planes.At(1, 3, 3), 0.5F * std::log2(5.0F / 4.0F), 1e-6F);
  EXPECT_EQ(planes.At(2, 3, 3), 0.0F);
}

TEST(NetworkInput, WithoutGroundNothingIsSaidOfHeight) {
  const Planes planes(Sphere(), std::nullopt);
  for (const int plane : {3, 4, 8}) {
    for (int col = 0; col < kCols; ++col) ASSERT_EQ(planes.At(plane, 2, col), 0.0F);
  }
}

// A row of 1800 pixels that misses everything but for `ranges` from `first` on.
RangeImage OneRun(int first, const std::vector<float>& ranges, const std::vector<float>& intensity) {
  RangeImage image = test::EmptyImage(1, 1800);
  for (std::size_t k = 0; k < ranges.size(); ++k) {
    const std::size_t i = image.Index(0, image.WrapColumn(first + static_cast<int>(k)));
    image.point_index[i] = static_cast<int>(k);
    image.range[i] = ranges[k];
    image.point[i] = ranges[k] * image.beam_direction[i];
    image.intensity[i] = intensity[k];
  }
  return image;
}

// Undoes s = d / (|d| + scale).
double Unsquash(double s, double scale) { return scale * s / (1.0 - std::abs(s)); }

TEST(NetworkInput, RunTellsWidthBrightnessArcSlantAndRoughness) {
  // A slanting parabola with a bump, seen by 13 columns across azimuth 0; another return beside it, too
  // far behind to be of the same run.
  const int first = 1794;
  std::vector<float> ranges;
  std::vector<float> intensity;
  Eigen::MatrixXd powers(13, 3);
  Eigen::VectorXd range(13);
  for (int k = 0; k < 13; ++k) {
    const double u = (k - 6) / 13.0;
    const double r = 4.0 + 0.06 * u + 0.4 * u * u + (k == 4 ? 0.02 : 0.0);
    ranges.push_back(static_cast<float>(r));
    intensity.push_back(static_cast<float>(40 + k));
    powers.row(k) << 1.0, u, u * u;
    range(k) = ranges.back();
  }
  const Eigen::VectorXd fit = powers.colPivHouseholderQr().solve(range);
  const double rms = std::sqrt((range - powers * fit).squaredNorm() / 13.0);
  ranges.push_back(4.4F);
  intensity.push_back(90.0F);
  std::vector<int> columns(1800);
  std::iota(columns.begin(), columns.end(), 0);
  const std::vector<float> planes =
      NetworkInput(OneRun(first, ranges, intensity), std::nullopt, columns);
  const auto at = [&](int plane, int k) {
    return static_cast<double>(planes[static_cast<std::size_t>(1800 * plane + (first + k) % 1800)]);
  };
  for (int k = 0; k < 13; ++k) {
    EXPECT_NEAR(0.1 * std::exp2(4.0 * at(9, k)), range.sum() * 2.0 * M_PI / 1800.0, 1e-5);
    EXPECT_NEAR(128.0 * (at(10, k) + 0.5), 46.0, 1e-4);
    EXPECT_NEAR(Unsquash(at(11, k), 0.05), fit(2) / 4.0, 1e-5);
    EXPECT_NEAR(Unsquash(at(12, k), 0.2), fit(1), 1e-5);
    EXPECT_NEAR(Unsquash(at(13, k), 0.01), rms, 1e-6);
  }
  EXPECT_NEAR(0.1 * std::exp2(4.0 * at(9, 13)), 4.4 * 2.0 * M_PI / 1800.0, 1e-6);
  EXPECT_NEAR(128.0 * (at(10, 13) + 0.5), 90.0, 1e-4);
  for (const int plane : {11, 12, 13}) EXPECT_EQ(at(plane, 13), 0.0);
}

TEST(NetworkInput, RunsOfATurnedSensorAreTheSame) {
  const test::SyntheticScan scan =
      test::MakeScan({{3.0, 0.1, 0.2, 5.0}, {-2.0, 4.0, 0.1, 5.0}}, 1.5, 0.01, 5);
  std::vector<int> columns(1800);
  std::iota(columns.begin(), columns.end(), 0);
  const std::vector<float> straight = NetworkInput(scan.image, std::nullopt, columns);
  for (const int k : {1, 700, 1799}) {
    const std::vector<float> turned = NetworkInput(test::Rolled(scan.image, k), std::nullopt, columns);
    for (std::size_t row = 9 * 16; row < 14 * 16; ++row) {
      for (std::size_t c = 0; c < 1800; ++c) {
        ASSERT_EQ(turned[row * 1800 + c], straight[row * 1800 + (c + static_cast<std::size_t>(k)) % 1800]);
      }
    }
  }
}

}  // namespace
}  // namespace dendro
