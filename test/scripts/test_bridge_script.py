"""The script of driver_bridge: what is right is read whole, what is wrong is one line that says where,
which key and what is expected."""
import json
import os
import pathlib
import shutil
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))
from dendro_bridge import programs  # noqa: E402
from dendro_bridge.script import ScriptError, load_rig, load_script, published_topics  # noqa: E402

RIG = str(ROOT / "config" / "rig.yaml")
GOOD = """
sources:
  - name: lidar
    type: vlp16_udp
  - name: camera
    type: poses
    file: poses.txt
record:
  folder: bags
"""


def program():
    try:
        return programs.find_program("sensor_source")
    except FileNotFoundError:
        pytest.skip("sensor_source is not built")


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "poses.txt").write_text("10 0 0 0 0 0 0 1\n11 1 0 0 0 0 0 1\n12 2 0 0 0 0 0 1\n")
    return tmp_path


def load(folder, text, look=False, rig=None):
    path = folder / "script.yaml"
    path.write_text(text)
    return load_script(str(path), RIG, program() if look else None, rig)


def error(folder, text, look=False):
    with pytest.raises(ScriptError) as caught:
        load(folder, text, look)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_a_good_script_is_read_whole(folder):
    script = load(folder, GOOD)
    assert [s["name"] for s in script["sources"]] == ["lidar", "camera"]
    lidar, camera = script["sources"]
    assert (lidar["data_port"], lidar["position_port"], lidar["frame"]) == (2368, 8308, "velodyne")
    assert camera["frame"] == "camera_pose_frame"
    assert camera["file"] == str(folder / "poses.txt")  # beside the script
    assert script["record"]["folder"] == str(folder / "bags")
    assert script["record"]["split_mb"] == 1024
    assert published_topics(lidar) == ["/velodyne_packets", "/fix"]
    json.dumps(script)


def lines(*changed):
    """A script with one source, and lines put in."""
    return "\n".join(["sources:", "  - name: a", "    type: poses", "    file: poses.txt", *changed, ""])


