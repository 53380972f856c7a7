#pragma once

#include <map>
#include <string>
#include <variant>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "dendro_slam/factor_graph/errors.h"
#include "dendro_slam/factor_graph/key.h"
#include "dendro_slam/geometry/cylinder.h"

/// Values of the variables: points on manifolds, with their tangent spaces.
namespace dendro {

/// A point of R^n, 1 <= n <= 6, stored in place.
using PointN = Eigen::Matrix<double, Eigen::Dynamic, 1, 0, 6, 1>;

/// What a variable can be.
///
/// | type       | manifold                        | tangent (rotation first)      | dimension |
/// |------------|---------------------------------|-------------------------------|-----------|
/// | Isometry3d | SE(3), `T * Exp(xi)`            | [omega (rad); rho (m)]        | 6 |
/// | Cylinder   | line manifold x curvature       | [alpha; beta; gamma]          | 5 |
/// | Vector3d   | R^3                             | the displacement              | 3 |
/// | PointN     | R^n                             | the displacement              | n |
using Value = std::variant<Eigen::Isometry3d, Cylinder, Eigen::Vector3d, PointN>;

constexpr int kMaxTangentDimension = 6;

/// "pose", "cylinder", "point", "vector".
const char* TypeName(const Value& value);

/// Dimension of the tangent space.
int TangentDimension(const Value& value);

/// The value moved by a tangent vector of TangentDimension(value) entries.
Value Retract(const Value& value, const double* delta);
/// The same into a value that is there already; no allocation where both have one type.
void Retract(const Value& value, const double* delta, Value* out);

/// Tangent vector from `from` to `to`, the inverse of Retract; both of one type.
void LocalCoordinates(const Value& from, const Value& to, double* delta);

/// Jacobian of LocalCoordinates(from, to) for a perturbation of `to`.
/// @param jacobian  Out, column-major, shape (d, d).
void LocalCoordinatesJacobian(const Value& from, const Value& to, double* jacobian);

/// No NaN, no infinity; rotations orthonormal and axes of unit length to 1e-3.
bool IsValid(const Value& value);

/// A set of named values, ordered by key.
class Values {
 public:
  using Map = std::map<Key, Value>;

  /// @throws DuplicateVariableError if the key is already there.
  void Insert(Key key, const Value& value);
  /// Inserts or overwrites.
  void Set(Key key, const Value& value) { map_[key] = value; }
  bool Contains(Key key) const { return map_.count(key) != 0; }
  /// @throws UnknownVariableError if the key is missing.
  const Value& Get(Key key) const;
  /// @throws UnknownVariableError if the key is missing or holds another type.
  template <class T>
  const T& At(Key key) const {
    const T* value = std::get_if<T>(&Get(key));
    if (value == nullptr) ThrowWrongType(key);
    return *value;
  }
  bool empty() const { return map_.empty(); }
  std::size_t size() const { return map_.size(); }
  Map::const_iterator begin() const { return map_.begin(); }
  Map::const_iterator end() const { return map_.end(); }

 private:
  [[noreturn]] void ThrowWrongType(Key key) const;

  Map map_;
};

}  // namespace dendro
