#pragma once

#include <vector>

#include <Eigen/Core>

#include "graph_store.h"
#include "ordering.h"

namespace dendro::internal {

/// A clique of the Bayes tree: the conditional density of its frontal variables given its
/// separator, and the density that its subtree leaves on the separator.
struct Clique {
  std::vector<int> variables;   ///< Frontal variables in elimination order, then the separator.
  int num_frontal = 0;
  int frontal_dimension = 0;
  int separator_dimension = 0;
  int parent = -1;
  std::vector<int> children;
  std::vector<int> factors;     ///< Assembled here: their first eliminated variable is frontal.
  /// `[L11; L21; d^T]`, column-major, shape (frontal + separator + 1, frontal).
  std::vector<double> conditional;
  /// Augmented Hessian on the separator, packed lower triangle of separator_dimension + 1 columns.
  std::vector<double> marginal;
  bool alive = false;
  bool structural = false;      ///< To be dissolved and eliminated again in a new order.
  bool dirty = false;           ///< To be factorised again.
  bool unsolved = false;        ///< Factorised, but the estimate does not know yet.
  int created = 0;              ///< Epoch in which it was made.
};

/// Levenberg-Marquardt damping `lambda * weight[v] * |d - anchor|^2 / 2` of the variables that are
/// eliminated while it is set.
struct Damping {
  double lambda = 0.0;
  /// Diagonal of the Hessian per variable slot, kMaxTangentDimension each.
  const std::vector<double>* weights = nullptr;
};

/// The Bayes tree (Kaess et al. 2012) by multifrontal Cholesky factorisation.
///
/// Changes are marked first (MarkStructural, MarkDirty), then Restructure orders and joins the
/// dissolved part anew, Factorize recomputes every marked clique from its factors and its
/// children's marginals, and the caller solves from the root.
class BayesTree {
 public:
  explicit BayesTree(GraphStore* graph) : graph_(graph) {}

  /// Marks the clique of a variable and all its ancestors for elimination in a new order.
  void MarkStructural(int variable);
  void MarkStructuralClique(int clique);
  void MarkAllStructural();
  /// Marks a clique and all its ancestors for numerical factorisation in the same order.
  void MarkDirty(int clique);
  void MarkAllDirty();

  /// Dissolves the marked cliques and eliminates their variables, and the new ones, symbolically.
  /// @param groups  Per variable slot: higher groups are eliminated later.
  /// @param epoch   Recorded in the new cliques.
  /// @return        Number of variables that got a new place.
  int Restructure(const std::vector<int>& new_variables,
                  const std::vector<int>& new_factors,
                  const std::vector<int>& groups,
                  int epoch);

  /// Factorises every dirty clique, children first.
  /// @return  -1, or the variable slot whose pivot vanished; the tree is then unusable.
  int Factorize(const Damping& damping);

  /// Cliques factorised by the last call of Factorize.
  const std::vector<int>& factorized() const { return factorized_; }
  int CountFrontal(const std::vector<int>& cliques) const;

  /// Solves the conditional of one clique for its frontal variables: `x` gets
  /// [frontal; separator], the separator from the variables' delta.
  void SolveClique(const Clique& clique, double* x) const;

  /// Columns of `L^-1 E` for the selected variables: `Sigma_ij = Y_i^T Y_j`.
  /// @return  Shape (dimension of the cliques on their paths to the root, sum of dimensions).
  Eigen::MatrixXd ForwardSolve(const std::vector<int>& variables) const;

  const std::vector<int>& roots() const { return roots_; }
  Clique& clique(int i) { return cliques_[i]; }
  const Clique& clique(int i) const { return cliques_[i]; }
  int num_slots() const { return static_cast<int>(cliques_.size()); }
  /// Multiply-adds of a factorisation of the whole tree, and doubles it keeps.
  double Flops() const;
  std::size_t StoredDoubles() const;

  void Clear();

 private:
  /// A stretch of a child's separator that is contiguous in its parent's front.
  struct Run {
    int target;
    int length;
  };

  int NewClique();
  void Reserve(std::size_t size, std::vector<double>* buffer);
  bool FactorizeClique(Clique* clique, const Damping& damping, int* failed);
  void AddFactor(const FactorRecord& factor, int stride, int rhs);
  void AddUnary(int variable, int stride, int rhs);
  void AddMarginal(const Clique& child, int stride, int rhs);

  GraphStore* graph_;
  std::vector<Clique> cliques_;
  std::vector<int> free_;
  std::vector<int> roots_;
  std::vector<int> structural_;
  std::vector<int> dirty_;
  std::vector<int> factorized_;
  // Work space, kept between calls.
  Hypergraph hypergraph_;
  std::vector<int> local_;        // Variable slot -> position in the part being eliminated.
  std::vector<int> offset_;       // Variable slot -> row in the front being assembled.
  std::vector<double> front_;
  std::vector<double> limits_;
  std::vector<Run> runs_;
  std::vector<std::vector<double>> spare_;  // Memory of the cliques dissolved last.
};

}  // namespace dendro::internal
