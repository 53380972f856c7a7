#!/usr/bin/python3
"""Draws one scan of a bag through the stages, as figures 5.2 (a) to (e) of the thesis.

    scripts/draw_scan.py BAG (--index N | --stamp S) [--map MAP_DIR] [--segment ID] [-o DIR]

Writes scan_a_labels.png, scan_b_segments.png, scan_c_fit.png, scan_d_cylinders.png and, with --map,
scan_e_map.png into DIR (default: scan_N beside the bag). Stamps below 86400 s are counted from the bag's
first scan. The fit drawn in (c) is that of --segment, else of the largest measured segment.
"""

import argparse
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

import matplotlib.pyplot as plt  # noqa: E402

from dendro_eval.errors import InputError  # noqa: E402
from dendro_eval.files import MapDirectory  # noqa: E402
from dendro_eval.scan import describe, scan_figures  # noqa: E402


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("bag", metavar="BAG")
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--index", type=int, metavar="N", help="number of the scan, from 0")
    which.add_argument("--stamp", type=float, metavar="S", help="stamp of the scan [s]")
    parser.add_argument("--map", metavar="MAP_DIR", help="map directory, for figure (e)")
    parser.add_argument("--segment", type=int, metavar="ID", help="segment whose fit is drawn")
    parser.add_argument("--config", metavar="YAML", help="sections of the nodelets, as map_bag takes them")
    parser.add_argument("-o", "--output", metavar="DIR", help="folder to write into")
    arguments = parser.parse_args()
    try:
        if not os.path.isfile(arguments.bag):
            raise InputError(f"{arguments.bag}: no such bag")
        scan = describe(arguments.bag, arguments.index, arguments.stamp, arguments.config)
        map_dir = MapDirectory(arguments.map) if arguments.map else None
        folder = arguments.output or os.path.join(os.path.dirname(os.path.abspath(arguments.bag)),
                                                  f"scan_{scan['index']}")
        os.makedirs(folder, exist_ok=True)
        for name, _, figure in scan_figures(scan, map_dir, arguments.segment):
            path = os.path.join(folder, name + ".png")
            figure.savefig(path, metadata={"Software": None})
            plt.close(figure)
            print(path)
    except InputError as error:
        print(f"draw_scan: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"draw_scan: {error.filename or ''}: {error.strerror}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
