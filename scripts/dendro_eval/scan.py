"""One scan through stages 1 to 3, drawn as figures 5.2 (a) to (e) of the thesis.

What is drawn comes from the program describe_scan, which runs the same classes as the nodelets.
"""

import json
import subprocess

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.collections import PolyCollection  # noqa: E402
from matplotlib.lines import Line2D  # noqa: E402

from .errors import InputError  # noqa: E402
from .figures import INK, PALETTE, SOFT, branch_color, silhouettes, spread  # noqa: E402
from .geometry import Chain  # noqa: E402
from .programs import program  # noqa: E402

# As rviz shows them; kNone is not drawn.
LABELS = {1: ("ground", "#8C7D69"), 2: ("wood", "#E69F00"), 3: ("leaf", "#009E73"), 4: ("other", "#56B4E9")}
INITIAL, FINAL = PALETTE[5], PALETTE[4]
MAX_NAMES = 24


def describe(bag, index=None, stamp=None, config=None):
    """The scan as a dictionary with arrays: points (n, 3), label, segment, ring (n,), segments."""
    command = [program("describe_scan"), bag]
    command += ["--index", str(index)] if stamp is None else ["--stamp", repr(float(stamp))]
    if config:
        command += ["--config", config]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        lines = result.stderr.strip().splitlines() or ["describe_scan failed"]
        raise InputError(lines[-1].removeprefix("describe_scan: "))
    scan = json.loads(result.stdout)
    table = np.array(scan["points"], float).reshape(-1, 6)
    scan["points"] = table[:, :3]
    scan["label"], scan["segment"], scan["ring"] = (table[:, k].astype(int) for k in (3, 4, 5))
    for segment in scan["segments"]:
        for key in ("initial", "final"):
            if segment[key]:
                segment[key].update({k: np.array(segment[key][k]) for k in ("axis", "point", "foot")})
    return scan


def title_of(scan):
    return f"scan {scan['index']}, stamp {scan['stamp_ns'] // 10**9}.{scan['stamp_ns'] % 10**9 // 10**6:03d} s"


def label_figure(scan):
    """(a) What the network says of every return, in the range image's own coordinates."""
    azimuth = np.degrees(np.arctan2(-scan["points"][:, 1], scan["points"][:, 0]))
    fig, ax = plt.subplots(figsize=(10.5, 3.3))
    for value, (name, color) in LABELS.items():
        chosen = scan["label"] == value
        if chosen.any():
            ax.scatter(azimuth[chosen], scan["ring"][chosen], s=4, marker="s", color=color, linewidths=0,
                       label=f"{name} ({chosen.sum()})")
    ax.set_xlim(-180, 180)
    ax.set_xticks(range(-180, 181, 45))
    ax.set_ylim(-0.7, 15.7)
    ax.set_yticks(range(0, 16, 3))
    ax.set_xlabel("azimuth, clockwise from the lidar's x axis [°]")
    ax.set_ylabel("ring, 0 the lowest")
    ax.set_title(f"(a) Stage 1: label of every return, {title_of(scan)}")
    fig.tight_layout(rect=(0, 0.09, 1, 1))
    fig.legend(loc="lower center", ncol=4, markerscale=3, fontsize=8.5)
    return fig


