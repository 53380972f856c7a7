"""Scores of a map against the truth of a simulation.

Every function returns a dictionary of scores. A score that cannot be computed is None, and the
group's "reasons" says why.
"""

import os

import numpy as np
from scipy.optimize import linear_sum_assignment

from .errors import InputError
from .files import parse_stamp, read_csv, read_label_file, read_segment_file
from .geometry import Chain, axis_angle_deg, inverse, rotation_angle_deg
from .ground import ground_height

SAMPLE_M = 0.02          # step along an estimate
MAX_AXIS_DEG = 15.0      # of a match
MIN_OFFSET_M = 0.05      # of a match: centre lines closer than max(this, the true radius)
MIN_OVERLAP = 0.5        # of the shorter of the two
OBSERVABLE_RETURNS = 30  # in each of
OBSERVABLE_SCANS = 3
SIGMAS_68, SIGMAS_95 = 0.994458, 1.959964  # two-sided intervals of a normal distribution
BREAST_HEIGHT_M = 1.3
LABEL_WOOD = 2


def group(names):
    return {name: None for name in names.split()}


def explain(scores, reason, names=None):
    """Notes why scores are None."""
    for name in names or [n for n, v in scores.items() if v is None]:
        scores.setdefault("reasons", {})[name] = reason
    return scores


# -------------------------------------------------------------------------------------------------
# Trajectory
# -------------------------------------------------------------------------------------------------

def common_stamps(estimate, truth, tolerance_ns=1000):
    """Pairs of stamps that name the same scan, ascending."""
    keys = np.array(sorted(truth), dtype=np.int64)
    pairs = []
    for stamp in sorted(estimate):
        at = int(np.searchsorted(keys, stamp))
        best = min((keys[i] for i in (at - 1, at) if 0 <= i < len(keys)),
                   key=lambda k: abs(int(k) - stamp), default=None)
        if best is not None and abs(int(best) - stamp) <= tolerance_ns:
            pairs.append((stamp, int(best)))
    return pairs


def alignment(estimate, truth):
    """T_truth_map from the first pose that both have, or None."""
    if not estimate or not truth:
        return None
    pairs = common_stamps(estimate, truth)
    if not pairs:
        return None
    return truth[pairs[0][1]] @ inverse(estimate[pairs[0][0]])


def path_alignment(estimate, truth):
    """T_truth_map with the least mean square distance between the whole paths, or None (Umeyama, "Least-squares
    estimation of transformation parameters between two point patterns", PAMI 1991; without scale).

    Where a map lies is told by its first pose; a heading that drifted before there was anything to hold it
    turns all of the map. This takes that out: what is left is the map's own shape.
    """
    pairs = common_stamps(estimate, truth) if estimate and truth else []
    if len(pairs) < 3:
        return None
    est = np.array([estimate[a][:3, 3] for a, _ in pairs])
    ref = np.array([truth[b][:3, 3] for _, b in pairs])
    est_mean, ref_mean = est.mean(axis=0), ref.mean(axis=0)
    u, spread, vt = np.linalg.svd((ref - ref_mean).T @ (est - est_mean))
    if spread[1] < 1e-6 * max(spread[0], 1e-12):
        return None  # a straight path does not tell the turn about itself
    T = np.eye(4)
    T[:3, :3] = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    T[:3, 3] = ref_mean - T[:3, :3] @ est_mean
    return T


ALIGNMENTS = {"first": alignment, "path": path_alignment}


