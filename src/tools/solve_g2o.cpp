// Solves an SE(3) pose graph in the g2o format with the incremental factor graph, in one batch or pose by pose.
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <map>
#include <numeric>
#include <string>
#include <vector>

#include <unistd.h>

#include <CLI/CLI.hpp>
#include <fmt/core.h>
#include <nlohmann/json.hpp>

#include "dendro_slam/factor_graph/g2o.h"
#include "dendro_slam/factor_graph/incremental_solver.h"
#include "dendro_slam/factor_graph/prior_factor.h"
#include "measure.h"

namespace {

using dendro::FactorList;
using dendro::Key;
using dendro::PoseGraph;
using dendro::PoseGraphKey;
using dendro::UpdateResult;

// Of the prior on the first pose, as GTSAM's examples fix it.
constexpr double kPriorSigma = 1e-4;

double Seconds(std::chrono::steady_clock::time_point start) {
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

struct Summary {
  std::vector<double> update_s;
  double initialization_s = 0.0;
  double total_s = 0.0;
  double error_initial = 0.0;
  double error = 0.0;
  double error_converged = 0.0;
  int iterations = 0;
  int steps_refused = 0;
  long relinearized = 0;
  long reeliminated = 0;
};

dendro::FactorPtr FirstPosePrior(const PoseGraph& graph) {
  return std::make_shared<dendro::PosePrior>(PoseGraphKey(graph.poses.begin()->first),
                                             graph.poses.begin()->second,
                                             dendro::NoiseModel::Isotropic(6, kPriorSigma));
}

void Count(const UpdateResult& result, Summary* summary) {
  summary->iterations += result.iterations;
  summary->steps_refused += result.steps_refused;
  summary->relinearized += result.variables_relinearized;
  summary->reeliminated += result.variables_reeliminated;
}

Summary SolveBatch(const PoseGraph& graph, bool chordal, dendro::IncrementalSolver* solver) {
  Summary summary;
  auto start = std::chrono::steady_clock::now();
  const auto poses = chordal ? dendro::ChordalInitialization(graph) : graph.poses;
  summary.initialization_s = Seconds(start);
  dendro::Values values;
  for (const auto& [id, pose] : poses) values.Insert(PoseGraphKey(id), pose);
  FactorList factors = dendro::PoseGraphFactors(graph);
  factors.push_back(FirstPosePrior(graph));
  start = std::chrono::steady_clock::now();
  const double cpu = dendro::measure::ThreadCpuSeconds();
  const UpdateResult result = solver->OptimizeBatch(factors, values);
  summary.update_s.push_back(dendro::measure::ThreadCpuSeconds() - cpu);
  summary.error_initial = result.error_before;
  Count(result, &summary);
  summary.total_s = Seconds(start);
  summary.error = summary.error_converged = result.error_after;
  return summary;
}

// Pose by pose in the order of the ids; a pose starts where the edge from the latest pose puts it.
Summary SolveIncrementally(const PoseGraph& graph, bool progress, dendro::IncrementalSolver* solver) {
  Summary summary;
  const FactorList all = dendro::PoseGraphFactors(graph);
  const std::vector<std::int64_t> order = dendro::InsertionOrder(graph);
  std::map<std::int64_t, std::size_t> place;
  for (std::size_t i = 0; i < order.size(); ++i) place[order[i]] = i;
  // An edge comes with the later of its poses.
  std::vector<std::vector<std::size_t>> edges_of(order.size());
  for (std::size_t i = 0; i < graph.edges.size(); ++i) {
    edges_of[std::max(place[graph.edges[i].from], place[graph.edges[i].to])].push_back(i);
  }
  const auto start = std::chrono::steady_clock::now();
  std::size_t done = 0;
  for (const std::int64_t id : order) {
    FactorList factors;
    dendro::Values values;
    Eigen::Isometry3d pose = graph.poses.at(id);
    std::size_t latest = 0;
    for (const std::size_t i : edges_of[done]) {
      const dendro::PoseGraphEdge& edge = graph.edges[i];
      factors.push_back(all[i]);
      const std::int64_t other = edge.from == id ? edge.to : edge.from;
      if (factors.size() > 1 && place[other] <= latest) continue;
      latest = place[other];
      const auto& T_other = solver->Estimate<Eigen::Isometry3d>(PoseGraphKey(other));
      pose = T_other * (edge.from == id ? edge.T_from_to.inverse() : edge.T_from_to);
    }
    values.Insert(PoseGraphKey(id), pose);
    if (id == graph.poses.begin()->first) factors.push_back(FirstPosePrior(graph));
    const double cpu = dendro::measure::ThreadCpuSeconds();
    const UpdateResult result = solver->Update(factors, values);
    summary.update_s.push_back(dendro::measure::ThreadCpuSeconds() - cpu);
    Count(result, &summary);
    ++done;
    if (progress && done % 50 == 0) {
      fmt::print(stderr, "\r{} of {} poses, 1/2 chi2 {:.3f} ", done, graph.poses.size(), result.error_after);
    }
  }
  if (progress) fmt::print(stderr, "\r{:60}\r", "");
  summary.total_s = Seconds(start);
  summary.error = solver->Error();
  summary.error_converged = solver->Optimize().error_after;
  return summary;
}

}  // namespace

int main(int argc, char** argv) {
  std::string file;
  std::string out_file;
  bool incremental = false;
  bool json = false;
  bool no_chordal = false;
  std::string trace_file;
  dendro::SolverConfig config;
  config.relinearize_skip = 10;
  double wildfire = 1e-3;
  CLI::App app{"Solves an SE(3) pose graph in the g2o format. Reports 1/2 chi2 as GTSAM counts it: SE(3) logarithm "
               "residuals, the file's information matrices, and a prior on the first pose with sigma 1e-4."};
  app.add_option("file", file, "Graph with VERTEX_SE3:QUAT and EDGE_SE3:QUAT lines")->required();
  app.add_flag("--incremental", incremental, "Add pose by pose, one update each, instead of one batch");
  app.add_flag("--json", json, "Print one JSON object instead of lines for people");
  app.add_option("--out", out_file, "Write the solved graph to this g2o file");
  app.add_option("--trace", trace_file, "Write the processor seconds of every update to this text file");
  app.add_flag("--no-chordal", no_chordal, "Batch: start from the poses of the file, not from chordal initialisation");
  app.add_option("--relinearize-skip", config.relinearize_skip, "Re-linearise in every n-th update")
      ->capture_default_str();
  app.add_option("--wildfire", wildfire, "Incremental: smaller changes of a tangent coordinate (rad, m) wait")
      ->capture_default_str();
  CLI11_PARSE(app, argc, argv);
  config.wildfire_threshold = config.still_threshold = wildfire;

  try {
    std::ifstream in(file);
    if (!in) throw std::runtime_error("cannot be opened");
    const PoseGraph graph = dendro::ReadG2o(in);
    dendro::IncrementalSolver solver(config);
    const bool progress = incremental && isatty(STDERR_FILENO) != 0;
    Summary summary = incremental ? SolveIncrementally(graph, progress, &solver)
                                  : SolveBatch(graph, !no_chordal, &solver);
    std::vector<double> sorted = summary.update_s;
    std::sort(sorted.begin(), sorted.end());
    if (!trace_file.empty()) {
      std::ofstream trace(trace_file);
      for (const double s : summary.update_s) trace << s << '\n';
      if (!trace.flush()) throw std::runtime_error(trace_file + " cannot be written");
    }
    if (!out_file.empty()) {
      PoseGraph solved = graph;
      for (auto& [id, pose] : solved.poses) pose = solver.Estimate<Eigen::Isometry3d>(PoseGraphKey(id));
      std::ofstream out(out_file);
      dendro::WriteG2o(solved, out);
      if (!out.flush()) throw std::runtime_error(out_file + " cannot be written");
    }
    const double cpu_s = std::accumulate(sorted.begin(), sorted.end(), 0.0);
    if (json) {
      nlohmann::ordered_json report;
      report["file"] = file;
      report["mode"] = incremental ? "incremental" : "batch";
      report["vertices"] = graph.poses.size();
      report["edges"] = graph.edges.size();
      report["half_chi2"] = summary.error;
      report["half_chi2_converged"] = summary.error_converged;
      report["total_s"] = summary.total_s;
      report["total_cpu_s"] = cpu_s;
      if (!incremental) {
        report["half_chi2_initial"] = summary.error_initial;
        report["initialization_s"] = summary.initialization_s;
        report["iteration_s"] = cpu_s / std::max(1, summary.iterations);
      } else {
        report["update_median_ms"] = 1e3 * dendro::measure::Quantile(sorted, 0.5);
        report["update_p99_ms"] = 1e3 * dendro::measure::Quantile(sorted, 0.99);
        report["update_max_ms"] = 1e3 * sorted.back();
      }
      report["iterations"] = summary.iterations;
      report["steps_refused"] = summary.steps_refused;
      report["variables_relinearized"] = summary.relinearized;
      report["variables_reeliminated"] = summary.reeliminated;
      report["peak_memory_mb"] = dendro::measure::PeakMemoryMb();
      std::cout << report.dump(2) << '\n';
    } else {
      fmt::print("{} vertices, {} edges, {}\n", graph.poses.size(), graph.edges.size(),
                 incremental ? "incremental" : "batch");
      fmt::print("1/2 chi2        {:.6f}\n", summary.error);
      if (incremental) {
        fmt::print("  converged     {:.6f}\n", summary.error_converged);
      } else {
        fmt::print("  initial       {:.6f} (initialisation {:.3f} s)\n", summary.error_initial,
                   summary.initialization_s);
      }
      fmt::print("total           {:.3f} s ({:.3f} s of processor time), {} iterations, {} steps refused\n", summary.total_s, cpu_s, summary.iterations,
                 summary.steps_refused);
      if (incremental) {
        fmt::print("update          median {:.3f} ms, p99 {:.3f} ms, max {:.3f} ms\n", 1e3 * dendro::measure::Quantile(sorted, 0.5),
                   1e3 * dendro::measure::Quantile(sorted, 0.99), 1e3 * sorted.back());
        fmt::print("work            {} variables eliminated again, {} linearised again\n", summary.reeliminated,
                   summary.relinearized);
      }
      fmt::print("peak memory     {:.1f} MB\n", dendro::measure::PeakMemoryMb());
    }
  } catch (const std::exception& error) {
    fmt::print(stderr, "solve_g2o: {}: {}\n", file, error.what());
    return 1;
  }
  return 0;
}