# text of the script, line of the error, words that it must hold
WRONG = [
    ("", None, ["empty"]),
    ("sources: [", 1, ["not YAML"]),
    ("- 1\n- 2\n", 1, ["group of keys", "a list"]),
    ("rate: 2\n", 1, ["'sources' is missing", "a list"]),
    ("sources: []\n", 1, ["at least one source"]),
    ("sources: lidar\n", 1, ["a list", "'lidar'"]),
    (lines() + "recrod: {}\n", 5, ["unknown key 'recrod'", "did you mean 'record'"]),
    (lines("    ratee: 2"), 5, ["sources[0]", "unknown key 'ratee'", "did you mean 'rate'", "known:"]),
    (lines("    data_port: 2368"), 5, ["unknown key 'data_port'"]),  # a pose file has no port
    (lines("    rate: fast"), 5, ["sources[0].rate", "a number", "'fast'"]),
    (lines("    rate: 0"), 5, ["above 0", "got 0"]),
    (lines("    rate: .nan"), 5, ["sources[0].rate", "a number"]),
    (lines("    rate: true"), 5, ["a number", "'true'"]),
    (lines("    repeat: 1"), 5, ["sources[0].repeat", "true or false"]),
    (lines("    rate: 1", "    rate: 2"), 6, ["rate", "twice"]),
    (lines("    align: begin"), 5, ["clock or start", "'begin'"]),
    (lines("    format: csv"), 5, ["auto or tum or realsense"]),
    (lines("    topic: bad topic"), 5, ["a topic like /"]),
    (lines("    start_s: -1"), 5, ["at least 0"]),
    (lines("    start_s: 5", "    stop_s: 4"), 2, ["stop_s (4)", "start_s (5)"]),
    (lines("    align: start") + "clock: recorded\n", 5, ["align: start needs clock: now"]),
    (lines("    file2: x").replace("poses.txt", "none.txt"), 5, ["unknown key"]),
    (lines().replace("poses.txt", "none.txt"), 4, ["sources[0].file", "no such file", "none.txt"]),
    (lines().replace("poses.txt", "$NO_SUCH_THING/a"), 4, ["the environment has no variable"]),
    (lines().replace("    file: poses.txt", ""), 2, ["'file' is missing", "path of a file"]),
    (lines().replace("  - name: a", "  - start_s: 0"), 2, ["'name' is missing"]),
    (lines().replace("name: a", "name: 2nd"), 2, ["sources[0].name", "a name like"]),
    (lines().replace("    type: poses", ""), 2, ["'type' is missing", "vlp16_udp", "topic"]),
    (lines().replace("type: poses", "type: pcap"), 3, ["sources[0].type", "vlp16_pcap", "'pcap'"]),
    (lines("  - name: a", "    type: topic", "    topic: /x"), 5, ["the name 'a' is taken"]),
    (lines("  - name: b", "    type: poses", "    file: poses.txt"), 5,
     ["sources[1]", "/camera/odom/sample is published by sources[0]"]),
    (lines("    faults: {fault: drop}"), 5, ["faults", "a list"]),
    (lines("    faults:", "      - {ratio: 0.5}"), 6, ["faults[0]", "'fault' is missing"]),
    (lines("    faults:", "      - {fault: burn}"), 6, ["drop or delay or silence or jump", "'burn'"]),
    (lines("    faults:", "      - {fault: drop}"), 6, ["'ratio' is missing"]),
    (lines("    faults:", "      - {fault: drop, ratio: 1.5}"), 6, ["faults[0].ratio", "at most 1"]),
    (lines("    faults:", "      - {fault: silence, ratio: 0.5}"), 6, ["unknown key 'ratio'"]),
    (lines("    faults:", "      - {fault: silence, from_s: 3, to_s: 2}"), 6, ["to_s (2)", "from_s (3)"]),
    (lines("    faults:", "      - {fault: jump}"), 6, ["a jump needs one of stamp_s"]),
    (lines("  - name: l", "    type: vlp16_udp", "    faults:", "      - {fault: jump, x_m: 1}"), 8,
     ["a lidar can only jump in time"]),
    (lines("  - name: l", "    type: vlp16_udp", "    address: lidar"), 7, ["an IPv4 address"]),
    (lines("  - name: t", "    type: topic", "    topic: /t", "    offset_s: 1"), 5,
     ["'output' is missing"]),
    (lines("  - name: t", "    type: topic", "    topic: /t", "    output: /t"), 8,
     ["must differ from topic"]),
    (lines() + "record: yes\n", 5, ["record", "a group of keys"]),
    (lines() + "record: {split_mb: 0}\n", 5, ["record.split_mb", "at least 1"]),
    (lines() + "record: {split_mb: 1.5}\n", 5, ["record.split_mb", "a whole number"]),
    (lines() + "record: {topics: /x}\n", 5, ["record.topics", "a list of topics"]),
    (lines() + "record: {topics: [1]}\n", 5, ["record.topics[0]", "a topic"]),
    (lines() + "clock: gps\n", 5, ["now or recorded"]),
    (lines() + "rig: no_rig.yaml\n", 5, ["rig", "no such file"]),
]


@pytest.mark.parametrize("text, line, words", WRONG, ids=[" ".join(w[2])[:50] for w in WRONG])
def test_what_is_wrong_is_said(folder, text, line, words):
    message = error(folder, text)
    place = f"{folder}/script.yaml" + (f":{line}: " if line else ": ")
    assert message.startswith(place), message
    for word in words:
        assert word in message, message


def test_files_that_are_not_there(folder):
    with pytest.raises(ScriptError, match="none.yaml: No such file"):
        load_script(str(folder / "none.yaml"), RIG)
    (folder / "binary.yaml").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(ScriptError, match="binary.yaml"):
        load_script(str(folder / "binary.yaml"), RIG)