def trajectory_scores(estimate, truth, T_truth_map, missing=""):
    scores = group("poses ate_rmse_m ate_max_m ate_path_rmse_m rpe_trans_m rpe_rot_deg")
    if T_truth_map is None:
        return explain(scores, missing or "no pose of the map has the stamp of a true pose")
    pairs = common_stamps(estimate, truth)
    est = [T_truth_map @ estimate[a] for a, _ in pairs]
    ref = [truth[b] for _, b in pairs]
    scores["poses"] = len(pairs)
    error = np.array([np.linalg.norm(e[:3, 3] - r[:3, 3]) for e, r in zip(est, ref)])
    scores["ate_rmse_m"] = float(np.sqrt(np.mean(error ** 2)))
    scores["ate_max_m"] = float(error.max())
    T_path = path_alignment(estimate, truth)
    if T_path is None:
        explain(scores, "fewer than three common poses, or a straight path", ["ate_path_rmse_m"])
    else:
        error = [np.linalg.norm((T_path @ estimate[a])[:3, 3] - truth[b][:3, 3]) for a, b in pairs]
        scores["ate_path_rmse_m"] = float(np.sqrt(np.mean(np.square(error))))
    # Relative error over the first pose that is at least 1 m of path further on.
    path = np.concatenate([[0.0], np.cumsum(
        [np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in zip(ref, ref[1:])])])
    trans, rot = [], []
    for i in range(len(ref)):
        j = int(np.searchsorted(path, path[i] + 1.0))
        if j >= len(ref):
            break
        delta = inverse(inverse(ref[i]) @ ref[j]) @ (inverse(est[i]) @ est[j])
        trans.append(np.linalg.norm(delta[:3, 3]))
        rot.append(rotation_angle_deg(delta[:3, :3]))
    if trans:
        scores["rpe_trans_m"] = float(np.sqrt(np.mean(np.square(trans))))
        scores["rpe_rot_deg"] = float(np.sqrt(np.mean(np.square(rot))))
    else:
        explain(scores, "the path is shorter than 1 m", ["rpe_trans_m", "rpe_rot_deg"])
    return scores


# -------------------------------------------------------------------------------------------------
# Branches
# -------------------------------------------------------------------------------------------------

class Match:
    """An estimate beside a true branch where they agree."""

    def __init__(self, overlap, along_middle, sample, axis_deg, offset_m):
        self.overlap = overlap            # [m]
        self.along_middle = along_middle  # on the truth [m]
        self.sample = sample              # index of the estimate's sample nearest to the middle
        self.axis_deg = axis_deg          # median over the overlap
        self.offset_m = offset_m          # median over the overlap


def overlap_of(samples, truth_chain, estimate_length, usable=None):
    """The overlap of an estimate's samples with a true branch, or None where it is no match.

    A place belongs to the overlap if it lies beside the true branch (not beyond its ends), with the
    axes less than 15 degrees apart and the centre lines less than max(5 cm, the true radius); the
    overlap must be half of the shorter of the two.
    """
    points, axes, _, weights, _ = samples
    distance, along, radius, axis, inside = truth_chain.project(points)
    angle = axis_angle_deg(axes, axis)
    good = inside & (angle < MAX_AXIS_DEG) & (distance < np.maximum(MIN_OFFSET_M, radius))
    overlap = float(weights[good].sum())
    if overlap < MIN_OVERLAP * min(estimate_length, truth_chain.length) or overlap <= 0.0:
        return None
    middle = 0.5 * (along[good].min() + along[good].max())
    candidates = good if usable is None or not (good & usable).any() else good & usable
    where = np.flatnonzero(candidates)
    nearest = int(where[np.argmin(np.abs(along[where] - middle))])
    return Match(overlap, float(along[nearest]), nearest,
                 float(np.median(angle[good])), float(np.median(distance[good])))


def visible_chain(branch, by_key):
    """The part of a true branch outside of its parent: what can be seen and measured."""
    if branch.parent is None or branch.parent not in by_key:
        return branch.chain
    parent = by_key[branch.parent].chain
    points, _, _, weights, _ = branch.chain.sample(0.01)
    distance, _, radius, _, _ = parent.project(points)
    hidden = distance < radius
    if not hidden[0]:
        return branch.chain
    first_outside = int(np.argmin(hidden)) if not hidden.all() else len(hidden)
    rest = branch.chain.from_along(float(weights[:first_outside].sum()))
    return rest if len(rest.start) else branch.chain


