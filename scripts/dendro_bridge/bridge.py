"""Runs a script: starts its sources and the recorder, watches them, and says how they are."""
import json
import os
import shutil
import signal
import socket
import tempfile
import threading
import time

import rosgraph
import rosparam
import rospy
import tf2_ros
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import TransformStamped
from std_msgs.msg import String

from . import programs, script as scripts
from .children import Child, process_start, stop_all
from .recorder import RateOfBytes, Recorder
from .status import Counter, StatusLine, duration, size, source_part

READY_S = 60.0        # how long the pipeline is waited for before the script begins anyway
HEAD_START_S = 0.5    # from the sources' start to script time 0
AFTER_END_S = 2.0     # the last scans pass through the pipeline before the bag is closed
LOOP_S = 0.05
MAPPING = "/tree_mapping"
STAGES = ("vlp16_decoder", "wood_segmentation", "branch_separation", "cylinder_fitting", "wood_icp",
          "tree_mapping")


def quaternion_of(roll, pitch, yaw):
    """x y z w of turns about the fixed axes x, y, z in this order [rad]."""
    import math
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy)


def static_transform(rig):
    """camera -> lidar, from the rig's file."""
    import math
    mount = rig["lidar_in_camera"]
    msg = TransformStamped()
    msg.header.stamp = rospy.Time.now()
    msg.header.frame_id = rig["camera"]["frame"]
    msg.child_frame_id = rig["lidar"]["frame"]
    t, r = msg.transform.translation, msg.transform.rotation
    t.x, t.y, t.z = mount["x_m"], mount["y_m"], mount["z_m"]
    r.x, r.y, r.z, r.w = quaternion_of(*(math.radians(mount[k])
                                         for k in ("roll_deg", "pitch_deg", "yaw_deg")))
    return msg


class Sockets:
    """The UDP sockets of a live lidar, kept open here: packets wait in them while the source that
    reads them is started again."""

    def __init__(self, source):
        self.source = source
        self.open = {}

    def fds(self):
        for key in ("data", "position"):
            port = self.source[key + "_port"]
            if port == 0 or key in self.open:
                continue
            s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            try:
                s.bind((self.source["address"], port))
            except OSError as error:
                s.close()
                raise OSError(f"udp {self.source['address']}:{port}: {error.strerror}") from None
            self.open[key] = s
        return {key: s.fileno() for key, s in self.open.items()}


