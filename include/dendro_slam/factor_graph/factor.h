#pragma once

#include <memory>
#include <vector>

#include "dendro_slam/factor_graph/key.h"
#include "dendro_slam/factor_graph/noise_model.h"
#include "dendro_slam/factor_graph/values.h"

namespace dendro {

/// The variables of a factor, in the order of its Jacobian's columns.
struct KeySpan {
  const Key* data = nullptr;
  int count = 0;

  const Key* begin() const { return data; }
  const Key* end() const { return data + count; }
  Key operator[](int i) const { return data[i]; }
  int size() const { return count; }
};

/// One term `rho(|W r(x)|^2) / 2` of the objective. Immutable, so that graphs can share it.
///
/// Values come as an array of pointers in the order of keys(), resolved once by the solver: no
/// look-up and no allocation per evaluation.
class Factor {
 public:
  virtual ~Factor() = default;

  virtual KeySpan keys() const = 0;
  /// Rows of the residual.
  virtual int dimension() const = 0;
  /// The error (objective term) at the values; never negative, infinite if it cannot be evaluated.
  virtual double Error(const Value* const* values) const = 0;
  /// Whitened, weighted residual and Jacobian, so that near the values the error is about
  /// `|jacobian d + residual|^2 / 2` for a tangent displacement d.
  /// @param jacobian  Out, column-major, shape (dimension(), sum of the tangent dimensions).
  /// @param residual  Out, shape (dimension()).
  /// @return          Error(values).
  virtual double Linearize(const Value* const* values, double* jacobian, double* residual) const = 0;

  /// "between x3 x4": the kind and the variables, for messages.
  virtual std::string Describe() const;

  /// @throws UnknownVariableError unless every value has the type that the factor needs.
  virtual void CheckTypes(const Value* const* values) const = 0;

  /// Error with a look-up by key, for tests and tables.
  double Error(const Values& values) const;
  /// Linearize with a look-up by key and its own memory, for tests.
  double Linearize(const Values& values,
                   Eigen::MatrixXd* jacobian,
                   Eigen::VectorXd* residual) const;

 protected:
  /// What kind of factor this is, one word.
  virtual const char* Kind() const = 0;
};

using FactorPtr = std::shared_ptr<const Factor>;
using FactorList = std::vector<FactorPtr>;

/// Base of the factors with a fixed residual of up to 6 rows on N typed variables: whitening, the
/// kernel and the type checks. Derived classes compute the plain residual and its Jacobians.
template <class... Types>
class TypedFactor : public Factor {
 public:
  static constexpr int kNumKeys = sizeof...(Types);

  KeySpan keys() const final { return {keys_, kNumKeys}; }
  int dimension() const final { return noise_.dimension(); }
  const NoiseModel& noise() const { return noise_; }

  double Error(const Value* const* values) const final {
    double residual[NoiseModel::kMaxDimension];
    Evaluate(values, residual, nullptr);
    return noise_.Error(residual);
  }
  double Linearize(const Value* const* values, double* jacobian, double* residual) const final {
    Evaluate(values, residual, jacobian);
    int columns = 0;
    for (int i = 0; i < kNumKeys; ++i) columns += TangentDimension(*values[i]);
    return noise_.Whiten(residual, jacobian, columns);
  }
  using Factor::Error;
  using Factor::Linearize;

  void CheckTypes(const Value* const* values) const final {
    int i = 0;
    (CheckType<Types>(keys_[i], *values[i], i), ...);
  }

  /// Plain residual and Jacobian, before the noise model.
  /// @param residual  Out, shape (dimension()).
  /// @param jacobian  Out, column-major, shape (dimension(), sum of the tangent dimensions), or null.
  virtual void Evaluate(const Value* const* values, double* residual, double* jacobian) const = 0;

 protected:
  template <class... Keys>
  explicit TypedFactor(const NoiseModel& noise, Keys... keys) : keys_{keys...}, noise_(noise) {
    static_assert(sizeof...(Keys) == kNumKeys, "one key per variable");
  }

 private:
  template <class T>
  void CheckType(Key key, const Value& value, int& i) const {
    ++i;
    if (!std::holds_alternative<T>(value)) ThrowWrongType(*this, key, value);
  }
  static void ThrowWrongType(const Factor& factor, Key key, const Value& value) {
    throw UnknownVariableError(key,
                               factor.Describe() + ": variable " + KeyName(key) + " is a " +
                                   TypeName(value) + ", which this factor cannot use; insert a value "
                                   "of the right type or correct the key");
  }

  Key keys_[kNumKeys];
  NoiseModel noise_;
};

}  // namespace dendro
