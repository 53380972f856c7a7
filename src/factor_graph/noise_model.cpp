#include "dendro_slam/factor_graph/noise_model.h"

#include <cmath>
#include <stdexcept>
#include <string>

#include <Eigen/Cholesky>

namespace dendro {

namespace {

void CheckDimension(Eigen::Index n) {
  if (n < 1 || n > NoiseModel::kMaxDimension) {
    throw std::invalid_argument("noise model: the dimension must be 1 to " +
                                std::to_string(NoiseModel::kMaxDimension) + ", got " +
                                std::to_string(n));
  }
}

// Lower Cholesky factor of a symmetric positive definite matrix.
NoiseModel::Matrix CholeskyLower(const Eigen::Ref<const Eigen::MatrixXd>& m, const char* name) {
  CheckDimension(m.rows());
  const std::string what = std::string("noise model: the ") + name;
  if (m.rows() != m.cols()) throw std::invalid_argument(what + " must be square");
  if (!m.allFinite()) throw std::invalid_argument(what + " holds NaN or infinity");
  const double asymmetry = (m - m.transpose()).cwiseAbs().maxCoeff();
  if (asymmetry > 1e-9 * m.cwiseAbs().maxCoeff()) {
    throw std::invalid_argument(what + " is not symmetric");
  }
  const Eigen::LLT<NoiseModel::Matrix> llt{NoiseModel::Matrix(m)};
  if (llt.info() != Eigen::Success) {
    throw std::invalid_argument(what + " is not positive definite");
  }
  return llt.matrixL();
}

void CheckKernelParameter(double parameter, const char* name) {
  if (!(std::isfinite(parameter) && parameter > 0.0)) {
    throw std::invalid_argument(std::string("robust kernel: ") + name + " must be positive");
  }
}

template <int N>
void WhitenColumns(const NoiseModel::Matrix& sqrt_information, double scale, double* m, int columns) {
  using Square = Eigen::Matrix<double, N, N>;
  using Column = Eigen::Matrix<double, N, 1>;
  const Eigen::Map<const Square> W(sqrt_information.data());
  if (scale != 1.0) Eigen::Map<Eigen::Matrix<double, N, Eigen::Dynamic>>(m, N, columns) *= scale;
  for (int c = 0; c < columns; ++c) {
    Eigen::Map<Column> column(m + c * N);
    const Column whitened = W * column;
    column = whitened;
  }
}

template <int N>
double WhitenedNorm(const NoiseModel::Matrix& sqrt_information, const double* residual) {
  const Eigen::Map<const Eigen::Matrix<double, N, N>> W(sqrt_information.data());
  const Eigen::Map<const Eigen::Matrix<double, N, 1>> r(residual);
  return (W * r).squaredNorm();
}

void WhitenAny(const NoiseModel::Matrix& W, bool diagonal, double scale, double* m, int columns) {
  const int n = static_cast<int>(W.rows());
  if (diagonal) {
    for (int c = 0; c < columns; ++c) {
      for (int r = 0; r < n; ++r) m[c * n + r] *= scale * W(r, r);
    }
    return;
  }
  switch (n) {
    case 1:
      return WhitenColumns<1>(W, scale, m, columns);
    case 2:
      return WhitenColumns<2>(W, scale, m, columns);
    case 3:
      return WhitenColumns<3>(W, scale, m, columns);
    case 4:
      return WhitenColumns<4>(W, scale, m, columns);
    case 5:
      return WhitenColumns<5>(W, scale, m, columns);
    default:
      return WhitenColumns<6>(W, scale, m, columns);
  }
}

}  // namespace

RobustKernel RobustKernel::Huber(double k) {
  CheckKernelParameter(k, "k");
  return {RobustKernelType::kHuber, k};
}

RobustKernel RobustKernel::Cauchy(double k) {
  CheckKernelParameter(k, "k");
  return {RobustKernelType::kCauchy, k};
}

RobustKernel RobustKernel::Dcs(double phi) {
  CheckKernelParameter(phi, "phi");
  return {RobustKernelType::kDcs, phi};
}

double RobustKernel::Loss(double s) const {
  const double p = parameter;
  switch (type) {
    case RobustKernelType::kNone:
      return s;
    case RobustKernelType::kHuber:
      return s <= p * p ? s : 2.0 * p * std::sqrt(s) - p * p;
    case RobustKernelType::kCauchy:
      return p * p * std::log1p(s / (p * p));
    case RobustKernelType::kDcs:
      return s <= p ? s : 3.0 * p - 4.0 * p * p / (p + s);
  }
  return s;
}

double RobustKernel::Weight(double s) const {
  const double p = parameter;
  switch (type) {
    case RobustKernelType::kNone:
      return 1.0;
    case RobustKernelType::kHuber:
      return s <= p * p ? 1.0 : p / std::sqrt(s);
    case RobustKernelType::kCauchy:
      return 1.0 / (1.0 + s / (p * p));
    case RobustKernelType::kDcs: {
      const double scale = s <= p ? 1.0 : 2.0 * p / (p + s);
      return scale * scale;
    }
  }
  return 1.0;
}

NoiseModel NoiseModel::Unit(int dimension) { return Isotropic(dimension, 1.0); }

NoiseModel NoiseModel::Isotropic(int dimension, double sigma) {
  CheckDimension(dimension);
  return Sigmas(Eigen::VectorXd::Constant(dimension, sigma));
}

NoiseModel NoiseModel::Sigmas(const Eigen::Ref<const Eigen::VectorXd>& sigmas) {
  CheckDimension(sigmas.size());
  if (!sigmas.allFinite() || sigmas.minCoeff() <= 0.0) {
    throw std::invalid_argument("noise model: every sigma must be finite and positive");
  }
  NoiseModel out;
  out.sqrt_information_ = Matrix(sigmas.cwiseInverse().asDiagonal());
  return out;
}

NoiseModel NoiseModel::Covariance(const Eigen::Ref<const Eigen::MatrixXd>& covariance) {
  const Matrix L = CholeskyLower(covariance, "covariance");
  const Matrix identity = Matrix::Identity(L.rows(), L.cols());
  return SqrtInformation(Eigen::MatrixXd(L.triangularView<Eigen::Lower>().solve(identity)));
}

NoiseModel NoiseModel::Information(const Eigen::Ref<const Eigen::MatrixXd>& information) {
  const Matrix L = CholeskyLower(information, "information");
  return SqrtInformation(Eigen::MatrixXd(L.transpose()));
}

NoiseModel NoiseModel::SqrtInformation(const Eigen::Ref<const Eigen::MatrixXd>& sqrt_information) {
  CheckDimension(sqrt_information.rows());
  if (sqrt_information.rows() != sqrt_information.cols() || !sqrt_information.allFinite()) {
    throw std::invalid_argument("noise model: the square-root information must be square and finite");
  }
  NoiseModel out;
  out.sqrt_information_ = Matrix(sqrt_information);
  out.diagonal_ = out.sqrt_information_.isDiagonal(0.0);
  return out;
}

NoiseModel NoiseModel::WithKernel(const RobustKernel& kernel) const {
  if (kernel.type != RobustKernelType::kNone) CheckKernelParameter(kernel.parameter, "parameter");
  NoiseModel out = *this;
  out.kernel_ = kernel;
  return out;
}

double NoiseModel::SquaredMahalanobis(const double* residual) const {
  const int n = dimension();
  double sum = 0.0;
  if (diagonal_) {
    for (int r = 0; r < n; ++r) {
      const double w = sqrt_information_(r, r) * residual[r];
      sum += w * w;
    }
    return sum;
  }
  switch (n) {
    case 5:
      return WhitenedNorm<5>(sqrt_information_, residual);
    case 6:
      return WhitenedNorm<6>(sqrt_information_, residual);
    default:
      break;
  }
  double whitened[kMaxDimension];
  for (int r = 0; r < n; ++r) whitened[r] = residual[r];
  WhitenAny(sqrt_information_, false, 1.0, whitened, 1);
  for (int r = 0; r < n; ++r) sum += whitened[r] * whitened[r];
  return sum;
}

double NoiseModel::Error(const double* residual) const {
  return 0.5 * kernel_.Loss(SquaredMahalanobis(residual));
}

double NoiseModel::Whiten(double* residual, double* jacobian, int columns) const {
  const int n = dimension();
  WhitenAny(sqrt_information_, diagonal_, 1.0, residual, 1);
  double s = 0.0;
  for (int r = 0; r < n; ++r) s += residual[r] * residual[r];
  double scale = 1.0;
  if (kernel_.type != RobustKernelType::kNone) {
    scale = std::sqrt(kernel_.Weight(s));
    for (int r = 0; r < n; ++r) residual[r] *= scale;
  }
  if (jacobian != nullptr) WhitenAny(sqrt_information_, diagonal_, scale, jacobian, columns);
  return 0.5 * kernel_.Loss(s);
}

}  // namespace dendro
