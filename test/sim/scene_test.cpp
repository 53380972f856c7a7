#include "dendro_slam/sim/scene.h"

#include <cmath>
#include <filesystem>
#include <fstream>
#include <random>
#include <vector>

#include <unistd.h>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "dendro_slam/sim/flight_path.h"
#include "dendro_slam/sim/raycaster.h"
#include "dendro_slam/sim/scene_generator.h"
#include "dendro_slam/sim/truth_writer.h"

namespace dendro {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;

std::string TemporaryFolder(const std::string& name) {
  const auto folder = std::filesystem::temp_directory_path() / ("dendro_scene_test_" + std::to_string(::getpid())) / name;
  std::filesystem::create_directories(folder);
  return folder.string();
}

std::string ErrorOf(const std::string& text, const std::string& name = "s.yaml") {
  try {
    ParseScene(text, name);
  } catch (const SceneFileError& e) {
    return e.what();
  }
  return "";
}

const char kGood[] = R"(frame: map
trees:
  - name: t
    branches:
      - {id: 0, parent: null, points: [[0, 0, 0, 0.3], [0, 0, 2, 0.2]]}
      - {id: 4, parent: 0, points: [[0, 0, 1, 0.1], [1, 0, 2, 0.05]]}
    leaves: {count: 20, size_m: 0.05, seed: 3}
ground: {type: plane, z: -0.5}
obstacles: [{type: box, size_m: [1, 2, 3], position: [5, 5, 1.5], yaw_deg: 30}]
)";

std::string Replaced(const std::string& from, const std::string& to) {
  std::string text = kGood;
  const std::size_t at = text.find(from);
  EXPECT_NE(at, std::string::npos) << from;
  return text.replace(at, from.size(), to);
}

TEST(Scene, ReadsWhatTheFileSays) {
  const Scene scene = ParseScene(kGood, "s.yaml");
  ASSERT_EQ(scene.trees.size(), 1u);
  EXPECT_EQ(scene.trees[0].name, "t");
  ASSERT_EQ(scene.trees[0].branches.size(), 2u);
  EXPECT_EQ(scene.trees[0].branches[0].parent, -1);
  EXPECT_EQ(scene.trees[0].branches[1].id, 4);
  EXPECT_EQ(scene.trees[0].branches[1].parent, 0);
  EXPECT_EQ(scene.trees[0].branches[1].points[1].radius_m, 0.05);
  EXPECT_NEAR(scene.trees[0].branches[1].Length(), std::sqrt(2.0), 1e-12);
  EXPECT_EQ(scene.ground.z_m, -0.5);
  EXPECT_EQ(scene.obstacles[0].yaw_deg, 30.0);
  EXPECT_EQ(MakeLeaves(scene.trees[0]).size(), 20u);
}

