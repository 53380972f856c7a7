#!/usr/bin/python3
"""The packets of simulate_bag, read by the velodyne-decoder wheel: the same returns as in the bag.

The wheel is an independent decoder; the test skips without it (scripts/setup_oracles).
"""
import datetime
import math
import os
import pathlib
import struct
import subprocess
import sys

import numpy as np
import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "test"))
import oracles

BUILD = pathlib.Path(os.environ.get("DENDRO_BUILD_DIR", ROOT / "build"))
SIMULATE = BUILD / "devel/lib/dendro_slam/simulate_bag"
# In leaf, so that one beam often has two echoes.
SCENE = ROOT / "config/scenes/palo_verde.yaml"
PATH = ROOT / "config/paths/thesis_quadrangle.yaml"
MODES = {"strongest": 0x37, "last": 0x38, "dual": 0x39}


@pytest.fixture(scope="module", params=MODES)
def flight(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    result = subprocess.run(
        [SIMULATE, SCENE, PATH, "-o", folder / "flight.bag", "--duration", "1.2", "--packets", "--pcap",
         folder / "flight.pcap", "--set", f"lidar.return_mode={request.param}"],
        capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return request.param, folder


def datagrams(capture):
    """(UDP port, payload) of every datagram."""
    data = capture.read_bytes()
    at = 24
    while at < len(data):
        size = struct.unpack_from("<I", data, at + 8)[0]
        frame = data[at + 16:at + 16 + size]
        yield struct.unpack_from(">H", frame, 36)[0], frame[42:]
        at += 16 + size


def our_returns(bag):
    """Rows of time past the hour [s], ring, range [m], azimuth [deg], intensity, of /velodyne_points."""
    import rosbag
    rows = []
    for _, msg, _ in rosbag.Bag(str(bag)).read_messages("/velodyne_points"):
        names = {"x": "<f4", "y": "<f4", "z": "<f4", "intensity": "<f4", "ring": "<u2", "time": "<f4"}
        dtype = np.dtype({"names": list(names), "formats": list(names.values()),
                          "offsets": [next(f.offset for f in msg.fields if f.name == n) for n in names],
                          "itemsize": msg.point_step})
        p = np.frombuffer(msg.data, dtype)
        rows.append(returns(msg.header.stamp.to_nsec() % 3600000000000 * 1e-9 + p["time"].astype(float),
                            p["ring"], p["x"], p["y"], p["intensity"]))
    return np.vstack(rows)


def returns(time_s, ring, x, y, intensity):
    x, y = x.astype(float), y.astype(float)
    elevation = np.radians(-15.0 + 2.0 * ring)
    return np.column_stack([time_s, ring, np.hypot(x, y) / np.cos(elevation),
                            np.degrees(np.arctan2(-y, x)) % 360.0, intensity])


def by_time_and_ring(rows):
    """Sorted by firing time (to a microsecond), ring and range."""
    return rows[np.lexsort((rows[:, 2], rows[:, 1], np.round(rows[:, 0] * 1e6)))]


def test_the_wheel_finds_our_returns(flight):
    vd = oracles.require("velodyne_decoder")
    mode, folder = flight
    theirs, kinds = [], []
    for stamp, p in vd.read_pcap(folder / "flight.pcap", vd.Config(model=vd.Model.VLP16)):
        theirs.append(returns((stamp.device + p[:, 4].astype(float)) % 3600.0, p[:, 6], p[:, 0], p[:, 1], p[:, 3]))
        kinds.append(p[:, 7])
    theirs, kinds = np.vstack(theirs), np.concatenate(kinds)
    ours = our_returns(folder / "flight.bag")
    # The last firings of the flight did not fill a packet.
    end = theirs[:, 0].max() + 1e-6
    assert end > ours[:, 0].max() - 24 * 55.296e-6
    ours = ours[ours[:, 0] < end]
    assert len(ours) > 120000 and len(theirs) == len(ours)
    a, b = by_time_and_ring(theirs), by_time_and_ring(ours)
    assert np.array_equal(a[:, 1], b[:, 1])
    turn = (a[:, 3] - b[:, 3] + 180.0) % 360.0 - 180.0
    print(f"{mode}: {len(a)} returns; largest differences: time {np.abs(a[:, 0] - b[:, 0]).max() * 1e6:.2f} us, "
          f"range {np.abs(a[:, 2] - b[:, 2]).max() * 1e3:.3f} mm, azimuth {np.abs(turn).max():.4f} deg, "
          f"intensity {np.abs(a[:, 4] - b[:, 4]).max():g}")
    assert np.abs(a[:, 0] - b[:, 0]).max() < 2e-6
    assert np.abs(a[:, 2] - b[:, 2]).max() < 0.002
    assert np.abs(turn).max() < 0.02
    assert np.array_equal(a[:, 4], b[:, 4])
    # Beams with two returns, and which of them is which.
    firing = np.round(b[:, 0] * 1e6) * 16 + b[:, 1]
    twice = np.sum(firing[1:] == firing[:-1])
    if mode == "dual":
        assert twice > 100
        values = {int(v): int(n) for v, n in zip(*np.unique(kinds, return_counts=True))}
        assert sorted(values.values())[:2] == [twice, twice], values
    else:
        assert twice == 0


def test_the_bytes_are_those_of_the_manual(flight):
    mode, folder = flight
    ports = {}
    for port, payload in datagrams(folder / "flight.pcap"):
        ports.setdefault(port, []).append(payload)
    assert set(ports) == {2368, 8308}
    stamps = []
    for packet in ports[2368]:
        assert len(packet) == 1206
        assert packet[1204] == MODES[mode] and packet[1205] == 0x22
        assert all(packet[100 * i:100 * i + 2] == b"\xff\xee" for i in range(12))
        azimuths = [struct.unpack_from("<H", packet, 100 * i + 2)[0] for i in range(12)]
        assert all(a < 36000 for a in azimuths)
        if mode == "dual":
            assert azimuths[0::2] == azimuths[1::2]
        stamps.append(struct.unpack_from("<I", packet, 1200)[0])
    firings = 12 if mode == "dual" else 24
    assert np.abs(np.diff(stamps) - firings * 55.296).max() <= 1.0
    assert all(len(p) == 512 for p in ports[8308])
    assert len(ports[8308]) == math.ceil(len(ports[2368]) / 5)


def test_the_position_packets_tell_time_and_place(flight):
    vd = oracles.require("velodyne_decoder")
    import rosbag
    mode, folder = flight
    # The map's origin lies in Tempe; the flight rests for almost a second 4 m east and 4 m south of it. On
    # WGS 84 a metre is 1.0752e-5 degrees of longitude and 9.0161e-6 degrees of latitude there.
    packets = [p for port, p in datagrams(folder / "flight.pcap") if port == 8308]
    for i, packet in enumerate(packets):
        telemetry = vd.TelemetryPacket(packet)
        assert telemetry.nmea_sentence.startswith("$GPRMC,")
        # The stamps start at 1600000000 s, the 13th of September 2020, 12:26:40 UTC.
        seconds = i * 5 * (12 if mode == "dual" else 24) * 55.296e-6
        assert telemetry.nmea_time.replace(tzinfo=None) == datetime.datetime(2020, 9, 13, 12, 26, 40 + int(seconds))
        assert telemetry.pps_status == vd.TelemetryPacket.PpsStatus.LOCKED
        assert abs(telemetry.usec_since_toh - (1600000000 % 3600 * 1e6 + seconds * 1e6)) < 1500
        x, y = telemetry.gps_position[:2]
        assert abs((x + 111.9324) / 1.0752e-5 - 4.0) < 0.02
        assert abs((y - 33.4214) / 9.0161e-6 + 4.0) < (0.02 if seconds < 1.0 else 0.4)
    bag = rosbag.Bag(str(folder / "flight.bag"))
    raw = [bytes(msg.data) for _, msg, _ in bag.read_messages("/velodyne_position_packets")]
    assert raw == packets
    fixes = [msg for _, msg, _ in bag.read_messages("/fix")]
    assert len(fixes) == 2 and fixes[1].header.stamp.to_sec() == 1600000001.0
    data = [bytes(bytearray(p.data)) for _, msg, _ in bag.read_messages("/velodyne_packets") for p in msg.packets]
    assert data == [p for port, p in datagrams(folder / "flight.pcap") if port == 2368]


def test_the_bytes_do_not_depend_on_the_threads(tmp_path):
    def everything(threads):
        folder = tmp_path / str(threads)
        folder.mkdir()
        result = subprocess.run(
            [SIMULATE, ROOT / "config/scenes/thesis_tree.yaml", PATH, "-o", folder / "f.bag", "--duration", "0.6",
             "--packets", "--imu", "--pcap", folder / "f.pcap", "--seed", "5", "--threads", str(threads)],
            capture_output=True, text=True)
        assert result.returncode == 0, result.stderr
        return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}

    one = everything(1)
    assert set(one) == {"f.bag", "f.pcap", "f.truth/scene.yaml", "f.truth/trajectory.tum", "f.truth/hits.csv",
                        "f.truth/labels.bin"}
    assert min(map(len, one.values())) > 100
    for threads in (2, 4):
        for name, content in everything(threads).items():
            assert content == one[name], (name, threads)


if __name__ == "__main__":
    sys.exit(pytest.main([__file__, "-q", "-p", "no:cacheprovider"]))
