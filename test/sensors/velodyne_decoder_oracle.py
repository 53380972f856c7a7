#!/usr/bin/env python3
"""Our decoder beside the `velodyne-decoder` wheel: the same returns of a capture, all of them.

A packet measures the azimuth where each of its blocks begins, and what a block's lasers fire in
between needs a step. Ours goes to the next measured azimuth, as the sensor's manual prescribes
(63-9243, section 9.5); the wheel goes on by the packet's mean step, past the next measurement. The
measurements jitter by up to 0.05 degrees at 1200 rpm, so the two part by up to 0.041 degrees there.
That this is all there is to it is computed here from the raw bytes: both ways to step, for every
return. Ours must be the manual's to 0.01 degrees (of the packet's and the cloud's rounding), the
wheel's the other, and without the difference between the two the decoders agree to 0.01 degrees.

usage: velodyne_decoder_oracle.py VLP16_DUMP FOLDER_OF_CAPTURES
Exits with 77 (skipped) when the wheel or the captures are missing.
"""
import pathlib
import struct
import subprocess
import sys
import tempfile

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))
import oracles

CAPTURES = ["grap_apple_20frames.pcap", "veloview_vlp16_90deg_50frames.pcap",
            "mrpt_vlp16_gps.pcap"]


def skip(reason):
    print("SKIPPED: " + reason)
    sys.exit(77)


def with_factory_byte(capture, out):
    """Copy of a capture with the VLP-16's model byte: the wheel goes by that byte alone."""
    data = bytearray(capture.read_bytes())
    at = 24
    while at + 16 <= len(data):
        size = struct.unpack_from("<I", data, at + 8)[0]
        at += 16 + size
        if size == 42 + 1206:
            data[at - 1] = 0x22
    out.write_bytes(data)


def data_packets(capture):
    """The payloads of the capture's data packets."""
    data = capture.read_bytes()
    at = 24
    while at + 16 <= len(data):
        size = struct.unpack_from("<I", data, at + 8)[0]
        at += 16
        if size == 42 + 1206:
            yield data[at + 42:at + size]
        at += size


class Steps:
    """Azimuths of a capture's firings by both ways to go on from a block's measured one."""

    def __init__(self, capture, np):
        self.np = np
        packets = list(data_packets(capture))
        self.stamp_us = np.array([struct.unpack_from("<I", p, 1200)[0] for p in packets])
        self.measured = np.array([[struct.unpack_from("<H", p, 100 * block + 2)[0] * 0.01
                                   for block in range(12)] for p in packets])
        steps = np.diff(self.measured, axis=1) % 360.0
        self.mean = steps.mean(axis=1)
        self.own = np.column_stack([steps, self.mean])  # The last block has no next one.

    def azimuths_deg(self, time_s):
        """By the step to the next measured azimuth, and by the packet's mean step [deg]."""
        np = self.np
        us = time_s * 1e6
        packet = np.searchsorted(self.stamp_us, np.round(us) + 1, side="right") - 1
        after = (us - self.stamp_us[packet]) / (2 * 55.296)
        block = np.minimum(np.floor(after + 0.01).astype(int), 11)
        begin = self.measured[packet, block]
        return (begin + (after - block) * self.own[packet, block],
                begin + (after - block) * self.mean[packet])


def turn(a, b):
    """a - b in (-180, 180] [deg]."""
    return (a - b + 180.0) % 360.0 - 180.0


def main():
    dump, folder = sys.argv[1], pathlib.Path(sys.argv[2])
    vd, reason = oracles.find("velodyne_decoder")
    if vd is None:
        skip(reason)
    import numpy as np
    captures = [folder / name for name in CAPTURES if (folder / name).exists()]
    if not captures:
        skip(f"no captures in {folder}")

    failed = False
    for capture in captures:
        with tempfile.TemporaryDirectory() as tmp:
            out = pathlib.Path(tmp) / "points.bin"
            subprocess.run([dump, str(capture), str(out)], check=True)
            ours = np.fromfile(out).reshape(-1, 8)

            patched = pathlib.Path(tmp) / "patched.pcap"
            with_factory_byte(capture, patched)
            rows = []
            for stamp, points in vd.read_pcap(patched, vd.Config(model=vd.Model.VLP16)):
                p = points.astype(np.float64)
                ring = p[:, 6].astype(int)
                laser = np.where(ring < 8, 2 * ring, 2 * (ring - 8) + 1)
                rows.append(np.column_stack([(stamp.device + p[:, 4]) % 3600.0, p[:, 0:4], laser]))
        theirs = np.vstack(rows)

        # A return is known by its laser and its microsecond.
        ours_at = {(int(l), round(t * 1e6)): i for i, (t, l) in enumerate(ours[:, [1, 6]])}
        index = np.full(len(theirs), -1)
        for i, (t, laser) in enumerate(theirs[:, [0, 5]]):
            us = round(t * 1e6)
            for d in (0, -1, 1):
                j = ours_at.get((int(laser), us + d))
                if j is not None:
                    index[i] = j
                    break
        missing = int((index < 0).sum())
        extra = len(ours) - len(theirs)
        a, b = theirs[index >= 0], ours[index[index >= 0]]
        range_off = np.abs(np.hypot(a[:, 1], a[:, 2]) - np.hypot(b[:, 2], b[:, 3])).max()
        z_off = np.abs(a[:, 3] - b[:, 4]).max()
        their_azimuth = np.degrees(np.arctan2(-a[:, 2], a[:, 1]))
        our_azimuth = np.degrees(np.arctan2(-b[:, 3], b[:, 2]))
        azimuth_off = np.abs(turn(their_azimuth, our_azimuth))
        intensity_off = np.abs(a[:, 4] - b[:, 5]).max()

        to_next, by_mean = Steps(capture, np).azimuths_deg(b[:, 1])
        ours_off = np.abs(turn(our_azimuth, to_next)).max()
        theirs_off = np.abs(turn(their_azimuth, by_mean)).max()
        rest = np.abs(turn(turn(their_azimuth, our_azimuth), turn(by_mean, to_next))).max()
        print(f"{capture.name}: {len(theirs)} returns, {missing} missing, {extra} more in ours; "
              f"horizontal range within {range_off * 1e3:.4f} mm, height within {z_off * 1e3:.4f} "
              f"mm, intensity within {intensity_off:g}; azimuth within {azimuth_off.max():.4f} "
              f"degrees ({(azimuth_off > 0.03).sum()} returns beyond 0.03), without the difference "
              f"in steps within {rest:.4f}; ours within {ours_off:.4f} of the step to the next "
              f"azimuth, the wheel within {theirs_off:.4f} of the mean step")
        if (missing or extra or range_off > 1e-4 or z_off > 1e-3 or rest > 0.01 or
                ours_off > 0.01 or theirs_off > 0.01 or intensity_off > 0):
            failed = True
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
