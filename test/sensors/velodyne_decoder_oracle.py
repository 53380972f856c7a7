#!/usr/bin/env python3
"""Every return that the `velodyne-decoder` wheel finds in a capture, ours must hold too.

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
        a, b = theirs[index >= 0], ours[index[index >= 0]]
        flat = np.hypot(a[:, 1], a[:, 2])
        range_off = np.abs(flat - np.hypot(b[:, 2], b[:, 3])).max()
        z_off = np.abs(a[:, 3] - b[:, 4]).max()
        turn = np.degrees(np.arctan2(a[:, 2], a[:, 1]) - np.arctan2(b[:, 3], b[:, 2]))
        azimuth_off = np.abs((turn + 180.0) % 360.0 - 180.0)
        beyond = (azimuth_off > 0.03).mean()
        azimuth_off = azimuth_off.max()
        intensity_off = np.abs(a[:, 4] - b[:, 5]).max()
        print(f"{capture.name}: {len(theirs)} returns, {missing} missing, "
              f"horizontal range within {range_off * 1e3:.4f} mm, height within {z_off * 1e3:.4f} mm, "
              f"azimuth within {azimuth_off:.4f} degrees ({beyond:.1e} of them beyond 0.03), "
              f"intensity within {intensity_off:g}")
        # The two differ in how they go on after the last azimuth of a packet; where the head's
        # azimuths jitter at 1200 rpm that shows.
        if (missing or range_off > 1e-4 or z_off > 1e-3 or azimuth_off > 0.05 or beyond > 1e-4 or
                intensity_off > 0):
            failed = True
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
