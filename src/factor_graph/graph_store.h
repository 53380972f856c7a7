#pragma once

#include <cstdint>
#include <vector>

#include "dendro_slam/factor_graph/factor.h"
#include "dendro_slam/factor_graph/values.h"

namespace dendro::internal {

/// A variable as the solver keeps it. Slots are reused after a removal.
struct VariableRecord {
  Key key = 0;
  int dimension = 0;
  bool alive = false;
  Value theta;                                ///< Linearisation point.
  Value estimate;                             ///< theta moved by delta.
  double delta[kMaxTangentDimension] = {};    ///< Solution of the linear system at theta.
  double published[kMaxTangentDimension] = {};  ///< The delta that descendants last used.
  int clique = -1;                            ///< Where it is eliminated.
  std::vector<int> factors;                   ///< Slots of its factors, ascending by insertion.
};

/// A factor as the solver keeps it.
struct FactorRecord {
  FactorPtr factor;
  std::uint32_t generation = 0;               ///< Of the slot, so that an old id is recognised.
  std::vector<int> variables;
  int columns = 0;
  int clique = -1;                            ///< Where it is assembled.
  /// Augmented Hessian `[A^T A, .; -r^T A, r^T r]` at theta, lower triangle packed by columns,
  /// `columns + 1` wide.
  std::vector<double> hessian;
};

struct GraphStore {
  std::vector<VariableRecord> variables;
  std::vector<FactorRecord> factors;
};

/// Index of entry (row, column), row >= column, in a packed lower triangle of `size` columns.
inline std::size_t PackedIndex(int row, int column, int size) {
  return static_cast<std::size_t>(column) * static_cast<std::size_t>(2 * size - column - 1) / 2 +
         static_cast<std::size_t>(row);
}

}  // namespace dendro::internal
