#include "dendro_slam/segmentation/network_input.h"

#include <cmath>
#include <numeric>
#include <optional>
#include <vector>

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

}  // namespace
}  // namespace dendro