def match_branches(estimates, truths, T_truth_map):
    """One-to-one matches with the greatest total overlap: list of (estimate, truth, Match, samples)."""
    by_key = {t.key: t for t in truths}
    visible = [visible_chain(t, by_key) for t in truths]
    reach = [(0.5 * (np.min(c.start, 0) + np.max(c.end, 0)), c) for c in visible]
    bounds = []
    for center, chain in reach:
        ends = np.vstack([chain.start, chain.end])
        bounds.append((center, np.linalg.norm(ends - center, axis=1).max() + 0.5 +
                       max(chain.r0.max(), chain.r1.max())))
    gain = np.zeros((len(estimates), len(truths)))
    found = {}
    samples_of = []
    for i, estimate in enumerate(estimates):
        chain = estimate.chain.transformed(T_truth_map)
        samples = chain.sample(SAMPLE_M)
        samples_of.append(samples)
        usable = estimate.measured[samples[4]] if estimate.measured is not None else None
        for j, chain_true in enumerate(visible):
            center, radius = bounds[j]
            if np.linalg.norm(samples[0] - center, axis=1).min() > radius:
                continue
            match = overlap_of(samples, chain_true, chain.length, usable)
            if match is not None:
                found[i, j] = match
                gain[i, j] = match.overlap
    matches = []
    if gain.size:
        for i, j in zip(*linear_sum_assignment(-gain)):
            if (i, j) in found:
                matches.append((estimates[i], truths[j], visible[j], found[i, j], samples_of[i]))
    return matches


def observable_keys(truth):
    """True branches with at least 30 returns in each of at least 3 scans."""
    return {key for key, counts in truth.hits.items()
            if sum(c >= OBSERVABLE_RETURNS for c in counts) >= OBSERVABLE_SCANS}


def statistics_of(errors_rel):
    return {"radius_error_rel_median": float(np.median(np.abs(errors_rel))),
            "radius_error_rel_p95": float(np.percentile(np.abs(errors_rel), 95)),
            "radius_bias_rel": float(np.mean(errors_rel))}


BRANCH_FIELDS = (
    "truth observable found false recall precision radius_error_rel_median radius_error_rel_p95 "
    "radius_bias_rel radius_rmse_m axis_error_deg_median centreline_error_m_median length_error_rel_median "
    "parent_correct_ratio order_correct_ratio angle_error_deg_median sigma_coverage_68 sigma_coverage_95 "
    "unresolved")


def branch_angle_deg(branch, by_key):
    """Angle at which a true branch leaves its parent [deg], directions from base to tip."""
    parent = by_key.get(branch.parent)
    if parent is None:
        return None
    chain = visible_chain(branch, by_key)
    _, _, _, axis, _ = parent.chain.project(chain.start[:1])
    return float(np.degrees(np.arccos(np.clip(axis[0] @ chain.axis[0], -1.0, 1.0))))


