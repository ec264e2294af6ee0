"""How far a body stands off a convex obstacle in the plane, and the half-plane between them.

The gap of the convex hulls is max over unit n of min_j n.y_j - h(n), h the support of the obstacle; it is attained at
the normal of a side of either, or along the line between two corners. Where they overlap it is minus the shortest way
out.
"""

from __future__ import annotations

import numpy as np
import scipy.spatial

from softgrasp.fem.obstacles.shapes import Ball, HalfSpace, Polytope, Shape
from softgrasp.fem.petsc import Array


def supports(shape: Shape, normals: Array) -> Array:
    """h(n), the largest n.y of the obstacle for each unit normal, (count,) [m]."""
    if isinstance(shape, Ball):
        return np.asarray(normals @ shape.center + shape.radius)
    if isinstance(shape, Polytope):
        return np.asarray((normals @ shape.corners.T).max(axis=1))
    return np.array([shape.support(n) for n in normals])


def separate(shape: Shape, body: Array) -> tuple[Array, float]:
    """The half-plane n.x >= h(n) that keeps a body (b, 2) farthest off an obstacle: n, (2,), and the gap [m]."""
    if isinstance(shape, HalfSpace):
        return shape.normal, float((body @ shape.normal).min() - shape.offset)
    assert isinstance(shape, Ball | Polytope)
    corners = shape.corners if isinstance(shape, Polytope) else shape.center[None, :]
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


def past(shape: Shape, way: Array, body: Array, side: int) -> Array:
    """Normals that turn from behind an obstacle over one side to its front, as the body goes along its way.

    Args:
        way: displacement of the body in every interval, (H, 2).
        body: nodes of the undisplaced body, (b, 2).
        side: 1 passes the obstacle on the left of the way, -1 on the right.

    Returns unit normals, (H, 2).
    """
    along = way[-1] - way[0]
    along = along / np.linalg.norm(along)
    across = side * np.array([-along[1], along[0]])
    both = np.vstack([along, -along])
    ahead, behind = supports(shape, both)
    reach = (ahead + behind) / 2 + np.ptp(body @ along) / 2
    progress = np.clip(((way + body.mean(axis=0)) @ along - (ahead - behind) / 2) / reach, -1, 1)
    return np.asarray(progress[:, None] * along + np.sqrt(1 - progress[:, None] ** 2) * across)
