#pragma once

#include <Eigen/Core>

/// Gaussian noise of a factor's residual, with an optional robust kernel.
namespace dendro {

enum class RobustKernelType { kNone, kHuber, kCauchy, kDcs };

/// A loss rho of the squared whitened residual `s`: the factor's error is `rho(s) / 2`, and its
/// linearisation is weighted with `rho'(s)`.
struct RobustKernel {
  RobustKernelType type = RobustKernelType::kNone;
  double parameter = 1.0;

  /// Quadratic up to `k` sigma, linear beyond.
  static RobustKernel Huber(double k = 1.345);
  /// `k^2 log(1 + s / k^2)`.
  static RobustKernel Cauchy(double k = 2.3849);
  /// Dynamic covariance scaling (Agarwal et al., ICRA 2013): quadratic up to `s = phi`, then
  /// saturating at `3 phi`; for measurements that may be false altogether, as loop closures are.
  static RobustKernel Dcs(double phi = 1.0);

  double Loss(double s) const;    ///< rho(s).
  double Weight(double s) const;  ///< rho'(s), in (0, 1].
};

/// Square-root information of a residual of up to 6 rows, stored in place.
///
/// The factories reject what is not finite, not positive (definite) or not symmetric with
/// std::invalid_argument.
class NoiseModel {
 public:
  static constexpr int kMaxDimension = 6;
  using Matrix =
      Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::ColMajor, kMaxDimension, kMaxDimension>;

  /// Standard deviation 1 in every row.
  static NoiseModel Unit(int dimension);
  static NoiseModel Isotropic(int dimension, double sigma);
  /// Independent rows, shape (n).
  static NoiseModel Sigmas(const Eigen::Ref<const Eigen::VectorXd>& sigmas);
  /// Full covariance, shape (n, n).
  static NoiseModel Covariance(const Eigen::Ref<const Eigen::MatrixXd>& covariance);
  /// Full information (inverse covariance), shape (n, n).
  static NoiseModel Information(const Eigen::Ref<const Eigen::MatrixXd>& information);
  /// Any square root W with information `W^T W`; W may be singular (a row of zeros switches that
  /// row of the residual off).
  static NoiseModel SqrtInformation(const Eigen::Ref<const Eigen::MatrixXd>& sqrt_information);

  /// The same noise with a robust kernel.
  NoiseModel WithKernel(const RobustKernel& kernel) const;

  int dimension() const { return static_cast<int>(sqrt_information_.rows()); }
  bool is_diagonal() const { return diagonal_; }
  /// W with information `W^T W`; the whitened residual is `W r`.
  const Matrix& sqrt_information() const { return sqrt_information_; }
  const RobustKernel& kernel() const { return kernel_; }

  /// Squared whitened norm `|W r|^2` (no kernel).
  double SquaredMahalanobis(const double* residual) const;
  /// Half the loss of the residual, `rho(|W r|^2) / 2`.
  double Error(const double* residual) const;
  /// Whitens in place and applies the kernel's weight.
  /// @param residual  Shape (n).
  /// @param jacobian  Column-major, shape (n, columns); may be null.
  /// @return          Error(residual) of the unwhitened residual.
  double Whiten(double* residual, double* jacobian, int columns) const;

 private:
  Matrix sqrt_information_;
  bool diagonal_ = true;
  RobustKernel kernel_;
};

}  // namespace dendro
