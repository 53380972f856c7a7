#!/usr/bin/python3
"""Runs KISS-ICP (the PyPI wheel) over a simulated bag and scores its path as evaluate_map.py does.

    scripts/benchmark_kiss_icp.py BAG [--truth TRUTH] [--map MAP_DIR] [--voxel M]

One JSON object on standard output: absolute trajectory error with the first pose aligned, and beside
it that of a map directory made from the same bag. TRUTH is by default the folder NAME.truth beside
the bag. KISS-ICP gets every return with its time and no odometry; its pose holds at the end of a
revolution, and is compared with the true pose of that time.

Needs scripts/setup_oracles kiss-icp; run it with build/oracles/bin/python.
"""

import argparse
import json
import os
import sys

import numpy as np

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from dendro_eval.files import MapDirectory, Truth  # noqa: E402
from dendro_eval.geometry import inverse  # noqa: E402
from dendro_eval.scores import alignment, trajectory_scores  # noqa: E402

TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def read_cloud(message):
    """(points (n, 3) [m], times (n) [s]) of a PointCloud2, without the beams that met nothing."""
    fields = {f.name: f for f in message.fields}
    missing = [name for name in ("x", "y", "z", "time") if name not in fields]
    if missing:
        raise SystemExit(f"benchmark_kiss_icp: the clouds have no field '{missing[0]}'")
    names = ("x", "y", "z", "time")
    layout = np.dtype({"names": names,
                       "formats": [TYPES[fields[n].datatype] for n in names],
                       "offsets": [fields[n].offset for n in names],
                       "itemsize": message.point_step})
    data = np.frombuffer(message.data, dtype=layout, count=message.width * message.height)
    points = np.column_stack([data["x"], data["y"], data["z"]]).astype(np.float64)
    good = np.isfinite(points).all(axis=1)
    return points[good], data["time"][good].astype(np.float64)


def interpolated(trajectory):
    """Function from a stamp [ns] to the true position and nearest rotation at it, or None outside."""
    stamps = np.array(sorted(trajectory), dtype=np.int64)
    positions = np.array([trajectory[int(s)][:3, 3] for s in stamps])

    def at(stamp):
        if not stamps[0] <= stamp <= stamps[-1]:
            return None
        pose = trajectory[int(stamps[np.argmin(np.abs(stamps - stamp))])].copy()
        pose[:3, 3] = [np.interp(float(stamp - stamps[0]), (stamps - stamps[0]).astype(float), p)
                       for p in positions.T]
        return pose
    return at


def run_kiss_icp(bag_path, voxel_m):
    """{stamp [ns] of the end of the revolution: 4x4 pose}."""
    try:
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP
    except ImportError:
        raise SystemExit("benchmark_kiss_icp: KISS-ICP is not installed; run scripts/setup_oracles "
                         "kiss-icp, and this script with build/oracles/bin/python") from None
    import rosbag
    config = KISSConfig()
    config.data.deskew = True
    config.data.min_range = 0.5
    config.mapping.voxel_size = voxel_m
    odometry = KissICP(config)
    poses = {}
    with rosbag.Bag(bag_path) as bag:
        for _, message, _ in bag.read_messages(topics=["/velodyne_points"]):
            points, times = read_cloud(message)
            if len(points) == 0:
                continue
            odometry.register_frame(points, times)
            end = message.header.stamp.to_nsec() + int(round(times.max() * 1e9))
            poses[end] = np.array(odometry.last_pose)
    return poses


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("bag", metavar="BAG")
    parser.add_argument("--truth", help="default: NAME.truth beside the bag")
    parser.add_argument("--map", metavar="MAP_DIR", help="score this map's path beside it")
    parser.add_argument("--voxel", type=float, default=1.0, metavar="M",
                        help="voxel size of KISS-ICP's map [m] (default %(default)s, KISS-ICP's own)")
    arguments = parser.parse_args()
    truth = Truth(arguments.truth or os.path.splitext(arguments.bag)[0] + ".truth").trajectory
    if not truth:
        raise SystemExit("benchmark_kiss_icp: the truth holds no trajectory")
    at = interpolated(truth)
    estimate, reference = {}, {}
    for stamp, pose in run_kiss_icp(arguments.bag, arguments.voxel).items():
        true = at(stamp)
        if true is not None:
            estimate[stamp], reference[stamp] = pose, true
    if not estimate:
        raise SystemExit(f"benchmark_kiss_icp: {arguments.bag}: no scan has a true pose")
    first = min(estimate)
    scores = {"kiss_icp": trajectory_scores(
        estimate, reference, reference[first] @ inverse(estimate[first]))}
    if arguments.map:
        mapped = MapDirectory(arguments.map).trajectory
        scores["dendro_slam"] = trajectory_scores(mapped, truth, alignment(mapped, truth))
    print(json.dumps(scores, indent=2))


if __name__ == "__main__":
    main()
