"""What impulses at the end of a step change: velocities, momentum, and the record of the run."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.model.surface import Surface
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.contact.impulse import Impulses
from softgrasp.fem.run.contact.record import Tables
from softgrasp.fem.run.contact.rows import Ints
from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState
from softgrasp.fem.run.motion import Driven
from softgrasp.fem.system import BlockSystem


class Strike:
    """Impulses of one run.

    Args:
        system: of the run.
        surface: its boundary.
        midpoint: its step.
        table: its record.
        free: whether the hand feels the tissue.
    """

    def __init__(
        self, system: BlockSystem, surface: Surface, midpoint: TissueMidpoint, table: Tables, free: bool
    ) -> None:
        self.system, self.surface, self.midpoint, self.table, self.free = system, surface, midpoint, table, free
        self.impulses: Impulses | None = None

    def reactions(self) -> Impulses:
        """What impulses do, made when the first node is to stop. Collective."""
        if self.impulses is None:
            order = self.midpoint.operators.order
            self.impulses = Impulses(self.system, self.surface, self.free, None if order is None else order.nodes)
        return self.impulses

    def nodes(self) -> Ints:
        """Nodes with columns of M^-1, in their order."""
        return np.zeros(0, dtype=np.intp) if self.impulses is None else self.impulses.mass.nodes

    def restore(self, nodes: Ints) -> None:
        """Make the columns of what `nodes` returned, in the same order, on which rounding depends. Collective."""
        if len(nodes):
            self.reactions().mass.enter(nodes)

    def stop(
        self, state: TissueState, drive: Driven, n: int, obstacle: Ints, node: Ints, normal: Array, b: Array
    ) -> None:
        """Change the velocity of nodes (k,) along normals (k, d) by b (k,) at the end of step n. Collective."""
        y = self.reactions().stop(node, normal, b)
        self.table.energy[2] += y @ b / 2
        self.strike(state, drive, n, obstacle, node, normal, y)

    def strike(
        self, state: TissueState, drive: Driven, n: int, obstacle: Ints, node: Ints, along: Array, y: Array
    ) -> None:
        """Impulses y (k,) of obstacles on nodes along vectors (k, d) at the end of step n. Collective."""
        table, surface, dt, each = self.table, self.surface, self.midpoint.dt, y[:, None] * along
        np.add.at(table.impulse[n - 1], obstacle, each)
        table.force[n - 1] += table.impulse[n - 1] / dt
        forces = np.zeros_like(surface.X)
        np.add.at(forces, node, each)
        table.hand[n - 1] += surface.T.T @ forces.ravel() / dt
        self._kick(state, drive, n, *self.reactions().jump(node, along, y))

    def _kick(self, state: TissueState, drive: Driven, n: int, jump: Array, hand: Array, gained: Array) -> None:
        """Add a jump of the velocity to tissue and hand, and what the momentum gains. Collective."""
        G, midpoint, table = self.system.G, self.midpoint, self.table
        mean = state.v.array_r + jump / 2
        state.v.array_w[:] += jump
        midpoint.r.array_w[:] += midpoint.s * midpoint.operators.gather(gained)
        if len(hand):
            drive.v[n] += hand
        sums = total(self.system.layout.comm, np.concatenate([G.T @ jump, [mean @ gained]]))
        table.kick[n - 1] = sums[:-1]
        table.energy[0] += sums[-1]
