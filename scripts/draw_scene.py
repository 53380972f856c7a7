#!/usr/bin/python3
"""Draws a scene and one simulated VLP-16 scan of it, side by side, into a PNG.

The picture is rendered by the simulator's own ray caster (program preview_scene), so it shows exactly
what the lidar meets.
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

COLOURS = {"ground": "#c9b27c", "trunk": "#6b4423", "branch": "#d2691e", "leaf": "#2e8b57",
           "obstacle": "#707783"}


def default_program():
    root = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    return os.path.join(root, "build", "devel", "lib", "dendro_slam", "preview_scene")


def read_scan(path):
    columns = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
    return np.atleast_1d(columns)


def draw(scene, output, preview, radius, extra, title):
    with tempfile.TemporaryDirectory() as folder:
        command = [preview, scene, "-o", folder] + extra
        result = subprocess.run(command, capture_output=True, text=True)
        if result.returncode != 0:
            sys.exit(result.stderr.strip() or f"draw_scene: {preview} failed")
        picture = plt.imread(os.path.join(folder, "picture.ppm"))
        scan = read_scan(os.path.join(folder, "scan.csv"))
    figure = plt.figure(figsize=(13, 6.8))
    axes = figure.add_subplot(1, 2, 1)
    axes.imshow(picture)
    axes.set_axis_off()
    axes.set_title(title)
    axes = figure.add_subplot(1, 2, 2, projection="3d")
    near = np.hypot(scan["x"], scan["y"]) < radius
    for kind, colour in COLOURS.items():
        chosen = near & (scan["kind"] == kind)
        size = 0.4 if kind == "ground" else 2.0
        axes.scatter(scan["x"][chosen], scan["y"][chosen], scan["z"][chosen], s=size, c=colour,
                     label=f"{kind} ({int(chosen.sum())})", depthshade=False)
    axes.set_xlim(-radius, radius)
    axes.set_ylim(-radius, radius)
    top = max(3.0, float(scan["z"][near].max()) if near.any() else 3.0)
    axes.set_zlim(0, top)
    axes.set_box_aspect((2 * radius, 2 * radius, top), zoom=1.25)
    axes.view_init(elev=12, azim=-35)
    axes.set_title(f"one scan, {len(scan)} returns")
    axes.legend(loc="upper left", markerscale=6, fontsize=8)
    figure.tight_layout()
    figure.savefig(output, dpi=90)
    plt.close(figure)


def main():
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter,
                                     epilog="Further arguments go to preview_scene, for example "
                                            "--position 4.5 -3 1.5 --eye 9 -6 3 --look-at 0 0 3.")
    parser.add_argument("scene", help="scene file (YAML)")
    parser.add_argument("-o", "--output", required=True, help="PNG to write")
    parser.add_argument("--preview", default=default_program(), help="program preview_scene")
    parser.add_argument("--radius", type=float, default=6.0, help="half width of the scan's drawing [m]")
    arguments, extra = parser.parse_known_args()
    title = os.path.splitext(os.path.basename(arguments.scene))[0]
    draw(arguments.scene, arguments.output, arguments.preview, arguments.radius, extra, title)


if __name__ == "__main__":
    main()
