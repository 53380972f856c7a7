#!/usr/bin/python3
"""simulate_bag, map_bag and pcap_to_bag as a user runs them: results, determinism, clear errors."""
import filecmp
import json
import os
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
TOOLS = next(pathlib.Path(base) / "lib/dendro_slam" for base in
             os.environ["CMAKE_PREFIX_PATH"].split(":")
             if (pathlib.Path(base) / "lib/dendro_slam/map_bag").exists())
SHARED = pathlib.Path(os.environ.get("DENDRO_SHARED_DATA", ROOT.parent / "shared/data"))
SCENE = ROOT / "config/scenes/thesis_tree.yaml"
PATH = ROOT / "config/paths/thesis_quadrangle.yaml"


def run(name, *args, timeout=300):
    return subprocess.run([TOOLS / name, *map(str, args)], capture_output=True, text=True,
                          timeout=timeout)


def good(name, *args):
    result = run(name, *args)
    assert result.returncode == 0, result.stderr
    return result


def one_line_error(result, *words):
    assert result.returncode != 0
    lines = result.stderr.strip().splitlines()
    assert lines, result
    for word in words:
        assert word in lines[-1], lines
    assert len(lines[-1]) < 2000


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("bag") / "flight.bag"
    good("simulate_bag", SCENE, PATH, "-o", path, "--duration", 3, "--packets", "--pcap",
         path.with_suffix(".pcap"))
    return path


@pytest.mark.parametrize("name", ["simulate_bag", "map_bag", "pcap_to_bag", "label_bag"])
def test_help(name):
    assert "Usage" in good(name, "--help").stdout


def test_truth_is_beside_the_bag(bag):
    truth = bag.with_suffix(".truth")
    assert {p.name for p in truth.iterdir()} >= {"scene.yaml", "trajectory.tum", "hits.csv", "labels.bin"}
    assert len((truth / "trajectory.tum").read_text().strip().splitlines()) >= 29


def test_same_seed_same_bag_whatever_the_threads(bag, tmp_path):
    again = tmp_path / "flight.bag"
    good("simulate_bag", SCENE, PATH, "-o", again, "--duration", 3, "--packets", "--threads", 1)
    assert filecmp.cmp(bag, again, shallow=False)


def test_map_bag_gives_the_same_bytes_twice(bag, tmp_path):
    for name in ("a", "b"):
        good("map_bag", bag, "-o", tmp_path / name, "--per-scan", "--config", ROOT / "config")
    names = {p.name for p in (tmp_path / "a").iterdir()}
    assert names >= {"tree_map.json", "cylinders.csv", "branches.csv", "trees.csv", "trajectory.tum",
                     "tree.ply", "timing.json", "scan_cylinders.csv", "scan_labels.bin"}
    for name in names - {"timing.json"}:
        assert filecmp.cmp(tmp_path / "a" / name, tmp_path / "b" / name, shallow=False), name
    timing = json.loads((tmp_path / "a/timing.json").read_text())
    assert timing


def test_points_follow_the_scans(bag, tmp_path):
    config = tmp_path / "points.yaml"
    config.write_text("tree_mapping: {map_cloud: {enabled: true}}\n")
    good("map_bag", bag, "-o", tmp_path / "with", "--config", config)
    good("map_bag", bag, "-o", tmp_path / "without")
    for name in ("cylinders.csv", "trajectory.tum"):  # points change nothing else
        assert filecmp.cmp(tmp_path / "with" / name, tmp_path / "without" / name, shallow=False), name
    assert not (tmp_path / "without/points.ply").exists()
    header = (tmp_path / "with/points.ply").read_bytes()[:200].split(b"element vertex ")[1]
    assert int(header.split()[0]) > 1000
    # Going on with such a map keeps its points.
    good("map_bag", bag, "-o", tmp_path / "more", "--load", tmp_path / "with")
    assert (tmp_path / "more/points.ply").exists()


def test_one_scan_is_described_and_drawn(bag, tmp_path):
    scan = json.loads(good("describe_scan", bag, "--index", 12).stdout)
    same = json.loads(good("describe_scan", bag, "--stamp", 1.2).stdout)
    assert scan["index"] == 12 and scan["stamp_ns"] == same["stamp_ns"] and scan["deskewed"]
    measured = [s for s in scan["segments"] if s["final"]]
    assert measured
    for segment in measured:
        returns = [p for p in scan["points"] if p[4] == segment["id"]]
        assert len(returns) == segment["num_pixels"]
        assert 0.03 < segment["final"]["radius_m"] < 0.35
        assert segment["initial"] is not None
    drawn = subprocess.run([sys.executable, ROOT / "scripts/draw_scan.py", bag, "--index", "12", "-o",
                            tmp_path / "pictures"], capture_output=True, text=True,
                           env={**os.environ, "DENDRO_BUILD_DIR": str(TOOLS.parents[2])})
    assert drawn.returncode == 0, drawn.stderr
    names = {p.name for p in (tmp_path / "pictures").iterdir()}
    assert names == {"scan_a_labels.png", "scan_b_segments.png", "scan_c_fit.png", "scan_d_cylinders.png"}
    one_line_error(run("describe_scan", bag, "--index", 999), "no scan 999", "0 to")
    one_line_error(run("describe_scan", bag, "--stamp", 500), "within a second")
    one_line_error(run("describe_scan", bag), "--stamp or --index")
    one_line_error(run("describe_scan", SCENE, "--index", 0), "thesis_tree.yaml")


