#!/usr/bin/python3
"""Draws a scene and one simulated VLP-16 scan of it, seen by the same camera, side by side, into a PNG.

The picture is rendered by the simulator's own ray caster (program preview_scene), so it shows exactly
what the lidar meets. Returns have the colour of what they truly fell on; every branch has its own.

    scripts/draw_scene.py config/scenes/thesis_tree.yaml -o thesis_tree.png
    scripts/draw_scene.py --all doc/scenes          # every shipped scene, from a good place
"""
import argparse
import os
import subprocess
import sys
import tempfile

import matplotlib
matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
SCENES = os.path.join(ROOT, "config", "scenes")
# Where the lidar stands, where the picture is taken from, and its centre.
VIEWS = {
    "thesis_tree": ([6.5, -1.0, 3.2], [8.4, -6.6, 4.4], [0.0, 0.0, 3.3]),
    "thesis_tree_pillars": ([2.0, -5.5, 3.2], [13.5, -8.5, 8.0], [0.0, 0.0, 2.2]),
    "saguaro": ([-1.5, -6.5, 3.0], [-3.0, -10.0, 4.2], [0.0, 0.0, 3.0]),
    "palo_verde": ([2.5, -5.8, 2.6], [6.4, -5.4, 3.6], [0.0, 0.0, 2.5]),
    "orchard_row": ([-1.0, -5.5, 2.2], [-5.5, -8.5, 3.6], [0.2, 0.0, 2.0]),
    "savanna": ([8.5, -6.0, 2.4], [2.5, -8.0, 4.0], [11.5, 1.5, 2.6]),
}
BACKGROUND = "#10141a"
KINDS = {"ground": "#8f7f5c", "leaf": "#4fb35a", "obstacle": "#8e99ab", "trunk": "#e08a3c"}
BRANCHES = ["#f2c14e", "#5ec4e8", "#e86a92", "#b58cf0", "#f27d52", "#7ee0c0", "#d9e56b", "#f0a8d0"]


def default_program():
    return os.path.join(ROOT, "build", "devel", "lib", "dendro_slam", "preview_scene")


