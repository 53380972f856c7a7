#include "dendro_slam/segmentation/line_support.h"

#include <algorithm>
#include <cmath>
#include <random>
#include <vector>

#include <Eigen/Dense>
#include <gtest/gtest.h>

namespace dendro {
namespace {

enum Plane { kSupport, kOnLine, kBend, kDepth, kSlope, kLikeness, kElsewhere };

class Scan {
 public:
  Scan(int rows, int cols, double row_gap_rad) {
    input_.rows = rows;
    input_.cols = cols;
    input_.row_gap_rad = static_cast<float>(row_gap_rad);
    const auto n = static_cast<std::size_t>(rows * cols);
    input_.range.assign(n, 0.0F);
    input_.log_width.assign(n, 0.0F);
    input_.wanted.assign(n, 0);
  }
  void Put(int row, int col, double range, double log_width = -2.0) {
    const std::size_t i = Index(row, col);
    input_.range[i] = static_cast<float>(range);
    input_.log_width[i] = static_cast<float>(log_width);
    input_.wanted[i] = 1;
  }
  // Elevation of a row and azimuth of a column, the latter clockwise as in a RangeImage.
  Eigen::Vector3d Beam(int row, double col) const {
    const double elevation = (row - 0.5 * (input_.rows - 1)) * input_.row_gap_rad;
    const double azimuth = -2.0 * M_PI * (col + 0.5) / input_.cols;
    return {std::cos(elevation) * std::cos(azimuth), std::cos(elevation) * std::sin(azimuth),
            std::sin(elevation)};
  }
  // One return in every row that the straight line through `a` along `d` crosses.
  std::vector<int> PutLine(const Eigen::Vector3d& a, const Eigen::Vector3d& d) {
    std::vector<int> cols;
    for (int row = 0; row < input_.rows; ++row) {
      // The line meets the cone of the row's elevation where z = tan(elevation) * hypot(x, y).
      const double slope = std::tan((row - 0.5 * (input_.rows - 1)) * input_.row_gap_rad);
      double low = -3.0;
      double high = 3.0;
      const auto above = [&](double t) {
        const Eigen::Vector3d p = a + t * d;
        return p.z() - slope * p.head<2>().norm();
      };
      for (int k = 0; k < 100; ++k) {
        const double middle = 0.5 * (low + high);
        (above(middle) > 0.0 ? high : low) = middle;
      }
      const Eigen::Vector3d p = a + low * d;
      const double azimuth = std::atan2(-p.y(), p.x());
      const int col = static_cast<int>(std::floor(azimuth / (2.0 * M_PI) * input_.cols + input_.cols)) %
                      input_.cols;
      Put(row, col, p.norm());
      cols.push_back(col);
    }
    return cols;
  }
  void Run() { out_ = LineSupport(input_); }
  float At(int plane, int row, int col) const {
    return out_[static_cast<std::size_t>(plane * input_.rows * input_.cols) + Index(row, col)];
  }
  const std::vector<float>& out() const { return out_; }
  LineSupportInput& input() { return input_; }