def branch_scores(map_dir, truth, T_truth_map):
    """(scores, per-branch details)."""
    scores = group(BRANCH_FIELDS)
    if map_dir.branches is None:
        return explain(scores, map_dir.missing["cylinders.csv"]), []
    estimates = [b for b in map_dir.branches if b.measured.any()]
    scores["unresolved"] = len(map_dir.branches) - len(estimates)
    if truth.branches is None:
        return explain(scores, truth.missing["scene.yaml"]), []
    scores["truth"] = len(truth.branches)
    if T_truth_map is None:
        return explain(scores, "the map cannot be moved into the truth's frame: no common pose"), []

    matches = match_branches(estimates, truth.branches, T_truth_map)
    by_key = {t.key: t for t in truth.branches}
    truth_of = {e.key: t.key for e, t, _, _, _ in matches}
    angles = {int(r["branch_id"]): float(r["angle_deg"]) for r in map_dir.branch_rows or []
              if r.get("angle_deg")}
    bases = {int(r["branch_id"]): r for r in map_dir.branch_rows or [] if r.get("base_diameter_m")}
    scores["false"] = len(estimates) - len(matches)
    if truth.hits is None:
        observable = None
        explain(scores, truth.missing["hits.csv"], ["observable", "found", "recall"])
    else:
        observable = observable_keys(truth) & set(by_key)
        scores["observable"] = len(observable)
        scores["found"] = sum(t.key in observable for _, t, _, _, _ in matches)
        if observable:
            scores["recall"] = scores["found"] / len(observable)
        else:
            explain(scores, "no true branch is observable", ["recall"])
    if estimates:
        scores["precision"] = len(matches) / len(estimates)
    else:
        explain(scores, "the map holds no measured branch", ["precision"])

    details = []
    for estimate, true, chain_true, match, samples in matches:
        radius_true = chain_true.radius_at(match.along_middle)
        index = samples[4][match.sample]
        detail = {
            "tree": true.key[0], "branch": true.key[1], "branch_id": estimate.key,
            "observable": None if observable is None else true.key in observable,
            "radius_true_m": radius_true, "radius_m": float(samples[2][match.sample]),
            "radius_sigma_m": float(estimate.sigma[index]),
            "measured": bool(estimate.measured[index]),
            "visible_arc_deg": estimate.rows[index]["arc"],
            "axis_error_deg": match.axis_deg, "centreline_error_m": match.offset_m,
            "length_true_m": chain_true.length, "length_m": estimate.chain.length,
            "order_true": true.order, "order": estimate.order if estimate.tree is not None else None,
        }
        base = bases.get(estimate.key)
        if base is not None:
            # The true diameter where the map's branch begins, which may be off the junction.
            start = T_truth_map[:3, :3] @ estimate.chain.start[0] + T_truth_map[:3, 3]
            _, _, radius_there, _, _ = chain_true.project(start[None])
            detail["base_diameter_true_m"] = 2.0 * float(radius_there[0])
            detail["base_diameter_m"] = float(base["base_diameter_m"])
            detail["base_diameter_sigma_m"] = float(base["base_diameter_sigma_m"])
        if true.parent is not None:
            parent_observable = observable is None or true.parent in observable
            detail["parent_correct"] = (
                (estimate.parent is not None and truth_of.get(estimate.parent) == true.parent)
                if parent_observable else None)
            detail["angle_true_deg"] = branch_angle_deg(true, by_key)
            detail["angle_deg"] = angles.get(estimate.key)
        details.append(detail)
    details.sort(key=lambda d: (d["tree"], d["branch"]))
    if not details:
        return explain(scores, "no estimate matches a true branch"), details

    radius = np.array([d["radius_m"] for d in details])
    radius_true = np.array([d["radius_true_m"] for d in details])
    sigma = np.array([d["radius_sigma_m"] for d in details])
    error = radius - radius_true
    scores.update(statistics_of(error / radius_true))
    scores["radius_rmse_m"] = float(np.sqrt(np.mean(error ** 2)))
    scores["axis_error_deg_median"] = float(np.median([d["axis_error_deg"] for d in details]))
    scores["centreline_error_m_median"] = float(np.median([d["centreline_error_m"] for d in details]))
    scores["length_error_rel_median"] = float(np.median(
        [abs(d["length_m"] - d["length_true_m"]) / d["length_true_m"] for d in details]))
    parents = [d["parent_correct"] for d in details if d.get("parent_correct") is not None]
    if parents:
        scores["parent_correct_ratio"] = float(np.mean(parents))
    else:
        explain(scores, "no found branch leaves an observable parent", ["parent_correct_ratio"])
    scores["order_correct_ratio"] = float(np.mean([d["order"] == d["order_true"] for d in details]))
    pairs = [(d["angle_deg"], d["angle_true_deg"]) for d in details if d.get("angle_deg") is not None]
    if pairs:
        scores["angle_error_deg_median"] = float(np.median([abs(a - b) for a, b in pairs]))
    else:
        explain(scores, "no found branch has an angle to its parent", ["angle_error_deg_median"])
    known = sigma > 0.0
    if known.any():
        ratio = np.abs(error[known]) / sigma[known]
        scores["sigma_coverage_68"] = float(np.mean(ratio <= SIGMAS_68))
        scores["sigma_coverage_95"] = float(np.mean(ratio <= SIGMAS_95))
    else:
        explain(scores, "the map gives no sigma", ["sigma_coverage_68", "sigma_coverage_95"])
    return scores, details