class View:
    """An orthographic view of the wood of a scan from the sensor: right, up and toward the sensor."""

    def __init__(self, scan):
        wood = scan["segment"] >= 0
        if not wood.any():
            wood = scan["label"] == 2
        points = scan["points"][wood] if wood.any() else scan["points"]
        self.empty = len(points) == 0
        centre = points.mean(axis=0) if len(points) else np.zeros(3)
        bearing = np.arctan2(centre[1], centre[0])
        self.toward = np.array([-np.cos(bearing), -np.sin(bearing), 0.0])
        self.right = np.array([np.sin(bearing), -np.cos(bearing), 0.0])
        across = points @ self.right if len(points) else np.zeros(1)
        up = points[:, 2] if len(points) else np.zeros(1)
        margin = 0.4
        self.x = (float(across.min()) - margin, float(across.max()) + margin)
        self.y = (float(up.min()) - margin, float(up.max()) + margin)

    def size(self):
        """Size of a figure that shows it in proportion."""
        width, height = self.x[1] - self.x[0], self.y[1] - self.y[0]
        scale = min(8.0 / width, 6.0 / height, 3.0)
        return max(6.8, scale * width + 3.2), max(3.6, scale * height + 1.4)

    def frame(self, ax):
        ax.set_ylim(*self.y)
        ax.set_aspect("equal")
        ax.set_xlabel("to the right, seen from the lidar [m]")
        ax.set_ylabel("up, from the lidar [m]")

    def context(self, ax, scan):
        others = (scan["segment"] < 0) & np.isin(scan["label"], (2, 3))
        p = scan["points"][others]
        ax.scatter(p @ self.right, p[:, 2], s=3, color="#c8c8c8", linewidths=0, zorder=1)
        return int(others.sum())


def place_names(ax, view, entries):
    """Names beside the picture, each with a line to its place; entries: (x, y, text, colour)."""
    middle, span = 0.5 * sum(view.x), view.x[1] - view.x[0]
    # Room for the names, about an inch on either side.
    room = span * max(0.28, 1.1 / max(ax.figure.get_size_inches()[0] - 3.2, 1.0))
    ax.set_xlim(view.x[0] - room, view.x[1] + room)
    for side in (-1, 1):
        chosen = [e for e in entries if (e[0] >= middle) == (side > 0)]
        if not chosen:
            continue
        heights = spread([e[1] for e in chosen], (view.y[1] - view.y[0]) / 22.0)
        edge = view.x[1] if side > 0 else view.x[0]
        for (x, y, text, _), height in zip(chosen, heights):
            ax.plot([x, edge], [y, height], color=SOFT, linewidth=0.5, zorder=2)
            ax.text(edge, height, text, fontsize=7.5, va="center", ha="left" if side > 0 else "right")


def segment_figure(scan):
    """(b) The instances of stage 2, one colour each."""
    view = View(scan)
    fig, ax = plt.subplots(figsize=view.size())
    rest = view.context(ax, scan)
    entries = []
    sizes = sorted(scan["segments"], key=lambda s: -s["num_pixels"])
    for segment in sizes:
        p = scan["points"][scan["segment"] == segment["id"]]
        across = p @ view.right
        ax.scatter(across, p[:, 2], s=7, color=branch_color(segment["id"]), linewidths=0, zorder=3)
        if len(entries) < MAX_NAMES and len(p):
            top = int(np.argmax(p[:, 2]))
            entries.append((float(across[top]), float(p[top, 2]), f"{segment['id']} ({len(p)})", None))
    place_names(ax, view, entries)
    view.frame(ax)
    ax.set_title(f"(b) Stage 2: segments (returns), {title_of(scan)}\n"
                 f"grey: {rest} other returns on wood and leaves", fontsize=9)
    fig.tight_layout()
    return fig


def chain_of_fit(fit):
    """The frustum of one fit."""
    start, end = (fit["point"] + fit[k] * fit["axis"] for k in ("start_s_m", "end_s_m"))
    radii = [max(0.0, fit["radius_m"] + fit["taper_m_per_m"] * fit[k]) for k in ("start_s_m", "end_s_m")]
    return Chain([start], [end], [radii[0]], [radii[1]])


def choose_segment(scan):
    """The measured segment with the most returns, else the largest that has a start."""
    measured = [s for s in scan["segments"] if s["final"]] or [s for s in scan["segments"] if s["initial"]]
    return max(measured, key=lambda s: s["num_pixels"])["id"] if measured else None


def circle(centre, radius):
    t = np.linspace(0.0, 2.0 * np.pi, 181)
    return centre[0] + radius * np.cos(t), centre[1] + radius * np.sin(t)


