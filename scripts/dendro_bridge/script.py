"""The script of driver_bridge and the rig's file: read strictly, every error with its line.

A script is YAML (config/scripts/ has examples). Nothing is guessed: an unknown key, a wrong type, a
value out of range or a recording that cannot be read is one `ScriptError`,
`FILE:LINE: KEY: what is wrong and what is expected`.
"""
import dataclasses
import difflib
import ipaddress
import json
import math
import os
import re
import subprocess

import yaml

REQUIRED = object()
NEVER_S = 1e9


class ScriptError(Exception):
    """One line for the user."""


@dataclasses.dataclass
class Field:
    """What a key may hold. `low` and `high` are allowed, `above` is not."""
    kind: str  # text name topic file folder address number whole flag choice topics group groups
    default: object = REQUIRED
    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    choices: tuple = ()
    fields: dict = None  # of a group


EXPECTED = {
    "text": "text", "name": "a name like lidar_2", "topic": "a topic like /velodyne_packets",
    "file": "the path of a file", "folder": "the path of a folder",
    "address": "an IPv4 address", "number": "a number", "whole": "a whole number",
    "flag": "true or false", "topics": "a list of topics", "group": "a group of keys",
    "groups": "a list, a group of keys each",
}

FAULTS = {
    "drop": {"ratio": Field("number", above=0, high=1)},
    "delay": {"delay_s": Field("number", above=0, high=60)},
    "silence": {},
    "jump": {"stamp_s": Field("number", 0.0, low=-1e6, high=1e6), "x_m": Field("number", 0.0),
             "y_m": Field("number", 0.0), "z_m": Field("number", 0.0),
             "yaw_deg": Field("number", 0.0)},
}
FAULT_TIMES = {"from_s": Field("number", 0.0, low=0), "to_s": Field("number", NEVER_S, above=0)}

ANY_SOURCE = {
    "name": Field("name"),
    "start_s": Field("number", 0.0, low=0),
    "stop_s": Field("number", NEVER_S, above=0),
    "offset_s": Field("number", 0.0, low=-1e9, high=1e9),
    "faults": Field("groups", []),
}
REPLAY = {
    "file": Field("file"),
    "rate": Field("number", None, above=0, high=100),
    "repeat": Field("flag", False),
    "align": Field("choice", "clock", choices=("clock", "start")),
}
SOURCES = {
    "vlp16_udp": {
        "topic": Field("topic", "/velodyne_packets"),
        "fix_topic": Field("topic", "/fix"),
        "address": Field("address", "0.0.0.0"),
    },
    "vlp16_pcap": {
        **REPLAY,
        "topic": Field("topic", "/velodyne_packets"),
        "fix_topic": Field("topic", "/fix"),
        "data_port": Field("whole", None, low=1, high=65535),
        "position_port": Field("whole", None, low=0, high=65535),
    },
    "poses": {
        **REPLAY,
        "topic": Field("topic", "/camera/odom/sample"),
        "format": Field("choice", "auto", choices=("auto", "tum", "realsense")),
        "sigma_rotation_rad": Field("number", 0.1, above=0),
        "sigma_translation_m": Field("number", 0.1, above=0),
    },
    "topic": {
        "topic": Field("topic"),
        "output": Field("topic", ""),
    },
}
RECORD = {
    "folder": Field("folder", "~/dendro_slam/bags"),
    "topics": Field("topics", []),
    "split_mb": Field("whole", 1024, low=1, high=1000000),
    "min_free_mb": Field("whole", 1000, low=0),
}
SCRIPT = {
    "rig": Field("file", None),
    "clock": Field("choice", "now", choices=("now", "recorded")),
    "rate": Field("number", 1.0, above=0, high=100),
    "duration_s": Field("number", NEVER_S, above=0),
    "seed": Field("whole", 1, low=0, high=2**31 - 1),
    "sources": Field("groups"),
    "record": Field("group", None, fields=RECORD),
}
RIG = {
    "lidar": Field("group", fields={
        "frame": Field("text", "velodyne"),
        "sender": Field("address", ""),
        "data_port": Field("whole", 2368, low=1, high=65535),
        "position_port": Field("whole", 8308, low=0, high=65535),
        "time_offset_s": Field("number", 0.0, low=-3600, high=3600),
    }),
    "camera": Field("group", fields={
        "frame": Field("text", "camera_pose_frame"),
        "odom_frame": Field("text", "odom"),
        "time_offset_s": Field("number", 0.0, low=-3600, high=3600),
    }),
    "lidar_in_camera": Field("group", fields={
        key: Field("number", low=-1000, high=1000)
        for key in ("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg")}),
}


