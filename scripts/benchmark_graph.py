#!/usr/bin/env python3
"""Runs factor graphs through this package and through GTSAM in one run and prints the ratios.

    scripts/benchmark_graph.py [GRAPH.g2o ...] [--only graphs|laps] [--minutes M] [--repeat N] [--json]

Needs the gtsam wheel in the Python that runs it, and takes five minutes:
    scripts/build solve_g2o cylinder_workload
    scripts/setup_oracles gtsam && build/oracles/bin/python scripts/benchmark_graph.py

Pose graphs: solve_g2o against iSAM2, and against one Gauss-Newton and one Levenberg-Marquardt iteration of
GTSAM from chordal initialisation. Both sides add pose by pose (a pose starts where the edge from the latest
pose puts it), on one thread. A time is the processor time (so that what else runs on the machine weighs
little) from the new factors to the estimate of the new pose: iSAM2 puts back-substitution off until an
estimate is asked for, so asking for that one pose is part of its time; an update of this package has all
estimates and the error. Sides take turns. iSAM2: relinearizeThreshold 0.1, relinearizeSkip 1 and 10;
ratios are against the better of the two.

Laps: `cylinder_workload`, ten minutes of laps around the same trees. GTSAM has no cylinders, and
factors written in Python would be no fair peer; so both sides get the ends of the cylinders as
points (two point observations, 6 residuals, where this package alone would use one cylinder factor of
5), GTSAM by its BearingRangeFactor3D with the same isotropic noise. Each side is a process of its own,
and memory is the peak of the process less what it had before the first update. The runs of this package
with real cylinders stand beside: every scan a pose, and key frames at 2 Hz with the scans between them
summarised (one cylinder factor per landmark).
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
# With the best known 1/2 chi2.
DEFAULT_GRAPHS = {"smallGrid3D.g2o": 517.925, "sphere2500.g2o": 675.701, "parking-garage.g2o": 0.634192}


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
    seconds, update_alone_s = [], 0.0
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
        update_alone_s += time.process_time() - start
        isam.calculateEstimatePose3(key)
        seconds.append(time.process_time() - start)
    result = summarize(seconds)
    result["update_alone_s"] = update_alone_s
    result["half_chi2"] = isam.getFactorsUnsafe().error(isam.calculateEstimate())
    return result


def batch_iteration_gtsam(path, levenberg_marquardt):
    """Processor time of one iteration from chordal initialisation."""
    import gtsam
    graph, initial = gtsam.readG2o(str(path), True)
    first = min(initial.keys())
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
    graph.add(gtsam.PriorFactorPose3(first, initial.atPose3(first), noise))
    start = gtsam.InitializePose3.initialize(graph)
    optimizer = (gtsam.LevenbergMarquardtOptimizer(graph, start) if levenberg_marquardt
                 else gtsam.GaussNewtonOptimizer(graph, start))
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


def read_scans(path):
    """The measurements that cylinder_workload --write leaves, one list a scan, read as they are used."""
    scan = []
    with open(path) as lines:
        for line in lines:
            word, *rest = line.split()
            if word != "SCAN":
                scan.append((word, [float(x) for x in rest]))
            elif scan:
                yield scan
                scan = []
    yield scan


def peak_memory_mb():
    """Of this process alone; getrusage would start with the peak of the process that started it."""
    with open("/proc/self/status") as lines:
        return next(float(line.split()[1]) / 1024.0 for line in lines if line.startswith("VmHWM:"))


def run_isam2_points(path, skip):
    import gtsam
    import numpy as np

    def pose(v):
        return gtsam.Pose3(gtsam.Rot3.Quaternion(v[6], v[3], v[4], v[5]), np.array(v[:3]))

    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(0.1)
    params.relinearizeSkip = skip
    isam = gtsam.ISAM2(params)
    seconds, known = [], set()
    before_mb = peak_memory_mb()
    for k, scan in enumerate(read_scans(path)):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        key = gtsam.symbol("x", k)
        for word, v in scan:
            if word == "PRIOR":
                T = pose(v)
                graph.add(gtsam.PriorFactorPose3(key, T, gtsam.noiseModel.Isotropic.Sigma(6, v[7])))
                values.insert(key, T)
            elif word == "ODOMETRY":
                noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([v[7]] * 3 + [v[8]] * 3))
                previous = gtsam.symbol("x", k - 1)
                T = isam.calculateEstimatePose3(previous).compose(pose(v))
                graph.add(gtsam.BetweenFactorPose3(previous, key, pose(v), noise))
                values.insert(key, T)
            else:
                point, sigma = np.array(v[1:4]), v[4]
                distance = np.linalg.norm(point)
                landmark = gtsam.symbol("l", int(v[0]))
                noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([sigma / distance] * 2 + [sigma]))
                graph.add(gtsam.BearingRangeFactor3D(key, landmark, gtsam.Unit3(point), distance, noise))
                if v[0] not in known:
                    known.add(v[0])
                    values.insert(landmark, T.transformFrom(point))
        start = time.process_time()
        isam.update(graph, values)
        isam.calculateEstimatePose3(key)
        seconds.append(time.process_time() - start)
    result = summarize(seconds)
    result["seconds"] = seconds
    result["peak_memory_mb"] = peak_memory_mb()
    result["peak_memory_before_mb"] = before_mb
    result["half_chi2"] = isam.getFactorsUnsafe().error(isam.calculateEstimate())
    return result


def used_mb(result):
    """What the graph and the solver took: not the interpreter, the libraries and the measurements."""
    return result["peak_memory_mb"] - result["peak_memory_before_mb"]


def run_laps(programs, minutes):
    import numpy as np
    workload = programs / "cylinder_workload"

    def own(*options):
        command = [str(workload), "--minutes", str(minutes), "--json", *options]
        return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)

    report = {}
    with tempfile.TemporaryDirectory() as folder:
        measurements = os.path.join(folder, "measurements.txt")
        report["own_points"] = own("--landmarks", "points", "--write", measurements)
        for skip in (1, 10):
            output = subprocess.run([sys.executable, __file__, "--isam2-points", measurements, "--skip", str(skip)],
                                    check=True, capture_output=True, text=True).stdout
            peer = json.loads(output)
            seconds = 1e3 * np.asarray(peer.pop("seconds"))
            per_minute = max(1, round(len(seconds) / minutes))
            peer["minutes"] = [{"median_ms": float(np.median(part)), "p99_ms": float(np.percentile(part, 99)),
                                "max_ms": float(part.max())}
                               for part in np.split(seconds, range(per_minute, len(seconds), per_minute))]
            report[f"isam2_skip_{skip}"] = peer
    report["own_cylinders"] = own("--landmarks", "cylinders")
    report["own_key_frames"] = own("--landmarks", "cylinders", "--key-frame-hz", "2", "--between", "summarize")
    points = report["own_points"]
    peers = [report["isam2_skip_1"], report["isam2_skip_10"]]
    last = points["minutes"][-1]["p99_ms"]
    report["ratio_total"] = points["total_cpu_s"] / min(p["total_s"] for p in peers)
    report["ratio_p99_last_minute"] = last / min(p["minutes"][-1]["p99_ms"] for p in peers)
    report["ratio_p99_last_to_first_minute"] = last / points["minutes"][0]["p99_ms"]
    report["ratio_memory"] = used_mb(points) / min(used_mb(p) for p in peers)
    report["ratio_error"] = points["half_chi2"] / min(p["half_chi2"] for p in peers)
    full, frames = report["own_cylinders"]["radii_m"], report["own_key_frames"]["radii_m"]
    report["key_frame_radius_difference_max_m"] = max(abs(a - b) for a, b in zip(full, frames))
    return report


def show_laps(report):
    print("laps around the same trees")
    for name, r in report.items():
        if isinstance(r, dict):
            first, end = r["minutes"][0], r["minutes"][-1]
            print(f"  {name:15s} total {r.get('total_s', r.get('total_cpu_s')):8.2f} s   p99 in the first minute "
                  f"{first['p99_ms']:7.2f} ms, in the last {end['p99_ms']:7.2f} ms   memory "
                  f"{used_mb(r):6.1f} MB   1/2 chi2 {r['half_chi2']:.3f}", flush=True)


def summary_rows(report):
    """(what, measured, aim) of everything that was run."""
    rows = []
    for name, entry in report.items():
        if name == "laps":
            frames = entry["own_key_frames"]
            rows += [
                ("laps: total time / iSAM2", entry["ratio_total"], None),
                ("laps: p99 in the last minute / iSAM2", entry["ratio_p99_last_minute"], 0.1),
                ("laps: p99 in the last / the first minute", entry["ratio_p99_last_to_first_minute"], 1.5),
                ("laps: |error / iSAM2 - 1|", abs(entry["ratio_error"] - 1.0), 0.001),
                ("laps: memory / iSAM2", entry["ratio_memory"], 0.5),
                ("laps, key frames: p99 of all key frames [ms]", frames["p99_ms"], 10.0),
                ("laps, key frames: memory of the process [MB]", frames["peak_memory_mb"], 250.0),
                ("laps, key frames: radii against every scan a pose, max [mm]",
                 1e3 * entry["key_frame_radius_difference_max_m"], 1.0),
            ]
            continue
        rows += [
            (f"{name}: total time / iSAM2", entry["ratio_total"], 0.5),
            (f"{name}: the same without iSAM2's back-substitution", entry["ratio_total_update_alone"], None),
            (f"{name}: p99 / iSAM2", entry["ratio_p99"], 0.5),
            # The small graph ends before the estimate has settled, with iSAM2 too.
            (f"{name}: error / best known - 1", entry["error_above_best"],
             None if name == "smallGrid3D.g2o" else 0.0005),
            (f"{name}: batch iteration / GTSAM", entry["ratio_batch_iteration"], 1.0),
        ]
    return rows


def best_of(repeat, call):
    results = [call() for _ in range(repeat)]
    return min(results, key=lambda r: r.get("iteration_s", r.get("total_s")))


def show(name, r):
    print(f"  {name:18s} total {r['total_s']:8.3f} s   median {r['median_ms']:8.3f} ms   "
          f"p99 {r['p99_ms']:8.3f} ms   max {r['max_ms']:8.3f} ms   1/2 chi2 {r['half_chi2']:.6f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("graphs", nargs="*", type=pathlib.Path)
    parser.add_argument("--programs", type=pathlib.Path, default=ROOT / "build/devel/lib/dendro_slam",
                        help="folder of solve_g2o and cylinder_workload")
    parser.add_argument("--only", choices=["graphs", "laps"], help="the pose graphs or the laps alone")
    parser.add_argument("--minutes", type=float, default=10.0, help="length of the laps")
    parser.add_argument("--isam2-points", type=pathlib.Path, help=argparse.SUPPRESS)
    parser.add_argument("--skip", type=int, default=1, help=argparse.SUPPRESS)
    parser.add_argument("--repeat", type=int, default=1, help="best of N runs of each side")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    args = parser.parse_args()
    try:
        import gtsam  # noqa: F401
    except ImportError:
        sys.exit("benchmark_graph: this Python has no gtsam; run scripts/setup_oracles gtsam and then the "
                 "script with build/oracles/bin/python")
    if args.isam2_points:
        print(json.dumps(run_isam2_points(args.isam2_points, args.skip)))
        return
    laps = args.only == "laps" or (args.only is None and not args.graphs)
    for program in ["solve_g2o"] * (args.only != "laps") + ["cylinder_workload"] * laps:
        if not (args.programs / program).exists():
            sys.exit(f"benchmark_graph: {args.programs / program} is missing; run scripts/build {program} first")
    solver = args.programs / "solve_g2o"
    shared = pathlib.Path(os.environ.get("DENDRO_SHARED_DATA", ROOT / "../shared/data"))
    graphs = args.graphs or [shared / "posegraph" / name for name in DEFAULT_GRAPHS]
    report = {}
    for path in graphs if args.only != "laps" else []:
        if not path.exists():
            sys.exit(f"benchmark_graph: {path} is missing; name g2o files on the command line")
        entry = {
            "own": best_of(args.repeat, lambda: run_own(solver, path, True)),
            "isam2_skip_1": best_of(args.repeat, lambda: run_isam2(path, 1)),
            "isam2_skip_10": best_of(args.repeat, lambda: run_isam2(path, 10)),
            "own_batch": best_of(args.repeat, lambda: run_own(solver, path, False)),
            "gtsam_batch": best_of(args.repeat, lambda: batch_iteration_gtsam(path, True)),
            "gtsam_batch_gauss_newton": best_of(args.repeat, lambda: batch_iteration_gtsam(path, False)),
        }
        peers = [entry["isam2_skip_1"], entry["isam2_skip_10"]]
        entry["ratio_total"] = entry["own"]["total_s"] / min(p["total_s"] for p in peers)
        entry["ratio_total_update_alone"] = entry["own"]["total_s"] / min(p["update_alone_s"] for p in peers)
        entry["ratio_p99"] = entry["own"]["p99_ms"] / min(p["p99_ms"] for p in peers)
        # Of a graph that is not among the public ones, what the batch solution reaches.
        best = DEFAULT_GRAPHS.get(path.name, entry["own_batch"]["half_chi2"])
        # A graph without noise has no error to compare.
        entry["error_above_best"] = entry["own"]["half_chi2"] / best - 1.0 if best > 1e-9 else None
        entry["ratio_batch_iteration"] = entry["own_batch"]["iteration_s"] / entry["gtsam_batch"]["iteration_s"]
        report[path.name] = entry
        if not args.json:
            print(path.name)
            show("dendro_slam", entry["own"])
            show("iSAM2 skip 1", entry["isam2_skip_1"])
            show("iSAM2 skip 10", entry["isam2_skip_10"])
            print(f"  batch iteration    own {1e3 * entry['own_batch']['iteration_s']:.1f} ms, "
                  f"GTSAM Levenberg-Marquardt {1e3 * entry['gtsam_batch']['iteration_s']:.1f} ms, "
                  f"Gauss-Newton {1e3 * entry['gtsam_batch_gauss_newton']['iteration_s']:.1f} ms")
            sys.stdout.flush()
    if laps:
        report["laps"] = run_laps(args.programs, args.minutes)
        if not args.json:
            show_laps(report["laps"])
    if args.json:
        print(json.dumps(report, indent=2))
        return
    print("ratios")
    for what, value, aim in summary_rows(report):
        shown = "         -" if value is None else f"{value:10.5f}"
        print(f"  {what:60s} {shown}" + (f"   aim: at most {aim:g}" if aim is not None else ""))


if __name__ == "__main__":
    main()
