"""Obstacles of a scene: a shape, translated along a known path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.obstacles.shapes import Ball, HalfSpace, Polytope, Shape
from softgrasp.fem.scene import obstacles as keys
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.scene.table import read_csv

Array = NDArray[Any]
Path = Callable[[float], Array]
"""Displacement (d,) [m] of an obstacle at a time [s]."""


@dataclass(frozen=True)
class Obstacle:
    """A rigid convex body at known places."""

    name: str  # name in reports
    kind: str  # kind in the scene
    shape: Shape  # shape where the scene puts it
    path: Path | None  # displacement from there, or None for a fixed one

    def shift(self, t: float) -> Array | float:
        """Displacement at a time [m], (d,), or 0 for a fixed one."""
        return 0.0 if self.path is None else self.path(t)

    def look(self, x: Array, t: float = 0.0) -> tuple[Array, Array]:
        """Gap (m,) [m] of points x (m, d) [m] at a time and its gradient, the outward unit normal (m, d)."""
        return self.shape.look(x - self.shift(t))

    def gap(self, x: Array, t: float = 0.0) -> Array:
        """Signed distance (m,) [m] of points x (m, d) [m] from the surface at a time, negative inside."""
        return self.look(x, t)[0]

    def normal(self, x: Array, t: float = 0.0) -> Array:
        """Outward unit normals (m, d) at points x (m, d) [m] at a time."""
        return self.look(x, t)[1]

    def support(self, n: Array, t: float = 0.0) -> float:
        """Largest n.y [m] over the obstacle at a time: points with n.x >= support are outside of it."""
        return self.shape.support(n) + float(np.sum(n * self.shift(t)))


def make_obstacles(scene: Scene, d: int) -> tuple[Obstacle, ...]:
    """The obstacles of a scene in d dimensions. Raises SceneError: a CSV file of a path does not fit."""
    given = scene.obstacle or []
    names = keys.obstacle_names(given)
    return tuple(
        Obstacle(name, entry.kind, make_shape(entry), make_path(scene, entry, f"obstacle.{i}.path.csv", d))
        for i, (name, entry) in enumerate(zip(names, given, strict=True))
    )


def make_shape(entry: keys.Obstacle) -> Shape:
    """The shape of an entry of the scene."""
    if entry.normal is not None:
        normal = np.array(entry.normal, dtype=float)
        return HalfSpace(normal / np.linalg.norm(normal), float(entry.offset or 0.0))
    if entry.center is not None:
        return Ball(np.array(entry.center, dtype=float), float(entry.radius or 0.0))
    if entry.points is not None:
        return Polytope.hull(np.array(entry.points, dtype=float))
    return Polytope.box(np.array(entry.lo, dtype=float), np.array(entry.hi, dtype=float))


def make_path(scene: Scene, entry: keys.Obstacle, key: str, d: int) -> Path | None:
    """The path of an entry of the scene, or None. Raises SceneError: its CSV file does not fit."""
    if entry.path is None:
        return None
    if entry.path.csv is None:
        velocity = np.array(entry.path.velocity, dtype=float)
        return lambda t: t * velocity
    from scipy.interpolate import CubicSpline  # few scenes need it

    times, values = read_csv(scene.path(entry.path.csv), d, scene.time_end, key, "one displacement per axis")
    spline = CubicSpline(times, values, bc_type="clamped")
    return lambda t: np.asarray(spline(t))
