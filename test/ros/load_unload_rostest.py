#!/usr/bin/python3
"""Loads and unloads every class that nodelet_plugins.xml names into the running manager."""
import pathlib
import signal
import subprocess
import sys
import time
import unittest
import xml.etree.ElementTree

import rosgraph
import rospy
import rostest

ROOT = pathlib.Path(__file__).resolve().parents[2]
SCENE = ["_scene:=" + str(ROOT / "config/scenes/thesis_tree.yaml"),
         "_path:=" + str(ROOT / "config/paths/thesis_quadrangle.yaml")]


def manager_topics():
    """What the nodelets of the manager publish and subscribe."""
    published, subscribed, _ = rosgraph.Master("/load_unload").getSystemState()
    return {(kind, topic) for kind, table in (("out", published), ("in", subscribed))
            for topic, nodes in table if "/manager" in nodes and not topic.endswith("/bond")}


def manager_is_up():
    return any(name == "/manager/load_nodelet"
               for name, _ in rosgraph.Master("/load_unload").getSystemState()[2])


def wait_for(condition, timeout_s=40.0):
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.1)
    return False


class LoadUnloadTest(unittest.TestCase):
    def classes(self):
        tree = xml.etree.ElementTree.parse(ROOT / "nodelet_plugins.xml")
        return [c.get("name") for c in tree.getroot().iter("class")]

    def test_every_class_loads_and_unloads(self):
        self.assertTrue(wait_for(manager_is_up))
        self.assertEqual(len(self.classes()), 8)
        # Collected by hand: rostest's report leaves failures of sub-tests out.
        problems = [p for p in map(self.load_and_unload, self.classes()) if p]
        self.assertFalse(problems, "\n".join(problems))

    def load_and_unload(self, name):
        """What went wrong with one class; empty when it loaded, ran and left nothing behind."""
        before = manager_topics()
        node = name.split("/")[1].lower()
        extra = SCENE if name.endswith("LidarSimulator") else []
        loader = subprocess.Popen(
            ["rosrun", "nodelet", "nodelet", "load", name, "manager", "__name:=" + node, *extra],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        loaded = wait_for(lambda: len(manager_topics() - before) >= 2)
        time.sleep(1.0)
        alive = loader.poll() is None
        loader.send_signal(signal.SIGINT)  # as Ctrl-C: the loader asks the manager to unload
        try:
            output = loader.communicate(timeout=30)[0]
        except subprocess.TimeoutExpired:
            loader.kill()
            return f"{name}: its loader did not end within 30 s"
        if not (loaded and alive):
            return f"{name} did not load:\n{output}"
        if not wait_for(lambda: manager_topics() <= before):
            return f"{name} did not unload: {sorted(manager_topics() - before)}"
        return ""

    def test_unknown_parameter_is_refused(self):
        loader = subprocess.run(
            ["rosrun", "nodelet", "nodelet", "load", "dendro_slam/WoodIcp", "manager",
             "__name:=misspelled", "_max_rang_m:=3.0"],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=60)
        self.assertNotEqual(loader.returncode, 0)


if __name__ == "__main__":
    rospy.init_node("load_unload_rostest")
    rostest.rosrun("dendro_slam", "load_unload", LoadUnloadTest, sys.argv)
