"""Readers of map directories and of the truth that simulate_bag writes."""

import csv
import json
import os
import struct

import numpy as np
import yaml

from .errors import InputError
from .geometry import Chain, pose_matrix


def parse_stamp(text):
    """Seconds with decimals to integer nanoseconds, exactly."""
    text = text.strip()
    sign = -1 if text.startswith("-") else 1
    whole, _, fraction = text.lstrip("+-").partition(".")
    return sign * (int(whole) * 1_000_000_000 + int((fraction + "0" * 9)[:9]))


def read_csv(path, required):
    """Rows of a table with a header as dictionaries. Names the file and the missing column or bad line."""
    try:
        with open(path, newline="", encoding="utf-8") as stream:
            reader = csv.DictReader(stream)
            header = reader.fieldnames or []
            missing = [c for c in required if c not in header]
            if missing:
                raise InputError(f"{path}: line 1: no column {', '.join(missing)}")
            rows = []
            for row in reader:
                if None in row or None in row.values():
                    raise InputError(f"{path}: line {reader.line_num}: expected {len(header)} fields")
                rows.append(row)
            return rows
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file") from None


def read_trajectory(path):
    """TUM file: {stamp_ns: 4x4 T_map_lidar}, in the order of the file."""
    poses = {}
    try:
        with open(path, encoding="utf-8") as stream:
            for number, line in enumerate(stream, 1):
                fields = line.split()
                if not fields or fields[0].startswith("#"):
                    continue
                try:
                    values = [float(f) for f in fields[1:]]
                    if len(values) != 7 or not np.all(np.isfinite(values)):
                        raise ValueError
                    poses[parse_stamp(fields[0])] = pose_matrix(*values)
                except ValueError:
                    raise InputError(
                        f"{path}: line {number}: expected 'stamp x y z qx qy qz qw'") from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    return poses


class Branch:
    """One branch of the map or of the truth."""

    def __init__(self, key, tree, parent, chain, order=None):
        self.key = key          # unique
        self.tree = tree
        self.parent = parent    # key of the parent or None
        self.chain = chain
        self.order = order
        self.measured = None    # (n,) bool per frustum, map only
        self.sigma = None       # (n,) radius sigma [m], map only
        self.rows = None        # rows of cylinders.csv, map only


