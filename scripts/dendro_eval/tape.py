"""Tape measurements of a user beside the map.

A CSV file with a header. Every row names a place and a size:
  branch      id of a branch of the map; with `position_m` from its base, else its middle; or
  height      height above the tree's base [m] on the trunk; with `tree` where there are several;
  radius_cm   or circumference_cm, the tape's reading.
"""

import csv
import math

from .errors import InputError

PLACES = ("branch", "height")
SIZES = ("radius_cm", "circumference_cm")
OPTIONAL = ("tree", "position_m", "name", "low_cm", "high_cm")
MAX_RADIUS_CM = 300.0
# Readings that are this many times the map's radius, within 15 %, were probably meant otherwise.
MISTAKES = ((10.0, "is it in mm?"), (2.0, "is it a diameter?"), (2.0 * math.pi, "is it a circumference?"), (0.01, "is it in metres?"),
            (1.0 / (2.0 * math.pi), "is it a radius?"), (1.0 / 2.54, "is it in inches?"))


def read_tape(path):
    """Rows {line, name, branch | height, tree, position, radius_m}."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as stream:
            reader = csv.DictReader(stream, skipinitialspace=True)
            header = [h.strip() for h in reader.fieldnames or []]
            reader.fieldnames = header
            rows = list(enumerate(reader, 2))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file") from None
    for separator, called in ((";", "semicolons"), ("\t", "tabs")):
        if len(header) == 1 and separator in header[0]:
            raise InputError(f"{path}: line 1: the fields are parted by {called}; expected commas")
    for name in header:
        if name not in PLACES + SIZES + OPTIONAL:
            hint = next((f" (did you mean {k}?)" for k in PLACES + SIZES
                         if name.split("_")[0] == k.split("_")[0]), "")
            raise InputError(f"{path}: line 1: unknown column '{name}'{hint}")
    if not any(p in header for p in PLACES):
        raise InputError(f"{path}: line 1: no column branch or height")
    if not any(s in header for s in SIZES):
        raise InputError(f"{path}: line 1: no column radius_cm or circumference_cm")
    entries = []
    for line, row in rows:
        if None in row or None in row.values():
            raise InputError(f"{path}: line {line}: expected {len(header)} fields")
        row = {k: v.strip() for k, v in row.items()}

        def number(key):
            try:
                value = float(row[key])
                if not math.isfinite(value):
                    raise ValueError
                return value
            except ValueError:
                raise InputError(f"{path}: line {line}: {key} '{row[key]}' is not a number") from None

        sizes = [s for s in SIZES if row.get(s)]
        places = [p for p in PLACES if row.get(p)]
        if len(sizes) != 1:
            raise InputError(f"{path}: line {line}: give either radius_cm or circumference_cm")
        if len(places) != 1:
            raise InputError(f"{path}: line {line}: give either branch or height")
        size = number(sizes[0])
        radius_cm = size if sizes[0] == "radius_cm" else size / (2.0 * math.pi)
        if not 0.0 < radius_cm <= MAX_RADIUS_CM:
            raise InputError(f"{path}: line {line}: {sizes[0]} {size:g} is no size of wood in cm")
        if radius_cm < 0.3:
            raise InputError(f"{path}: line {line}: {sizes[0]} {size:g} is below 3 mm radius: is it in metres?")
        entry = {"line": line, "name": row.get("name") or "", "radius_m": radius_cm / 100.0,
                 "branch": None, "height": None, "position": None, "tree": None}
        if places[0] == "branch":
            value = number("branch")
            if value != int(value):
                raise InputError(f"{path}: line {line}: branch '{row['branch']}' is not a branch id")
            entry["branch"] = int(value)
        else:
            entry["height"] = number("height")
        if row.get("position_m"):
            entry["position"] = number("position_m")
        if row.get("tree"):
            entry["tree"] = int(number("tree"))
        entries.append(entry)
    if not entries:
        raise InputError(f"{path}: holds no measurement")
    return entries


def compare_tape(path, map_dir):
    """Rows {name, place, tape_m, map_m, sigma_m, difference_m, note}.

    map_m is None with a reason where nothing was seen; the note also says which line looks like a wrong unit.
    """
    branches = {b.key: b for b in map_dir.branches or []}
    trunks = {b.tree: b for b in map_dir.branches or [] if b.order == 0 and b.tree is not None}
    base_z = {int(r["tree_id"]): float(r["z"]) for r in map_dir.trees or []}
    result = []
    for entry in read_tape(path):
        line = entry["line"]
        if entry["branch"] is not None:
            branch = branches.get(entry["branch"])
            if branch is None:
                raise InputError(f"{path}: line {line}: the map has no branch {entry['branch']}")
            along = 0.5 * branch.chain.length if entry["position"] is None else entry["position"]
            if not 0.0 <= along <= branch.chain.length:
                raise InputError(f"{path}: line {line}: position_m {along:g} is outside of branch "
                                 f"{branch.key} (0 to {branch.chain.length:.2f} m)")
            place = f"branch {branch.key}, {along:.2f} m from its base"
            index = next((i for i in range(len(branch.chain.lengths))
                          if along <= branch.chain.offset[i] + branch.chain.lengths[i] + 1e-9), -1)
            radius = branch.chain.radius_at(along)
        else:
            if entry["tree"] is None and len(trunks) != 1:
                raise InputError(f"{path}: line {line}: the map has {len(trunks)} trees: add a column tree")
            tree = next(iter(trunks)) if entry["tree"] is None else entry["tree"]
            branch = trunks.get(tree)
            if branch is None:
                raise InputError(f"{path}: line {line}: the map has no tree {tree}")
            place = f"trunk of tree {tree} at {entry['height']:g} m"
            seen = float(max(branch.chain.start[:, 2].max(), branch.chain.end[:, 2].max())) - \
                base_z.get(tree, float(branch.chain.start[0, 2]))
            if entry["height"] > 3.0 * seen and entry["height"] > 10.0:
                raise InputError(f"{path}: line {line}: height {entry['height']:g} m is far above tree {tree}, "
                                 f"whose trunk was seen up to {seen:.1f} m: is it in cm?")
            z = base_z.get(tree, float(branch.chain.start[0, 2])) + entry["height"]
            index, radius = None, None
            for i in range(len(branch.chain.lengths)):
                z0, z1 = branch.chain.start[i, 2], branch.chain.end[i, 2]
                if min(z0, z1) <= z <= max(z0, z1) and z0 != z1:
                    index = i
                    radius = float(branch.chain.r0[i] +
                                   (z - z0) / (z1 - z0) * (branch.chain.r1[i] - branch.chain.r0[i]))
                    break
        row = {"name": entry["name"] or place, "place": place, "tape_m": entry["radius_m"],
               "map_m": None, "sigma_m": None, "difference_m": None, "note": "", "doubt": None}
        if index is None:
            row["note"] = "not seen there"
        else:
            row.update(map_m=radius, sigma_m=float(branch.sigma[index]),
                       difference_m=radius - entry["radius_m"])
            if not branch.measured[index]:
                row["note"] = "inferred"
            times = entry["radius_m"] / radius if radius > 0.0 else 1.0
            question = next((q for factor, q in MISTAKES if 1 / 1.15 < times / factor < 1.15), None)
            if question:
                row["doubt"] = row["note"] = f"line {line}: {times:.3g} times the map's radius: {question}"
        result.append(row)
    return result
