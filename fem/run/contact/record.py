"""What obstacles did to the tissue in a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.petsc import Array
from softgrasp.fem.run.displacement import exact_sum
from softgrasp.fem.run.states.snapshots import FILMED, spread
from softgrasp.fem.shown import Shown


@dataclass(frozen=True, repr=False)
class ContactRecord(Shown):
    """Forces, gaps and energies of contact in a run; arrays are the same on every rank."""

    names: tuple[str, ...]
    """Names of the obstacles."""
    force: Array
    """Mean force of each obstacle on the tissue in each step, impulses included, (steps, obstacles, d) [N]."""
    impulse: Array
    """Impulse of each obstacle on the tissue at the end of each step, (steps, obstacles, d) [N s]."""
    gap: Array
    """Least gap between boundary nodes and each obstacle, (steps + 1, obstacles) [m]."""
    touching: NDArray[Any]
    """Number of boundary nodes that each obstacle presses in each step, (steps, obstacles)."""
    chattering: NDArray[Any]
    """Number of boundary nodes whose touching each obstacle takes back in each step, (steps, obstacles): it changed in
    the step before."""
    instants: NDArray[Any]
    """Steps at whose end ``pressing`` is kept, those that a film of the run shows, (instants,)."""
    pressing: Array
    """Force on each boundary node in the steps that end there, without impulses, (instants, p, d) [N]."""
    work: float
    """Work of the contact on the tissue in the frame of the hand, impulses included [J]."""
    touch: float
    """Energy dissipated in the steps of first touch, >= 0 [J]."""
    stopped: float
    """Kinetic energy dissipated by impulses along normals [J]; with ``rubbed`` it adds up to >= 0."""
    rubbed: float
    """Energy dissipated by friction, >= 0 [J]."""
    rounds: int
    """Rounds of all contact problems [1]."""
    columns: int
    """Responses of the tissue to boundary forces that were solved for [1]."""
    nodes: int
    """Boundary nodes that may touch [1]."""

    @property
    def penetration(self) -> float:
        """Largest depth of a boundary node at the end of a step [m]."""
        return max(0.0, -float(self.gap.min(initial=0.0)))

    @property
    def chatter(self) -> int:
        """Changes of a node's touching that the next step takes back, in the whole run.

        A node touches an obstacle in a step whose force on it, constant in the step, is positive.
        """
        return int(self.chattering.sum())

    @property
    def chatter_end(self) -> int:
        """Number of steps until no touching is taken back any more, 0 where none ever is.

        A landing throws cells above pressed nodes upwards, which lifts some for a short time; at rest nothing chatters.
        """
        return int(np.flatnonzero(self.chattering.any(axis=1)).max(initial=-1)) + 1

    @property
    def force_end(self) -> Array:
        """Force of each obstacle on the tissue at the end, mean of the last two steps, (obstacles, d) [N].

        The midpoint rule lets the forces of stiff modes alternate from step to step.
        """
        return np.asarray(self.force[-2:].mean(axis=0))


@dataclass
class Tables:
    """The record of a run in progress."""

    force: Array  # mean forces, (steps, obstacles, d) [N]
    impulse: Array  # impulses, (steps, obstacles, d) [N s]
    gap: Array  # least gaps, (steps + 1, obstacles) [m]
    touching: Array  # numbers of pressed nodes, (steps, obstacles)
    chattering: Array  # numbers of nodes whose touching takes back its change in the step before, (steps, obstacles)
    hand: Array  # force of the contact in the freedoms of the hand, impulses included, (steps, n_s) [N, N m]
    kick: Array  # G'u for the jump u of the velocity by each impulse, (steps, n_s) [N s, N m s]
    energy: Array  # work, and energy dissipated at first touch, by impulses and by friction, in a step, (4,) [J]
    sums: Array  # of ``energy`` over the steps, and what rounding of these sums lost, (2, 4) [J]
    lately: NDArray[np.int8]  # 1 of nodes that touched in the last step, and 2 where that changed then, (obstacles, p)
    instants: dict[int, int]  # number of each instant of a film by its step
    pressing: Array  # forces on the boundary nodes in the steps that end there, (instants, p, d) [N]

    @staticmethod
    def empty(steps: int, obstacles: int, p: int, d: int, n_s: int) -> Tables:
        """Room for all steps."""
        force, impulse = np.zeros((2, steps, obstacles, d))
        hand, kick = np.zeros((2, steps, n_s))
        gap, (touching, chattering) = np.zeros((steps + 1, obstacles)), np.zeros((2, steps, obstacles))
        energy, sums, lately = np.zeros(4), np.zeros((2, 4)), np.zeros((obstacles, p), dtype=np.int8)
        none = np.zeros((0, p, d))
        return Tables(force, impulse, gap, touching, chattering, hand, kick, energy, sums, lately, {}, none)

    def film(self, steps: NDArray[Any]) -> None:
        """Keep the forces of a film of states at these steps, (m,)."""
        shown = steps[spread(len(steps), FILMED)].tolist() if len(steps) else []
        self.instants = {step: i for i, step in enumerate(shown)}
        self.pressing = np.zeros((len(shown), *self.pressing.shape[1:]))

    def show(self, n: int, pressing: Callable[[], Array]) -> None:
        """Keep the forces of the step that ends at n where a film shows it; pressing: returns them, (p, d) [N]."""
        if (i := self.instants.get(n)) is not None:
            self.pressing[i] = pressing()

    def count_back(self, n: int, obstacle: NDArray[np.intp], node: NDArray[np.intp]) -> None:
        """Count what takes back its last change in step n, where these pairs of obstacle and node, (k,), touch."""
        if not len(node) and not self.lately.any():
            return
        on = np.zeros(self.lately.shape, dtype=bool)
        on[obstacle, node] = True
        changes = on != (self.lately & 1)
        self.chattering[n] = (changes & (self.lately > 1)).sum(axis=1)
        self.lately[:] = on + 2 * changes

    def add(self) -> None:
        """Add the energies of a step to the sums, and keep what rounding loses."""
        if not self.energy.any():
            return
        self.sums[0], lost = exact_sum(self.sums[0], self.energy)
        self.sums[1] += lost
        self.energy[:] = 0.0

    @property
    def energies(self) -> Array:
        """Work, and energy dissipated at first touch, by impulses and by friction, so far, (4,) [J]."""
        return np.asarray(self.sums.sum(axis=0))

    def _tables(self) -> tuple[Array, ...]:
        return self.force, self.impulse, self.gap, self.touching, self.chattering, self.hand, self.kick

    def packed(self, n: int) -> Array:
        """The first n rows of all tables side by side, (n, numbers)."""
        return np.hstack([table[:n].reshape(n, -1) for table in self._tables()])

    def unpack(self, rows: Array) -> None:
        """Take back what `packed` returned."""
        n, tables = len(rows), self._tables()
        parts = np.split(rows, np.cumsum([table[0].size for table in tables])[:-1], axis=1)
        for table, part in zip(tables, parts, strict=True):
            table[:n] = part.reshape(n, *table.shape[1:])
