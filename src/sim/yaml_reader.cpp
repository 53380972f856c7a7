#include "yaml_reader.h"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>

#include "dendro_slam/sim/scene.h"

namespace dendro {

YamlMap::YamlMap(const YAML::Node& node, std::string file, std::string where)
    : node_(node), file_(std::move(file)), where_(std::move(where)) {
  if (!node_.IsMap()) {
    FailAt(node_, "", "expected a map of keys and values");
  }
  std::vector<std::string> seen;
  for (const auto& entry : node_) {
    const std::string key = entry.first.Scalar();
    if (std::find(seen.begin(), seen.end(), key) != seen.end()) {
      FailAt(entry.first, key, "the key appears twice");
    }
    seen.push_back(key);
  }
}

YamlMap YamlMap::Parse(const std::string& text, const std::string& file) {
  YAML::Node node;
  try {
    node = YAML::Load(text);
  } catch (const YAML::Exception& e) {
    throw SceneFileError(fmt::format("{}:{}: not valid YAML: {}", file, e.mark.line + 1, e.msg));
  }
  if (!node.IsDefined() || node.IsNull()) {
    throw SceneFileError(fmt::format("{}: the file is empty; expected a map of keys and values", file));
  }
  return YamlMap(node, file, "");
}

std::string YamlMap::KeyPath(const std::string& key) const {
  if (where_.empty()) return key;
  if (key.empty()) return where_;
  return where_ + "." + key;
}

void YamlMap::FailAt(const YAML::Node& node,
                     const std::string& key,
                     const std::string& message) const {
  const YAML::Mark mark = node.IsDefined() ? node.Mark() : node_.Mark();
  const std::string path = KeyPath(key);
  throw SceneFileError(fmt::format("{}:{}: {}{}{}", file_, mark.line + 1, path,
                                   path.empty() ? "" : ": ", message));
}

void YamlMap::Fail(const std::string& key, const std::string& expected) const {
  const YAML::Node node = node_[key];
  FailAt(node.IsDefined() ? node : node_, key, expected);
}

void YamlMap::AllowOnly(std::initializer_list<const char*> keys) const {
  AllowOnly(std::vector<std::string>(keys.begin(), keys.end()));
}

void YamlMap::AllowOnly(const std::vector<std::string>& keys) const {
  for (const auto& entry : node_) {
    const std::string key = entry.first.Scalar();
    if (std::find(keys.begin(), keys.end(), key) == keys.end()) {
      FailAt(entry.first, key, fmt::format("unknown key; expected one of {}", fmt::join(keys, ", ")));
    }
  }
}

bool YamlMap::Has(const std::string& key) const { return node_[key].IsDefined(); }

bool YamlMap::IsNull(const std::string& key) const {
  const YAML::Node node = node_[key];
  return node.IsDefined() && node.IsNull();
}

YAML::Node YamlMap::Get(const std::string& key) const {
  const YAML::Node node = node_[key];
  if (!node.IsDefined()) FailAt(node_, key, "the key is missing");
  return node;
}

double YamlMap::ToNumber(const YAML::Node& node,
                         const std::string& key,
                         const char* expected) const {
  // Beyond a thousand million no length, time or angle makes sense, and single precision suffers.
  constexpr double kLargest = 1e9;
  double value = 0.0;
  if (!node.IsScalar() || !YAML::convert<double>::decode(node, value) || !(std::abs(value) <= kLargest)) {
    FailAt(node, key, fmt::format("expected {}", expected));
  }
  return value;
}

double YamlMap::Number(const std::string& key) const {
  return ToNumber(Get(key), key, "a finite number");
}

double YamlMap::Number(const std::string& key, double fallback) const {
  return Has(key) ? Number(key) : fallback;
}

int YamlMap::Integer(const std::string& key) const {
  const YAML::Node node = Get(key);
  int value = 0;
  if (!node.IsScalar() || !YAML::convert<int>::decode(node, value)) {
    FailAt(node, key, "expected a whole number");
  }
  return value;
}

int YamlMap::Integer(const std::string& key, int fallback) const {
  return Has(key) ? Integer(key) : fallback;
}

std::uint64_t YamlMap::Seed(const std::string& key, std::uint64_t fallback) const {
  if (!Has(key)) return fallback;
  const YAML::Node node = Get(key);
  std::uint64_t value = 0;
  if (!node.IsScalar() || !YAML::convert<std::uint64_t>::decode(node, value)) {
    FailAt(node, key, "expected a whole number from 0");
  }
  return value;
}

bool YamlMap::Boolean(const std::string& key, bool fallback) const {
  if (!Has(key)) return fallback;
  const YAML::Node node = Get(key);
  bool value = false;
  if (!node.IsScalar() || !YAML::convert<bool>::decode(node, value)) {
    FailAt(node, key, "expected true or false");
  }
  return value;
}

std::string YamlMap::String(const std::string& key) const {
  const YAML::Node node = Get(key);
  if (!node.IsScalar()) FailAt(node, key, "expected a text");
  return node.Scalar();
}

std::string YamlMap::String(const std::string& key, const std::string& fallback) const {
  return Has(key) ? String(key) : fallback;
}

Eigen::Vector3d YamlMap::Vector(const std::string& key) const {
  const YAML::Node node = Get(key);
  if (!node.IsSequence() || node.size() != 3) FailAt(node, key, "expected three numbers [x, y, z]");
  Eigen::Vector3d v;
  for (int i = 0; i < 3; ++i) v[i] = ToNumber(node[i], key, "three numbers [x, y, z]");
  return v;
}

Eigen::Vector3d YamlMap::Vector(const std::string& key, const Eigen::Vector3d& fallback) const {
  return Has(key) ? Vector(key) : fallback;
}

std::vector<double> YamlMap::Numbers(const std::string& key) const {
  const YAML::Node node = Get(key);
  if (!node.IsSequence()) FailAt(node, key, "expected a list of numbers");
  std::vector<double> values;
  for (const YAML::Node& item : node) values.push_back(ToNumber(item, key, "a list of numbers"));
  return values;
}

std::vector<std::vector<double>> YamlMap::Rows(const std::string& key, int columns) const {
  const YAML::Node node = Get(key);
  const std::string expected = fmt::format("a list of rows of {} numbers", columns);
  if (!node.IsSequence()) FailAt(node, key, "expected " + expected);
  std::vector<std::vector<double>> rows;
  for (std::size_t i = 0; i < node.size(); ++i) {
    const YAML::Node row = node[i];
    const std::string name = fmt::format("{}[{}]", key, i);
    if (!row.IsSequence() || row.size() != static_cast<std::size_t>(columns)) {
      FailAt(row, name, fmt::format("expected {} numbers", columns));
    }
    std::vector<double> values;
    for (const YAML::Node& item : row) values.push_back(ToNumber(item, name, "a finite number"));
    rows.push_back(std::move(values));
  }
  return rows;
}

YamlMap YamlMap::Map(const std::string& key) const {
  const YAML::Node node = Get(key);
  if (!node.IsMap()) FailAt(node, key, "expected a map of keys and values");
  return YamlMap(node, file_, KeyPath(key));
}

std::vector<YamlMap> YamlMap::Maps(const std::string& key) const {
  std::vector<YamlMap> maps;
  if (!Has(key)) return maps;
  const YAML::Node node = Get(key);
  if (node.IsNull()) return maps;
  if (!node.IsSequence()) FailAt(node, key, "expected a list");
  for (std::size_t i = 0; i < node.size(); ++i) {
    const std::string name = fmt::format("{}[{}]", key, i);
    if (!node[i].IsMap()) FailAt(node[i], name, "expected a map of keys and values");
    maps.emplace_back(node[i], file_, KeyPath(name));
  }
  return maps;
}

}  // namespace dendro
