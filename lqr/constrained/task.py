"""What a plan has to do: start, obstacles on their paths, margins, and what they leave of every gap."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from softgrasp.fem.obstacles.obstacle import Path
from softgrasp.fem.obstacles.shapes import Shape
from softgrasp.fem.petsc import Array
from softgrasp.lqr.constrained.horizon import HeldPlant, Horizon
from softgrasp.lqr.constrained.rows import Limits
from softgrasp.lqr.constrained.separation import gaps, separate, supports
from softgrasp.lqr.plant.checks import ControlError


@dataclass(frozen=True)
class Task:
    """What a plan has to do."""

    start: Array  # x_0 of the reduced plant, from the target, (N,)
    places: Array  # nodes of the body at the target [m], (nodes, d)
    u_bar: Array  # steady input at the target [N], (n_s,)
    shapes: tuple[Shape, ...]  # obstacles
    names: tuple[str, ...]  # of the obstacles
    error: Array  # margin for what the reduced plant leaves out at every node [m], (nodes, d)
    clearance: float = 0.0  # distance to keep beyond that [m]
    limits: Limits = field(default_factory=Limits)  # of the hand
    noise: Array | float = 0.0  # margin for what noise moves every node [m], (nodes, d) or 0
    bounded: bool = True  # whether ``error`` is a proved bound
    penalty: float | None = None  # cost of a metre inside an obstacle [1/m]; None: many times that of the way
    paths: tuple[Path | None, ...] = ()  # translation of each obstacle; empty where all are fixed
    arms: Array | float = 0.0  # |r_j| from a hand that turns, whose square of the angle has a margin [m], (nodes,)
    angle: Array | None = None  # of this hand at the target, (n_s - d,) [rad]; None: it does not turn
    extent: float = 0.0  # longest side of the body [m]; 0: that of ``places``, where all keep gaps

    @property
    def size(self) -> float:
        """Longest side of the body [m]."""
        return max(self.extent, float(np.ptp(self.places, axis=0).max()))

    def path(self, i: int) -> Path | None:
        """Translation of an obstacle, None for a fixed one."""
        return self.paths[i] if self.paths else None

    def shifts(self, i: int, times: Array) -> Array:
        """Displacement of an obstacle at times [s], (.., d) [m]."""
        path, d = self.path(i), self.places.shape[1]
        if path is None:
            return np.zeros((*np.shape(times), d))
        return np.array([path(float(t)) for t in np.ravel(times)]).reshape(*np.shape(times), d)

    def separate(self, i: int, body: Array, t: float) -> tuple[Array, float]:
        """Normal between a body (nodes, d) and an obstacle at a time, and the gap [m]."""
        return separate(self.shapes[i], body - self.shifts(i, np.asarray(t)))

    def gaps(self, body: Array, times: Array) -> Array:
        """Gap of the body (count, nodes, d) to every obstacle at times [s], (count, obstacles) [m]."""
        shapes = enumerate(self.shapes)
        every = [gaps(shape, body - self.shifts(i, times)[:, None]) for i, shape in shapes]
        return np.array(every).reshape(-1, len(body)).T


def after_paths(plant: HeldPlant, task: Task, steps: int, longest: int) -> int:
    """Intervals, at least ``steps``, after which no obstacle comes nearer to the body at the target.

    One that passes through the target has to leave room there first, where it does within ``longest``.

    Raises ControlError: there are more than ``longest``.
    """
    for i, name in enumerate(task.names):
        path, first = task.path(i), steps
        if path is None:
            continue
        if np.isfinite(path.end):
            steps = max(steps, int(np.ceil(path.end / plant.grid - 1e-9)))
        else:  # at a constant velocity, for ever
            leaving = None
            for k in range(first, longest + 1):
                normal = task.separate(i, task.places, k * plant.grid)[0]
                if normal @ path(0.0, 1) <= 0:
                    leaving = k if leaving is None else leaving
                    if _free_at(task, i, normal, k * plant.grid).min() > 0:
                        steps = k
                        break
            else:
                steps = longest + 1 if leaving is None else leaving
        if steps > longest:
            raise ControlError(
                f"obstacle {name} moves towards the body at the target until the end of the longest plan, of "
                f"{longest * plant.grid:.4g} s; give a path that ends or leaves, or set control.constraints.horizon"
            )
    return steps


def at_target(task: Task, t: float) -> list[tuple[Array, Array]]:
    """Normal and free way of every node at the target, from time t on; raises ControlError where there is none."""
    result = []
    for i, name in enumerate(task.names):
        normal, gap = task.separate(i, task.places, t)
        free = _free_at(task, i, normal, t)
        if not free.min() > 0:
            need = gap - float(free.min())
            raise ControlError(
                f"at the target the gap to obstacle {name} is {gap:.4g} m and a plan needs more than {need:.4g} m, for "
                "clearance and the bound of the reduced plant; move motion.target, raise control.constraints.N or "
                "lower grid"
            )
        result.append((normal, free))
    return result


def _free_at(task: Task, i: int, normal: Array, t: float) -> Array:
    """Way of every node at the target to the half-space of an obstacle at a time, less clearance and margin."""
    free = free_ways(task.shapes[i], task, normal[None])[0]
    if task.angle is not None:
        free = free - task.arms * float(task.angle @ task.angle) / 2
    return np.asarray(free - normal @ task.shifts(i, np.asarray(t)))


def free_ways(shape: Shape, task: Task, normals: Array) -> Array:
    """Way of every node at the target to the half-spaces of an obstacle, less clearance and margin, (count, nodes).

    Of the obstacle where the scene puts it.
    """
    off = normals @ task.places.T - supports(shape, normals)[:, None]
    return np.asarray(off - task.clearance - np.abs(normals) @ (task.error + task.noise).T)


def instants(horizon: Horizon, steps: int | None = None) -> Array:
    """All instants of a number of intervals [s], (H, parts + 1); those behind the horizon are its end."""
    plant, H = horizon.plant, horizon.steps
    times = np.arange(H if steps is None else steps)[:, None] + np.arange(plant.parts + 1) / plant.parts
    return np.asarray(plant.grid * np.minimum(times, H))


def path_turns(horizon: Horizon, task: Task, i: int, normals: Array) -> Array | float:
    """Bound on the acceleration of an obstacle along the normals of intervals, (count, parts) [m/s2]."""
    path = task.path(i)
    if path is None:
        return 0.0
    ends = instants(horizon, len(normals))
    still = np.zeros(normals.shape[1])  # from its end on
    most = [[path.fastest_turn(a, b) if a < path.end else still for a, b in pairwise(row)] for row in ends.tolist()]
    return np.asarray(np.einsum("kd,kid->ki", np.abs(normals), np.array(most)))


def seen_by(horizon: Horizon, task: Task, i: int, body: Array) -> Array:
    """Places of the body (H, parts + 1, nodes, d) as an obstacle sees them, that moves from where the scene puts it."""
    return np.asarray(body - task.shifts(i, instants(horizon, len(body)))[:, :, None])
