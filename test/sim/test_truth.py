#!/usr/bin/python3
"""The truth that simulate_bag writes: complete, in the bag as in the files, and true of the points."""
import csv
import os
import pathlib
import struct
import subprocess
import sys

import numpy as np
import pytest
import rosbag
import yaml

ROOT = pathlib.Path(__file__).resolve().parents[2]
BUILD = pathlib.Path(os.environ.get("DENDRO_BUILD_DIR", ROOT / "build"))
SHARED = pathlib.Path(os.environ.get("DENDRO_SHARED_DATA", ROOT.parent / "shared/data"))
SIMULATE = BUILD / "devel/lib/dendro_slam/simulate_bag"
PATH = ROOT / "config/paths/thesis_quadrangle.yaml"

# Two trees whose ids have gaps and are not in order, a mesh, a wall.
SCENE = """
frame: map
trees:
  - name: first
    branches:
      - {id: 7, parent: 2, points: [[0.75, 0, 1.75, 0.05], [0.75, -1.2, 2.6, 0.04]]}
      - {id: 2, parent: 5, points: [[0, 0, 1, 0.08], [1.5, 0, 2.5, 0.06]]}
      - {id: 5, parent: null, points: [[0, 0, 0, 0.2], [0, 0, 4, 0.15]]}
  - name: second
    branches:
      - {id: 0, parent: null, points: [[0, 7, 0, 0.25], [0, 7, 5, 0.2]]}
      - {id: 1, parent: 0, points: [[0, 7, 2, 0.1], [-1, 7, 3, 0.08]]}
    leaves: {count: 300, size_m: 0.1, seed: 1, max_wood_radius_m: 0.2}
ground: {type: plane, z: 0}
obstacles: [{type: box, size_m: [0.3, 4, 3], position: [-5, 0, 1.5]}]
meshes: [{file: block.ply, position: [2, -2, 0], label: obstacle}, {file: block.obj, position: [2, 2, 0], scale: 0.5}]
"""
CUBE = [(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def cloud(msg, **types):
    dtype = np.dtype({"names": list(types), "formats": list(types.values()),
                      "offsets": [next(f.offset for f in msg.fields if f.name == n) for n in types],
                      "itemsize": msg.point_step})
    return np.frombuffer(msg.data, dtype)


def simulate(folder, scene, *options):
    (folder / "scene.yaml").write_text(scene)
    result = subprocess.run([SIMULATE, folder / "scene.yaml", PATH, "-o", folder / "f.bag", *options],
                            capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    topics = {}
    for topic, msg, _ in rosbag.Bag(str(folder / "f.bag")).read_messages():
        topics.setdefault(topic, []).append(msg)
    return topics


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    folder = tmp_path_factory.mktemp("truth")
    lines = ["ply", "format ascii 1.0", "element vertex 8", "property float x", "property float y",
             "property float z", "element face 6", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(map(str, v)) for v in CUBE] + ["4 " + " ".join(map(str, f)) for f in FACES]
    (folder / "block.ply").write_text("\n".join(lines) + "\n")
    (folder / "block.obj").write_text("".join(f"v {x} {y} {z}\n" for x, y, z in CUBE) +
                                      "".join("f " + " ".join(str(i + 1) for i in f) + "\n" for f in FACES))
    return folder, simulate(folder, SCENE, "--duration", "2", "--set", "lidar.enable_range_noise=false",
                            "--set", "lidar.enable_footprint=false")


def rotation(q):
    x, y, z, w = q
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


def test_every_scan_has_its_truth_in_bag_and_files(flight):
    folder, topics = flight
    truth = folder / "f.truth"
    scans = topics["/velodyne_points"]
    assert len(scans) == 20
    poses = np.loadtxt(truth / "trajectory.tum")
    blob = (truth / "labels.bin").read_bytes()
    assert blob[:8] == b"DSTRUTH1"
    at = 8
    rows = list(csv.DictReader((truth / "hits.csv").open()))
    for i, scan in enumerate(scans):
        pose, labels, hits = (topics[f"/ground_truth/{t}"][i] for t in ("lidar_pose", "labels", "hits"))
        stamp = scan.header.stamp
        assert stamp == pose.header.stamp == labels.header.stamp == hits.header.stamp
        p, q = pose.pose.position, pose.pose.orientation
        assert abs(poses[i, 0] - stamp.to_sec()) < 1e-6
        assert np.allclose(poses[i, 1:4], [p.x, p.y, p.z], atol=1e-8)
        assert abs(abs(poses[i, 4:] @ [q.x, q.y, q.z, q.w]) - 1) < 1e-9
        returns = cloud(labels, label="u1", branch="<i2", tree="<i2")
        assert len(returns) == scan.width * scan.height
        ns, count = struct.unpack_from("<qI", blob, at)
        assert (ns, count) == (stamp.to_nsec(), len(returns))
        at += 12
        for name, dtype in (("label", "u1"), ("branch", "<i2"), ("tree", "<i2")):
            values = np.frombuffer(blob, dtype, count, at)
            assert np.array_equal(values, returns[name])
            at += values.nbytes
        wood = returns[returns["branch"] >= 0]
        pairs, counts = np.unique(wood[["tree", "branch"]], return_counts=True)
        expected = [(int(t), int(b), int(n)) for (t, b), n in zip(pairs.tolist(), counts)]
        assert [tuple(h) for h in cloud(hits, tree="<i2", branch="<i2", hits="<u4").tolist()] == expected
        name = f"{stamp.secs}.{stamp.nsecs:09d}"
        assert [(int(r["tree"]), int(r["branch"]), int(r["hits"])) for r in rows if r["stamp"] == name] == expected
        assert np.all(returns["label"][returns["branch"] >= 0] == 2)
    assert at == len(blob)


def test_labels_and_ids_are_true_of_the_points(flight):
    folder, topics = flight
    scene = yaml.safe_load((folder / "f.truth/scene.yaml").read_text())
    assert [t["name"] for t in scene["trees"]] == ["first", "second"]
    assert [b["id"] for b in scene["trees"][0]["branches"]] == [7, 2, 5]
    points, labels = topics["/velodyne_points"][0], topics["/ground_truth/labels"][0]
    pose = topics["/ground_truth/lidar_pose"][0].pose
    R = rotation([pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w])
    xyz = cloud(points, x="<f4", y="<f4", z="<f4")
    # The sensor rests in the first revolution but for its sway (a degree or two).
    p = np.column_stack([xyz[n] for n in "xyz"]) @ R.T + [pose.position.x, pose.position.y, pose.position.z]
    truth = cloud(labels, label="u1", branch="<i2", tree="<i2")
    seen = set()
    for t, tree in enumerate(scene["trees"]):
        for branch in tree["branches"]:
            mine = p[(truth["tree"] == t) & (truth["branch"] == branch["id"])]
            if len(mine) == 0:
                continue
            seen.add((t, branch["id"]))
            a, b = np.array(branch["points"][0]), np.array(branch["points"][1])
            d = b[:3] - a[:3]
            s = np.clip((mine - a[:3]) @ d / (d @ d), 0, 1)
            off = np.linalg.norm(mine - a[:3] - s[:, None] * d, axis=1)
            assert np.all(np.abs(off - (a[3] + s * (b[3] - a[3]))) < 0.05), (t, branch["id"])
    assert seen == {(0, 5), (0, 2), (0, 7), (1, 0), (1, 1)}
    assert np.all(np.abs(p[truth["label"] == 1][:, 2]) < 0.4)
    others = p[truth["label"] == 4]
    for low, high in (((2, -2, 0), (3, -1, 1)), ((2, 2, 0), (2.5, 2.5, 0.5)), ((-5.2, -2, 0), (-4.8, 2, 3))):
        inside = np.all((others > np.array(low) - 0.15) & (others < np.array(high) + 0.15), axis=1)
        assert inside.sum() > 20, (low, inside.sum())
        others = others[~inside]
    assert len(others) == 0


def test_the_trees_come_with_their_ids_and_parents(flight):
    _, topics = flight
    tree_map, = topics["/ground_truth/tree_map"]
    parents = {b.id: b.parent_id for b in tree_map.branches}
    # The second tree's ids follow the first's largest, 7.
    assert list(parents) == [2, 5, 7, 8, 9]
    assert (parents[7], parents[2], parents[9]) == (2, 5, 8)
    assert [t.trunk_branch_id for t in tree_map.trees] == [5, 8]
    assert {c.branch_id for c in tree_map.cylinders} == set(parents)


def test_a_real_tree_can_be_flown_around(tmp_path):
    file = SHARED / "trees/itsme_tree_1_pc.txt"
    if not file.exists():
        pytest.skip(f"{file} is not here")
    xyz = np.loadtxt(file, usecols=(0, 1, 2), skiprows=1)
    base = xyz[np.argmin(xyz[:, 2])]
    scene = (f"frame: map\nground: {{type: plane, z: 0}}\nclouds: [{{file: {file}, label: wood, point_radius_m: 0.03, "
             f"position: [{-base[0]}, {-base[1]}, {-base[2]}]}}]\n")
    topics = simulate(tmp_path, scene, "--duration", "1")
    near = 0
    for points, labels in zip(topics["/velodyne_points"], topics["/ground_truth/labels"]):
        truth = cloud(labels, label="u1", branch="<i2", tree="<i2")
        xyz = cloud(points, x="<f4", y="<f4", z="<f4")
        wood = xyz[truth["label"] == 2]
        # The stem stands 5.7 m away, at the corner's other end of the diagonal.
        near += int(np.sum(np.abs(np.hypot(wood["x"], wood["y"]) - 5.66) < 0.6))
        assert np.all(truth["branch"] == -1)
    assert near > 200, near


if __name__ == "__main__":
    sys.exit(pytest.main([__file__, "-q", "-p", "no:cacheprovider"]))
