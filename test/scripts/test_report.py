"""scripts/report.py: the report is whole and self-contained; bad tape files are named by their line."""

import os
import subprocess
import sys

import pytest

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
sys.path.insert(0, os.path.join(ROOT, "scripts"))
sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from dendro_eval.errors import InputError  # noqa: E402
from dendro_eval.files import MapDirectory  # noqa: E402
from dendro_eval.tape import compare_tape  # noqa: E402
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
])
def test_bad_tape_names_the_line(tmp_path, text, words):
    write_map(tmp_path / "map")
    (tmp_path / "tape.csv").write_text(text)
    with pytest.raises(InputError) as error:
        compare_tape(str(tmp_path / "tape.csv"), MapDirectory(str(tmp_path / "map")))
    for word in words:
        assert word in str(error.value)
    assert "\n" not in str(error.value)