class MapDirectory:
    """What a map directory holds. Missing files leave None with a reason in `missing`."""

    CYLINDER_COLUMNS = (
        "tree_id branch_id cylinder_id parent_cylinder_id branch_order position_in_branch start_x start_y "
        "start_z end_x end_y end_z length_m radius_m radius_sigma_m taper_m_per_m status").split()

    def __init__(self, path):
        self.path = path
        if not os.path.isdir(path):
            raise InputError(f"{path}: no such map directory")
        self.missing = {}
        self.branches = self._read_branches()
        self.branch_rows = self._optional("branches.csv", lambda p: read_csv(p, ["branch_id", "length_m"]))
        self.trees = self._optional("trees.csv", lambda p: read_csv(p, ["tree_id", "dbh_m", "height_m"]))
        self.trajectory = self._optional("trajectory.tum", read_trajectory)
        self.timing = self._optional("timing.json", self._read_json)
        self._document = None

    def file(self, name):
        return os.path.join(self.path, name)

    def document(self):
        """tree_map.json, or None where it is missing. Read when first asked for: it can be large."""
        if self._document is None:
            self._document = self._optional("tree_map.json", self._read_json) or {}
        return self._document or None

    def directions_seen(self):
        """{branch id: [(length [m], axis (3,), seen (36,) bool)]} of the measured cylinders, or None.

        The bins are 10 degrees each around the landmark's axis, from the first vector of
        perpendicular_basis(axis).
        """
        document = self.document()
        if document is None:
            return None
        try:
            landmarks = {m["id"]: (np.array(m["axis"], float), np.array([c == "1" for c in m["arc_seen"]]))
                         for m in document["landmarks"]}
            # bitset text: bin 0 is the last digit
            result = {}
            for c in document["cylinders"]:
                if c["landmark_id"] not in landmarks:
                    continue
                axis, seen = landmarks[c["landmark_id"]]
                length = float(np.linalg.norm(np.subtract(c["end"], c["start"])))
                result.setdefault(c["branch_id"], []).append((length, axis, seen[::-1]))
            return result
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{self.file('tree_map.json')}: {error!r}") from None

    def _optional(self, name, reader):
        path = self.file(name)
        if not os.path.exists(path):
            self.missing[name] = f"{name} is not in the map directory"
            return None
        return reader(path)

    @staticmethod
    def _read_json(path):
        try:
            with open(path, encoding="utf-8") as stream:
                return json.load(stream)
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: {error}") from None

    def _read_branches(self):
        path = self.file("cylinders.csv")
        if not os.path.exists(path):
            self.missing["cylinders.csv"] = "cylinders.csv is not in the map directory"
            return None
        by_branch = {}
        branch_of = {}
        for line, row in enumerate(read_csv(path, self.CYLINDER_COLUMNS), 2):
            try:
                cylinder = {
                    "line": line,
                    "id": int(row["cylinder_id"]),
                    "branch": int(row["branch_id"]),
                    "tree": int(row["tree_id"]) if row["tree_id"] else None,
                    "parent": int(row["parent_cylinder_id"]) if row["parent_cylinder_id"] else None,
                    "order": int(row["branch_order"]),
                    "position": int(row["position_in_branch"]),
                    "start": [float(row[f"start_{a}"]) for a in "xyz"],
                    "end": [float(row[f"end_{a}"]) for a in "xyz"],
                    "radius": float(row["radius_m"]),
                    "sigma": float(row["radius_sigma_m"]),
                    "taper": float(row["taper_m_per_m"]),
                    "length": float(row["length_m"]),
                    "status": row["status"],
                    "arc": float(row.get("visible_arc_deg") or "nan"),
                }
            except ValueError as error:
                raise InputError(f"{path}: line {line}: {error}") from None
            by_branch.setdefault(cylinder["branch"], []).append(cylinder)
            branch_of[cylinder["id"]] = cylinder["branch"]
        branches = []
        for key in sorted(by_branch):
            rows = sorted(by_branch[key], key=lambda c: c["position"])
            parent = rows[0]["parent"]
            half = [0.5 * c["taper"] * c["length"] for c in rows]
            branch = Branch(
                key, rows[0]["tree"], branch_of.get(parent) if parent is not None else None,
                Chain([c["start"] for c in rows], [c["end"] for c in rows],
                      [max(0.0, c["radius"] - h) for c, h in zip(rows, half)],
                      [max(0.0, c["radius"] + h) for c, h in zip(rows, half)]), rows[0]["order"])
            branch.measured = np.array([c["status"] == "MEASURED" for c in rows])
            branch.sigma = np.array([c["sigma"] for c in rows])
            branch.rows = rows
            branches.append(branch)
        return branches


