"""export_map: every format is read back by an independent reader and agrees with the map's own tables."""

import csv
import json
import math
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import scipy.io
import scipy.spatial

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))

import oracles  # noqa: E402

BUILD = os.environ.get("DENDRO_BUILD_DIR") or os.path.join(
    os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))), "build")
EXPORT = os.path.join(BUILD, "devel", "lib", "dendro_slam", "export_map")
MAKE = os.path.join(BUILD, "test", "make_test_map")


# Two trees and a piece on its own; one cylinder; none; 240 trees of 50 cylinders; one tree of 10 000.
KINDS = ("small", "one", "empty", "big", "tall")


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    root = tmp_path_factory.mktemp("maps")
    for kind in KINDS:
        subprocess.run([MAKE, str(root / kind), kind], check=True, stdout=subprocess.DEVNULL)
    return root


def export(map_dir, fmt, output, *arguments, expect=0):
    result = subprocess.run([EXPORT, str(map_dir), "-f", fmt, "-o", str(output), *arguments],
                            capture_output=True, text=True, check=False)
    assert result.returncode == expect, result.stderr
    return result.stdout if expect == 0 else result.stderr


def rows(path):
    with open(path, newline="") as stream:
        return list(csv.DictReader(stream))


def table(map_dir, name, tree=None):
    return [r for r in rows(map_dir / name) if tree is None or r["tree_id"] == str(tree)]


def frustum(row):
    r, half = float(row["radius_m"]), 0.5 * float(row["taper_m_per_m"]) * float(row["length_m"])
    a, b = r - half, r + half
    return math.pi * float(row["length_m"]) / 3 * (a * a + a * b + b * b)