 private:
  std::size_t Index(int row, int col) const {
    return static_cast<std::size_t>(row * input_.cols + (col + input_.cols) % input_.cols);
  }
  LineSupportInput input_;
  std::vector<float> out_;
};

constexpr double kVlp16Gap = 2.0 * M_PI / 180.0;

TEST(LineSupport, StraightTwigGoesOnInEveryRow) {
  // Across azimuth 0, leaning sideways and towards the sensor.
  Scan scan(16, 1800, kVlp16Gap);
  const Eigen::Vector3d lean(-0.4, 0.35, 1.0);
  const std::vector<int> cols = scan.PutLine({5.0, 0.0, 0.0}, lean);
  scan.Run();
  for (int row = 3; row + 3 < 16; ++row) {
    const int col = cols[static_cast<std::size_t>(row)];
    // The slope is a whole number of columns a row: a pixel three rows away may be missed by one.
    EXPECT_GE(scan.At(kOnLine, row, col), 1.66F) << row;
    EXPECT_GT(scan.At(kSupport, row, col), 1.3F) << row;
    EXPECT_LT(scan.At(kBend, row, col), 0.3F) << row;
    EXPECT_EQ(scan.At(kLikeness, row, col), 0.0F);
    // Columns and range a row, from the geometry.
    const double columns = 0.5 * std::remainder(cols[static_cast<std::size_t>(row + 1)] -
                                                    cols[static_cast<std::size_t>(row - 1)], 1800.0);
    EXPECT_NEAR(12.0 * scan.At(kSlope, row, col), columns, 2.0) << row;
    const auto range = [&](int r) {
      return scan.input().range[static_cast<std::size_t>(r * 1800 + cols[static_cast<std::size_t>(r)])];
    };
    EXPECT_NEAR(scan.At(kDepth, row, col), 0.5 * (range(row + 1) - range(row - 1)) / (range(row) * kVlp16Gap),
                1e-3);
  }
}

TEST(LineSupport, LoneReturnIsPassedOnAllSides) {
  Scan scan(16, 1800, kVlp16Gap);
  scan.Put(8, 900, 4.0);
  scan.Run();
  EXPECT_NEAR(scan.At(kSupport, 8, 900), -2.0F, 1e-5F);
  EXPECT_EQ(scan.At(kOnLine, 8, 900), 0.0F);
  EXPECT_NEAR(scan.At(kElsewhere, 8, 900), -2.0F, 1e-5F);
  // Rows outside of the image count for nothing.
  Scan edge(16, 1800, kVlp16Gap);
  edge.Put(0, 900, 4.0);
  edge.Run();
  EXPECT_NEAR(edge.At(kSupport, 0, 900), -1.0F, 1e-5F);
}

TEST(LineSupport, WhatIsHiddenDoesNotSpeakAgainstALine) {
  // Above the return and its neighbours something nearer, or something behind.
  const auto support = [](double range_above) {
    Scan scan(16, 1800, kVlp16Gap);
    for (int row = 5; row <= 9; ++row) scan.Put(row, 900, 4.0);
    for (int row = 10; row <= 11; ++row) {
      for (int col = 850; col <= 950; ++col) scan.Put(row, col, range_above);
    }
    scan.Run();
    return scan.At(kSupport, 8, 900);
  };
  // Four rows on the line (9, 7, 6, 5); rows 10 and 11 hidden or passed.
  EXPECT_NEAR(support(2.0), 4.0 / 3.0, 0.02);
  EXPECT_NEAR(support(6.0), 2.0 / 3.0, 0.02);
}

TEST(LineSupport, RunsOfAnotherWidthAreUnlike) {
  Scan scan(16, 1800, kVlp16Gap);
  for (int row = 0; row < 16; ++row) scan.Put(row, 700, 3.0, row == 8 ? -1.0 : -2.5);
  scan.Run();
  EXPECT_NEAR(scan.At(kLikeness, 8, 700), 1.5F, 1e-5F);
  EXPECT_NEAR(scan.At(kSupport, 8, 700), (6.0 - 0.3 * 1.5) / 3.0, 0.02);
}

TEST(LineSupport, StepInDepthIsNoLine) {
  // A return 15 cm before a straight line of returns: the line goes on behind it.
  Scan scan(16, 1800, kVlp16Gap);
  for (int row = 0; row < 16; ++row) scan.Put(row, 700, row == 8 ? 2.85 : 3.0);
  scan.Run();
  EXPECT_LT(scan.At(kSupport, 8, 700), -1.0F);
  EXPECT_GT(scan.At(kSupport, 6, 700), 0.9F);
}

// What the training's mirrored and upside down scans rely on.
TEST(LineSupport, MirroredAndUpsideDownOnlyTheSignsChange) {
  constexpr int kRows = 9;
  constexpr int kCols = 300;
  Scan scan(kRows, kCols, 5.0 * 2.0 * M_PI / kCols);
  Scan mirrored(kRows, kCols, 5.0 * 2.0 * M_PI / kCols);
  Scan turned(kRows, kCols, 5.0 * 2.0 * M_PI / kCols);
  std::mt19937 engine(11);
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  for (int row = 0; row < kRows; ++row) {
    for (int col = 0; col < kCols; ++col) {
      if (uniform(engine) < 0.3) continue;
      const double range = 3.0 + 0.4 * uniform(engine);
      const double width = -3.0 + 3.0 * uniform(engine);
      scan.Put(row, col, range, width);
      mirrored.Put(row, kCols - 1 - col, range, width);
      turned.Put(kRows - 1 - row, col, range, width);
    }
  }
  scan.Run();
  mirrored.Run();
  turned.Run();
  int compared = 0;
  for (int row = 0; row < kRows; ++row) {
    for (int col = 0; col < kCols; ++col) {
      const auto expect = [&](const Scan& other, int r, int c, int plane, float sign) {
        // Slopes a column apart may find the same returns: the first of them is named.
        const float slack = plane == kSlope ? 2.01F / 6.0F : 1e-4F;
        ASSERT_NEAR(other.At(plane, r, c), sign * scan.At(plane, row, col), slack) << plane;
      };
      for (const int plane : {kSupport, kElsewhere}) {
        expect(mirrored, row, kCols - 1 - col, plane, 1.0F);
        expect(turned, kRows - 1 - row, col, plane, 1.0F);
      }
      if (scan.At(kOnLine, row, col) == 0.0F) continue;  // All slopes are as bad: any may be named.
      ++compared;
      for (const int plane : {kOnLine, kBend, kLikeness}) {
        expect(mirrored, row, kCols - 1 - col, plane, 1.0F);
        expect(turned, kRows - 1 - row, col, plane, 1.0F);
      }
      expect(mirrored, row, kCols - 1 - col, kSlope, -1.0F);
      expect(mirrored, row, kCols - 1 - col, kDepth, 1.0F);
      expect(turned, kRows - 1 - row, col, kSlope, -1.0F);
      expect(turned, kRows - 1 - row, col, kDepth, -1.0F);
    }
  }
  EXPECT_GT(compared, 1000);
}

TEST(LineSupport, OnlyWhereWantedAndFiniteForAnySize) {
  for (const int rows : {1, 2, 7}) {
    for (const int cols : {1, 5, 360}) {
      Scan scan(rows, cols, kVlp16Gap);
      for (int row = 0; row < rows; ++row) {
        for (int col = 0; col < cols; col += 2) scan.Put(row, col, 1.0 + 0.01 * col);
      }
      scan.input().wanted.assign(scan.input().wanted.size(), 0);
      const std::size_t last = scan.input().wanted.size() - 1;
      scan.input().wanted[last] = 1;
      scan.Run();
      for (std::size_t i = 0; i < scan.out().size(); ++i) {
        ASSERT_TRUE(std::isfinite(scan.out()[i]));
        ASSERT_LE(std::abs(scan.out()[i]), 5.0F);
        if (i % (last + 1) != last) ASSERT_EQ(scan.out()[i], 0.0F);
      }
    }
  }
}

}  // namespace
}  // namespace dendro
