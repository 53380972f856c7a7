#!/usr/bin/python3
"""Feeds the running pipeline with what it cannot use: one clear message each, and it goes on."""
import math
import struct
import sys
import time
import unittest

import rosgraph
import rospy
import rostest
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Log
from sensor_msgs.msg import PointCloud2, PointField

SIZES = {PointField.FLOAT32: ("f", 4), PointField.UINT16: ("H", 2)}
FULL = [("x", PointField.FLOAT32), ("y", PointField.FLOAT32), ("z", PointField.FLOAT32),
        ("intensity", PointField.FLOAT32), ("ring", PointField.UINT16), ("time", PointField.FLOAT32)]


def cylinder_points():
    """A trunk of 20 cm radius 4 m ahead, as the 16 rings see it."""
    points = []
    for column in range(1800):
        azimuth = math.radians(0.2 * column)
        for ring in range(16):
            elevation = math.radians(-15 + 2 * ring)
            dx, dy = math.cos(azimuth), -math.sin(azimuth)
            along = 4.0 * dx
            inside = 0.2 ** 2 - (4.0 ** 2 - along ** 2)
            if along <= 0 or inside < 0:
                continue
            horizontal = along - math.sqrt(inside)
            points.append((horizontal * dx, horizontal * dy, horizontal * math.tan(elevation), 50.0,
                           ring, column * 55.296e-6))
    return points


POINTS = cylinder_points()


def make_cloud(stamp, fields=FULL, points=POINTS):
    names = [name for name, _ in FULL]
    cloud = PointCloud2()
    cloud.header.stamp = rospy.Time.from_sec(stamp)
    cloud.header.frame_id = "velodyne"
    offset = 0
    for name, kind in fields:
        cloud.fields.append(PointField(name, offset, kind, 1))
        offset += SIZES[kind][1]
    layout = "<" + "".join(SIZES[kind][0] for _, kind in fields)
    picks = [names.index(name) for name, _ in fields]
    cloud.data = b"".join(struct.pack(layout, *(p[i] for i in picks)) for p in points)
    cloud.height, cloud.width = 1, len(points)
    cloud.point_step = offset
    cloud.row_step = offset * len(points)
    return cloud


class BadInputTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.log = []
        cls.scans = []
        rospy.Subscriber("/rosout", Log, lambda m: cls.log.append((m.level, m.msg)), queue_size=1000)
        rospy.Subscriber("wood_scan", PointCloud2, lambda m: cls.scans.append(m.header.stamp.to_sec()),
                         queue_size=100)
        cls.points = rospy.Publisher("/velodyne_points", PointCloud2, queue_size=100)
        cls.odometry = rospy.Publisher("/odometry", Odometry, queue_size=100)
        deadline = time.monotonic() + 60
        while cls.points.get_num_connections() == 0 or cls.odometry.get_num_connections() == 0:
            assert time.monotonic() < deadline, "the pipeline did not come up"
            time.sleep(0.2)
        time.sleep(2.0)
        cls.stamp = 1000.0

    def next_stamp(self):
        type(self).stamp += 0.1
        return self.stamp

    def send_good(self, count=12):
        """Enough scans to pass the wait for odometry; returns the stamps that came back."""
        before = len(self.scans)
        for _ in range(count):
            self.points.publish(make_cloud(self.next_stamp()))
            time.sleep(0.05)
        deadline = time.monotonic() + 20
        while len(self.scans) == before and time.monotonic() < deadline:
            time.sleep(0.1)
        return self.scans[before:]

    def expect(self, *words, timeout_s=15.0):
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            for level, text in list(self.log):
                if level >= Log.WARN and all(word in text for word in words):
                    return
            time.sleep(0.1)
        self.fail(f"no message with {words} in {self.log}")

    def check_alive(self):
        self.assertTrue(self.send_good(), "no scan comes out any more")
        nodes = {n for table in rosgraph.Master("/bad_input").getSystemState()[0] for n in table[1]}
        self.assertIn("/dendro_manager", nodes)

    def test_1_good_scans_come_out(self):
        self.check_alive()

    def test_2_no_ring_and_no_time(self):
        self.points.publish(make_cloud(self.next_stamp(), FULL[:4]))
        self.expect("/velodyne_points", "'ring'")
        self.expect("/velodyne_points", "'time'")
        self.check_alive()

    def test_3_no_coordinates(self):
        self.points.publish(make_cloud(self.next_stamp(), FULL[3:]))
        self.expect("/velodyne_points", "no field 'x'")
        self.check_alive()

    def test_4_wrong_size(self):
        cloud = make_cloud(self.next_stamp())
        cloud.data = cloud.data[:100]
        self.points.publish(cloud)
        time.sleep(6.0)  # Messages of one kind come at most every 5 s.
        self.points.publish(cloud)
        self.expect("/velodyne_points", "100 bytes")
        self.check_alive()

    def test_5_nan_points(self):
        nan = float("nan")
        broken = [(nan, nan, nan, *p[3:]) if i % 2 else p for i, p in enumerate(POINTS)]
        self.points.publish(make_cloud(self.next_stamp(), points=broken))
        self.points.publish(make_cloud(self.next_stamp(), points=[(nan,) * 3 + p[3:] for p in POINTS]))
        self.check_alive()

    def test_6_empty_cloud(self):
        self.points.publish(make_cloud(self.next_stamp(), points=[]))
        self.expect("/velodyne_points", "empty cloud")
        self.check_alive()

    def test_7_missing_transform(self):
        for i in range(60):
            message = Odometry()
            message.header.stamp = rospy.Time.from_sec(self.stamp + 0.02 * i)
            message.header.frame_id = "odom"
            message.child_frame_id = "camera_pose_frame"
            message.pose.pose.orientation.w = 1.0
            self.odometry.publish(message)
        self.check_alive()
        self.expect("camera_pose_frame", "velodyne", "static_transform_publisher")

    def test_8_bad_odometry(self):
        message = Odometry()
        message.header.stamp = rospy.Time.from_sec(self.stamp + 100.0)
        message.pose.pose.position.x = float("nan")
        self.odometry.publish(message)
        self.expect("/odometry", "not finite")
        self.check_alive()

    def test_9_time_jumps_back(self):
        type(self).stamp = 500.0
        self.check_alive()
        self.expect("/velodyne_points", "time jumped back")
        self.expect("the map starts anew")
        self.assertGreater(max(s for s in self.scans if s < 900), 500.0)


if __name__ == "__main__":
    rospy.init_node("bad_input_rostest")
    rostest.rosrun("dendro_slam", "bad_input", BadInputTest, sys.argv)