class _Reader:
    """Turns the nodes of a YAML file into values; knows the line of each."""

    def __init__(self, path):
        self.path = path
        self.constructor = yaml.constructor.SafeConstructor()

    def fail(self, node, key, what):
        line = f":{node.start_mark.line + 1}" if node is not None else ""
        raise ScriptError(f"{self.path}{line}: {key + ': ' if key else ''}{what}")

    def root(self):
        try:
            with open(self.path, encoding="utf-8") as f:
                node = yaml.compose(f, Loader=yaml.SafeLoader)
        except OSError as error:
            raise ScriptError(f"{self.path}: {error.strerror}") from None
        except UnicodeDecodeError:
            raise ScriptError(f"{self.path}: not a text file") from None
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            line = f":{mark.line + 1}" if mark else ""
            raise ScriptError(f"{self.path}{line}: not YAML: {error.problem}") from None
        except yaml.YAMLError as error:
            raise ScriptError(f"{self.path}: not YAML: {error}") from None
        if node is None:
            raise ScriptError(f"{self.path}: the file is empty")
        return node

    def mapping(self, node, where):
        """{key: (node of the key, node of the value)}."""
        if not isinstance(node, yaml.MappingNode):
            self.fail(node, where, f"expected {EXPECTED['group']}, got {self.describe(node)}")
        found = {}
        for key_node, value in node.value:
            key = str(key_node.value)
            if key in found:
                self.fail(key_node, self.join(where, key), "given twice")
            found[key] = (key_node, value)
        return found

    @staticmethod
    def join(where, key):
        return f"{where}.{key}" if where else key

    def describe(self, node):
        if isinstance(node, yaml.MappingNode):
            return "a group of keys"
        if isinstance(node, yaml.SequenceNode):
            return "a list"
        return repr(node.value) if node.value != "" else "nothing"

    def group(self, node, where, fields):
        """A group of keys as a dict with the defaults filled in."""
        found = self.mapping(node, where)
        self.refuse_unknown(found, where, fields)
        result = {}
        for key, field in fields.items():
            if key in found:
                result[key] = self.value(found[key][1], self.join(where, key), field)
            elif field.default is REQUIRED:
                self.fail(node, where, f"'{key}' is missing: expected {self.expected(field)}")
            else:
                result[key] = field.default
        return result

    def refuse_unknown(self, found, where, fields):
        for key, (key_node, _) in found.items():
            if key not in fields:
                near = difflib.get_close_matches(key, fields, 1, 0.6)
                hint = f" (did you mean '{near[0]}'?)" if near else ""
                self.fail(key_node, where,
                          f"unknown key '{key}'{hint}; known: {', '.join(fields)}")

    @staticmethod
    def expected(field):
        if field.kind == "choice":
            return " or ".join(field.choices)
        return EXPECTED[field.kind]

    def value(self, node, where, field):
        wrong = f"expected {self.expected(field)}, got {self.describe(node)}"
        if field.kind == "group":
            return self.group(node, where, field.fields)
        if field.kind in ("groups", "topics"):
            if not isinstance(node, yaml.SequenceNode):
                self.fail(node, where, wrong)
            if field.kind == "topics":
                item = Field("topic")
                return [self.value(n, f"{where}[{i}]", item) for i, n in enumerate(node.value)]
            return node  # Read by who knows its fields.
        if not isinstance(node, yaml.ScalarNode):
            self.fail(node, where, wrong)
        try:
            value = self.constructor.construct_object(node)
        except (yaml.YAMLError, ValueError):
            self.fail(node, where, wrong)
        if field.kind in ("number", "whole"):
            return self.number(node, where, field, value, wrong)
        if field.kind == "flag":
            if not isinstance(value, bool):
                self.fail(node, where, wrong)
            return value
        if field.kind == "choice":
            if value not in field.choices:
                self.fail(node, where, wrong)
            return value
        if not isinstance(value, str):
            self.fail(node, where, wrong)
        return self.text(node, where, field, value, wrong)

    def number(self, node, where, field, value, wrong):
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            self.fail(node, where, wrong)
        if field.kind == "whole" and not isinstance(value, int):
            self.fail(node, where, wrong)
        if not math.isfinite(value):
            self.fail(node, where, wrong)
        if value < field.low or value > field.high or value <= field.above:
            low = f"above {field.above:g}" if field.above > -math.inf else (
                f"at least {field.low:g}" if field.low > -math.inf else "")
            high = f"at most {field.high:g}" if field.high < math.inf else ""
            self.fail(node, where, f"expected {EXPECTED[field.kind]} "
                      f"{' and '.join(t for t in (low, high) if t)}, got {value:g}")
        return float(value) if field.kind == "number" else value

    def text(self, node, where, field, value, wrong):
        if field.kind == "name" and not re.fullmatch(r"[a-z][a-z0-9_]*", value):
            self.fail(node, where, wrong)
        if field.kind == "topic" and value and not re.fullmatch(r"/?[a-zA-Z][\w/]*\w|/?[a-zA-Z]", value):
            self.fail(node, where, wrong)
        if field.kind == "address" and value:
            try:
                ipaddress.IPv4Address(value)
            except ValueError:
                self.fail(node, where, wrong)
        if field.kind in ("file", "folder"):
            if not value:
                self.fail(node, where, wrong)
            value = self.path_of(value)
            if "$" in value:
                self.fail(node, where, f"the environment has no variable for '{value}'")
            if field.kind == "file" and not os.path.isfile(value):
                self.fail(node, where, f"no such file: {value}")
        return value

    def path_of(self, value):
        value = os.path.expandvars(os.path.expanduser(value))
        return os.path.normpath(os.path.join(os.path.dirname(os.path.abspath(self.path)), value))


