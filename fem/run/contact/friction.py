"""Contact with Coulomb friction in 2D: forces x_t along the tangent of a pressed node, |x_t| <= mu x_n.

The slip of a step is that of the node against the obstacle, hand included, over the step; a slipping node has x_t
against it. So x_t does the work x_t slip <= 0 at an obstacle at rest, exactly, and sticking nodes do none. What sticks
stops along its tangent too when the impulse comes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.model.build import Model
from softgrasp.fem.obstacles import HalfSpace
from softgrasp.fem.obstacles.coulomb import OPEN, STICK, Coulomb
from softgrasp.fem.obstacles.obstacle import Obstacle
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.contact.general import Contact
from softgrasp.fem.run.contact.rows import Flags, Ints, Rows
from softgrasp.fem.run.hand import HandStep
from softgrasp.fem.run.midpoint import TissueMidpoint
from softgrasp.fem.run.motion import ForceDrive, TableDrive


@dataclass
class RubbingRows(Rows):
    """Contact rows with friction."""

    tangent: Array  # unit tangent of the step, (k, d)
    x_t: Array  # force along it [N], (k,)
    slip: Array  # slip along it in the step [m], (k,)
    kind: NDArray[np.int8]  # set, see `softgrasp.fem.obstacles.coulomb`, (k,)

    def forces(self) -> Array:
        """See :meth:`Rows.forces`."""
        return self.x[:, None] * self.normal + self.x_t[:, None] * self.tangent


class FrictionContact(Contact):
    """Contact of one run in which an obstacle has friction, see :class:`softgrasp.fem.run.contact.general.Contact`."""

    rows: RubbingRows

    def __init__(self, model: Model, midpoint: TissueMidpoint, steps: int, hand: HandStep | None) -> None:
        super().__init__(model, midpoint, steps, hand)
        self.mu = np.array([entry.friction for entry in model.scene.obstacle or []])
        self.coulomb = Coulomb()
        self.flat = all(isinstance(o.shape, HalfSpace) for o in self.obstacles)
        self.pairs, self.C, self.W = np.zeros((0, 2), dtype=int), np.zeros((0, 0)), np.zeros((0, 0))

    def _basis(self, obstacle: Obstacle) -> Array:
        """See :meth:`Contact._basis`: all directions."""
        return np.eye(self.d)

    def _make_rows(self, pairs: Ints) -> RubbingRows:
        """See :meth:`Contact._make_rows`."""
        rows, k = super()._make_rows(pairs), len(pairs)
        return RubbingRows(
            rows.obstacle, rows.node, rows.normal, rows.x, np.zeros((k, self.d)), np.zeros(k), np.zeros(k),
            np.full(k, OPEN, np.int8),
        )  # fmt: skip

    def press(self, n: int, drive: TableDrive | ForceDrive) -> None:
        """See :meth:`Contact.press`. Collective."""
        super().press(n, drive)
        self.table.energy[3] -= self.rows.x_t @ self.rows.slip
        self.small.tally[0] = self.coulomb.rounds

    def _forces(
        self, known: Flags, active: Flags, n: int, x0: Array, free: Array, x1: Array, tol: float
    ) -> tuple[Array, RubbingRows]:
        """See :meth:`Contact._forces`. Collective."""
        pairs = np.argwhere(known)
        rows, k = self._make_rows(pairs), len(pairs)
        begun = np.full(known.shape, OPEN, np.int8)
        begun[self.rows.obstacle, self.rows.node] = self.rows.kind
        q = self._look_along(rows, n, x0, free, x1)
        turned = np.stack([-rows.normal[:, 1], rows.normal[:, 0]], axis=1)
        rows.tangent = turned / np.linalg.norm(turned, axis=1)[:, None]
        shifts = [o.shift((n + 1) * self.dt) - o.shift(n * self.dt) + np.zeros(self.d) for o in self.obstacles]
        moved = (free - x0)[rows.node] - np.array(shifts)[rows.obstacle]
        q = np.concatenate([q, np.einsum("ij,ij->i", rows.tangent, moved) / 2])
        if not (self.flat and np.array_equal(pairs, self.pairs)):  # where normals stay, W stays with the pairs
            directions = np.vstack([rows.normal, rows.tangent])
            self.C, self.pairs = self.select(self.responses, np.vstack([pairs, pairs]), directions), pairs
            m = self.C.shape[1]
            self.W = self.C @ self.responses.G[:m, :m] @ self.C.T
        x, kind = self.coulomb.solve(self.W, q, self.mu[rows.obstacle], begun[rows.obstacle, rows.node], tol / 4)
        rows.x, rows.x_t, rows.kind = x[:k], x[k:], kind.astype(np.int8)
        rows.slip = 2 * (q + self.W @ x)[k:]
        return self.C.T @ x, rows

    def _held_back(self, rows: Rows, normal: Array, v: Array) -> tuple[Rows, Array, Array]:
        """See :meth:`Contact._held_back`: sticking nodes stop along their tangents too."""
        stuck = self.rows.kind == STICK
        every = self._make_rows(np.vstack([np.stack([r.obstacle, r.node], axis=1) for r in (rows, rows.take(stuck))]))
        turned = np.stack([-normal[stuck, 1], normal[stuck, 0]], axis=1)
        return every, np.vstack([normal, turned]), np.vstack([v, v[stuck]])

    def _sets(self) -> list[NDArray[Any]]:
        """See :meth:`Contact._sets`."""
        return [*super()._sets(), self.rows.kind.astype(float)]

    def _resume(self, sets: list[Array]) -> None:
        """See :meth:`Contact._resume`. Collective."""
        super()._resume(sets)
        self.coulomb.rounds = self.small.rounds
        self.rows.kind = sets[1].astype(np.int8)
