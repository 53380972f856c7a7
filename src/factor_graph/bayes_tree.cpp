#include "bayes_tree.h"

#include <algorithm>
#include <cstring>

#include "dense_front.h"

namespace dendro::internal {

namespace {

// A pivot below this part of its assembled diagonal entry is no information.
constexpr double kPivotTolerance = 1e-13;

// Cost model of joining a clique with its parent, in multiply-adds: passing a marginal on costs
// about kMarginalCost per entry, a clique of its own kCliqueCost.
constexpr double kMarginalCost = 6.0;
constexpr double kCliqueCost = 2500.0;

// Multiply-adds of a partial Cholesky factorisation of `f` of `n` columns.
double FrontCost(double n, double f) {
  const double s = n - f;
  return f * f * f / 6.0 + f * f * s / 2.0 + f * s * s / 2.0;
}

}  // namespace

void BayesTree::MarkStructural(int variable) {
  MarkStructuralClique(graph_->states[variable].clique);
}

void BayesTree::MarkStructuralClique(int clique) {
  while (clique >= 0 && !cliques_[clique].structural) {
    cliques_[clique].structural = true;
    structural_.push_back(clique);
    clique = cliques_[clique].parent;
  }
}

void BayesTree::MarkAllStructural() {
  for (int c = 0; c < num_slots(); ++c) {
    if (cliques_[c].alive) MarkStructuralClique(c);
  }
}

void BayesTree::MarkDirty(int clique) {
  while (clique >= 0 && !cliques_[clique].dirty) {
    cliques_[clique].dirty = true;
    dirty_.push_back(clique);
    clique = cliques_[clique].parent;
  }
}

void BayesTree::MarkAllDirty() {
  for (int c = 0; c < num_slots(); ++c) {
    if (cliques_[c].alive) MarkDirty(c);
  }
}

void BayesTree::Clear() {
  cliques_.clear();
  free_.clear();
  roots_.clear();
  structural_.clear();
  dirty_.clear();
  factorized_.clear();
  spare_.clear();
  for (VariableState& v : graph_->states) v.clique = -1;
}

int BayesTree::NewClique() {
  if (free_.empty()) {
    cliques_.emplace_back();
    return num_slots() - 1;
  }
  const int c = free_.back();
  free_.pop_back();
  return c;
}

// Gives an empty buffer room for `size` doubles, from a dissolved clique if one fits: large blocks
// that go back to the system and come again cost more than the arithmetic on them.
void BayesTree::Reserve(std::size_t size, std::vector<double>* buffer) {
  if (buffer->capacity() >= size) return;
  auto best = spare_.end();
  for (auto it = spare_.begin(); it != spare_.end(); ++it) {
    if (it->capacity() < size || it->capacity() > size + size / 2) continue;
    if (best == spare_.end() || it->capacity() < best->capacity()) best = it;
  }
  if (best == spare_.end()) {
    buffer->reserve(size);
    return;
  }
  std::swap(*best, spare_.back());
  *buffer = std::move(spare_.back());
  spare_.pop_back();
}

int BayesTree::Restructure(const std::vector<int>& new_variables,
                           const std::vector<int>& new_factors,
                           const std::vector<int>& groups,
                           int epoch) {
  std::vector<VariableRecord>& variables = graph_->variables;
  std::vector<VariableState>& states = graph_->states;
  std::vector<FactorRecord>& factors = graph_->factors;
  local_.resize(variables.size(), -1);
  offset_.resize(variables.size(), -1);

  // What is eliminated again: variables, factors, and the subtrees that hang below.
  std::vector<int> part;
  std::vector<int> part_factors;
  std::vector<int> orphans;
  for (const int c : structural_) {
    Clique& clique = cliques_[c];
    for (int i = 0; i < clique.num_frontal; ++i) {
      const int v = clique.variables[i];
      if (variables[v].alive && states[v].clique == c) part.push_back(v);
    }
    for (const int f : clique.factors) {
      if (factors[f].factor) part_factors.push_back(f);
    }
    for (const int child : clique.children) {
      if (!cliques_[child].structural) orphans.push_back(child);
    }
  }
  part.insert(part.end(), new_variables.begin(), new_variables.end());
  part_factors.insert(part_factors.end(), new_factors.begin(), new_factors.end());
  spare_.clear();
  for (const int c : structural_) {
    for (std::vector<double>* buffer : {&cliques_[c].conditional, &cliques_[c].marginal}) {
      if (buffer->capacity() > 0) spare_.push_back(std::move(*buffer));
    }
    if (cliques_[c].parent < 0) roots_.erase(std::find(roots_.begin(), roots_.end(), c));
    cliques_[c] = Clique();
    free_.push_back(c);
  }
  structural_.clear();
  dirty_.erase(std::remove_if(dirty_.begin(),
                              dirty_.end(),
                              [this](int c) { return !cliques_[c].alive; }),
               dirty_.end());
  const int n = static_cast<int>(part.size());
  if (n == 0) return 0;

  // Order.
  for (int i = 0; i < n; ++i) local_[part[i]] = i;
  hypergraph_.Clear(n);
  for (const int f : part_factors) {
    for (const int v : factors[f].variables) hypergraph_.members.push_back(local_[v]);
    hypergraph_.Close();
  }
  for (const int c : orphans) {
    const Clique& orphan = cliques_[c];
    for (std::size_t i = orphan.num_frontal; i < orphan.variables.size(); ++i) {
      hypergraph_.members.push_back(local_[orphan.variables[i]]);
    }
    hypergraph_.Close();
  }
  std::vector<int> part_groups(n);
  for (int i = 0; i < n; ++i) part_groups[i] = groups[part[i]];
  std::vector<int> order;
  ConstrainedOrder(hypergraph_, part_groups, &order);
  std::vector<int> ordered(n);
  std::vector<int> position(n);
  for (int p = 0; p < n; ++p) {
    position[order[p]] = p;
    ordered[p] = part[order[p]];
  }

  // Symbolic elimination: the separator of each variable alone.
  const int num_edges = hypergraph_.num_edges();
  std::vector<int> edge_first(num_edges);
  std::vector<int> bucket_start(n + 1, 0);
  for (int e = 0; e < num_edges; ++e) {
    int first = n;
    for (int k = hypergraph_.starts[e]; k < hypergraph_.starts[e + 1]; ++k) {
      hypergraph_.members[k] = position[hypergraph_.members[k]];
      first = std::min(first, hypergraph_.members[k]);
    }
    edge_first[e] = first;
    ++bucket_start[first + 1];
  }
  for (int p = 0; p < n; ++p) bucket_start[p + 1] += bucket_start[p];
  std::vector<int> bucket(num_edges);
  {
    std::vector<int> next(bucket_start.begin(), bucket_start.end() - 1);
    for (int e = 0; e < num_edges; ++e) bucket[next[edge_first[e]]++] = e;
  }
  std::vector<std::vector<int>> separators(n);
  std::vector<int> first_child(n, -1), next_sibling(n, -1), stamp(n, -1);
  for (int p = 0; p < n; ++p) {
    std::vector<int>& separator = separators[p];
    stamp[p] = p;
    const auto add = [&](int q) {
      if (q > p && stamp[q] != p) {
        stamp[q] = p;
        separator.push_back(q);
      }
    };
    for (int k = bucket_start[p]; k < bucket_start[p + 1]; ++k) {
      const int e = bucket[k];
      for (int m = hypergraph_.starts[e]; m < hypergraph_.starts[e + 1]; ++m) {
        add(hypergraph_.members[m]);
      }
    }
    for (int child = first_child[p]; child >= 0; child = next_sibling[child]) {
      for (const int q : separators[child]) add(q);
    }
    std::sort(separator.begin(), separator.end());
    if (!separator.empty()) {
      const int parent = separator.front();
      next_sibling[p] = first_child[parent];
      first_child[parent] = p;
    }
  }

  // Supernodes: join a variable's clique with those of its children where that costs less than
  // passing their marginals on.
  struct Node {
    std::vector<int> frontal;   // Positions, ascending.
    std::vector<int> children;  // Heads (last positions) of the child nodes.
    double f = 0.0, n = 0.0;    // Dimensions of the frontal part and of the whole.
  };
  std::vector<Node> nodes(n);
  std::vector<int> node_of(n);
  std::vector<int> child_list;
  for (int p = 0; p < n; ++p) {
    Node& node = nodes[p];
    node.f = states[ordered[p]].dimension;
    node.n = node.f;
    for (const int q : separators[p]) node.n += states[ordered[q]].dimension;
    child_list.clear();
    for (int child = first_child[p]; child >= 0; child = next_sibling[child]) {
      child_list.push_back(child);
    }
    // The largest separator first: it adds the fewest zeros.
    std::sort(child_list.begin(), child_list.end(), [&](int a, int b) {
      const double sa = nodes[a].n - nodes[a].f;
      const double sb = nodes[b].n - nodes[b].f;
      return sa != sb ? sa > sb : a < b;
    });
    for (const int child : child_list) {
      Node& other = nodes[child];
      const double s = other.n - other.f;
      const double apart = FrontCost(node.n, node.f) + FrontCost(other.n, other.f) +
                           kMarginalCost * s * s / 2.0 + kCliqueCost;
      const double joined = FrontCost(node.n + other.f, node.f + other.f);
      if (joined <= apart) {
        node.frontal.insert(node.frontal.end(), other.frontal.begin(), other.frontal.end());
        node.children.insert(node.children.end(), other.children.begin(), other.children.end());
        node.f += other.f;
        node.n += other.f;
        other = Node();
      } else {
        node.children.push_back(child);
      }
    }
    node.frontal.push_back(p);
  }

  // Cliques, in elimination order of their last variable: children before parents.
  std::vector<int> clique_of_head(n, -1);
  for (int p = 0; p < n; ++p) {
    Node& node = nodes[p];
    if (node.frontal.empty()) continue;
    std::sort(node.frontal.begin(), node.frontal.end());
    const int c = NewClique();
    Clique& clique = cliques_[c];
    clique.alive = true;
    clique.created = epoch;
    clique.num_frontal = static_cast<int>(node.frontal.size());
    clique.variables.reserve(node.frontal.size() + separators[p].size());
    for (const int q : node.frontal) {
      node_of[q] = c;
      const int v = ordered[q];
      states[v].clique = c;
      clique.variables.push_back(v);
      clique.frontal_dimension += states[v].dimension;
    }
    for (const int q : separators[p]) {
      const int v = ordered[q];
      clique.variables.push_back(v);
      clique.separator_dimension += states[v].dimension;
    }
    clique_of_head[p] = c;
    clique.children.reserve(node.children.size());
    for (const int child : node.children) {
      clique.children.push_back(clique_of_head[child]);
      cliques_[clique_of_head[child]].parent = c;
    }
    if (separators[p].empty()) roots_.push_back(c);
    clique.dirty = true;
    dirty_.push_back(c);
  }
  const int num_part_factors = static_cast<int>(part_factors.size());
  for (int e = 0; e < num_edges; ++e) {
    const int c = node_of[edge_first[e]];
    if (e < num_part_factors) {
      cliques_[c].factors.push_back(part_factors[e]);
      factors[part_factors[e]].clique = c;
    } else {
      const int orphan = orphans[e - num_part_factors];
      cliques_[orphan].parent = c;
      cliques_[c].children.push_back(orphan);
    }
  }
  for (const int v : part) local_[v] = -1;
  return n;
}

int BayesTree::CountFrontal(const std::vector<int>& cliques) const {
  int count = 0;
  for (const int c : cliques) count += cliques_[c].num_frontal;
  return count;
}

int BayesTree::Factorize(const Damping& damping) {
  offset_.resize(graph_->variables.size(), -1);
  // Parents before children from the roots, then backwards.
  factorized_.clear();
  for (const int root : roots_) {
    if (cliques_[root].dirty) factorized_.push_back(root);
  }
  for (std::size_t i = 0; i < factorized_.size(); ++i) {
    for (const int child : cliques_[factorized_[i]].children) {
      if (cliques_[child].dirty) factorized_.push_back(child);
    }
  }
  for (auto it = factorized_.rbegin(); it != factorized_.rend(); ++it) {
    int failed = -1;
    if (!FactorizeClique(&cliques_[*it], damping, &failed)) return failed;
  }
  for (const int c : factorized_) {
    cliques_[c].dirty = false;
    cliques_[c].unsolved = true;
  }
  dirty_.clear();
  return -1;
}

bool BayesTree::FactorizeClique(Clique* clique, const Damping& damping, int* failed) {
  const std::vector<VariableState>& states = graph_->states;
  const int frontal = clique->frontal_dimension;
  const int separator = clique->separator_dimension;
  const int rhs = frontal + separator;
  const int size = rhs + 1;
  const int stride = FrontStride(size);
  const std::size_t cells = static_cast<std::size_t>(stride) * stride;
  if (front_.size() < cells) front_.resize(cells);
  // The lower triangle alone; what is above it is never read into a result.
  for (int j = 0; j < stride; ++j) {
    std::memset(front_.data() + static_cast<std::size_t>(j) * stride + j, 0,
                sizeof(double) * static_cast<std::size_t>(stride - j));
  }

  int offset = 0;
  for (const int v : clique->variables) {
    offset_[v] = offset;
    offset += states[v].dimension;
  }
  for (int i = 0; i < clique->num_frontal; ++i) AddUnary(clique->variables[i], stride, rhs);
  // What is summed lies scattered in memory, so the next is fetched while one is added.
  const std::vector<int>& factors = clique->factors;
  for (std::size_t i = 0; i < factors.size(); ++i) {
    if (i + 2 < factors.size()) PrefetchLines(&graph_->factors[factors[i + 2]], sizeof(FactorRecord));
    if (i + 1 < factors.size()) {
      const FactorRecord& next = graph_->factors[factors[i + 1]];
      PrefetchLines(next.hessian.data(), next.hessian.size() * sizeof(double));
      PrefetchLines(next.variables.data(), 1);
    }
    AddFactor(graph_->factors[factors[i]], stride, rhs);
  }
  for (const int child : clique->children) AddMarginal(cliques_[child], stride, rhs);

  limits_.resize(std::max(limits_.size(), static_cast<std::size_t>(frontal)));
  for (int j = 0; j < frontal; ++j) {
    limits_[j] = kPivotTolerance * front_[static_cast<std::size_t>(j) * stride + j];
  }
  if (damping.lambda > 0.0) {
    offset = 0;
    for (int i = 0; i < clique->num_frontal; ++i) {
      const int v = clique->variables[i];
      for (int k = 0; k < states[v].dimension; ++k, ++offset) {
        const double d =
            damping.lambda * (*damping.weights)[static_cast<std::size_t>(v) * kMaxTangentDimension + k];
        double* column = front_.data() + static_cast<std::size_t>(offset) * stride;
        column[offset] += d;
        column[rhs] += d * states[v].delta[k];
      }
    }
  }

  const int column = PartialCholesky(front_.data(), stride, size, frontal, limits_.data());
  if (column >= 0) {
    for (int i = 0; i < clique->num_frontal; ++i) {
      const int v = clique->variables[i];
      if (column < offset_[v] + states[v].dimension) {
        *failed = v;
        return false;
      }
    }
  }

  Reserve(static_cast<std::size_t>(size) * frontal, &clique->conditional);
  clique->conditional.resize(static_cast<std::size_t>(size) * frontal);
  for (int j = 0; j < frontal; ++j) {
    std::memcpy(clique->conditional.data() + static_cast<std::size_t>(j) * size,
                front_.data() + static_cast<std::size_t>(j) * stride,
                sizeof(double) * static_cast<std::size_t>(size));
  }
  if (separator > 0) {
    const int m = separator + 1;
    Reserve(static_cast<std::size_t>(m) * (m + 1) / 2, &clique->marginal);
    clique->marginal.resize(static_cast<std::size_t>(m) * (m + 1) / 2);
    double* out = clique->marginal.data();
    for (int j = 0; j < m; ++j) {
      const double* source = front_.data() + static_cast<std::size_t>(frontal + j) * stride + frontal + j;
      std::memcpy(out, source, sizeof(double) * static_cast<std::size_t>(m - j));
      out += m - j;
    }
  }
  return true;
}

void BayesTree::AddFactor(const FactorRecord& factor, int stride, int rhs) {
  const std::vector<VariableState>& states = graph_->states;
  const double* source = factor.hessian.data();
  const int count = static_cast<int>(factor.variables.size());
  for (int a = 0; a < count; ++a) {
    const int va = factor.variables[a];
    const int da = states[va].dimension;
    for (int k = 0; k < da; ++k) {
      const int column = offset_[va] + k;
      double* target = front_.data() + static_cast<std::size_t>(column) * stride;
      for (int r = k; r < da; ++r) target[offset_[va] + r] += *source++;
      for (int b = a + 1; b < count; ++b) {
        const int vb = factor.variables[b];
        const int db = states[vb].dimension;
        const int row = offset_[vb];
        if (row > column) {
          for (int r = 0; r < db; ++r) target[row + r] += *source++;
        } else {
          for (int r = 0; r < db; ++r) {
            front_[static_cast<std::size_t>(row + r) * stride + column] += *source++;
          }
        }
      }
      target[rhs] += *source++;
    }
  }
}

void BayesTree::AddUnary(int variable, int stride, int rhs) {
  const std::vector<double>& unary = graph_->variables[variable].unary;
  if (unary.empty()) return;
  const double* source = unary.data();
  const int first = offset_[variable];
  const int d = graph_->states[variable].dimension;
  for (int k = 0; k < d; ++k) {
    double* target = front_.data() + static_cast<std::size_t>(first + k) * stride;
    for (int r = k; r < d; ++r) target[first + r] += *source++;
    target[rhs] += *source++;
  }
}

void BayesTree::AddMarginal(const Clique& child, int stride, int rhs) {
  const std::vector<VariableState>& states = graph_->states;
  std::vector<Run>& runs = runs_;
  runs.clear();
  for (std::size_t i = child.num_frontal; i < child.variables.size(); ++i) {
    const int v = child.variables[i];
    const int length = states[v].dimension;
    if (!runs.empty() && runs.back().target + runs.back().length == offset_[v]) {
      runs.back().length += length;
    } else {
      runs.push_back({offset_[v], length});
    }
  }
  if (!runs.empty() && runs.back().target + runs.back().length == rhs) {
    runs.back().length += 1;
  } else {
    runs.push_back({rhs, 1});
  }
  const double* in = child.marginal.data();
  for (std::size_t a = 0; a < runs.size(); ++a) {
    for (int k = 0; k < runs[a].length; ++k) {
      const int column = runs[a].target + k;
      double* target = front_.data() + static_cast<std::size_t>(column) * stride;
      for (int r = k; r < runs[a].length; ++r) target[runs[a].target + r] += *in++;
      for (std::size_t b = a + 1; b < runs.size(); ++b) {
        const int row = runs[b].target;
        const int length = runs[b].length;
        if (row > column) {
          double* out = target + row;
          for (int r = 0; r < length; ++r) out[r] += in[r];
        } else {
          double* out = front_.data() + static_cast<std::size_t>(row) * stride + column;
          for (int r = 0; r < length; ++r) out[static_cast<std::size_t>(r) * stride] += in[r];
        }
        in += length;
      }
    }
  }
}

void BayesTree::SolveClique(const Clique& clique, double* x) const {
  const int frontal = clique.frontal_dimension;
  int offset = frontal;
  for (std::size_t i = clique.num_frontal; i < clique.variables.size(); ++i) {
    const VariableState& v = graph_->states[clique.variables[i]];
    for (int k = 0; k < v.dimension; ++k) x[offset++] = v.delta[k];
  }
  SolveConditional(clique.conditional.data(), frontal, clique.separator_dimension, x);
}

Eigen::MatrixXd BayesTree::ForwardSolve(const std::vector<int>& selected) const {
  // The cliques on the paths to the root, every one after those below it. A column has entries only
  // from its variable's clique upwards: with the columns in the order in which their cliques are
  // passed, those of a subtree lie side by side.
  struct Passed {
    int clique = -1;
    int first_column = 0;  // Of the cliques below it.
    int own_column = 0;    // Of its own variables; then come those of the next clique.
  };
  std::vector<int> in_path(cliques_.size(), -1);  // Index in `climbed`.
  std::vector<int> climbed;
  for (const int v : selected) {
    for (int c = graph_->states[v].clique; c >= 0 && in_path[c] < 0; c = cliques_[c].parent) {
      in_path[c] = static_cast<int>(climbed.size());
      climbed.push_back(c);
    }
  }
  std::vector<std::vector<int>> below(climbed.size());
  std::vector<int> open;
  for (const int c : climbed) {
    const int parent = cliques_[c].parent;
    if (parent < 0) {
      open.push_back(c);
    } else {
      below[in_path[parent]].push_back(c);
    }
  }
  std::vector<std::vector<std::pair<int, int>>> starting(climbed.size());  // (row in the clique, selected)
  std::vector<int> row_in_clique(graph_->variables.size(), -1);
  for (const int c : climbed) {
    int row = 0;
    for (int i = 0; i < cliques_[c].num_frontal; ++i) {
      row_in_clique[cliques_[c].variables[i]] = row;
      row += graph_->states[cliques_[c].variables[i]].dimension;
    }
  }
  for (std::size_t i = 0; i < selected.size(); ++i) {
    starting[in_path[graph_->states[selected[i]].clique]].emplace_back(row_in_clique[selected[i]],
                                                                      static_cast<int>(i));
  }
  for (auto& list : starting) std::sort(list.begin(), list.end());

  // Down in pre-order, which read backwards passes every clique after those below it.
  std::vector<int> down;
  while (!open.empty()) {
    const int c = open.back();
    open.pop_back();
    down.push_back(c);
    open.insert(open.end(), below[in_path[c]].begin(), below[in_path[c]].end());
  }
  std::vector<Passed> passed;
  std::vector<int> row_of(graph_->variables.size(), -1);
  std::vector<int> column_of(selected.size(), 0);
  std::vector<int> first_column(climbed.size(), 0);
  int rows = 0, columns = 0;
  for (auto it = down.rbegin(); it != down.rend(); ++it) {
    const Clique& clique = cliques_[*it];
    for (int i = 0; i < clique.num_frontal; ++i) {
      row_of[clique.variables[i]] = rows + row_in_clique[clique.variables[i]];
    }
    rows += clique.frontal_dimension;
    int first = columns;
    for (const int child : below[in_path[*it]]) first = std::min(first, first_column[in_path[child]]);
    first_column[in_path[*it]] = first;
    passed.push_back({*it, first, columns});
    for (const auto& [row, i] : starting[in_path[*it]]) {
      column_of[i] = columns;
      columns += graph_->states[selected[i]].dimension;
    }
  }

  Eigen::MatrixXd Y = Eigen::MatrixXd::Zero(rows, columns);
  for (std::size_t i = 0; i < selected.size(); ++i) {
    for (int k = 0; k < graph_->states[selected[i]].dimension; ++k) {
      Y(row_of[selected[i]] + k, column_of[i] + k) = 1.0;
    }
  }
  constexpr int kChunk = 32;  // Columns that start together.
  Eigen::MatrixXd passed_on;
  for (std::size_t p = 0; p < passed.size(); ++p) {
    const Clique& clique = cliques_[passed[p].clique];
    const int frontal = clique.frontal_dimension, separator = clique.separator_dimension;
    const int first_row = row_of[clique.variables[0]];
    const int end_column = p + 1 < passed.size() ? passed[p + 1].own_column : columns;
    using StridedMatrix = Eigen::Map<const Eigen::MatrixXd, 0, Eigen::OuterStride<>>;
    const Eigen::OuterStride<> stride(frontal + separator + 1);
    const StridedMatrix L11(clique.conditional.data(), frontal, frontal, stride);
    const int inherited = passed[p].own_column - passed[p].first_column;
    if (inherited > 0) {
      auto y = Y.block(first_row, passed[p].first_column, frontal, inherited);
      L11.triangularView<Eigen::Lower>().solveInPlace(y);
    }
    // Above the row of its variable a column stays empty.
    const auto& own = starting[in_path[passed[p].clique]];
    int column = passed[p].own_column;
    for (std::size_t i = 0; i < own.size();) {
      const int row = own[i].first;
      int width = 0;
      for (; i < own.size() && width < kChunk; ++i) {
        width += graph_->states[selected[own[i].second]].dimension;
      }
      auto y = Y.block(first_row + row, column, frontal - row, width);
      L11.bottomRightCorner(frontal - row, frontal - row).triangularView<Eigen::Lower>().solveInPlace(y);
      column += width;
    }
    if (separator == 0) continue;
    const StridedMatrix L21(clique.conditional.data() + frontal, separator, frontal, stride);
    const int width = end_column - passed[p].first_column;
    passed_on.noalias() = L21 * Y.block(first_row, passed[p].first_column, frontal, width);
    int source = 0;
    for (std::size_t i = clique.num_frontal; i < clique.variables.size(); ++i) {
      const int v = clique.variables[i];
      const int d = graph_->states[v].dimension;
      Y.block(row_of[v], passed[p].first_column, d, width) -= passed_on.middleRows(source, d);
      source += d;
    }
  }

  Eigen::MatrixXd out(rows, columns);
  int column = 0;
  for (std::size_t i = 0; i < selected.size(); ++i) {
    const int d = graph_->states[selected[i]].dimension;
    out.middleCols(column, d) = Y.middleCols(column_of[i], d);
    column += d;
  }
  return out;
}

double BayesTree::Flops() const {
  double flops = 0.0;
  for (const Clique& c : cliques_) {
    if (c.alive) flops += FrontCost(c.frontal_dimension + c.separator_dimension, c.frontal_dimension);
  }
  return flops;
}

std::size_t BayesTree::StoredDoubles() const {
  std::size_t total = 0;
  for (const Clique& c : cliques_) total += c.conditional.capacity() + c.marginal.capacity();
  return total;
}

}  // namespace dendro::internal
