#include "dendro_slam/ros/params.h"

#include <fmt/format.h>
#include <XmlRpcException.h>
#include <XmlRpcValue.h>
#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <limits>
#include <sstream>

namespace dendro_ros {
namespace {

ParamTree FromXmlRpc(XmlRpc::XmlRpcValue& value, const std::string& where) {
  switch (value.getType()) {
    case XmlRpc::XmlRpcValue::TypeBoolean:
      return {static_cast<bool>(value)};
    case XmlRpc::XmlRpcValue::TypeInt:
      return {static_cast<int>(value)};
    case XmlRpc::XmlRpcValue::TypeDouble:
      return {static_cast<double>(value)};
    case XmlRpc::XmlRpcValue::TypeString:
      return {static_cast<std::string>(value)};
    case XmlRpc::XmlRpcValue::TypeArray: {
      ParamTree::List list;
      for (int i = 0; i < value.size(); ++i) list.push_back(FromXmlRpc(value[i], where));
      return {std::move(list)};
    }
    case XmlRpc::XmlRpcValue::TypeStruct: {
      ParamTree::Map map;
      for (auto& member : value) map[member.first] = FromXmlRpc(member.second, where);
      return {std::move(map)};
    }
    default:
      throw ParamError(fmt::format("{}: a parameter of a kind that cannot be read", where));
  }
}

bool ParseNumber(const std::string& text, double& number) {
  if (text == ".inf" || text == "+.inf") {
    number = std::numeric_limits<double>::infinity();
    return true;
  }
  if (text == ".nan") {
    number = std::numeric_limits<double>::quiet_NaN();
    return true;
  }
  const char* begin = text.data() + (!text.empty() && text[0] == '+' ? 1 : 0);
  const char* end = text.data() + text.size();
  const auto result = std::from_chars(begin, end, number);
  const bool starts_like_a_number =
      begin != end && (*begin == '-' || *begin == '.' || (*begin >= '0' && *begin <= '9'));
  return starts_like_a_number && result.ec == std::errc() && result.ptr == end;
}

ParamTree FromYaml(const YAML::Node& node, const std::string& where) {
  switch (node.Type()) {
    case YAML::NodeType::Null:
    case YAML::NodeType::Undefined:
      return {};
    case YAML::NodeType::Sequence: {
      ParamTree::List list;
      for (const YAML::Node& item : node) list.push_back(FromYaml(item, where));
      return {std::move(list)};
    }
    case YAML::NodeType::Map: {
      ParamTree::Map map;
      for (const auto& item : node) {
        const std::string key = item.first.as<std::string>();
        if (!map.emplace(key, FromYaml(item.second, where)).second) {
          throw ParamError(
              fmt::format("{}: line {}: key '{}' is given twice", where, item.first.Mark().line + 1, key));
        }
      }
      return {std::move(map)};
    }
    case YAML::NodeType::Scalar:
      break;
  }
  const std::string text = node.Scalar();
  if (node.Tag() == "!") return {text};  // Quoted.
  if (text == "true" || text == "True") return {true};
  if (text == "false" || text == "False") return {false};
  int integer = 0;
  const auto result = std::from_chars(text.data(), text.data() + text.size(), integer);
  if (!text.empty() && result.ec == std::errc() && result.ptr == text.data() + text.size()) {
    return {integer};
  }
  double number = 0.0;
  if (ParseNumber(text, number)) return {number};
  return {text};
}

std::size_t EditDistance(const std::string& a, const std::string& b) {
  std::vector<std::size_t> row(b.size() + 1);
  for (std::size_t j = 0; j <= b.size(); ++j) row[j] = j;
  for (std::size_t i = 1; i <= a.size(); ++i) {
    std::size_t diagonal = row[0];
    row[0] = i;
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const std::size_t above = row[j];
      row[j] = std::min({above + 1, row[j - 1] + 1, diagonal + (a[i - 1] == b[j - 1] ? 0U : 1U)});
      diagonal = above;
    }
  }
  return row[b.size()];
}

}  // namespace

