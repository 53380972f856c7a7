#pragma once

#include <map>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <variant>
#include <vector>

#include <ros/node_handle.h>

/// One strict reader of configuration, for ROS parameters and for YAML files.
///
/// A config struct names its fields through `template <class V> void Visit(V&& v)`; the struct holds
/// the only defaults. An unknown key, a wrong type and a value that `Validate()` refuses are errors
/// that name the key and where it was found.
namespace dendro_ros {

/// Configuration that cannot be used. One line: where, which key, what is expected.
class ParamError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// Parameters as a tree of typed values, whatever they were read from.
struct ParamTree {
  using Map = std::map<std::string, ParamTree>;
  using List = std::vector<ParamTree>;
  std::variant<std::monostate, bool, int, double, std::string, List, Map> value;

  /// The map of this node, empty when nothing was given.
  /// @throws ParamError  It is a scalar or a list.
  const Map& AsMap(const std::string& where) const;
  /// "a whole number", "text", ...: for messages.
  const char* TypeName() const;
};

/// The private parameters of a node or nodelet; empty when none are set.
ParamTree ReadRosParams(const ros::NodeHandle& nh);
/// A YAML file. Quoted scalars are text; duplicate keys are refused.
/// @throws ParamError  Missing, unreadable or malformed (with line and column).
ParamTree ReadYamlFile(const std::string& path);
/// YAML text.
/// @param where  Named in errors.
ParamTree ParseYaml(const std::string& text, const std::string& where);

/// The known key nearest to a misspelled one (edit distance at most a third of its length), or "".
std::string NearestKey(const std::string& key, const std::vector<std::string>& known);

/// The name of every key of a config struct, in its own order; nested structs as "outer/inner".
template <class Config>
std::vector<std::string> ConfigKeys();

/// Reads a config struct: defaults, overridden by what the tree holds, validated.
/// @param where  Named in errors, e.g. a file or a node's namespace.
/// @throws ParamError  Unknown key, wrong type, or a value that Validate() refuses.
template <class Config>
Config ReadConfig(const ParamTree& tree, const std::string& where);

/// As ReadConfig, but keys that the tree does not hold keep the value they have.
template <class Config>
void UpdateConfig(const ParamTree& tree, const std::string& where, Config* config);

namespace internal {

template <class T, class = void>
struct IsConfig : std::false_type {};
struct AnyVisitor {
  template <class T>
  void operator()(const char*, T&) {}
};
template <class T>
struct IsConfig<T, std::void_t<decltype(std::declval<T&>().Visit(std::declval<AnyVisitor&>()))>>
    : std::true_type {};

template <class T, class = void>
struct HasValidate : std::false_type {};
template <class T>
struct HasValidate<T, std::void_t<decltype(std::declval<const T&>().Validate())>> : std::true_type {};

void Assign(const ParamTree& tree, const std::string& where, bool& value);
void Assign(const ParamTree& tree, const std::string& where, int& value);
void Assign(const ParamTree& tree, const std::string& where, double& value);
void Assign(const ParamTree& tree, const std::string& where, std::string& value);
[[noreturn]] void FailType(const ParamTree& tree, const std::string& where, const char* expected);
[[noreturn]] void FailUnknown(const std::string& where,
                              const std::string& key,
                              const std::vector<std::string>& known);
[[noreturn]] void FailInvalid(const std::string& where, const std::string& what);

struct KeyLister {
  std::vector<std::string>& keys;
  std::string prefix;
  template <class T>
  void operator()(const char* key, T& value) {
    if constexpr (IsConfig<T>::value) {
      value.Visit(KeyLister{keys, prefix + key + "/"});
    } else {
      keys.push_back(prefix + key);
    }
  }
};

template <class Config>
void ReadInto(const ParamTree& tree, const std::string& where, Config& config);

template <class T>
void Read(const ParamTree& tree, const std::string& where, T& value) {
  if constexpr (IsConfig<T>::value) {
    ReadInto(tree, where, value);
  } else {
    Assign(tree, where, value);
  }
}

/// A list of texts, numbers or config structs.
template <class T>
void Read(const ParamTree& tree, const std::string& where, std::vector<T>& values) {
  const ParamTree::List* list = std::get_if<ParamTree::List>(&tree.value);
  if (list == nullptr) FailType(tree, where, "a list");
  values.clear();
  for (const ParamTree& item : *list) {
    T value{};
    Read(item, where + "[" + std::to_string(values.size()) + "]", value);
    values.push_back(std::move(value));
  }
}

struct FieldAssigner {
  const ParamTree::Map& map;
  const std::string& where;
  std::vector<std::string>& known;
  template <class T>
  void operator()(const char* key, T& value) {
    known.emplace_back(key);
    const auto it = map.find(key);
    if (it == map.end()) return;
    Read(it->second, where + "/" + key, value);
  }
};

template <class Config>
void ReadInto(const ParamTree& tree, const std::string& where, Config& config) {
  const ParamTree::Map& map = tree.AsMap(where);
  std::vector<std::string> known;
  config.Visit(FieldAssigner{map, where, known});
  for (const auto& entry : map) {
    bool is_known = false;
    for (const std::string& key : known) is_known = is_known || key == entry.first;
    if (!is_known) FailUnknown(where, entry.first, known);
  }
  if constexpr (HasValidate<Config>::value) {
    try {
      std::as_const(config).Validate();
    } catch (const std::invalid_argument& error) {
      FailInvalid(where, error.what());
    }
  }
}

}  // namespace internal

template <class Config>
std::vector<std::string> ConfigKeys() {
  std::vector<std::string> keys;
  Config config;
  config.Visit(internal::KeyLister{keys, ""});
  return keys;
}

template <class Config>
Config ReadConfig(const ParamTree& tree, const std::string& where) {
  Config config;
  internal::ReadInto(tree, where, config);
  return config;
}

template <class Config>
void UpdateConfig(const ParamTree& tree, const std::string& where, Config* config) {
  internal::ReadInto(tree, where, *config);
}

}  // namespace dendro_ros