TEST(Scene, EveryMistakeGetsTheFileTheLineTheKeyAndWhatIsExpected) {
  EXPECT_EQ(ErrorOf(kGood), "");
  EXPECT_THAT(ErrorOf(Replaced("ground:", "gruond:")),
              AllOf(HasSubstr("s.yaml:8"), HasSubstr("gruond"), HasSubstr("unknown key"), HasSubstr("ground")));
  EXPECT_THAT(ErrorOf(Replaced("ground: {type: plane, z: -0.5}\n", "")), AllOf(HasSubstr("ground"), HasSubstr("missing")));
  EXPECT_THAT(ErrorOf(Replaced("0, 0, 2, 0.2", "0, 0, 2, -0.2")),
              AllOf(HasSubstr("s.yaml:5"), HasSubstr("trees[0].branches[0].points"), HasSubstr("radius"), HasSubstr(">= 0")));
  EXPECT_THAT(ErrorOf(Replaced("parent: 0", "parent: 7")),
              AllOf(HasSubstr("s.yaml:6"), HasSubstr("parent"), HasSubstr("branch 7 does not exist")));
  EXPECT_THAT(ErrorOf(Replaced("parent: 0", "parent: 4")), HasSubstr("does not exist"));
  EXPECT_THAT(ErrorOf(Replaced(", parent: 0", "")), AllOf(HasSubstr("s.yaml:6"), HasSubstr("parent"), HasSubstr("missing")));
  EXPECT_THAT(ErrorOf(Replaced("parent: 0", "parent: -1")), AllOf(HasSubstr("s.yaml:6"), HasSubstr("parent"), HasSubstr("null")));
  EXPECT_THAT(ErrorOf(Replaced("parent: null", "parent: 4")), AllOf(HasSubstr("s.yaml:5"), HasSubstr("circle")));
  EXPECT_THAT(ErrorOf(Replaced("[0, 0, 0, 0.3]", "[0, 0, 1e30, 0.3]")), AllOf(HasSubstr("s.yaml:5"), HasSubstr("points[0]"), HasSubstr("finite")));
  EXPECT_THAT(ErrorOf(Replaced("count: 20", "count: 2000000000")), AllOf(HasSubstr("s.yaml:7"), HasSubstr("leaves.count")));
  EXPECT_THAT(ErrorOf(Replaced("id: 4", "id: 0")), HasSubstr("twice"));
  EXPECT_THAT(ErrorOf(Replaced("id: 4", "id: four")), AllOf(HasSubstr("id"), HasSubstr("whole number")));
  EXPECT_THAT(ErrorOf(Replaced("id: 4", "id: 4.5")), HasSubstr("whole number"));
  EXPECT_THAT(ErrorOf(Replaced("[1, 0, 2, 0.05]", "[1, 0, 2]")), AllOf(HasSubstr("points[1]"), HasSubstr("4 numbers")));
  EXPECT_THAT(ErrorOf(Replaced("[1, 0, 2, 0.05]", "[1, 0, .nan, 0.05]")), HasSubstr("finite"));
  EXPECT_THAT(ErrorOf(Replaced("count: 20", "count: -1")), AllOf(HasSubstr("s.yaml:7"), HasSubstr("leaves.count")));
  EXPECT_THAT(ErrorOf(Replaced("size_m: [1, 2, 3]", "size_m: [1, 0, 3]")), AllOf(HasSubstr("obstacles[0].size_m"), HasSubstr("> 0")));
  EXPECT_THAT(ErrorOf(Replaced("type: plane", "type: flat")), AllOf(HasSubstr("ground.type"), HasSubstr("plane, rough or none")));
  EXPECT_THAT(ErrorOf(Replaced("name: t\n", "name: t\n    name: u\n")), HasSubstr("twice"));
  EXPECT_THAT(ErrorOf("trees: [\n"), AllOf(HasSubstr("s.yaml:"), HasSubstr("not valid YAML")));
  EXPECT_THAT(ErrorOf(""), HasSubstr("empty"));
  EXPECT_THROW(LoadScene("/does/not/exist.yaml"), SceneFileError);
}

/// Text with a few random changes: characters, words and lines deleted, doubled, swapped, replaced.
std::string Mutated(const std::string& text, std::mt19937* rng) {
  static const std::vector<std::string> kWords = {
      "-1", "0", "1e9", "1e308", ".nan", ".inf", "-.inf", "null", "~", "[]", "{}", "[", "}", ": ", "\n", "  ", "- ",
      "&a", "*a", "!!binary", "true", "\"", "'", "|", ">", "?", "%", "\t", "\xff", "2147483648", "99999999999999999999",
      "{a: 1}", "[[1, 2, 3, 4]]", "mesh.ply", "/dev/null", ".", "trunk", "box", "walk", "plane", "type"};
  std::string out = text;
  const int changes = 1 + static_cast<int>((*rng)() % 2);
  for (int i = 0; i < changes; ++i) {
    const std::size_t at = (*rng)() % (out.size() + 1);
    const std::size_t length = std::min<std::size_t>((*rng)() % 5, out.size() - at);
    switch ((*rng)() % 4) {
      case 0: out.erase(at, length); break;
      case 1: out.insert(at, out.substr(at, length)); break;
      case 2: out.replace(at, length, kWords[(*rng)() % kWords.size()]); break;
      default: out.insert(at, kWords[(*rng)() % kWords.size()]); break;
    }
  }
  return out;
}

