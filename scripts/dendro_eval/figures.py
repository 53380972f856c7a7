"""Figures of a map. Units on every axis; colours that colour-blind readers can tell apart."""

import os

import matplotlib

matplotlib.use("Agg")
import matplotlib.colors  # noqa: E402
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.collections import PolyCollection  # noqa: E402
from matplotlib.lines import Line2D  # noqa: E402
from matplotlib.patches import Patch  # noqa: E402

from .geometry import perpendicular_basis  # noqa: E402
from .scores import alignment, common_stamps  # noqa: E402

# Okabe and Ito 2008, in the order of tree.ply and of rviz.
PALETTE = ["#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7"]
INFERRED_ALPHA = 0.35
INK, SOFT = "#222222", "#8a8a8a"
MAX_LEGEND = 24
MAX_LABELS = 14

plt.rcParams.update({
    "font.size": 9.5, "axes.titlesize": 10.5, "axes.labelsize": 9.5, "axes.spines.top": False,
    "axes.spines.right": False, "axes.edgecolor": SOFT, "axes.labelcolor": INK, "text.color": INK,
    "axes.grid": True, "grid.color": "#e6e6e6", "grid.linewidth": 0.6, "axes.axisbelow": True,
    "legend.frameon": False, "figure.dpi": 110, "savefig.dpi": 130, "svg.hashsalt": "dendro_slam",
})


