"""scripts/calibrate_rig.py: the rig file it writes and what it says; the calibration itself is tested
in test/sim/rig_calibrator_test.cpp."""
import importlib.util
import pathlib

import pytest
import yaml

ROOT = pathlib.Path(__file__).resolve().parents[2]
spec = importlib.util.spec_from_file_location("calibrate_rig", ROOT / "scripts/calibrate_rig.py")
calibrate_rig = importlib.util.module_from_spec(spec)
spec.loader.exec_module(calibrate_rig)

RESULT = {
    "known": True, "parent_frame": "camera_pose_frame", "child_frame": "velodyne",
    "translation_m": [0.1, -0.02, 0.034567], "time_offset_s": -0.0123,
    # Roll 90 degrees, then yaw 90 degrees about the fixed axes, by hand: (x y z w) = (1 1 1 1) / 2.
    "quaternion_xyzw": [0.5, 0.5, 0.5, 0.5],
    "rotation_sigma_deg": 0.05, "position_sigma_m": 0.003, "time_sigma_s": 0.0002,
    "odometry_scale": 1.004, "residual_rotation_deg": 0.1, "residual_position_m": 0.01, "motions": 400,
    "distance_m": 18.0, "scans": 300, "scans_registered": 299, "registration_rms_m": 0.006,
    "missing": [],
}


def test_rig_file_keeps_everything_else():
    template = (ROOT / "config/rig.yaml").read_text()
    text = calibrate_rig.rig_file(template, RESULT)
    before, after = yaml.safe_load(template)["rig"], yaml.safe_load(text)["rig"]
    assert after["lidar_in_camera"] == pytest.approx(
        {"x_m": 0.1, "y_m": -0.02, "z_m": 0.03457, "roll_deg": 90.0, "pitch_deg": 0.0,
         "yaw_deg": 90.0}, abs=1e-4)
    assert after["camera"]["time_offset_s"] == pytest.approx(-0.0123)
    assert after["lidar"] == before["lidar"], "the lidar's own time offset is another key"
    del before["lidar_in_camera"], after["lidar_in_camera"]
    del before["camera"]["time_offset_s"], after["camera"]["time_offset_s"]
    assert after == before
    assert len(text.splitlines()) == len(template.splitlines()), "comments stay"


def test_a_rig_file_without_the_keys_is_refused():
    with pytest.raises(SystemExit, match="lidar_in_camera/x_m"):
        calibrate_rig.rig_file("rig:\n  camera:\n    frame: a\n", RESULT)


def test_what_is_not_known_is_not_a_number():
    unknown = dict(RESULT, known=False, translation_m=None, time_offset_s=None,
                   missing=["the rig turned about one axis only"])
    text = "\n".join(calibrate_rig.summary(unknown))
    assert "position: not known" in text and "time offset: not known" in text
    assert "missing: the rig turned about one axis only" in text
    assert "roll 90.00" in text
