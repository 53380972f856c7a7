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
    assert loads
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


if __name__ == "__main__":
    sys.exit(pytest.main([__file__, "-q", "-p", "no:cacheprovider"]))
