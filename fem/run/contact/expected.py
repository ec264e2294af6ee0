"""What contact needs in a run, estimated before it: as many columns as nodes are on the way of the undeformed body.

Before half-spaces with a Cholesky in blocks a column has entries on the ancestors of its node in the elimination tree
alone, and is read twice in a step of contact; else it has all rows and is read once, or a second solve is taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from softgrasp.fem.model.build import Model
from softgrasp.fem.model.surface import Surface, make_surface, node_distance
from softgrasp.fem.obstacles import HalfSpace, Obstacle, make_obstacles
from softgrasp.fem.obstacles.mass import FACTORED
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import motion_table
from softgrasp.fem.run.states.snapshots import spread
from softgrasp.fem.solve.costs import SolverName

INSTANTS = 200  # of a prescribed motion, at which gaps are computed
# Entries of the factor of the mass with n nodes: 2.5 n log2 n in 2D, 6.5 n^(4/3) in 3D; 2.3 and 2.5 were counted for
# 27 000 and 104 000 nodes, 5.4 to 7.6 for 1200 to 8800 [1].
FILL = {2: 2.5, 3: 6.5}
MASS = 1e-7  # time of such an entry while it is made [s]
MASS_BYTES = 20.0  # of such an entry; while it is made, both factors and one copy are there [byte]
# Ancestors of a node in nested dissection over the nodes of a cut, (nodes)^(1 - 1/d): 2.1 to 2.8 and 1.9 to 2.2 were
# counted for nodes of the lower edge or face, with 400 to 20 200 and 441 to 6615 nodes [1].
ANCESTORS = {2: 2.7, 3: 2.1}
# Matrices over the rows: N S^-1 N' twice, its factor, N M^-1 N' twice and its factor, and what making them takes;
# with friction both inverses too, all four in single precision, and a factor of each problem of odd and of even steps.
# Measured with 101 to 1089 rows, and 202 to 1323 with friction [byte an entry].
SQUARES = {False: 72.0, True: 108.0}
# Time of friction in a step, of an entry of N S^-1 N': Newton's rounds and their factors, in steps of contact and their
# impulses; fitted to runs of `set_down` and `set_down_3d` with 122 to 1323 rows [s].
RUB = 6e-9
CODE = 10e6  # modules and compiled code of contact [byte]


@dataclass(frozen=True)
class ExpectedContact:
    """Size of the contact of a run."""

    nodes: int  # boundary nodes that should touch [1]
    columns: int  # of S^-1 N' [1]
    surface: int  # unknowns of the boundary [1]
    dimension: int  # axes [1]
    flat: bool  # whether there are half-spaces alone
    rubs: bool  # whether an obstacle has friction

    def memory(self, n: int, ranks: int, copies: float, solver: SolverName) -> float:
        """Memory over all ranks [byte] with n unknowns, of which ``copies`` are kept."""
        rows = ranks * self._ancestors(n) if self._swept(solver) else copies * n + ranks * self.surface
        mass = 8.0 * self.nodes * self._ancestors(n) / self.dimension + MASS_BYTES * self._fill(n)
        return 8.0 * self.columns * rows + ranks * (CODE + mass + SQUARES[self.rubs] * self.columns**2)

    def seconds(self, n: int, solve: float, steps: int, factor: float, solver: SolverName) -> float:
        """Time of first touches and of all steps in contact [s], at most; solve: time of one with ``factor`` bytes [s].

        The first touch of a column needs a solve, or the half of one.
        """
        swept = self._swept(solver)
        read = 2 * self._ancestors(n) if swept else n
        step = solve * min(1.0, 8.0 * self.columns * read / max(2 * factor, 1.0))
        touches = self.columns * solve * (0.5 if swept else 1.0)
        rub = RUB * self.columns**2 if self.rubs else 0.0
        return touches + self._fill(n) * MASS + steps * (step + rub)

    def _swept(self, solver: SolverName) -> bool:
        return self.flat and solver == "cholesky"

    def _ancestors(self, n: int) -> float:
        d = self.dimension
        return min(n, ANCESTORS[d] * d * math.pow(n / d, 1 - 1 / d))

    def _fill(self, n: int) -> float:
        """Entries of the factor of the mass; none where conjugate gradients solve."""
        nodes, fill = n / self.dimension, FILL[self.dimension]
        if nodes > FACTORED[self.dimension]:
            return 0.0
        return fill * nodes * (math.log2(nodes + 1) if self.dimension == 2 else math.cbrt(nodes))


def expected_contact(model: Model, n: int | None = None) -> ExpectedContact | None:
    """Contact of a run, or None without; with n unknowns on a mesh of the same shape. Collective.

    Nodes that a prescribed hand leads nearer than half their distance to an obstacle should touch; under a hand that a
    force drives, those that are the nearest to it at the start.
    """
    scene, layout = model.scene, model.system.layout
    if not scene.effects.obstacles:
        return None
    surface, obstacles = make_surface(model.space, model.system), make_obstacles(scene, layout.dimension)
    near, d = node_distance(model.space) / 2, layout.dimension
    free = scene.motion.drive == "force"
    q = np.zeros((1, layout.n_s)) if free else motion_table(scene, layout.n_s).q
    gaps = nearest_gaps(surface, obstacles, q, scene.time_end / scene.time.steps)
    touching = gaps < (gaps.min(axis=1, keepdims=True) + near if free else near)
    entries = scene.obstacle or []
    straight = [isinstance(o.shape, HalfSpace) and not e.friction for o, e in zip(obstacles, entries, strict=True)]
    finer = ((n or layout.n_e) / layout.n_e) ** ((d - 1) / d)
    columns = int(touching.sum(axis=1) @ np.where(straight, 1, d))
    nodes = int(touching.any(axis=0).sum())
    flat = all(isinstance(o.shape, HalfSpace) for o in obstacles)
    nodes, columns, size = (round(finer * count) for count in (nodes, columns, surface.X.size))
    return ExpectedContact(nodes, columns, size, d, flat, any(e.friction for e in entries))


def nearest_gaps(
    surface: Surface, obstacles: tuple[Obstacle, ...], q: Array, dt: float, instants: int = INSTANTS
) -> Array:
    """Least gaps of the boundary nodes while the undeformed body follows the hand q, (obstacles, p) [m]."""
    least = np.full((len(obstacles), len(surface.X)), np.inf)
    for n in spread(len(q), instants).tolist():
        x = surface.places(q[n])
        least = np.minimum(least, [o.gap(x, n * dt) for o in obstacles])
    return least
