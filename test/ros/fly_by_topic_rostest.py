#!/usr/bin/python3
"""Steers the live simulator by a topic: it goes where it is told, scans from there, and says the truth."""
import math
import sys
import time
import unittest

import numpy as np
import rospy
import rostest
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu, PointCloud2


class FlyByTopicTest(unittest.TestCase):
    def setUp(self):
        self.seen = {"lidar": [], "odometry": [], "points": [], "imu": []}
        self.subscribers = [
            rospy.Subscriber("/ground_truth/lidar_pose", PoseStamped, self.seen["lidar"].append, queue_size=1000),
            rospy.Subscriber("/odometry", Odometry, self.seen["odometry"].append, queue_size=10000),
            rospy.Subscriber("/imu/data_raw", Imu, self.seen["imu"].append, queue_size=10000),
            rospy.Subscriber("/velodyne_points", PointCloud2, self.seen["points"].append, queue_size=100)]
        self.pilot = rospy.Publisher("/pose", PoseStamped, queue_size=10)
        self.wait(lambda: len(self.seen["lidar"]) > 3 and self.pilot.get_num_connections() > 0, "no scans")

    def wait(self, condition, message, seconds=60):
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                self.fail(message)
            time.sleep(0.02)

    def steer(self, x, y, z, yaw, frame="map"):
        pose = PoseStamped()
        pose.header.frame_id = frame
        pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = x, y, z
        pose.pose.orientation.z, pose.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        self.pilot.publish(pose)

    def lidar_is_at(self, x, y, z, yaw):
        pose = self.seen["lidar"][-1].pose
        turned = 2 * math.atan2(pose.orientation.z, pose.orientation.w) - yaw
        return (math.dist((pose.position.x, pose.position.y, pose.position.z), (x, y, z)) < 0.02 and
                abs(math.remainder(turned, 2 * math.pi)) < 0.02)

    def test_goes_where_it_is_told(self):
        # It starts where the path starts, the lidar 10 cm above the body, and stays there.
        start = self.seen["lidar"][0].pose.position
        self.assertLess(math.dist((start.x, start.y, start.z), (4.0, -4.0, 1.5)), 0.02)
        # What cannot be a pose is ignored.
        self.steer(9.0, 9.0, 9.0, 0.0, frame="camera")
        self.steer(float("nan"), 9.0, 9.0, 0.0)
        time.sleep(0.5)
        self.assertTrue(self.lidar_is_at(4.0, -4.0, 1.5, math.radians(0.0)), self.seen["lidar"][-1])
        # Three stations, given as a script would: once, and as a joystick would: again and again.
        self.steer(3.0, -2.0, 2.0, 0.5)
        self.wait(lambda: self.lidar_is_at(3.0, -2.0, 2.1, 0.5), "it did not come to the first station")
        deadline = time.monotonic() + 60
        while not self.lidar_is_at(2.5, 1.5, 1.1, 3.0):
            self.assertLess(time.monotonic(), deadline, "it did not come to the second station")
            self.steer(2.5, 1.5, 1.0, 3.0)
            time.sleep(0.05)
        # The motion on the way had no leaps: a tenth of a second at 5 m/s.
        places = np.array([[m.pose.position.x, m.pose.position.y, m.pose.position.z] for m in self.seen["lidar"]])
        self.assertLess(np.linalg.norm(np.diff(places, axis=0), axis=1).max(), 0.5)
        stamps = [m.header.stamp.to_sec() for m in self.seen["lidar"]]
        self.assertLess(abs(np.diff(stamps) - 0.1).max(), 1e-3)
        # The scan is seen from there: the trunk, 0.3 m thick at the foot, stands at the map's origin.
        count = len(self.seen["points"])
        self.wait(lambda: len(self.seen["points"]) > count + 3, "no more scans")
        msg = self.seen["points"][-1]
        dtype = np.dtype({"names": ["x", "y", "z"], "formats": ["<f4"] * 3,
                          "offsets": [f.offset for f in msg.fields[:3]], "itemsize": msg.point_step})
        p = np.frombuffer(msg.data, dtype)
        x = 2.5 + p["x"] * math.cos(3.0) - p["y"] * math.sin(3.0)
        y = 1.5 + p["x"] * math.sin(3.0) + p["y"] * math.cos(3.0)
        trunk = (np.hypot(x, y) < 0.5) & (p["z"] > -0.5) & (p["z"] < 0.3)
        self.assertGreater(trunk.sum(), 100)
        self.assertAlmostEqual(float(np.median(np.hypot(x, y)[trunk])), 0.28, delta=0.04)
        # Odometry came along: from the start to here it moved as the truth did, up to its drift.
        o = self.seen["odometry"][-1].pose.pose.position
        self.assertAlmostEqual(math.dist((o.x, o.y, o.z), (0.1, 0.0, 0.0)), math.dist((2.5, 1.5), (4.0, -4.0)), delta=0.4)
        imu = self.seen["imu"][-1]
        self.assertEqual(imu.header.frame_id, "base_link")
        self.assertAlmostEqual(imu.linear_acceleration.z, 9.81, delta=0.5)


if __name__ == "__main__":
    rospy.init_node("fly_by_topic_rostest")
    rostest.rosrun("dendro_slam", "fly_by_topic", FlyByTopicTest, sys.argv)