def same_points(a, b, tolerance=1e-5):
    """The same points in any order, to the tables' last digit."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    return a.shape == b.shape and np.all(scipy.spatial.cKDTree(a).query(b)[0] < tolerance) and \
        np.all(scipy.spatial.cKDTree(b).query(a)[0] < tolerance)


def check_qsm(path, map_dir, tree):
    """A TreeQSM file against our tables, read by SciPy."""
    qsm = scipy.io.loadmat(path)["QSM"][0, 0]
    cylinder = {n: qsm["cylinder"][0, 0][n] for n in qsm["cylinder"][0, 0].dtype.names}
    branch = {n: qsm["branch"][0, 0][n] for n in qsm["branch"][0, 0].dtype.names}
    data = {n: qsm["treedata"][0, 0][n] for n in qsm["treedata"][0, 0].dtype.names}
    ours = table(map_dir, "cylinders.csv", tree)
    n = len(ours)
    assert all(cylinder[k].shape == (n, 3 if k in ("start", "axis") else 1) for k in cylinder)
    parent, extension = cylinder["parent"][:, 0], cylinder["extension"][:, 0]
    assert (parent == 0).sum() == 1 and parent[0] == 0  # one connected tree
    assert np.all(parent < np.arange(1, n + 1))
    for i in range(n):
        if extension[i] > 0:
            assert extension[i] == i + 2 and parent[i + 1] == i + 1
            assert cylinder["branch"][i, 0] == cylinder["branch"][i + 1, 0]
    assert np.allclose(np.linalg.norm(cylinder["axis"], axis=1), 1.0)
    # Every one of our cylinders is there, by its start.
    assert same_points(cylinder["start"], [[float(r[f"start_{a}"]) for a in "xyz"] for r in ours])
    assert cylinder["radius"].sum() == pytest.approx(sum(float(r["radius_m"]) for r in ours), rel=1e-5)
    assert cylinder["added"].sum() == sum(r["status"] != "MEASURED" for r in ours)
    branches = table(map_dir, "branches.csv", tree)
    assert branch["order"].shape == (len(branches), 1)
    assert branch["order"][0, 0] == 0 and branch["parent"][0, 0] == 0
    assert cylinder["branch"].max() == len(branches)
    volume = 1000 * sum(frustum(r) for r in ours)
    assert data["TotalVolume"][0, 0] == pytest.approx(volume, rel=1e-4)
    assert data["TrunkVolume"][0, 0] + data["BranchVolume"][0, 0] == pytest.approx(data["TotalVolume"][0, 0])
    assert branch["volume"].sum() == pytest.approx(volume, rel=1e-4)
    assert data["NumberBranches"][0, 0] == len(branches) - 1
    row = table(map_dir, "trees.csv", tree)[0]
    assert data["TreeHeight"][0, 0] == pytest.approx(float(row["height_m"]), abs=1e-5)
    if row["dbh_m"]:
        assert data["DBHcyl"][0, 0] == pytest.approx(float(row["dbh_m"]), abs=1e-5)
        assert data["DBHqsm"][0, 0] == pytest.approx(float(row["dbh_m"]), abs=0.02)
    assert data["StemTaper"].shape[0] == 2
    assert np.all(np.diff(data["StemTaper"][0]) > 0)
    return cylinder, branch, data


def test_treeqsm_mat(maps, tmp_path):
    message = export(maps / "small", "treeqsm-mat", tmp_path / "qsm.mat")
    assert "2 files" in message and "attached to no tree" in message
    _, _, data = check_qsm(tmp_path / "qsm_0.mat", maps / "small", 0)
    check_qsm(tmp_path / "qsm_1.mat", maps / "small", 1)
    # The trunk is the frustum 0.2 to 0.1 m over 5 m.
    assert data["TrunkVolume"][0, 0] == pytest.approx(1000 * math.pi * 5 / 3 * (0.04 + 0.02 + 0.01), rel=0.01)
    assert data["TrunkLength"][0, 0] == pytest.approx(5.0, abs=1e-6)
    assert data["CrownAreaConv"][0, 0] > 1.0
    export(maps / "small", "treeqsm-mat", tmp_path / "one.mat", "--tree", "1")
    assert (tmp_path / "one.mat").read_bytes() == (tmp_path / "qsm_1.mat").read_bytes()


def test_members_are_those_of_a_real_treeqsm_file(maps, tmp_path):
    real = os.path.join(os.environ.get("DENDRO_SHARED_DATA", ""), "trees", "itsme_tree_1_qsm.mat")
    if not os.path.exists(real):
        pytest.skip("no real TreeQSM file: DENDRO_SHARED_DATA is not there")
    export(maps / "one", "treeqsm-mat", tmp_path / "q.mat")
    theirs, ours = (scipy.io.loadmat(p)["QSM"][0, 0] for p in (real, tmp_path / "q.mat"))
    for part in ("cylinder", "branch"):
        assert set(ours[part][0, 0].dtype.names) == set(theirs[part][0, 0].dtype.names)
    assert set(ours["treedata"][0, 0].dtype.names) <= set(theirs["treedata"][0, 0].dtype.names)


def test_treeqsm_text(maps, tmp_path):
    export(maps / "small", "treeqsm-txt", tmp_path / "cylinder_t.txt")
    lines = (tmp_path / "cylinder_t_0.txt").read_text().splitlines()
    assert len(lines[0].split("\t")) == 13
    values = np.array([[float(v) for v in line.split("\t")] for line in lines[1:]])
    ours = table(maps / "small", "cylinders.csv", 0)
    assert values.shape == (len(ours), 17)
    assert values[:, 1].sum() == pytest.approx(sum(float(r["length_m"]) for r in ours), abs=1e-3)
    assert values[0, 8] == 0 and values[0, 10] == 1 and values[0, 11] == 0
    # rTwig: within a branch the parent is id - 1.
    ids = np.arange(1, len(values) + 1)
    inside = values[:, 12] > 1
    assert np.all(values[inside, 8] == ids[inside] - 1)


def test_simpleforest(maps, tmp_path):
    export(maps / "small", "simpleforest", tmp_path / "sf.csv", "--tree", "0")
    theirs, ours = rows(tmp_path / "sf.csv"), table(maps / "small", "cylinders.csv", 0)
    assert list(theirs[0]) == ("ID,parentID,startX,startY,startZ,endX,endY,endZ,radius,length,growthLength,"
                               "averagePointDistance,segmentID,parentSegmentID,branchOrder,"
                               "reverseBranchOrder,branchID").split(",")
    assert len(theirs) == len(ours)
    total = sum(float(r["length_m"]) for r in ours)
    assert float(theirs[0]["growthLength"]) == pytest.approx(total, abs=1e-4)
    assert [r["parentID"] for r in theirs].count("-1") == 1
    by_id = {r["ID"]: r for r in theirs}
    for r in theirs[1:]:
        parent = by_id[r["parentID"]]
        assert float(parent["growthLength"]) > float(r["growthLength"])
        if r["segmentID"] != parent["segmentID"]:
            assert r["parentSegmentID"] == parent["segmentID"]
        assert int(parent["reverseBranchOrder"]) >= int(r["reverseBranchOrder"])
    assert theirs[0]["reverseBranchOrder"] == "3"  # trunk, branch, twig
    assert {r["branchID"] for r in theirs} == {r["branch_id"] for r in ours}


def test_raycloudtools(maps, tmp_path):
    message = export(maps / "small", "raycloudtools", tmp_path / "t.txt")
    assert "left out" in message
    lines = [line for line in (tmp_path / "t.txt").read_text().splitlines() if not line.startswith("#")]
    assert lines[0] == "x,y,z,radius,parent_id,section_id"
    assert len(lines) == 3
    for tree, line in enumerate(lines[1:]):
        segments = [[float(v) for v in s.split(",")] for s in line.split(", ")]
        ours = table(maps / "small", "cylinders.csv", tree)
        assert len(segments) == len(ours) + 1
        assert segments[0][4] == -1
        assert all(0 <= s[4] < i for i, s in enumerate(segments) if i)
        assert same_points([s[:3] for s in segments[1:]],
                           [[float(r[f"end_{a}"]) for a in "xyz"] for r in ours])
        trunk = [s for s in segments[1:] if s[5] == 0]
        length = sum(math.dist(s[:3], segments[int(s[4])][:3]) for s in trunk)
        assert length == pytest.approx(5.0, abs=1e-4)


def test_treeloc(maps, tmp_path):
    export(maps / "small", "treeloc", tmp_path / "loc", "--every", "10")
    assert sorted(os.listdir(tmp_path / "loc")) == ["TreeManagerState_0.csv", "TreeManagerState_1.csv",
                                                     "TreeManagerState_2.csv", "trajectory.txt"]
    poses = np.loadtxt(tmp_path / "loc" / "trajectory.txt")
    assert poses.shape == (3, 8) and poses[1, 0] == pytest.approx(2.0)
    trees = table(maps / "small", "trees.csv")
    for pose, index in zip(poses, range(3)):
        state = rows(tmp_path / "loc" / f"TreeManagerState_{index}.csv")
        assert len(state) == 2
        yaw = 2 * math.atan2(pose[6], pose[7])
        for ours, row in zip(trees, state):
            p = np.array([float(row[f"location_{a}"]) for a in "xyz"])
            R = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
            assert np.allclose(R @ p + pose[1:4], [float(ours[a]) for a in "xyz"], atol=1e-5)
            axes = np.array([[float(row[f"axis_{r}{c}"]) for c in range(3)] for r in range(3)])
            assert np.allclose(axes @ axes.T, np.eye(3), atol=1e-5)
            assert axes[2, 2] == pytest.approx(1.0, abs=1e-5)  # upright trunks
            assert float(row["dbh"]) == pytest.approx(float(ours["dbh_m"]), abs=1e-5)


def read_ply(path):
    """A small PLY reader of its own: (vertices (n, 3), colours (n, 3), faces (m, 3))."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + 11
    header = data[:end].decode().splitlines()
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    n, m = (int(next(h for h in header if h.startswith(f"element {k}")).split()[2]) for k in ("vertex", "face"))
    vertices = np.frombuffer(data, np.dtype([("p", "<f4", 3), ("c", "u1", 3)]), n, end)
    faces = np.frombuffer(data, np.dtype([("n", "u1"), ("v", "<i4", 3)]), m, end + 15 * n)
    assert len(data) == end + 15 * n + 13 * m
    assert m == 0 or (np.all(faces["n"] == 3) and faces["v"].min() >= 0 and faces["v"].max() < n)
    return vertices["p"], vertices["c"], faces["v"]


