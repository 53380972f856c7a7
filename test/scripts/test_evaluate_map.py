"""scripts/evaluate_map.py on maps whose scores are known by hand."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
sys.path.insert(0, os.path.join(ROOT, "scripts"))
sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from dendro_eval.files import MapDirectory, Truth  # noqa: E402
from dendro_eval.ground import ground_height  # noqa: E402
from dendro_eval.scores import alignment, evaluate, path_alignment, trajectory_scores  # noqa: E402
from map_maker import MAP, write_labels, write_map, write_segments, write_truth  # noqa: E402


def score(tmp_path, *arguments, expect=0):
    result = subprocess.run(
        [sys.executable, os.path.join(ROOT, "scripts", "evaluate_map.py"), str(tmp_path / "map"),
         str(tmp_path / "truth"), *arguments], capture_output=True, text=True, check=False)
    assert result.returncode == expect, result.stderr
    return json.loads(result.stdout) if expect == 0 else result.stderr


def test_perfect_map_scores_perfect(tmp_path):
    write_truth(tmp_path / "truth")
    write_map(tmp_path / "map")
    s = score(tmp_path)
    assert s["trajectory"]["ate_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    assert s["trajectory"]["rpe_trans_m"] == pytest.approx(0.0, abs=1e-9)
    b = s["branches"]
    assert (b["truth"], b["observable"], b["found"], b["false"], b["unresolved"]) == (3, 3, 3, 0, 0)
    assert b["recall"] == b["precision"] == 1.0
    assert b["parent_correct_ratio"] == b["order_correct_ratio"] == 1.0
    for name in ("radius_error_rel_median", "radius_error_rel_p95", "radius_bias_rel", "radius_rmse_m",
                 "axis_error_deg_median", "centreline_error_m_median"):
        assert b[name] == pytest.approx(0.0, abs=1e-4), name
    assert b["length_error_rel_median"] == pytest.approx(0.0, abs=0.01)
    assert b["angle_error_deg_median"] == pytest.approx(0.0, abs=1e-3)
    assert b["sigma_coverage_68"] == b["sigma_coverage_95"] == 1.0
    tree = s["trees"][0]
    # Radius 0.20 - 0.01 * 1.3 at breast height.
    assert tree["dbh_truth_m"] == pytest.approx(0.374)
    assert tree["dbh_m"] == pytest.approx(0.374)
    assert tree["height_error_m"] == pytest.approx(0.0)
    assert s["timing"]["realtime_factor"] == 2.0
    assert s["timing"]["stages"]["total"]["p99_ms"] == 45.0
    # The path of these maps is straight.
    assert "reasons" not in b and set(s["trajectory"]["reasons"]) == {"ate_path_rmse_m"}


def test_frame_of_the_map_does_not_matter(tmp_path):
    write_truth(tmp_path / "truth")
    write_map(tmp_path / "map", turn_deg=75.0, shift=(3.0, -2.0, 0.7))
    s = score(tmp_path)
    assert s["trajectory"]["ate_rmse_m"] == pytest.approx(0.0, abs=1e-6)
    assert s["branches"]["found"] == 3
    assert s["branches"]["centreline_error_m_median"] == pytest.approx(0.0, abs=1e-6)


def test_shifted_radius_gives_the_known_error(tmp_path):
    write_truth(tmp_path / "truth")
    write_map(tmp_path / "map", radius_add=0.003, sigma=0.002)
    b = score(tmp_path)["branches"]
    # 0.003 / (0.18, 0.06, 0.05) at the middles; the trunk's middle has 0.18.
    assert b["radius_rmse_m"] == pytest.approx(0.003, abs=1e-5)
    assert b["radius_error_rel_median"] == pytest.approx(0.05, abs=1e-3)
    assert b["radius_bias_rel"] == pytest.approx((0.003 / 0.18 + 0.05 + 0.06) / 3, abs=1e-3)
    # 1.5 sigma off: outside of 68 %, inside of 95 %.
    assert b["sigma_coverage_68"] == 0.0
    assert b["sigma_coverage_95"] == 1.0


def test_trajectory_error_by_hand(tmp_path):
    write_truth(tmp_path / "truth")
    write_map(tmp_path / "map", drift_m=0.1)
    t = score(tmp_path)["trajectory"]
    # Every pose but the first, which is aligned, is 0.1 m off.
    assert t["ate_max_m"] == pytest.approx(0.1)
    assert t["ate_rmse_m"] == pytest.approx(0.1 * (11 / 12) ** 0.5, rel=1e-4)
    # 0.25 m a step: pairs four steps apart, only the first of eight sees the jump.
    assert t["rpe_trans_m"] == pytest.approx(0.1 / 8 ** 0.5, rel=1e-4)
    assert t["rpe_rot_deg"] == pytest.approx(0.0, abs=1e-6)


def test_false_and_missing_branches(tmp_path):
    write_truth(tmp_path / "truth")
    branches = dict(MAP)
    del branches[2]
    branches[5] = (0, 1, [(0, 0.2, 1.0, 0.05), (0, 1.5, 1.0, 0.05)])
    write_map(tmp_path / "map", branches)
    b = score(tmp_path)["branches"]
    assert (b["found"], b["false"]) == (2, 1)
    assert b["recall"] == pytest.approx(2 / 3, rel=1e-5)
    assert b["precision"] == pytest.approx(2 / 3, rel=1e-5)


def test_one_to_one_and_the_overlap_rule(tmp_path):
    write_truth(tmp_path / "truth")
    branches = dict(MAP)
    # The same branch twice: one match, one false. The longer overlap wins.
    branches[6] = (0, 1, [(0.5, 0, 2.5, 0.09), (1.0, 0, 3.0, 0.09)])
    write_map(tmp_path / "map", branches)
    b = score(tmp_path)["branches"]
    assert (b["found"], b["false"]) == (3, 1)
    assert {m["branch_id"] for m in b["matched"]} == {0, 1, 2}
    # A branch that lies only by a third beside the true one is no match.
    branches = dict(MAP)
    branches[2] = (0, 1, [(0, -1.6, 3.0, 0.05), (0, -2.8, 3.0, 0.05)])
    write_map(tmp_path / "map", branches)
    b = score(tmp_path)["branches"]
    assert (b["found"], b["false"]) == (2, 1)
    # 16 degrees off in direction, or 6 cm off to the side (radius 5 cm): no match; 4 cm: one.
    for points, found in (([(0, -0.2, 3.0, 0.05), (0, -1.9, 3.49, 0.05)], 2),
                          ([(0.06, -0.2, 3.0, 0.05), (0.06, -1.9, 3.0, 0.05)], 2),
                          ([(0.04, -0.2, 3.0, 0.05), (0.04, -1.9, 3.0, 0.05)], 3)):
        branches[2] = (0, 1, points)
        write_map(tmp_path / "map", branches)
        b = score(tmp_path)["branches"]
        assert b["found"] == found, points


def test_observable_counts_scans_with_thirty_returns(tmp_path):
    write_truth(tmp_path / "truth", hidden=(2,))
    write_map(tmp_path / "map")
    b = score(tmp_path)["branches"]
    assert (b["truth"], b["observable"], b["found"], b["recall"], b["false"]) == (3, 2, 2, 1.0, 0)
    write_truth(tmp_path / "truth", hits=29)
    b = score(tmp_path)["branches"]
    assert b["observable"] == 0 and b["recall"] is None
    assert "observable" in b["reasons"]["recall"]
    write_truth(tmp_path / "truth", poses=2)
    assert score(tmp_path)["branches"]["observable"] == 0


def test_wrong_parent(tmp_path):
    write_truth(tmp_path / "truth")
    branches = dict(MAP)
    branches[2] = (1, 2, MAP[2][2])
    write_map(tmp_path / "map", branches)
    b = score(tmp_path)["branches"]
    assert b["parent_correct_ratio"] == 0.5
    assert b["order_correct_ratio"] == pytest.approx(2 / 3, rel=1e-5)


def test_missing_truth_is_null_with_a_reason(tmp_path):
    write_truth(tmp_path / "truth")
    write_map(tmp_path / "map")
    os.remove(tmp_path / "truth" / "hits.csv")
    b = score(tmp_path)["branches"]
    assert b["recall"] is None and "hits.csv" in b["reasons"]["recall"]
    assert b["precision"] == 1.0
    os.remove(tmp_path / "truth" / "trajectory.tum")
    os.remove(tmp_path / "map" / "timing.json")
    s = score(tmp_path, "--per-scan")
    assert s["trajectory"]["ate_rmse_m"] is None
    assert "trajectory.tum" in s["trajectory"]["reasons"]["ate_rmse_m"]
    assert s["branches"]["found"] is None and s["branches"]["reasons"]["found"]
    assert s["timing"]["stages"] is None and "timing.json" in s["timing"]["reasons"]["stages"]
    for name in ("segments", "segmentation", "branches_in_scan"):
        values = [v for k, v in s[name].items() if k != "reasons"]
        assert all(v is None for v in values)
        assert "map_bag --per-scan" in next(iter(s[name]["reasons"].values()))
    assert s["trees"][0]["dbh_m"] is None


def test_empty_map(tmp_path):
    write_truth(tmp_path / "truth")
    write_map(tmp_path / "map", {9: (None, 0, [(30, 0, 0, 0.1), (30, 0, 1, 0.1)])}, status="UNRESOLVED")
    b = score(tmp_path)["branches"]
    assert (b["found"], b["false"], b["recall"], b["unresolved"]) == (0, 0, 0.0, 1)
    assert b["precision"] is None and b["radius_rmse_m"] is None


def test_bad_input_is_one_line(tmp_path):
    write_truth(tmp_path / "truth")
    assert "no such map directory" in score(tmp_path, expect=2)
    write_map(tmp_path / "map")
    table = (tmp_path / "map" / "cylinders.csv").read_text()
    (tmp_path / "map" / "cylinders.csv").write_text(table.replace("radius_m,", "radius,", 1))
    message = score(tmp_path, expect=2)
    assert "cylinders.csv" in message and "radius_m" in message and message.count("\n") == 1
    (tmp_path / "map" / "cylinders.csv").write_text(table.replace("MEASURED\n", "MEASURED,1\n", 1))
    assert "line 2" in score(tmp_path, expect=2)
    write_map(tmp_path / "map")
    (tmp_path / "truth" / "trajectory.tum").write_text("0.0 1 2 3\n")
    assert "line 1" in score(tmp_path, expect=2)


def test_single_scans(tmp_path):
    write_truth(tmp_path / "truth")
    write_map(tmp_path / "map")
    # The lidar stands at (5, 0.25 i, 1.5): the trunk's axis is at (-5, -0.25 i, .) in its frame.
    header = ("stamp,segment,num_points,num_rings,distance_m,visible_arc_deg,axis_x,axis_y,axis_z,point_x,"
              "point_y,point_z,radius_m,sigma_axis_1_deg,sigma_axis_2_deg,sigma_position_1_m,"
              "sigma_position_2_m,sigma_radius_m,start_x,start_y,start_z,end_x,end_y,end_z,end_sigma_m,"
              "taper_m_per_m,mad_m,status,reason")
    rows = [header]
    for i, add in enumerate((0.009, -0.009, 0.0181)):
        y = -0.25 * i
        rows.append(f"0.{i}00000000,0,50,8,5,120,0,0,1,-5,{y},0,{0.185 + add},0.5,0.5,0.01,0.01,0.01,"
                    f"-5,{y},-0.5,-5,{y},0.5,0.1,-0.01,0.01,MEASURED,")
    rows.append("0.000000000,1,3,1,5,10" + "," * 22 + "UNRESOLVED,too few rings")
    (tmp_path / "map" / "scan_cylinders.csv").write_text("\n".join(rows) + "\n")
    write_labels(tmp_path / "truth" / "labels.bin", b"DSTRUTH1",
                 [(0, [2] * 60 + [1] * 40, [0] * 40 + [1] * 20 + [-1] * 40, [0] * 60 + [-1] * 40)])
    write_labels(tmp_path / "map" / "scan_labels.bin", b"DSLABEL1",
                 [(0, [2] * 50 + [3] * 10 + [2] * 10 + [1] * 30, None, None)])
    # Segment 0: 30 of the trunk; segment 1: 10 of the trunk and 10 of branch 1.
    write_segments(tmp_path / "map" / "scan_segments.bin",
                   [(0, [0] * 30 + [1] * 20 + [-1] * 50, [5.0] * 45 + [9.0] * 55)])
    s = score(tmp_path, "--per-scan")
    g = s["segments"]
    assert (g["count"], g["measured"], g["matched"]) == (4, 3, 3)
    assert g["unresolved_ratio"] == 0.25
    # The radius of the truth at z = 1.5 is 0.185.
    assert g["radius_error_rel_median"] == pytest.approx(0.009 / 0.185, abs=1e-3)
    assert g["radius_bias_rel"] == pytest.approx(0.0181 / 3 / 0.185, abs=1e-3)
    assert g["sigma_coverage_68"] == pytest.approx(2 / 3, rel=1e-5)
    assert g["sigma_coverage_95"] == 1.0
    assert g["matched_10cm"] == 3
    assert g["radius_error_rel_median_10cm"] == g["radius_error_rel_median"]
    assert g["radius_bias_rel_10cm"] == g["radius_bias_rel"]
    assert g["sigma_coverage_68_10cm"] == g["sigma_coverage_68"]
    assert g["axis_error_deg_median"] == pytest.approx(0.0, abs=1e-6)
    m = s["segmentation"]
    assert m["accuracy"] == 0.8
    assert m["wood_iou"] == pytest.approx(50 / 70, rel=1e-5)
    assert m["wood_recall"] == pytest.approx(50 / 60, rel=1e-5)
    assert m["wood_recall_beyond_8m"] == pytest.approx(5 / 15, rel=1e-5)
    n = s["branches_in_scan"]
    assert n["purity"] == pytest.approx(40 / 50)
    # Only the trunk has 30 returns; its largest segment holds 30 of 40.
    assert n["completeness"] == pytest.approx(0.75)
    assert n["segments"] == 2
    assert n["pieces_per_branch"] == pytest.approx(2.0)


def test_figures(tmp_path):
    write_truth(tmp_path / "truth")
    write_map(tmp_path / "map")
    score(tmp_path, "--figures")
    figures = sorted(os.listdir(tmp_path / "map" / "figures"))
    assert "tree.png" in figures and "radius.png" in figures and "trajectory.png" in figures
    assert all(os.path.getsize(tmp_path / "map" / "figures" / f) > 5000 for f in figures)


def test_breast_height_counts_from_the_ground(tmp_path):
    # The generator starts a stem 15 cm below the ground; base and ground of generate_scene --seed 101.
    rough = {"type": "rough", "z": 0, "amplitude_m": 0.09542878844224682, "wavelength_m": 3.1343234263842414,
             "seed": 101}
    assert ground_height(rough, 0.0, 0.0) == pytest.approx(-0.1479151 + 0.15, abs=1e-6)
    assert ground_height({"type": "plane", "z": 0.4}, 3, 4) == 0.4
    assert ground_height({"type": "none"}, 0, 0) is None and ground_height(None, 0, 0) is None
    # TREE's trunk thins by 1 cm per metre: 10 cm of it in the ground make 2 mm of diameter at breast height.
    write_truth(tmp_path / "truth")
    write_map(tmp_path / "map")
    scene = tmp_path / "truth" / "scene.yaml"
    plain = scene.read_text()
    for z, expected, height in ((None, 0.374, 0.0), (-0.5, 0.374, 0.0), (0.1, 0.372, 0.1)):
        scene.write_text(plain + ("" if z is None else f"ground: {{type: plane, z: {z}}}\n"))
        tree = evaluate(MapDirectory(str(tmp_path / "map")), Truth(str(tmp_path / "truth")))["trees"][0]
        assert tree["dbh_truth_m"] == pytest.approx(expected, abs=1e-9)
        assert tree["height_error_m"] == pytest.approx(height, abs=1e-6)


def test_path_alignment_takes_a_turned_map_back():
    # A helix as truth; the estimate is turned by 2 degrees about its first pose, as when the heading drifts
    # before anything holds it.
    def pose(angle):
        T = np.eye(4)
        T[:3, 3] = [4.5 * np.cos(angle), 4.5 * np.sin(angle), 1.0 + 0.2 * angle]
        return T

    truth = {k * 10 ** 8: pose(0.1 * k) for k in range(100)}
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", 2.0, degrees=True).as_matrix()
    first = truth[0]
    estimate = {k: first @ turn @ np.linalg.inv(first) @ T for k, T in truth.items()}
    t = trajectory_scores(estimate, truth, path_alignment(estimate, truth))
    assert t["ate_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    assert t["ate_path_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    turned, _ = Rotation.align_vectors([T[:3, 3] - first[:3, 3] for T in truth.values()],
                                       [T[:3, 3] - first[:3, 3] for T in estimate.values()])
    assert path_alignment(estimate, truth)[:3, :3] == pytest.approx(turned.as_matrix(), abs=1e-9)
    # With the first pose given, as the default has it, the turn is an error of the path.
    estimate[0] = truth[0]
    t = trajectory_scores(estimate, truth, alignment(estimate, truth))
    assert t["ate_rmse_m"] > 0.1 and t["ate_path_rmse_m"] < 1e-9


def test_a_straight_path_does_not_tell_its_turn():
    truth = {k: np.block([[np.eye(3), np.array([[0.1 * k], [0.0], [0.0]])], [np.zeros((1, 3)), 1.0]])
             for k in range(10)}
    assert path_alignment(truth, truth) is None
    t = trajectory_scores(truth, truth, alignment(truth, truth))
    assert t["ate_path_rmse_m"] is None and "straight" in t["reasons"]["ate_path_rmse_m"]
