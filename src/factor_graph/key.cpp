#include "dendro_slam/factor_graph/key.h"

namespace dendro {

std::string KeyName(Key key) {
  const char symbol = KeySymbol(key);
  const bool printable = symbol >= 33 && symbol <= 126;
  return printable ? std::string(1, symbol) + std::to_string(KeyIndex(key)) : std::to_string(key);
}

}  // namespace dendro