@pytest.mark.parametrize("change, words", [
    (("velodyne", "3"), ["text"]),
    (("2368", "99999"), ["at most 65535"]),
    (("z_m:", "zz_m:"), ["unknown key 'zz_m'", "did you mean 'z_m'"]),
    (("    yaw_deg: 0.0", ""), ["'yaw_deg' is missing"]),
    (("    x_m: 0.0", "    x_m: left"), ["a number", "'left'"]),
])
def test_the_rig_is_read_strictly(folder, change, words):
    text = pathlib.Path(RIG).read_text()
    assert change[0] in text
    (folder / "rig.yaml").write_text(text.replace(*change))
    with pytest.raises(ScriptError) as caught:
        load_rig(str(folder / "rig.yaml"))
    for word in words + ["rig.yaml:"]:
        assert word in str(caught.value)


def test_the_rig_reaches_the_sources(folder):
    text = pathlib.Path(RIG).read_text().replace("2368", "2400").replace("camera_pose_frame", "eye")
    (folder / "rig.yaml").write_text(text.replace("time_offset_s: 0.0    # added to the stamps of the "
                                                  "camera", "time_offset_s: 0.25 #"))
    for script in (load(folder, GOOD + "rig: rig.yaml\n"),
                   load(folder, GOOD, rig=str(folder / "rig.yaml"))):
        lidar, camera = script["sources"]
        assert lidar["data_port"] == 2400
        assert camera["frame"] == "eye"
        assert camera["offset_s"] == 0.25


def test_recordings_share_one_time(folder):
    (folder / "later.txt").write_text("14 0 0 0 0 0 0 1\n15 1 0 0 0 0 0 1\n")
    text = """
sources:
  - {name: a, type: poses, file: poses.txt, topic: /a}
  - {name: b, type: poses, file: later.txt, topic: /b, offset_s: -1}
  - {name: c, type: poses, file: later.txt, topic: /c, align: start, start_s: 0.5}
rate: 2
"""
    script = load(folder, text, look=True)
    a, b, c = script["sources"]
    assert a["origin_ns"] == b["origin_ns"] == str(10 * 10**9)
    # The first pose of c is due when c is switched on, 0.5 s after the start at twice the speed.
    assert c["origin_ns"] == str(13 * 10**9)
    assert script["end_s"] == pytest.approx((15 - 1 - 10) / 2)
    assert load(folder, text + "duration_s: 1\n", look=True)["end_s"] == 1
    assert load(folder, text.replace("later.txt, topic: /b", "later.txt, repeat: true, topic: /b"),
                look=True)["end_s"] == 1e9


def test_recordings_are_looked_into(folder):
    (folder / "poses.txt").write_text("10 0 0 0 0 0 0 1\n9 0 0 0 0 0 0 1\n")
    assert "poses.txt: line 2: time does not grow" in error(folder, GOOD, look=True)
    (folder / "walk.pcap").write_text("this is no capture")
    message = error(folder, "sources:\n  - {name: a, type: vlp16_pcap, file: walk.pcap}\n", look=True)
    assert "script.yaml:2" in message and "walk.pcap" in message


def test_the_program_ends_with_one_line(folder):
    program()
    (folder / "script.yaml").write_text(lines("    ratee: 2"))
    done = subprocess.run([ROOT / "scripts" / "driver_bridge", "--check", folder / "script.yaml"],
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.strip().splitlines()) == 1
    assert "script.yaml:5: sources[0]: unknown key 'ratee'" in done.stderr


def test_the_examples_are_good(folder, monkeypatch):
    """Every shipped script, with the recordings that it speaks of in their place."""
    shared = pathlib.Path(os.environ.get("DENDRO_SHARED_DATA", ROOT / "../shared/data"))
    monkeypatch.setenv("HOME", str(folder))
    home = folder / "dendro_slam"
    home.mkdir()
    look = None
    capture = shared / "vlp16" / "grap_apple_20frames.pcap"
    (home / "walk.csv").write_text("time,x,y,z,qx,qy,qz,qw,tracker_confidence\n"
                                   "1,0,0,0,0,0,0,1,3\n2,0,0,-1,0,0,0,1,2\n")
    if capture.exists():
        shutil.copy(capture, home / "walk.pcap")
        look = program()
    else:
        (home / "walk.pcap").write_text("")
    scripts = sorted((ROOT / "config" / "scripts").glob("*.yaml"))
    assert len(scripts) >= 4
    for path in scripts:
        assert load_script(str(path), RIG, look)["sources"], path
