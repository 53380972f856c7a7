#!/usr/bin/python3
"""The live simulator of simulation.launch: its topics and its clock, and a map that begins to grow."""
import sys
import time
import unittest

import rospy
import rostest
import tf2_ros
from dendro_slam.msg import TreeMap
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2


class SimulationTest(unittest.TestCase):
    def test_map_begins_to_grow(self):
        seen = {}

        def count(topic, kind):
            def callback(message):
                seen.setdefault(topic, []).append(message)
            return rospy.Subscriber(topic, kind, callback, queue_size=1000)

        buffer = tf2_ros.Buffer()
        listener = tf2_ros.TransformListener(buffer)
        subscribers = [count("/velodyne_points", PointCloud2), count("/odometry", Odometry),
                       count("/clock", Clock), count("/ground_truth/lidar_pose", PoseStamped),
                       count("/ground_truth/tree_map", TreeMap), count("/tree_map", TreeMap)]
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline:
            if any(m.branches for m in seen.get("/tree_map", [])):
                break
            time.sleep(0.2)
        else:
            self.fail(f"no branch in the map: {({k: len(v) for k, v in seen.items()})}")
        self.assertEqual({f.name for f in seen["/velodyne_points"][0].fields},
                         {"x", "y", "z", "intensity", "ring", "time"})
        self.assertEqual(len(seen["/ground_truth/tree_map"]), 1)
        self.assertGreater(len(seen["/odometry"]), len(seen["/velodyne_points"]) * 10)
        clocks = [m.clock.to_sec() for m in seen["/clock"]]
        self.assertEqual(clocks, sorted(clocks))
        # map -> odom -> ... -> velodyne is one tree, and the map sees the lidar near the truth's start.
        transform = buffer.lookup_transform("map", "velodyne", rospy.Time(0), rospy.Duration(5.0))
        moved = transform.transform.translation
        first = seen["/ground_truth/lidar_pose"][0].pose.position
        last = seen["/ground_truth/lidar_pose"][-1].pose.position
        truth = ((last.x - first.x) ** 2 + (last.y - first.y) ** 2) ** 0.5
        self.assertAlmostEqual((moved.x ** 2 + moved.y ** 2) ** 0.5, truth, delta=0.3)
        del listener, subscribers


if __name__ == "__main__":
    rospy.init_node("simulation_rostest")
    rostest.rosrun("dendro_slam", "simulation", SimulationTest, sys.argv)
