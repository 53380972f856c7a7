#include "dendro_slam/mapping/georeference.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>
#include <vector>

#include <gtest/gtest.h>

namespace dendro {
namespace {

constexpr double kDeg = M_PI / 180.0;
constexpr std::int64_t kSecond = 1000000000LL;

// Metres per degree on the WGS 84 ellipsoid by the radii of curvature (Snyder 1987, eq. 4-18, 4-20),
// written out here so that the truth does not come from the geodesy library.
struct MetresPerDegree {
  explicit MetresPerDegree(double latitude_deg) {
    const double a = 6378137.0;
    const double e2 = 0.00669437999014;
    const double s = std::sin(latitude_deg * kDeg);
    const double w = std::sqrt(1.0 - e2 * s * s);
    north = a * (1.0 - e2) / (w * w * w) * kDeg;
    east = a / w * std::cos(latitude_deg * kDeg) * kDeg;
  }
  double north;
  double east;
};

// A walk along a rectangle, once around in 120 s.
std::vector<StampedPose> Rectangle(double length_m, double width_m) {
  std::vector<StampedPose> out;
  const double way = 2.0 * (length_m + width_m);
  for (int i = 0; i <= 1200; ++i) {
    double s = way * i / 1200.0;
    StampedPose pose;
    pose.stamp_ns = i * kSecond / 10;
    Eigen::Vector2d p;
    if (s < length_m) {
      p = {s, 0.0};
    } else if ((s -= length_m) < width_m) {
      p = {length_m, s};
    } else if ((s -= width_m) < length_m) {
      p = {length_m - s, width_m};
    } else {
      p = {0.0, width_m - (s - length_m)};
    }
    pose.T_map_lidar.translation() << p, 1.5;
    out.push_back(pose);
  }
  return out;
}

// Fixes once a second of a map whose origin and heading are given; a slow error and white noise.
std::vector<GeoFix> Fixes(const std::vector<StampedPose>& walk, double latitude_deg,
                          double longitude_deg, double heading_deg, double slow_m, double white_m,
                          int seed) {
  const MetresPerDegree metres(latitude_deg);
  std::mt19937 rng(static_cast<unsigned>(seed));
  std::normal_distribution<double> gauss;
  std::vector<GeoFix> out;
  Eigen::Vector2d error(slow_m * gauss(rng), slow_m * gauss(rng));
  const double keep = std::exp(-1.0 / 20.0);
  for (std::size_t i = 0; i < walk.size(); i += 10) {
    error = keep * error +
            slow_m * std::sqrt(1.0 - keep * keep) * Eigen::Vector2d(gauss(rng), gauss(rng));
    const Eigen::Vector3d p = walk[i].T_map_lidar.translation();
    // The map's x axis points to `heading` clockwise from north, y a quarter turn to its left.
    const double h = heading_deg * kDeg;
    const double east = std::sin(h) * p.x() - std::cos(h) * p.y() + error.x() + white_m * gauss(rng);
    const double north = std::cos(h) * p.x() + std::sin(h) * p.y() + error.y() + white_m * gauss(rng);
    GeoFix fix;
    fix.stamp_ns = walk[i].stamp_ns;
    fix.latitude_deg = latitude_deg + north / metres.north;
    fix.longitude_deg = longitude_deg + east / metres.east;
    fix.altitude_m = 250.0 + p.z();
    fix.horizontal_sigma_m = std::max(0.02, std::hypot(slow_m, white_m));
    out.push_back(fix);
  }
  return out;
}

std::optional<Georeference> Solve(const std::vector<StampedPose>& walk,
                                  const std::vector<GeoFix>& fixes,
                                  const GeoreferencerConfig& config = GeoreferencerConfig()) {
  Georeferencer georeferencer(config);
  for (const GeoFix& fix : fixes) EXPECT_TRUE(georeferencer.Add(fix));
  return georeferencer.Solve(walk);
}

double HeadingOff(double a, double b) { return std::abs(std::remainder(a - b, 360.0)); }

// One degree of latitude at 45 degrees north is 111 131.8 m, of longitude 78 846.8 m (tables of the
// WGS 84 ellipsoid), so the expected numbers can be checked by hand.
TEST(Georeference, ByHand) {
  std::vector<StampedPose> walk(2);
  walk[0].stamp_ns = 0;
  walk[1].stamp_ns = kSecond;
  walk[1].T_map_lidar.translation().x() = 100.0;  // 100 m along the map's x axis ...
  GeoFix start;
  start.latitude_deg = 45.0;
  start.longitude_deg = 7.0;
  start.horizontal_sigma_m = 0.02;
  GeoFix end = start;
  end.stamp_ns = kSecond;
  end.longitude_deg = 7.0 + 100.0 / 78846.8;  // ... are 100 m to the east.
  GeoreferencerConfig config;
  config.min_fixes = 2;
  const auto found = Solve(walk, {start, end}, config);
  ASSERT_TRUE(found.has_value());
  ASSERT_TRUE(found->heading_deg.has_value());
  EXPECT_NEAR(*found->heading_deg, 90.0, 0.01);
  EXPECT_NEAR(found->origin.latitude_deg, 45.0, 1e-7);
  EXPECT_NEAR(found->origin.longitude_deg, 7.0, 1e-7);
  EXPECT_FALSE(found->origin.altitude_m.has_value());
  // 100 m to the left of east is north.
  const GeoPosition north = found->Locate({0.0, 100.0, 0.0});
  EXPECT_NEAR(north.latitude_deg, 45.0 + 100.0 / 111131.8, 2e-7);
  EXPECT_NEAR(north.longitude_deg, 7.0, 2e-7);
  EXPECT_TRUE(found->note.empty());
}

TEST(Georeference, ExactFixesAnyPlaceAndHeading) {
  const auto walk = Rectangle(40.0, 25.0);
  for (const double latitude : {-33.4, 0.0, 41.7, 68.0}) {
    for (const double heading : {0.0, 77.0, 180.0, 359.5}) {
      const auto found = Solve(walk, Fixes(walk, latitude, 0.4575, heading, 0.0, 0.0, 1));
      ASSERT_TRUE(found && found->heading_deg) << latitude << " " << heading;
      const MetresPerDegree metres(latitude);
      EXPECT_LT(HeadingOff(*found->heading_deg, heading), 0.01);
      EXPECT_NEAR((found->origin.latitude_deg - latitude) * metres.north, 0.0, 0.01);
      EXPECT_NEAR((found->origin.longitude_deg - 0.4575) * metres.east, 0.0, 0.01);
      ASSERT_TRUE(found->origin.altitude_m.has_value());
      EXPECT_NEAR(*found->origin.altitude_m, 250.0, 0.01);
      EXPECT_LT(found->residual_m, 0.01);
    }
  }
}

// Over many walks the errors must be of the size that the sigmas say.
TEST(Georeference, SigmasCoverTheErrors) {
  const auto walk = Rectangle(60.0, 30.0);
  int heading_within = 0;
  int position_within = 0;
  constexpr int kRuns = 200;
  for (int seed = 0; seed < kRuns; ++seed) {
    const auto found = Solve(walk, Fixes(walk, 50.0, 8.0, 33.0, 1.5, 0.5, seed));
    ASSERT_TRUE(found && found->heading_deg) << seed;
    heading_within += HeadingOff(*found->heading_deg, 33.0) < 2.0 * found->heading_sigma_deg;
    // At the pivot, where the two do not mix.
    const GeoPosition pivot = found->Locate({found->pivot.x(), found->pivot.y(), 0.0});
    const MetresPerDegree metres(50.0);
    const double h = 33.0 * kDeg;
    const double north = std::cos(h) * found->pivot.x() + std::sin(h) * found->pivot.y();
    const double off = (pivot.latitude_deg - 50.0) * metres.north - north;
    position_within += std::abs(off) < 2.0 * found->horizontal_sigma_m;
  }
  std::printf("within two sigmas: heading %d, position %d of %d\n", heading_within, position_within,
              kRuns);
  EXPECT_GE(heading_within, 170);
  EXPECT_GE(position_within, 170);
}

TEST(Georeference, OutliersHaveNoSay) {
  const auto walk = Rectangle(60.0, 30.0);
  auto fixes = Fixes(walk, 50.0, 8.0, 120.0, 0.3, 0.2, 5);
  // A fifth of the fixes 60 to 200 m off, all to the same side, as under a wall.
  int outliers = 0;
  for (std::size_t i = 0; i < fixes.size(); i += 5) {
    fixes[i].latitude_deg += (60.0 + static_cast<double>(i)) / 111000.0;
    ++outliers;
  }
  const auto found = Solve(walk, fixes);
  ASSERT_TRUE(found && found->heading_deg);
  EXPECT_LT(HeadingOff(*found->heading_deg, 120.0), 1.0);
  const MetresPerDegree metres(50.0);
  EXPECT_NEAR((found->origin.latitude_deg - 50.0) * metres.north, 0.0, 0.6);
  EXPECT_EQ(found->num_outliers, outliers);
}

TEST(Georeference, AShortWalkTellsNoHeading) {
  const auto walk = Rectangle(3.0, 2.0);
  const auto found = Solve(walk, Fixes(walk, 50.0, 8.0, 120.0, 2.0, 1.0, 6));
  ASSERT_TRUE(found.has_value());
  EXPECT_FALSE(found->heading_deg.has_value());
  EXPECT_GT(found->heading_sigma_deg, 10.0);
  EXPECT_NE(found->note.find("heading is not known"), std::string::npos);
  // Its place is still known, with the walk's size on top.
  EXPECT_NEAR(found->origin.latitude_deg, 50.0, 6.0 / 111000.0);
  EXPECT_GT(found->HorizontalSigma({3.0, 2.0, 0.0}), found->horizontal_sigma_m);
  const GeoPosition far = found->Locate({100.0, 0.0, 0.0});
  EXPECT_NEAR(far.latitude_deg, found->origin.latitude_deg, 1e-12);
  EXPECT_GT(found->HorizontalSigma({100.0, 0.0, 0.0}), 90.0);

  // Standing still tells nothing of the heading at all.
  std::vector<StampedPose> still = walk;
  for (StampedPose& pose : still) pose.T_map_lidar = Eigen::Isometry3d::Identity();
  const auto standing = Solve(still, Fixes(still, 50.0, 8.0, 120.0, 2.0, 1.0, 7));
  ASSERT_TRUE(standing.has_value());
  EXPECT_FALSE(standing->heading_deg.has_value());
}

TEST(Georeference, TheAntennaIsNotTheLidar) {
  auto walk = Rectangle(40.0, 25.0);
  auto fixes = Fixes(walk, 50.0, 8.0, 10.0, 0.0, 0.0, 1);
  // The lidar is carried turned by 90 degrees, half a metre from the antenna along its own x axis.
  for (StampedPose& pose : walk) {
    pose.T_map_lidar.linear() = Eigen::AngleAxisd(0.5 * M_PI, Eigen::Vector3d::UnitZ()).toRotationMatrix();
    pose.T_map_lidar.translation().y() -= 0.5;
  }
  GeoreferencerConfig config;
  config.antenna_x_m = 0.5;
  const auto found = Solve(walk, fixes, config);
  ASSERT_TRUE(found && found->heading_deg);
  EXPECT_LT(found->residual_m, 0.01);
  EXPECT_LT(HeadingOff(*found->heading_deg, 10.0), 0.01);
}

TEST(Georeference, RefusesWhatIsNoFix) {
  Georeferencer georeferencer;
  GeoFix fix;
  fix.latitude_deg = 91.0;
  EXPECT_FALSE(georeferencer.Add(fix));
  fix.latitude_deg = std::nan("");
  EXPECT_FALSE(georeferencer.Add(fix));
  fix.latitude_deg = 50.0;
  EXPECT_TRUE(georeferencer.Add(fix));
  EXPECT_FALSE(georeferencer.Add(fix)) << "the same stamp again";
  EXPECT_FALSE(georeferencer.Solve(Rectangle(10.0, 10.0)).has_value()) << "a single fix";
  EXPECT_FALSE(georeferencer.Solve({}).has_value());
  GeoreferencerConfig config;
  config.default_sigma_m = 0.0;
  EXPECT_THROW(Georeferencer{config}, std::invalid_argument);
}

}  // namespace
}  // namespace dendro
