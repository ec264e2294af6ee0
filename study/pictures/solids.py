"""Rigid obstacles as meshes of PyVista, cut off beside the body."""

from __future__ import annotations

from typing import Any

import numpy as np

from softgrasp.fem import Array, Ball, HalfSpace, Obstacle, Polytope
from softgrasp.study.pictures.obstacles import polygons

ROOM = 0.25  # of the size of the body, by which the part that is shown goes beyond it [1]
SLAB = 0.12  # thickness of what is shown of a half-space, over the size of the body [1]
BEHIND = 1e-3  # depth behind the plane of the body, over its size [1]


def solids(obstacles: tuple[Obstacle, ...], t: float, box: Array, flat: bool) -> Any:
    """One triangulated surface (PyVista) of all obstacles near the body; None without any.

    Args:
        t: time [s].
        box: lower and upper corner of the body, (2, 3) [m].
        flat: whether the body lies in a plane; then the obstacles do, just behind it.
    """
    import pyvista

    size = float(np.ptp(box, axis=0).max())
    low, high = box[0] - ROOM * size, box[1] + ROOM * size
    parts = []
    for obstacle in obstacles:
        mesh = _flat(obstacle, t, np.array([low, high])[:, :2], size) if flat else _solid(obstacle, t, box, size)
        bounds = np.column_stack([low, high]).ravel()
        if flat:
            bounds[4:] = -size, size
        part = mesh.triangulate().clip_box(bounds, invert=False).extract_surface(algorithm=None)
        if part.n_points:
            parts.append(part)
    if not parts:
        return None
    return pyvista.merge(parts)


def _flat(obstacle: Obstacle, t: float, box: Array, size: float) -> Any:
    """Polygon of an obstacle of the plane; ``box``: corners of what is shown, (2, 2), ``size`` of the body [m]."""
    import pyvista

    shape, shift = obstacle.shape, np.zeros(2) + obstacle.shift(t)
    if isinstance(shape, HalfSpace):
        along, middle = np.array([-shape.normal[1], shape.normal[0]]), box.mean(axis=0)
        foot = middle + (shape.offset + shape.normal @ shift - middle @ shape.normal) * shape.normal
        back = foot - SLAB * size * shape.normal
        reach = 4 * size * along
        corners = np.array([foot - reach, foot + reach, back + reach, back - reach])
    else:
        (corners,), _ = polygons(shape, shift, box)
    points = np.column_stack([corners, np.full(len(corners), -BEHIND * size)])
    return pyvista.PolyData(points, faces=[len(points), *range(len(points))])


def _solid(obstacle: Obstacle, t: float, box: Array, size: float) -> Any:
    """Surface of an obstacle in space; ``box``: corners of the body, (2, 3), ``size`` of the body [m]."""
    import pyvista

    shape, shift = obstacle.shape, np.zeros(3) + obstacle.shift(t)
    if isinstance(shape, Ball):
        return pyvista.Sphere(radius=shape.radius, center=shape.center + shift, theta_resolution=96, phi_resolution=96)
    if isinstance(shape, HalfSpace):
        middle = box.mean(axis=0)
        foot = middle + (shape.offset + shape.normal @ shift - middle @ shape.normal) * shape.normal
        return pyvista.Plane(center=foot, direction=shape.normal, i_size=4 * size, j_size=4 * size)
    assert isinstance(shape, Polytope)
    return pyvista.PolyData(shape.corners + shift).delaunay_3d().extract_surface(algorithm=None)
