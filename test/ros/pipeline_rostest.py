#!/usr/bin/python3
"""Plays a short simulated bag into the running pipeline and checks the map that it saves.

The pipeline is that of mapping.launch (see pipeline.test). The same bag goes through map_bag, and both
maps must agree: the same branches, radii within 1 mm.
"""
import csv
import json
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import time
import unittest

import rospy
import rostest
from dendro_slam.msg import GraphStatus, ScanCylinders, Segments, TreeMap
from dendro_slam.srv import LoadMap, SaveMap
from nav_msgs.msg import Odometry, Path
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

ROOT = pathlib.Path(__file__).resolve().parents[2]
DURATION_S = 7.0


def program(name):
    found = shutil.which(name) or next(
        (str(p / name) for base in os.environ["CMAKE_PREFIX_PATH"].split(":")
         for p in [pathlib.Path(base) / "lib" / "dendro_slam"] if (p / name).exists()), None)
    assert found, f"{name} is not built"
    return found


def branches(directory):
    with open(os.path.join(directory, "branches.csv")) as f:
        return list(csv.DictReader(f))


def cylinders(directory):
    with open(os.path.join(directory, "cylinders.csv")) as f:
        return list(csv.DictReader(f))


class PipelineTest(unittest.TestCase):
    def setUp(self):
        self.folder = tempfile.mkdtemp(prefix="dendro_pipeline_")
        self.bag = os.path.join(self.folder, "flight.bag")
        subprocess.run([program("simulate_bag"), ROOT / "config/scenes/thesis_tree.yaml",
                        ROOT / "config/paths/thesis_quadrangle.yaml", "-o", self.bag,
                        "--duration", str(DURATION_S)], check=True, timeout=120)

    def tearDown(self):
        shutil.rmtree(self.folder, ignore_errors=True)

    def test_map_of_a_short_flight(self):
        seen = {}
        last = {}

        def count(topic, kind):
            def callback(message):
                seen[topic] = seen.get(topic, 0) + 1
                last[topic] = message
                last["time"] = time.monotonic()
            return rospy.Subscriber(topic, kind, callback, queue_size=1000)

        subscribers = [count("wood_scan", PointCloud2), count("segments", Segments),
                       count("cylinders", ScanCylinders), count("icp_odometry", Odometry),
                       count("tree_map", TreeMap), count("path", Path),
                       count("map_markers", MarkerArray),
                       count("tree_mapping/graph_status", GraphStatus)]
        rospy.wait_for_service("tree_mapping/save_map", timeout=60)
        deadline = time.monotonic() + 30
        while any(s.get_num_connections() == 0 for s in subscribers):
            self.assertLess(time.monotonic(), deadline, "not every nodelet came up")
            time.sleep(0.2)
        subprocess.run(["rosbag", "play", "--quiet", "--clock", "-d", "1", self.bag],
                       check=True, timeout=120, stdin=subprocess.DEVNULL)
        # Every scan is worked off: the queues are long enough to hold the whole bag.
        deadline = time.monotonic() + 120
        while time.monotonic() - last.get("time", 0) < 5.0 and time.monotonic() < deadline:
            time.sleep(0.2)
        scans = int(DURATION_S * 10)
        for topic in ("wood_scan", "segments", "cylinders", "icp_odometry",
                      "tree_mapping/graph_status"):
            self.assertGreaterEqual(seen.get(topic, 0), scans - 2, f"{topic}: {seen}")
        for topic in ("tree_map", "path", "map_markers"):
            self.assertGreaterEqual(seen.get(topic, 0), 1, f"{topic}: {seen}")
        status = last["tree_mapping/graph_status"]
        self.assertTrue(status.used_odometry)
        self.assertEqual(status.scans_dropped, 0)
        self.assertEqual(last["wood_scan"].height, 16)

        live = os.path.join(self.folder, "live")
        reply = rospy.ServiceProxy("tree_mapping/save_map", SaveMap)(directory=live)
        self.assertTrue(reply.success, reply.message)
        with open(os.path.join(live, "tree_map.json")) as f:
            json.load(f)
        trunk = max(branches(live), key=lambda b: float(b["base_diameter_m"]))
        # The scene's trunk tapers from 0.30 m at the ground; the path sees it from 0.5 m up.
        self.assertAlmostEqual(float(trunk["base_diameter_m"]), 0.58, delta=0.06)

        batch = os.path.join(self.folder, "batch")
        subprocess.run([program("map_bag"), self.bag, "-o", batch], check=True, timeout=240)
        self.assertEqual([b["branch_id"] for b in branches(live)],
                         [b["branch_id"] for b in branches(batch)])
        live_cylinders, batch_cylinders = cylinders(live), cylinders(batch)
        self.assertEqual(len(live_cylinders), len(batch_cylinders))
        for a, b in zip(live_cylinders, batch_cylinders):
            self.assertAlmostEqual(float(a["radius_m"]), float(b["radius_m"]), delta=0.001)

        # Reset empties the map, load brings it back, and errors are answers.
        self.assertTrue(rospy.ServiceProxy("tree_mapping/reset", Trigger)().success)
        load = rospy.ServiceProxy("tree_mapping/load_map", LoadMap)
        refused = load(directory=os.path.join(self.folder, "nothing"))
        self.assertFalse(refused.success)
        self.assertIn("nothing", refused.message)
        loaded = load(directory=live)
        self.assertTrue(loaded.success, loaded.message)
        refused = rospy.ServiceProxy("tree_mapping/save_map", SaveMap)(directory="/proc/nothing")
        self.assertFalse(refused.success)


if __name__ == "__main__":
    rospy.init_node("pipeline_rostest")
    rostest.rosrun("dendro_slam", "pipeline", PipelineTest, sys.argv)
