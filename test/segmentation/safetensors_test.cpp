#include "dendro_slam/segmentation/safetensors.h"

#include <algorithm>
#include <cmath>
#include <fstream>
#include <iterator>
#include <limits>
#include <random>
#include <string>

#include <gtest/gtest.h>

#include "dendro_slam/segmentation/erfnet.h"

namespace dendro {
namespace {

const std::string kFixture =
    std::string(DENDRO_SOURCE_DIR) + "/test/segmentation/data/erfnet_fixture.safetensors";

std::vector<std::uint8_t> WithHeader(const std::string& header, std::size_t data_bytes) {
  std::vector<std::uint8_t> bytes(8 + header.size() + data_bytes, 0);
  for (unsigned i = 0; i < 8; ++i) {
    bytes[i] = static_cast<std::uint8_t>(static_cast<std::uint64_t>(header.size()) >> (8 * i));
  }
  std::copy(header.begin(), header.end(), bytes.begin() + 8);
  return bytes;
}

void ExpectRefused(const std::vector<std::uint8_t>& bytes, const std::string& reason) {
  try {
    TensorFile::Parse(bytes, "file");
    ADD_FAILURE() << "accepted, expected: " << reason;
  } catch (const WeightsError& error) {
    const std::string text = error.what();
    EXPECT_NE(text.find(reason), std::string::npos) << text;
    EXPECT_EQ(text.find('\n'), std::string::npos) << text;
  }
}

std::vector<std::uint8_t> FileBytes(const std::string& path) {
  std::ifstream stream(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(stream), std::istreambuf_iterator<char>()};
}

TEST(Safetensors, ReadsWhatTheTrainingScriptWrote) {
  const TensorFile file = TensorFile::Load(kFixture);
  EXPECT_EQ(file.Metadata("format"), "dendro_erfnet_1");
  EXPECT_EQ(file.Get("00.conv.weight", {6, 9, 3, 5}).values.size(), 810U);
}

TEST(Safetensors, RoundTrip) {
  const std::map<std::string, Tensor> tensors = {{"b", {{2, 3}, {1, 2, 3, 4, 5, -6.5F}}},
                                                 {"a", {{1}, {1e-30F}}}};
  const TensorFile file =
      TensorFile::Parse(TensorFile::Serialize(tensors, {{"k", "v\n\"x\""}}), "memory");
  EXPECT_EQ(file.Get("b", {2, 3}).values, tensors.at("b").values);
  EXPECT_EQ(file.Get("a", {1}).values, tensors.at("a").values);
  EXPECT_EQ(file.Metadata("k"), "v\n\"x\"");
  EXPECT_THROW(file.Get("b", {3, 2}), WeightsError);
  EXPECT_THROW(file.Get("c", {1}), WeightsError);
  EXPECT_THROW(file.Metadata("z"), WeightsError);
}

TEST(Safetensors, RefusesWithTheReason) {
  EXPECT_THROW(TensorFile::Load("/nonexistent/x.safetensors"), WeightsError);
  ExpectRefused({}, "truncated");
  ExpectRefused({1, 2, 3}, "truncated");
  ExpectRefused({255, 255, 255, 255, 255, 255, 255, 255}, "header over 1 MiB");
  ExpectRefused({100, 0, 0, 0, 0, 0, 0, 0, '{', '}'}, "truncated: header of 100 bytes");
  ExpectRefused(WithHeader("[1]", 0), "not a JSON object");
  ExpectRefused(WithHeader("{\"a\"", 0), "not a JSON object");
  ExpectRefused(WithHeader(R"({"a":1})", 0), "lacks dtype");
  ExpectRefused(WithHeader(R"({"a":{"dtype":"F16","shape":[1],"data_offsets":[0,2]}})", 2),
                "not of dtype F32");
  ExpectRefused(WithHeader(R"({"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}})", 4),
                "points outside the file");
  ExpectRefused(WithHeader(R"({"a":{"dtype":"F32","shape":[2],"data_offsets":[0,4]}})", 4),
                "has 4 bytes");
  ExpectRefused(WithHeader(R"({"a":{"dtype":"F32","shape":[2],"data_offsets":[8,0]}})", 8),
                "no usable data_offsets");
  ExpectRefused(WithHeader(R"({"a":{"dtype":"F32","shape":[-2],"data_offsets":[0,8]}})", 8),
                "no usable shape");
  ExpectRefused(
      WithHeader(R"({"a":{"dtype":"F32","shape":[4294967296,4294967296],"data_offsets":[0,8]}})", 8),
      "no usable shape");
  ExpectRefused(
      WithHeader(
          R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[18446744073709551612,18446744073709551615]}})",
          8),
      "points outside the file");
  ExpectRefused(WithHeader(R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]},)"
                           R"("b":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}})", 4),
                "overlap");
  ExpectRefused(WithHeader(R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}})", 8),
                "bytes after the last tensor");
  std::map<std::string, Tensor> tensors = {
      {"a", {{2}, {0.0F, std::numeric_limits<float>::quiet_NaN()}}}};
  ExpectRefused(TensorFile::Serialize(tensors, {}), "NaN or Inf");
  tensors["a"].values[1] = std::numeric_limits<float>::infinity();
  ExpectRefused(TensorFile::Serialize(tensors, {}), "NaN or Inf");
}

// Whatever the bytes, the answer is a network or a WeightsError. Run under the sanitizers
// (scripts/build --sanitize) this also shows that no read leaves the file.
TEST(Safetensors, SurvivesRandomDamage) {
  const std::vector<std::uint8_t> good = FileBytes(kFixture);
  ASSERT_GT(good.size(), 10000U);
  std::uint64_t header_size = 0;
  for (std::size_t i = 8; i-- > 0;) header_size = header_size << 8U | good[i];
  std::mt19937 rng(99);
  int refused = 0;
  for (int trial = 0; trial < 1500; ++trial) {
    std::vector<std::uint8_t> bytes = good;
    const std::size_t reach = trial % 3 == 0 ? bytes.size() : 8 + header_size;
    const int damages = 1 + static_cast<int>(rng() % 4);
    for (int k = 0; k < damages; ++k) {
      switch (rng() % 4) {
        case 0: bytes[rng() % std::min(reach, bytes.size())] ^= 1U << (rng() % 8); break;
        case 1: bytes[rng() % std::min(reach, bytes.size())] = static_cast<std::uint8_t>(rng()); break;
        case 2: bytes[rng() % std::min(reach, bytes.size())] = "0123456789{}[],:\"x-"[rng() % 19]; break;
        default:
          if (k == 0) bytes.resize(1 + rng() % bytes.size());
      }
    }
    try {
      const TensorFile file = TensorFile::Parse(bytes, "damaged");
      ErfNet net(file);
    } catch (const WeightsError& error) {
      ++refused;
      ASSERT_EQ(std::string(error.what()).find('\n'), std::string::npos) << error.what();
    }
  }
  EXPECT_GT(refused, 1000);
}

}  // namespace
}  // namespace dendro