@pytest.mark.parametrize("fmt", ["ply-branch", "ply-order", "ply-sigma"])
def test_ply(maps, tmp_path, fmt):
    export(maps / "small", fmt, tmp_path / "m.ply")
    vertices, colors, faces = read_ply(tmp_path / "m.ply")
    ours = table(maps / "small", "cylinders.csv")
    assert len(vertices) == 26 * len(ours)
    a, b, c = (vertices[faces[:, k]].astype(float) for k in range(3))
    volume = float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)
    # A 12-gon has 6 / pi sin(30 degrees) of its circle's area.
    assert volume == pytest.approx(sum(frustum(r) for r in ours) * 6 / math.pi * 0.5, rel=1e-3)
    assert len(np.unique(colors, axis=0)) >= 2
    if fmt == "ply-branch":
        assert (maps / "small" / "tree.ply").read_bytes() == (tmp_path / "m.ply").read_bytes()


POINTS = np.dtype([("p", "<f8", 3), ("label", "u1"), ("tree", "<i4"), ("branch", "<i4")])


def read_points(path):
    """ply-points, by a reader of its own."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + 11
    header = data[:end].decode().splitlines()
    assert [h.split()[-1] for h in header if h.startswith("property")] == [
        "x", "y", "z", "label", "tree_id", "branch_id"]
    n = int(next(h for h in header if h.startswith("element vertex")).split()[2])
    assert len(data) == end + n * POINTS.itemsize
    return np.frombuffer(data, POINTS, n, end)


@pytest.mark.parametrize("kind", KINDS)
def test_las_and_ply_points(maps, tmp_path, kind):
    export(maps / kind, "ply-points", tmp_path / "p.ply")
    points = read_points(tmp_path / "p.ply")
    cylinders = table(maps / kind, "cylinders.csv")
    expected = {"small": 20 * len(cylinders) + 500 * 7, "big": 20 * len(cylinders),
                "tall": 20 * len(cylinders)}.get(kind, 0)
    assert len(points) == expected
    if kind == "small":
        # Wood points lie on their branch's surface; every branch has its twenty per cylinder.
        wood = points[points["label"] == 2]
        of_branch = {b: (wood["branch"] == b).sum() for b in np.unique(wood["branch"])}
        assert -1 not in of_branch
        for branch in {int(r["branch_id"]) for r in cylinders}:
            count = 20 * sum(int(r["branch_id"]) == branch for r in cylinders)
            assert of_branch[branch] == pytest.approx(count, abs=0.1 * count + 4)
        # What hangs on no tree has a branch but no tree.
        loose = {int(r["branch_id"]) for r in cylinders if r["tree_id"] == ""}
        assert loose and all((wood["tree"][wood["branch"] == b] == -1).all() for b in loose)
        leaves = points[points["label"] == 3]
        assert len(leaves) == 3500 and (leaves["branch"] == -1).all() and set(leaves["tree"]) == {0, 1}
    laspy = oracles.require("laspy")
    export(maps / kind, "las", tmp_path / "p.las")
    las = laspy.read(tmp_path / "p.las")
    assert str(las.header.version) == "1.4" and las.header.point_format.id == 6
    assert las.header.point_count == len(las.points) == len(points)
    assert np.allclose(las.xyz.reshape(-1, 3), points["p"], atol=0.51e-4)
    assert np.array_equal(las["tree_id"], points["tree"])
    assert np.array_equal(las["branch_id"], points["branch"])
    assert np.array_equal(np.asarray(las.classification), np.where(points["label"] == 2, 64, 5))
    if len(points):
        assert np.allclose(las.header.maxs, points["p"].max(axis=0), atol=1e-3)
        assert np.allclose(las.header.mins, points["p"].min(axis=0), atol=1e-3)
    assert las.header.number_of_points_by_return[0] == len(points)


def metres_between(a, b):
    """East and north from a to b (longitude, latitude), by the geodesic's chord: both to ECEF and back."""
    def ecef(longitude, latitude):
        e2, lo, la = 6.69437999014e-3, math.radians(longitude), math.radians(latitude)
        n = 6378137.0 / math.sqrt(1 - e2 * math.sin(la) ** 2)
        return np.array([n * math.cos(la) * math.cos(lo), n * math.cos(la) * math.sin(lo), n * (1 - e2) * math.sin(la)])
    lo, la = math.radians(a[0]), math.radians(a[1])
    d = ecef(*b[:2]) - ecef(*a[:2])
    return (d @ [-math.sin(lo), math.cos(lo), 0],
            d @ [-math.sin(la) * math.cos(lo), -math.sin(la) * math.sin(lo), math.cos(la)])