def branch_color(branch_id):
    """Colour of a branch by its id; every second round of the palette is darker."""
    if branch_id is None or branch_id < 0:
        return "#AAAAAA"
    color = np.array(matplotlib.colors.to_rgb(PALETTE[branch_id % len(PALETTE)]))
    dark = (branch_id // len(PALETTE)) % 2 == 1
    return matplotlib.colors.to_hex(0.6 * color if dark else color)


def tree_title(tree):
    return "not attached to a tree" if tree is None else f"tree {tree}"


# -------------------------------------------------------------------------------------------------
# The tree from four sides
# -------------------------------------------------------------------------------------------------

def silhouettes(chain, right):
    """Outline of every frustum seen along a horizontal direction: (n, 4, 2) of (right, up)."""
    a = np.stack([chain.start @ right, chain.start[:, 2]], axis=1)
    b = np.stack([chain.end @ right, chain.end[:, 2]], axis=1)
    along = b - a
    length = np.linalg.norm(along, axis=1, keepdims=True)
    # Seen end-on the outline is a disc; a square of its size stands in for it.
    along = np.where(length > 1e-6, along / np.maximum(length, 1e-6), [[1.0, 0.0]])
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    r0, r1 = chain.r0[:, None], chain.r1[:, None]
    return np.stack([a + r0 * normal, b + r1 * normal, b - r1 * normal, a - r0 * normal], axis=1)


def spread(values, gap):
    """Values moved as little as needed to be `gap` apart, order kept."""
    order = np.argsort(values, kind="stable")
    placed = np.array(values, float)[order]
    for _ in range(200):
        overlap = gap - np.diff(placed)
        if (overlap <= 1e-9).all():
            break
        for i in np.flatnonzero(overlap > 0):
            placed[i] -= 0.5 * overlap[i]
            placed[i + 1] += 0.5 * overlap[i]
    result = np.empty(len(placed))
    result[order] = placed
    return result


def draw_view(ax, branches, azimuth_deg, box, label):
    """One orthographic view from a horizontal direction; the viewer stands at `azimuth_deg`."""
    a = np.radians(azimuth_deg)
    toward = np.array([np.cos(a), np.sin(a), 0.0])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    for branch in sorted(branches, key=lambda b: float(np.mean(b.chain.start @ toward))):
        outline = silhouettes(branch.chain, right)
        color = branch_color(branch.key)
        for mask, alpha in ((~branch.measured, INFERRED_ALPHA), (branch.measured, 1.0)):
            if mask.any():
                ax.add_collection(PolyCollection(outline[mask], facecolor=color, alpha=alpha,
                                                 edgecolor="#33333366", linewidth=0.3))
    center, half, low, high = box
    middle = float(center @ right)
    ax.set_xlim(middle - half, middle + half)
    ax.set_ylim(low, high)
    ax.set_aspect("equal")
    ax.set_xlabel("to the right [m]")
    ax.set_title(f"seen from azimuth {azimuth_deg:.0f}°")
    if not label:
        return
    tips = [(b, float(b.chain.end[-1] @ right), float(b.chain.end[-1][2])) for b in branches]
    for side in (-1, 1):
        chosen = [t for t in tips if (t[1] >= middle) == (side > 0)]
        if not chosen:
            continue
        heights = spread([t[2] for t in chosen], (high - low) / 26.0)
        edge = middle + side * half * 0.97
        for (branch, x, z), height in zip(chosen, heights):
            ax.plot([x, edge - side * half * 0.13], [z, height], color=SOFT, linewidth=0.5)
            ax.text(edge, height, str(branch.key), fontsize=8, va="center",
                    ha="right" if side > 0 else "left")


def tree_figure(map_dir, tree):
    """The branches of one tree (None: of no tree) from four sides, one colour per branch."""
    branches = [b for b in map_dir.branches if b.tree == tree]
    points = np.vstack([np.vstack([b.chain.start, b.chain.end]) for b in branches])
    low, high = points.min(axis=0), points.max(axis=0)
    center = 0.5 * (low + high)
    half = max(0.5 * np.hypot(*(high - low)[:2]), 0.3 * (high - low)[2], 0.3) * 1.15 + 0.1
    margin = 0.05 * (high[2] - low[2]) + 0.2
    box = (center, half, low[2] - margin, high[2] + margin)
    columns = 4
    order = sorted(branches, key=lambda b: (b.order, b.key))
    rows = int(np.ceil(min(len(order), MAX_LEGEND) / columns))
    fig_height = min(8.0, max(3.4, 3.0 * (box[3] - box[2]) / (2 * half) + 0.6))
    legend_height = 0.2 * (rows + 1) + 0.3
    fig, axes = plt.subplots(1, 4, figsize=(12.6, fig_height + legend_height), sharey=True)
    for ax, azimuth in zip(axes, (0, 90, 180, 270)):
        draw_view(ax, branches, azimuth, box, len(branches) <= MAX_LABELS)
    axes[0].set_ylabel("height in the map frame, z [m]")
    handles = []
    for branch in order[:MAX_LEGEND]:
        base = branch.rows[int(np.argmax(branch.measured))]
        handles.append(Patch(facecolor=branch_color(branch.key), edgecolor="#333333", linewidth=0.4,
                             label=f"{branch.key}: order {branch.order}, ø {200 * base['radius']:.1f} "
                                   f"± {200 * base['sigma']:.1f} cm, {branch.chain.length:.1f} m"))
    title = f"{tree_title(tree).capitalize()}: {len(branches)} branches" if tree is not None else \
        f"{len(branches)} pieces not attached to a tree"
    fig.suptitle(title, y=0.995, fontsize=12)
    note = "branch id: order, diameter of its lowest measured section, length. Pale: inferred between measurements."
    if len(order) > MAX_LEGEND:
        note += f" {len(order) - MAX_LEGEND} more in branches.csv."
    share = legend_height / (fig_height + legend_height)
    fig.tight_layout(rect=(0, share, 1, 0.985))
    fig.legend(handles=handles, loc="lower center", bbox_to_anchor=(0.5, 0.0), ncol=columns,
               fontsize=8.5, title=note, title_fontsize=8.5)
    return fig


# -------------------------------------------------------------------------------------------------
# Taper, radius, trajectory, coverage, timing
# -------------------------------------------------------------------------------------------------

def trunk_of(map_dir, tree):
    return next((b for b in map_dir.branches if b.tree == tree and b.order == 0), None)


def taper_figure(map_dir, tree, true_trunk=None):
    """Diameter of the trunk over the height above its base, with intervals and the DBH."""
    trunk = trunk_of(map_dir, tree)
    row = next((r for r in map_dir.trees or [] if int(r["tree_id"]) == tree), None)
    base = float(row["z"]) if row else float(trunk.chain.start[0, 2])
    fig, ax = plt.subplots(figsize=(6.2, 4.8))
    height = 0.5 * (trunk.chain.start[:, 2] + trunk.chain.end[:, 2]) - base
    diameter = 100 * (trunk.chain.r0 + trunk.chain.r1)
    sigma = 200 * trunk.sigma
    m = trunk.measured
    if true_trunk is not None:
        z = np.concatenate([true_trunk.chain.start[:, 2], true_trunk.chain.end[-1:, 2]])
        r = np.concatenate([true_trunk.chain.r0, true_trunk.chain.r1[-1:]])
        ax.plot(200 * r, z - z[0], color=INK, linewidth=1.2, label="truth")
    ax.errorbar(diameter[m], height[m], xerr=1.96 * sigma[m], fmt="none", ecolor="#9ecae1", elinewidth=2,
                label="95 % interval")
    ax.errorbar(diameter[m], height[m], xerr=sigma[m], fmt="o", color=PALETTE[4], markersize=4,
                elinewidth=2, label="measured, ± 1 sigma")
    if (~m).any():
        ax.plot(diameter[~m], height[~m], "o", color=SOFT, markerfacecolor="white", markersize=4,
                label="inferred")
    if row and row["dbh_m"]:
        dbh, dbh_sigma, dbh_height = (float(row[k]) for k in ("dbh_m", "dbh_sigma_m", "dbh_height_m"))
        ax.errorbar([100 * dbh], [dbh_height], xerr=[196 * dbh_sigma], fmt="D", color=PALETTE[5],
                    markersize=7, elinewidth=2,
                    label=f"DBH {100 * dbh:.1f} ± {100 * dbh_sigma:.1f} cm at {dbh_height:g} m")
    ax.set_xlabel("diameter of the trunk [cm]")
    ax.set_ylabel("height above the tree's base [m]")
    # A single piece has no range of its own: some air beside and above it.
    ax.set_xlim(0, max(ax.get_xlim()[1], 1.2 * float(diameter.max())))
    ax.set_ylim(min(0.0, float(height.min())) - 0.1, max(ax.get_ylim()[1], float(height.max()) + 0.5))
    ax.set_title(f"Stem taper of {tree_title(tree)}")
    ax.legend(loc="best", fontsize=8.5)
    fig.tight_layout()
    return fig


def radius_figure(scores):
    """Radius of every found branch against the truth, with its 1 and 2 sigma intervals."""
    details = scores["branches"]["matched"]
    true = 100 * np.array([d["radius_true_m"] for d in details])
    found = 100 * np.array([d["radius_m"] for d in details])
    sigma = 100 * np.array([d["radius_sigma_m"] for d in details])
    fig, (left, right) = plt.subplots(1, 2, figsize=(10.5, 4.6), gridspec_kw={"width_ratios": [1, 1.15]})
    limit = 1.12 * max(true.max(), found.max())
    left.plot([0, limit], [0, limit], color=INK, linewidth=1, label="equal")
    left.fill_between([0, limit], [0, 0.95 * limit], [0, 1.05 * limit], color="#eeeeee",
                      label="± 5 %", zorder=0)
    left.errorbar(true, found, yerr=1.96 * sigma, fmt="o", color=PALETTE[4], ecolor="#9ecae1",
                  elinewidth=2, markersize=4.5, label="branch, 95 % interval")
    left.set_xlim(0, limit)
    left.set_ylim(0, limit)
    left.set_aspect("equal")
    left.set_xlabel("true radius [cm]")
    left.set_ylabel("radius in the map [cm]")
    left.set_title("Radius at the middle of the overlap")
    left.legend(loc="upper left", fontsize=8.5)
    order = np.argsort(-true, kind="stable")
    y = np.arange(len(order))
    error = 100 * (found - true) / true
    right.axvline(0, color=INK, linewidth=1)
    right.axvspan(-5, 5, color="#eeeeee", zorder=0)
    right.errorbar(error[order], y, xerr=(1.96 * 100 * sigma / true)[order], fmt="o", color=PALETTE[5],
                   ecolor="#f5c29b", elinewidth=2, markersize=4.5)
    if len(order) <= 40:
        right.set_yticks(y)
        right.set_yticklabels([f"{details[i]['branch_id']} ({true[i]:.1f} cm)" for i in order],
                              fontsize=8.5 if len(order) < 25 else 6.5)
    else:
        right.set_yticks([])
    right.set_ylim(len(order) - 0.4, -0.6)
    right.set_xlabel("radius error [%], with 95 % interval")
    right.set_ylabel("branch of the map (true radius), thick to thin")
    right.set_title("Relative error")
    fig.tight_layout()
    return fig


def trajectory_figure(map_dir, truth=None):
    """The path from above, its height over time and, with the truth, its error over time."""
    T = alignment(map_dir.trajectory, truth.trajectory) if truth is not None else None
    stamps = np.array(list(map_dir.trajectory))
    time = (stamps - stamps[0]) * 1e-9
    position = np.array([p[:3, 3] for p in map_dir.trajectory.values()])
    columns = 3 if T is not None else 2
    fig, axes = plt.subplots(1, columns, figsize=(4.4 * columns, 4.2))
    true_position = true_time = None
    if T is not None:
        position = position @ T[:3, :3].T + T[:3, 3]
        true_position = np.array([p[:3, 3] for p in truth.trajectory.values()])
        true_time = (np.array(list(truth.trajectory)) - stamps[0]) * 1e-9
    top, side = axes[0], axes[1]
    if true_position is not None:
        top.plot(true_position[:, 0], true_position[:, 1], color=INK, linewidth=2.6, alpha=0.35, label="truth")
        side.plot(true_time, true_position[:, 2], color=INK, linewidth=2.6, alpha=0.35, label="truth")
    top.plot(position[:, 0], position[:, 1], color=PALETTE[4], linewidth=1.2, label="map")
    top.plot(*position[0, :2], "^", color=PALETTE[2], markersize=7, label="start")
    side.plot(time, position[:, 2], color=PALETTE[4], linewidth=1.2, label="map")
    for branch in map_dir.branches or []:
        if branch.order == 0 and branch.tree is not None:
            base = branch.chain.start[:1]
            base = base @ T[:3, :3].T + T[:3, 3] if T is not None else base
            top.plot(base[0, 0], base[0, 1], "o", color=PALETTE[5], markersize=8,
                     label="trunk" if "trunk" not in top.get_legend_handles_labels()[1] else None)
    top.set_aspect("equal", adjustable="datalim")
    top.set_xlabel("x [m]")
    top.set_ylabel("y [m]")
    top.set_title("Path of the lidar from above")
    top.legend(loc="best", fontsize=8.5)
    side.set_xlabel("time [s]")
    side.set_ylabel("z [m]")
    low, high = side.get_ylim()
    if high - low < 1.0:
        side.set_ylim(0.5 * (low + high) - 0.5, 0.5 * (low + high) + 0.5)
    side.set_title("Height of the lidar")
    side.legend(loc="best", fontsize=8.5)
    if T is not None:
        pairs = common_stamps(map_dir.trajectory, truth.trajectory)
        error = [np.linalg.norm((T @ map_dir.trajectory[a])[:3, 3] - truth.trajectory[b][:3, 3])
                 for a, b in pairs]
        axes[2].plot([(a - stamps[0]) * 1e-9 for a, _ in pairs], 100 * np.array(error), color=PALETTE[5])
        axes[2].set_xlabel("time [s]")
        axes[2].set_ylabel("position error [cm]")
        axes[2].set_ylim(bottom=0)
        axes[2].set_title("Error, first pose aligned")
    fig.tight_layout()
    return fig


SIDE_BINS = 36
STEEP_DEG = 45.0


def sides_seen(pieces, steep):
    """Share of a branch's length that was seen from each of 36 directions around it.

    Steep branches: compass directions, from +x counter-clockwise. Lying ones: from the upper side,
    counter-clockwise looking from base to tip (the axis taken upwards where it is not level).
    """
    total = np.zeros(SIDE_BINS)
    for length, axis, seen in pieces:
        basis = perpendicular_basis(axis)
        up = axis if axis[2] >= 0 else -axis
        if steep:
            zero, quarter = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
        else:
            zero = np.array([0.0, 0.0, 1.0]) - up[2] * up
            zero /= np.linalg.norm(zero)
            quarter = np.cross(up, zero)
        for k in range(SIDE_BINS):
            turn = 2.0 * np.pi * (k + 0.5) / SIDE_BINS
            direction = (np.cos(turn) * zero + np.sin(turn) * quarter) @ basis
            angle = np.arctan2(direction[1], direction[0]) / (2.0 * np.pi) % 1.0
            if seen[int(angle * len(seen)) % len(seen)]:
                total[k] += length
    return total / max(sum(p[0] for p in pieces), 1e-9)


def coverage_figure(map_dir):
    """Which side of every branch was seen, as a share of its measured length."""
    directions = map_dir.directions_seen()
    branches = [b for b in map_dir.branches if b.measured.any()]
    branches.sort(key=lambda b: (b.order, b.key))
    if not directions:
        return arc_figure(branches)
    groups = {True: [], False: []}
    for branch in branches:
        pieces = directions.get(branch.key)
        if not pieces:
            continue
        rise = abs(sum(length * (axis[2] if axis[2] >= 0 else -axis[2]) for length, axis, _ in pieces))
        steep = rise / sum(p[0] for p in pieces) > np.cos(np.radians(STEEP_DEG))
        groups[steep].append((branch, sides_seen(pieces, steep)))
    shown = {steep: rows[:40] for steep, rows in groups.items() if rows}
    heights = [max(len(rows), 2) for rows in shown.values()]
    fig, axes = plt.subplots(len(shown), 1, figsize=(8.2, 1.1 * len(shown) + 0.9 + 0.24 * sum(heights)),
                             gridspec_kw={"height_ratios": heights}, squeeze=False)
    picture = None
    for ax, (steep, rows) in zip(axes[:, 0], shown.items()):
        picture = ax.imshow(np.array([r[1] for r in rows]), aspect="auto", cmap="cividis", vmin=0, vmax=1,
                            extent=(0, 360, len(rows) - 0.5, -0.5), interpolation="nearest")
        for k in range(1, len(rows)):
            ax.axhline(k - 0.5, color="white", linewidth=1)
        ax.set_yticks(range(len(rows)))
        ax.set_yticklabels([f"{b.key} (order {b.order})" for b, _ in rows], fontsize=8)
        ax.set_xticks(range(0, 361, 45))
        ax.set_ylabel("branch")
        ax.grid(False)
        more = f" (first 40 of {len(groups[steep])})" if len(groups[steep]) > 40 else ""
        if steep:
            ax.set_xlabel("direction that was seen [°], counter-clockwise from +x of the map")
            ax.set_title("Steep branches and trunks: seen from which direction" + more)
        else:
            ax.set_xlabel("side that was seen [°]: 0 and 360 the upper side, 180 the lower")
            ax.set_title("Lying branches: seen from above, below or a side" + more)
    fig.tight_layout(rect=(0, 0, 0.9, 1))
    bar = fig.colorbar(picture, cax=fig.add_axes([0.92, 0.2, 0.018, 0.6]))
    bar.set_label("share of the length", fontsize=8.5)
    return fig


def arc_figure(branches):
    """How much of the way round every branch was seen, from the tables alone."""
    shown = branches[:40]
    fig, ax = plt.subplots(figsize=(6.2, 1.3 + 0.24 * len(shown)))
    for i, branch in enumerate(shown):
        arc = np.array([r["arc"] for r in branch.rows])[branch.measured]
        weight = branch.chain.lengths[branch.measured]
        mean = float(np.sum(arc * weight) / np.sum(weight))
        ax.barh(i, mean, color=branch_color(branch.key), edgecolor="#333333", linewidth=0.4, height=0.7)
        ax.text(mean + 4, i, f"{mean:.0f}°", va="center", fontsize=8)
    ax.set_yticks(range(len(shown)))
    ax.set_yticklabels([f"{b.key} (order {b.order})" for b in shown], fontsize=8)
    ax.set_ylim(len(shown) - 0.4, -0.6)
    ax.set_xlim(0, 385)
    ax.set_xticks(range(0, 361, 60))
    ax.set_xlabel("angle around the axis that was seen [°], 360 is all round")
    ax.set_ylabel("branch")
    more = f" (first 40 of {len(branches)})" if len(branches) > 40 else ""
    ax.set_title("Coverage" + more)
    fig.tight_layout()
    return fig


def timing_figure(timing):
    stages = timing.get("stages", {})
    names = list(stages)
    fig, ax = plt.subplots(figsize=(7.2, 1.7 + 0.36 * len(names)))
    smallest = min([s["p50_ms"] for s in stages.values() if s["p50_ms"] > 0.0] or [1.0])
    for i, name in enumerate(names):
        s = stages[name]
        ax.plot([max(s["p50_ms"], smallest), max(s["max_ms"], smallest)], [i, i], color="#cccccc", linewidth=3,
                zorder=1, solid_capstyle="round")
        for key, marker, color, text in (("p50_ms", "o", PALETTE[4], "median"),
                                         ("p99_ms", "s", PALETTE[5], "99th percentile"),
                                         ("max_ms", "|", INK, "maximum")):
            ax.plot(max(s[key], smallest), i, marker, color=color, markersize=7,
                    label=text if i == 0 else None, zorder=2)
    ax.axvline(100.0, color=SOFT, linestyle="--", linewidth=1, label="one scan at 10 Hz, 100 ms")
    ax.set_xscale("log")
    ax.set_yticks(range(len(names)))
    ax.set_yticklabels(names)
    ax.set_ylim(len(names) - 0.4, -0.6)
    ax.set_xlabel("time per scan [ms]")
    factor = timing.get("realtime_factor")
    ax.set_title("Time per scan and stage" + (f"; {factor:.1f} s of data per second of work" if factor else ""))
    height = fig.get_size_inches()[1]
    fig.tight_layout(rect=(0, 0.28 / height, 1, 1))
    fig.legend(loc="lower center", fontsize=8.5, ncol=4)
    return fig


def all_figures(map_dir, truth=None, scores=None):
    """(name, caption, figure) one by one, for what the map directory holds."""
    if map_dir.branches:
        trees = sorted({b.tree for b in map_dir.branches if b.tree is not None})
        if any(b.tree is None for b in map_dir.branches):
            trees.append(None)
        for tree in trees:
            suffix = "" if len(trees) == 1 or tree == trees[0] else \
                "_unattached" if tree is None else f"_{tree}"
            yield f"tree{suffix}", "The map from four sides, one colour per branch.", tree_figure(map_dir, tree)
        for tree in trees:
            trunk = trunk_of(map_dir, tree) if tree is not None else None
            if trunk is None or not trunk.measured.any():
                continue
            suffix = "" if tree == trees[0] else f"_{tree}"
            yield (f"taper{suffix}", "Diameter of the trunk over its height, with intervals.",
                   taper_figure(map_dir, tree, true_trunk(map_dir, truth, scores, tree)))
        if any(b.measured.any() for b in map_dir.branches):
            yield "coverage", "Which side of each branch was seen.", coverage_figure(map_dir)
    if scores and scores["branches"].get("matched"):
        yield "radius", "Radius of every found branch against the truth.", radius_figure(scores)
    if map_dir.trajectory:
        yield "trajectory", "The path of the lidar.", trajectory_figure(map_dir, truth)
    if map_dir.timing and map_dir.timing.get("stages"):
        yield "timing", "Time per scan and stage.", timing_figure(map_dir.timing)


def true_trunk(map_dir, truth, scores, tree):
    """The true trunk that a tree of the map belongs to, or None."""
    if truth is None or truth.branches is None or not scores:
        return None
    for entry, index in zip(scores["trees"], range(len(truth.tree_names))):
        if entry.get("tree_id") == tree:
            return next((b for b in truth.branches if b.tree == index and b.parent is None), None)
    return None


def save_figures(folder, map_dir, truth=None, scores=None):
    """Writes every figure as PNG; returns [(name, caption, path)]."""
    os.makedirs(folder, exist_ok=True)
    saved = []
    for name, caption, figure in all_figures(map_dir, truth, scores):
        path = os.path.join(folder, name + ".png")
        figure.savefig(path, metadata={"Software": None})
        plt.close(figure)
        saved.append((name, caption, path))
    return saved


