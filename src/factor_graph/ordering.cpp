#include "ordering.h"

#include <stdexcept>

#include <ccolamd.h>

namespace dendro::internal {

void ConstrainedOrder(const Hypergraph& graph,
                      const std::vector<int>& groups,
                      std::vector<int>* order) {
  const int n = graph.num_variables;
  order->resize(n);
  if (n <= 2) {
    for (int i = 0; i < n; ++i) (*order)[i] = i;
    if (n == 2 && groups[0] > groups[1]) std::swap((*order)[0], (*order)[1]);
    return;
  }
  // CCOLAMD wants columns of rows: transpose the hyperedges.
  const int rows = graph.num_edges();
  const int nonzeros = static_cast<int>(graph.members.size());
  std::vector<int> p(n + 1, 0);
  for (const int v : graph.members) ++p[v + 1];
  for (int i = 0; i < n; ++i) p[i + 1] += p[i];
  const std::size_t length = ccolamd_recommended(nonzeros, rows, n);
  std::vector<int> A(length);
  std::vector<int> next(p.begin(), p.end() - 1);
  for (int e = 0; e < rows; ++e) {
    for (int k = graph.starts[e]; k < graph.starts[e + 1]; ++k) A[next[graph.members[k]]++] = e;
  }
  double knobs[CCOLAMD_KNOBS];
  int stats[CCOLAMD_STATS];
  ccolamd_set_defaults(knobs);
  knobs[CCOLAMD_DENSE_ROW] = -1;
  knobs[CCOLAMD_DENSE_COL] = -1;
  std::vector<int> cmember(groups);
  if (!ccolamd(rows, n, static_cast<int>(length), A.data(), p.data(), knobs, stats, cmember.data())) {
    throw std::logic_error("ccolamd rejected the graph");
  }
  for (int i = 0; i < n; ++i) (*order)[i] = p[i];
}

}  // namespace dendro::internal
