#pragma once

#include <stdexcept>
#include <string>

#include "dendro_slam/factor_graph/key.h"

/// What can be wrong with a factor graph. Every message names the variable and the remedy; a solver
/// that throws keeps the graph it had before the call.
namespace dendro {

class GraphError : public std::runtime_error {
 public:
  GraphError(Key key, const std::string& message) : std::runtime_error(message), key_(key) {}
  /// The variable that the message names.
  Key key() const { return key_; }

 private:
  Key key_;
};

/// The factors leave a direction of this variable free: no factor at all, a part of the graph
/// without a prior, or a factor that does not see the direction.
class UnderconstrainedError : public GraphError {
 public:
  using GraphError::GraphError;
};

/// A factor or a query names a variable that is neither in the graph nor among the new values, or
/// holds another type than asked for.
class UnknownVariableError : public GraphError {
 public:
  using GraphError::GraphError;
};

/// A new value for a variable that the graph already has.
class DuplicateVariableError : public GraphError {
 public:
  using GraphError::GraphError;
};

/// A value, a measurement or a residual is NaN or infinite.
class NonFiniteError : public GraphError {
 public:
  using GraphError::GraphError;
};

/// A factor id that the graph does not hold (never given, or already removed).
class UnknownFactorError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

}  // namespace dendro