def test_map_bag_goes_on_with_a_map(bag, tmp_path):
    good("map_bag", bag, "-o", tmp_path / "a")
    good("map_bag", bag, "-o", tmp_path / "b", "--load", tmp_path / "a")


def test_what_is_switched_off_is_not_mapped_with(bag, tmp_path):
    good("map_bag", bag, "-o", tmp_path / "both")
    for switch in ("use_icp", "use_odometry"):
        config = tmp_path / f"{switch}.yaml"
        config.write_text(f"tree_mapping: {{{switch}: false}}\n")
        good("map_bag", bag, "-o", tmp_path / switch, "--config", config)
    paths = [(tmp_path / name / "trajectory.tum").read_bytes() for name in ("both", "use_icp", "use_odometry")]
    assert len(set(paths)) == 3


def test_bag_without_odometry(tmp_path):
    path = tmp_path / "none.bag"
    good("simulate_bag", SCENE, PATH, "-o", path, "--duration", 2, "--odometry", "none")
    result = good("map_bag", path, "-o", tmp_path / "map")
    assert "no odometry" in result.stderr


def test_capture_to_bag_to_map(bag, tmp_path):
    result = good("pcap_to_bag", bag.with_suffix(".pcap"), "-o", tmp_path / "capture.bag")
    assert " 0 lost" in result.stdout
    good("map_bag", tmp_path / "capture.bag", "-o", tmp_path / "map")


def test_label_bag_draws_what_stage_1_sees(bag, tmp_path):
    result = good("label_bag", bag, "-o", tmp_path / "labels", "--every", 10)
    pictures = sorted((tmp_path / "labels").iterdir())
    assert [p.name for p in pictures] == ["scan_00000.png", "scan_00010.png", "scan_00020.png"]
    assert all(p.read_bytes().startswith(b"\x89PNG") for p in pictures)
    for line in result.stdout.strip().splitlines():
        ground, wood, leaf, other = (int(part.split()[0]) for part in line.split(": ")[1].split(", "))
        assert ground > 5000 and 50 < wood < 3000 and leaf + other < 100, line  # A bare tree on a plane.
    one_line_error(run("label_bag", bag, "-o", tmp_path / "x", "--weights", bag), "flight.bag")


def test_real_capture(tmp_path):
    capture = SHARED / "vlp16/grap_apple_20frames.pcap"
    if not capture.exists():
        pytest.skip(f"{capture} is not here")
    good("pcap_to_bag", capture, "-o", tmp_path / "grap.bag")
    result = good("map_bag", tmp_path / "grap.bag", "-o", tmp_path / "map")
    assert "no odometry" in result.stderr


def test_errors_are_one_clear_line(bag, tmp_path):
    one_line_error(run("map_bag", tmp_path / "none.bag", "-o", tmp_path / "m"), "no such bag")
    text = tmp_path / "text.bag"
    text.write_text("this is not a bag\n")
    one_line_error(run("map_bag", text, "-o", tmp_path / "m"), "text.bag")
    one_line_error(run("map_bag", bag, "-o", tmp_path / "m", "--points", "/nothing"), "/nothing",
                   "/velodyne_points (sensor_msgs/PointCloud2")
    one_line_error(run("map_bag", bag, "-o", tmp_path / "m", "--load", tmp_path / "no_map"), "no_map")
    bad = tmp_path / "bad.yaml"
    bad.write_text("cylinder_fitting: {max_radus_m: 0.3}\n")
    one_line_error(run("map_bag", bag, "-o", tmp_path / "m", "--config", bad), "max_radus_m",
                   "did you mean 'max_radius_m'")
    bad.write_text("cylinder_fitting: {max_radius_m: -1.0}\n")
    one_line_error(run("map_bag", bag, "-o", tmp_path / "m", "--config", bad), "max_radius_m")
    one_line_error(run("simulate_bag", tmp_path / "no.yaml", PATH, "-o", tmp_path / "x.bag"), "no.yaml")
    one_line_error(run("simulate_bag", SCENE, PATH, "-o", "/proc/x.bag", "--duration", 1), "/proc/x.bag")
    for setting, words in (("odometry.jump_tme_s=60", ["jump_tme_s", "did you mean 'jump_time_s'"]),
                           ("odometry.loss_time_s=-1", ["loss_time_s", ">= 0"]), ("lidar=dual", ["SECTION.KEY=VALUE"]),
                           ("camera.rate_hz=3", ["lidar, odometry or imu"])):
        one_line_error(run("simulate_bag", SCENE, PATH, "-o", tmp_path / "x.bag", "--set", setting), "--set", *words)
    one_line_error(run("pcap_to_bag", tmp_path / "no.pcap", "-o", tmp_path / "x.bag"), "no.pcap")
    one_line_error(run("pcap_to_bag", text, "-o", tmp_path / "x.bag"), "text.bag")
    assert not (tmp_path / "x.bag").exists()
    assert not (tmp_path / "m").exists() or not list((tmp_path / "m").iterdir())


if __name__ == "__main__":
    sys.exit(pytest.main([__file__, "-q", "-p", "no:cacheprovider"]))
