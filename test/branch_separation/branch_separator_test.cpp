#include "dendro_slam/branch_separation/branch_separator.h"

#include <algorithm>
#include <limits>
#include <map>
#include <random>
#include <set>
#include <stdexcept>

#include <gtest/gtest.h>

#include "../cylinder_fitting/cone_scan.h"

namespace dendro {
namespace {

using dendro_test::SimulateCones;
using dendro_test::TestCone;
using dendro_test::TestScan;
using dendro_test::TestSensor;
using Eigen::Vector3d;

TestCone Upright(double x, double y, double radius, double low = -1.0, double high = 1.0) {
  return {Vector3d(x, y, low), Vector3d(x, y, high), radius, radius};
}

std::int32_t Set(TestScan* test, int row, int col, double range) {
  RangeImage& image = test->scan.image;
  const std::size_t pixel = image.Index(row, image.WrapColumn(col));
  image.range[pixel] = static_cast<float>(range);
  image.point[pixel] = static_cast<float>(range) * image.beam_direction[pixel];
  image.point_index[pixel] = static_cast<std::int32_t>(pixel);
  test->scan.label[pixel] = Label::kWood;
  return static_cast<std::int32_t>(pixel);
}

// The true cone of most of a segment's pixels, and the share of them.
std::pair<int, double> Majority(const TestScan& test, const Segment& segment) {
  std::map<int, int> votes;
  for (const std::int32_t p : segment.pixels) ++votes[test.truth[static_cast<std::size_t>(p)]];
  int best = -1, count = 0;
  for (const auto& [cone, n] : votes) {
    if (n > count) {
      best = cone;
      count = n;
    }
  }
  return {best, static_cast<double>(count) / static_cast<double>(segment.pixels.size())};
}

TEST(BranchSeparator, NothingInNothingOut) {
  const TestScan test = SimulateCones({}, TestSensor(), 1);
  EXPECT_TRUE(BranchSeparator().Separate(test.scan).empty());
  EXPECT_TRUE(BranchSeparator().Separate(LabelledScan()).empty());
}

TEST(BranchSeparator, TwoTrunksAreTwoSegments) {
  const TestScan test = SimulateCones({Upright(4, 0.5, 0.15), Upright(4, -0.5, 0.1)}, TestSensor(), 1);
  const auto segments = BranchSeparator().Separate(test.scan);
  ASSERT_EQ(segments.size(), 2u);
  EXPECT_EQ(segments[0].id, 0);
  EXPECT_EQ(segments[1].id, 1);
  for (const Segment& s : segments) EXPECT_EQ(Majority(test, s).second, 1.0);
}

TEST(BranchSeparator, SegmentsAreDisjointAscendingAndCoverTheWood) {
  const TestScan test = SimulateCones(
      {Upright(4, 0.5, 0.15), {Vector3d(4, 0.5, 0), Vector3d(3.5, 1.8, 0.9), 0.06, 0.05}},
      TestSensor(), 2);
  std::set<std::int32_t> seen;
  for (const Segment& s : BranchSeparator().Separate(test.scan)) {
    EXPECT_TRUE(std::is_sorted(s.pixels.begin(), s.pixels.end()));
    for (const std::int32_t p : s.pixels) EXPECT_TRUE(seen.insert(p).second);
  }
  std::size_t wood = 0;
  for (std::size_t i = 0; i < test.truth.size(); ++i) wood += test.truth[i] >= 0;
  EXPECT_EQ(seen.size(), wood);
}

TEST(BranchSeparator, OneTrunkAcrossTheColumnSeam) {
  const TestScan test = SimulateCones({Upright(4, 0.0, 0.2)}, TestSensor(), 1);
  EXPECT_EQ(BranchSeparator().Separate(test.scan).size(), 1u);
  BranchSeparatorConfig thesis;
  thesis.thesis_mode = true;
  EXPECT_GT(BranchSeparator(thesis).Separate(test.scan).size(), 1u) << "the thesis does not wrap";
}

TEST(BranchSeparator, SingleMissingPixelsDoNotSplit) {
  TestScan test = SimulateCones({Upright(3.5, 1.0, 0.2)}, TestSensor(), 5);
  for (std::size_t i = 0; i < test.truth.size(); ++i) {
    if (test.truth[i] < 0 || (i % 1800 + i / 1800) % 5 != 0) continue;
    test.scan.label[i] = Label::kNone;
    test.scan.image.point_index[i] = -1;
  }
  EXPECT_EQ(BranchSeparator().Separate(test.scan).size(), 1u);
  BranchSeparatorConfig config;
  config.max_missing_pixels = 0;
  EXPECT_GT(BranchSeparator(config).Separate(test.scan).size(), 1u);
}

TEST(BranchSeparator, ForkIsTrunkAndBranch) {
  const TestCone trunk = Upright(4, 0.5, 0.15, -1.2, 1.5);
  const TestCone branch{Vector3d(4, 0.5, -0.2), Vector3d(4.2, 1.6, 0.9), 0.06, 0.05};
  const TestScan test = SimulateCones({trunk, branch}, TestSensor(), 3);
  std::map<int, std::size_t> largest;
  std::size_t points = 0, pure = 0;
  for (const Segment& s : BranchSeparator().Separate(test.scan)) {
    const auto [cone, share] = Majority(test, s);
    largest[cone] = std::max(largest[cone], s.pixels.size());
    points += s.pixels.size();
    pure += static_cast<std::size_t>(share * static_cast<double>(s.pixels.size()) + 0.5);
  }
  ASSERT_EQ(largest.size(), 2u);
  EXPECT_GT(static_cast<double>(pure) / static_cast<double>(points), 0.95);
  std::size_t trunk_pixels = 0;
  for (const int t : test.truth) trunk_pixels += t == 0;
  EXPECT_GT(largest[0], trunk_pixels * 9 / 10) << "the trunk goes on past the fork";
}

// A level twig met by one ring hangs on its trunk's run there; the rings below and above show the trunk.
TEST(BranchSeparator, OneRowOfATwigIsNotTheTrunks) {
  TestScan test = SimulateCones({Upright(4, 0.0, 0.1)}, TestSensor(), 3);
  const int row = 7;
  int last = -1;  // The trunk lies on both sides of column 0; its highest column there.
  for (int col = 0; col < 100; ++col) {
    if (test.truth[test.scan.image.Index(row, col)] == 0) last = col;
  }
  ASSERT_GT(last, 0);
  std::set<std::int32_t> twig;
  for (int k = 1; k <= 4; ++k) twig.insert(Set(&test, row, last + k, 3.97));
  const auto segments = BranchSeparator().Separate(test.scan);
  ASSERT_EQ(segments.size(), 2u);
  const Segment& trunk = segments[0].pixels.size() > segments[1].pixels.size() ? segments[0] : segments[1];
  int foreign = 0;
  for (const std::int32_t p : trunk.pixels) foreign += static_cast<int>(twig.count(p));
  EXPECT_LE(foreign, 1);
}

TEST(BranchSeparator, ArmsWithTheBackgroundBetweenThemAreNotOneTrunk) {
  const TestCone trunk = Upright(4, 0.0, 0.17, -1.2, 0.0);
  const TestCone left = Upright(4, 0.11, 0.08, 0.0, 1.2), right = Upright(4, -0.11, 0.08, 0.0, 1.2);
  const TestScan test = SimulateCones({trunk, left, right}, TestSensor(), 3);
  for (const Segment& s : BranchSeparator().Separate(test.scan)) {
    std::map<int, int> of_cone;
    for (const std::int32_t p : s.pixels) ++of_cone[test.truth[static_cast<std::size_t>(p)]];
    EXPECT_LE(std::min(of_cone[1], of_cone[2]), 2) << "segment " << s.id << " holds both arms";
  }
}

TEST(BranchSeparator, BranchPassingInFrontIsNotMerged) {
  const TestCone trunk = Upright(5, 0.8, 0.2, -1.3, 1.3);
  const TestCone front{Vector3d(4.2, 0.0, -0.6), Vector3d(4.2, 1.5, 0.6), 0.05, 0.05};
  const TestScan test = SimulateCones({trunk, front}, TestSensor(), 3);
  std::size_t points = 0, pure = 0;
  for (const Segment& s : BranchSeparator().Separate(test.scan)) {
    points += s.pixels.size();
    pure += static_cast<std::size_t>(
        Majority(test, s).second * static_cast<double>(s.pixels.size()) + 0.5);
  }
  EXPECT_GT(static_cast<double>(pure) / static_cast<double>(points), 0.98);
}

// What a nearer branch uncovers row by row is the trunk's, not a row of branches leaving it.
TEST(BranchSeparator, TrunkThatComesOutBehindABranchIsNotCutIntoStrips) {
  const TestCone trunk = Upright(4.5, 0.0, 0.22, -1.5, 1.5);
  for (const double side : {-1.0, 1.0}) {
    const TestCone in_front{Vector3d(3.6, side * 0.15, -0.6), Vector3d(2.8, -side * 0.9, 1.1), 0.1, 0.1};
    for (unsigned seed = 1; seed <= 4; ++seed) {
      const TestScan test = SimulateCones({trunk, in_front}, TestSensor(), seed);
      int pieces = 0;
      std::size_t held = 0, largest = 0;
      for (const Segment& s : BranchSeparator().Separate(test.scan)) {
        if (Majority(test, s).first != 0) continue;
        ++pieces;
        held += s.pixels.size();
        largest = std::max(largest, s.pixels.size());
      }
      // Below it, above it and both of its sides.
      EXPECT_LE(pieces, 4) << seed;
      EXPECT_GT(held, 250u);
      EXPECT_GT(2 * largest, held);
    }
  }
}

TEST(BranchSeparator, CurvedBranchIsCutAndStraightTrunkIsNot) {
  std::vector<TestCone> arc;  // A quarter circle of radius 1.3 m in twelve short cones.
  for (int i = 0; i < 12; ++i) {
    const auto at = [](int k) {
      const double angle = k * 0.5 * M_PI / 12.0;
      return Vector3d(4.0, 1.3 * (1.0 - std::cos(angle)), -0.7 + 1.3 * std::sin(angle));
    };
    arc.push_back({at(i), at(i + 1), 0.06, 0.06});
  }
  EXPECT_GE(BranchSeparator().Separate(SimulateCones(arc, TestSensor(), 1).scan).size(), 2u);
  const TestScan straight = SimulateCones({Upright(4.0, 1.0, 0.06)}, TestSensor(), 1);
  EXPECT_EQ(BranchSeparator().Separate(straight.scan).size(), 1u);
}

TEST(BranchSeparator, LongTrunkIsCutAtTheMaximumLength) {
  const TestScan test = SimulateCones({Upright(8.0, 1.0, 0.2, -2.5, 2.5)}, TestSensor(), 1);
  BranchSeparatorConfig config;
  config.max_length_m = 10.0;
  EXPECT_EQ(BranchSeparator(config).Separate(test.scan).size(), 1u);
  config.max_length_m = 2.5;
  EXPECT_EQ(BranchSeparator(config).Separate(test.scan).size(), 2u);
}

TEST(BranchSeparator, NonFinitePointsAreSkipped) {
  TestScan test = SimulateCones({Upright(4, 0.5, 0.15)}, TestSensor(), 1);
  std::size_t finite = 0;
  for (std::size_t i = 0; i < test.truth.size(); ++i) {
    if (test.truth[i] < 0) continue;
    if (i % 7 == 0) {
      test.scan.image.point[i].y() = std::numeric_limits<float>::quiet_NaN();
    } else {
      ++finite;
    }
  }
  std::size_t kept = 0;
  for (const Segment& s : BranchSeparator().Separate(test.scan)) kept += s.pixels.size();
  EXPECT_EQ(kept, finite);
}

// Algorithms 1 and 2 by hand, 0.28 m:
//   row 0: A A . B B      two instances            -> indices 0, 1
//   row 1: A A . B B      the same count           -> indices 0, 1 again
//   row 2: A . A . B      a missing pixel: three   -> new indices 2, 3, 4
//   row 3: (nothing)      skipped
//   row 4: A A A          one                      -> new index 5
//   row 5: A A' A'        two (a jump in range)    -> new indices 6, 7
TEST(BranchSeparator, ThesisModeFollowsTheAlgorithmsAsPrinted) {
  TestScan test = SimulateCones({}, TestSensor(), 1);
  std::vector<std::vector<std::int32_t>> expected(8);
  const auto put = [&](int index, int row, int col, double range) {
    expected[static_cast<std::size_t>(index)].push_back(Set(&test, row, col, range));
  };
  for (int row = 0; row < 2; ++row) {
    put(0, row, 10, 4.0);
    put(0, row, 11, 4.0);
    put(1, row, 13, 4.0);
    put(1, row, 14, 4.0);
  }
  put(2, 2, 10, 4.0);
  put(3, 2, 12, 4.0);
  put(4, 2, 14, 4.0);
  for (const int col : {10, 11, 12}) put(5, 4, col, 4.0);
  put(6, 5, 10, 4.0);
  put(7, 5, 11, 4.4);
  put(7, 5, 12, 4.4);
  BranchSeparatorConfig config;
  config.thesis_mode = true;
  const auto segments = BranchSeparator(config).Separate(test.scan);
  ASSERT_EQ(segments.size(), expected.size());
  for (auto& pixels : expected) {
    EXPECT_TRUE(std::any_of(segments.begin(), segments.end(),
                            [&](const Segment& s) { return s.pixels == pixels; }));
  }
}

TEST(BranchSeparator, ConstantThresholdIsSelectable) {
  TestScan test = SimulateCones({}, TestSensor(), 1);
  for (int row = 4; row < 10; ++row) {
    for (int c = 0; c < 5; ++c) Set(&test, row, 100 + c, 3.0);
    for (int c = 5; c < 10; ++c) Set(&test, row, 100 + c, 3.22);  // A step of 22 cm.
  }
  BranchSeparatorConfig config;
  EXPECT_EQ(BranchSeparator(config).Separate(test.scan).size(), 2u);
  config.adaptive_threshold = false;
  EXPECT_EQ(BranchSeparator(config).Separate(test.scan).size(), 1u);
}

TEST(BranchSeparator, RandomScansNeitherCrashNorLosePixels) {
  std::mt19937 rng(3);
  std::uniform_real_distribution<double> u(0.0, 1.0);
  for (int k = 0; k < 20; ++k) {
    TestScan test = SimulateCones({}, TestSensor(), 1);
    std::set<std::int32_t> wood;
    const double fill = u(rng) * u(rng);
    for (int row = 0; row < 16; ++row) {
      for (int col = 0; col < 1800; ++col) {
        if (u(rng) < 0.2 * fill) wood.insert(Set(&test, row, col, 1.0 + 10.0 * u(rng)));
      }
    }
    std::set<std::int32_t> seen;
    for (const Segment& s : BranchSeparator().Separate(test.scan)) {
      seen.insert(s.pixels.begin(), s.pixels.end());
    }
    EXPECT_EQ(seen, wood);
  }
}

TEST(BranchSeparator, RefusesAnImageWhoseVectorsDoNotMatch) {
  TestScan test = SimulateCones({}, TestSensor(), 1);
  test.scan.label.pop_back();
  EXPECT_THROW(BranchSeparator().Separate(test.scan), std::invalid_argument);
}

TEST(BranchSeparatorConfig, NamesTheBadField) {
  BranchSeparatorConfig config;
  config.max_incidence_deg = 95.0;
  try {
    BranchSeparator separator(config);
    FAIL();
  } catch (const std::invalid_argument& e) {
    EXPECT_NE(std::string(e.what()).find("max_incidence_deg"), std::string::npos);
  }
}

}  // namespace
}  // namespace dendro
