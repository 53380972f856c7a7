#!/usr/bin/env python3
"""Runs pose graphs through solve_g2o and through GTSAM's iSAM2 in one run and prints the ratios.

    scripts/benchmark_graph.py [GRAPH.g2o ...] [--solver PATH] [--repeat N] [--json]

Needs the gtsam wheel in the Python that runs it, e.g.
    python3 -m venv venv && venv/bin/pip install gtsam numpy && venv/bin/python scripts/benchmark_graph.py
Both sides add pose by pose (a pose starts where the edge from the latest pose puts it), on one
thread. Times are processor time of the update calls alone, so that what else runs on the machine
weighs little; sides take turns. iSAM2: relinearizeThreshold 0.1, relinearizeSkip 1 and 10; ratios
are against the better of the two.
"""
import argparse
import collections
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = pathlib.Path(__file__).resolve().parent.parent
DEFAULT_GRAPHS = ["smallGrid3D.g2o", "sphere2500.g2o", "parking-garage.g2o"]


def summarize(seconds):
    import numpy as np
    ms = 1e3 * np.asarray(seconds)
    return {"total_s": float(ms.sum() / 1e3), "median_ms": float(np.median(ms)),
            "p99_ms": float(np.percentile(ms, 99)), "max_ms": float(ms.max())}


def run_isam2(path, skip):
    import gtsam
    graph, initial = gtsam.readG2o(str(path), True)
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(0.1)
    params.relinearizeSkip = skip
    isam = gtsam.ISAM2(params)
    edges = collections.defaultdict(list)
    for i in range(graph.size()):
        edges[max(graph.at(i).keys())].append(graph.at(i))
    seconds = []
    keys = sorted(initial.keys())
    for key in keys:
        factors, values, pose, latest = gtsam.NonlinearFactorGraph(), gtsam.Values(), initial.atPose3(key), -1
        for factor in edges[key]:
            factors.add(factor)
            a, b = factor.keys()
            other = a if b == key else b
            if other <= latest:
                continue
            latest = other
            motion = factor.measured() if b == key else factor.measured().inverse()
            pose = isam.calculateEstimatePose3(other).compose(motion)
        values.insert(key, pose)
        if key == keys[0]:
            noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
            factors.add(gtsam.PriorFactorPose3(key, initial.atPose3(key), noise))
        start = time.process_time()
        isam.update(factors, values)
        seconds.append(time.process_time() - start)
    result = summarize(seconds)
    result["half_chi2"] = isam.getFactorsUnsafe().error(isam.calculateEstimate())
    return result


def batch_iteration_gtsam(path):
    """Processor time of one Gauss-Newton iteration from chordal initialisation."""
    import gtsam
    graph, initial = gtsam.readG2o(str(path), True)
    first = min(initial.keys())
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
    graph.add(gtsam.PriorFactorPose3(first, initial.atPose3(first), noise))
    start = gtsam.InitializePose3.initialize(graph)
    optimizer = gtsam.GaussNewtonOptimizer(graph, start)
    times = []
    for _ in range(4):
        begin = time.process_time()
        optimizer.iterate()
        times.append(time.process_time() - begin)
    return {"iteration_s": min(times), "half_chi2": optimizer.error()}


def run_own(solver, path, incremental):
    with tempfile.TemporaryDirectory() as folder:
        trace = os.path.join(folder, "trace.txt")
        command = [str(solver), str(path), "--json", "--trace", trace]
        if incremental:
            command.append("--incremental")
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        report = json.loads(output)
        with open(trace) as lines:
            result = summarize([float(line) for line in lines])
    result["half_chi2"] = report["half_chi2"]
    result["peak_memory_mb"] = report["peak_memory_mb"]
    if not incremental:
        result["iteration_s"] = report["iteration_s"]
    return result


def best_of(repeat, call):
    results = [call() for _ in range(repeat)]
    return min(results, key=lambda r: r.get("iteration_s", r.get("total_s")))


def show(name, r):
    print(f"  {name:18s} total {r['total_s']:8.3f} s   median {r['median_ms']:8.3f} ms   "
          f"p99 {r['p99_ms']:8.3f} ms   max {r['max_ms']:8.3f} ms   1/2 chi2 {r['half_chi2']:.6f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("graphs", nargs="*", type=pathlib.Path)
    parser.add_argument("--solver", type=pathlib.Path,
                        default=ROOT / "build/devel/lib/dendro_slam/solve_g2o")
    parser.add_argument("--repeat", type=int, default=1, help="best of N runs of each side")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    args = parser.parse_args()
    try:
        import gtsam  # noqa: F401
    except ImportError:
        sys.exit("benchmark_graph: this Python has no gtsam; pip install gtsam numpy into a virtual "
                 "environment and run the script with its python")
    if not args.solver.exists():
        sys.exit(f"benchmark_graph: {args.solver} is missing; run scripts/build solve_g2o first")
    shared = pathlib.Path(os.environ.get("DENDRO_SHARED_DATA", ROOT / "../shared/data"))
    graphs = args.graphs or [shared / "posegraph" / name for name in DEFAULT_GRAPHS]
    report = {}
    for path in graphs:
        if not path.exists():
            sys.exit(f"benchmark_graph: {path} is missing; name g2o files on the command line")
        entry = {
            "own": best_of(args.repeat, lambda: run_own(args.solver, path, True)),
            "isam2_skip_1": best_of(args.repeat, lambda: run_isam2(path, 1)),
            "isam2_skip_10": best_of(args.repeat, lambda: run_isam2(path, 10)),
            "own_batch": best_of(args.repeat, lambda: run_own(args.solver, path, False)),
            "gtsam_batch": best_of(args.repeat, lambda: batch_iteration_gtsam(path)),
        }
        peers = [entry["isam2_skip_1"], entry["isam2_skip_10"]]
        entry["ratio_total"] = entry["own"]["total_s"] / min(p["total_s"] for p in peers)
        entry["ratio_p99"] = entry["own"]["p99_ms"] / min(p["p99_ms"] for p in peers)
        entry["ratio_batch_iteration"] = entry["own_batch"]["iteration_s"] / entry["gtsam_batch"]["iteration_s"]
        report[path.name] = entry
        if not args.json:
            print(path.name)
            show("dendro_slam", entry["own"])
            show("iSAM2 skip 1", entry["isam2_skip_1"])
            show("iSAM2 skip 10", entry["isam2_skip_10"])
            print(f"  batch iteration    own {1e3 * entry['own_batch']['iteration_s']:.1f} ms, "
                  f"GTSAM {1e3 * entry['gtsam_batch']['iteration_s']:.1f} ms")
            print(f"  ratios             total {entry['ratio_total']:.2f}   p99 {entry['ratio_p99']:.2f}   "
                  f"batch iteration {entry['ratio_batch_iteration']:.2f}", flush=True)
    if args.json:
        print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