class Truth:
    """A truth folder: scene.yaml, trajectory.tum, hits.csv, labels.bin; a missing file leaves None.

    A branch's key is (tree index, branch id).
    """

    def __init__(self, path):
        self.path = path
        if not os.path.isdir(path):
            raise InputError(f"{path}: no such truth directory")
        self.missing = {}
        self.tree_names, self.branches, self.ground = None, None, None
        scene = self.file("scene.yaml")
        if os.path.exists(scene):
            self.tree_names, self.branches, self.ground = read_scene(scene)
        else:
            self.missing["scene.yaml"] = "scene.yaml is not in the truth directory"
        self.trajectory, self.hits = None, None
        if os.path.exists(self.file("trajectory.tum")):
            self.trajectory = read_trajectory(self.file("trajectory.tum"))
        else:
            self.missing["trajectory.tum"] = "trajectory.tum is not in the truth directory"
        if os.path.exists(self.file("hits.csv")):
            self.hits = self._read_hits(self.file("hits.csv"))
        else:
            self.missing["hits.csv"] = "hits.csv is not in the truth directory"

    def file(self, name):
        return os.path.join(self.path, name)

    @staticmethod
    def _read_hits(path):
        """{(tree, branch): [returns per scan]}"""
        hits = {}
        for line, row in enumerate(read_csv(path, ["stamp", "tree", "branch", "hits"]), 2):
            try:
                hits.setdefault((int(row["tree"]), int(row["branch"])), []).append(int(row["hits"]))
            except ValueError as error:
                raise InputError(f"{path}: line {line}: {error}") from None
        return hits


def read_scene(path):
    """(tree names, branches, ground) of a scene file."""
    try:
        with open(path, encoding="utf-8") as stream:
            scene = yaml.load(stream, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except yaml.YAMLError as error:
        raise InputError(f"{path}: {' '.join(str(error).split())}") from None
    names, branches = [], []
    for t, tree in enumerate((scene or {}).get("trees") or []):
        names.append(tree.get("name", f"tree_{t}"))
        parents = {}
        for entry in tree.get("branches") or []:
            try:
                parent = entry.get("parent")
                parents[entry["id"]] = parent
                branches.append(Branch((t, entry["id"]), t, None if parent is None else (t, parent),
                                       Chain.from_points(entry["points"])))
            except (KeyError, TypeError, ValueError, IndexError):
                raise InputError(f"{path}: tree {t}: branch {entry!r:.60} is not id, parent, points") from None
    by_key = {b.key: b for b in branches}
    for branch in branches:
        branch.order, above = 0, branch
        while above.parent is not None:
            if above.parent not in by_key or branch.order > len(branches):
                raise InputError(f"{path}: branch {above.key[1]}: parent {above.parent[1]} does not exist")
            above = by_key[above.parent]
            branch.order += 1
    return names, branches, (scene or {}).get("ground")


def read_label_file(path, magic, ids):
    """{stamp_ns: arrays} of labels.bin (ids: also branch and tree ids) or scan_labels.bin."""
    with open(path, "rb") as stream:
        data = stream.read()
    if data[:8] != magic:
        raise InputError(f"{path}: does not begin with {magic.decode()}")
    scans, at = {}, 8
    while at < len(data):
        if at + 12 > len(data):
            raise InputError(f"{path}: cut off at byte {at}")
        stamp, count = struct.unpack_from("<qI", data, at)
        at += 12
        size = count * (5 if ids else 1)
        if at + size > len(data):
            raise InputError(f"{path}: cut off at byte {at}")
        scan = {"label": np.frombuffer(data, np.uint8, count, at)}
        if ids:
            scan["branch"] = np.frombuffer(data, "<i2", count, at + count)
            scan["tree"] = np.frombuffer(data, "<i2", count, at + 3 * count)
        scans[stamp] = scan
        at += size
    return scans


def read_segment_file(path):
    """{stamp_ns: {"segment": int32, "range": float32}} of scan_segments.bin."""
    with open(path, "rb") as stream:
        data = stream.read()
    if data[:8] != b"DSSEGMT1":
        raise InputError(f"{path}: does not begin with DSSEGMT1")
    scans, at = {}, 8
    while at < len(data):
        if at + 12 > len(data):
            raise InputError(f"{path}: cut off at byte {at}")
        stamp, count = struct.unpack_from("<qI", data, at)
        at += 12
        if at + 8 * count > len(data):
            raise InputError(f"{path}: cut off at byte {at}")
        scans[stamp] = {"segment": np.frombuffer(data, "<i4", count, at),
                        "range": np.frombuffer(data, "<f4", count, at + 4 * count)}
        at += 8 * count
    return scans
