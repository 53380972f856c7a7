#!/usr/bin/python3
"""save_map and load_map while the disk of the session and of the saved map is full: one clear message each,
the files and the running map stay as they were, and both work again when there is room."""
import csv
import errno
import hashlib
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
from dendro_slam.msg import Cylinder, GraphStatus, ScanCylinders
from dendro_slam.srv import LoadMap, SaveMap
from std_srvs.srv import Trigger


def radius(directory):
    """Mean of the map's cylinders [m]."""
    with open(directory / "cylinders.csv", encoding="utf-8") as stream:
        radii = [float(row["radius_m"]) for row in csv.DictReader(stream)]
    return sum(radii) / len(radii)


def contents(directory):
    return {str(p.relative_to(directory)): hashlib.md5(p.read_bytes()).hexdigest()
            for p in sorted(directory.rglob("*")) if p.is_file()}


class FullDiskTest(unittest.TestCase):
    def setUp(self):
        self.folder = pathlib.Path(tempfile.mkdtemp(prefix="dendro_full_disk_"))
        self.addCleanup(shutil.rmtree, self.folder, True)
        self.disk = self.folder / "disk"
        self.disk.mkdir()
        mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", self.disk],
                                 stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)
        if mounted.returncode != 0:
            self.skipTest("a small disk cannot be mounted here (needs root)")
        self.addCleanup(subprocess.run, ["umount", "-l", self.disk], check=False)
        node = subprocess.Popen(
            ["rosrun", "nodelet", "nodelet", "standalone", "dendro_slam/TreeMapping", "__name:=tree_mapping",
             f"_session_directory:={self.disk}/session", "_session_id:=one", "_use_icp:=false",
             "_use_odometry:=false", "_lidar_mount/from_tf:=false"])
        self.addCleanup(node.wait, 20)
        self.addCleanup(node.terminate)
        for name in ("save_map", "load_map", "reset"):
            rospy.wait_for_service(f"tree_mapping/{name}", 60)
        self.save = rospy.ServiceProxy("tree_mapping/save_map", SaveMap)
        self.load = rospy.ServiceProxy("tree_mapping/load_map", LoadMap)
        self.mapped = 0
        rospy.Subscriber("tree_mapping/graph_status", GraphStatus, self.on_status, queue_size=1000)
        self.cylinders = rospy.Publisher("cylinders", ScanCylinders, queue_size=100)
        deadline = time.monotonic() + 60
        while self.cylinders.get_num_connections() == 0:
            self.assertLess(time.monotonic(), deadline, "the mapping does not listen")
            time.sleep(0.1)
        time.sleep(0.5)
        self.stamp = 1000.0

    def on_status(self, _):
        self.mapped += 1

    def see_trunk(self, trunk_radius, scans=30):
        """A trunk 4 m ahead, from a lidar that stands still, in so many scans."""
        before = self.mapped
        for _ in range(scans):
            self.stamp += 0.5
            scan = ScanCylinders()
            scan.header.stamp = rospy.Time.from_sec(self.stamp)
            scan.header.frame_id = "velodyne"
            c = Cylinder(status=Cylinder.MEASURED, curvature=1.0 / trunk_radius, radius_sigma=0.002,
                         start_s=-0.7, end_s=0.7, end_sigma=0.07, num_points=400, num_rings=10, distance=4.0,
                         visible_arc=2.8, mean_abs_deviation=0.005)
            c.axis.z = 1.0
            c.point.x = 4.0
            for k, sigma in enumerate((0.005, 0.005, 0.003, 0.003, 0.002 / trunk_radius ** 2)):
                c.covariance[6 * k] = sigma ** 2
            scan.cylinders = [c]
            self.cylinders.publish(scan)
            time.sleep(0.02)
        # The last ones wait for odometry, until later ones show that none comes.
        deadline = time.monotonic() + 20
        while self.mapped < before + scans - 3:
            self.assertLess(time.monotonic(), deadline, f"{self.mapped - before} of {scans} scans were mapped")
            time.sleep(0.05)

    def fill(self):
        self.filler = self.disk / "filler"
        with open(self.filler, "wb", buffering=0) as stream:
            for block in (4096, 1):
                try:
                    while True:
                        stream.write(bytes(block))
                except OSError as error:
                    self.assertEqual(error.errno, errno.ENOSPC)

    def test_save_and_load(self):
        earlier, live, after = (self.folder / name for name in ("earlier", "live", "after"))
        self.see_trunk(0.20)
        self.assertTrue(self.save(directory=str(earlier)).success)
        self.assertAlmostEqual(radius(earlier), 0.20, delta=0.005)
        self.assertTrue(rospy.ServiceProxy("tree_mapping/reset", Trigger)().success)
        self.see_trunk(0.10)
        kept = self.disk / "map"
        self.assertTrue(self.save(directory=str(kept)).success)
        session = self.disk / "session"
        maps, journal = contents(kept), (session / "scans.journal").read_bytes()
        self.fill()

        saved = self.save(directory=str(kept))
        self.assertFalse(saved.success)
        self.assertIn("No space left on device", saved.message)
        self.assertIn(str(kept), saved.message)
        self.assertEqual(contents(kept), maps)

        loaded = self.load(directory=str(earlier))
        self.assertFalse(loaded.success)
        self.assertIn("No space left on device", loaded.message)
        self.assertIn("the running map stays", loaded.message)
        self.assertEqual((session / "scans.journal").read_bytes(), journal)
        self.assertFalse((session / "base").exists() or (session / "next").exists())
        self.assertTrue(self.save(directory=str(live)).success)
        self.assertAlmostEqual(radius(live), 0.10, delta=0.005)
        # It goes on being mapped, too.
        self.see_trunk(0.10, scans=5)

        self.filler.unlink()
        loaded = self.load(directory=str(earlier))
        self.assertTrue(loaded.success, loaded.message)
        self.assertTrue((session / "base" / "tree_map.json").exists())
        self.assertTrue(self.save(directory=str(after)).success)
        self.assertAlmostEqual(radius(after), 0.20, delta=0.005)


if __name__ == "__main__":
    rospy.init_node("full_disk_rostest")
    rostest.rosrun("dendro_slam", "full_disk", FullDiskTest, sys.argv)
