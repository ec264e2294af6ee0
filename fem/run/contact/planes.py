"""Mean normals of the rows of a step, and planes instead where the rounds of a step do not end.

Where a node passes an edge within a step, rounds can go from one face to the other without end. Such a row keeps the
normal n_0 at the begin of the step: the obstacle is convex and lies behind the plane n_0.(x - x_0) = -g_0, so that a
node before it is outside, and the problem is linear. A pressed one has n_0.(x_1 - x_0) = -g_0, as the work of its force
asks; beyond the edge its gap is positive.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.obstacles import HalfSpace
from softgrasp.fem.obstacles.obstacle import Obstacle, mean_normal
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.contact.rows import Flags, Rows

PATIENCE = 40  # rounds of a step until rows keep planes; steps whose rounds end take fewer


@dataclass
class Planes:
    """Normals of the rows of a step of one run."""

    obstacles: tuple[Obstacle, ...]
    dt: float  # [s]
    straight: float  # motion of a node below which its normal does not turn [m]
    kept: Flags  # pairs of obstacle and node whose plane stays in the step, (obstacles, p)

    def look_along(self, rows: Rows, n: int, x0: Array, free: Array, x1: Array, gaps: Array, after: Array) -> Array:
        """Set the normals of rows between x0 and x1 in step n; half their gaps at the free end, (k,) [m].

        gaps, after: gaps at x0 and at the free end, (obstacles, p) [m].
        """
        q = after[rows.obstacle, rows.node] / 2
        for o, obstacle in enumerate(self.obstacles):
            mine = np.flatnonzero(rows.obstacle == o)
            i = rows.node[mine]
            if isinstance(obstacle.shape, HalfSpace):
                rows.normal[mine] = obstacle.shape.normal
                continue
            begin, end = (x[i] - obstacle.shift(t * self.dt) for x, t in ((x0, n), (x1, n + 1)))
            normal, stays = mean_normal(obstacle.shape, begin, end, self.straight), self.kept[o, i]
            normal[stays] = obstacle.shape.look(begin[stays])[1]
            rows.normal[mine] = normal
            q[mine] = gaps[o, i] / 2
            q[mine] += np.einsum("ij,ij->i", normal, free[i] - obstacle.shift((n + 1) * self.dt) - begin) / 2
        return q

    def left(self, rows: Rows, n: int, x0: Array, x1: Array, gaps: Array, after: Array) -> Array:
        """Gaps of rows at x1 whose gaps to the obstacles are ``after``: to their planes where these stay, (k,) [m]."""
        left, on = after[rows.obstacle, rows.node], self.kept[rows.obstacle, rows.node]
        if on.any():
            o, i = rows.obstacle[on], rows.node[on]
            moved = [obstacle.shift((n + 1) * self.dt) - obstacle.shift(n * self.dt) for obstacle in self.obstacles]
            step = x1[i] - x0[i] - np.array([move + np.zeros(x0.shape[1]) for move in moved])[o]
            left[on] = gaps[o, i] + np.einsum("ij,ij->i", rows.normal[on], step)
        return left

    def keep(self, rows: Rows, wrong: Flags, count: int) -> None:
        """Let rows that are ``wrong`` after round ``count`` keep planes, (k,)."""
        if count >= PATIENCE:
            self.kept[rows.obstacle[wrong], rows.node[wrong]] = True
