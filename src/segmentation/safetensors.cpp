#include "dendro_slam/segmentation/safetensors.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <fstream>
#include <limits>
#include <utility>

#include <fmt/format.h>
#include <nlohmann/json.hpp>

namespace dendro {
namespace {

constexpr std::uint64_t kMaxFileBytes = 64ULL << 20;
constexpr std::uint64_t kMaxHeaderBytes = 1ULL << 20;
constexpr std::size_t kMaxDimensions = 6;

[[noreturn]] void Fail(const std::string& name, const std::string& reason) {
  throw WeightsError(fmt::format("weights file '{}': {}", name, reason));
}

// Names come from the file: keep the message one line of printable characters.
std::string Printable(const std::string& text) {
  std::string out;
  for (const char c : text.substr(0, 64)) out += (c >= 32 && c < 127) ? c : '?';
  return out;
}

std::string ShapeText(const std::vector<int>& shape) {
  return fmt::format("[{}]", fmt::join(shape, ", "));
}

float LittleEndianFloat(const std::uint8_t* bytes) {
  const std::uint32_t bits = static_cast<std::uint32_t>(bytes[0]) |
                             static_cast<std::uint32_t>(bytes[1]) << 8U |
                             static_cast<std::uint32_t>(bytes[2]) << 16U |
                             static_cast<std::uint32_t>(bytes[3]) << 24U;
  float value;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

// A JSON number as an unsigned integer, or nothing for anything else.
bool ToUnsigned(const nlohmann::json& value, std::uint64_t* out) {
  if (!value.is_number_unsigned()) return false;
  *out = value.get<std::uint64_t>();
  return true;
}

}  // namespace

TensorFile TensorFile::Load(const std::string& path) {
  std::ifstream stream(path, std::ios::binary);
  if (!stream) Fail(path, "cannot be opened");
  std::vector<std::uint8_t> bytes;
  std::vector<char> block(1U << 16U);
  while (stream) {
    stream.read(block.data(), static_cast<std::streamsize>(block.size()));
    const std::streamsize got = stream.gcount();
    if (got <= 0) break;
    if (bytes.size() + static_cast<std::size_t>(got) > kMaxFileBytes) {
      Fail(path, "larger than 64 MiB");
    }
    bytes.insert(bytes.end(), block.begin(), block.begin() + got);
  }
  if (stream.bad()) Fail(path, "cannot be read");
  return Parse(bytes, path);
}

TensorFile TensorFile::Parse(const std::vector<std::uint8_t>& bytes, const std::string& name) {
  if (bytes.size() < 8) Fail(name, fmt::format("truncated: {} bytes", bytes.size()));
  if (bytes.size() > kMaxFileBytes) Fail(name, "larger than 64 MiB");
  std::uint64_t header_size = 0;
  for (std::size_t i = 8; i-- > 0;) header_size = header_size << 8U | bytes[i];
  if (header_size > kMaxHeaderBytes) Fail(name, "not a safetensors file: header over 1 MiB");
  if (header_size > bytes.size() - 8) {
    Fail(name, fmt::format("truncated: header of {} bytes in a file of {}", header_size,
                           bytes.size()));
  }
  const auto header_begin = bytes.begin() + 8;
  const auto header_end = header_begin + static_cast<std::ptrdiff_t>(header_size);
  const nlohmann::json header = nlohmann::json::parse(header_begin, header_end, nullptr, false);
  if (header.is_discarded() || !header.is_object()) {
    Fail(name, "not a safetensors file: header is not a JSON object");
  }
  const std::uint8_t* data = bytes.data() + 8 + header_size;
  const std::uint64_t data_size = bytes.size() - 8 - header_size;

  TensorFile file;
  file.name_ = name;
  std::vector<std::pair<std::uint64_t, std::uint64_t>> extents;
  for (const auto& [key, entry] : header.items()) {
    if (key == "__metadata__") {
      if (!entry.is_object()) Fail(name, "__metadata__ is not an object");
      for (const auto& [meta_key, meta_value] : entry.items()) {
        if (!meta_value.is_string()) Fail(name, "__metadata__ holds something else than strings");
        file.metadata_[meta_key] = meta_value.get<std::string>();
      }
      continue;
    }
    const std::string label = Printable(key);
    if (!entry.is_object() || !entry.contains("dtype") || !entry.contains("shape") ||
        !entry.contains("data_offsets")) {
      Fail(name, fmt::format("tensor '{}' lacks dtype, shape or data_offsets", label));
    }
    const nlohmann::json& dtype = entry["dtype"];
    if (!dtype.is_string() || dtype.get<std::string>() != "F32") {
      Fail(name, fmt::format("tensor '{}' is not of dtype F32", label));
    }
    const nlohmann::json& shape = entry["shape"];
    const nlohmann::json& offsets = entry["data_offsets"];
    if (!shape.is_array() || shape.empty() || shape.size() > kMaxDimensions) {
      Fail(name, fmt::format("tensor '{}' has no usable shape", label));
    }
    Tensor tensor;
    std::uint64_t count = 1;
    for (const nlohmann::json& extent : shape) {
      std::uint64_t value = 0;
      // With every factor and the product below 2^24 nothing overflows.
      if (!ToUnsigned(extent, &value) || value == 0 || value > (kMaxFileBytes / 4) ||
          count * value > kMaxFileBytes / 4) {
        Fail(name, fmt::format("tensor '{}' has no usable shape", label));
      }
      count *= value;
      tensor.shape.push_back(static_cast<int>(value));
    }
    std::uint64_t begin = 0;
    std::uint64_t end = 0;
    if (!offsets.is_array() || offsets.size() != 2 || !ToUnsigned(offsets[0], &begin) ||
        !ToUnsigned(offsets[1], &end) || begin > end) {
      Fail(name, fmt::format("tensor '{}' has no usable data_offsets", label));
    }
    if (end > data_size) {
      Fail(name, fmt::format("tensor '{}' points outside the file (truncated?)", label));
    }
    if (end - begin != 4 * count) {
      Fail(name, fmt::format("tensor '{}' of shape {} has {} bytes", label,
                             ShapeText(tensor.shape), end - begin));
    }
    tensor.values.resize(static_cast<std::size_t>(count));
    for (std::size_t i = 0; i < tensor.values.size(); ++i) {
      const float value = LittleEndianFloat(data + begin + 4 * i);
      if (!std::isfinite(value)) Fail(name, fmt::format("tensor '{}' holds NaN or Inf", label));
      tensor.values[i] = value;
    }
    extents.emplace_back(begin, end);
    file.tensors_[key] = std::move(tensor);
  }
  // The format demands that the tensors tile the data without overlap or hole.
  std::sort(extents.begin(), extents.end());
  std::uint64_t at = 0;
  for (const auto& [begin, end] : extents) {
    if (begin != at) Fail(name, "tensors overlap or leave holes");
    at = end;
  }
  if (at != data_size) Fail(name, "bytes after the last tensor");
  return file;
}

std::vector<std::uint8_t> TensorFile::Serialize(
    const std::map<std::string, Tensor>& tensors,
    const std::map<std::string, std::string>& metadata) {
  nlohmann::json header = nlohmann::json::object();
  if (!metadata.empty()) header["__metadata__"] = metadata;
  std::uint64_t offset = 0;
  for (const auto& [name, tensor] : tensors) {
    const std::uint64_t size = 4 * tensor.values.size();
    header[name] = {{"dtype", "F32"},
                    {"shape", tensor.shape},
                    {"data_offsets", {offset, offset + size}}};
    offset += size;
  }
  std::string text = header.dump();
  while (text.size() % 8 != 0) text += ' ';
  std::vector<std::uint8_t> bytes;
  bytes.reserve(8 + text.size() + offset);
  for (unsigned i = 0; i < 8; ++i) {
    bytes.push_back(static_cast<std::uint8_t>(static_cast<std::uint64_t>(text.size()) >> (8U * i)));
  }
  bytes.insert(bytes.end(), text.begin(), text.end());
  for (const auto& [name, tensor] : tensors) {
    for (const float value : tensor.values) {
      std::uint32_t bits;
      std::memcpy(&bits, &value, sizeof bits);
      for (unsigned i = 0; i < 4; ++i) bytes.push_back(static_cast<std::uint8_t>(bits >> (8U * i)));
    }
  }
  return bytes;
}

const Tensor& TensorFile::Get(const std::string& tensor, const std::vector<int>& shape) const {
  const auto found = tensors_.find(tensor);
  if (found == tensors_.end()) Fail(name_, fmt::format("tensor '{}' is missing", tensor));
  if (found->second.shape != shape) {
    Fail(name_, fmt::format("tensor '{}' has shape {}, expected {}: another architecture", tensor,
                            ShapeText(found->second.shape), ShapeText(shape)));
  }
  return found->second;
}

const std::string& TensorFile::Metadata(const std::string& key) const {
  const auto found = metadata_.find(key);
  if (found == metadata_.end()) Fail(name_, fmt::format("metadata '{}' is missing", key));
  return found->second;
}

}  // namespace dendro
