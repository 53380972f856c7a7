#!/usr/bin/python3
"""Finds where the lidar sits on the camera, and the offset of their clocks, from a bag of both.

    scripts/calibrate_rig.py BAG [-o rig.yaml] [--rig config/rig.yaml] [options of calibrate_rig]

Move the rig by hand for 30 to 60 s where walls, trunks and the ground surround it: walk slowly, and
turn it all the time about at least two axes by 20 degrees and more (nod, roll, swing). The lidar's
motion comes from its scans alone; aligned with the odometry's it gives rotation, position and time
offset with their uncertainty. What the motion does not show is not given: the summary says how to
move instead, and the exit status is 3.

-o writes a rig file with the result (keys `lidar_in_camera` and the camera's `time_offset_s`), the
rest as in --rig. The work is done by the program calibrate_rig (build first, then source
build/devel/setup.bash or run from the checkout); its JSON goes to standard output with --json.
"""
import argparse
import json
import os
import pathlib
import re
import shutil
import subprocess
import sys

from scipy.spatial.transform import Rotation

ROOT = pathlib.Path(__file__).resolve().parents[1]


def find_program():
    """The program, in the build of this checkout or where ROS finds it."""
    built = ROOT / "build/devel/lib/dendro_slam/calibrate_rig"
    if os.access(built, os.X_OK):
        return str(built)
    for prefix in os.environ.get("CMAKE_PREFIX_PATH", "").split(":"):
        candidate = pathlib.Path(prefix) / "lib/dendro_slam/calibrate_rig"
        if os.access(candidate, os.X_OK):
            return str(candidate)
    return shutil.which("calibrate_rig")


def fixed_axes_deg(quaternion):
    """Roll, pitch, yaw about fixed axes in this order, as rig files have them [deg]."""
    return Rotation.from_quat(quaternion).as_euler("xyz", degrees=True)


def summary(result):
    """The result in words, one line each."""
    lines = [f"{result['scans_registered']} of {result['scans']} scans followed over "
             f"{result['distance_m']:.1f} m, returns within {1e3 * result['registration_rms_m']:.1f} "
             f"mm of their surfaces; {result['motions']} motions compared"]
    if result["quaternion_xyzw"] is not None:
        roll, pitch, yaw = fixed_axes_deg(result["quaternion_xyzw"])
        lines.append(f"rotation {result['child_frame']} in {result['parent_frame']}: roll {roll:.2f}, "
                     f"pitch {pitch:.2f}, yaw {yaw:.2f} degrees "
                     f"(+-{result['rotation_sigma_deg']:.2f} about the least sure axis)")
    else:
        lines.append("rotation: not known")
    if result["translation_m"] is not None:
        x, y, z = result["translation_m"]
        lines.append(f"position: {x:.4f}, {y:.4f}, {z:.4f} m "
                     f"(+-{1e3 * result['position_sigma_m']:.1f} mm in the least sure direction)")
    else:
        lines.append("position: not known")
    if result["time_offset_s"] is not None:
        lines.append(f"time offset: {1e3 * result['time_offset_s']:+.2f} ms to add to the odometry's "
                     f"stamps (+-{1e3 * result['time_sigma_s']:.2f} ms)")
    else:
        lines.append("time offset: not known")
    lines.append(f"residual of a motion: {result['residual_rotation_deg']:.3f} degrees, "
                 f"{1e3 * result['residual_position_m']:.1f} mm; the odometry's lengths are "
                 f"{100 * (result['odometry_scale'] - 1):+.2f} % off the lidar's")
    lines += ["missing: " + text for text in result["missing"]]
    return lines


def set_key(text, section, key, value):
    """A rig file with one number of one section changed, its comments kept."""
    pattern = re.compile(rf"^(  {section}:[^\n]*\n(?:(?:    [^\n]*|\s*)\n)*?    {key}: *)([^\s#]+)",
                         re.MULTILINE)
    changed, count = pattern.subn(lambda match: match.group(1) + value, text, count=1)
    if count != 1:
        raise SystemExit(f"calibrate_rig.py: the rig file has no key {section}/{key}")
    return changed


def rig_file(template, result):
    """The rig file `template` (text) with the calibration in it."""
    x, y, z = result["translation_m"]
    roll, pitch, yaw = fixed_axes_deg(result["quaternion_xyzw"])
    text = template
    for key, value in (("x_m", f"{x:.5f}"), ("y_m", f"{y:.5f}"), ("z_m", f"{z:.5f}"),
                       ("roll_deg", f"{roll:.4f}"), ("pitch_deg", f"{pitch:.4f}"),
                       ("yaw_deg", f"{yaw:.4f}")):
        text = set_key(text, "lidar_in_camera", key, value)
    return set_key(text, "camera", "time_offset_s", f"{result['time_offset_s']:.5f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag")
    parser.add_argument("-o", "--output", type=pathlib.Path, help="rig file to write")
    parser.add_argument("--rig", type=pathlib.Path, default=ROOT / "config/rig.yaml",
                        help="rig file that gives the rest (default: config/rig.yaml)")
    parser.add_argument("--json", action="store_true", help="print the whole result as JSON")
    args, passed_on = parser.parse_known_args()
    program = find_program()
    if program is None:
        raise SystemExit("calibrate_rig.py: the program calibrate_rig is not built; run scripts/build")
    run = subprocess.run([program, args.bag, *passed_on], stdout=subprocess.PIPE, text=True)
    if run.returncode not in (0, 3):
        return run.returncode
    result = json.loads(run.stdout)
    if args.json:
        print(json.dumps(result, indent=2))
    else:
        print("\n".join(summary(result)))
    if args.output is not None:
        if not result["known"]:
            print(f"calibrate_rig.py: {args.output} not written: the motion does not show all of it",
                  file=sys.stderr)
        else:
            text = rig_file(args.rig.read_text(), result)
            args.output.write_text(text)
    return run.returncode


if __name__ == "__main__":
    sys.exit(main())
