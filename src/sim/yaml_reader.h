#pragma once

#include <initializer_list>
#include <string>
#include <type_traits>
#include <vector>

#include <Eigen/Core>
#include <yaml-cpp/yaml.h>

namespace dendro {

/// A YAML map of a scene or path file, read strictly: unknown keys, missing keys and wrong types are
/// SceneFileErrors that name the file, the line, the key and what is expected.
class YamlMap {
 public:
  /// @param file   Name of the file, for messages.
  /// @param where  Path of the map in the file, such as `trees[0]`; empty for the whole file.
  YamlMap(const YAML::Node& node, std::string file, std::string where);

  /// Parses text. @throws SceneFileError  With the line of a syntax error.
  static YamlMap Parse(const std::string& text, const std::string& file);

  /// Every key must be one of these.
  void AllowOnly(std::initializer_list<const char*> keys) const;
  void AllowOnly(const std::vector<std::string>& keys) const;

  bool Has(const std::string& key) const;
  bool IsNull(const std::string& key) const;

  double Number(const std::string& key) const;
  double Number(const std::string& key, double fallback) const;
  int Integer(const std::string& key) const;
  int Integer(const std::string& key, int fallback) const;
  std::uint64_t Seed(const std::string& key, std::uint64_t fallback) const;
  bool Boolean(const std::string& key, bool fallback) const;
  std::string String(const std::string& key) const;
  std::string String(const std::string& key, const std::string& fallback) const;
  Eigen::Vector3d Vector(const std::string& key) const;
  Eigen::Vector3d Vector(const std::string& key, const Eigen::Vector3d& fallback) const;
  /// A list of numbers.
  std::vector<double> Numbers(const std::string& key) const;
  /// A list of rows of `columns` numbers.
  std::vector<std::vector<double>> Rows(const std::string& key, int columns) const;
  YamlMap Map(const std::string& key) const;
  /// A list of maps; empty when the key is missing.
  std::vector<YamlMap> Maps(const std::string& key) const;

  /// A config struct with `Visit`; keys that are missing keep their value.
  template <class Config>
  void Read(Config* config) const;

  /// Throws a SceneFileError for this key.
  [[noreturn]] void Fail(const std::string& key, const std::string& expected) const;
  const std::string& where() const { return where_; }

 private:
  YAML::Node Get(const std::string& key) const;
  [[noreturn]] void FailAt(const YAML::Node& node,
                           const std::string& key,
                           const std::string& message) const;
  std::string KeyPath(const std::string& key) const;
  double ToNumber(const YAML::Node& node, const std::string& key, const char* expected) const;

  YAML::Node node_;
  std::string file_;
  std::string where_;
};

template <class Config>
void YamlMap::Read(Config* config) const {
  std::vector<std::string> keys;
  config->Visit([&](const char* name, auto& value) {
    keys.emplace_back(name);
    using T = std::decay_t<decltype(value)>;
    if (!Has(name)) return;
    if constexpr (std::is_same_v<T, bool>) {
      value = Boolean(name, value);
    } else if constexpr (std::is_same_v<T, int>) {
      value = Integer(name);
    } else if constexpr (std::is_same_v<T, double>) {
      value = Number(name);
    } else {
      value = String(name);
    }
  });
  AllowOnly(keys);
}

}  // namespace dendro