@pytest.mark.parametrize("kind", KINDS)
def test_geojson(maps, tmp_path, kind):
    # The map's x axis points 30 degrees east of north.
    export(maps / kind, "geojson", tmp_path / "m.json", "--georeference", "33.4214,-111.9280,30,350")
    with open(tmp_path / "m.json") as stream:
        document = json.load(stream)
    assert document["type"] == "FeatureCollection"
    trees = [f for f in document["features"] if f["geometry"]["type"] == "Point"]
    branches = [f for f in document["features"] if f["geometry"]["type"] == "LineString"]
    ours = table(maps / kind, "trees.csv")
    assert len(trees) == len(ours) and len(branches) == len(table(maps / kind, "branches.csv"))
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    for feature, row in zip(trees, ours):
        x, y, z = (float(row[a]) for a in "xyz")
        east, north = metres_between((-111.9280, 33.4214), feature["geometry"]["coordinates"])
        # x runs 30 degrees east of north, y is to the left of it: 60 degrees west of north.
        assert east == pytest.approx(x * s - y * c, abs=0.01)
        assert north == pytest.approx(x * c + y * s, abs=0.01)
        # The map's plane touches the ellipsoid at the origin, so heights above it grow with the distance.
        height = 350 + z + (east ** 2 + north ** 2) / (2 * 6.37e6)
        assert feature["geometry"]["coordinates"][2] == pytest.approx(height, abs=1e-3)
        assert str(feature["properties"]["tree_id"]) == row["tree_id"]
        assert feature["properties"]["dbh_m"] == pytest.approx(float(row["dbh_m"] or "nan"), abs=1e-6) \
            or not row["dbh_m"]
    cylinders = table(maps / kind, "cylinders.csv")
    for feature in branches:
        own = [r for r in cylinders if int(r["branch_id"]) == feature["properties"]["branch_id"]]
        assert len(feature["geometry"]["coordinates"]) == len(own) + 1
        assert feature["properties"]["tree_id"] == (int(own[0]["tree_id"]) if own[0]["tree_id"] else None)


