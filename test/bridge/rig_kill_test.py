#!/usr/bin/python3
"""The orchard capture and a pose file through rig.launch, while every process of it is killed with -9.

Each death may cost the scan that the process had in work, nothing more: counted in the recording (by the
sensor's own clock) and in the map (by its trajectory).
"""
import os
import pathlib
import re
import signal
import subprocess
import sys
import tempfile
import time
import unittest

import harness
import orchard

DURATION_S = 12
TURN_PACKETS = 77


class RigKillTest(unittest.TestCase):
    def setUp(self):
        if not harness.CAPTURE.exists():
            self.skipTest(f"no capture: {harness.CAPTURE}")
        self.folder = pathlib.Path(tempfile.mkdtemp(prefix="dendro_rig_"))
        orchard.write_poses(harness.TRACK, self.folder / "poses.txt")
        (self.folder / "orchard.yaml").write_text(f"""
sources:
  - {{name: lidar, type: vlp16_pcap, file: {harness.CAPTURE.resolve()}, repeat: true, align: start}}
  - {{name: camera, type: poses, file: poses.txt, repeat: true, align: start}}
record: {{split_mb: 4, min_free_mb: 50}}
duration_s: {DURATION_S}
""")
        self.ros = harness.Ros(self.folder)
        self.addCleanup(self.ros.close)

    def kill(self, name, pid):
        """Kills and waits until it runs again under another pid."""
        self.assertTrue(pid)
        os.kill(pid, signal.SIGKILL)
        return time.monotonic()

    def kill_child(self, name):
        old = self.ros.state()["children"][name]
        self.kill(name, old["pid"])
        harness.wait_for(
            lambda: self.ros.state()["children"][name]["pid"] not in (0, old["pid"]), 15,
            f"{name} is started again")

    def kill_node(self, node, timeout_s=30):
        pid = self.ros.pid_of(node)
        self.kill(node, pid)
        harness.wait_for(lambda: self.ros.pid_of(node) not in (None, pid), timeout_s,
                         f"{node} is started again")

    def script_s(self):
        return time.time() - int(self.ros.state()["started_ns"]) * 1e-9

    def wait_until(self, script_s):
        time.sleep(max(0.0, script_s - self.script_s()))

    def test_every_process_is_killed(self):
        launch = self.ros.start(
            ["roslaunch", "-p", self.ros.port, "dendro_slam", "rig.launch",
             f"script:={self.folder / 'orchard.yaml'}", f"folder:={self.folder / 'out'}"], "rig.log")
        harness.wait_for(lambda: (self.ros.state() or {}).get("started_ns", "0") != "0", 90,
                         "the script begins")
        self.wait_until(1.5)
        self.kill_child("lidar")
        self.wait_until(3.0)
        self.kill_child("camera")
        self.wait_until(4.5)
        self.kill_child("recorder")
        self.wait_until(6.0)
        self.kill_node("/driver_bridge")
        self.wait_until(7.5)
        self.kill_node("/dendro_manager")
        self.kill_node("/rosout")
        harness.wait_for(lambda: self.ros.state()["ended"], 60 + DURATION_S, "the script ends")
        state = self.ros.state()
        log = self.ros.log("rig.log")
        self.assertIsNone(launch.poll(), log)
        for name in ("lidar", "camera", "recorder"):
            self.assertEqual(state["children"][name]["restarts"], 1, log)
        self.assertIn("took over 3 running processes", log)

        bags = self.recorded()
        packets, missing = harness.missing_packets(bags)
        print(f"recorded {packets} packets in {len(bags)} bags, {missing} missing")
        self.assertGreater(packets, (DURATION_S - 1.5) * 754)
        # The source and the recorder were killed once each.
        self.assertLessEqual(missing, 2 * TURN_PACKETS)
        poses = harness.stamps_of(bags, "/camera/odom/sample")
        gaps = [b - a for a, b in zip(poses, poses[1:])]
        # The poses of the recorder's chunk in work: a tenth of a second, and a margin for its queue.
        self.assertLess(max(gaps) * 1e-9, 0.25)

        mapped = self.mapped()
        turns = harness.stamps_of(bags, "/velodyne_packets")
        lost = sum(max(0, round((b - a) / 0.1) - 1) for a, b in zip(mapped, mapped[1:]))
        print(f"{len(turns)} revolutions recorded, {len(mapped)} mapped, {lost} lost between them")
        self.assertLessEqual(lost, 5)  # one for each process that was killed
        self.assertGreater(len(mapped), len(turns) - 5)
        restored = re.search(r"the map of (\d+) scans in .* was restored", self.ros.log("rig.log"))
        self.assertTrue(restored)
        self.assertGreater(int(restored.group(1)), 5)

    def recorded(self):
        """Every part of the recording; the part that was cut off is mended as the message says."""
        folder = self.folder / "out" / "bags"
        cut_off = list(folder.glob("*.active"))
        self.assertEqual(len(cut_off), 1, "the recorder was killed once")
        subprocess.run(["rosbag", "reindex", "-q", cut_off[0]], check=True, timeout=60,
                       env=self.ros.environment)
        bags = sorted(folder.glob("*.bag")) + [cut_off[0]]
        self.assertGreaterEqual(len(bags), 4)
        for bag in bags:
            subprocess.run(["rosbag", "info", bag], check=True, stdout=subprocess.DEVNULL, timeout=60)
        return bags

    def mapped(self):
        """Stamps of the mapped scans [s], once everything has been worked off."""
        from dendro_slam.srv import SaveMap
        import rospy
        rospy.init_node("rig_kill_test", anonymous=True, disable_signals=True)
        rospy.wait_for_service("/tree_mapping/save_map", 60)
        save = rospy.ServiceProxy("/tree_mapping/save_map", SaveMap)
        before = 0
        for _ in range(60):
            reply = save(directory=str(self.folder / "map"))
            self.assertTrue(reply.success, reply.message)
            lines = (self.folder / "map" / "trajectory.tum").read_text().splitlines()
            stamps = [float(line.split()[0]) for line in lines if not line.startswith("#")]
            if len(stamps) == before:
                return stamps
            before = len(stamps)
            time.sleep(1.5)
        self.fail("the scans are not worked off")
        return []


if __name__ == "__main__":
    sys.path.insert(0, str(pathlib.Path(__file__).parent))
    unittest.main(verbosity=2, warnings="ignore")