def load_rig(path):
    """The rig's file as a dict."""
    reader = _Reader(path)
    return reader.group(reader.root(), "", {"rig": Field("group", fields=RIG)})["rig"]


def _read_faults(reader, nodes, where, kind):
    faults = []
    for i, node in enumerate(nodes.value):
        here = f"{where}[{i}]"
        found = reader.mapping(node, here)
        if "fault" not in found:
            reader.fail(node, here, f"'fault' is missing: expected {' or '.join(FAULTS)}")
        which = reader.value(found["fault"][1], here + ".fault",
                             Field("choice", choices=tuple(FAULTS)))
        fields = {"fault": Field("text"), **FAULT_TIMES, **FAULTS[which]}
        fault = reader.group(node, here, fields)
        if fault["to_s"] <= fault["from_s"]:
            reader.fail(node, here, f"to_s ({fault['to_s']:g}) must be later than from_s "
                        f"({fault['from_s']:g})")
        if which == "jump":
            moved = [k for k in FAULTS["jump"] if fault[k] != 0.0]
            if not moved:
                reader.fail(node, here, f"a jump needs one of {', '.join(FAULTS['jump'])}")
            if kind.startswith("vlp16") and moved != ["stamp_s"]:
                reader.fail(node, here, "a lidar can only jump in time: stamp_s")
        faults.append(fault)
    return faults


def _read_source(reader, node, where, script):
    found = reader.mapping(node, where)
    if "type" not in found:
        reader.fail(node, where, f"'type' is missing: expected {' or '.join(SOURCES)}")
    kind = reader.value(found["type"][1], where + ".type", Field("choice", choices=tuple(SOURCES)))
    fields = {"type": Field("text"), **ANY_SOURCE, **SOURCES[kind]}
    source = reader.group(node, where, fields)
    if source["stop_s"] <= source["start_s"]:
        reader.fail(node, where, f"stop_s ({source['stop_s']:g}) must be later than start_s "
                    f"({source['start_s']:g})")
    source["faults"] = (_read_faults(reader, source["faults"], where + ".faults", kind)
                        if "faults" in found else [])
    if source.get("rate", 1) is None:
        source["rate"] = script["rate"]
    if source.get("align") == "start" and script["clock"] == "recorded":
        reader.fail(found["align"][0], where, "align: start needs clock: now, for the stamps of the "
                    "sources to fit each other")
    if kind == "topic":
        changed = source["faults"] or source["offset_s"] != 0.0
        if changed and not source["output"]:
            reader.fail(node, where, "'output' is missing: faults and offset_s change the messages, "
                        "so they must be passed on under another name")
        if source["output"] == source["topic"]:
            reader.fail(found["output"][1], where + ".output", "must differ from topic")
    return source


