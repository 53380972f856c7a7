"""Writes small map directories and truth folders whose scores are known by hand."""

import json
import math
import os
import struct

COLUMNS = ("tree_id,branch_id,cylinder_id,parent_cylinder_id,branch_order,position_in_branch,"
           "start_x,start_y,start_z,end_x,end_y,end_z,axis_x,axis_y,axis_z,length_m,radius_m,"
           "radius_sigma_m,taper_m_per_m,axis_sigma_deg,position_sigma_m,num_scans,num_points,"
           "visible_arc_deg,mad_m,status")

# A straight trunk of 4 m and two branches; x y z radius, the bases on the parent's axis.
TREE = {
    0: (None, [(0, 0, 0, 0.20), (0, 0, 4, 0.16)]),
    1: (0, [(0, 0, 2.0, 0.06), (2.0, 0, 4.0, 0.06)]),
    2: (0, [(0, 0, 3.0, 0.05), (0, -2.0, 3.0, 0.05)]),
}
# The map of it: branches begin at the trunk's surface.
MAP = {
    0: (None, 0, [(0, 0, 0, 0.20), (0, 0, 4, 0.16)]),
    1: (0, 1, [(0.18, 0, 2.18, 0.06), (2.0, 0, 4.0, 0.06)]),
    2: (0, 1, [(0, -0.17, 3.0, 0.05), (0, -2.0, 3.0, 0.05)]),
}


def write_truth(folder, tree=None, poses=12, hits=100, hidden=()):
    os.makedirs(folder, exist_ok=True)
    tree = tree or TREE
    lines = ["frame: map", "trees:", "  - name: test_tree", "    branches:"]
    for key, (parent, points) in tree.items():
        text = ", ".join("[" + ", ".join(str(float(v)) for v in p) + "]" for p in points)
        lines.append(f"      - {{id: {key}, parent: {'null' if parent is None else parent}, points: [{text}]}}")
    with open(os.path.join(folder, "scene.yaml"), "w") as stream:
        stream.write("\n".join(lines) + "\n")
    with open(os.path.join(folder, "trajectory.tum"), "w") as stream:
        for i in range(poses):
            stream.write(f"{i // 10}.{i % 10}00000000 5.0 {0.25 * i} 1.5 0 0 0 1\n")
    with open(os.path.join(folder, "hits.csv"), "w") as stream:
        stream.write("stamp,tree,branch,hits\n")
        for i in range(poses):
            for key in tree:
                if key not in hidden:
                    stream.write(f"{i // 10}.{i % 10}00000000,0,{key},{hits}\n")


def write_map(folder, branches=None, turn_deg=0.0, shift=(0.0, 0.0, 0.0), poses=12, drift_m=0.0,
              radius_add=0.0, sigma=0.002, status="MEASURED"):
    """A map in a frame that is turned about z and shifted against the truth's."""
    os.makedirs(folder, exist_ok=True)
    branches = branches or MAP
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))

    def move(p):
        return (c * p[0] - s * p[1] + shift[0], s * p[0] + c * p[1] + shift[1], p[2] + shift[2])

    first_of, rows, cylinder = {}, [], 0
    for key, (parent, order, points) in branches.items():
        before = first_of.get(parent, "")
        first_of[key] = cylinder
        for position, (a, b) in enumerate(zip(points, points[1:])):
            start, end = move(a), move(b)
            length = math.dist(start, end)
            axis = [(e - b0) / length for b0, e in zip(start, end)]
            rows.append([0, key, cylinder, before, order, position, *start, *end, *axis, length,
                         (a[3] + b[3]) / 2 + radius_add, sigma, (b[3] - a[3]) / length, 0.5, 0.005, 12,
                         500, 200.0, 0.01, status])
            before = cylinder
            cylinder += 1
    with open(os.path.join(folder, "cylinders.csv"), "w") as stream:
        stream.write(COLUMNS + "\n")
        for row in rows:
            stream.write(",".join(str(v) for v in row) + "\n")
    with open(os.path.join(folder, "branches.csv"), "w") as stream:
        stream.write("tree_id,branch_id,parent_branch_id,branch_order,num_cylinders,num_measured,"
                     "base_x,base_y,base_z,tip_x,tip_y,tip_z,length_m,base_diameter_m,"
                     "base_diameter_sigma_m,middle_diameter_m,tip_diameter_m,angle_deg,azimuth_deg,"
                     "zenith_deg,height_m\n")
        for key, (parent, order, points) in branches.items():
            base, tip = move(points[0]), move(points[-1])
            length = sum(math.dist(a[:3], b[:3]) for a, b in zip(points, points[1:]))
            zenith = math.degrees(math.acos((points[-1][2] - points[0][2]) / length))
            d = [2 * (points[i][3] + radius_add) for i in (0, len(points) // 2, -1)]
            values = [0, key, "" if parent is None else parent, order, len(points) - 1, len(points) - 1,
                      *base, *tip, length, d[0], 2 * sigma, d[1], d[2], "" if parent is None else zenith,
                      0.0, zenith, points[0][2]]
            stream.write(",".join(str(v) for v in values) + "\n")
    with open(os.path.join(folder, "trees.csv"), "w") as stream:
        stream.write("tree_id,x,y,z,dbh_m,dbh_sigma_m,dbh_height_m,height_m,num_branches,max_branch_order,"
                     "stem_volume_m3,wood_volume_m3_above_min_radius,min_radius_m,volume_sigma_m3,lean_deg,"
                     "arc_coverage_deg,num_scans,status\n")
        stream.write(f"0,0,0,0,{0.374 + 2 * radius_add},0.004,1.3,4.0,2,1,0.4,0.45,0.025,0.01,0,200,12,"
                     "MEASURED\n")
    half = math.radians(turn_deg) / 2
    with open(os.path.join(folder, "trajectory.tum"), "w") as stream:
        for i in range(poses):
            x, y, z = move((5.0 + drift_m * (i > 0), 0.25 * i, 1.5))
            stream.write(f"{i // 10}.{i % 10}00000000 {x!r} {y!r} {z!r} 0 0 {math.sin(half)!r} "
                         f"{math.cos(half)!r}\n")
    with open(os.path.join(folder, "timing.json"), "w") as stream:
        json.dump({"stages": {"segmentation": {"count": 12, "p50_ms": 10.0, "p99_ms": 20.0, "max_ms": 21.0,
                                               "total_ms": 120.0},
                              "total": {"count": 12, "p50_ms": 30.0, "p99_ms": 45.0, "max_ms": 50.0,
                                        "total_ms": 370.0}},
                   "data_duration_s": 1.2, "wall_duration_s": 0.6, "realtime_factor": 2.0}, stream)


def write_labels(path, magic, scans):
    """scans: [(stamp_ns, labels, branch ids or None, tree ids or None)]"""
    with open(path, "wb") as stream:
        stream.write(magic)
        for stamp, labels, branches, trees in scans:
            stream.write(struct.pack("<qI", stamp, len(labels)) + bytes(labels))
            if branches is not None:
                stream.write(struct.pack(f"<{len(branches)}h", *branches))
                stream.write(struct.pack(f"<{len(trees)}h", *trees))


def write_segments(path, scans):
    """scans: [(stamp_ns, segment ids, ranges)]"""
    with open(path, "wb") as stream:
        stream.write(b"DSSEGMT1")
        for stamp, segments, ranges in scans:
            stream.write(struct.pack("<qI", stamp, len(segments)))
            stream.write(struct.pack(f"<{len(segments)}i", *segments))
            stream.write(struct.pack(f"<{len(ranges)}f", *ranges))
