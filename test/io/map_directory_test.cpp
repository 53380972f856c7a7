#include "dendro_slam/io/map_directory.h"

#include <fcntl.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <csignal>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <limits>
#include <sstream>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "../topology/landmark_maker.h"
#include "dendro_slam/io/mesh.h"

namespace dendro {
namespace {

namespace fs = std::filesystem;
using Eigen::Vector3d;
using testing::AllOf;
using testing::HasSubstr;
using testing::Not;

class Directory : public testing::Test {
 protected:
  void SetUp() override {
    char name[] = "/tmp/dendro_map_XXXXXX";
    ASSERT_NE(mkdtemp(name), nullptr);
    root_ = name;
    map_ = (root_ / "map").string();
  }
  void TearDown() override { fs::remove_all(root_); }

  std::string Read(const std::string& name) const {
    std::ifstream stream(fs::path(map_) / name, std::ios::binary);
    std::ostringstream content;
    content << stream.rdbuf();
    return content.str();
  }
  void Write(const std::string& name, const std::string& content) const {
    std::ofstream(fs::path(map_) / name, std::ios::binary) << content;
  }
  std::vector<std::string> Names() const {
    std::vector<std::string> names;
    for (const auto& entry : fs::directory_iterator(map_)) names.push_back(entry.path().filename());
    std::sort(names.begin(), names.end());
    return names;
  }

