#!/usr/bin/python3
"""Scores a map directory against the truth of a simulation: one JSON object on standard output.

    scripts/evaluate_map.py MAP_DIR TRUTH [--per-scan] [--align first|path] [--figures [DIR]]

TRUTH is the folder that simulate_bag writes beside its bag (NAME.truth). The map is moved into the
truth's frame by the first pose that both have; with --align path by the whole path, which takes the
heading that drifted before a branch was in view out of the branches' scores. A score that cannot be
computed is null, and the "reasons" of its group say why.
"""

import argparse
import json
import math
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from dendro_eval.errors import InputError  # noqa: E402
from dendro_eval.files import MapDirectory, Truth  # noqa: E402
from dendro_eval.scores import ALIGNMENTS, evaluate  # noqa: E402


def rounded(value):
    """Six significant digits; numbers that are not finite become null."""
    if isinstance(value, dict):
        return {k: rounded(v) for k, v in value.items()}
    if isinstance(value, list):
        return [rounded(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("map_dir", metavar="MAP_DIR")
    parser.add_argument("truth", metavar="TRUTH")
    parser.add_argument("--per-scan", action="store_true",
                        help="also score single scans (files of map_bag --per-scan)")
    parser.add_argument("--align", choices=sorted(ALIGNMENTS), default="first",
                        help="what moves the map into the truth's frame: the first pose (default) or the whole path")
    parser.add_argument("--figures", nargs="?", const="", metavar="DIR",
                        help="draw figures into DIR (default MAP_DIR/figures)")
    arguments = parser.parse_args()
    try:
        map_dir, truth = MapDirectory(arguments.map_dir), Truth(arguments.truth)
        scores = evaluate(map_dir, truth, arguments.per_scan, arguments.align)
        print(json.dumps(rounded(scores), indent=2, allow_nan=False))
        if arguments.figures is not None:
            from dendro_eval.figures import save_figures
            save_figures(arguments.figures or os.path.join(arguments.map_dir, "figures"),
                         map_dir, truth, scores)
    except InputError as error:
        print(f"evaluate_map: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"evaluate_map: {error.filename or ''}: {error.strerror}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