const ParamTree::Map& ParamTree::AsMap(const std::string& where) const {
  static const Map kEmpty;
  if (std::holds_alternative<std::monostate>(value)) return kEmpty;
  if (const Map* map = std::get_if<Map>(&value)) return *map;
  internal::FailType(*this, where, "a group of parameters");
}

const char* ParamTree::TypeName() const {
  static const char* const kNames[] = {
      "nothing", "true/false", "a whole number", "a number", "text", "a list", "a group of parameters"};
  return kNames[value.index()];
}

ParamTree ReadRosParams(const ros::NodeHandle& nh) {
  XmlRpc::XmlRpcValue value;
  if (!nh.getParam(nh.getNamespace(), value)) return {};
  return FromXmlRpc(value, nh.getNamespace());
}

ParamTree ParseYaml(const std::string& text, const std::string& where) {
  try {
    return FromYaml(YAML::Load(text), where);
  } catch (const YAML::Exception& error) {
    throw ParamError(fmt::format("{}: line {}, column {}: {}",
                                 where,
                                 error.mark.line + 1,
                                 error.mark.column + 1,
                                 error.msg));
  }
}

ParamTree ReadYamlFile(const std::string& path) {
  std::error_code error;
  if (std::filesystem::is_directory(path, error)) {
    throw ParamError(fmt::format("{}: is a folder, expected a YAML file", path));
  }
  std::ifstream file(path);
  if (!file) throw ParamError(fmt::format("{}: cannot be opened", path));
  std::stringstream text;
  text << file.rdbuf();
  return ParseYaml(text.str(), path);
}

std::string NearestKey(const std::string& key, const std::vector<std::string>& known) {
  std::string nearest;
  std::size_t best = std::max<std::size_t>(2, key.size() / 3) + 1;
  for (const std::string& candidate : known) {
    const std::size_t distance = EditDistance(key, candidate);
    if (distance < best) {
      best = distance;
      nearest = candidate;
    }
  }
  return nearest;
}

namespace internal {

void FailType(const ParamTree& tree, const std::string& where, const char* expected) {
  throw ParamError(fmt::format("{}: expected {}, got {}", where, expected, tree.TypeName()));
}

void Assign(const ParamTree& tree, const std::string& where, bool& value) {
  const bool* read = std::get_if<bool>(&tree.value);
  if (read == nullptr) FailType(tree, where, "true or false");
  value = *read;
}

void Assign(const ParamTree& tree, const std::string& where, int& value) {
  const int* read = std::get_if<int>(&tree.value);
  if (read == nullptr) FailType(tree, where, "a whole number");
  value = *read;
}

void Assign(const ParamTree& tree, const std::string& where, double& value) {
  if (const int* integer = std::get_if<int>(&tree.value)) {
    value = *integer;
    return;
  }
  const double* read = std::get_if<double>(&tree.value);
  if (read == nullptr) FailType(tree, where, "a number");
  if (!std::isfinite(*read)) {
    throw ParamError(fmt::format("{}: expected a finite number, got {}", where, *read));
  }
  value = *read;
}

void Assign(const ParamTree& tree, const std::string& where, std::string& value) {
  const std::string* read = std::get_if<std::string>(&tree.value);
  if (read == nullptr) FailType(tree, where, "text");
  value = *read;
}

void FailUnknown(const std::string& where,
                 const std::string& key,
                 const std::vector<std::string>& known) {
  const std::string nearest = NearestKey(key, known);
  std::string list;
  for (const std::string& name : known) list += (list.empty() ? "" : ", ") + name;
  throw ParamError(fmt::format("{}: unknown parameter '{}'{}; known: {}",
                               where,
                               key,
                               nearest.empty() ? "" : fmt::format(", did you mean '{}'?", nearest),
                               list.empty() ? "none" : list));
}

void FailInvalid(const std::string& where, const std::string& what) {
  throw ParamError(fmt::format("{}: {}", where, what));
}

}  // namespace internal

}  // namespace dendro_ros
