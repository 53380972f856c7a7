"""Tables 5.1 and 5.2 of the thesis for our maps of its two plants: tape, thesis, ours."""

import numpy as np

from .scores import alignment

# Segment: (name, branch of the scene, where along it [m from its base], tape low and high, the thesis'
# figure; all radii in cm). The tape gives a range for some segments, a half chord for others.
TABLES = {
    "saguaro": ("Table 5.1: saguaro", [
        ("Base", 0, (0.6, 2.6), 23.8, 25.8, 25.99),
        ("Left", 1, (1.0, 2.7), 21.5, 21.5, 23.73),
        ("Center", 0, (4.8, 6.4), 16.8, 16.8, 19.25),
        ("Right", 2, (1.0, 2.3), 16.6, 16.6, 23.91)]),
    "palo_verde": ("Table 5.2: palo verde", [
        ("Base", 0, (0.45, 0.85), 14.95, 16.17, 14.51),
        ("Left", 1, (0.5, 1.8), 7.68, 8.49, 8.79),
        ("Right", 2, (0.3, 1.1), 10.91, 11.72, 12.56),
        ("RightLeft", 3, (0.4, 1.5), 9.5, 9.5, 9.07),
        ("RightRight", 4, (0.4, 1.6), 5.66, 6.47, 5.24)]),
}
STEP_M = 0.05
MAX_ANGLE_DEG = 20.0


def outside(value, low, high):
    """Distance of a value to an interval."""
    return max(low - value, 0.0, value - high)


def radius_of_stretch(branches, chain, stretch):
    """The map along a stretch of a true branch: (mean radius, its sigma, share of the stretch found).

    At every 5 cm the cylinder is taken whose axis passes nearest, within the larger of 5 cm and the
    radius, and less than 20 degrees off. Inferred ones do not count. Neighbouring cylinders share
    their errors, so the sigma is their mean and does not shrink with their number.
    """
    points, axes, true_radii, _, _ = chain.sample(STEP_M)
    along = np.concatenate([chain.offset[i] + (np.arange(n) + 0.5) / n * length
                            for i, length in enumerate(chain.lengths) if length > 0.0
                            for n in [max(1, int(np.ceil(length / STEP_M)))]])
    inside = (along >= stretch[0]) & (along <= stretch[1])
    found = []
    for point, axis, radius in zip(points[inside], axes[inside], true_radii[inside]):
        best = None
        for moved, branch in branches:
            relative = point - moved.start
            t = np.einsum("ni,ni->n", relative, moved.axis) / moved.lengths
            clipped = np.clip(t, 0.0, 1.0)
            feet = moved.start + clipped[:, None] * (moved.end - moved.start)
            distance = np.linalg.norm(point - feet, axis=1)
            good = branch.measured & (np.abs(moved.axis @ axis) > np.cos(np.radians(MAX_ANGLE_DEG))) & \
                (distance < max(0.05, radius))
            if not good.any():
                continue
            k = int(np.argmin(np.where(good, distance, np.inf)))
            if best is None or distance[k] < best[0]:
                r = moved.r0[k] + clipped[k] * (moved.r1[k] - moved.r0[k])
                best = (distance[k], float(r), float(branch.sigma[k]), branch.key)
        if best is not None:
            found.append(best[1:])
    if not found:
        return None, None, 0.0, []
    radii, sigmas = np.array([f[0] for f in found]), np.array([f[1] for f in found])
    return float(radii.mean()), float(sigmas.mean()), len(found) / max(int(inside.sum()), 1), \
        sorted({f[2] for f in found})


def thesis_table(map_dir, truth):
    """{title, rows} for a scene of the thesis, or None. Needs both trajectories for the frame."""
    if truth is None or not truth.tree_names or len(truth.tree_names) != 1 or not map_dir.branches:
        return None
    entry = TABLES.get(truth.tree_names[0])
    if entry is None or not map_dir.trajectory or not truth.trajectory:
        return None
    T = alignment(map_dir.trajectory, truth.trajectory)
    if T is None:
        return None
    branches = [(b.chain.transformed(T), b) for b in map_dir.branches]
    true = {b.key[1]: b.chain for b in truth.branches}
    rows = []
    for name, branch, stretch, low, high, thesis in entry[1]:
        radius, sigma, share, keys = radius_of_stretch(branches, true[branch], stretch)
        rows.append({
            "name": name, "low_cm": low, "high_cm": high, "thesis_cm": thesis, "branches": keys,
            "found_share": share,
            "ours_cm": None if radius is None else 100 * radius,
            "sigma_cm": None if radius is None else 100 * sigma})
    return {"title": entry[0], "rows": rows}


def mean_errors(rows, key):
    """(mean distance to the nearest tape bound, mean distance to the middle) [cm], over what is there."""
    there = [r for r in rows if r[key] is not None]
    if not there:
        return None, None
    return (float(np.mean([outside(r[key], r["low_cm"], r["high_cm"]) for r in there])),
            float(np.mean([abs(r[key] - 0.5 * (r["low_cm"] + r["high_cm"])) for r in there])))