# -------------------------------------------------------------------------------------------------
# Trees
# -------------------------------------------------------------------------------------------------

def radius_at_height(chain, height_m):
    """Radius where a chain first passes a height above its base, or None."""
    base = chain.start[0, 2]
    for k in range(len(chain.lengths)):
        z0, z1 = chain.start[k, 2] - base, chain.end[k, 2] - base
        if min(z0, z1) <= height_m <= max(z0, z1) and z1 != z0:
            f = (height_m - z0) / (z1 - z0)
            return float(chain.r0[k] + f * (chain.r1[k] - chain.r0[k]))
    return None


def tree_scores(map_dir, truth, details):
    """One entry per true tree; the map's tree is the one that holds the branch matched to its trunk."""
    if truth.branches is None:
        return []
    rows = {int(r["tree_id"]): r for r in map_dir.trees or []}
    tree_of = {b.key: b.tree for b in map_dir.branches or []}
    result = []
    for index, name in enumerate(truth.tree_names):
        trunk = next((b for b in truth.branches if b.tree == index and b.parent is None), None)
        if trunk is None:
            continue
        entry = {"name": name, **group("tree_id dbh_truth_m dbh_m dbh_sigma_m height_error_m")}
        match = next((d for d in details
                      if d["tree"] == index and d["branch"] == trunk.key[1]), None)
        row = rows.get(tree_of.get(match["branch_id"])) if match else None
        height = float(row["dbh_height_m"]) if row and row.get("dbh_height_m") else BREAST_HEIGHT_M
        # Heights count from the ground: a stem may begin a little below it.
        start = trunk.chain.start[0]
        ground = ground_height(truth.ground, float(start[0]), float(start[1]))
        foot = 0.0 if ground is None else max(0.0, ground - float(start[2]))
        radius = radius_at_height(trunk.chain, height + foot)
        if radius is None:
            explain(entry, f"the true trunk does not pass {height} m", ["dbh_truth_m"])
        else:
            entry["dbh_truth_m"] = 2.0 * radius
        if map_dir.trees is None:
            explain(entry, map_dir.missing["trees.csv"], ["tree_id", "dbh_m", "dbh_sigma_m", "height_error_m"])
        elif row is None:
            explain(entry, "no tree of the map has this trunk",
                    ["tree_id", "dbh_m", "dbh_sigma_m", "height_error_m"])
        else:
            entry["tree_id"] = int(row["tree_id"])
            if row["dbh_m"]:
                entry["dbh_m"], entry["dbh_sigma_m"] = float(row["dbh_m"]), float(row["dbh_sigma_m"])
            else:
                explain(entry, "the trunk was not measured at breast height", ["dbh_m", "dbh_sigma_m"])
            top = max(max(b.chain.start[:, 2].max(), b.chain.end[:, 2].max())
                      for b in truth.branches if b.tree == index)
            entry["height_error_m"] = float(row["height_m"]) - float(top - start[2] - foot)
        result.append(entry)
    return result


# -------------------------------------------------------------------------------------------------
# Single scans
# -------------------------------------------------------------------------------------------------