def test_geojson_of_a_map_with_fixes(maps, tmp_path):
    with open(maps / "small" / "tree_map.json") as stream:
        document = json.load(stream)
    del document["checksum"]  # The map is changed by hand here.
    place = {"latitude_deg": 33.4214, "longitude_deg": -111.928, "altitude_m": None, "heading_deg": 30.0,
             "heading_sigma_deg": 2.0, "horizontal_sigma_m": 0.5, "vertical_sigma_m": 0.0, "pivot": [1.0, -2.0],
             "num_fixes": 40, "num_outliers": 0, "residual_m": 0.6, "span_m": 12.0, "note": ""}

    def exported(name, **changes):
        own = tmp_path / name
        shutil.copytree(maps / "small", own)
        with open(own / "tree_map.json", "w") as stream:
            json.dump(dict(document, georeference=dict(place, **changes)), stream)
        export(own, "geojson", own / "m.json")
        with open(own / "m.json") as stream:
            features = json.load(stream)["features"]
        return ([f for f in features if f["properties"]["kind"] == "tree"],
                [f for f in features if f["properties"]["kind"] == "branch"])

    trees, branches = exported("known")
    rows = table(maps / "small", "trees.csv")
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    for feature, row in zip(trees, rows):
        x, y = float(row["x"]), float(row["y"])
        at = feature["geometry"]["coordinates"]
        assert len(at) == 2  # No altitude was known.
        east, north = metres_between((-111.928, 33.4214), at)
        assert (east, north) == (pytest.approx(x * s - y * c, abs=0.01), pytest.approx(x * c + y * s, abs=0.01))
        swing = math.hypot(x - 1, y + 2) * math.radians(2)
        assert feature["properties"]["position_sigma_m"] == pytest.approx(math.hypot(0.5, swing), abs=1e-4)
    assert all(f["geometry"]["type"] == "LineString" for f in branches) and branches

    # Without a heading nothing but the pivot's place is known.
    trees, branches = exported("no_heading", heading_deg=None, note="heading not known")
    assert all(f["geometry"] is None for f in branches) and branches
    for feature, row in zip(trees, rows):
        assert feature["geometry"]["coordinates"] == pytest.approx([-111.928, 33.4214], abs=1e-9)
        distance = math.hypot(float(row["x"]) - 1, float(row["y"]) + 2)
        assert feature["properties"]["position_sigma_m"] == pytest.approx(math.hypot(0.5, distance), abs=1e-4)