  fs::path root_;
  std::string map_;
};

MapFiles SomeMap() {
  MapFiles files;
  files.landmarks = {test::MakeLandmark(0, {0, 0, 0}, {0, 0, 3.0}, 0.2, 0.17),
                     test::MakeLandmark(4, {0.4, 0, 2.0}, {1.6, 0.1, 3.1}, 0.05, 0.03),
                     test::MakeLandmark(7, {5.1, 3, 2.0}, {5.9, 3, 2.0}, 0.02, 0.02)};
  files.landmarks[0].covariance(1, 3) = files.landmarks[0].covariance(3, 1) = 1.0 / 3e6;
  files.landmarks.push_back(test::MakeLandmark(9, {9, 9, 0}, {9, 9, 1}, 0.1, 0.1));
  files.landmarks.back().confirmed = false;
  files.next_landmark_id = 12;
  TreeTopology topology{TopologyConfig()};
  files.model = topology.Build(files.landmarks, 1234567890123456789);
  files.topology = topology.state();
  files.snapshot.upright = true;
  files.snapshot.next_landmark_id = 12;
  LandmarkState state;
  state.id = 4;
  state.line = files.landmarks[1].cylinder;
  state.covariance = files.landmarks[1].covariance;
  state.profile.set_knots(
      {{-2, {{3, 1.0 / 7e-6, 0.05 / 7e-6, 5}, {8, 40000.0, 2001.0, 2}}, 7}, {1, {}, 0}});
  state.first_cell = -9;
  state.coverage = {3, 5, 0, 7};
  state.num_scans = 7;
  state.num_points = 99;
  state.arc_seen.set(35);
  state.deviation_sum_m = 0.1;
  state.first_scan = 3;
  state.last_scan = 123456789012;
  state.confirmed = true;
  files.snapshot.landmarks = {state};
  for (int i = 0; i < 5; ++i) {
    StampedPose pose;
    pose.stamp_ns = 1700000000123456789 + i * 100000000LL;
    pose.T_map_lidar.linear() =
        Eigen::AngleAxisd(0.3 * i, Vector3d(1, 2, 3).normalized()).toRotationMatrix();
    pose.T_map_lidar.translation() = Vector3d(0.1 * i, 1.0 / 3.0, -2.0);
    files.trajectory.push_back(pose);
  }
  files.ground = {{12, {-0.25, 1.0 / 3.0}, -1.6, {0.01, -0.02}}, {3, {1.5, 0.5}, -1.5, {0.0, 0.1}}};
  files.config = {{"topology/join_gap_m", "1"}, {"seg/method", "network"}};
  return files;
}

TEST_F(Directory, WhatIsSavedIsLoaded) {
  const MapFiles saved = SomeMap();
  StageTimer timer;
  timer.Add("total", 3.0);
  SaveMap(map_, saved, &timer);
  EXPECT_THAT(Names(),
              testing::ElementsAre("branches.csv",
                                   "cylinders.csv",
                                   "timing.json",
                                   "trajectory.tum",
                                   "tree.ply",
                                   "tree_map.json",
                                   "trees.csv"));
  const MapFiles loaded = LoadMap(map_);
  ASSERT_EQ(loaded.ground.size(), 2u);
  for (std::size_t i = 0; i < 2; ++i) {
    EXPECT_EQ(loaded.ground[i].count, saved.ground[i].count);
    EXPECT_EQ(loaded.ground[i].foot, saved.ground[i].foot);
    EXPECT_EQ(loaded.ground[i].z_m, saved.ground[i].z_m);
    EXPECT_EQ(loaded.ground[i].slope, saved.ground[i].slope);
  }
  ASSERT_EQ(loaded.landmarks.size(), saved.landmarks.size());
  for (std::size_t i = 0; i < saved.landmarks.size(); ++i) {
    const Landmark &a = saved.landmarks[i], &b = loaded.landmarks[i];
    EXPECT_EQ(a.id, b.id);
    EXPECT_EQ(a.confirmed, b.confirmed);
    EXPECT_EQ(a.cylinder.axis, b.cylinder.axis);  // exact, not nearly
    EXPECT_EQ(a.cylinder.point, b.cylinder.point);
    EXPECT_EQ(a.cylinder.curvature, b.cylinder.curvature);
    EXPECT_EQ(a.covariance, b.covariance);
    EXPECT_EQ(a.s_min_m, b.s_min_m);
    EXPECT_EQ(a.s_max_m, b.s_max_m);
    EXPECT_EQ(a.arc_seen, b.arc_seen);
    EXPECT_EQ(a.num_points, b.num_points);
    ASSERT_EQ(a.profile.size(), b.profile.size());
    for (std::size_t k = 0; k < a.profile.size(); ++k) {
      EXPECT_EQ(a.profile[k].s_m, b.profile[k].s_m);
      EXPECT_EQ(a.profile[k].radius_m, b.profile[k].radius_m);
      EXPECT_EQ(a.profile[k].radius_sigma_m, b.profile[k].radius_sigma_m);
      EXPECT_EQ(a.profile[k].num_scans, b.profile[k].num_scans);
    }
  }
  EXPECT_EQ(loaded.next_landmark_id, 12);
  EXPECT_EQ(loaded.model.stamp_ns, saved.model.stamp_ns);
  EXPECT_EQ(loaded.config, saved.config);
  EXPECT_EQ(loaded.frame, "map");
  EXPECT_TRUE(loaded.snapshot.upright);
  EXPECT_EQ(loaded.snapshot.next_landmark_id, 12);
  ASSERT_EQ(loaded.snapshot.landmarks.size(), 1u);
  const LandmarkState &was = saved.snapshot.landmarks[0], &is = loaded.snapshot.landmarks[0];
  EXPECT_EQ(is.line.point, was.line.point);
  EXPECT_EQ(is.covariance, was.covariance);
  EXPECT_EQ(is.coverage, was.coverage);
  EXPECT_EQ(is.first_cell, -9);
  EXPECT_EQ(is.last_scan, was.last_scan);
  ASSERT_EQ(is.profile.knots().size(), 2u);
  EXPECT_EQ(is.profile.knots()[0].bins[0].weighted_radius, 0.05 / 7e-6);
  EXPECT_EQ(is.profile.knots()[0].bins[1].index, 8);
  ASSERT_EQ(loaded.trajectory.size(), 5u);
  for (std::size_t i = 0; i < 5; ++i) {
    EXPECT_EQ(loaded.trajectory[i].stamp_ns, saved.trajectory[i].stamp_ns);
    EXPECT_LT((loaded.trajectory[i].T_map_lidar.matrix() - saved.trajectory[i].T_map_lidar.matrix())
                  .norm(),
              1e-8);
  }
  // The model and the ids are equal too: everything writes the same bytes again.
  EXPECT_EQ(CylindersCsv(loaded.model), CylindersCsv(saved.model));
  EXPECT_EQ(BranchesCsv(loaded.model), BranchesCsv(saved.model));
  EXPECT_EQ(TreesCsv(loaded.model), TreesCsv(saved.model));
  EXPECT_EQ(TreeMapJson(loaded), TreeMapJson(saved));
  TreeTopology topology{TopologyConfig()};
  topology.Restore(loaded.topology);
  EXPECT_EQ(CylindersCsv(topology.Build(loaded.landmarks, 0)), CylindersCsv(saved.model));
}

TEST_F(Directory, TwoSavesAreTheSameBytes) {
  SaveMap(map_, SomeMap());
  const std::string first = Read("tree_map.json") + Read("tree.ply") + Read("cylinders.csv");
  SaveMap(map_, SomeMap());
  EXPECT_EQ(first, Read("tree_map.json") + Read("tree.ply") + Read("cylinders.csv"));
}

TEST_F(Directory, TablesByHand) {
  TreeModel model;
  MapCylinder c;
  c.id = 3;
  c.tree_id = -1;
  c.branch_id = 2;
  c.start = Vector3d(0, 0, -0.0000001);
  c.end = Vector3d(0, 0, 2);
  c.radius_m = 0.125;
  c.radius_sigma_m = 0.001;
  c.taper_m_per_m = -0.01;
  c.axis_sigma_rad = 0.01;
  c.visible_arc_rad = M_PI;
  c.num_scans = 4;
  c.num_points = 99;
  model.cylinders = {c};
  const std::string text = CylindersCsv(model);
  EXPECT_THAT(text,
              HasSubstr("\n,2,3,,0,0,0.000000,0.000000,0.000000,0.000000,0.000000,2.000000,"
                        "0.000000,0.000000,1.000000,2.000000,0.125000,0.001000,-0.010000,0.5730,"
                        "0.000000,4,99,180.0,0.000000,MEASURED\n"));
  EXPECT_THAT(
      text.substr(0, text.find('\n')),
      testing::StrEq("tree_id,branch_id,cylinder_id,parent_cylinder_id,branch_order,"
                     "position_in_branch,start_x,start_y,start_z,end_x,end_y,end_z,axis_x,axis_y,"
                     "axis_z,length_m,radius_m,radius_sigma_m,taper_m_per_m,axis_sigma_deg,"
                     "position_sigma_m,num_scans,num_points,visible_arc_deg,mad_m,status"));
  MapTree tree;
  tree.id = 1;
  tree.branch_ids = {0, 1, 2};
  tree.dbh_m = 0.3;
  tree.dbh_sigma_m = 0.002;
  tree.height_m = 7.5;
  tree.dbh_status = FitStatus::kMeasured;
  tree.crown = MapCrown{12.5, 9.0, 14.0, 10.0, 1.5, 6.0, 0.5, 77};
  model.trees = {tree, tree};
  model.trees[1].dbh_m.reset();
  model.trees[1].dbh_status = FitStatus::kUnresolved;
  model.trees[1].crown.reset();
  EXPECT_THAT(
      TreesCsv(model),
      AllOf(HasSubstr("\n1,0.000000,0.000000,0.000000,0.300000,0.002000,1.3000,7.500000,2,0,"),
            HasSubstr(",,,1.3000,7.500000,2,0,"),
            HasSubstr(",12.500000,9.000000,1.500000,6.000000,0.500000,77,MEASURED\n"),
            HasSubstr(",0,,,,,,,UNRESOLVED\n")));
  StampedPose pose;
  pose.stamp_ns = 5;
  EXPECT_EQ(TrajectoryTum({pose}),
            "0.000000005 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 "
            "1.000000000\n");
}

TEST_F(Directory, TheGeoreferenceIsSavedAndExportedWithTheTrees) {
  MapFiles files;
  MapTree tree;
  tree.id = 3;
  tree.base = {0.0, 100.0, 0.0};
  files.model.trees = {tree};
  Georeference g;
  g.origin = {45.0, 7.0, 321.5};
  g.heading_deg = 90.0;  // The map's x axis points east, y north.
  g.heading_sigma_deg = 2.5;
  g.horizontal_sigma_m = 1.25;
  g.vertical_sigma_m = 3.0;
  g.pivot = {4.0, 100.0};
  g.num_fixes = 60;
  g.num_outliers = 2;
  g.residual_m = 1.5;
  g.span_m = 20.0;
  files.georeference = g;
  SaveMap(map_, files);
  const MapFiles loaded = LoadMap(map_);
  ASSERT_TRUE(loaded.georeference.has_value());
  EXPECT_EQ(TreeMapJson(loaded), TreeMapJson(files));
  EXPECT_EQ(loaded.georeference->origin.altitude_m, g.origin.altitude_m);
  EXPECT_EQ(loaded.georeference->heading_deg, g.heading_deg);
  EXPECT_EQ(loaded.georeference->num_outliers, 2);
  // 100 m north of 45 degrees, where the meridian's radius is 6367382 m, and 321.5 m above it:
  // 45 + deg(100 / 6367703.5). Sigma: hypot(1.25, 4 m x 2.5 degrees).
  const std::string csv = TreesCsv(loaded.model, &*loaded.georeference);
  EXPECT_THAT(csv, HasSubstr(",status,latitude_deg,longitude_deg,place_sigma_m\n"));
  EXPECT_THAT(csv, HasSubstr(",UNRESOLVED,45.00089979,7.00000000,1.26\n"));
  EXPECT_EQ(TreesCsv(loaded.model).find("latitude"), std::string::npos);

  g.heading_deg.reset();
  g.origin.altitude_m.reset();
  g.note = "the heading is not known";
  files.georeference = g;
  SaveMap(map_, files);
  const MapFiles again = LoadMap(map_);
  EXPECT_FALSE(again.georeference->heading_deg.has_value());
  EXPECT_FALSE(again.georeference->origin.altitude_m.has_value());
  EXPECT_EQ(again.georeference->note, g.note);
}

TEST_F(Directory, PointsAreKeptAndBelongToTheirMap) {
  MapFiles files = SomeMap();
  CloudPoint wood, leaf;
  wood.position = Vector3d(1.5, -2.25, 3.0000001);
  wood.tree_id = 4;
  wood.branch_id = 9;
  leaf.position = Vector3d(0, 0, 7);
  leaf.label = Label::kLeaf;
  files.points = {wood, leaf};
  SaveMap(map_, files);
  const MapFiles loaded = LoadMap(map_);
  ASSERT_EQ(loaded.points.size(), 2U);
  EXPECT_EQ(loaded.points[0].position, wood.position);
  EXPECT_EQ(loaded.points[0].tree_id, 4);
  EXPECT_EQ(loaded.points[0].branch_id, 9);
  EXPECT_EQ(loaded.points[1].label, Label::kLeaf);
  EXPECT_EQ(loaded.points[1].tree_id, -1);
  const std::string whole = Read("points.ply");
  const auto refused = [&](const std::string& content) {
    WriteFileAtomically((map_ + "/points.ply"), content);
    EXPECT_THROW(LoadMap(map_), MapFileError) << content.size();
  };
  refused("");
  refused(whole.substr(0, whole.size() - 1));
  refused(whole + "x");
  refused("ply\nformat ascii 1.0\nelement vertex 99999999999999999999\n");
  std::string label = whole;
  label[whole.size() - 9] = 1;  // ground
  refused(label);
  // A map without points removes those of the map before.
  files.points.clear();
  SaveMap(map_, files);
  EXPECT_TRUE(LoadMap(map_).points.empty());
  EXPECT_FALSE(std::filesystem::exists(map_ + "/points.ply"));
}

TEST_F(Directory, EmptyMap) {
  SaveMap(map_, MapFiles());
  const MapFiles loaded = LoadMap(map_);
  EXPECT_TRUE(loaded.landmarks.empty());
  EXPECT_TRUE(loaded.trajectory.empty());
}

TEST_F(Directory, DiskFullLeavesTheOldMapWhole) {
  SaveMap(map_, SomeMap());
  const std::string before = Read("tree_map.json") + Read("cylinders.csv");
  MapFiles bigger = SomeMap();
  bigger.config["note"] = std::string(200000, 'x');
  // A file that may not grow beyond 100 kB fails as a full disk does: in the middle of a write.
  std::signal(SIGXFSZ, SIG_IGN);
  rlimit old{}, small{};
  getrlimit(RLIMIT_FSIZE, &old);
  small = old;
  small.rlim_cur = 100000;
  setrlimit(RLIMIT_FSIZE, &small);
  std::string message;
  try {
    SaveMap(map_, bigger);
  } catch (const MapFileError& error) {
    message = error.what();
  }
  setrlimit(RLIMIT_FSIZE, &old);
  EXPECT_THAT(message,
              AllOf(HasSubstr("cannot write"), HasSubstr("tree_map.json"), Not(HasSubstr("\n"))));
  EXPECT_EQ(before, Read("tree_map.json") + Read("cylinders.csv"));
  EXPECT_EQ(Names().size(), 6u);  // no temporary file is left
  SaveMap(map_, bigger);
  EXPECT_EQ(LoadMap(map_).config.at("note").size(), 200000u);
}

TEST_F(Directory, PlacesThatCannotBeWritten) {
  std::ofstream(root_ / "file") << "x";
  try {
    SaveMap((root_ / "file").string(), SomeMap());
    FAIL();
  } catch (const MapFileError& error) {
    EXPECT_THAT(error.what(), HasSubstr("file"));
  }
  EXPECT_THROW(SaveMap((root_ / "file" / "below").string(), SomeMap()), MapFileError);
  EXPECT_THROW(SaveMap("/proc/nothing/here", SomeMap()), MapFileError);
  // A directory in the way of the final name.
  fs::create_directories(fs::path(map_) / "cylinders.csv" / "in_the_way");
  EXPECT_THROW(SaveMap(map_, SomeMap()), MapFileError);
  EXPECT_FALSE(fs::exists(fs::path(map_) / "tree_map.json"));
  EXPECT_EQ(Names().size(), 1u);
}

TEST_F(Directory, NumbersThatAreNotFiniteAreNotSaved) {
  SaveMap(map_, SomeMap());
  const std::string before = Read("tree_map.json");
  MapFiles bad = SomeMap();
  bad.landmarks[1].profile[0].radius_m = std::numeric_limits<double>::quiet_NaN();
  try {
    SaveMap(map_, bad);
    FAIL();
  } catch (const MapFileError& error) {
    EXPECT_THAT(error.what(), HasSubstr("landmark 4"));
  }
  EXPECT_EQ(before, Read("tree_map.json"));
}

TEST_F(Directory, BadFilesAreRefusedWithFileAndField) {
  SaveMap(map_, SomeMap());
  const std::string good = Read("tree_map.json");
  const auto expect =
      [&](const std::string& from, const std::string& to, const std::string& field) {
        const std::size_t at = good.find(from);
        ASSERT_NE(at, std::string::npos) << from;
        std::string text = good;
        text.replace(at, from.size(), to);
        Write("tree_map.json", text);
        try {
          LoadMap(map_);
          ADD_FAILURE() << "accepted " << to;
        } catch (const MapFileError& error) {
          EXPECT_THAT(error.what(),
                      AllOf(HasSubstr("tree_map.json"), HasSubstr(field), Not(HasSubstr("\n"))));
        }
      };
  expect("\"version\": 1", "\"version\": 2", "version is 2");
  expect("dendro_slam tree map", "some other map", "format");
  expect("\"frame\": \"map\"", "\"frame\": 3", "frame");
  expect("\"next_landmark_id\": 12", "\"next_landmark_id\": 3", "next_landmark_id");
  expect("\"curvature\":", "\"curvature\":-", "landmarks[0].curvature is not positive");
  expect("\"curvature\":", "\"curve\":", "landmarks[0].curvature is missing");
  expect("\"confirmed\":true", "\"confirmed\":1", "landmarks[0].confirmed");
  expect("\"arc_seen\":\"0", "\"arc_seen\":\"2", "landmarks[0].arc_seen");
  expect("\"s_max_m\":", "\"s_max_m\":-9,\"was\":", "landmarks[0].s_max_m is below");
  expect("\"status\":\"MEASURED\"", "\"status\":\"GUESSED\"", "status");
  expect("\"next_branch_id\":", "\"next_branch_id\":0,\"was\":", "topology.branch_of_landmark");
  expect("\"id\":4", "\"id\":0", "is used twice");
  expect(
      "\"knots\":[{\"index\":-2", "\"knots\":[{\"index\":9", "landmark_states[0].knots[1].index");
  expect("\"coverage\":[3,", "\"coverage\":[3.5,", "landmark_states[0].coverage[0]");
  expect("\"upright\": true", "\"upright\": 1", "upright");
  expect("\"stamp_ns\": ", "\"stamp_ns\": 1e400, \"was\": ", "JSON");
  // Cut off anywhere: refused, never a crash.
  for (std::size_t length = 0; length < good.size() - 2; length += good.size() / 97) {
    Write("tree_map.json", good.substr(0, length));
    EXPECT_THROW(LoadMap(map_), MapFileError) << length;
  }
  Write("tree_map.json", good);
  Write("trajectory.tum", "1.5 0 0 0 0 0 0 1\n2.5 0 0\n");
  try {
    LoadMap(map_);
    FAIL();
  } catch (const MapFileError& error) {
    EXPECT_THAT(error.what(), AllOf(HasSubstr("trajectory.tum"), HasSubstr("line 2")));
  }
  EXPECT_THROW(LoadMap((root_ / "nothing").string()), MapFileError);
}

TEST_F(Directory, RandomDamageNeverCrashes) {
  SaveMap(map_, SomeMap());
  const std::string good = Read("tree_map.json");
  std::uint64_t state = 12345;
  for (int i = 0; i < 300; ++i) {
    std::string text = good;
    for (int k = 0; k < 3; ++k) {
      state = state * 6364136223846793005ULL + 1442695040888963407ULL;
      text[(state >> 20) % text.size()] = static_cast<char>(32 + (state >> 50) % 95);
    }
    Write("tree_map.json", text);
    try {
      LoadMap(map_);
    } catch (const MapFileError& error) {
      EXPECT_THAT(error.what(), HasSubstr("tree_map.json"));
    }
  }
}

TEST_F(Directory, EveryFlippedBitIsFound) {
  SaveMap(map_, SomeMap());
  const std::string good = Read("tree_map.json");
  std::uint64_t state = 777;
  for (int i = 0; i < 300; ++i) {
    std::string text = good;
    state = state * 6364136223846793005ULL + 1442695040888963407ULL;
    text[(state >> 20) % text.size()] ^= static_cast<char>(1 << ((state >> 50) % 7));
    if (text.find("\"checksum\"") == std::string::npos) continue;  // Now one of before.
    Write("tree_map.json", text);
    EXPECT_THROW(LoadMap(map_), MapFileError) << i;
  }
  // Changed by hand, and maps of before: no checksum, no complaint.
  std::string text = good;
  const std::size_t line = text.rfind('\n', text.find("\"checksum\""));
  text.erase(line, text.find('\n', line + 1) - line);
  Write("tree_map.json", text);
  EXPECT_NO_THROW(LoadMap(map_));
}

TEST_F(Directory, ScansAreStreamed) {
  LabelledScan scan;
  RangeImage& image = scan.image;
  image.stamp_ns = 1500000000;
  image.rows = 1;
  image.cols = 3;
  const auto nan = std::numeric_limits<float>::quiet_NaN();
  image.range = {4.0f, nan, 6.0f};
  image.point.assign(3, Eigen::Vector3f::Zero());
  image.point_index = {1, -1, 0};
  image.pixel_of_point = {2, 0, -1};
  scan.label = {Label::kWood, Label::kNone, Label::kGround};
  scan.wood_probability = {1.0f, 0.0f, 0.0f};
  FittedCylinder good, bad;
  good.segment_id = 0;
  good.status = FitStatus::kMeasured;
  good.cylinder.point = Vector3d(4, 0, 0);
  good.cylinder.curvature = 10.0;
  good.covariance = Matrix5d::Identity() * 1e-4;
  good.covariance(4, 4) = 0.04;
  good.start_s_m = -0.5;
  good.end_s_m = 0.5;
  bad.segment_id = 1;
  bad.reason = UnresolvedReason::kTooFewRings;
  {
    ScanWriter writer(map_);
    writer.Add(scan, {Segment{0, {0}}}, {good, bad});
    EXPECT_FALSE(fs::exists(fs::path(map_) / "scan_labels.bin"));
    writer.Finish();
  }
  EXPECT_EQ(Names().size(), 3u);
  std::string labels("DSLABEL1");
  const std::int64_t stamp = 1500000000;
  const std::uint32_t count = 3;
  labels.append(reinterpret_cast<const char*>(&stamp), 8);
  labels.append(reinterpret_cast<const char*>(&count), 4);
  labels.append({1, 2, 0});
  EXPECT_EQ(Read("scan_labels.bin"), labels);
  const std::string segments = Read("scan_segments.bin");
  ASSERT_EQ(segments.size(), 8u + 12u + 24u);
  std::int32_t ids[3];
  float ranges[3];
  std::memcpy(ids, segments.data() + 20, 12);
  std::memcpy(ranges, segments.data() + 32, 12);
  EXPECT_THAT(ids, testing::ElementsAre(-1, 0, -1));
  EXPECT_EQ(ranges[0], 6.0f);
  EXPECT_EQ(ranges[1], 4.0f);
  EXPECT_TRUE(std::isnan(ranges[2]));
  std::istringstream table(Read("scan_cylinders.csv"));
  std::string header, first, second;
  std::getline(table, header);
  std::getline(table, first);
  std::getline(table, second);
  EXPECT_EQ(std::count(header.begin(), header.end(), ','),
            std::count(first.begin(), first.end(), ','));
  EXPECT_EQ(std::count(header.begin(), header.end(), ','),
            std::count(second.begin(), second.end(), ','));
  EXPECT_THAT(first,
              AllOf(HasSubstr("1.500000000,0,"),
                    HasSubstr(",0.100000,0.5730,"),
                    HasSubstr(",0.002000,4.000000,0.000000,-0.500000,4.000000,0.000000,0.500000,"),
                    HasSubstr(",MEASURED,")));
  EXPECT_THAT(second, HasSubstr("UNRESOLVED,too few rings"));
  {
    ScanWriter unfinished((root_ / "other").string());
    unfinished.Add(scan, {}, {});
  }
  EXPECT_TRUE(fs::is_empty(root_ / "other"));
}

TEST(StageTimer, PercentilesByHand) {
  StageTimer timer;
  for (int i = 100; i >= 1; --i) timer.Add("a", i);
  timer.Add("b", 7.0);
  const auto summaries = timer.Summaries();
  EXPECT_EQ(summaries.at("a").count, 100);
  EXPECT_EQ(summaries.at("a").p50_ms, 50.0);
  EXPECT_EQ(summaries.at("a").p99_ms, 99.0);
  EXPECT_EQ(summaries.at("a").max_ms, 100.0);
  EXPECT_EQ(summaries.at("a").total_ms, 5050.0);
  EXPECT_EQ(summaries.at("b").p50_ms, 7.0);
  EXPECT_EQ(summaries.at("b").p99_ms, 7.0);
  timer.set_data_duration_s(10.0);
  timer.set_wall_duration_s(4.0);
  EXPECT_THAT(TimingJson(timer),
              AllOf(HasSubstr("\"realtime_factor\": 2.5"), HasSubstr("\"p99_ms\": 99.0")));
  EXPECT_THAT(TimingJson(StageTimer()), HasSubstr("\"realtime_factor\": null"));
}

TEST(Mesh, FrustumIsClosedAndFacesOutwards) {
  MapCylinder c;
  c.start = Vector3d(1, 2, 3);
  c.end = Vector3d(1.5, 2.5, 5);
  c.radius_m = 0.2;
  c.taper_m_per_m = -0.05;
  Mesh mesh;
  AppendFrustum(c, Rgb{1, 2, 3}, 64, &mesh);
  // Signed volume by the divergence theorem: positive when the faces turn outwards.
  double volume = 0.0;
  for (const auto& t : mesh.triangles) {
    volume += mesh.vertices[t[0]].dot(mesh.vertices[t[1]].cross(mesh.vertices[t[2]])) / 6.0;
  }
  const double length = c.Length(), r0 = StartRadius(c), r1 = EndRadius(c);
  EXPECT_GT(r0, r1);
  EXPECT_NEAR(volume, M_PI * length / 3.0 * (r0 * r0 + r0 * r1 + r1 * r1), 0.002 * volume);
  // Every edge is used once in either direction.
  std::map<std::pair<int, int>, int> edges;
  for (const auto& t : mesh.triangles) {
    for (int k = 0; k < 3; ++k) ++edges[{t[k], t[(k + 1) % 3]}];
  }
  for (const auto& [edge, count] : edges) {
    EXPECT_EQ(count, 1);
    EXPECT_EQ((edges.count({edge.second, edge.first})), 1u);
  }
  EXPECT_EQ(mesh.colors.size(), mesh.vertices.size());
  EXPECT_THROW(AppendFrustum(c, Rgb{}, 2, &mesh), std::invalid_argument);
}

TEST(Mesh, PlyHasTheSizeItsHeaderSays) {
  TreeTopology topology{TopologyConfig()};
  const TreeModel model = topology.Build(SomeMap().landmarks, 0);
  const Mesh mesh = ModelMesh(model, MeshColor::kByBranch, 8);
  EXPECT_EQ(mesh.vertices.size(), model.cylinders.size() * 18);
  const std::string ply = MeshToPly(mesh);
  const std::string end = "end_header\n";
  EXPECT_EQ(ply.size(),
            ply.find(end) + end.size() + mesh.vertices.size() * 15 + mesh.triangles.size() * 13);
  EXPECT_THAT(ply, HasSubstr("element vertex " + std::to_string(mesh.vertices.size()) + "\n"));
  // The pieces without a tree are a mesh of their own.
  EXPECT_EQ(TreeMesh(model, 0, MeshColor::kByOrder, 8).vertices.size() +
                TreeMesh(model, -1, MeshColor::kByOrder, 8).vertices.size(),
            mesh.vertices.size());
  EXPECT_FALSE(TreeMesh(model, -1, MeshColor::kBySigma).vertices.empty());
}

TEST(Mesh, NeighbouringIdsHaveDifferentColours) {
  for (int i = 0; i < 13; ++i) {
    for (int k = i + 1; k < 14; ++k) EXPECT_NE(BranchColor(i), BranchColor(k)) << i << ' ' << k;
  }
  EXPECT_EQ(SigmaColor(0.0), (Rgb{0, 34, 78}));
  EXPECT_EQ(SigmaColor(1.0), (Rgb{255, 234, 70}));
}

}  // namespace
}  // namespace dendro
