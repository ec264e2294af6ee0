"""State x and feedback u = K x of the plant, by parts and as columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from softgrasp.fem.petsc import Array, total
from softgrasp.fem.shown import Shown
from softgrasp.lqr.plant.block import Block


@dataclass(frozen=True, repr=False)
class PlantState(Shown):
    """x = [q_s, v_s, z, v_z] with z = q_e - T q_s."""

    q_s: Array  # displacement of the hand on every rank [m, rad], (n_s,)
    v_s: Array  # velocity of the hand on every rank [m/s, rad/s], (n_s,)
    z: Array  # displacement of the tissue relative to the hand [m], local rows (n_local,)
    v_z: Array  # velocity of the tissue relative to the hand [m/s], local rows (n_local,)

    def __sub__(self, other: PlantState) -> PlantState:
        return PlantState(self.q_s - other.q_s, self.v_s - other.v_s, self.z - other.z, self.v_z - other.v_z)

    @property
    def block(self) -> Block:
        """The state as one column."""
        return Block.of_parts(*(part[:, None] for part in (self.q_s, self.v_s, self.z, self.v_z)))


@dataclass(frozen=True, repr=False)
class Gain(Shown):
    """u = K x = K_s [q_s; v_s] + K_z' z + K_v' v_z."""

    K_s: Array
    """Gain on the hand, on every rank [N/m, N s/m; N m for torques], (n_s, 2 n_s)."""
    K_z: Array
    """Gain on z, transposed [N/m], local rows (n_local, n_s)."""
    K_v: Array
    """Gain on v_z, transposed [N s/m], local rows (n_local, n_s)."""

    @property
    def block(self) -> Block:
        """K' as columns of the size of the state."""
        return Block(self.K_s.T, np.concatenate([self.K_z, self.K_v]))

    @classmethod
    def of_block(cls, K: Block) -> Gain:
        """The gain whose columns K' are given."""
        *_, K_z, K_v = K.parts
        return cls(np.ascontiguousarray(K.hand.T), np.asfortranarray(K_z), np.asfortranarray(K_v))

    def apply(self, comm: MPI.Intracomm, x: PlantState) -> Array:
        """K x, (n_s,), on every rank. Collective."""
        tissue = total(comm, self.K_z.T @ x.z + self.K_v.T @ x.v_z)
        return np.asarray(self.K_s @ np.concatenate([x.q_s, x.v_s]) + tissue)
