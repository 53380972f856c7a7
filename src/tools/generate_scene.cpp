#include <cstdint>
#include <iostream>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>

#include "dendro_slam/sim/scene_generator.h"

namespace {

/// One option per field of a config struct, named as the field with dashes.
template <class Config>
void AddOptions(CLI::App* app, const std::string& group, Config* config) {
  config->Visit([&](const char* name, auto& value) {
    std::string flag = "--" + std::string(name);
    for (char& c : flag) {
      if (c == '_') c = '-';
    }
    app->add_option(flag, value)->capture_default_str()->group(group);
  });
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app(
      "Makes a scene with seeded trees. By default the trees are drawn at random (forms, sizes, branch "
      "orders, leaves); with --tree every tree has the given botanical parameters.");
  std::string output;
  std::uint64_t seed = 1;
  bool given_tree = false;
  dendro::SceneGeneratorConfig scene_config;
  dendro::TreeGeneratorConfig tree_config;
  app.add_option("-o,--output", output, "Scene file to write (YAML)")->required();
  app.add_option("--seed", seed, "The same seed gives the same scene")->capture_default_str();
  app.add_flag("--tree", given_tree, "Use the parameters of the group Tree");
  AddOptions(&app, "Scene", &scene_config);
  AddOptions(&app, "Tree", &tree_config);
  CLI11_PARSE(app, argc, argv);
  try {
    dendro::Scene scene = dendro::GenerateScene(scene_config, seed);
    if (given_tree) {
      std::uint64_t tree_seed = seed * 1000;
      for (dendro::SceneTree& tree : scene.trees) {
        if (tree.name == "grass") continue;
        Eigen::Vector3d base = tree.branches.at(0).points.at(0).position;
        base.z() = dendro::GroundHeight(scene.ground, base.x(), base.y());
        tree = dendro::GenerateTree(tree_config, base, tree_seed++);
      }
    }
    dendro::SaveScene(scene, output);
    std::size_t branches = 0;
    for (const dendro::SceneTree& tree : scene.trees) branches += tree.branches.size();
    std::cout << output << ": " << scene.trees.size() << " trees, " << branches << " branches\n";
  } catch (const std::exception& e) {
    std::cerr << "generate_scene: " << e.what() << "\n";
    return 1;
  }
  return 0;
}
