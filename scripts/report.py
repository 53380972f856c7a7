#!/usr/bin/python3
"""A report of a map directory: one self-contained HTML file and a PDF.

    scripts/report.py MAP_DIR [--truth TRUTH] [--tape CSV] [--bag BAG [--scan N|--stamp S]] [-o NAME]

Writes MAP_DIR/report.html and MAP_DIR/report.pdf (or NAME.html and NAME.pdf). With --truth (the folder
that simulate_bag writes) radii and trajectory are drawn against it; with --tape a table of differences
to tape measurements is added (columns: branch or height, radius_cm or circumference_cm). With --bag one
scan is followed through the stages, as figure 5.2 of the thesis does; without --scan or --stamp it is the
one in the middle of the map's trajectory. Maps of the thesis' two plants, simulated, also get its tables
5.1 and 5.2 with a column of ours.
"""

import argparse
import base64
import html
import io
import itertools
import os
import re
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.backends.backend_pdf import PdfPages  # noqa: E402

from dendro_eval.errors import InputError  # noqa: E402
from dendro_eval.figures import all_figures  # noqa: E402
from dendro_eval.files import MapDirectory, Truth  # noqa: E402
from dendro_eval.scan import describe, scan_figures  # noqa: E402
from dendro_eval.scores import evaluate  # noqa: E402
from dendro_eval.tape import compare_tape  # noqa: E402
from dendro_eval.thesis import mean_errors, outside, thesis_table  # noqa: E402

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 1120px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.6em; margin-bottom: .1em; } h2 { font-size: 1.2em; margin-top: 2em; border-bottom: 1px solid #ddd; }
table { border-collapse: collapse; font-size: .9em; } td, th { padding: .25em .7em; text-align: right; border-bottom: 1px solid #eee; }
th { border-bottom: 2px solid #888; vertical-align: bottom; } td.text, th.text { text-align: left; }
figure { margin: 1em 0; } figure img { max-width: 100%; } figcaption { color: #666; font-size: .9em; }
.swatch { display: inline-block; width: .9em; height: .9em; border: 1px solid #555; vertical-align: -.1em; }
.bad { color: #a33c00; }
"""


def number(value, digits=3, scale=1.0, sign=False):
    if value is None or value == "":
        return "&ndash;"
    return f"{float(value) * scale:{'+' if sign else ''}.{digits}f}"


def with_sigma(value, sigma, digits=1, scale=100.0):
    if value is None or value == "":
        return "&ndash;"
    return f"{float(value) * scale:.{digits}f} &plusmn; {float(sigma) * scale:.{digits}f}"


def table(header, rows, text_columns=(0,)):
    def cells(tag, values):
        return "".join(f'<{tag}{" class=text" if i in text_columns else ""}>{v}</{tag}>'
                       for i, v in enumerate(values))
    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f"<table><thead><tr>{cells('th', header)}</tr></thead><tbody>{body}</tbody></table>"


def tree_table(map_dir):
    return table(
        ["tree", "DBH [cm]", "at [m]", "height seen [m]", "branches", "orders",
         "stem volume [m&sup3;]", "wood volume [m&sup3;]", "above radius [cm]", "lean [&deg;]", "arc seen [&deg;]",
         "scans", "status"],
        [[r["tree_id"], with_sigma(r["dbh_m"], r["dbh_sigma_m"] or 0.0), number(r["dbh_height_m"], 2),
          number(r["height_m"], 2), r["num_branches"], r["max_branch_order"],
          number(r["stem_volume_m3"], 3),
          with_sigma(r["wood_volume_m3_above_min_radius"], r["volume_sigma_m3"], 3, 1.0),
          number(r["min_radius_m"], 1, 100), number(r["lean_deg"], 1), number(r["arc_coverage_deg"], 0),
          r["num_scans"], r["status"]] for r in map_dir.trees])


def branch_table(map_dir):
    from dendro_eval.figures import branch_color
    rows = []
    for r in sorted(map_dir.branch_rows, key=lambda r: (r["tree_id"] == "", int(r["tree_id"] or 0),
                                                        int(r["branch_order"]), int(r["branch_id"]))):
        swatch = f'<span class=swatch style="background:{branch_color(int(r["branch_id"]))}"></span>'
        rows.append([f'{swatch} {r["branch_id"]}', r["tree_id"] or "none", r["parent_branch_id"] or "&ndash;",
                     r["branch_order"], with_sigma(r["base_diameter_m"], r["base_diameter_sigma_m"]),
                     number(r["middle_diameter_m"], 1, 100), number(r["tip_diameter_m"], 1, 100),
                     number(r["length_m"], 2), number(r["angle_deg"], 0), number(r["azimuth_deg"], 0),
                     number(r["height_m"], 2), f'{r["num_measured"]} of {r["num_cylinders"]}'])
    return table(["branch", "tree", "parent", "order", "&oslash; base [cm]", "&oslash; middle [cm]",
                  "&oslash; tip [cm]", "length [m]", "angle [&deg;]", "azimuth [&deg;]", "height [m]",
                  "cylinders measured"], rows)


def score_table(scores):
    b, t = scores["branches"], scores["trajectory"]
    percent = lambda v: number(v, 1, 100) + ("" if v is None else " %")  # noqa: E731
    rows = [["branches found, of the observable", f'{b["found"]} of {b["observable"]}'],
            ["branches of the map that are none", b["false"]],
            ["radius error, median", percent(b["radius_error_rel_median"])],
            ["radius error, 95th percentile", percent(b["radius_error_rel_p95"])],
            ["radius bias", percent(b["radius_bias_rel"])],
            ["truths inside the 68 % / 95 % intervals",
             f'{percent(b["sigma_coverage_68"])} / {percent(b["sigma_coverage_95"])}'],
            ["axis error, median [&deg;]", number(b["axis_error_deg_median"], 2)],
            ["parent right", percent(b["parent_correct_ratio"])],
            ["trajectory error, RMS [cm]", number(t["ate_rmse_m"], 1, 100)],
            ["trajectory error, largest [cm]", number(t["ate_max_m"], 1, 100)]]
    for tree in scores["trees"]:
        rows.append([f'DBH of {html.escape(tree["name"])} [cm], truth / map',
                     f'{number(tree["dbh_truth_m"], 1, 100)} / '
                     f'{with_sigma(tree["dbh_m"], tree["dbh_sigma_m"] or 0.0)}'])
    return table(["score", ""], rows)


def tape_table(rows):
    differences = [abs(r["difference_m"]) for r in rows if r["difference_m"] is not None]
    body = [[html.escape(r["name"]), number(r["tape_m"], 2, 100), with_sigma(r["map_m"], r["sigma_m"] or 0, 2),
             number(r["difference_m"], 2, 100, sign=True), r["note"]] for r in rows]
    mean = f"<p>Mean absolute difference {100 * sum(differences) / len(differences):.2f} cm over " \
           f"{len(differences)} places.</p>" if differences else ""
    return table(["place", "tape, radius [cm]", "map, radius [cm]", "difference [cm]", ""], body,
                 text_columns=(0, 4)) + mean


def thesis_rows(entry):
    """Table 5.1 or 5.2 with our column, and below it how far off the tape each is."""
    body = []
    for r in entry["rows"]:
        tape = f'{r["low_cm"]:g}' if r["low_cm"] == r["high_cm"] else f'{r["low_cm"]:g} &ndash; {r["high_cm"]:g}'
        cells = [html.escape(r["name"]), tape, number(r["thesis_cm"], 2), with_sigma(r["ours_cm"], r["sigma_cm"] or 0,
                                                                                   2, 1.0)]
        for key in ("thesis_cm", "ours_cm"):
            cells.append(number(None if r[key] is None else outside(r[key], r["low_cm"], r["high_cm"]), 2))
        body.append(cells + [", ".join(map(str, r["branches"])) or "not found"])
    text = table(["segment", "tape [cm]", "thesis [cm]", "ours [cm]", "thesis, off the tape [cm]",
                  "ours, off the tape [cm]", "branches of the map"], body)
    for key, name in (("thesis_cm", "Thesis"), ("ours_cm", "Ours")):
        bound, middle = mean_errors(entry["rows"], key)
        if bound is not None:
            text += (f"<p>{name}: mean distance to the nearest tape bound {bound:.2f} cm, to the middle of the bounds "
                     f"{middle:.2f} cm.</p>")
    return text


def crown_table(map_dir):
    """Crowns by their leaf points; empty where none was measured."""
    rows = [[r["tree_id"], number(r["crown_volume_m3"], 1), number(r["crown_projected_area_m2"], 1),
             number(r["crown_base_height_m"], 2), number(r["crown_top_height_m"], 2), number(r["crown_alpha_m"], 2),
             r["crown_points"]] for r in map_dir.trees if r.get("crown_volume_m3")]
    if not rows:
        return ""
    return table(["tree", "crown volume [m&sup3;]", "projected area [m&sup2;]", "base [m]", "top [m]",
                  "alpha [m]", "leaf points"], rows)


def plain(text):
    """A table cell of the page as plain text."""
    text = re.sub(r"<[^>]*>", "", str(text))
    return html.unescape(text).strip()


def table_pages(title, page, rows_per_page=34):
    """Figures with the rows of an HTML table made by table()."""
    header = [plain(c) for c in re.findall(r"<th[^>]*>(.*?)</th>", page)]
    rows = [[plain(c) for c in re.findall(r"<td[^>]*>(.*?)</td>", row)]
            for row in re.findall(r"<tr>(<td.*?)</tr>", page)]
    notes = [plain(p) for p in re.findall(r"<p>(.*?)</p>", page)]
    for first in range(0, max(len(rows), 1), rows_per_page):
        part = rows[first:first + rows_per_page]
        row_height = 0.2  # inches
        last = first + rows_per_page >= len(rows)
        below = 0.2 + (row_height * len(notes) if last else 0.0)
        height = 0.55 + below + row_height * (len(part) + 1)
        figure = plt.figure(figsize=(11.7, height))
        figure.text(0.02, 1.0 - 0.3 / height, title + (" (continued)" if first else ""), fontsize=12)
        for k, note in enumerate(notes if last else []):
            figure.text(0.02, (below - row_height * (k + 0.8)) / height, note, fontsize=8.5)
        ax = figure.add_axes([0.02, below / height, 0.96, row_height * (len(part) + 1) / height])
        ax.axis("off")
        if not part:
            continue
        width = [max([len(header[i])] + [len(r[i]) for r in rows]) + 2 for i in range(len(header))]
        total = min(1.0, sum(width) / 130)
        drawn = ax.table(cellText=part, colLabels=header, cellLoc="right", edges="horizontal",
                         colWidths=[w / sum(width) for w in width], bbox=[0.0, 0.0, total, 1.0])
        drawn.auto_set_font_size(False)
        drawn.set_fontsize(8)
        for (row, column), cell in drawn.get_celld().items():
            cell.set_edgecolor("#bbbbbb")
            if column == 0:
                cell.set_text_props(ha="left")
            if row == 0:
                cell.set_text_props(weight="bold")
        yield figure


def chosen_scan(arguments, map_dir):
    """The scan of the bag that the report follows through the stages."""
    if not os.path.isfile(arguments.bag):
        raise InputError(f"{arguments.bag}: no such bag")
    if arguments.scan is not None or arguments.stamp is not None:
        return describe(arguments.bag, arguments.scan, arguments.stamp)
    if not map_dir.trajectory:
        return describe(arguments.bag, 0)
    stamps = list(map_dir.trajectory)
    return describe(arguments.bag, stamp=stamps[len(stamps) // 2] * 1e-9)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("map_dir", metavar="MAP_DIR")
    parser.add_argument("--truth", help="truth folder of the simulation")
    parser.add_argument("--tape", metavar="CSV", help="tape measurements")
    parser.add_argument("--bag", help="bag of the map, to follow one of its scans through the stages")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--scan", type=int, metavar="N", help="number of that scan, from 0")
    which.add_argument("--stamp", type=float, metavar="S", help="stamp of that scan [s]")
    parser.add_argument("-o", "--output", metavar="NAME", help="path without ending; default MAP_DIR/report")
    arguments = parser.parse_args()
    try:
        map_dir = MapDirectory(arguments.map_dir)
        truth = Truth(arguments.truth) if arguments.truth else None
        scores = evaluate(map_dir, truth) if truth else None
        tape = compare_tape(arguments.tape, map_dir) if arguments.tape else None
        for row in tape or []:
            if row["doubt"]:
                print(f"report: {arguments.tape}: {row['doubt']}", file=sys.stderr)
        thesis = thesis_table(map_dir, truth) if truth else None
        scan = chosen_scan(arguments, map_dir) if arguments.bag else None
        name = arguments.output or os.path.join(arguments.map_dir, "report")
        title = "Map of " + os.path.basename(os.path.normpath(arguments.map_dir))
        parts = [f"<h1>{html.escape(title)}</h1>"]
        loose = sum(b.tree is None for b in map_dir.branches or [])
        parts.append(f"<p>{len(map_dir.trees or [])} trees, {len(map_dir.branches or []) - loose} branches, "
                     f"{loose} pieces that could not be attached. Intervals are &plusmn; 1 sigma.</p>")
        if not map_dir.branches:
            parts.append("<p class=bad>The map holds no branch.</p>")
        if map_dir.trees:
            parts.append("<h2>Trees</h2>" + tree_table(map_dir))
        if scores:
            parts.append("<h2>Against the truth</h2>" + score_table(scores))
        if thesis:
            parts.append(f"<h2>{html.escape(thesis['title'])}</h2>" + thesis_rows(thesis))
        if tape:
            parts.append("<h2>Against the tape</h2>" + tape_table(tape))
        crowns = crown_table(map_dir) if map_dir.trees else ""
        if crowns:
            parts.append("<h2>Crowns</h2>" + crowns)
        tables = []  # of the PDF: before the figures
        if map_dir.trees:
            tables.append(("Trees", tree_table(map_dir)))
        if scores:
            tables.append(("Against the truth", score_table(scores)))
        if thesis:
            tables.append((thesis["title"], thesis_rows(thesis)))
        if tape:
            tables.append(("Against the tape", tape_table(tape)))
        if crowns:
            tables.append(("Crowns", crowns))
        os.makedirs(os.path.dirname(os.path.abspath(name)), exist_ok=True)
        with PdfPages(name + ".pdf.tmp", metadata={"Title": title, "CreationDate": None}) as pdf:
            def add_tables(which):
                for heading, text in which:
                    for figure in table_pages(heading, text):
                        pdf.savefig(figure)
                        plt.close(figure)

            add_tables(tables)
            figures = all_figures(map_dir, truth, scores)
            if scan:
                figures = itertools.chain(figures, scan_figures(scan, map_dir))
            for _, caption, figure in figures:
                picture = io.BytesIO()
                figure.savefig(picture, format="png", metadata={"Software": None})
                data = base64.b64encode(picture.getvalue()).decode()
                parts.append(f'<figure><img alt="{html.escape(caption)}" src="data:image/png;base64,{data}">'
                             f"<figcaption>{html.escape(caption)}</figcaption></figure>")
                pdf.savefig(figure)
                plt.close(figure)
            if map_dir.branch_rows:
                add_tables([("Branches", branch_table(map_dir))])
            if not pdf.get_pagecount():
                figure = plt.figure(figsize=(6, 2))
                figure.text(0.5, 0.5, "The map holds no branch.", ha="center")
                pdf.savefig(figure)
                plt.close(figure)
        os.replace(name + ".pdf.tmp", name + ".pdf")
        if map_dir.branch_rows:
            parts.append("<h2>Branches</h2>" + branch_table(map_dir))
        page = (f"<!doctype html><html lang=en><head><meta charset=utf-8><title>{html.escape(title)}</title>"
                f"<style>{STYLE}</style></head><body>{''.join(parts)}</body></html>\n")
        with open(name + ".html.tmp", "w", encoding="utf-8") as stream:
            stream.write(page)
        os.replace(name + ".html.tmp", name + ".html")
        print(f"{name}.html\n{name}.pdf")
    except InputError as error:
        print(f"report: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"report: {error.filename or ''}: {error.strerror}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
