"""Distance of a body from a convex obstacle, and the half-space between them.

The gap of the convex hulls is max over unit n of min_j n.y_j - h(n), h the support of the obstacle; it is attained at
the normal of a side of either, or along the line between two corners. Where they overlap it is minus the shortest way
out. In space the hulls have too many pairs of sides to look at: n is the solution of the program of least distance
min |w|^2 / 2, w.(y_j - o_k) >= 1 over all pairs of corners, n = w / |w|, and where it has none a face of the hull of
the differences.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import scipy.spatial

from softgrasp.fem.obstacles.shapes import Ball, HalfSpace, Polytope, Shape
from softgrasp.fem.petsc import Array
from softgrasp.lqr.program.least_distance import InfeasibleError, nearest

UPRIGHT = 1e-6  # sine of the angle from the vertical below which a way is vertical
UP = np.array([0.0, 0.0, 1.0])
ROUNDS = 20  # of the search for sides; a few are enough for hulls apart
TOUCH = 1e-15  # of the square of a length: rounding


def supports(shape: Shape, normals: Array) -> Array:
    """h(n), the largest n.y of the obstacle for each unit normal, (count,) [m]."""
    if isinstance(shape, Ball):
        return np.asarray(normals @ shape.center + shape.radius)
    if isinstance(shape, Polytope):
        return np.asarray((normals @ shape.corners.T).max(axis=1))
    return np.array([shape.support(n) for n in normals])


def separate(shape: Shape, body: Array) -> tuple[Array, float]:
    """The half-space n.x >= h(n) that keeps a body (b, d) farthest off an obstacle: n, (d,), and the gap [m]."""
    if isinstance(shape, HalfSpace):
        return shape.normal, float((body @ shape.normal).min() - shape.offset)
    assert isinstance(shape, Ball | Polytope)
    corners = shape.corners if isinstance(shape, Polytope) else shape.center[None, :]
    if body.shape[1] == 2 and len(body) > 2:
        with suppress(scipy.spatial.QhullError):  # on a line
            return _separate_plane(shape, corners, body)
    normal = _apart((body[:, None] - corners).reshape(-1, body.shape[1]))
    return normal, float((body @ normal).min() - supports(shape, normal[None])[0])


def _separate_plane(shape: Ball | Polytope, corners: Array, body: Array) -> tuple[Array, float]:
    """Of points in the plane that enclose something."""
    hull = body[scipy.spatial.ConvexHull(body).vertices]
    sides = np.roll(hull, -1, axis=0) - hull
    normals = [np.column_stack([-sides[:, 1], sides[:, 0]])]  # inwards: hulls turn to the left
    if isinstance(shape, Polytope):
        normals.append(shape.normals)
    normals.append((hull[:, None] - corners).reshape(-1, 2))
    every = np.vstack(normals)
    size = np.linalg.norm(every, axis=1)
    every = every[size > 0] / size[size > 0, None]
    gaps = (every @ hull.T).min(axis=1) - supports(shape, every)
    best = int(np.argmax(gaps))
    return every[best], float(gaps[best])


def gaps(shape: Shape, bodies: Array) -> Array:
    """The gap of `separate` for many bodies (count, b, d), (count,) [m].

    Those apart in the plane are found together: from a side p q of points of the hull of the differences y - o, the
    nearest point x to the origin on it, and the point s of the hull farthest against x, until x.s = x.x [GJK88].
    """
    if isinstance(shape, HalfSpace):
        return np.asarray((bodies @ shape.normal).min(axis=1) - shape.offset)
    assert isinstance(shape, Ball | Polytope)
    found, open_ = np.empty(len(bodies)), np.ones(len(bodies), dtype=bool)
    if bodies.shape[2] == 2:
        corners = shape.corners if isinstance(shape, Polytope) else shape.center[None, :]
        distance, open_ = _distances(bodies, corners)
        found = distance - (shape.radius if isinstance(shape, Ball) else 0.0)
    for t in np.flatnonzero(open_):
        found[t] = separate(shape, bodies[t])[1]
    return found


def _distances(bodies: Array, corners: Array) -> tuple[Array, Array]:
    """Distances of hulls in the plane (count,) [m], and which of them are not found, for they overlap or touch."""
    count = np.arange(len(bodies))

    def farthest(x: Array) -> Array:
        """The point y - o with the least x.(y - o), (count, 2)."""
        nearest_corner = corners[(x @ corners.T).argmax(axis=1)]
        return np.asarray(bodies[count, np.einsum("tjd,td->tj", bodies, x).argmin(axis=1)] - nearest_corner)

    p = q = x = bodies[:, 0] - corners[0]
    for _ in range(ROUNDS):
        s = farthest(x)
        ends = _on_side(p, s), _on_side(q, s)
        first = (ends[0] ** 2).sum(axis=1) <= (ends[1] ** 2).sum(axis=1)
        closer = np.where(first[:, None], *ends)
        left = (x * x).sum(axis=1) - (x * s).sum(axis=1) > TOUCH * (s * s).sum(axis=1)
        p, q = np.where(left[:, None], np.where(first[:, None], p, q), p), np.where(left[:, None], s, q)
        x = np.where(left[:, None], closer, x)
        if not left.any():
            break
    size = np.linalg.norm(x, axis=1)
    low = (x * farthest(x)).sum(axis=1)  # size * distance from below, where it is size itself from above
    return size, np.asarray(low < size**2 - 1e-12 * size * np.abs(bodies).max())


def _on_side(p: Array, s: Array) -> Array:
    """Nearest point to the origin on the lines between p and s, (count, 2)."""
    along = s - p
    length = (along * along).sum(axis=1)
    part = np.clip(-(p * along).sum(axis=1) / np.where(length > 0, length, 1.0), 0.0, 1.0)
    return np.asarray(p + part[:, None] * along)


def _apart(points: Array) -> Array:
    """The unit vector n with the largest min_p n.p, (d,)."""
    size = float(np.abs(points).max())
    try:
        w = nearest(-points / size, np.full(len(points), -1.0)).x
    except InfeasibleError:  # the origin is inside: the nearest face of the hull
        try:
            faces = scipy.spatial.ConvexHull(points).equations
        except scipy.spatial.QhullError:  # fewer than d + 1 points, or flat: across what they span
            return np.asarray(np.linalg.svd(points - points[0])[2][-1])
        return np.asarray(-faces[int(np.argmax(faces[:, -1])), :-1])
    return np.asarray(w / np.linalg.norm(w))


def past(shape: Shape, way: Array, body: Array, side: int) -> Array:
    """Normals that turn from behind an obstacle over one side to its front, as the body goes along its way.

    Args:
        way: displacement of the body from the obstacle in every interval, (H, d).
        body: nodes of the undisplaced body, (b, d).
        side: 1 passes the obstacle on the left of the way, -1 on the right; in space 2 above and -2 below it.

    Returns unit normals, (H, d).
    """
    along = way[-1] - way[0]
    length = float(np.linalg.norm(along))
    along = along / length if length > 0 else np.eye(way.shape[1])[0]
    across = np.sign(side) * _across(along)[abs(side) - 1]
    both = np.vstack([along, -along])
    ahead, behind = supports(shape, both)
    reach = (ahead + behind) / 2 + np.ptp(body @ along) / 2
    progress = np.clip(((way + body.mean(axis=0)) @ along - (ahead - behind) / 2) / reach, -1, 1)
    return np.asarray(progress[:, None] * along + np.sqrt(1 - progress[:, None] ** 2) * across)


def _across(along: Array) -> list[Array]:
    """Left of a direction, and in space above it."""
    if len(along) == 2:
        return [np.array([-along[1], along[0]])]
    left = np.cross(UP, along)
    if np.linalg.norm(left) < UPRIGHT:
        left = np.cross(np.array([0.0, 1.0, 0.0]), along)  # of a way straight up or down, -x or x
    left = left / np.linalg.norm(left)
    return [left, np.cross(along, left)]
