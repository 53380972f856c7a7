#!/usr/bin/python3
"""Every launch file is sound: it parses, its packages, nodes and arguments exist, and every nodelet that
it loads is a class of nodelet_plugins.xml."""
import pathlib
import re
import sys
import xml.etree.ElementTree

import pytest
import roslaunch.config
import roslaunch.rlutil

ROOT = pathlib.Path(__file__).resolve().parents[2]
LAUNCH_FILES = sorted((ROOT / "launch").glob("*.launch"))
CLASSES = {c.get("name") for c in
           xml.etree.ElementTree.parse(ROOT / "nodelet_plugins.xml").getroot().iter("class")}


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda p: p.name)
def test_launch_file_is_sound(path):
    error = roslaunch.rlutil.check_roslaunch(str(path))
    assert not error, error


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda p: p.name)
def test_nodelets_exist(path):
    config = roslaunch.config.load_config_default([str(path)], None, verbose=False)
    loads = [re.match(r"load (\S+) (\S+)", node.args) for node in config.nodes
             if node.type == "nodelet" and node.args.startswith("load")]
    hosted = [word.split("=")[1] for node in config.nodes if node.type == "pipeline_node"
              for word in node.args.split()]
    assert loads or hosted
    assert set(hosted) <= CLASSES
    managers = {node.name for node in config.nodes if node.args.strip() == "manager"}
    for load in loads:
        assert load.group(1) in CLASSES
        assert load.group(2) in managers


def test_arguments_that_scripts_rely_on():
    names = {a.get("name") for a in
             xml.etree.ElementTree.parse(ROOT / "launch/mapping.launch").getroot().iter("arg")}
    assert {"points", "odometry", "config", "output", "use_sim_time", "rviz", "queue_size"} <= names


def test_topics_can_be_changed():
    config = roslaunch.config.load_config_default(
        [(str(ROOT / "launch/mapping.launch"), ["points:=/a", "odometry:=/b", "packets:=/c"])],
        None, verbose=False)
    remaps = {node.name: dict(node.remap_args) for node in config.nodes}
    assert remaps["wood_segmentation"] == {"velodyne_points": "/a", "odometry": "/b"}
    assert remaps["tree_mapping"] == {"odometry": "/b"}
    assert remaps["vlp16_decoder"] == {"velodyne_packets": "/c", "velodyne_points": "/a"}


def test_one_process_holds_the_same_nodelets():
    """mapping.launch maps with the same nodelets and topics, in one process or with one each."""
    def nodes(one_process):
        config = roslaunch.config.load_config_default(
            [(str(ROOT / "launch/mapping.launch"),
              [f"one_process:={one_process}", "points:=/a", "odometry:=/b", "packets:=/c"])],
            None, verbose=False)
        return {node.name: node for node in config.nodes}

    apart, together = nodes("false"), nodes("true")
    assert set(together) == {"dendro_manager"}
    host = together["dendro_manager"]
    assert host.respawn
    hosted = dict(word.split("=") for word in host.args.split())
    assert hosted == {name: node.args.split()[1] for name, node in apart.items()
                      if node.args.startswith("load")}
    assert dict(host.remap_args) == {"odometry": "/b", "velodyne_points": "/a", "velodyne_packets": "/c"}


def test_a_bad_script_ends_roslaunch_before_it_begins(tmp_path, capfd):
    script = tmp_path / "bad.yaml"
    script.write_text("sources: none\n")
    with pytest.raises(roslaunch.core.RLException):
        roslaunch.config.load_config_default(
            [(str(ROOT / "launch/rig.launch"), [f"script:={script}"])], None, verbose=False)
    assert f"{script}:1: sources: expected a list" in capfd.readouterr().err


if __name__ == "__main__":
    sys.exit(pytest.main([__file__, "-q", "-p", "no:cacheprovider"]))
