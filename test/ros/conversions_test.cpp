#include "dendro_slam/ros/conversions.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <limits>
#include <random>

#include "dendro_slam/geometry/so3.h"
#include "dendro_slam/ros/markers.h"
#include "dendro_slam/ros/point_cloud2.h"

namespace dendro_ros {
namespace {

using dendro::Matrix6d;
using dendro::Vector6d;

Eigen::Isometry3d SomePose() {
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  T.linear() = dendro::ExpSo3({0.4, -0.9, 1.3});
  T.translation() = Eigen::Vector3d(1.0, -2.0, 0.5);
  return T;
}

Matrix6d SomeCovariance() {
  std::mt19937 random(7);
  std::normal_distribution<double> normal;
  Matrix6d A;
  for (int i = 0; i < 36; ++i) A(i / 6, i % 6) = normal(random);
  return A * A.transpose() + 0.1 * Matrix6d::Identity();
}

TEST(Stamp, RoundTripsToTheNanosecond) {
  const std::int64_t stamp = 1700000000123456789;
  EXPECT_EQ(ToNs(ToRosTime(stamp)), stamp);
  EXPECT_EQ(ToRosTime(stamp).sec, 1700000000U);
  EXPECT_EQ(ToRosTime(stamp).nsec, 123456789U);
  EXPECT_THROW(ToRosTime(-1), std::invalid_argument);
  EXPECT_THROW(ToRosTime(std::int64_t{1} << 62), std::invalid_argument);
}

TEST(PoseCovariance, QuarterTurnByHand) {
  // x of the body points along y of the parent: a sideways sigma of the body's x is the parent's y.
  Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
  T.linear() << 0, -1, 0, 1, 0, 0, 0, 0, 1;
  Vector6d variances;
  variances << 1, 2, 3, 4, 5, 6;  // omega x y z, rho x y z of the body
  const Matrix6d ros = ToFixedAxesCovariance(T, variances.asDiagonal());
  Vector6d expected;
  expected << 5, 4, 6, 2, 1, 3;  // parent x y z, rotation about parent x y z
  EXPECT_TRUE(ros.isApprox(Matrix6d(expected.asDiagonal()), 1e-12)) << ros;
}

TEST(PoseCovariance, MatchesSampledPerturbationsOfANonDiagonalCovariance) {
  // The ROS perturbation is read off the perturbed pose itself: translation in the parent's axes,
  // and the rotation vector of R' R^T, which has fixed axes.
  const Eigen::Isometry3d T = SomePose();
  const Matrix6d tangent = SomeCovariance();
  Matrix6d expected = Matrix6d::Zero();
  const Eigen::LLT<Matrix6d> llt(tangent);
  constexpr double kStep = 1e-6;
  for (int i = 0; i < 6; ++i) {
    const Vector6d xi = kStep * Vector6d(Matrix6d(llt.matrixL()).col(i));
    const Eigen::Isometry3d perturbed = T * dendro::ExpSe3(xi);
    Vector6d ros;
    ros.head<3>() = perturbed.translation() - T.translation();
    ros.tail<3>() = dendro::LogSo3(perturbed.linear() * T.linear().transpose());
    expected += ros * ros.transpose() / (kStep * kStep);
  }
  const Matrix6d ros = ToFixedAxesCovariance(T, tangent);
  EXPECT_TRUE(ros.isApprox(expected, 1e-5)) << ros << "\n\n" << expected;
  EXPECT_FALSE(ros.isApprox(tangent, 0.1));
}

TEST(PoseCovariance, RoundTripsThroughTheMessage) {
  const Eigen::Isometry3d T = SomePose();
  const Matrix6d covariance = SomeCovariance();
  nav_msgs::Odometry odometry;
  odometry.header.stamp = ToRosTime(12345678901);
  odometry.pose = ToMsg(T, covariance);
  const OdometryPose read = FromMsg(odometry);
  EXPECT_EQ(read.stamp_ns, 12345678901);
  EXPECT_TRUE(read.T_odom_child.isApprox(T, 1e-12));
  EXPECT_TRUE(read.covariance.isApprox(covariance, 1e-12));
}

TEST(Pose, RefusesWhatIsNotARigidMotion) {
  geometry_msgs::Pose pose;  // All zeros: an unset quaternion.
  EXPECT_THROW(FromMsg(pose), std::invalid_argument);
  pose.orientation.w = 1.0;
  EXPECT_NO_THROW(FromMsg(pose));
  pose.position.x = std::numeric_limits<double>::quiet_NaN();
  EXPECT_THROW(FromMsg(pose), std::invalid_argument);
}

TEST(IcpOdometry, CarriesTheMotionBetweenTwoScans) {
  dendro::RelativeMotion motion;
  motion.from_stamp_ns = 1000000000;
  motion.to_stamp_ns = 1100000000;
  motion.T_from_to = dendro::ExpSe3((Vector6d() << 0.01, -0.02, 0.03, 0.1, 0.05, -0.02).finished());
  motion.covariance = 1e-4 * SomeCovariance();
  const Eigen::Isometry3d T0 = SomePose();
  const auto previous = ToIcpOdometryWithoutMotion(motion.from_stamp_ns, T0, "icp_odom", "velodyne");
  const auto current = ToIcpOdometry(motion, T0 * motion.T_from_to, "icp_odom", "velodyne");
  EXPECT_FALSE(MotionBetween(previous, previous).has_value());
  const auto read = MotionBetween(previous, current);
  ASSERT_TRUE(read.has_value());
  EXPECT_EQ(read->from_stamp_ns, motion.from_stamp_ns);
  EXPECT_EQ(read->to_stamp_ns, motion.to_stamp_ns);
  EXPECT_TRUE(read->T_from_to.isApprox(motion.T_from_to, 1e-12));
  EXPECT_TRUE(read->covariance.isApprox(motion.covariance, 1e-9));
  // 0.1 m in 0.1 s along x.
  EXPECT_NEAR(current.twist.twist.linear.x, 1.0, 0.05);
}

dendro::LabelledScan SomeScan() {
  const float nan = std::numeric_limits<float>::quiet_NaN();
  dendro::LabelledScan scan;
  dendro::RangeImage& image = scan.image;
  image.stamp_ns = 42000000007;
  image.rows = 2;
  image.cols = 3;
  image.deskewed = true;
  for (int i = 0; i < 6; ++i) {
    const bool hit = i != 4;
    const auto f = static_cast<float>(i);
    image.point.emplace_back(hit ? f : nan, hit ? 1.0F : nan, hit ? -f : nan);
    image.range.push_back(hit ? 3.0F + f : nan);
    image.intensity.push_back(hit ? 10.0F * f : 0.0F);
    image.time_s.push_back(0.001F * f);
    image.beam_origin.emplace_back(0.0F, 0.0F, 0.01F * f);
    image.beam_direction.emplace_back(1.0F, 0.0F, 0.0F);
    image.point_index.push_back(hit ? 5 - i : -1);
    scan.wood_probability.push_back(hit ? 0.1F * f : 0.0F);
    scan.label.push_back(hit ? dendro::Label::kWood : dendro::Label::kNone);
  }
  image.pixel_of_point = {5, -1, 3, 2, 1, 0};
  return scan;
}

TEST(WoodScan, RoundTripsEveryPixel) {
  const dendro::LabelledScan scan = SomeScan();
  const auto cloud = ToWoodScan(scan, "velodyne");
  EXPECT_EQ(cloud->height, 2U);
  EXPECT_EQ(cloud->width, 3U);
  EXPECT_EQ(cloud->header.frame_id, "velodyne");
  const dendro::LabelledScan read = FromWoodScan(*cloud, "wood_scan");
  EXPECT_EQ(read.image.stamp_ns, scan.image.stamp_ns);
  EXPECT_TRUE(read.image.deskewed);
  for (std::size_t i = 0; i < 6; ++i) {
    if (scan.image.HasReturn(i)) {
      EXPECT_EQ(read.image.point[i], scan.image.point[i]);
      EXPECT_EQ(read.image.range[i], scan.image.range[i]);
    } else {
      EXPECT_FALSE(read.image.point[i].allFinite());
    }
    EXPECT_EQ(read.image.intensity[i], scan.image.intensity[i]);
    EXPECT_EQ(read.image.time_s[i], scan.image.time_s[i]);
    EXPECT_EQ(read.image.beam_origin[i], scan.image.beam_origin[i]);
    EXPECT_EQ(read.image.beam_direction[i], scan.image.beam_direction[i]);
    EXPECT_EQ(read.image.point_index[i], scan.image.point_index[i]);
    EXPECT_EQ(read.wood_probability[i], scan.wood_probability[i]);
    EXPECT_EQ(read.label[i], scan.label[i]);
  }
  EXPECT_EQ(read.image.pixel_of_point, scan.image.pixel_of_point);
}

TEST(WoodScan, RefusesAnotherCloud) {
  auto cloud = ToVelodyneCloud(dendro::LidarScan{}, "velodyne");
  try {
    FromWoodScan(*cloud, "/some/topic");
    FAIL() << "accepted";
  } catch (const PointCloud2Error& error) {
    EXPECT_NE(std::string(error.what()).find("/some/topic"), std::string::npos);
  }
}

TEST(Images, ShowTheHighestRingFirst) {
  const dendro::LabelledScan scan = SomeScan();
  const auto range = ToRangeImageMsg(scan.image, "velodyne");
  std::uint16_t first = 0;
  std::memcpy(&first, range->data.data(), 2);
  EXPECT_EQ(first, 600);  // Row 1, column 0: range 6 m.
  std::uint16_t missing = 1;
  std::memcpy(&missing, range->data.data() + 2, 2);
  EXPECT_EQ(missing, 0);
  const auto labels = ToLabelImageMsg(scan, "velodyne");
  ASSERT_EQ(labels->data.size(), 18U);
  EXPECT_EQ(labels->data[0], LabelColor(dendro::Label::kWood)[0]);
}

TEST(Segments, RoundTripAndRefusePixelsOutside) {
  const std::vector<dendro::Segment> segments = {{0, {1, 2, 5}}, {1, {}}};
  const auto msg = ToMsg(segments, 5, "velodyne");
  const auto read = FromMsg(*msg, 6);
  ASSERT_EQ(read.size(), 2U);
  EXPECT_EQ(read[0].pixels, segments[0].pixels);
  EXPECT_EQ(read[1].id, 1);
  EXPECT_THROW(FromMsg(*msg, 5), std::invalid_argument);
}

TEST(ScanCylinders, GroundRoundTrip) {
  EXPECT_FALSE(GroundFromMsg(*ToMsg(std::vector<dendro::FittedCylinder>{}, 5, "velodyne")));
  dendro::GroundPlane ground;
  ground.normal = Eigen::Vector3f(0.1F, -0.2F, 0.97F).normalized();
  ground.offset = 1.4F;
  const auto msg = ToMsg(std::vector<dendro::FittedCylinder>{}, 5, "velodyne", ground);
  const auto back = GroundFromMsg(*msg);
  ASSERT_TRUE(back.has_value());
  EXPECT_EQ(back->normal, ground.normal);
  EXPECT_EQ(back->offset, ground.offset);
  msg->ground_offset = NAN;
  EXPECT_THROW(GroundFromMsg(*msg), std::invalid_argument);
}

TEST(ScanCylinders, RoundTrip) {
  dendro::FittedCylinder fit;
  fit.segment_id = 3;
  fit.status = dendro::FitStatus::kMeasured;
  fit.cylinder.axis = Eigen::Vector3d(1, 2, 3).normalized();
  fit.cylinder.point = {4, 5, 6};
  fit.cylinder.curvature = 12.5;
  for (int i = 0; i < 25; ++i) fit.covariance(i / 5, i % 5) = i;
  fit.taper_m_per_m = -0.02;
  fit.taper_sigma_m_per_m = 0.01;
  fit.taper_estimated = true;
  fit.bend_information << 0.1, 0.2, 0.2, 0.5;
  fit.bend_vector << 0.03, -0.04;
  fit.start_s_m = -0.4;
  fit.end_s_m = 0.5;
  fit.end_sigma_m = 0.05;
  fit.num_points = 77;
  fit.num_rings = 6;
  fit.distance_m = 5.5;
  fit.visible_arc_rad = 2.5;
  fit.mean_abs_deviation_m = 0.007;
  const auto read = FromMsg(*ToMsg({fit}, 9, "velodyne"));
  ASSERT_EQ(read.size(), 1U);
  EXPECT_EQ(read[0].segment_id, 3);
  EXPECT_EQ(read[0].status, dendro::FitStatus::kMeasured);
  EXPECT_EQ(read[0].cylinder.axis, fit.cylinder.axis);
  EXPECT_EQ(read[0].cylinder.point, fit.cylinder.point);
  EXPECT_EQ(read[0].cylinder.curvature, 12.5);
  EXPECT_EQ(read[0].covariance, fit.covariance);
  EXPECT_EQ(read[0].taper_m_per_m, -0.02);
  EXPECT_TRUE(read[0].taper_estimated);
  EXPECT_EQ(read[0].bend_information, fit.bend_information);
  EXPECT_EQ(read[0].bend_vector, fit.bend_vector);
  EXPECT_EQ(read[0].end_s_m, 0.5);
  EXPECT_EQ(read[0].num_rings, 6);
  EXPECT_EQ(read[0].mean_abs_deviation_m, 0.007);

  auto bad = ToMsg({fit}, 9, "velodyne");
  bad->cylinders[0].curvature = std::numeric_limits<double>::quiet_NaN();
  EXPECT_THROW(FromMsg(*bad), std::invalid_argument);
}

TEST(TreeMap, RoundTrip) {
  dendro::TreeModel model;
  model.stamp_ns = 77;
  dendro::MapCylinder cylinder;
  cylinder.id = 4;
  cylinder.branch_id = 2;
  cylinder.start = {1, 2, 3};
  cylinder.end = {1, 2, 4};
  cylinder.radius_m = 0.1;
  cylinder.taper_m_per_m = -0.01;
  cylinder.status = dendro::FitStatus::kInferred;
  model.cylinders.push_back(cylinder);
  dendro::MapBranch branch;
  branch.id = 2;
  branch.cylinder_ids = {4};
  branch.angle_rad = 0.7;
  model.branches.push_back(branch);
  dendro::MapTree tree;
  tree.trunk_branch_id = 2;
  model.trees.push_back(tree);
  tree.id = 1;
  tree.dbh_m = 0.25;
  model.trees.push_back(tree);
  const dendro::TreeModel read = FromMsg(*ToMsg(model, "map"));
  EXPECT_EQ(read.stamp_ns, 77);
  ASSERT_EQ(read.cylinders.size(), 1U);
  EXPECT_EQ(read.cylinders[0].end, cylinder.end);
  EXPECT_EQ(read.cylinders[0].status, dendro::FitStatus::kInferred);
  EXPECT_EQ(read.branches[0].cylinder_ids, branch.cylinder_ids);
  EXPECT_FALSE(read.trees[0].dbh_m.has_value());
  EXPECT_EQ(read.trees[1].dbh_m.value(), 0.25);
}

TEST(Markers, OneMeshPerTreeAndALabelPerBranch) {
  dendro::TreeModel model;
  for (int i = 0; i < 4; ++i) {
    dendro::MapCylinder cylinder;
    cylinder.id = i;
    cylinder.tree_id = i / 2;
    cylinder.branch_id = i;
    cylinder.start = {0, 0, static_cast<double>(i)};
    cylinder.end = {0, 0, i + 1.0};
    cylinder.radius_m = 0.1;
    model.cylinders.push_back(cylinder);
    dendro::MapBranch branch;
    branch.id = i;
    branch.tree_id = i / 2;
    model.branches.push_back(branch);
  }
  const auto markers = MapMarkers(model, {}, "map");
  int meshes = 0;
  int labels = 0;
  ASSERT_FALSE(markers.markers.empty());
  EXPECT_EQ(markers.markers.front().action, visualization_msgs::Marker::DELETEALL);
  for (const auto& marker : markers.markers) {
    if (marker.type == visualization_msgs::Marker::TRIANGLE_LIST && marker.ns == "trees") {
      ++meshes;
      EXPECT_EQ(marker.points.size(), marker.colors.size());
      EXPECT_EQ(marker.points.size() % 3, 0U);
    }
    if (marker.type == visualization_msgs::Marker::TEXT_VIEW_FACING) ++labels;
  }
  EXPECT_EQ(meshes, 2);
  EXPECT_EQ(labels, 4);
}

// A tree whose branches leave at the same height all round: labels at their middles would be on top
// of each other from every side.
dendro::TreeModel Whorl(int branches, int cylinders_per_branch) {
  dendro::TreeModel model;
  dendro::MapTree tree;
  tree.dbh_m = 0.3;
  tree.trunk_branch_id = 0;
  for (int b = 0; b <= branches; ++b) {
    dendro::MapBranch branch;
    branch.id = b;
    branch.tree_id = 0;
    branch.order = b == 0 ? 0 : 1;
    branch.parent_id = b == 0 ? -1 : 0;
    const double angle = 2.4 * b;
    const Eigen::Vector3d direction =
        b == 0 ? Eigen::Vector3d(0, 0, 1) : Eigen::Vector3d(std::cos(angle), std::sin(angle), 0.3);
    branch.base = b == 0 ? Eigen::Vector3d(0, 0, 0) : Eigen::Vector3d(0, 0, 2);
    branch.tip = branch.base + 2.0 * direction;
    branch.base_radius_m = 0.1 - 0.001 * b;
    for (int i = 0; i < cylinders_per_branch; ++i) {
      dendro::MapCylinder cylinder;
      cylinder.id = static_cast<int>(model.cylinders.size());
      cylinder.tree_id = 0;
      cylinder.branch_id = b;
      cylinder.landmark_id = b;
      cylinder.branch_order = branch.order;
      cylinder.position_in_branch = i;
      cylinder.parent_id = i > 0 ? cylinder.id - 1 : (b > 0 ? 0 : -1);
      cylinder.start = branch.base + (branch.tip - branch.base) * i / cylinders_per_branch;
      cylinder.end = branch.base + (branch.tip - branch.base) * (i + 1) / cylinders_per_branch;
      cylinder.radius_m = 0.05;
      cylinder.radius_sigma_m = 0.001;
      branch.cylinder_ids.push_back(cylinder.id);
      model.cylinders.push_back(cylinder);
    }
    tree.branch_ids.push_back(b);
    model.branches.push_back(branch);
  }
  model.trees = {tree};
  return model;
}

TEST(Markers, LabelsOfATreeStandAtDifferentHeights) {
  MapMarkerStyle style;
  const auto markers = MapMarkers(Whorl(30, 2), style, "map");
  std::vector<double> heights;
  std::string first;
  for (const auto& marker : markers.markers) {
    if (marker.type != visualization_msgs::Marker::TEXT_VIEW_FACING) continue;
    if (heights.empty()) first = marker.text;
    heights.push_back(marker.pose.position.z);
    EXPECT_NE(marker.text.find("\u00b1"), std::string::npos);
    EXPECT_EQ(marker.text.substr(marker.text.size() - 2), "cm");
  }
  EXPECT_EQ(first, "tree 0: DBH 30.0 \u00b1 0.0 cm");
  // Thirteen find a free height near the whorl, and the trunk's own.
  EXPECT_GE(heights.size(), 12U);
  std::sort(heights.begin(), heights.end());
  for (std::size_t i = 1; i < heights.size(); ++i) {
    EXPECT_GE(heights[i] - heights[i - 1], 1.2 * style.label_height_m);
  }
}

TEST(Markers, BigMapsStayBelowTheirTriangles) {
  const dendro::TreeModel model = Whorl(199, 100);
  MapMarkerStyle style;
  std::size_t triangles = 0;
  for (const auto& marker : MapMarkers(model, style, "map").markers) {
    if (marker.ns == "trees") triangles += marker.points.size() / 3;
  }
  EXPECT_GT(triangles, 200000U);
  EXPECT_LE(triangles, 420000U);  // the caps at the branches' ends come on top
}

TEST(Markers, OnlyWhatChangedIsSentAgain) {
  MarkerChanges changes;
  dendro::TreeModel model = Whorl(3, 2);
  const auto all = MapMarkers(model, {}, "map");
  EXPECT_EQ(changes.Next(all).markers.size(), all.markers.size());
  EXPECT_TRUE(changes.Next(all).markers.empty());
  // A later stamp is no change; another colour is one of the mesh and of the lines.
  model.stamp_ns = 77;
  EXPECT_TRUE(changes.Next(MapMarkers(model, {}, "map")).markers.empty());
  MapMarkerStyle by_order;
  by_order.color = dendro::MeshColor::kByOrder;
  const auto recoloured = changes.Next(MapMarkers(model, by_order, "map"));
  ASSERT_EQ(recoloured.markers.size(), 2U);
  EXPECT_EQ(recoloured.markers[0].ns, "trees");
  EXPECT_EQ(recoloured.markers[1].ns, "skeleton");
  // Without labels these are deleted one by one.
  by_order.labels = false;
  const auto without = changes.Next(MapMarkers(model, by_order, "map"));
  EXPECT_EQ(without.markers.size(), 5U);  // four labels and their lines
  for (const auto& marker : without.markers) {
    EXPECT_EQ(marker.action, visualization_msgs::Marker::DELETE);
    EXPECT_EQ(marker.ns.substr(0, 5), "label");
    EXPECT_EQ(marker.header.frame_id, "map");
  }
  changes.Forget();
  EXPECT_EQ(changes.Next(all).markers.size(), all.markers.size());
}

TEST(Markers, ObservedLandmarksFlash) {
  const dendro::TreeModel model = Whorl(3, 2);
  const auto flash = UpdateMarkers(model, {1, 3, 99}, 5, "map");
  ASSERT_EQ(flash.markers.size(), 1U);
  EXPECT_EQ(flash.markers[0].ns, "updates");
  EXPECT_EQ(flash.markers[0].points.size(), 4U * 2U * 20U * 3U);  // four cylinders, mantles only
  EXPECT_GT(flash.markers[0].lifetime.toSec(), 0.1);
  EXPECT_TRUE(UpdateMarkers(model, {99}, 5, "map").markers.empty());
}

}  // namespace
}  // namespace dendro_ros