def test_geojson_needs_a_place(maps, tmp_path):
    assert "--georeference" in export(maps / "one", "geojson", tmp_path / "m.json", expect=2)
    message = export(maps / "one", "geojson", tmp_path / "m.json", "--georeference", "91,0,0", expect=2)
    assert "latitude_deg" in message and message.count("\n") == 1


def test_crown_columns(maps):
    trees = table(maps / "small", "trees.csv")
    for tree, spheres in zip(trees, (5, 2)):
        # Half-metre balls of leaves round the branches' tips, some of which touch.
        assert 0.3 * spheres < float(tree["crown_volume_m3"]) < 0.524 * spheres
        assert 0 < float(tree["crown_base_height_m"]) < float(tree["crown_top_height_m"]) < 6
        assert int(tree["crown_points"]) == 500 * spheres
    assert all(r["crown_volume_m3"] == "" for r in table(maps / "big", "trees.csv"))


def test_branches_and_trees_say_what_they_know(maps):
    cylinders = {r["cylinder_id"]: r for r in table(maps / "small", "cylinders.csv")}
    for branch in table(maps / "small", "branches.csv"):
        own = sorted((c for c in cylinders.values() if c["branch_id"] == branch["branch_id"]),
                     key=lambda c: int(c["position_in_branch"]))
        assert branch["base_status"] == own[0]["status"] and branch["tip_status"] == own[-1]["status"]
        inferred = sum(float(c["length_m"]) for c in own if c["status"] == "INFERRED")
        assert float(branch["inferred_length_m"]) == pytest.approx(inferred, abs=1e-5)
        assert float(branch["tip_diameter_sigma_m"]) == pytest.approx(2 * float(own[-1]["radius_sigma_m"]),
                                                                      abs=2e-6)
        assert float(branch["visible_arc_deg"]) == 180.0 and branch["num_scans"] == "10"
    assert {r["status"] for r in table(maps / "small", "trees.csv")} == {"MEASURED"}


def test_one_cylinder_and_none(maps, tmp_path):
    for kind in ("treeqsm-mat", "treeqsm-txt", "simpleforest", "raycloudtools", "ply-sigma", "json"):
        export(maps / "one", kind, tmp_path / kind)
    check_qsm(tmp_path / "treeqsm-mat", maps / "one", 0)
    assert len(rows(tmp_path / "simpleforest")) == 1
    assert "holds no tree" in export(maps / "empty", "treeqsm-mat", tmp_path / "none.mat", expect=2)
    assert not (tmp_path / "none.mat").exists()
    export(maps / "empty", "raycloudtools", tmp_path / "none.txt")
    export(maps / "empty", "ply-branch", tmp_path / "none.ply")
    assert len(read_ply(tmp_path / "none.ply")[0]) == 0
    assert "no tree 7" in export(maps / "one", "simpleforest", tmp_path / "x", "--tree", "7", expect=2)