def published_topics(source):
    """What a source puts on topics that a recording should hold."""
    if source["type"] == "topic":
        return [source["output"] or source["topic"]]
    return [t for t in (source["topic"], source.get("fix_topic")) if t]


def _apply_rig(source, rig):
    """Fills in what the rig's file says of this sensor."""
    lidar = source["type"].startswith("vlp16")
    sensor = rig["lidar"] if lidar else rig["camera"]
    source["offset_s"] += sensor["time_offset_s"] if source["type"] != "topic" else 0.0
    source["frame"] = sensor["frame"]
    if not lidar:
        source["odom_frame"] = rig["camera"]["odom_frame"]
        return
    for port in ("data_port", "position_port"):
        if source.get(port) is None:
            source[port] = rig["lidar"][port]
    if source["type"] == "vlp16_udp":
        source["sender"] = rig["lidar"]["sender"]
    if source["position_port"] == 0:
        source["fix_topic"] = ""


def source_config(source):
    """The part of a source that the program sensor_source understands."""
    return {key: value for key, value in source.items()
            if key not in ("name", "align", "first_ns", "last_ns")}


def _describe(program, source):
    """First and last stamp of a recording, read by the program that will play it."""
    text = json.dumps(source_config(source))
    done = subprocess.run([program, "--describe", text], stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        message = (done.stderr.strip().splitlines() or ["sensor_source failed"])[-1]
        raise ValueError(message)
    span = json.loads(done.stdout)
    return span["first_ns"], span["last_ns"]


def _align(script):
    """Where each recording lies in the script's time, and when the script is over [s]."""
    replays = [s for s in script["sources"] if "first_ns" in s]
    for s in replays:
        s["offset_ns"] = round(s["offset_s"] * 1e9)
    common = [s["first_ns"] + s["offset_ns"] for s in replays if s["align"] == "clock"]
    origin = min(common) if common else 0
    ends = []
    for s in script["sources"]:
        end = s["stop_s"]
        if "first_ns" in s:
            s["origin_ns"] = str(origin)
            if s["align"] == "start":
                s["origin_ns"] = str(s["first_ns"] + s["offset_ns"]
                                     - round(s["start_s"] * s["rate"] * 1e9))
            if not s["repeat"]:
                last_s = (s["last_ns"] + s["offset_ns"] - int(s["origin_ns"])) * 1e-9 / s["rate"]
                end = min(end, last_s)
            s["stamps"] = script["clock"]
            del s["offset_ns"]
        ends.append(end)
    return min(script["duration_s"], max(ends))


def load_script(path, default_rig, program=None, rig=None):
    """Reads and checks a script.

    @param default_rig  File that holds where the script names none.
    @param program  sensor_source, to look into the recordings; None: they are not looked into.
    @param rig      File that takes the place of what the script names.
    @return  A dict that JSON can hold: clock, duration_s, sources (with all that sensor_source needs
             but the start), record (or None), rig.
    """
    reader = _Reader(path)
    root = reader.root()
    script = reader.group(root, "", SCRIPT)
    script["rig"] = load_rig(rig or script["rig"] or default_rig)
    nodes = script["sources"].value
    if not nodes:
        reader.fail(script["sources"], "sources", "expected at least one source")
    script["sources"] = []
    names, topics = {}, {}
    for i, node in enumerate(nodes):
        where = f"sources[{i}]"
        source = _read_source(reader, node, where, script)
        if source["name"] in names:
            reader.fail(node, where, f"the name '{source['name']}' is taken by "
                        f"{names[source['name']]}")
        names[source["name"]] = where
        _apply_rig(source, script["rig"])
        for topic in published_topics(source):
            if topic in topics:
                reader.fail(node, where, f"{topic} is published by {topics[topic]} already")
            topics[topic] = where
        source["seed"] = script["seed"] + i
        if program and "file" in source:
            try:
                source["first_ns"], source["last_ns"] = _describe(program, source)
            except ValueError as error:
                reader.fail(node, where, str(error))
        script["sources"].append(source)
    script["end_s"] = _align(script)
    script["path"] = os.path.abspath(path)
    return script
