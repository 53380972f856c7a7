#include <cmath>
#include <limits>
#include <random>
#include <sstream>
#include <stdexcept>

#include <gmock/gmock.h>

#include "dendro_slam/factor_graph/between_factor.h"
#include "dendro_slam/factor_graph/cylinder_factor.h"
#include "dendro_slam/factor_graph/g2o.h"
#include "dendro_slam/factor_graph/incremental_solver.h"
#include "dendro_slam/factor_graph/junction_point_factor.h"
#include "dendro_slam/factor_graph/linear_factor.h"
#include "dendro_slam/factor_graph/prior_factor.h"
#include "graph_test_util.h"

namespace dendro {
namespace {

using namespace test;

Key X(std::uint64_t i) { return MakeKey('x', i); }
Key L(std::uint64_t i) { return MakeKey('l', i); }
Key P(std::uint64_t i) { return MakeKey('p', i); }

// A walk among cylinders and one point, as the mapping builds it: per step the new factors and
// values.
struct Walk {
  std::vector<FactorList> factors;
  std::vector<Values> values;
};

Walk MakeWalk(int poses, int landmarks, unsigned seed) {
  std::mt19937 rng(seed);
  Walk walk;
  std::vector<Cylinder> trees;
  for (int i = 0; i < landmarks; ++i) trees.push_back(RandomCylinder(rng));
  const Eigen::Vector3d junction(0.5, 1.0, 2.0);
  Vector6d odometry_sigma;
  odometry_sigma << 0.01, 0.01, 0.01, 0.03, 0.03, 0.03;
  Vector5d cylinder_sigma;
  cylinder_sigma << 0.02, 0.02, 0.02, 0.02, 0.2;
  const Matrix5d cylinder_covariance = cylinder_sigma.cwiseAbs2().asDiagonal();
  Eigen::Isometry3d truth = Eigen::Isometry3d::Identity();
  Eigen::Isometry3d guess = truth;
  std::vector<bool> seen(landmarks, false);
  for (int i = 0; i < poses; ++i) {
    FactorList factors;
    Values values;
    if (i == 0) {
      factors.push_back(std::make_shared<PosePrior>(X(0), truth, NoiseModel::Isotropic(6, 1e-3)));
    } else {
      Vector6d motion;
      motion << 0, 0, 0.3, 0.8, 0, 0.1;
      const Eigen::Isometry3d step = ExpSe3(motion);
      truth = truth * step;
      const Eigen::Isometry3d measured =
          step * ExpSe3(odometry_sigma.cwiseProduct(RandomVector<6>(rng)));
      guess = guess * measured;
      factors.push_back(std::make_shared<BetweenFactor>(X(i - 1), X(i), measured,
                                                        NoiseModel::Sigmas(odometry_sigma)));
    }
    values.Insert(X(i), guess);
    for (int l = 0; l < landmarks; ++l) {
      if ((i + l) % 3 == 0) continue;
      const Cylinder measured = TransformCylinder(truth.inverse(), trees[l])
                                    .Retract(cylinder_sigma.cwiseProduct(RandomVector<5>(rng)));
      factors.push_back(
          std::make_shared<CylinderFactor>(X(i), L(l), measured, cylinder_covariance));
      if (!seen[l]) values.Insert(L(l), TransformCylinder(guess, measured));
      seen[l] = true;
    }
    if (i % 2 == 0) {
      const Eigen::Vector3d seen_point = truth.inverse() * junction + RandomVector<3>(rng, 0.02);
      factors.push_back(std::make_shared<JunctionPointFactor>(X(i), P(0), seen_point,
                                                              NoiseModel::Isotropic(3, 0.02)));
      if (i == 0) values.Insert(P(0), Eigen::Vector3d(guess * seen_point));
    }
    walk.factors.push_back(factors);
    walk.values.push_back(values);
  }
  return walk;
}

// The dense Hessian at the estimates, variables in the order of the keys.
Eigen::MatrixXd DenseHessian(const std::vector<FactorPtr>& factors, const Values& values) {
  std::map<Key, int> offset;
  int size = 0;
  for (const auto& [key, value] : values) {
    offset[key] = size;
    size += TangentDimension(value);
  }
  Eigen::MatrixXd H = Eigen::MatrixXd::Zero(size, size);
  for (const FactorPtr& factor : factors) {
    Eigen::MatrixXd J;
    Eigen::VectorXd r;
    factor->Linearize(values, &J, &r);
    Eigen::MatrixXd wide = Eigen::MatrixXd::Zero(J.rows(), size);
    int column = 0;
    for (const Key key : factor->keys()) {
      const int d = TangentDimension(values.Get(key));
      wide.middleCols(offset.at(key), d) = J.middleCols(column, d);
      column += d;
    }
    H += wide.transpose() * wide;
  }
  return H;
}

TEST(Solver, LineOfPointsByHand) {
  // x0 = 0 (sigma 1), x1 - x0 = 2 (sigma 1) by way of a linear factor, x1 = 1 (sigma 1):
  // the optimum is x0 = -1/3, x1 = 4/3, and 1/2 chi2 = 1/6.
  PointN zero(1), one(1);
  zero << 0.0;
  one << 1.0;
  Eigen::MatrixXd A(1, 2);
  A << -1.0, 1.0;
  const FactorList factors = {
      std::make_shared<VectorPrior>(P(0), zero, NoiseModel::Unit(1)),
      std::make_shared<VectorPrior>(P(1), one, NoiseModel::Unit(1)),
      LinearFactor::FromSquareRoot({P(0), P(1)}, {zero, zero}, A, Eigen::VectorXd::Constant(1, -2.0))};
  Values values;
  values.Insert(P(0), zero);
  values.Insert(P(1), zero);
  IncrementalSolver solver;
  const UpdateResult result = solver.Update(factors, values);
  EXPECT_NEAR(result.error_before, 2.5, 1e-12);
  EXPECT_NEAR(result.error_after, 1.0 / 6.0, 1e-12);
  EXPECT_NEAR(solver.Estimate<PointN>(P(0))[0], -1.0 / 3.0, 1e-12);
  EXPECT_NEAR(solver.Estimate<PointN>(P(1))[0], 4.0 / 3.0, 1e-12);
  // Information [2 -1; -1 2], covariance [2 1; 1 2] / 3.
  const Eigen::MatrixXd covariance = solver.JointMarginalCovariance({P(1), P(0)});
  EXPECT_NEAR(covariance(0, 0), 2.0 / 3.0, 1e-12);
  EXPECT_NEAR(covariance(0, 1), 1.0 / 3.0, 1e-12);
}

TEST(Solver, IncrementalEqualsBatchAndNeverRaisesTheError) {
  const Walk walk = MakeWalk(60, 7, 1);
  IncrementalSolver incremental;
  FactorList all;
  Values initial;
  for (std::size_t i = 0; i < walk.factors.size(); ++i) {
    const UpdateResult result = incremental.Update(walk.factors[i], walk.values[i]);
    EXPECT_LE(result.error_after, result.error_before * (1 + 1e-12));
    EXPECT_NEAR(result.error_after, incremental.Error(), 1e-9);
    EXPECT_EQ(result.new_factor_ids.size(), walk.factors[i].size());
    all.insert(all.end(), walk.factors[i].begin(), walk.factors[i].end());
    for (const auto& [key, value] : walk.values[i]) initial.Insert(key, value);
    if (i % 20 == 19) {
      IncrementalSolver batch;
      const double optimum = batch.OptimizeBatch(all, initial).error_after;
      // Close at every step, equal after convergence.
      EXPECT_LT(incremental.Error(), optimum * 1.01);
      UpdateOptions converge;
      converge.converge = true;
      EXPECT_NEAR(incremental.Update({}, {}, converge).error_after, optimum, 1e-6 * optimum);
    }
  }
  double sum = 0.0;
  const Values estimates = incremental.Estimates();
  for (const FactorPtr& factor : all) sum += factor->Error(estimates);
  EXPECT_NEAR(sum, incremental.Error(), 1e-9 * sum);
}

TEST(Solver, MarginalsMatchTheInverseHessian) {
  const Walk walk = MakeWalk(12, 4, 2);
  IncrementalSolver solver;
  FactorList all;
  for (std::size_t i = 0; i < walk.factors.size(); ++i) {
    solver.Update(walk.factors[i], walk.values[i]);
    all.insert(all.end(), walk.factors[i].begin(), walk.factors[i].end());
  }
  solver.Optimize();
  const Values estimates = solver.Estimates();
  const Eigen::MatrixXd covariance = DenseHessian(all, estimates).inverse();
  std::vector<Key> keys;
  std::vector<int> index;
  int offset = 0;
  for (const auto& [key, value] : estimates) {
    const int d = TangentDimension(value);
    const Eigen::MatrixXd marginal = solver.MarginalCovariance(key);
    const Eigen::MatrixXd expected = covariance.block(offset, offset, d, d);
    EXPECT_LT((marginal - expected).norm(), 1e-5 * expected.norm()) << KeyName(key);
    for (int i = 0; i < d; ++i) index.push_back(offset + i);
    keys.push_back(key);
    offset += d;
  }
  const Eigen::MatrixXd joint = solver.JointMarginalCovariance(keys);
  EXPECT_LT((joint - covariance).norm(), 1e-5 * covariance.norm());
}

TEST(Solver, PairMarginalsAreThoseOfTheJoint) {
  const Walk walk = MakeWalk(12, 4, 2);
  IncrementalSolver solver;
  for (std::size_t i = 0; i < walk.factors.size(); ++i) solver.Update(walk.factors[i], walk.values[i]);
  const std::vector<Key> others = {L(0), L(2), X(3)};
  const std::vector<Eigen::MatrixXd> pairs = solver.PairMarginalCovariances(X(11), others);
  ASSERT_EQ(pairs.size(), others.size());
  for (std::size_t i = 0; i < others.size(); ++i) {
    const Eigen::MatrixXd joint = solver.JointMarginalCovariance({X(11), others[i]});
    EXPECT_LT((pairs[i] - joint).norm(), 1e-10 * joint.norm());
  }
}

// `r = atan(p)` in each coordinate: Newton's step from 2 overshoots, so that it is refused and damped.
class ArcTangentFactor final : public TypedFactor<Eigen::Vector3d> {
 public:
  explicit ArcTangentFactor(Key key) : TypedFactor(NoiseModel::Isotropic(3, 0.1), key) {}
  void Evaluate(const Value* const* values, double* residual, double* jacobian) const override {
    const auto& p = std::get<Eigen::Vector3d>(*values[0]);
    for (int i = 0; i < 3; ++i) residual[i] = std::atan(p[i]);
    if (jacobian == nullptr) return;
    Eigen::Map<Eigen::Matrix3d> J(jacobian);
    J.setZero();
    for (int i = 0; i < 3; ++i) J(i, i) = 1.0 / (1.0 + p[i] * p[i]);
  }

