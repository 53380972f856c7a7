#include "dendro_slam/ros/params.h"

#include <gtest/gtest.h>

#include <cmath>

namespace dendro_ros {
namespace {

struct InnerConfig {
  double length_m = 2.0;
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("length_m", length_m);
  }
};

struct SomeConfig {
  double max_radius_m = 0.6;
  int min_points = 8;
  bool enabled = true;
  std::string method = "network";
  InnerConfig inner;

  void Validate() const {
    if (!(max_radius_m > 0.0)) throw std::invalid_argument("max_radius_m must be positive");
  }
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("max_radius_m", max_radius_m);
    v("min_points", min_points);
    v("enabled", enabled);
    v("method", method);
    v("inner", inner);
  }
};

std::string ErrorOf(const std::string& yaml) {
  try {
    ReadConfig<SomeConfig>(ParseYaml(yaml, "file.yaml"), "file.yaml");
  } catch (const ParamError& error) {
    return error.what();
  }
  return "";
}

TEST(ReadConfig, KeepsTheDefaultsOfTheStruct) {
  const auto config = ReadConfig<SomeConfig>(ParseYaml("", "f"), "f");
  EXPECT_EQ(config.max_radius_m, 0.6);
  EXPECT_EQ(config.min_points, 8);
  EXPECT_EQ(config.inner.length_m, 2.0);
}

TEST(ReadConfig, ReadsEveryType) {
  const auto config = ReadConfig<SomeConfig>(
      ParseYaml("{max_radius_m: 1, min_points: 12, enabled: false, method: \"12\", inner: "
                "{length_m: 1e-3}}",
                "f"),
      "f");
  EXPECT_EQ(config.max_radius_m, 1.0);
  EXPECT_EQ(config.min_points, 12);
  EXPECT_FALSE(config.enabled);
  EXPECT_EQ(config.method, "12");
  EXPECT_EQ(config.inner.length_m, 1e-3);
}

TEST(ReadConfig, UnknownKeyNamesTheNearest) {
  const std::string error = ErrorOf("max_radus_m: 0.3");
  EXPECT_NE(error.find("file.yaml"), std::string::npos) << error;
  EXPECT_NE(error.find("'max_radus_m'"), std::string::npos) << error;
  EXPECT_NE(error.find("did you mean 'max_radius_m'"), std::string::npos) << error;
  const std::string nested = ErrorOf("inner: {lenght_m: 1.0}");
  EXPECT_NE(nested.find("file.yaml/inner"), std::string::npos) << nested;
  const std::string far = ErrorOf("zebra: 1");
  EXPECT_EQ(far.find("did you mean"), std::string::npos) << far;
}

TEST(ReadConfig, TypesAreStrict) {
  EXPECT_NE(ErrorOf("min_points: 8.0").find("a whole number"), std::string::npos);
  EXPECT_NE(ErrorOf("min_points: 8.5").find("file.yaml/min_points"), std::string::npos);
  EXPECT_NE(ErrorOf("min_points: true"), "");
  EXPECT_NE(ErrorOf("enabled: 1").find("true or false"), std::string::npos);
  EXPECT_NE(ErrorOf("max_radius_m: thick").find("a number"), std::string::npos);
  EXPECT_NE(ErrorOf("max_radius_m: .nan").find("finite"), std::string::npos);
  EXPECT_NE(ErrorOf("max_radius_m: .inf").find("finite"), std::string::npos);
  EXPECT_NE(ErrorOf("method: 3").find("text"), std::string::npos);
  EXPECT_NE(ErrorOf("inner: 3").find("group"), std::string::npos);
  EXPECT_NE(ErrorOf("[1, 2]").find("group"), std::string::npos);
}

TEST(ReadConfig, RangeComesFromValidate) {
  const std::string error = ErrorOf("max_radius_m: -1.0");
  EXPECT_NE(error.find("max_radius_m must be positive"), std::string::npos) << error;
  EXPECT_NE(error.find("file.yaml"), std::string::npos) << error;
}

TEST(ParseYaml, NamesTheLineOfBrokenText) {
  try {
    ParseYaml("a: 1\nb: [1, 2", "broken.yaml");
    FAIL() << "accepted";
  } catch (const ParamError& error) {
    EXPECT_NE(std::string(error.what()).find("broken.yaml: line"), std::string::npos) << error.what();
  }
  EXPECT_THROW(ReadYamlFile("/nonexistent/x.yaml"), ParamError);
  EXPECT_THROW(ReadYamlFile("/"), ParamError);
}

TEST(ConfigKeys, ListsNestedKeys) {
  const std::vector<std::string> expected = {
      "max_radius_m", "min_points", "enabled", "method", "inner/length_m"};
  EXPECT_EQ(ConfigKeys<SomeConfig>(), expected);
}

}  // namespace
}  // namespace dendro_ros
