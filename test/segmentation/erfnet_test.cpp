#include "dendro_slam/segmentation/erfnet.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <string>

#include <gtest/gtest.h>

#include "dendro_slam/segmentation/safetensors.h"

namespace dendro {
namespace {

const std::string kData = std::string(DENDRO_SOURCE_DIR) + "/test/segmentation/data/";

// The fixture is PyTorch's answer of a small random network with every kind of layer, whose batch
// normalisations have random statistics (scripts/train_segmentation.py --fixture).
TEST(ErfNet, LogitsEqualPyTorch) {
  ErfNet net(TensorFile::Load(kData + "erfnet_fixture.safetensors"));
  EXPECT_EQ(net.input_channels(), 9);
  EXPECT_EQ(net.classes(), 4);
  EXPECT_EQ(net.row_multiple(), 4);
  EXPECT_EQ(net.col_multiple(), 4);
  const TensorFile io = TensorFile::Load(kData + "erfnet_fixture_io.safetensors");
  const Tensor& input = io.Get("input", {9, 16, 64});
  const Tensor& expected = io.Get("logits", {4, 16, 64});
  const std::vector<float> logits = net.Forward(input.values, 16, 64);
  ASSERT_EQ(logits.size(), expected.values.size());
  float largest = 0.0F;
  for (std::size_t i = 0; i < logits.size(); ++i) {
    ASSERT_NEAR(logits[i], expected.values[i], 1e-4F) << i;
    largest = std::max(largest, std::abs(expected.values[i]));
  }
  EXPECT_GT(largest, 0.5F);  // The comparison is of something.
}

TEST(ErfNet, SecondPassGivesTheSameAndDoesNotTouchTheFirst) {
  ErfNet net(TensorFile::Load(kData + "erfnet_fixture.safetensors"));
  const TensorFile io = TensorFile::Load(kData + "erfnet_fixture_io.safetensors");
  const Tensor& input = io.Get("input", {9, 16, 64});
  const std::vector<float> first = net.Forward(input.values, 16, 64);
  const std::vector<float> copy = first;
  net.Forward(std::vector<float>(9 * 16 * 128, 0.3F), 16, 128);
  EXPECT_EQ(first, copy);
  EXPECT_EQ(net.Forward(input.values, 16, 64), copy);
}

TEST(ErfNet, RefusesSizesThatDoNotFit) {
  ErfNet net(TensorFile::Load(kData + "erfnet_fixture.safetensors"));
  EXPECT_THROW(net.Forward(std::vector<float>(9 * 16 * 62), 16, 62), std::invalid_argument);
  EXPECT_THROW(net.Forward(std::vector<float>(9 * 15 * 64), 15, 64), std::invalid_argument);
  EXPECT_THROW(net.Forward(std::vector<float>(7), 16, 64), std::invalid_argument);
}

// A file with something changed must be refused with one line that says what is wrong.
class ErfNetRefuses : public ::testing::Test {
 protected:
  ErfNetRefuses() {
    const TensorFile file = TensorFile::Load(kData + "erfnet_fixture.safetensors");
    tensors_ = file.tensors();
    metadata_ = file.metadata();
  }
  void ExpectRefused(const std::string& reason) {
    const TensorFile file = TensorFile::Parse(TensorFile::Serialize(tensors_, metadata_), "x");
    try {
      ErfNet net(file);
      ADD_FAILURE() << "accepted: " << reason;
    } catch (const WeightsError& error) {
      const std::string text = error.what();
      EXPECT_NE(text.find(reason), std::string::npos) << text;
      EXPECT_EQ(text.find('\n'), std::string::npos);
    }
  }
  std::map<std::string, Tensor> tensors_;
  std::map<std::string, std::string> metadata_;
};

TEST_F(ErfNetRefuses, MissingTensor) {
  tensors_.erase("01.conv3.bias");
  ExpectRefused("tensor '01.conv3.bias' is missing");
}

TEST_F(ErfNetRefuses, WrongShape) {
  tensors_["00.conv.bias"] = Tensor{{7}, std::vector<float>(7)};
  ExpectRefused("tensor '00.conv.bias' has shape [7], expected [6]");
}

TEST_F(ErfNetRefuses, TensorLeftOver) {
  tensors_["99.conv.bias"] = Tensor{{1}, {0.0F}};
  ExpectRefused("do not use");
}

TEST_F(ErfNetRefuses, OtherFormat) {
  metadata_["format"] = "pt";
  ExpectRefused("another architecture");
}

TEST_F(ErfNetRefuses, BadLayers) {
  for (const auto& [layers, reason] : std::map<std::string, std::string>{
           {"stem:6:3x5:1x2 twist", "unknown type"},
           {"stem:6:3x5:1x2 add last:4:1x1:1x2", "another size"},
           {"stem:6:3x4:1x2", "odd kernel"},
           {"stem:6:3x5:1x3", "out of range"},
           {"stem:99999:3x5:1x2", "bad channel count"},
           {"stem:6:3x5", "wrong number of fields"},
           {"stem:6:3x5:1x2 last:4:2x2:1x2", "odd kernel"},
           {"stem:6:3x5:1x2 grow:6:1x1", "wrong number of fields"},
           {"stem:6:3x5:1x2", "does not end in a 'last' layer"},
           {"", "does not end in a 'last' layer"}}) {
    metadata_["layers"] = layers;
    ExpectRefused(reason);
  }
}

}  // namespace
}  // namespace dendro