 private:
  const char* Kind() const override { return "arctangent"; }
};

TEST(Solver, MarginalsAfterARefusedStepAreWithoutItsDamping) {
  // Linearised where they start: the refused step does not move them.
  Values values;
  values.Insert(P(0), Value(Eigen::Vector3d(2.0, 2.2, 2.4)));
  values.Insert(P(1), Value(Eigen::Vector3d(2.1, 2.0, 1.9)));
  FactorList factors = {std::make_shared<ArcTangentFactor>(P(0)), std::make_shared<ArcTangentFactor>(P(1))};
  SolverConfig config;
  config.lambda_initial = 1.0;
  config.max_iterations = 20;
  IncrementalSolver solver(config);
  const UpdateResult result = solver.Update(factors, values);
  ASSERT_GT(result.steps_refused, 0);
  ASSERT_GT(result.damping, 0.0);
  ASSERT_LT(result.error_after, result.error_before);
  const Eigen::MatrixXd covariance = DenseHessian(factors, values).inverse();
  EXPECT_LT((solver.MarginalCovariance(P(0)) - covariance.topLeftCorner<3, 3>()).norm(),
            1e-9 * covariance.norm());
  EXPECT_LT((solver.JointMarginalCovariance({P(0), P(1)}) - covariance).norm(), 1e-9 * covariance.norm());
  // And the run goes on to the optimum as if nobody had asked.
  solver.Update({}, {});
  EXPECT_LT(solver.Update({}, {}).error_after, result.error_after);
}

TEST(Solver, MarginalizingWithAnUpdateIsMarginalizingBeforeIt) {
  const Walk walk = MakeWalk(20, 4, 6);
  IncrementalSolver before, with;
  for (std::size_t i = 0; i + 1 < walk.factors.size(); ++i) {
    before.Update(walk.factors[i], walk.values[i]);
    with.Update(walk.factors[i], walk.values[i]);
  }
  before.Optimize();
  with.Optimize();
  const std::vector<Key> old = {X(3), X(4), X(5)};
  before.Marginalize(old);
  before.Update(walk.factors.back(), walk.values.back());
  UpdateOptions options;
  options.marginalize = old;
  with.Update(walk.factors.back(), walk.values.back(), options);
  EXPECT_FALSE(with.Contains(X(4)));
  EXPECT_EQ(with.num_variables(), before.num_variables());
  EXPECT_EQ(with.num_factors(), before.num_factors());
  EXPECT_NEAR(with.Optimize().error_after, before.Optimize().error_after, 1e-9);
  const Eigen::MatrixXd expected = before.JointMarginalCovariance({X(19), L(0)});
  EXPECT_LT((with.JointMarginalCovariance({X(19), L(0)}) - expected).norm(), 1e-6 * expected.norm());
  // A new factor on what goes is refused, and nothing has changed.
  options.marginalize = {X(19)};
  const int factors = with.num_factors();
  EXPECT_THROW(with.Update({walk.factors.back().front()}, {}, options), UnknownVariableError);
  EXPECT_EQ(with.num_factors(), factors);
}

TEST(Solver, RemovedFactorsLeaveNoTrace) {
  const Walk walk = MakeWalk(15, 4, 3);
  IncrementalSolver solver;
  for (std::size_t i = 0; i < walk.factors.size(); ++i) solver.Update(walk.factors[i], walk.values[i]);
  const double before = solver.Optimize().error_after;
  // A false measurement bends the map; taking it out mends it.
  Eigen::Isometry3d wrong = Eigen::Isometry3d::Identity();
  wrong.translation() << 3, 3, 3;
  const UpdateResult added = solver.Update(
      {std::make_shared<BetweenFactor>(X(2), X(12), wrong, NoiseModel::Isotropic(6, 0.01))}, {});
  EXPECT_GT(solver.Error(), before + 10.0);
  ASSERT_EQ(added.new_factor_ids.size(), 1u);
  EXPECT_TRUE(solver.ContainsFactor(added.new_factor_ids[0]));
  solver.RemoveFactors(added.new_factor_ids);
  EXPECT_FALSE(solver.ContainsFactor(added.new_factor_ids[0]));
  EXPECT_THROW(solver.RemoveFactors(added.new_factor_ids), UnknownFactorError);
  EXPECT_NEAR(solver.Optimize().error_after, before, 1e-6 * before);
  // A variable goes with its last factor.
  solver.RemoveFactors(solver.FactorsOf(P(0)));
  EXPECT_FALSE(solver.Contains(P(0)));
  EXPECT_EQ(solver.num_variables(), 15 + 4);
}

TEST(Solver, MarginalizationKeepsTheRest) {
  const Walk walk = MakeWalk(20, 4, 4);
  IncrementalSolver solver;
  for (std::size_t i = 0; i < walk.factors.size(); ++i) solver.Update(walk.factors[i], walk.values[i]);
  solver.Optimize();
  const Values before = solver.Estimates();
  const Eigen::MatrixXd covariance = solver.JointMarginalCovariance({X(19), L(0), L(3)});
  std::vector<Key> old;
  for (int i = 0; i < 15; ++i) old.push_back(X(i));
  EXPECT_NE(solver.Marginalize(old), 0u);
  EXPECT_EQ(solver.num_variables(), 5 + 4 + 1);
  solver.Optimize();
  for (const auto& [key, value] : solver.Estimates()) {
    double delta[6];
    LocalCoordinates(before.Get(key), value, delta);
    for (int i = 0; i < TangentDimension(value); ++i) EXPECT_NEAR(delta[i], 0.0, 1e-5) << KeyName(key);
  }
  const Eigen::MatrixXd after = solver.JointMarginalCovariance({X(19), L(0), L(3)});
  EXPECT_LT((after - covariance).norm(), 1e-4 * covariance.norm());
}

TEST(Solver, RobustKernelsShrugOffAFalseLoop) {
  for (const RobustKernel& kernel : {RobustKernel::Cauchy(), RobustKernel::Dcs(1.0)}) {
    const Walk walk = MakeWalk(15, 4, 5);
    IncrementalSolver solver;
    for (std::size_t i = 0; i < walk.factors.size(); ++i) solver.Update(walk.factors[i], walk.values[i]);
    solver.Optimize();
    const Eigen::Vector3d before = solver.Estimate<Eigen::Isometry3d>(X(14)).translation();
    Eigen::Isometry3d wrong = Eigen::Isometry3d::Identity();
    wrong.translation() << 5, 0, 0;
    solver.Update({std::make_shared<BetweenFactor>(X(0), X(14), wrong,
                                                   NoiseModel::Isotropic(6, 0.05).WithKernel(kernel))},
                  {});
    solver.Optimize();
    EXPECT_LT((solver.Estimate<Eigen::Isometry3d>(X(14)).translation() - before).norm(), 0.05);
  }
}

// Runs the call, expects the error to name the key and to leave the graph as it was.
template <class ErrorType, class Call>
void ExpectRefused(IncrementalSolver* solver, Key key, const std::string& word, Call call) {
  const double error = solver->Error();
  const int variables = solver->num_variables();
  const int factors = solver->num_factors();
  try {
    call();
    FAIL() << "no error for " << KeyName(key);
  } catch (const ErrorType& e) {
    EXPECT_EQ(e.key(), key) << e.what();
    EXPECT_THAT(e.what(), testing::HasSubstr(KeyName(key)));
    EXPECT_THAT(e.what(), testing::HasSubstr(word));
  }
  EXPECT_EQ(solver->num_variables(), variables);
  EXPECT_EQ(solver->num_factors(), factors);
  EXPECT_NEAR(solver->Error(), error, 1e-12 * error);
}

TEST(Solver, FaultyGraphsAreNamedAndRefused) {
  const Walk walk = MakeWalk(10, 4, 6);
  IncrementalSolver solver;
  for (std::size_t i = 0; i < walk.factors.size(); ++i) solver.Update(walk.factors[i], walk.values[i]);
  const Eigen::Isometry3d I = Eigen::Isometry3d::Identity();
  const auto between = [&](Key a, Key b) {
    return std::make_shared<BetweenFactor>(a, b, I, NoiseModel::Unit(6));
  };
  Values one;
  one.Insert(X(50), I);
  ExpectRefused<UnknownVariableError>(&solver, X(99), "initial value", [&] {
    solver.Update({between(X(0), X(99))}, {});
  });
  ExpectRefused<UnderconstrainedError>(&solver, X(50), "no factor", [&] { solver.Update({}, one); });
  Values two = one;
  two.Insert(X(51), I);
  try {
    solver.Update({between(X(50), X(51))}, two);
    FAIL();
  } catch (const UnderconstrainedError& e) {
    EXPECT_THAT(e.what(), testing::HasSubstr("add a prior"));
    EXPECT_THAT(e.what(), testing::AnyOf(testing::HasSubstr("x50"), testing::HasSubstr("x51")));
  }
  // A cylinder known only by its curvature.
  Values landmark;
  landmark.Insert(L(50), Cylinder{});
  ExpectRefused<UnderconstrainedError>(&solver, L(50), "under-constrained", [&] {
    solver.Update({std::make_shared<CurvatureFactor>(L(50), 3.0, 0.1)}, landmark);
  });
  Eigen::Isometry3d nan = I;
  nan.translation().y() = std::numeric_limits<double>::quiet_NaN();
  Values bad;
  bad.Insert(X(50), nan);
  ExpectRefused<NonFiniteError>(&solver, X(50), "NaN", [&] {
    solver.Update({between(X(0), X(50))}, bad);
  });
  // Fits, but so far away that its derivative overflows.
  Eigen::Isometry3d far = solver.Estimate<Eigen::Isometry3d>(X(9));
  far.translation().setConstant(1e200);
  const Eigen::Isometry3d motion = solver.Estimate<Eigen::Isometry3d>(X(9)).inverse() * far;
  Values away;
  away.Insert(X(50), far);
  ExpectRefused<NonFiniteError>(&solver, X(50), "check the measurement", [&] {
    solver.Update({std::make_shared<BetweenFactor>(X(50), X(9), motion.inverse(), NoiseModel::Unit(6))}, away);
  });
  Values again;
  again.Insert(X(3), I);
  ExpectRefused<DuplicateVariableError>(&solver, X(3), "already", [&] { solver.Update({}, again); });
  Values typed;
  typed.Insert(L(51), Eigen::Vector3d(1, 2, 3));
  ExpectRefused<UnknownVariableError>(&solver, L(51), "point", [&] {
    solver.Update({std::make_shared<CurvatureFactor>(L(51), 3.0, 0.1)}, typed);
  });
  EXPECT_THROW(solver.Estimate<Cylinder>(X(0)), UnknownVariableError);
  EXPECT_THROW(solver.MarginalCovariance(X(99)), UnknownVariableError);
  // And it goes on.
  const Walk longer = MakeWalk(12, 4, 6);
  for (int i = 10; i < 12; ++i) solver.Update(longer.factors[i], longer.values[i]);
  EXPECT_EQ(solver.num_variables(), 12 + 4 + 1);
}

TEST(Solver, ConfigNamesTheField) {
  SolverConfig config;
  config.lambda_up = 0.5;
  try {
    IncrementalSolver solver(config);
    FAIL();
  } catch (const std::invalid_argument& e) {
    EXPECT_THAT(e.what(), testing::HasSubstr("lambda_up"));
  }
}

TEST(Solver, SameInputSameBytes) {
  const Walk walk = MakeWalk(25, 5, 7);
  IncrementalSolver a, b;
  for (std::size_t i = 0; i < walk.factors.size(); ++i) {
    const double ea = a.Update(walk.factors[i], walk.values[i]).error_after;
    const double eb = b.Update(walk.factors[i], walk.values[i]).error_after;
    EXPECT_EQ(ea, eb);
  }
  EXPECT_EQ(a.MarginalCovariance(X(24)), b.MarginalCovariance(X(24)));
}

TEST(LinearFactor, JacobiansMatch) {
  std::mt19937 rng(8);
  for (int trial = 0; trial < 10; ++trial) {
    const Eigen::Isometry3d T = RandomPose(rng);
    const Cylinder c = RandomCylinder(rng);
    Eigen::MatrixXd A(14, 14);
    for (int i = 0; i < 14; ++i) A.col(i) = RandomVector<14>(rng);
    const Eigen::VectorXd g = RandomVector<14>(rng);
    const LinearFactor factor({X(0), L(0), P(0)}, {T, c, Eigen::Vector3d(1, 2, 3)}, A * A.transpose(), g);
    Values values;
    values.Insert(X(0), Eigen::Isometry3d(T * RandomPose(rng, 0.2, 0.2)));
    values.Insert(L(0), c.Retract(RandomVector<5>(rng, 0.1)));
    values.Insert(P(0), Eigen::Vector3d(RandomVector<3>(rng)));
    ExpectJacobianMatches(factor, values);
    Eigen::MatrixXd J;
    Eigen::VectorXd r;
    Values origin;
    origin.Insert(X(0), T);
    origin.Insert(L(0), c);
    origin.Insert(P(0), Eigen::Vector3d(1, 2, 3));
    factor.Linearize(origin, &J, &r);
    EXPECT_LT((J.transpose() * J - A * A.transpose()).norm(), 1e-8 * (A * A.transpose()).norm());
    EXPECT_LT((J.transpose() * r + g).norm(), 1e-6 * g.norm());
  }
}

TEST(G2o, ReadsWritesAndNamesTheLine) {
  const std::string text =
      "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n"
      "VERTEX_SE3:QUAT 1 1 2 3 0 0 0.7071067811865476 0.7071067811865476\n"
      "EDGE_SE3:QUAT 0 1 1 2 3 0 0 0.7071067811865476 0.7071067811865476 "
      "1 0 0 0 0 0 2 0 0 0 0 3 0 0 0 4 0.5 0 5 0 6\n";
  std::istringstream in(text);
  const PoseGraph graph = ReadG2o(in);
  ASSERT_EQ(graph.edges.size(), 1u);
  Vector6d diagonal;
  diagonal << 4, 5, 6, 1, 2, 3;
  EXPECT_LT((graph.edges[0].information.diagonal() - diagonal).norm(), 1e-12);
  EXPECT_EQ(graph.edges[0].information(0, 1), 0.5);
  std::stringstream out;
  WriteG2o(graph, out);
  const PoseGraph again = ReadG2o(out);
  EXPECT_LT((again.poses.at(1).matrix() - graph.poses.at(1).matrix()).norm(), 1e-12);
  std::istringstream bad("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 nan 0 0 0 0 0 1\n");
  try {
    ReadG2o(bad);
    FAIL();
  } catch (const std::runtime_error& e) {
    EXPECT_THAT(e.what(), testing::HasSubstr("line 2"));
  }
}

// Crafted files: what is wrong is named with the variable and with what to do.
TEST(G2o, FaultyFilesNameTheVariableAndTheRemedy) {
  const std::string unit = " 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n";
  const auto vertex = [](int id, const char* x = "0") {
    return "VERTEX_SE3:QUAT " + std::to_string(id) + " " + x + " 0 0 0 0 0 1\n";
  };
  const auto edge = [&](int a, int b) {
    return "EDGE_SE3:QUAT " + std::to_string(a) + " " + std::to_string(b) + " 1 0 0 0 0 0 1" + unit;
  };
  const std::string two = vertex(0) + vertex(1);
  const struct {
    std::string text, variable, remedy;
  } cases[] = {
      {vertex(0) + vertex(1, "nan") + edge(0, 1), "line 2: vertex 1", "correct the line"},
      {two + "EDGE_SE3:QUAT 0 1 1 0 inf 0 0 0 1" + unit, "line 3: edge 0 1", "correct the line"},
      {two + "EDGE_SE3:QUAT 0 1 1 0 0\n", "line 3: edge 0 1", "correct the line"},
      {two + "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 0" + unit, "line 3: edge 0 1", "0 0 0 1"},
      {two + "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 0 0 0 0 1 0 0 1 0 1\n", "line 3: edge 0 1",
       "small information"},
      {two + edge(0, 1) + edge(1, 7), "line 4: edge 1 7: vertex 7", "add one or take the edge out"},
      {two + vertex(1) + edge(0, 1), "line 3: vertex 1", "take one of them out"},
      {two + edge(1, 1), "line 3: edge 1 1", "take it out"},
      {two + "EDGE_SE3:QUAT 0 -1 1 0 0 0 0 0 1" + unit, "line 3", "number the vertices from 0"},
      {two + "VERTEX_SE2 2 0 0 0\n", "line 3: tag VERTEX_SE2", "only SE(3)"},
      {"# nothing\n", "no SE(3) vertex", "it needs"},
      {two + vertex(2) + vertex(3) + edge(0, 1) + edge(2, 3), "variable x2", "add an edge"},
      {two + vertex(2) + edge(0, 1), "variable x2", "add an edge"},
  };
  for (const auto& c : cases) {
    try {
      std::istringstream in(c.text);
      const PoseGraph graph = ReadG2o(in);
      ChordalInitialization(graph);
      ADD_FAILURE() << c.text;
    } catch (const std::runtime_error& e) {
      EXPECT_THAT(e.what(), testing::AllOf(testing::HasSubstr(c.variable), testing::HasSubstr(c.remedy)));
    }
  }
}

// A pose that only a later one is joined to waits for it; otherwise the order is that of the ids.
TEST(G2o, InsertionOrderFollowsIdsAndEdges) {
  PoseGraph graph;
  for (const auto& [a, b] : std::vector<std::pair<int, int>>{{0, 1}, {2, 4}, {1, 3}, {3, 4}, {0, 4}}) {
    PoseGraphEdge edge;
    edge.from = a;
    edge.to = b;
    graph.edges.push_back(edge);
    graph.poses.emplace(a, Eigen::Isometry3d::Identity());
    graph.poses.emplace(b, Eigen::Isometry3d::Identity());
  }
  EXPECT_THAT(InsertionOrder(graph), testing::ElementsAre(0, 1, 3, 4, 2));
  EXPECT_THROW(InsertionOrder(PoseGraph{}), std::invalid_argument);
}

}  // namespace
}  // namespace dendro
