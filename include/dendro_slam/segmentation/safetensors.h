#pragma once

#include <cstdint>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

namespace dendro {

/// A weights file that cannot be used; `what()` is one line that names the file and the reason.
class WeightsError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// A dense tensor of finite 32-bit floats, row-major.
struct Tensor {
  std::vector<int> shape;     ///< Extent per dimension, outermost first; all positive.
  std::vector<float> values;  ///< As many as the product of `shape`.
};

/// The contents of a safetensors file: named tensors and the string map `__metadata__`.
///
/// The format (https://github.com/huggingface/safetensors): eight bytes little-endian header
/// length, a JSON header that gives dtype, shape and byte range of every tensor, then the bytes.
/// Only F32 tensors are accepted. Nothing in the header is believed before it was checked against
/// the size of the file: no read leaves the buffer, whatever the bytes are.
class TensorFile {
 public:
  /// Reads and checks a file. @throws WeightsError if it is missing, truncated, larger than 64 MiB,
  ///   not safetensors, of another dtype, holds overlapping or out-of-range tensors, or NaN or Inf.
  static TensorFile Load(const std::string& path);
  /// The same from memory; `name` stands for the file in error messages.
  static TensorFile Parse(const std::vector<std::uint8_t>& bytes, const std::string& name);
  /// Serialises tensors and metadata; the inverse of Parse. Deterministic (sorted by name).
  static std::vector<std::uint8_t> Serialize(const std::map<std::string, Tensor>& tensors,
                                             const std::map<std::string, std::string>& metadata);

  const std::string& name() const { return name_; }
  const std::map<std::string, Tensor>& tensors() const { return tensors_; }
  const std::map<std::string, std::string>& metadata() const { return metadata_; }
  bool Has(const std::string& tensor) const { return tensors_.count(tensor) > 0; }

  /// The tensor of that name and exactly that shape. @throws WeightsError otherwise.
  const Tensor& Get(const std::string& tensor, const std::vector<int>& shape) const;
  /// The metadata entry of that name. @throws WeightsError if there is none.
  const std::string& Metadata(const std::string& key) const;

 private:
  std::string name_;
  std::map<std::string, Tensor> tensors_;
  std::map<std::string, std::string> metadata_;
};

}  // namespace dendro