def segment_scores(map_dir, truth):
    """Single-scan cylinders against the truth, each moved into the truth's frame by the true pose."""
    scores = group("count measured matched radius_error_rel_median radius_error_rel_p95 radius_bias_rel "
                   "radius_rmse_m axis_error_deg_median centreline_error_m_median sigma_coverage_68 "
                   "sigma_coverage_95 unresolved_ratio matched_10cm radius_error_rel_median_10cm "
                   "radius_bias_rel_10cm sigma_coverage_68_10cm sigma_coverage_95_10cm")
    path = map_dir.file("scan_cylinders.csv")
    if not os.path.exists(path):
        return explain(scores, "scan_cylinders.csv is not in the map directory (map_bag --per-scan)")
    rows = read_csv(path, ("stamp segment radius_m sigma_radius_m start_x start_y start_z end_x end_y "
                           "end_z taper_m_per_m status").split())
    measured = [r for r in rows if r["status"] == "MEASURED"]
    scores["count"], scores["measured"] = len(rows), len(measured)
    if rows:
        scores["unresolved_ratio"] = 1.0 - len(measured) / len(rows)
    if truth.branches is None or truth.trajectory is None:
        return explain(scores, truth.missing.get("scene.yaml") or truth.missing["trajectory.tum"])
    by_key = {t.key: t for t in truth.branches}
    visible = [visible_chain(t, by_key) for t in truth.branches]
    boxes = [(np.minimum(c.start, c.end).min(0) - 0.5, np.maximum(c.start, c.end).max(0) + 0.5)
             for c in visible]
    stamps = np.array(sorted(truth.trajectory), dtype=np.int64)
    error, relative, sigma, axis, offset, thick = [], [], [], [], [], []
    for line, row in enumerate(measured, 2):
        try:
            stamp = parse_stamp(row["stamp"])
            value = {k: float(row[k]) for k in row if k not in ("stamp", "status", "reason") and row[k]}
        except ValueError as problem:
            raise InputError(f"{path}: about line {line}: {problem}") from None
        nearest = int(stamps[np.argmin(np.abs(stamps - stamp))]) if len(stamps) else None
        if nearest is None or abs(nearest - stamp) > 1000:
            continue
        T = truth.trajectory[nearest]
        start = np.array([value[f"start_{a}"] for a in "xyz"])
        end = np.array([value[f"end_{a}"] for a in "xyz"])
        length = float(np.linalg.norm(end - start))
        if length <= 0.0:
            continue
        # radius_m holds at the anchor, the middle of the observed stretch.
        r, half = value["radius_m"], 0.5 * value["taper_m_per_m"] * length
        chain = Chain([start], [end], [max(r - half, 0.0)], [max(r + half, 0.0)]).transformed(T)
        samples = chain.sample(max(SAMPLE_M, length / 20.0))
        middle = samples[0].mean(axis=0)
        best = None
        for (low, high), chain_true in zip(boxes, visible):
            if np.any(middle < low) or np.any(middle > high):
                continue
            match = overlap_of(samples, chain_true, length)
            if match is not None and (best is None or match.overlap > best[0].overlap):
                best = (match, chain_true)
        if best is None:
            continue
        match, chain_true = best
        truth_radius = chain_true.radius_at(match.along_middle)
        error.append(samples[2][match.sample] - truth_radius)
        relative.append(error[-1] / truth_radius)
        thick.append(truth_radius >= 0.10)
        sigma.append(value["sigma_radius_m"])
        axis.append(match.axis_deg)
        offset.append(match.offset_m)
    scores["matched"] = len(error)
    if not error:
        return explain(scores, "no measured segment lies on a true branch")
    scores.update(statistics_of(np.array(relative)))
    scores["radius_rmse_m"] = float(np.sqrt(np.mean(np.square(error))))
    scores["axis_error_deg_median"] = float(np.median(axis))
    scores["centreline_error_m_median"] = float(np.median(offset))
    ratio = np.abs(error) / np.maximum(sigma, 1e-12)
    scores["sigma_coverage_68"] = float(np.mean(ratio <= SIGMAS_68))
    scores["sigma_coverage_95"] = float(np.mean(ratio <= SIGMAS_95))
    # Wood as thick as the thesis': thinner branches are narrower than two beams.
    thick = np.array(thick)
    scores["matched_10cm"] = int(thick.sum())
    if thick.any():
        of_thick = np.array(relative)[thick]
        scores["radius_error_rel_median_10cm"] = float(np.median(np.abs(of_thick)))
        scores["radius_bias_rel_10cm"] = float(np.mean(of_thick))
        scores["sigma_coverage_68_10cm"] = float(np.mean(ratio[thick] <= SIGMAS_68))
        scores["sigma_coverage_95_10cm"] = float(np.mean(ratio[thick] <= SIGMAS_95))
    return scores


