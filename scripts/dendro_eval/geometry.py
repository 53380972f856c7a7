"""Chains of conical frusta and rigid motions."""

import numpy as np


def perpendicular_basis(axis):
    """The two unit vectors that the map counts directions around an axis from, shape (3, 2).

    Duff et al., "Building an orthonormal basis, revisited" (JCGT 2017), as PerpendicularBasis of the core.
    """
    x, y, z = axis
    sign = float(np.copysign(1.0, z))
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array([[1.0 + sign * x * x * a, b], [sign * b, sign + y * y * a], [-sign * x, -y]])


class Chain:
    """A branch as frusta from base to tip.

    start, end: (n, 3) ends of the axis [m]; r0, r1: (n,) radii there [m].
    """

    def __init__(self, start, end, r0, r1):
        self.start = np.asarray(start, float).reshape(-1, 3)
        self.end = np.asarray(end, float).reshape(-1, 3)
        self.r0 = np.asarray(r0, float).reshape(-1)
        self.r1 = np.asarray(r1, float).reshape(-1)
        delta = self.end - self.start
        self.lengths = np.linalg.norm(delta, axis=1)
        self.axis = delta / np.maximum(self.lengths, 1e-12)[:, None]
        self.offset = np.concatenate([[0.0], np.cumsum(self.lengths)[:-1]])

    @classmethod
    def from_points(cls, points):
        """points: (n, 4) rows x y z radius. Steps (two points at one place) have no length."""
        p = np.asarray(points, float)
        keep = np.linalg.norm(np.diff(p[:, :3], axis=0), axis=1) > 1e-9
        return cls(p[:-1, :3][keep], p[1:, :3][keep], p[:-1, 3][keep], p[1:, 3][keep])

    @property
    def length(self):
        return float(self.lengths.sum())

    def transformed(self, T):
        return Chain(self.start @ T[:3, :3].T + T[:3, 3], self.end @ T[:3, :3].T + T[:3, 3],
                     self.r0, self.r1)

    def sample(self, step):
        """Points about `step` apart: (points (m, 3), axes (m, 3), radii (m,), weights (m,) [m], index (m,)).

        The weight of a point is the length that it stands for; the weights add up to the length.
        """
        points, axes, radii, weights, index = [], [], [], [], []
        for i, length in enumerate(self.lengths):
            if length <= 0.0:
                continue
            n = max(1, int(np.ceil(length / step)))
            f = (np.arange(n) + 0.5) / n
            points.append(self.start[i] + f[:, None] * (self.end[i] - self.start[i]))
            axes.append(np.repeat(self.axis[i][None], n, axis=0))
            radii.append(self.r0[i] + f * (self.r1[i] - self.r0[i]))
            weights.append(np.full(n, length / n))
            index.append(np.full(n, i))
        return tuple(np.concatenate(a) for a in (points, axes, radii, weights, index))

    def project(self, points):
        """Nearest place on the axis of every point.

        Returns (distance, along, radius, axis, inside): along [m] from the base, inside False where
        the point lies beyond one of the chain's two ends.
        """
        points = np.asarray(points, float).reshape(-1, 3)
        relative = points[:, None, :] - self.start[None]
        raw = np.einsum("mni,ni->mn", relative, self.axis) / self.lengths[None]
        t = np.clip(raw, 0.0, 1.0)
        foot = self.start[None] + t[..., None] * (self.end - self.start)[None]
        distance = np.linalg.norm(points[:, None, :] - foot, axis=2)
        k = np.argmin(distance, axis=1)
        rows = np.arange(len(points))
        tk = t[rows, k]
        inside = ~(((k == 0) & (raw[rows, k] < 0.0)) |
                   ((k == len(self.lengths) - 1) & (raw[rows, k] > 1.0)))
        radius = self.r0[k] + tk * (self.r1[k] - self.r0[k])
        return (distance[rows, k], self.offset[k] + tk * self.lengths[k], radius, self.axis[k], inside)

    def radius_at(self, along):
        """Radius at a distance from the base along the axis [m]."""
        k = int(np.clip(np.searchsorted(self.offset, along, side="right") - 1, 0, len(self.offset) - 1))
        f = np.clip((along - self.offset[k]) / max(self.lengths[k], 1e-12), 0.0, 1.0)
        return float(self.r0[k] + f * (self.r1[k] - self.r0[k]))

    def point_at(self, along):
        k = int(np.clip(np.searchsorted(self.offset, along, side="right") - 1, 0, len(self.offset) - 1))
        f = np.clip((along - self.offset[k]) / max(self.lengths[k], 1e-12), 0.0, 1.0)
        return self.start[k] + f * (self.end[k] - self.start[k])

    def from_along(self, along):
        """The part of the chain beyond `along` [m] from its base."""
        keep = self.offset + self.lengths > along + 1e-9
        start = self.start[keep].copy()
        r0 = self.r0[keep].copy()
        if len(start):
            first = int(np.argmax(keep))
            f = np.clip((along - self.offset[first]) / self.lengths[first], 0.0, 1.0)
            start[0] = self.start[first] + f * (self.end[first] - self.start[first])
            r0[0] = self.r0[first] + f * (self.r1[first] - self.r0[first])
        return Chain(start, self.end[keep], r0, self.r1[keep])


def pose_matrix(x, y, z, qx, qy, qz, qw):
    """4x4 rigid motion of a position [m] and a quaternion."""
    n = np.array([qx, qy, qz, qw], float)
    n /= np.linalg.norm(n)
    i, j, k, w = n
    T = np.eye(4)
    T[:3, :3] = [[1 - 2 * (j * j + k * k), 2 * (i * j - k * w), 2 * (i * k + j * w)],
                 [2 * (i * j + k * w), 1 - 2 * (i * i + k * k), 2 * (j * k - i * w)],
                 [2 * (i * k - j * w), 2 * (j * k + i * w), 1 - 2 * (i * i + j * j)]]
    T[:3, 3] = [x, y, z]
    return T


def inverse(T):
    out = np.eye(4)
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return out


def rotation_angle_deg(R):
    return float(np.degrees(np.arctan2(
        np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2.0,
        (np.trace(R) - 1.0) / 2.0)))


def axis_angle_deg(a, b):
    """Angle between axes without regard to their sign [deg]; rows of (n, 3)."""
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.degrees(np.arctan2(cross, np.abs(np.sum(a * b, axis=-1))))