// Whatever is done to a file, it is read or refused with an error that begins with its name.
TEST(Scene, DamagedFilesAreReadOrRefusedByName) {
  std::mt19937 rng(7);
  const std::string path = "type: circle\nradius_m: 4\naltitude_m: 2\nlaps: 0.2\nspeed_mps: 1\nlook_at: [0, 0, 1]\n"
                           "odometry: {model: t265, seed: 2}\norigin: {latitude_deg: 1, longitude_deg: 2}\n"
                           "extrinsics: {base_to_lidar: {position: [0, 0, 0.1], rpy_deg: [0, 0, 0]}}\n";
  int read = 0, refused = 0;
  for (int i = 0; i < 3000; ++i) {
    const bool scene = i % 2 == 0;
    const std::string text = Mutated(scene ? std::string(kGood) : path, &rng);
    try {
      if (scene) {
        ValidateScene(ParseScene(text, "s.yaml"));
      } else {
        EXPECT_LE(ParseFlightPath(text, "s.yaml").duration_s, 86400.0);
      }
      ++read;
    } catch (const SceneFileError& e) {
      ++refused;
      EXPECT_EQ(std::string(e.what()).rfind("s.yaml:", 0), 0u) << e.what() << "\n" << text;
    } catch (const std::exception& e) {
      ADD_FAILURE() << e.what() << "\n" << text;
    }
  }
  EXPECT_GT(read, 60);
  EXPECT_GT(refused, 1000);
}

TEST(Scene, MeshesAndCloudsAreReadAndTheirErrorsNameTheFile) {
  const std::string folder = TemporaryFolder("meshes");
  std::ofstream(folder + "/quad.obj") << "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n";
  std::ofstream(folder + "/tri.ply") << "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
                                        "property float z\nelement face 1\nproperty list uchar int vertex_indices\n"
                                        "end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";
  std::ofstream(folder + "/broken.ply") << "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n"
                                           "property float y\nproperty float z\nend_header\n0 0 0\n";
  std::ofstream(folder + "/face.obj") << "v 0 0 0\nv 1 0 0\nf 1 2 3\n";
  std::ofstream(folder + "/points.txt") << "# x y z\n1 2 3\n4,5,6\n";
  const std::string name = folder + "/s.yaml";
  const auto with = [](const std::string& rest) { return "ground: {type: none}\n" + rest; };
  const Scene scene = ParseScene(with("meshes: [{file: quad.obj, position: [0, 0, 2], scale: 2}, {file: tri.ply}]\n"
                                      "clouds: [{file: points.txt, position: [1, 0, 0], label: wood}]\n"), name);
  ASSERT_EQ(scene.meshes.size(), 2u);
  EXPECT_EQ(scene.meshes[0].triangles.size(), 2u);
  EXPECT_EQ(scene.meshes[0].vertices[2], Eigen::Vector3d(2, 2, 2));
  ASSERT_EQ(scene.clouds[0].points.size(), 2u);
  EXPECT_EQ(scene.clouds[0].points[1], Eigen::Vector3d(5, 5, 6));
  EXPECT_NEAR(Raycaster(scene).Cast({0.5, 1.9, 9}, {0, 0, -1})->range_m, 7.0, 1e-12);
  // Read back, from another folder.
  const std::string elsewhere = TemporaryFolder("elsewhere") + "/copy.yaml";
  SaveScene(scene, elsewhere);
  EXPECT_EQ(LoadScene(elsewhere).meshes[0].vertices, scene.meshes[0].vertices);

  EXPECT_THAT(ErrorOf(with("meshes: [{file: none.ply}]\n"), name), AllOf(HasSubstr("s.yaml:2"), HasSubstr("none.ply"), HasSubstr("cannot be read")));
  EXPECT_THAT(ErrorOf(with("meshes: [{file: broken.ply}]\n"), name), AllOf(HasSubstr("broken.ply"), HasSubstr("ends too early")));
  EXPECT_THAT(ErrorOf(with("meshes: [{file: face.obj}]\n"), name), AllOf(HasSubstr("face.obj"), HasSubstr("line 3")));
  EXPECT_THAT(ErrorOf(with("meshes: [{file: quad.stl}]\n"), name), HasSubstr(".ply or .obj"));
  EXPECT_THAT(ErrorOf(with("clouds: [{file: quad.obj, point_radius_m: 0}]\n"), name), HasSubstr("> 0"));
}

TEST(Scene, TheTextReadsBackToTheSameScene) {
  for (std::uint64_t seed = 1; seed <= 5; ++seed) {
    SceneGeneratorConfig config;
    config.num_trees = 2;
    config.num_grass_tufts = 2;
    const Scene scene = GenerateScene(config, seed);
    const std::string text = FormatScene(scene);
    EXPECT_EQ(FormatScene(ParseScene(text, "s.yaml")), text);
  }
}