def segmentation_scores(map_dir, truth):
    scores = group("scans returns wood_iou accuracy wood_recall wood_recall_beyond_8m")
    predicted_path, truth_path = map_dir.file("scan_labels.bin"), truth.file("labels.bin")
    if not os.path.exists(predicted_path):
        return explain(scores, "scan_labels.bin is not in the map directory (map_bag --per-scan)")
    if not os.path.exists(truth_path):
        return explain(scores, "labels.bin is not in the truth directory")
    predicted = read_label_file(predicted_path, b"DSLABEL1", ids=False)
    actual = read_label_file(truth_path, b"DSTRUTH1", ids=True)
    ranges = {}
    if os.path.exists(map_dir.file("scan_segments.bin")):
        ranges = read_segment_file(map_dir.file("scan_segments.bin"))
    tp = fp = fn = tn = far_tp = far_fn = scans = 0
    for stamp, scan in predicted.items():
        true = actual.get(stamp)
        if true is None:
            continue
        if len(true["label"]) != len(scan["label"]):
            raise InputError(f"{predicted_path}: the scan at {stamp} ns has {len(scan['label'])} returns, "
                             f"the truth {len(true['label'])}")
        scans += 1
        is_wood, says_wood = true["label"] == LABEL_WOOD, scan["label"] == LABEL_WOOD
        tp += int(np.sum(is_wood & says_wood))
        fp += int(np.sum(~is_wood & says_wood))
        fn += int(np.sum(is_wood & ~says_wood))
        tn += int(np.sum(~is_wood & ~says_wood))
        if stamp in ranges:
            far = ranges[stamp]["range"] > 8.0
            far_tp += int(np.sum(is_wood & says_wood & far))
            far_fn += int(np.sum(is_wood & ~says_wood & far))
    scores["scans"], scores["returns"] = scans, tp + fp + fn + tn
    if scores["returns"] == 0:
        return explain(scores, "no scan has the stamp of a true scan")
    scores["accuracy"] = (tp + tn) / scores["returns"]
    if tp + fn:
        scores["wood_iou"] = tp / (tp + fp + fn)
        scores["wood_recall"] = tp / (tp + fn)
    else:
        explain(scores, "no return fell on wood", ["wood_iou", "wood_recall"])
    if far_tp + far_fn:
        scores["wood_recall_beyond_8m"] = far_tp / (far_tp + far_fn)
    else:
        explain(scores, "no return on wood beyond 8 m" if ranges else
                "scan_segments.bin, which holds the ranges, is not in the map directory",
                ["wood_recall_beyond_8m"])
    return scores