def test_ten_thousand_cylinders(maps, tmp_path):
    ours = table(maps / "big", "cylinders.csv")
    assert len(ours) > 10000
    export(maps / "big", "raycloudtools", tmp_path / "t.txt")
    lines = (tmp_path / "t.txt").read_text().splitlines()[2:]
    assert len(lines) == 240
    assert sum(line.count(", ") for line in lines) == len(ours)
    export(maps / "big", "treeqsm-mat", tmp_path / "q.mat", "--tree", "239")
    check_qsm(tmp_path / "q.mat", maps / "big", 239)
    export(maps / "big", "ply-sigma", tmp_path / "m.ply")
    assert len(read_ply(tmp_path / "m.ply")[0]) == 26 * len(ours)


def starts_and_branches(fmt, path):
    """(starts (n, 3), lengths (n), branch of each (n), number of roots) of a tree's file, by its own rules."""
    if fmt == "treeqsm-mat":
        cylinder = scipy.io.loadmat(path)["QSM"][0, 0]["cylinder"][0, 0]
        return cylinder["start"], cylinder["length"][:, 0], cylinder["branch"][:, 0], (cylinder["parent"] == 0).sum()
    if fmt == "treeqsm-txt":
        values = np.loadtxt(path, skiprows=1, ndmin=2)
        return values[:, 2:5], values[:, 1], values[:, 10], (values[:, 8] == 0).sum()
    table_of = rows(path)
    return (np.array([[float(r[f"start{a}"]) for a in "XYZ"] for r in table_of]),
            np.array([float(r["length"]) for r in table_of]), np.array([int(r["branchID"]) for r in table_of]),
            [r["parentID"] for r in table_of].count("-1"))


@pytest.mark.parametrize("fmt", ["treeqsm-mat", "treeqsm-txt", "simpleforest"])
@pytest.mark.parametrize("kind", KINDS)
def test_every_tree_has_its_file_and_every_file_all_of_its_tree(maps, tmp_path, fmt, kind):
    trees = [int(r["tree_id"]) for r in table(maps / kind, "trees.csv")]
    if not trees:
        assert "holds no tree" in export(maps / kind, fmt, tmp_path / "t.x", expect=2)
        assert os.listdir(tmp_path) == []
        return
    message = export(maps / kind, fmt, tmp_path / "t.x")
    loose = sum(r["tree_id"] == "" for r in table(maps / kind, "cylinders.csv"))
    assert (f"{loose} cylinders that are attached to no tree" in message) == (loose > 0) == (kind == "small")
    assert len(os.listdir(tmp_path)) == len(trees)
    ours = {tree: [] for tree in trees}
    for row in table(maps / kind, "cylinders.csv"):
        if row["tree_id"]:
            ours[int(row["tree_id"])].append(row)
    for tree in trees:
        path = tmp_path / ("t.x" if len(trees) == 1 else f"t_{tree}.x")
        starts, lengths, branches, roots = starts_and_branches(fmt, path)
        assert roots == 1
        # The text has four digits.
        assert same_points(starts, [[float(r[f"start_{a}"]) for a in "xyz"] for r in ours[tree]],
                           1e-4 if fmt == "treeqsm-txt" else 1e-5)
        assert lengths.sum() == pytest.approx(sum(float(r["length_m"]) for r in ours[tree]), rel=1e-4)
        assert len(set(branches)) == len({r["branch_id"] for r in ours[tree]})
        if fmt == "simpleforest":
            assert set(branches) == {int(r["branch_id"]) for r in ours[tree]}