def fit_figure(scan, segment_id=None):
    """(c) One fit: its returns, the axis, normal and radius that it starts from, and those it ends with."""
    if segment_id is None:
        segment_id = choose_segment(scan)
    segment = next((s for s in scan["segments"] if s["id"] == segment_id), None)
    if segment is None:
        raise InputError(f"the scan has no segment {segment_id}" if segment_id is not None
                         else "the scan holds no segment that could be fitted")
    p = scan["points"][scan["segment"] == segment_id]
    initial, final = segment["initial"], segment["final"]
    if initial is None and final is None:
        raise InputError(f"segment {segment_id} is too small to be fitted ({segment['reason']})")
    best = final or initial
    axis = best["axis"] if best["axis"][2] >= 0 else -best["axis"]
    centre = p.mean(axis=0)
    # Left: from the sensor, upright along the axis. Right: along the axis; the sensor is below.
    depth = centre - (centre @ axis) * axis
    depth /= np.linalg.norm(depth)
    side = np.cross(depth, axis)
    anchor = best["point"]

    def local(q):
        d = np.atleast_2d(q) - anchor
        return d @ side, d @ axis, d @ depth

    fig, (left, right) = plt.subplots(1, 2, figsize=(10.8, 5.2), gridspec_kw={"width_ratios": [1, 1.25]})
    x, z, y = local(p)
    low, high = float(z.min()), float(z.max())
    left.scatter(100 * x, 100 * z, s=10, color="#555555", linewidths=0, zorder=3, label=f"{len(p)} returns")
    right.scatter(100 * x, 100 * y, s=10, color="#555555", linewidths=0, zorder=3)
    entries = (("start", initial, INITIAL, "--"), ("end", final, FINAL, "-"))
    for name, fit, color, style in entries:
        if fit is None:
            continue
        a = fit["axis"] if fit["axis"] @ axis >= 0 else -fit["axis"]
        # Where the line has the heights of the picture's ends.
        ends = [fit["point"] + ((s - (fit["point"] - anchor) @ axis) / (a @ axis)) * a for s in (low, high)]
        ex, ez, _ = local(np.array(ends))
        taper = fit.get("taper_m_per_m", 0.0)
        half = [fit["radius_m"] + taper * float((e - fit["point"]) @ fit["axis"]) for e in ends]
        left.plot(100 * ex, 100 * ez, style, color=color, linewidth=1.8, zorder=4,
                  label=f"axis at the {name} of the fit")
        for sign in (-1, 1):
            left.plot(100 * (ex + sign * np.array(half)), 100 * ez, style, color=color, linewidth=0.9, zorder=2)
        cx, _, cy = local(fit["point"] + (((anchor - fit["point"]) @ axis) / (a @ axis)) * a)
        right.plot(*circle((100 * cx[0], 100 * cy[0]), 100 * fit["radius_m"]), style, color=color, linewidth=1.6,
                   zorder=2)
        right.plot(100 * cx, 100 * cy, "+" if style == "-" else "x", color=color, markersize=9, zorder=4)
        # The normal n of the thesis runs from the sensor to the foot on the axis; here from where it
        # meets the surface.
        n = fit["foot"] / np.linalg.norm(fit["foot"])
        nx, _, ny = (float(v[0]) for v in local(anchor + n))
        length = np.hypot(nx, ny)
        # The arrow's tail, so that the axes make room for it.
        right.plot(100 * cx[0] - 190 * fit["radius_m"] * nx / length,
                   100 * cy[0] - 190 * fit["radius_m"] * ny / length, alpha=0)
        right.annotate("", xy=(100 * cx[0], 100 * cy[0]), zorder=4,
                       xytext=(100 * cx[0] - 180 * fit["radius_m"] * nx / length,
                               100 * cy[0] - 180 * fit["radius_m"] * ny / length),
                       arrowprops={"arrowstyle": "->", "color": color, "linestyle": style, "linewidth": 1.2})
    left.set_xlabel("across, seen from the lidar [cm]")
    left.set_ylabel("along the axis [cm]")
    left.set_title("from the lidar: axis and outline")
    left.set_aspect("equal", adjustable="datalim")
    right.set_xlabel("across [cm]")
    right.set_ylabel("away from the lidar [cm]")
    right.set_title("along the axis: circle and normal (arrow)")
    right.set_aspect("equal", adjustable="datalim")
    note = []
    if initial is not None:
        note.append(f"start: radius {100 * initial['radius_m']:.2f} cm")
    if final is not None:
        note.append(f"end: radius {100 * final['radius_m']:.2f} ± {100 * final['radius_sigma_m']:.2f} cm")
        if initial is not None:
            turn = np.degrees(np.arccos(np.clip(abs(initial["axis"] @ final["axis"]), 0, 1)))
            note.append(f"the axis turned by {turn:.1f}°")
    else:
        note.append(f"UNRESOLVED: {segment['reason']}")
    fig.suptitle(f"(c) Stage 3: fit of segment {segment_id}, {title_of(scan)}\n" + ";  ".join(note), fontsize=10.5)
    handles = [Line2D([], [], marker="o", linestyle="", color="#555555", markersize=4, label=f"{len(p)} returns")]
    handles += [Line2D([], [], color=c, linestyle=s, label=f"{n} of the fit") for n, f, c, s in entries if f]
    fig.tight_layout(rect=(0, 0.05, 1, 1))
    fig.legend(handles=handles, loc="lower center", ncol=3, fontsize=8.5)
    return fig