def branches_in_scan_scores(map_dir, truth):
    """Segments against the branch ids of their returns.

    purity: share of the segments' returns that lie on the branch most of the segment lies on;
    completeness: share of the returns of a branch (at least 30 in the scan) that its largest
    segment holds; pieces: segments that lie mostly on such a branch, per branch and scan.
    """
    scores = group("segments purity completeness pieces_per_branch")
    path, truth_path = map_dir.file("scan_segments.bin"), truth.file("labels.bin")
    if not os.path.exists(path):
        return explain(scores, "scan_segments.bin is not in the map directory (map_bag --per-scan)")
    if not os.path.exists(truth_path):
        return explain(scores, "labels.bin is not in the truth directory")
    segments = read_segment_file(path)
    actual = read_label_file(truth_path, b"DSTRUTH1", ids=True)
    pure = total = held = on_branches = pieces = branches = count = 0
    for stamp, scan in segments.items():
        true = actual.get(stamp)
        if true is None or len(true["label"]) != len(scan["segment"]):
            continue
        wood = (true["label"] == LABEL_WOOD) & (true["branch"] >= 0)
        key = np.where(wood, (true["tree"].astype(np.int64) + 1) * 65536 + true["branch"], -1)
        inside = scan["segment"] >= 0
        table = {}
        for (segment, branch), n in zip(*np.unique(
                np.stack([scan["segment"][inside].astype(np.int64), key[inside]], axis=1),
                axis=0, return_counts=True)):
            table.setdefault(int(segment), {})[int(branch)] = int(n)
        mostly = {}
        for segment, counts in table.items():
            branch = max(sorted(counts), key=lambda b: counts[b])
            pure += counts[branch] if branch >= 0 else 0
            total += sum(counts.values())
            mostly[branch] = mostly.get(branch, 0) + 1
        count += len(table)
        for branch, n in zip(*np.unique(key[wood], return_counts=True)):
            if n < OBSERVABLE_RETURNS:
                continue
            branches += 1
            on_branches += int(n)
            held += max((c.get(int(branch), 0) for c in table.values()), default=0)
            pieces += mostly.get(int(branch), 0)
    scores["segments"] = count
    if total:
        scores["purity"] = pure / total
    else:
        explain(scores, "no segment in a scan of the truth", ["purity"])
    if branches:
        scores["completeness"] = held / on_branches
        scores["pieces_per_branch"] = pieces / branches
    else:
        explain(scores, "no branch has 30 returns in a scan", ["completeness", "pieces_per_branch"])
    return scores


# -------------------------------------------------------------------------------------------------
# Timing and all together
# -------------------------------------------------------------------------------------------------

def timing_scores(map_dir):
    scores = group("stages realtime_factor")
    if map_dir.timing is None:
        return explain(scores, map_dir.missing["timing.json"])
    scores["stages"] = {
        name: {k: stage.get(k) for k in ("count", "p50_ms", "p99_ms", "max_ms")}
        for name, stage in map_dir.timing.get("stages", {}).items()}
    scores["realtime_factor"] = map_dir.timing.get("realtime_factor")
    if scores["realtime_factor"] is None:
        explain(scores, "timing.json holds no duration of the run", ["realtime_factor"])
    return scores


def evaluate(map_dir, truth, per_scan=False, align="first"):
    """All scores; also the per-branch details for figures and reports under branches.matched.

    align: what moves the map into the truth's frame, a key of ALIGNMENTS. `trajectory.ate_path_rmse_m` is
    always that of the path.
    """
    T = ALIGNMENTS[align](map_dir.trajectory, truth.trajectory)
    missing = map_dir.missing.get("trajectory.tum") or truth.missing.get("trajectory.tum") or ""
    branches, details = branch_scores(map_dir, truth, T)
    result = {
        "trajectory": trajectory_scores(map_dir.trajectory, truth.trajectory, T, missing),
        "branches": {**branches, "matched": details},
        "trees": tree_scores(map_dir, truth, details),
    }
    if per_scan:
        result["segments"] = segment_scores(map_dir, truth)
        result["segmentation"] = segmentation_scores(map_dir, truth)
        result["branches_in_scan"] = branches_in_scan_scores(map_dir, truth)
    result["timing"] = timing_scores(map_dir)
    return result