TEST(Scene, EveryShippedSceneLoadsAndCanBeCast) {
  int count = 0;
  for (const auto& entry : std::filesystem::directory_iterator(std::string(DENDRO_SOURCE_DIR) + "/config/scenes")) {
    if (entry.path().extension() != ".yaml") continue;
    const Scene scene = LoadScene(entry.path().string());
    EXPECT_FALSE(scene.trees.empty()) << entry.path();
    const Raycaster raycaster(scene);
    const auto hit = raycaster.Cast({4.0, 0.3, 1.0}, Eigen::Vector3d(-0.1, 0, -1).normalized());
    ASSERT_TRUE(hit) << entry.path();
    ++count;
  }
  EXPECT_GE(count, 6);
}

TEST(Scene, TheRealCloudOfATreeCanBeScanned) {
  const std::string file = std::string(DENDRO_SHARED_DATA) + "/trees/itsme_tree_1_pc.txt";
  if (!std::filesystem::exists(file)) GTEST_SKIP() << "not there: " << file;
  const Scene scene = ParseScene("ground: {type: none}\nclouds: [{file: " + file + ", label: wood}]\n", "s.yaml");
  EXPECT_EQ(scene.clouds[0].points.size(), 30826u);
  const Raycaster raycaster(scene);
  const Eigen::Vector3d p = scene.clouds[0].points[100];
  const auto hit = raycaster.Cast(p + Eigen::Vector3d(0, 0, 100), {0, 0, -1}, 200.0);
  ASSERT_TRUE(hit);
  EXPECT_EQ(SurfaceLabel(hit->kind), Label::kWood);
}

TEST(SceneLeaves, AreSeededAndHangOnThinWood) {
  Scene scene = ParseScene(kGood, "s.yaml");
  SceneTree& tree = scene.trees[0];
  tree.leaves.count = 500;
  tree.leaves.max_wood_radius_m = 0.08;
  const std::vector<Disc> a = MakeLeaves(tree), b = MakeLeaves(tree);
  ASSERT_EQ(a.size(), 500u);
  for (std::size_t i = 0; i < a.size(); ++i) {
    EXPECT_EQ(a[i].centre, b[i].centre);
    EXPECT_NEAR(a[i].normal.norm(), 1.0, 1e-12);
    EXPECT_GT(a[i].centre.x(), -0.7);  // The thin branch grows to +x, the thick trunk has no leaves.
    EXPECT_GE(a[i].radius_m, 0.5 * 0.05 * 0.7 - 1e-12);
    EXPECT_LE(a[i].radius_m, 0.5 * 0.05 * 1.3 + 1e-12);
  }
  tree.leaves.seed = 4;
  EXPECT_NE(MakeLeaves(tree)[0].centre, a[0].centre);
}

TEST(SceneGenerator, TreesAreValidForEverySeedAndForm) {
  for (std::uint64_t seed = 1; seed <= 300; ++seed) {
    const TreeGeneratorConfig config = RandomTreeConfig(seed);
    const SceneTree tree = GenerateTree(config, {1, 2, 0}, seed);
    Scene scene;
    scene.trees.push_back(tree);
    ASSERT_NO_THROW(ValidateScene(scene)) << seed;
    for (const SceneBranch& branch : tree.branches) {
      if (branch.parent < 0) continue;
      const SceneBranch* parent = tree.FindBranch(branch.parent);
      ASSERT_NE(parent, nullptr);
      ASSERT_LT(branch.parent, branch.id);
      // It starts on the centre line of its parent and is not thicker than that.
      double nearest = 1e9, radius = 0.0;
      for (std::size_t i = 1; i < parent->points.size(); ++i) {
        const Eigen::Vector3d d = parent->points[i].position - parent->points[i - 1].position;
        const double u = std::clamp((branch.points[0].position - parent->points[i - 1].position).dot(d) / d.squaredNorm(), 0.0, 1.0);
        const double distance = (branch.points[0].position - parent->points[i - 1].position - u * d).norm();
        if (distance < nearest) {
          nearest = distance;
          radius = parent->points[i - 1].radius_m + u * (parent->points[i].radius_m - parent->points[i - 1].radius_m);
        }
      }
      EXPECT_LT(nearest, 1e-6) << seed;
      EXPECT_LE(branch.points[0].radius_m, radius + config.min_radius_m) << seed << " " << branch.id;
    }
  }
}

