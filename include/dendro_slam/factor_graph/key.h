#pragma once

#include <cstdint>
#include <string>

/// Names of the variables of a factor graph.
namespace dendro {

/// A letter (the kind of the variable, e.g. 'x' pose, 'l' landmark) in the top byte and an index in
/// the lower 56 bits.
using Key = std::uint64_t;

constexpr int kKeyIndexBits = 56;
constexpr Key kKeyIndexMask = (Key{1} << kKeyIndexBits) - 1;

/// The key of variable `symbol``index`, e.g. MakeKey('x', 12).
constexpr Key MakeKey(char symbol, std::uint64_t index) {
  return (static_cast<Key>(static_cast<unsigned char>(symbol)) << kKeyIndexBits) |
         (index & kKeyIndexMask);
}

constexpr char KeySymbol(Key key) { return static_cast<char>(key >> kKeyIndexBits); }
constexpr std::uint64_t KeyIndex(Key key) { return key & kKeyIndexMask; }

/// "x12"; keys without a letter print as their number.
std::string KeyName(Key key);

}  // namespace dendro
