"""roslaunch and driver_bridge under a master of their own, for the tests of the bridge."""
import contextlib
import json
import os
import pathlib
import signal
import socket
import subprocess
import sys
import time

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))
SHARED = pathlib.Path(os.environ.get("DENDRO_SHARED_DATA", ROOT / "../shared/data"))
CAPTURE = SHARED / "vlp16" / "grap_apple_20frames.pcap"
TRACK = SHARED / "vlp16" / "grap_apple_gnss_track.txt"


def free_port():
    with contextlib.closing(socket.socket()) as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def wait_for(condition, timeout_s, what):
    """Waits for something true and returns it."""
    deadline = time.monotonic() + timeout_s
    while True:
        found = condition()
        if found:
            return found
        assert time.monotonic() < deadline, f"not within {timeout_s:g} s: {what}"
        time.sleep(0.05)


def alive(pid):
    from dendro_bridge.children import process_start
    return process_start(pid) is not None


def children_of(pid):
    """Pids of all processes below one."""
    found = []
    for task in pathlib.Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            for child in task.read_text().split():
                found += [int(child), *children_of(int(child))]
    return found


class Ros:
    """A master and whatever is started under it; all of it ends with `close`."""

    def __init__(self, folder):
        self.folder = pathlib.Path(folder)
        self.port = free_port()
        self.environment = dict(os.environ, ROS_MASTER_URI=f"http://localhost:{self.port}",
                                ROS_HOSTNAME="localhost", ROS_LOG_DIR=str(self.folder / "log"),
                                HOME=str(self.folder), PYTHONUNBUFFERED="1")
        os.environ.update({k: self.environment[k] for k in ("ROS_MASTER_URI", "ROS_HOSTNAME")})
        self.started = []

    def start(self, command, log):
        with open(self.folder / log, "ab") as out:
            process = subprocess.Popen([str(c) for c in command], stdout=out,
                                       stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
                                       env=self.environment, start_new_session=True)
        self.started.append(process)
        return process

    def log(self, name):
        return (self.folder / name).read_text(errors="replace")

    def master(self):
        import rosgraph
        return rosgraph.Master("/bridge_test")

    def state(self, bridge="/driver_bridge"):
        """What the bridge keeps for its successor; None before there is any."""
        try:
            return json.loads(self.master().getParam(bridge + "/state"))
        except Exception:  # no master yet, or no parameter
            return None

    def pid_of(self, node):
        """Of a node, from itself."""
        import xmlrpc.client
        try:
            uri = self.master().lookupNode(node)
            return xmlrpc.client.ServerProxy(uri).getPid("/bridge_test")[2]
        except Exception:  # not there, or just gone
            return None

    def close(self):
        state = self.state()
        for process in reversed(self.started):
            below = children_of(process.pid)
            for number, patience in ((signal.SIGINT, 25), (signal.SIGKILL, 5)):
                if process.poll() is not None:
                    break
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process.pid, number)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(patience)
            for pid in below:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        for child in (state or {"children": {}})["children"].values():
            if child["pid"] and alive(child["pid"]):
                os.kill(child["pid"], signal.SIGKILL)


def missing_packets(bags):
    """(packets, missing between the first and the last) of recordings, by the sensor's own clock."""
    import rosbag
    times = set()
    for path in bags:
        with rosbag.Bag(path) as bag:
            for _, scan, _ in bag.read_messages("/velodyne_packets"):
                for packet in scan.packets:
                    stamp = packet.stamp.to_nsec()
                    of_hour = int.from_bytes(bytes(packet.data)[1200:1204], "little")
                    times.add((stamp, of_hour))
    ordered = sorted(times)
    missing = 0
    for (_, a), (_, b) in zip(ordered, ordered[1:]):
        missing += max(0, round(((b - a) % 3600000000) / 1327.104) - 1)
    return len(ordered), missing


def stamps_of(bags, topic):
    import rosbag
    stamps = set()
    for path in bags:
        with rosbag.Bag(path) as bag:
            stamps |= {m.header.stamp.to_nsec() for _, m, _ in bag.read_messages(topic)}
    return sorted(stamps)