class Bridge:
    def __init__(self, script, options, line=None):
        """@param options  record (bool or None), folder, pipeline (node or ""), run, stay."""
        self.script = script
        self.options = options
        self.line = line or StatusLine()
        self.stopping = threading.Event()
        self.name = rospy.get_name()
        self.state_param = self.name + "/state"
        self.master = rosgraph.Master(self.name)
        self.reports = {}   # what is said on /diagnostics: name -> {key: value}
        self.rate_of_bytes = RateOfBytes()
        self.map_rate = Counter()
        self.children = {}
        self.sockets = {}
        self.recorder = None
        self.ended = False
        self.readers = {}
        self.started_ns = 0

    # --- What outlives a bridge that dies --------------------------------------------------------

    def save_state(self):
        state = {"run": self.options.run, "started_ns": str(self.started_ns), "ended": self.ended,
                 "readers": self.readers, "run_folder": self.run_folder, "prefix": self.prefix,
                 "children": {n: c.state() for n, c in self.children.items()}}
        if self.recorder:
            state["children"]["recorder"] = self.recorder.child.state()
        text = json.dumps(state)
        if text != self.saved_state:
            rospy.set_param(self.state_param, text)
            self.saved_state = text

    def load_state(self):
        self.saved_state = None
        state = json.loads(rospy.get_param(self.state_param, "{}"))
        if state and state["run"] != self.options.run:
            for child in state["children"].values():  # left behind by another launch
                if child["pid"] and process_start(child["pid"]) == child["ticks"]:
                    os.kill(child["pid"], signal.SIGINT)
            return {}
        return state

    # --- Beginning -------------------------------------------------------------------------------

    def prepare(self):
        state = self.load_state()
        self.run_folder = state.get("run_folder") or tempfile.mkdtemp(prefix="driver_bridge_")
        os.makedirs(self.run_folder, exist_ok=True)
        self.prefix = state.get("prefix") or time.strftime("rig_%Y-%m-%d-%H-%M-%S")
        self.status_topic = rospy.Publisher("~status", String, queue_size=1, latch=True)
        self.released = rospy.Publisher("~released", String, queue_size=10, latch=True)
        self.diagnostics = rospy.Publisher("/diagnostics", DiagnosticArray, queue_size=10)
        self.broadcaster = tf2_ros.StaticTransformBroadcaster()
        self.broadcaster.sendTransform(static_transform(self.script["rig"]))
        rospy.Subscriber("/diagnostics", DiagnosticArray, self.on_diagnostics, queue_size=100)
        self.make_recorder()
        for source in self.script["sources"]:
            self.children[source["name"]] = self.make_child(source)
        if state:
            return self.take_over(state)
        if self.recorder:
            self.recorder.child.start()
        self.wait_for_readers()
        self.started_ns = time.time_ns() + round(HEAD_START_S * 1e9)
        self.save_state()
        return None

    def take_over(self, state):
        self.started_ns = int(state["started_ns"])
        self.readers = state["readers"]
        self.ended = state["ended"]
        children = dict(self.children)
        if self.recorder:
            children["recorder"] = self.recorder.child
        alive = sum(child.adopt(state["children"][name]) for name, child in children.items()
                    if name in state["children"])
        self.line.say(f"it was started again and took over {alive} running processes")

    def make_recorder(self):
        settings = self.script["record"]
        wanted = self.options.record if self.options.record is not None else settings is not None
        if not wanted:
            return
        settings = dict(settings or {k: f.default for k, f in scripts.RECORD.items()})
        if self.options.folder:
            settings["folder"] = self.options.folder
        settings["folder"] = os.path.abspath(os.path.expanduser(settings["folder"]))
        topics = [t for s in self.script["sources"] for t in scripts.published_topics(s)]
        topics += [t for t in ["/tf_static", "/diagnostics", *settings["topics"]] if t not in topics]
        self.recorder = Recorder(settings, topics, self.name + "_recorder", self.run_folder,
                                 self.prefix, self.release_recorder)

    def release_recorder(self):
        """The sources need not wait for the recorder any more."""
        self.released.publish(String(self.recorder.node_name))

    def make_child(self, source):
        program = programs.find_program("sensor_source")
        name = source["name"]
        if source["type"] == "vlp16_udp":
            self.sockets[name] = Sockets(source)

        def command():
            config = scripts.source_config(source)
            config["started_ns"] = str(self.started_ns)
            config["readers"] = self.readers.get(name, [])
            config["released_on"] = self.name + "/released"
            if self.options.pipeline in config["readers"]:
                config["acknowledged_by"] = self.options.pipeline
                config["acknowledged_on"] = MAPPING + "/graph_status"
            if "file" in source:
                config["progress"] = os.path.join(self.run_folder, name + ".progress")
            if name in self.sockets:
                for key, fd in self.sockets[name].fds().items():
                    config[key + "_fd"] = fd
            # The lidar comes back last: the scans need the poses.
            config["settle_s"] = 1.3 if source["type"].startswith("vlp16") else 1.0
            return [program, json.dumps(config), "__name:=" + name]

        def fds():
            return tuple(self.sockets[name].fds().values()) if name in self.sockets else ()

        return Child(name, command, os.path.join(self.run_folder, name + ".log"), fds)

    def subscribers(self):
        """topic -> nodes, as the master knows them."""
        try:
            return dict(self.master.getSystemState()[1])
        except (rosgraph.MasterException, OSError):
            return {}

    def wait_for_readers(self):
        """Waits until the pipeline and the recorder listen, and learns who listens to what."""
        important = [self.options.pipeline] if self.options.pipeline else []
        if self.recorder:
            important.append(self.recorder.node_name)
        deadline = time.monotonic() + READY_S
        topics = {s["name"]: scripts.published_topics(s) for s in self.script["sources"]}
        every = {t for ts in topics.values() for t in ts}
        missing = list(important)
        while missing and not self.stopping.is_set():
            listening = self.subscribers()
            missing = [n for n in important
                       if not any(n in listening.get(t, []) for t in every)]
            if missing and time.monotonic() > deadline:
                self.line.say(f"{', '.join(missing)} does not listen to any source after "
                              f"{READY_S:.0f} s; the script begins without")
                break
            self.stopping.wait(0.1)
        if important:
            self.stopping.wait(1.0)  # the other subscriptions of the same node
        listening = self.subscribers()
        self.readers = {name: [n for n in important if n in listening.get(ts[0], [])]
                        for name, ts in topics.items()}

    # --- Reports ---------------------------------------------------------------------------------

    def on_diagnostics(self, array):
        for status in array.status:
            report = {v.key: v.value for v in status.values}
            report["message"] = status.message
            report["level"] = status.level
            report["time"] = time.monotonic()
            self.reports[status.name.lstrip("/")] = report

    def report_of(self, name):
        report = self.reports.get(name.lstrip("/"))
        if report is None or time.monotonic() - report["time"] > 3.0:
            return None
        return report

    def status_text(self):
        script_s = (time.time_ns() - self.started_ns) * 1e-9
        parts = [f"{max(0, int(script_s)) // 60}:{max(0, int(script_s)) % 60:02d}"]
        for source in self.script["sources"]:
            name = source["name"]
            child = self.children[name]
            down = bool(child.problem) and not child.running()
            parts.append(source_part(name, self.report_of(name), child.done or self.ended, down))
        parts.append(self.map_text())
        if self.recorder:
            total = self.recorder.bytes()
            self.rate_of_bytes.add(total)
            done, active = self.recorder.files()
            left = self.recorder.seconds_left(self.rate_of_bytes.per_second())
            recording = "DISK FULL" if self.recorder.full else f"bag {size(total)} in " \
                f"{len(done) + len(active)}"
            parts.append(recording)
            free = f"disk {size(self.recorder.free_bytes())}"
            parts.append(free + (f" ({duration(left)})" if left is not None else ""))
        restarts = {n: c.restarts for n, c in self.everyone().items() if c.restarts}
        if restarts:
            parts.append("restarts " + " ".join(f"{n} {c}" for n, c in restarts.items()))
        if self.ended:
            parts.append("script over")
        return " | ".join(p for p in parts if p)

    def map_text(self):
        if not self.options.pipeline:
            return ""
        report = self.report_of(MAPPING)
        if report is None:
            return "map DOWN"
        scans = int(report.get("scans processed", 0))
        dropped = sum(int(v) for stage in STAGES for k, v in (self.report_of(stage) or {}).items()
                      if k.startswith("dropped"))
        text = f"map {self.map_rate.rate(scans):.1f} Hz {dropped} dropped"
        landmarks = report.get("landmarks")
        return text + (f" {int(float(landmarks))} cylinders" if landmarks is not None else "")

    def everyone(self):
        people = dict(self.children)
        if self.recorder:
            people["recorder"] = self.recorder.child
        return people

    def publish_status(self):
        text = self.status_text()
        self.status_topic.publish(String(text))
        status = DiagnosticStatus(name="driver_bridge", hardware_id="dendro_slam", message=text)
        people = self.everyone()
        down = [n for n, c in people.items() if c.wanted and not c.done and not c.running()]
        if down or (self.recorder and self.recorder.full):
            status.level = DiagnosticStatus.ERROR
        elif any(c.restarts for c in people.values()):
            status.level = DiagnosticStatus.WARN
        status.values = [KeyValue(f"restarts {n}", str(c.restarts)) for n, c in people.items()]
        status.values += [KeyValue(f"pid {n}", str(c.pid or 0)) for n, c in people.items()]
        if self.recorder:
            done, active = self.recorder.files()
            status.values += [KeyValue("bags finished", str(len(done))),
                              KeyValue("bags in work", str(len(active))),
                              KeyValue("bytes recorded", str(self.recorder.bytes())),
                              KeyValue("bytes free", str(self.recorder.free_bytes())),
                              KeyValue("disk full", str(self.recorder.full).lower())]
        array = DiagnosticArray(status=[status])
        array.header.stamp = rospy.Time.now()
        self.diagnostics.publish(array)
        if not self.ended or self.line.terminal:
            self.line.show(text)

    # --- The loop --------------------------------------------------------------------------------

    def run(self):
        self.prepare()
        shown = 0.0
        while not self.stopping.is_set() and not rospy.is_shutdown():
            for child in self.children.values():
                self.tend(child)
            if self.recorder and not self.ended:
                happened = self.recorder.tend()
                if happened:
                    self.line.say(happened)
            if time.monotonic() - shown >= 1.0:
                shown = time.monotonic()
                self.publish_status()
                self.save_state_if_possible()
            if not self.ended and self.over():
                self.end()
                if not self.options.stay:
                    break
            self.stopping.wait(LOOP_S)
        self.finish()

    def tend(self, child):
        if self.ended:
            return
        before = (child.pid, child.done)
        if child._popen is None and child.pid is not None and not child.running():
            # A child of the bridge that died: its exit status is not ours to read.
            report = self.reports.get(child.name)
            child.done = bool(report) and report["message"] == "ended"
        happened = child.tend()
        if happened:
            self.line.say(happened)
        if (child.pid, child.done) != before:
            self.save_state_if_possible()

    def save_state_if_possible(self):
        try:
            self.save_state()
        except (rospy.ROSException, rosgraph.MasterException, OSError, rosparam.RosParamException):
            pass  # the master is gone; what runs goes on

    def over(self):
        script_s = (time.time_ns() - self.started_ns) * 1e-9
        if script_s > self.script["duration_s"]:
            return True
        return bool(self.children) and all(c.done for c in self.children.values())

    def end(self):
        """The script is over: the sources end, the bag is closed."""
        stop_all(self.children.values())
        self.stopping.wait(AFTER_END_S)
        if self.recorder:
            self.recorder.stop()
        self.ended = True
        self.save_state_if_possible()
        self.line.show(self.status_text(), now=True)
        self.line.say("the script is over" + self.recorded_text())

    def recorded_text(self):
        if not self.recorder:
            return ""
        done, active = self.recorder.files()
        text = f"; {size(self.recorder.bytes())} in {len(done)} bags: {self.recorder.prefix}-*.bag"
        for path in active:
            text += f"; {path} was cut off: rosbag reindex {path}"
        return text

    def finish(self):
        if not self.ended:
            stop_all(self.children.values())
            if self.recorder:
                self.recorder.stop()
                self.line.say("stopped" + self.recorded_text())
        if not any(c.restarts for c in self.everyone().values()):
            shutil.rmtree(self.run_folder, ignore_errors=True)  # else the logs say why
        try:
            rospy.delete_param(self.state_param)
        except (KeyError, rospy.ROSException, OSError):
            pass