def cylinder_figure(scan):
    """(d) All cylinders of the scan."""
    view = View(scan)
    fig, ax = plt.subplots(figsize=view.size())
    view.context(ax, scan)
    wood = scan["segment"] >= 0
    p = scan["points"][wood]
    ax.scatter(p @ view.right, p[:, 2], s=3, color="#777777", linewidths=0, zorder=2)
    entries, unresolved = [], 0
    for segment in sorted(scan["segments"], key=lambda s: -s["num_pixels"]):
        fit = segment["final"]
        if fit is None:
            unresolved += 1
            continue
        chain = chain_of_fit(fit)
        ax.add_collection(PolyCollection(silhouettes(chain, view.right), facecolor=branch_color(segment["id"]),
                                         edgecolor=INK, linewidth=0.5, alpha=0.75, zorder=3))
        if len(entries) < MAX_NAMES:
            top = chain.end[0] if chain.end[0, 2] >= chain.start[0, 2] else chain.start[0]
            entries.append((float(top @ view.right), float(top[2]),
                            f"{segment['id']}: {100 * fit['radius_m']:.1f} ± {100 * fit['radius_sigma_m']:.1f} cm",
                            None))
    place_names(ax, view, entries)
    view.frame(ax)
    found = len(scan["segments"]) - unresolved
    ax.set_title(f"(d) Stage 3: radii ± 1 sigma, {title_of(scan)}\n"
                 f"cylinders: {found}, segments without a radius: {unresolved}", fontsize=9)
    fig.tight_layout()
    return fig


