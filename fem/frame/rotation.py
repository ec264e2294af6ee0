"""Rotations by any angle, in three dimensions; a plane turns about its third axis.

A hand's degrees of freedom are q_s = [p; theta]: displacement of its reference point and rotation vector, whose
direction is the axis and whose length is the angle. With H the matrix of the cross product theta x,

    Q = exp H = I + a H + b H^2,   J = I + b H + c H^2,   Q - I = J H,   omega = J theta',
    a = sin t / t,   b = (1 - cos t) / t^2,   c = (t - sin t) / t^3,   t = |theta|,

so that a point at r from the reference point goes by p + (Q - I) r = p + J (theta x r): J times what a small rotation
would give. All functions accept stacks in leading axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array

SMALL = 1e-2  # angle below which the series have three terms [rad]: the next is below 1e-14
ROUND = 2 * np.pi  # a whole turn [rad]
CROSS = np.zeros((3, 9))  # entries of the matrix of w x by rows, each a multiple of one of w
CROSS[[0, 1, 2], [7, 2, 3]], CROSS[[0, 1, 2], [5, 6, 1]] = 1.0, -1.0


def cross_matrix(w: Array) -> Array:
    """The matrix of w x, (..., 3, 3), for w (..., 3)."""
    return np.asarray((w @ CROSS).reshape(*w.shape, 3))


def _coefficients(theta: Array) -> tuple[Array, Array, Array]:
    t = np.linalg.norm(theta, axis=-1)
    x = t * t
    safe = np.where(t > SMALL, t, 1.0)
    a = np.where(t > SMALL, np.sin(safe) / safe, 1 - x / 6 * (1 - x / 20 * (1 - x / 42)))
    b = np.where(t > SMALL, (1 - np.cos(safe)) / safe**2, 0.5 * (1 - x / 12 * (1 - x / 30 * (1 - x / 56))))
    c = np.where(t > SMALL, (safe - np.sin(safe)) / safe**3, (1 - x / 20 * (1 - x / 42 * (1 - x / 72))) / 6)
    return a[..., None, None], b[..., None, None], c[..., None, None]


def rotation_matrix(theta: Array) -> Array:
    """Q = exp H, (..., 3, 3), of rotation vectors (..., 3) [rad]."""
    (a, b, _), H = _coefficients(theta), cross_matrix(theta)
    return np.asarray(np.eye(3) + a * H + b * (H @ H))


def left_jacobian(theta: Array) -> Array:
    """J with omega = J theta' and Q - I = J H, (..., 3, 3), of rotation vectors (..., 3) [rad]."""
    (_, b, c), H = _coefficients(theta), cross_matrix(theta)
    return np.asarray(np.eye(3) + b * H + c * (H @ H))


def rotation_vector(Q: Array, near: Array) -> Array:
    """The rotation vector (3,) of Q (3, 3) that lies next to another; whole turns are counted on [rad]."""
    axis = np.array([Q[2, 1] - Q[1, 2], Q[0, 2] - Q[2, 0], Q[1, 0] - Q[0, 1]]) / 2
    sine, cosine = float(np.linalg.norm(axis)), (float(np.trace(Q)) - 1) / 2
    angle = float(np.arctan2(sine, cosine))
    if angle > np.pi / 2 and sine < 0.1:  # near half a turn Q - Q' vanishes, and Q + Q' has the axis
        square = (Q + Q.T) / 2 - cosine * np.eye(3)
        column = square[:, int(np.argmax(square.diagonal()))]
        axis = column * np.copysign(1.0, column @ axis)
    length = float(np.linalg.norm(axis))
    if length < 1e-8 * max(1.0, angle):  # no turn, or whole ones: about the axis there was
        size = float(np.linalg.norm(near))
        if size < np.pi:
            return np.asarray(axis)
        return np.asarray(near / size * ROUND * np.round(size / ROUND) + axis)
    unit = axis / length
    return np.asarray(unit * (angle + ROUND * np.round((near @ unit - angle) / ROUND)))


def cayley(w: Array) -> Array:
    """(I - W/2)^-1 (I + W/2) for the matrix W of w x, (3, 3): a rotation about w by 2 atan(|w| / 2)."""
    W = cross_matrix(w) / 2
    return np.asarray(np.linalg.solve(np.eye(3) - W, np.eye(3) + W))


def cayley_vector(Q: Array) -> Array:
    """The w (3,) with cayley(w) = Q; Q turns by less than half a turn."""
    theta = rotation_vector(Q, np.zeros(3))
    angle = float(np.linalg.norm(theta))
    return theta if angle == 0 else np.asarray(theta * (2 * np.tan(angle / 2) / angle))


def spatial(q: Array) -> Array:
    """[x, y, z, rx, ry, rz] (..., 6) of a hand that turns, (..., 3) in the plane or (..., 6) in space."""
    if q.shape[-1] == 6:
        return np.asarray(q, dtype=float)
    full = np.zeros((*q.shape[:-1], 6))
    full[..., :2], full[..., 5] = q[..., :2], q[..., 2]
    return full


def freedoms(d: int) -> list[int]:
    """Places of the hand's degrees of freedom among those in space."""
    return [0, 1, 5] if d == 2 else list(range(6))


@dataclass(frozen=True)
class Pose:
    """Place of the hand, from its degrees of freedom: a point at r goes to p + Q (r + z)."""

    shift: Array  # displacement p of the reference point, (..., d) [m]
    Q: Array  # rotation, (..., d, d) [1]
    J: Array  # matrix J of the rotation vector, (..., d, d) [1]

    @staticmethod
    def of(q_s: Array, d: int) -> Pose:
        """Place for degrees of freedom (..., n_s) of a hand that turns [m, rad]."""
        q = spatial(np.asarray(q_s, dtype=float))
        Q, J = (f(q[..., 3:])[..., :d, :d] for f in (rotation_matrix, left_jacobian))
        return Pose(q[..., :d], Q, J)

    def rigid(self, linear: Array) -> Array:
        """Return p + (Q - I) r for the displacement p + theta x r of small rotations, rows (m, d) [m]."""
        shift = self.shift[..., None, :]
        return np.asarray(shift + (linear - shift) @ np.swapaxes(self.J, -1, -2))

    def turned(self, z: Array) -> Array:
        """Q z of rows (m, d)."""
        return np.asarray(z @ np.swapaxes(self.Q, -1, -2))

    def displacement(self, linear: Array, z: Array) -> Array:
        """World displacement p + (Q - I) r + Q z of points, rows (m, d) [m]; see :meth:`rigid`."""
        return self.rigid(linear) + self.turned(z)

    def velocity(self, u: Array, linear: Array, e: Array, spin: Array) -> Array:
        """World velocity p' + omega x (r + u - p) + Q e of points, rows (m, d) [m/s].

        Args:
            u: their world displacement [m].
            linear: p' + omega x r, the velocity of small rotations [m/s].
            e: velocity against the hand, in its frame [m/s].
            spin: angular velocity omega in space, (1,) or (3,) [rad/s].
        """
        d = u.shape[-1]
        W = cross_matrix(spatial(np.concatenate([np.zeros(d), spin]))[3:])[:d, :d]
        return np.asarray(linear + (u - self.shift) @ W.T + self.turned(e))
