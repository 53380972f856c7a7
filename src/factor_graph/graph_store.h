#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "dendro_slam/factor_graph/factor.h"
#include "dendro_slam/factor_graph/values.h"

namespace dendro::internal {

/// What elimination and back-substitution need of a variable, apart from the rest so that they stay
/// in the cache.
struct VariableState {
  double delta[kMaxTangentDimension] = {};      ///< Solution of the linear system at theta.
  int dimension = 0;
  int clique = -1;                              ///< Where it is eliminated.
  double last_unit = 1.0;                       ///< What a change of 1 m is in the last coordinate.
  double published[kMaxTangentDimension] = {};  ///< The delta that descendants last used.
};

/// The rest of a variable. Slots are reused after a removal.
struct VariableRecord {
  Key key = 0;
  bool alive = false;
  Value theta;                                ///< Linearisation point.
  Value estimate;                             ///< theta moved by delta.
  std::vector<int> factors;                   ///< Slots of its factors, ascending by insertion.
  /// Sum of the augmented Hessians of the factors on this variable alone, packed, dimension + 1 wide;
  /// empty for none. A landmark may have thousands: they are not part of the tree.
  std::vector<double> unary;
};

/// A factor as the solver keeps it.
struct FactorRecord {
  FactorPtr factor;
  std::uint32_t generation = 0;               ///< Of the slot, so that an old id is recognised.
  std::vector<int> variables;
  int columns = 0;
  int clique = -1;                            ///< Where it is assembled; none on one variable.
  /// Augmented Hessian `[A^T A, .; -r^T A, r^T r]` at theta, lower triangle packed by columns,
  /// `columns + 1` wide.
  std::vector<double> hessian;
};

struct GraphStore {
  std::vector<VariableState> states;       ///< By variable slot, as `variables`.
  std::vector<VariableRecord> variables;
  std::vector<FactorRecord> factors;
};

/// Asks for memory that will be read soon; has no other effect.
inline void PrefetchLines(const void* memory, std::size_t bytes) {
#ifdef __GNUC__
  constexpr std::size_t kLine = 64;
  for (std::size_t at = 0; at < bytes; at += kLine) {
    __builtin_prefetch(static_cast<const char*>(memory) + at);
  }
#else
  static_cast<void>(memory);
  static_cast<void>(bytes);
#endif
}

/// Index of entry (row, column), row >= column, in a packed lower triangle of `size` columns.
inline std::size_t PackedIndex(int row, int column, int size) {
  return static_cast<std::size_t>(column) * static_cast<std::size_t>(2 * size - column - 1) / 2 +
         static_cast<std::size_t>(row);
}

}  // namespace dendro::internal