TEST(SceneGenerator, TheTrunkHasTheDiameterAskedFor) {
  TreeGeneratorConfig config;
  config.form = "excurrent";
  config.lean_deg = 0.0;
  config.sweep = 0.0;
  config.dbh_m = 0.3;
  config.segment_length_m = 0.1;
  const SceneTree tree = GenerateTree(config, {0, 0, 0}, 1);
  Scene scene;
  scene.trees.push_back(tree);
  scene.trees[0].branches.resize(1);
  const auto hit = Raycaster(scene).Cast({-5, 0, 1.3}, {1, 0, 0});
  ASSERT_TRUE(hit);
  EXPECT_NEAR(2.0 * (5.0 - hit->range_m), 0.3, 0.003);
  EXPECT_THROW((config.taper = 1.2, config.Validate()), std::invalid_argument);
}

TEST(SceneGenerator, TheSameSeedGivesTheSameScene) {
  SceneGeneratorConfig config;
  config.num_trees = 3;
  EXPECT_EQ(FormatScene(GenerateScene(config, 7)), FormatScene(GenerateScene(config, 7)));
  EXPECT_NE(FormatScene(GenerateScene(config, 7)), FormatScene(GenerateScene(config, 8)));
}

TEST(TruthWriter, WritesWhatReadsBack) {
  const std::string folder = TemporaryFolder("truth");
  const Scene scene = ParseScene(kGood, "s.yaml");
  SimulatedScan scan;
  scan.scan.stamp_ns = 1600000000012345678;
  scan.T_map_lidar.translation() = Eigen::Vector3d(1, 2, 3);
  scan.truth.resize(4);
  scan.truth[0].kind = SurfaceKind::kGround;
  scan.truth[1] = {SurfaceKind::kTrunk, 0, 0, 1.0F};
  scan.truth[2] = {SurfaceKind::kBranch, 0, 4, 1.0F};
  scan.truth[3] = {SurfaceKind::kLeaf, 0, -1, 1.0F};
  TruthWriter writer(folder, scene);
  writer.AddScan(scan);
  scan.scan.stamp_ns += 100000000;
  scan.truth.resize(2);
  writer.AddScan(scan);
  writer.Finish();

  const std::vector<ScanLabels> labels = ReadScanLabels(folder + "/labels.bin");
  ASSERT_EQ(labels.size(), 2u);
  EXPECT_EQ(labels[0].stamp_ns, 1600000000012345678);
  EXPECT_EQ(labels[0].label, (std::vector<std::uint8_t>{1, 2, 2, 3}));
  EXPECT_EQ(labels[0].branch_id, (std::vector<std::int16_t>{-1, 0, 4, -1}));
  EXPECT_EQ(labels[0].tree_id, (std::vector<std::int16_t>{-1, 0, 0, 0}));
  EXPECT_EQ(labels[1].label.size(), 2u);
  std::ifstream hits(folder + "/hits.csv");
  std::string line;
  std::getline(hits, line);
  EXPECT_EQ(line, "stamp,tree,branch,hits");
  std::getline(hits, line);
  EXPECT_EQ(line, "1600000000.012345678,0,0,1");
  std::ifstream trajectory(folder + "/trajectory.tum");
  std::getline(trajectory, line);
  EXPECT_THAT(line, HasSubstr("1600000000.012345678 1.000000000 2.000000000 3.000000000 "));
  EXPECT_EQ(LoadScene(folder + "/scene.yaml").trees[0].branches.size(), 2u);

  std::ofstream(folder + "/bad.bin") << "DSOTHER1";
  EXPECT_THROW(ReadScanLabels(folder + "/bad.bin"), SceneFileError);
  std::filesystem::resize_file(folder + "/labels.bin", 30);
  EXPECT_THROW(ReadScanLabels(folder + "/labels.bin"), SceneFileError);
  EXPECT_THROW(TruthWriter("/proc/none", scene), SceneFileError);
}

}  // namespace
}  // namespace dendro
