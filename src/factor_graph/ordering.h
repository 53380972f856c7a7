#pragma once

#include <vector>

namespace dendro::internal {

/// Hyperedges over variables 0 .. num_variables-1 in compressed rows: edge i joins
/// `members[starts[i]] .. members[starts[i + 1] - 1]`.
struct Hypergraph {
  int num_variables = 0;
  std::vector<int> starts = {0};
  std::vector<int> members;

  void Clear(int variables) {
    num_variables = variables;
    starts.assign(1, 0);
    members.clear();
  }
  void Close() { starts.push_back(static_cast<int>(members.size())); }
  int num_edges() const { return static_cast<int>(starts.size()) - 1; }
};

/// Fill-reducing elimination order by CCOLAMD.
/// @param groups  Per variable; higher groups are eliminated later.
/// @param order   Out: variables in elimination order.
void ConstrainedOrder(const Hypergraph& graph,
                      const std::vector<int>& groups,
                      std::vector<int>* order);

}  // namespace dendro::internal