def project(points, eye, target):
    """Image coordinates in half heights (x right, y down) and depth [m], as preview_scene's camera."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    d = points - eye
    depth = d @ forward
    scale = 1.0 / (np.tan(np.radians(25.0)) * np.maximum(depth, 1e-6))
    return d @ right * scale, -(d @ up) * scale, depth


def draw(scene, output, preview, view, extra):
    lidar, eye, target = (np.asarray(v, float) for v in view)
    with tempfile.TemporaryDirectory() as folder:
        command = [preview, scene, "-o", folder, "--width", "720", "--height", "720"]
        for option, place in (("--position", lidar), ("--eye", eye), ("--look-at", target)):
            command += [option] + [repr(float(v)) for v in place]
        result = subprocess.run(command + extra, capture_output=True, text=True)
        if result.returncode != 0:
            sys.exit(result.stderr.strip() or f"draw_scene: {preview} failed")
        picture = plt.imread(os.path.join(folder, "picture.ppm"))
        scan = np.atleast_1d(np.genfromtxt(os.path.join(folder, "scan.csv"), delimiter=",", names=True, dtype=None,
                                           encoding="utf-8"))
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 6.35), facecolor=BACKGROUND)
    name = os.path.splitext(os.path.basename(scene))[0]
    left.imshow(picture)
    left.set_title(name, color="white", fontsize=13)
    right.set_facecolor(BACKGROUND)
    points = np.column_stack([scan[c] for c in "xyz"])
    x, y, depth = project(points, eye, target)
    visible = (depth > 0.5) & (np.abs(x) < 1.0) & (np.abs(y) < 1.0)
    order = np.argsort(-depth)
    colour = np.array([KINDS.get(k, "#ffffff") for k in scan["kind"]], dtype=object)
    woody = scan["kind"] == "branch"
    ids = np.unique(np.column_stack([scan["tree"][woody], scan["branch"][woody]]), axis=0)
    for i, (tree, branch) in enumerate(ids):
        colour[woody & (scan["tree"] == tree) & (scan["branch"] == branch)] = BRANCHES[i % len(BRANCHES)]
    base = np.where(scan["kind"] == "ground", 2.0, 7.0)
    size = np.clip(base * (np.linalg.norm(target - eye) / np.maximum(depth, 0.5)) ** 1.3, 0.4, 30.0)
    order = order[visible[order]]
    right.scatter(x[order], y[order], s=size[order], c=list(colour[order]), linewidths=0)
    sx, sy, sd = project(lidar[None], eye, target)
    if sd[0] > 0 and abs(sx[0]) < 1 and abs(sy[0]) < 1:
        right.plot(sx, sy, marker="o", color="white", markersize=7, markeredgecolor="black")
        side = -1 if sx[0] > 0.8 else 1
        right.annotate("lidar", (sx[0], sy[0]), (8 * side, 6), textcoords="offset points", color="white", fontsize=10,
                       ha="left" if side > 0 else "right")
    right.set_xlim(-1, 1)
    right.set_ylim(1, -1)
    right.set_aspect("equal")
    right.set_title(f"one revolution of the VLP-16, {len(scan):,} returns", color="white", fontsize=13)
    kinds = [k for k in ("trunk", "branch", "leaf", "obstacle", "ground") if np.any(scan["kind"] == k)]
    handles = [plt.Line2D([], [], marker="o", linestyle="", color=KINDS.get(k, BRANCHES[0]),
                          label=f"{k} {int(np.sum(scan['kind'] == k)):,}") for k in kinds]
    right.legend(handles=handles, loc="upper left", frameon=False, labelcolor="white", fontsize=9, borderaxespad=0.2)
    for axes in (left, right):
        axes.set_xticks([])
        axes.set_yticks([])
        for spine in axes.spines.values():
            spine.set_visible(False)
    figure.subplots_adjust(0.005, 0.005, 0.995, 0.945, wspace=0.01)
    figure.savefig(output, dpi=95, facecolor=BACKGROUND)
    plt.close(figure)
    shrink(output)


def shrink(output):
    """Fewer colours in the rendered half make a third of the bytes; the scan's are few already."""
    from PIL import Image
    image = Image.open(output).convert("RGB")
    box = (0, 0, image.width // 2, image.height)
    image.paste(image.crop(box).quantize(200, dither=Image.Dither.NONE).convert("RGB"), box)
    image.save(output, optimize=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter,
                                     epilog="Further arguments go to preview_scene, for example "
                                            "--lidar-return_mode dual, or --path PATH --scan 100.")
    parser.add_argument("scene", nargs="?", help="scene file (YAML)")
    parser.add_argument("-o", "--output", help="PNG to write")
    parser.add_argument("--all", metavar="FOLDER", help="draw every shipped scene into this folder")
    parser.add_argument("--preview", default=default_program(), help="program preview_scene")
    for name, meaning in (("--position", "where the lidar stands, upright [m]"),
                          ("--eye", "where the picture is taken from [m]"), ("--look-at", "its centre [m]")):
        parser.add_argument(name, nargs=3, type=float, metavar=("X", "Y", "Z"), help=meaning)
    arguments, extra = parser.parse_known_args()
    if (arguments.scene is None) == (arguments.all is None):
        parser.error("expected either SCENE and -o PNG, or --all FOLDER")
    if arguments.scene and not arguments.output:
        parser.error("expected -o PNG")
    if not os.access(arguments.preview, os.X_OK):
        sys.exit(f"draw_scene: {arguments.preview} is not built; scripts/build preview_scene")
    if arguments.all:
        os.makedirs(arguments.all, exist_ok=True)
        for name, view in VIEWS.items():
            draw(os.path.join(SCENES, name + ".yaml"), os.path.join(arguments.all, name + ".png"), arguments.preview,
                 view, extra)
        return
    name = os.path.splitext(os.path.basename(arguments.scene))[0]
    view = VIEWS.get(name, ([4.5, -3.0, 1.5], [8.5, -5.7, 3.0], [0.0, 0.0, 3.0]))
    view = [given or default for given, default in zip((arguments.position, arguments.eye, arguments.look_at), view)]
    draw(arguments.scene, arguments.output, arguments.preview, view, extra)


if __name__ == "__main__":
    main()
