"""scripts/report.py: the report is whole and self-contained; bad tape files are named by their line."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
sys.path.insert(0, os.path.join(ROOT, "scripts"))
sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from dendro_eval.errors import InputError  # noqa: E402
from dendro_eval.figures import sides_seen  # noqa: E402
from dendro_eval.files import MapDirectory, Truth  # noqa: E402
from dendro_eval.geometry import perpendicular_basis  # noqa: E402
from dendro_eval.scan import scan_figures  # noqa: E402
from dendro_eval.tape import compare_tape  # noqa: E402
from dendro_eval.thesis import mean_errors, thesis_table  # noqa: E402
from map_maker import write_map, write_truth  # noqa: E402


def run(*arguments, expect=0):
    result = subprocess.run([sys.executable, os.path.join(ROOT, "scripts", "report.py"), *map(str, arguments)],
                            capture_output=True, text=True, check=False)
    assert result.returncode == expect, result.stderr
    return result.stdout if expect == 0 else result.stderr


def test_report_with_truth_and_tape(tmp_path):
    write_truth(tmp_path / "truth")
    write_map(tmp_path / "map", radius_add=0.002)
    (tmp_path / "tape.csv").write_text("branch,radius_cm\n1,6.0\n2,5.0\n")
    run(tmp_path / "map", "--truth", tmp_path / "truth", "--tape", tmp_path / "tape.csv")
    page = (tmp_path / "map" / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 6
    for text in ("Trees", "Against the truth", "Against the tape", "Branches", "3 of 3", "+0.20",
                 "Mean absolute difference 0.20 cm"):
        assert text in page, text
    # Self-contained: nothing is fetched.
    assert "http" not in page and "<script" not in page and "<link" not in page
    assert (tmp_path / "map" / "report.pdf").read_bytes().startswith(b"%PDF")
    assert not [f for f in os.listdir(tmp_path / "map") if f.endswith(".tmp")]


def test_report_of_a_map_alone_and_of_an_empty_map(tmp_path):
    write_map(tmp_path / "map")
    run(tmp_path / "map", "-o", tmp_path / "out" / "r")
    assert "Against the truth" not in (tmp_path / "out" / "r.html").read_text()
    table = (tmp_path / "map" / "cylinders.csv").read_text().splitlines()[0]
    for name in ("trajectory.tum", "timing.json", "trees.csv", "branches.csv"):
        os.remove(tmp_path / "map" / name)
    (tmp_path / "map" / "cylinders.csv").write_text(table + "\n")
    run(tmp_path / "map")
    assert "The map holds no branch" in (tmp_path / "map" / "report.html").read_text()
    assert "no such map directory" in run(tmp_path / "nothing", expect=2)


def test_tape_by_hand(tmp_path):
    write_map(tmp_path / "map")
    path = tmp_path / "tape.csv"
    # 2 pi * 0.06 m around branch 1; the trunk has 0.19 at 1 m.
    path.write_text("name,branch,height,circumference_cm\nlow,1,,37.7\nstem,,1.0,125.66\n")
    rows = compare_tape(str(path), MapDirectory(str(tmp_path / "map")))
    assert [r["name"] for r in rows] == ["low", "stem"]
    assert rows[0]["tape_m"] == pytest.approx(0.06, abs=1e-4)
    assert rows[0]["difference_m"] == pytest.approx(0.0, abs=1e-4)
    assert rows[1]["tape_m"] == pytest.approx(0.2, abs=1e-4)
    assert rows[1]["map_m"] == pytest.approx(0.19, abs=1e-6)
    path.write_text("height,radius_cm\n9,10\n")
    assert compare_tape(str(path), MapDirectory(str(tmp_path / "map")))[0]["note"] == "not seen there"


def test_coverage_says_which_side(tmp_path):
    # An upright trunk seen from +y only, and a level branch along +y seen from below only.
    for axis, wanted, steep in (((0, 0, 1.0), (0, 1.0, 0), True), ((0, 0, -1.0), (0, 1.0, 0), True),
                                ((0, 1.0, 0), (0, 0, -1.0), False), ((0, 0.8, 0.6), (0, 0.6, -0.8), False)):
        axis, wanted = np.array(axis), np.array(wanted)
        angle = 2 * np.pi * (np.arange(36) + 0.5) / 36
        around = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ perpendicular_basis(axis).T
        assert np.allclose(around @ axis, 0, atol=1e-12)
        seen = around @ wanted > np.cos(np.radians(45))
        share = sides_seen([(2.0, axis, seen), (1.0, axis, np.zeros(36, bool))], steep)
        middle = 90 if steep else 180  # counter-clockwise from +x; from the upper side
        centres = 10 * np.arange(36) + 5
        inside = np.abs(centres - middle) < 40
        assert np.allclose(share[inside], 2 / 3) and np.allclose(share[np.abs(centres - middle) > 50], 0)
    write_map(tmp_path / "map")
    document = {"landmarks": [{"id": 5, "axis": [0, 0, 1], "arc_seen": "0" * 35 + "1"}],
                "cylinders": [{"id": 0, "branch_id": 0, "landmark_id": 5, "start": [0, 0, 0], "end": [0, 0, 4]},
                              {"id": 1, "branch_id": 1, "landmark_id": -1, "start": [0, 0, 0], "end": [1, 0, 4]}]}
    (tmp_path / "map" / "tree_map.json").write_text(json.dumps(document))
    pieces = MapDirectory(str(tmp_path / "map")).directions_seen()
    assert list(pieces) == [0]
    length, _, seen = pieces[0][0]
    assert length == 4 and seen[0] and seen.sum() == 1  # bin 0 is the text's last digit
    run(tmp_path / "map")
    (tmp_path / "map" / "tree_map.json").write_text("{")
    assert "tree_map.json" in run(tmp_path / "map", expect=2)


def test_the_tables_of_the_thesis(tmp_path):
    # A palo verde of straight branches, and a map whose left branch is 3 mm too thick.
    tree = {0: (None, [(0, 0, 0, 0.1556), (0, 0, 1, 0.1556)]),
            1: (0, [(0, 0, 1, 0.0809), (-2, 0, 3, 0.0809)]),
            2: (0, [(0, 0, 1, 0.1132), (1, 0, 2.2, 0.1132)]),
            3: (2, [(1, 0, 2.2, 0.095), (1, 1, 4, 0.095)]),
            4: (2, [(1, 0, 2.2, 0.0607), (2.5, -0.5, 3.5, 0.0607)])}
    write_truth(tmp_path / "truth", tree=tree)
    scene = tmp_path / "truth" / "scene.yaml"
    scene.write_text(scene.read_text().replace("test_tree", "palo_verde"))
    branches = {k: (p, 0 if p is None else 1, [(*q[:3], q[3] + (0.003 if k == 1 else 0)) for q in points])
                for k, (p, points) in tree.items() if k != 4}
    write_map(tmp_path / "map", branches=branches, turn_deg=30, shift=(5, -2, 1))
    entry = thesis_table(MapDirectory(str(tmp_path / "map")), Truth(str(tmp_path / "truth")))
    rows = {r["name"]: r for r in entry["rows"]}
    assert [r["thesis_cm"] for r in entry["rows"]] == [14.51, 8.79, 12.56, 9.07, 5.24]
    assert rows["Base"]["ours_cm"] == pytest.approx(15.56, abs=0.01) and rows["Base"]["branches"] == [0]
    assert rows["Left"]["ours_cm"] == pytest.approx(8.39, abs=0.01)
    assert rows["RightRight"]["ours_cm"] is None and rows["RightRight"]["found_share"] == 0
    # The thesis: 0.49 cm to the nearest bound, 0.85 cm to the middle.
    bound, middle = mean_errors(entry["rows"], "thesis_cm")
    assert bound == pytest.approx(0.486, abs=1e-6) and middle == pytest.approx(0.851, abs=1e-6)
    bound, middle = mean_errors(entry["rows"], "ours_cm")
    assert bound == pytest.approx(0.0, abs=1e-6) and middle == pytest.approx((0.305 + 0.005) / 4, abs=0.01)
    run(tmp_path / "map", "--truth", tmp_path / "truth")
    page = (tmp_path / "map" / "report.html").read_text()
    assert "Table 5.2: palo verde" in page and "not found" in page and "14.51" in page
    # Another scene has no such table.
    scene.write_text(scene.read_text().replace("palo_verde", "oak"))
    assert thesis_table(MapDirectory(str(tmp_path / "map")), Truth(str(tmp_path / "truth"))) is None


def make_scan(segments=True):
    """A scan of one upright cylinder of 10 cm radius, 4 m in front of the sensor."""
    rng = np.random.default_rng(1)
    angle = rng.uniform(np.pi / 2, 3 * np.pi / 2, 80)
    wood = np.stack([4 + 0.1 * np.cos(angle), 0.1 * np.sin(angle), rng.uniform(-0.5, 0.5, 80)], axis=1)
    ground = np.stack([rng.uniform(1, 5, 50), rng.uniform(-2, 2, 50), np.full(50, -1.5)], axis=1)
    fit = {"axis": np.array([0, 0, 1.0]), "point": np.array([4.0, 0, 0]), "foot": np.array([4.0, 0, 0]),
           "radius_m": 0.1}
    final = {**fit, "radius_sigma_m": 0.001, "taper_m_per_m": 0.0, "start_s_m": -0.5, "end_s_m": 0.5}
    return {"stamp_ns": 1600000000123456789, "index": 7, "deskewed": True,
            "points": np.vstack([wood, ground]), "ring": np.arange(130) % 16,
            "label": np.array([2] * 80 + [1] * 50), "segment": np.array([0 if segments else -1] * 80 + [-1] * 50),
            "segments": [{"id": 0, "num_pixels": 80, "status": "MEASURED", "reason": "", "initial": fit,
                          "final": final}] if segments else []}


def test_one_scan_through_the_stages(tmp_path):
    write_map(tmp_path / "map")
    map_dir = MapDirectory(str(tmp_path / "map"))
    names = [name for name, _, _ in scan_figures(make_scan(), map_dir)]
    assert names == ["scan_a_labels", "scan_b_segments", "scan_c_fit", "scan_d_cylinders", "scan_e_map"]
    unresolved = make_scan()
    unresolved["segments"][0].update(final=None, status="UNRESOLVED", reason="too few rings")
    assert len(list(scan_figures(unresolved))) == 4
    assert [name for name, _, _ in scan_figures(make_scan(segments=False))] == ["scan_a_labels"]
    with pytest.raises(InputError, match="no segment 9"):
        list(scan_figures(make_scan(), segment_id=9))
    for arguments, word in ((["--bag", tmp_path / "no.bag"], "no such bag"),
                            (["--bag", __file__, "--scan", "3"], "test_report.py")):
        assert word in run(tmp_path / "map", *arguments, expect=2)


@pytest.mark.parametrize("text, words", [
    ("branch,radius_m\n1,0.06\n", ["line 1", "radius_m", "radius_cm"]),
    ("branch\n1\n", ["line 1", "radius_cm or circumference_cm"]),
    ("radius_cm\n6\n", ["line 1", "branch or height"]),
    ("branch,radius_cm\n1,6\n77,6\n", ["line 3", "no branch 77"]),
    ("branch,radius_cm\n1,six\n", ["line 2", "'six'"]),
    ("branch,radius_cm\n1,0.06\n", ["line 2", "metres"]),
    ("branch,radius_cm\n1,6000\n", ["line 2", "6000"]),
    ("branch,radius_cm\n1,-6\n", ["line 2", "-6"]),
    ("branch,radius_cm\n1,6,7\n", ["line 2", "2 fields"]),
    ("branch,height,radius_cm\n1,2,7\n", ["line 2", "branch or height"]),
    ("branch,radius_cm,circumference_cm\n1,,\n", ["line 2", "radius_cm or circumference_cm"]),
    ("branch,radius_cm,position_m\n1,6,9\n", ["line 2", "position_m"]),
    ("branch,radius_cm\n", ["no measurement"]),
    ("branch;radius_cm\n1;6\n", ["line 1", "semicolons"]),
    ("height,radius_cm\n1.3,19\n130,19\n", ["line 3", "height 130", "cm?"]),
    ('branch,radius_cm\n1,"6,1"\n', ["line 2", "'6,1'"]),
])
def test_bad_tape_names_the_line(tmp_path, text, words):
    write_map(tmp_path / "map")
    (tmp_path / "tape.csv").write_text(text)
    with pytest.raises(InputError) as error:
        compare_tape(str(tmp_path / "tape.csv"), MapDirectory(str(tmp_path / "map")))
    for word in words:
        assert word in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("reading, question", [
    ("60", "in mm?"), ("37.7", "a circumference?"), ("12", "a diameter?"), ("2.36", "in inches?"), ("6.4", None),
])
def test_tape_in_another_unit_is_doubted_by_its_line(tmp_path, reading, question):
    write_map(tmp_path / "map")
    (tmp_path / "tape.csv").write_text(f"branch,radius_cm\n2,5\n1,{reading}\n")
    rows = compare_tape(str(tmp_path / "tape.csv"), MapDirectory(str(tmp_path / "map")))
    assert rows[0]["doubt"] is None
    if question is None:
        assert rows[1]["doubt"] is None
    else:
        assert "line 3" in rows[1]["doubt"] and question in rows[1]["doubt"]
    # The difference is given all the same: it may be the map that is wrong.
    assert rows[1]["difference_m"] == pytest.approx(0.06 - float(reading) / 100, abs=1e-6)