@pytest.mark.parametrize("kind", KINDS)
def test_formats_of_the_whole_map_hold_all_of_it(maps, tmp_path, kind):
    cylinders, trees = table(maps / kind, "cylinders.csv"), table(maps / kind, "trees.csv")
    attached = [r for r in cylinders if r["tree_id"]]
    message = export(maps / kind, "raycloudtools", tmp_path / "t.txt")
    assert ("left out" in message) == (len(attached) < len(cylinders))
    lines = [line for line in (tmp_path / "t.txt").read_text().splitlines() if not line.startswith("#")][1:]
    assert len(lines) == len(trees)
    segments = [[float(v) for v in s.split(",")] for line in lines for s in line.split(", ")]
    assert [s[4] for s in segments].count(-1) == len(trees)
    if attached:
        assert same_points([s[:3] for s in segments if s[4] >= 0],
                           [[float(r[f"end_{a}"]) for a in "xyz"] for r in attached])
    # The mesh also shows what is attached to no tree.
    for fmt in ("ply-branch", "ply-order", "ply-sigma"):
        export(maps / kind, fmt, tmp_path / "m.ply")
        vertices, _, faces = read_ply(tmp_path / "m.ply")
        assert len(vertices) == 26 * len(cylinders)
        a, b, c = (vertices[faces[:, k]].astype(float) for k in range(3))
        middle = vertices.mean(axis=0) if len(vertices) else 0.0
        volume = float(np.einsum("ij,ij->", a - middle, np.cross(b - middle, c - middle)) / 6)
        assert volume == pytest.approx(sum(frustum(r) for r in cylinders) * 6 / math.pi * 0.5, rel=2e-3)
    export(maps / kind, "treeloc", tmp_path / "loc", "--every", "20")
    states = sorted(p for p in os.listdir(tmp_path / "loc") if p.startswith("Tree"))
    assert len(states) == len(np.loadtxt(tmp_path / "loc" / "trajectory.txt", ndmin=2)) == 2
    for state in states:
        # A tree without DBH is there, not reconstructed.
        there = rows(tmp_path / "loc" / state)
        assert [float(r["dbh"]) for r in there] == pytest.approx([float(r["dbh_m"] or 0) for r in trees], abs=1e-5)
        assert [r["reconstructed"] for r in there] == ["1" if r["dbh_m"] else "0" for r in trees]
    export(maps / kind, "json", tmp_path / "map.json")
    document = json.loads((tmp_path / "map.json").read_text())
    assert [c["id"] for c in document["cylinders"]] == sorted(int(r["cylinder_id"]) for r in cylinders)
    assert len(document["branches"]) == len(table(maps / kind, "branches.csv"))
    assert sum(c["length_m"] if "length_m" in c else math.dist(c["start"], c["end"])
               for c in document["cylinders"]) == pytest.approx(sum(float(r["length_m"]) for r in cylinders), abs=1e-2)
    export(maps / kind, "csv", tmp_path / "tables")
    for name in ("cylinders.csv", "branches.csv", "trees.csv"):
        assert (tmp_path / "tables" / name).read_bytes() == (maps / kind / name).read_bytes()


def test_tables_and_json_come_back(maps, tmp_path):
    export(maps / "small", "csv", tmp_path / "tables")
    for name in ("cylinders.csv", "branches.csv", "trees.csv"):
        assert (tmp_path / "tables" / name).read_bytes() == (maps / "small" / name).read_bytes()
    export(maps / "small", "json", tmp_path / "tree_map.json")
    assert (tmp_path / "tree_map.json").read_bytes() == (maps / "small" / "tree_map.json").read_bytes()


def test_bad_use_is_one_line(maps, tmp_path):
    assert "tree_map.json" in export(tmp_path, "json", tmp_path / "x", expect=2)
    message = export(maps / "small", "json", "/proc/none/x", expect=2)
    assert message.count("\n") == 1
    result = subprocess.run([EXPORT, str(maps / "small"), "-f", "dwg", "-o", "x"], capture_output=True,
                            text=True, check=False)
    assert result.returncode != 0 and "dwg" in result.stderr