def map_figure(scan, map_dir):
    """(e) The map and where the lidar was, from the side and from above."""
    stamps = np.array(list(map_dir.trajectory))
    here = map_dir.trajectory[int(stamps[np.argmin(np.abs(stamps - scan["stamp_ns"]))])]
    path = np.array([T[:3, 3] for T in map_dir.trajectory.values()])
    branches = map_dir.branches
    points = np.vstack([np.vstack([b.chain.start, b.chain.end]) for b in branches] + [path])
    low, high = points.min(axis=0) - 0.4, points.max(axis=0) + 0.4
    centre = np.mean(np.vstack([b.chain.start for b in branches]), axis=0)
    to_tree = centre - here[:3, 3]
    # Across the line from the lidar to the trees, so that the lidar stands beside them in the picture.
    bearing = np.arctan2(to_tree[1], to_tree[0])
    right = np.array([np.cos(bearing), np.sin(bearing), 0.0])
    fig, (side, top) = plt.subplots(1, 2, figsize=(11.2, 5.4))
    for ax, project, names in ((side, lambda q: (q @ right, q[:, 2]), ("across the view [m]", "z [m]")),
                               (top, lambda q: (q[:, 0], q[:, 1]), ("x [m]", "y [m]"))):
        for branch in branches:
            if ax is side:
                outline = silhouettes(branch.chain, right)
            else:
                outline = plan_outline(branch.chain)
            ax.add_collection(PolyCollection(outline, facecolor=branch_color(branch.key), edgecolor="#33333366",
                                             linewidth=0.3, zorder=3))
        ax.plot(*project(path), color=PALETTE[2], linewidth=1, zorder=2)
        ax.plot(*project(here[None, :3, 3]), "o", color=INK, markersize=6, zorder=5)
        x, y = (float(v[0]) for v in project(here[None, :3, 3]))
        for k, color in enumerate(("#D55E00", "#009E73", "#0072B2")):
            tip = here[:3, 3] + 0.6 * here[:3, k]
            tx, ty = (float(v[0]) for v in project(tip[None]))
            ax.plot([x, tx], [y, ty], color=color, linewidth=2.2, zorder=6)
        ax.set_aspect("equal", adjustable="datalim")
        ax.autoscale_view()
        ax.set_xlabel(names[0])
        ax.set_ylabel(names[1])
    side.set_ylim(low[2], high[2])
    side.set_title("from the side")
    top.set_title("from above")
    fig.suptitle(f"(e) Stage 4: the map of {len(branches)} branches and the lidar's pose at {title_of(scan)}",
                 fontsize=10.5)
    handles = [Line2D([], [], color=PALETTE[2], label="path"),
               Line2D([], [], marker="o", linestyle="", color=INK, label="lidar, its axes x y z"),
               Line2D([], [], color="#D55E00", label="x"), Line2D([], [], color="#009E73", label="y"),
               Line2D([], [], color="#0072B2", label="z")]
    fig.tight_layout(rect=(0, 0.05, 1, 1))
    fig.legend(handles=handles, loc="lower center", ncol=5, fontsize=8.5)
    return fig


def plan_outline(chain):
    """Outline of every frustum seen from above: (n, 4, 2)."""
    a, b = chain.start[:, :2], chain.end[:, :2]
    along = b - a
    length = np.linalg.norm(along, axis=1, keepdims=True)
    r0, r1 = chain.r0[:, None], chain.r1[:, None]
    unit = np.where(length > 1e-6, along / np.maximum(length, 1e-6), [[1.0, 0.0]])
    # A steep frustum is little more than its disc: lengthened so that its square is seen.
    steep = length < r0
    a, b = np.where(steep, a - r0 * unit, a), np.where(steep, b + r0 * unit, b)
    normal = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    return np.stack([a + r0 * normal, b + r1 * normal, b - r1 * normal, a - r0 * normal], axis=1)


def scan_figures(scan, map_dir=None, segment_id=None):
    """(name, caption, figure) one by one; what a scan does not hold is left out."""
    yield "scan_a_labels", "(a) Stage 1: label of every return of one scan.", label_figure(scan)
    if scan["segments"]:
        yield "scan_b_segments", "(b) Stage 2: the scan's segments, one colour each.", segment_figure(scan)
        if segment_id is not None or choose_segment(scan) is not None:
            yield ("scan_c_fit", "(c) Stage 3: one fit, where it starts (dashed) and where it ends.",
                   fit_figure(scan, segment_id))
        yield "scan_d_cylinders", "(d) Stage 3: all cylinders of the scan.", cylinder_figure(scan)
    if map_dir is not None and map_dir.branches and map_dir.trajectory:
        yield "scan_e_map", "(e) Stage 4: the map, and the lidar's pose at this scan.", map_figure(scan, map_dir)
