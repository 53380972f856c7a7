"""The layering of the package, held by grep: the core and the simulator know nothing of ROS, core
headers keep heavy libraries private, and the parameter table follows the configuration structs."""
import pathlib
import re
import subprocess

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
ROS_SIDE = {"ros", "nodelets", "tools"}
ROS_INCLUDE = re.compile(
    r'#include\s*[<"](ros|rosbag|tf2|tf2_ros|nodelet|pluginlib|\w+_msgs|std_srvs|diagnostic_updater|'
    r'dendro_slam/[A-Z]\w*\.h|dendro_slam/ros)\b')
HEAVY_INCLUDE = re.compile(r'#include\s*[<"](ceres|opencv2|pcl|bt[A-Z]\w*|bullet|LinearMath|yaml-cpp|pcap)')


def sources(folder):
    files = [f for f in (ROOT / folder).rglob("*") if f.suffix in (".h", ".cpp", ".hpp")]
    assert files
    return files


def is_core(path):
    return not ROS_SIDE & set(path.relative_to(ROOT).parts)


def lines(path, pattern):
    return [f"{path.relative_to(ROOT)}:{i}: {line.strip()}"
            for i, line in enumerate(path.read_text().splitlines(), 1) if pattern.search(line)]


def test_the_pattern_finds_ros_where_it_is():
    found = [f for f in sources("src/nodelets") if lines(f, ROS_INCLUDE)]
    assert len(found) >= 8


@pytest.mark.parametrize("folder", ["include", "src"])
def test_core_and_simulator_do_not_include_ros(folder):
    found = [hit for f in sources(folder) if is_core(f) for hit in lines(f, ROS_INCLUDE)]
    assert not found, "\n".join(found)


def test_core_does_not_print():
    pattern = re.compile(r"std::(cout|cerr|clog)|[^n]printf\(|\bexit\(|\babort\(")
    found = [hit for f in sources("src") if is_core(f) for hit in lines(f, pattern)]
    assert not found, "\n".join(found)


def test_public_headers_keep_heavy_libraries_private():
    found = [hit for f in sources("include") if is_core(f) for hit in lines(f, HEAVY_INCLUDE)]
    assert not found, "\n".join(found)


def test_parameter_table_is_up_to_date():
    subprocess.run([ROOT / "scripts" / "parameter_table.py", "--check"], check=True)
