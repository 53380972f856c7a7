#!/usr/bin/python3
"""driver_bridge without the pipeline: faults as they are seen in the topics and the recording, a process that
is killed, a live lidar whose reader dies, splits, the status line, a full disk, the end of the script."""
import os
import pathlib
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import unittest

import harness

FROM_S, TO_S = 1.5, 3.0
DROP = 0.3


def tum(path, duration_s, rate_hz=50):
    """A straight line, 1 m/s along x."""
    with open(path, "w") as f:
        for k in range(int(duration_s * rate_hz)):
            f.write(f"{1000 + k / rate_hz:.6f} {k / rate_hz:.6f} 0 0 0 0 0 1\n")


class Spy:
    """Everything that comes on a topic, with the time of its arrival."""

    def __init__(self, topic, kind):
        import rospy
        self.seen = []
        self.subscriber = rospy.Subscriber(topic, kind, self.on_message, queue_size=10000)

    def on_message(self, message):
        self.seen.append((time.time(), message))


class BridgeTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        import rospy
        cls.folder = pathlib.Path(tempfile.mkdtemp(prefix="dendro_bridge_"))
        cls.ros = harness.Ros(cls.folder)
        cls.addClassCleanup(cls.ros.close)
        cls.ros.start(["roscore", "-p", cls.ros.port], "roscore.log")
        harness.wait_for(lambda: cls.ros.pid_of("/rosout"), 30, "the master is up")
        rospy.init_node("bridge_test", disable_signals=True)
        tum(cls.folder / "line.txt", 20)

    def bridge(self, name, script, *options):
        path = self.folder / f"{name}.yaml"
        path.write_text(script)
        return self.ros.start([harness.ROOT / "scripts" / "driver_bridge", path, *options],
                              f"{name}.log")

    def started_s(self):
        state = harness.wait_for(
            lambda: (s := self.ros.state()) and s["started_ns"] != "0" and s, 30, "it begins")
        return int(state["started_ns"]) * 1e-9

    def ends(self, process, timeout_s=40):
        try:
            self.assertEqual(process.wait(timeout_s), 0)
        except subprocess.TimeoutExpired:
            self.fail("the bridge does not end")

    def test_faults_do_what_they_say(self):
        from nav_msgs.msg import Odometry
        source = "  - {{name: {0}, type: poses, file: line.txt, topic: /{0}, faults: [{1}]}}\n"
        window = f"from_s: {FROM_S}, to_s: {TO_S}"
        faults = {"plain": "", "dropped": f"{{fault: drop, ratio: {DROP}, {window}}}",
                  "late": f"{{fault: delay, delay_s: 0.5, {window}}}",
                  "jumped": f"{{fault: jump, x_m: 3, stamp_s: 100, {window}}}",
                  "silent": f"{{fault: silence, {window}}}"}
        spies = {name: Spy("/" + name, Odometry) for name in faults}
        passed_on = Spy("/passed_on", Odometry)
        relay = ("  - {name: relay, type: topic, topic: /plain, output: /passed_on, offset_s: 10,"
                 f" faults: [{{fault: silence, from_s: {TO_S}}}]}}\n")
        bridge = self.bridge("faults", "duration_s: 4.2\nsources:\n" + relay
                             + "".join(source.format(n, f) for n, f in faults.items()))
        begin = self.started_s()
        self.ends(bridge)

        def during(name, low=FROM_S, high=TO_S):
            """x tells when a pose was due; the edges are left out."""
            return [(t, m) for t, m in spies[name].seen
                    if low + 0.1 <= m.pose.pose.position.x % 20 <= high - 0.1]

        count = {name: len(during(name)) for name in faults if name != "jumped"}
        expected = (TO_S - FROM_S - 0.2) * 50
        self.assertAlmostEqual(count["plain"], expected, delta=2)
        self.assertEqual(count["silent"], 0)
        self.assertGreater(len(during("silent", TO_S, 4.0)), 30)
        # Binomial of 65: sigma 0.057; four of them.
        self.assertAlmostEqual(count["dropped"] / expected, 1 - DROP, delta=0.23)
        self.assertEqual(count["late"], count["plain"])
        # How long after their stamps they come, beside the same poses without the delay.
        delay = [t - m.header.stamp.to_sec() for t, m in during("late")]
        plain = [t - m.header.stamp.to_sec() for t, m in during("plain")]
        self.assertAlmostEqual(sorted(delay)[len(delay) // 2] - sorted(plain)[len(plain) // 2], 0.5,
                               delta=0.1)
        order = [m.header.stamp for _, m in spies["late"].seen]
        self.assertEqual(order, sorted(order))
        jumped = [m for _, m in spies["jumped"].seen if m.header.stamp.to_sec() > begin + 100]
        self.assertAlmostEqual(len(jumped), (TO_S - FROM_S) * 50, delta=5)
        for m in jumped:  # 3 m ahead of where it is by its stamp
            self.assertAlmostEqual(m.pose.pose.position.x - (m.header.stamp.to_sec() - 100 - begin),
                                   3.0, delta=0.03)
        # A topic is passed on with its stamps moved, until it is silenced.
        relayed = {m.header.stamp.to_nsec() for _, m in passed_on.seen}
        plain = {m.header.stamp.to_nsec() + 10 * 10**9 for _, m in spies["plain"].seen}
        self.assertTrue(relayed <= plain)
        self.assertAlmostEqual(len(relayed), TO_S * 50, delta=40)

    def test_a_killed_source_goes_on_where_it_was(self):
        from std_msgs.msg import String
        status = Spy("/driver_bridge/status", String)
        bridge = self.bridge("killed", "duration_s: 4.5\nsources:\n"
                             "  - {name: camera, type: poses, file: line.txt, topic: /odometry}\n"
                             "record: {folder: killed, split_mb: 1, min_free_mb: 10}\n")
        begin = self.started_s()
        for at in (1.0, 2.0):  # the second death is answered a little later
            time.sleep(max(0.0, begin + at - time.time()))
            pid = self.ros.state()["children"]["camera"]["pid"]
            os.kill(pid, signal.SIGKILL)
            harness.wait_for(lambda: self.ros.state()["children"]["camera"]["pid"] not in (0, pid),
                             10, "it is started again")
        self.ends(bridge)
        bags = sorted((self.folder / "killed").glob("*.bag"))
        stamps = harness.stamps_of(bags, "/odometry")
        self.assertGreaterEqual(len(stamps), 215)
        self.assertLess(max(b - a for a, b in zip(stamps, stamps[1:])), 0.021e9)  # none is missing
        line = status.seen[-1][1].data
        self.assertRegex(line, r"^0:0\d \| camera .*\| bag \d+ MB in \d+ \| disk [\d.]+ GB.*"
                               r"restarts camera 2")
        self.assertIn("confidence high", " ".join(m.data for _, m in status.seen))
        self.assertIn("camera was killed by SIGKILL; it is started again", self.ros.log("killed.log"))

    def test_a_bad_script_is_one_line(self):
        (self.folder / "bad.yaml").write_text("sources:\n  - {name: a, type: poses, fil: line.txt}\n")
        done = subprocess.run([harness.ROOT / "scripts" / "driver_bridge", self.folder / "bad.yaml"],
                              stderr=subprocess.PIPE, text=True, timeout=30)
        self.assertEqual(done.returncode, 2)
        self.assertRegex(done.stderr, r"^driver_bridge: .*/bad.yaml:2: sources\[0\]: unknown key 'fil' "
                                      r"\(did you mean 'file'\?\)[^\n]*\n$")

    def test_a_full_disk_stops_the_recording_only(self):
        from nav_msgs.msg import Odometry
        disk = self.folder / "disk"
        disk.mkdir()
        mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", disk],
                                 stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)
        if mounted.returncode != 0:
            self.skipTest("a small disk cannot be mounted here (needs root)")
        self.addCleanup(subprocess.run, ["umount", "-l", disk], check=False)
        with open(self.folder / "fast.txt", "w") as f:
            for k in range(12000):
                f.write(f"{1000 + k / 2000:.6f} 0 0 0 0 0 0 1\n")
        spy = Spy("/fast", Odometry)
        bridge = self.bridge("full", "duration_s: 4\nsources:\n"
                             "  - {name: camera, type: poses, file: fast.txt, topic: /fast}\n"
                             "record: {folder: disk, min_free_mb: 0}\n")
        begin = self.started_s()
        self.ends(bridge)
        log = self.ros.log("full.log")
        self.assertEqual(log.count("recording has stopped"), 1, log)
        self.assertRegex(log, r"recording has stopped: \d+ MB are left on the disk of .*/disk; "
                              r"[\d.]+ MB are recorded, mapping goes on")
        self.assertNotIn("started again", log)
        self.assertGreater(spy.seen[-1][0], begin + 3.7)  # the source went on to the end

    def test_a_live_lidar_loses_nothing_when_its_reader_dies(self):
        port = harness.free_port()
        (self.folder / "live_rig.yaml").write_text(
            (harness.ROOT / "config" / "rig.yaml").read_text().replace("2368", str(port))
            .replace("8308", "0"))
        bridge = self.bridge("live", "rig: live_rig.yaml\nduration_s: 4\nsources:\n"
                             "  - {name: lidar, type: vlp16_udp, address: 127.0.0.1}\n"
                             "record: {folder: live, min_free_mb: 10}\n")
        begin = self.started_s()
        sent = []

        def send():
            s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            while time.time() < begin + 3.2:
                k = len(sent)
                # 754 packets a second, one revolution of 76; the reader may be away for a third of it.
                azimuth = int(k * 36000 / 76) % 36000
                block = b"\xff\xee" + azimuth.to_bytes(2, "little") + b"\x00" * 96
                s.sendto(block * 12 + (k * 1327 % 3600000000).to_bytes(4, "little") + b"\x37\x22",
                         ("127.0.0.1", port))
                sent.append(k)
                time.sleep(max(0.0, begin + 0.3 + len(sent) * 0.001327 - time.time()))

        sender = threading.Thread(target=send)
        harness.wait_for(lambda: self.ros.pid_of("/lidar"), 20, "the source runs")
        time.sleep(max(0.0, begin + 0.3 - time.time()))
        sender.start()
        time.sleep(1.0)
        os.kill(self.ros.state()["children"]["lidar"]["pid"], signal.SIGKILL)
        sender.join()
        self.ends(bridge)
        packets, missing = harness.missing_packets(sorted((self.folder / "live").glob("*.bag")))
        print(f"sent {len(sent)}, recorded {packets}, missing {missing}")
        self.assertGreater(packets, 1500)
        # The revolution that the killed process had begun.
        self.assertLessEqual(missing, 77)


if __name__ == "__main__":
    unittest.main(verbosity=2, warnings="ignore")
