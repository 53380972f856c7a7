"""A pose file for the orchard capture, from the GNSS track of the same drive."""
import math


def read_track(path):
    """(seconds, east m, north m) of each fix."""
    with open(path) as f:
        rows = [line.split() for line in f if line.strip()]
    return [(float(r[0]), float(r[2]), float(r[3])) for r in rows]


def write_poses(track_path, out_path, duration_s=8.0, rate_hz=50.0):
    """Writes a TUM file of the stretch where the vehicle drives, heading along its way."""
    track = read_track(track_path)
    moving = next(i for i in range(len(track) - 50)
                  if math.dist(track[i][1:], track[i + 50][1:]) > 5.0)
    t0, e0, n0 = track[moving]
    at, lines = moving, ["# time x y z qx qy qz qw"]
    for k in range(int(duration_s * rate_hz)):
        t = t0 + k / rate_hz
        while track[at + 1][0] <= t:
            at += 1
        (ta, ea, na), (tb, eb, nb) = track[at], track[at + 1]
        s = (t - ta) / (tb - ta)
        heading = math.atan2(track[at + 25][2] - na, track[at + 25][1] - ea)
        lines.append(f"{t:.6f} {ea + s * (eb - ea) - e0:.4f} {na + s * (nb - na) - n0:.4f} 0 "
                     f"0 0 {math.sin(heading / 2):.9f} {math.cos(heading / 2):.9f}")
    with open(out_path, "w") as f:
        f.write("\n".join(lines) + "\n")
