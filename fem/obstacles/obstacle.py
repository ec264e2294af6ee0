"""Obstacles of a scene: a shape, translated along a known path."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.errors import SolverError
from softgrasp.fem.obstacles.shapes import Ball, HalfSpace, Polytope, Shape
from softgrasp.fem.scene import obstacles as keys
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.scene.table import read_csv

Array = NDArray[Any]
GRAZE = 1e-6  # depth over the thickness of an obstacle that a line on its surface may have [1]
THIRDS = 60  # searches, each of which leaves two thirds of a line: 3e-11 of it


class Path(ABC):
    """A known translation over time."""

    @abstractmethod
    def __call__(self, t: float, order: int = 0) -> Array:
        """Displacement (d,) [m] at a time [s], or its derivative of a given order."""

    @property
    @abstractmethod
    def end(self) -> float:
        """Time from which the obstacle rests [s]; infinite where it never does."""

    @abstractmethod
    def fastest_turn(self, begin: float, end: float) -> Array:
        """Bound on the acceleration along every axis between two times [m/s2], (d,)."""


@dataclass(frozen=True)
class Uniform(Path):
    """A constant velocity."""

    velocity: Array  # [m/s], (d,)

    def __call__(self, t: float, order: int = 0) -> Array:
        """See :meth:`Path.__call__`."""
        return np.asarray((t if order == 0 else float(order == 1)) * self.velocity)

    @property
    def end(self) -> float:
        """See :meth:`Path.end`."""
        return math.inf if self.velocity.any() else 0.0

    def fastest_turn(self, begin: float, end: float) -> Array:
        """See :meth:`Path.fastest_turn`; a constant velocity has none."""
        return np.zeros(len(self.velocity))


@dataclass(frozen=True)
class Spline(Path):
    """A cubic spline at rest at both ends; later the obstacle rests where it ends."""

    spline: Any  # of scipy.interpolate, displacement (d,) [m] over time [s]

    def __call__(self, t: float, order: int = 0) -> Array:
        """See :meth:`Path.__call__`."""
        if t > self.end:  # a longer run of a reduced model finds the obstacle at rest there
            return np.asarray(self.spline(self.end) if order == 0 else np.zeros(self.spline.c.shape[2]))
        return np.asarray(self.spline(t, order))

    @property
    def end(self) -> float:
        """See :meth:`Path.end`."""
        return float(self.spline.x[-1])

    def fastest_turn(self, begin: float, end: float) -> Array:
        """See :meth:`Path.fastest_turn`; the acceleration is linear between the times of the table."""
        inside = self.spline.x[(self.spline.x > begin) & (self.spline.x < end)]
        times = np.clip(np.concatenate([[begin], inside, [end]]), None, self.end)
        return np.asarray(np.abs(self.spline(times, 2)).max(axis=0))


@dataclass(frozen=True)
class Obstacle:
    """A rigid convex body at known places."""

    name: str  # name in reports
    kind: str  # kind in the scene
    shape: Shape  # shape where the scene puts it
    path: Path | None  # displacement from there, or None for a fixed one

    def shift(self, t: float) -> Array | float:
        """Displacement at a time [m], (d,), or 0 for a fixed one."""
        return 0.0 if self.path is None else self.path(t, 0)

    def rate(self, t: float) -> Array | float:
        """Velocity at a time [m/s], (d,), or 0 for a fixed one."""
        return 0.0 if self.path is None else self.path(t, 1)

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


def mean_normal(shape: Shape, begin: Array, end: Array, straight: float) -> Array:
    """Normals n (k, d) between points with n.(end - begin) = change of the gap, so that forces along n do exact work.

    The normal in the middle, corrected along the motion as a discrete gradient is [Gonzalez96]; that at the end where a
    point moves by less than ``straight`` [m].
    """
    (g0, _), (g1, last) = shape.look(begin), shape.look(end)
    step = end - begin
    square = np.einsum("ij,ij->i", step, step)
    turns = square > straight**2
    normal = np.where(turns[:, None], shape.look((begin + end) / 2)[1], last)
    lacks = np.where(turns, g1 - g0 - np.einsum("ij,ij->i", normal, step), 0.0)
    return np.asarray(normal + (lacks / np.where(turns, square, 1.0))[:, None] * step)


def check_passage(
    obstacles: tuple[Obstacle, ...],
    before: Array,
    after: Array,
    places: tuple[Array, Array],
    times: tuple[float, float],
) -> None:
    """See that no point can pass through an obstacle within a step, which no gap would show.

    Args:
        obstacles: those of a run.
        before, after: gaps of the points at both ends of the step, (obstacles, k) [m].
        places: the points at both ends, (k, d) [m].
        times: of both ends [s].

    Raises SolverError: a point moves by more than an obstacle's thickness, on a line that leaves or is leaving it.
    """
    for obstacle, g0, g1 in zip(obstacles, before, after, strict=True):
        size = obstacle.shape.size()
        if math.isinf(size):
            continue
        shift = np.asarray(obstacle.shift(times[1])) - obstacle.shift(times[0])
        way = np.linalg.norm(places[1] - places[0] - shift, axis=1)
        near = (way > size) & (g0 + np.maximum(g1, 0.0) < way)
        if near.any():
            ends = places[0][near] - obstacle.shift(times[0]), places[1][near] - obstacle.shift(times[1])
            near[near] = _least(obstacle.shape, *ends) < np.minimum(g1[near], 0.0) - GRAZE * size
        if near.any():
            longest = float(way[near].max())
            raise SolverError(
                f"obstacle '{obstacle.name}' has a thickness or radius of {size:.2g} m, and from t = {times[0]:.6g} s "
                f"on a node beside it moves by {longest:.2g} m in one step: it could pass through; raise "
                f"time.steps by a factor of at least {math.ceil(longest / size)}"
            )


def _least(shape: Shape, begin: Array, end: Array) -> Array:
    """Least gap on the lines between points, which is convex along them, (k,) [m]."""
    low, high = np.zeros((len(begin), 1)), np.ones((len(begin), 1))
    for _ in range(THIRDS):
        one, other = (2 * low + high) / 3, (low + 2 * high) / 3
        rises = shape.look(begin + one * (end - begin))[0] < shape.look(begin + other * (end - begin))[0]
        low, high = np.where(rises[:, None], low, one), np.where(rises[:, None], other, high)
    return shape.look(begin + (low + high) / 2 * (end - begin))[0]


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
        return Uniform(np.array(entry.path.velocity, dtype=float))
    from scipy.interpolate import CubicSpline  # few scenes need it

    times, values = read_csv(scene.path(entry.path.csv), d, None, key, "one displacement per axis")
    return Spline(CubicSpline(times, values, bc_type="clamped"))
