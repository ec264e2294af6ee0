"""Columns of the size of the state, hand and tissue apart: state x and feedback u = K x of the plant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from mpi4py import MPI

from softgrasp.fem.petsc import Array, total


@dataclass(frozen=True)
class Block:
    """A few columns of the size of the state."""

    hand: Array  # rows of q_s and v_s, (2 n_s, k), on every rank
    tall: Array  # local rows of z and v_z, one below the other, (2 n_local, k)

    @property
    def columns(self) -> int:
        """Number of columns."""
        return int(self.hand.shape[1])

    def __getitem__(self, part: slice | Array) -> Self:
        return type(self)(self.hand[:, part], self.tall[:, part])

    def times(self, small: Array) -> Block:
        """Block @ small."""
        return Block(self.hand @ small, self.tall @ small)

    @classmethod
    def join(cls, blocks: list[Self]) -> Self:
        """Columns side by side."""
        return cls(np.hstack([b.hand for b in blocks]), np.hstack([b.tall for b in blocks]))


@dataclass(frozen=True)
class PlantState:
    """x = [q_s, v_s, z, v_z] with z = q_e - T q_s."""

    # q_s, v_s: hand [m, rad] and [m/s, rad/s], (n_s,), on every rank
    q_s: Array
    v_s: Array
    # z, v_z: relative displacement [m] and velocity [m/s] of the tissue, local rows (n_local,)
    z: Array
    v_z: Array

    def __sub__(self, other: PlantState) -> PlantState:
        return PlantState(self.q_s - other.q_s, self.v_s - other.v_s, self.z - other.z, self.v_z - other.v_z)

    @property
    def block(self) -> Block:
        """The state as one column."""
        return Block(np.concatenate([self.q_s, self.v_s])[:, None], np.concatenate([self.z, self.v_z])[:, None])


@dataclass(frozen=True)
class Gain:
    """u = K x = K_s [q_s; v_s] + K_z' z + K_v' v_z."""

    K_s: Array  # gain on the hand [N/m, N s/m; N m for torques], (n_s, 2 n_s), on every rank
    # K_z, K_v: gain on z and v_z, transposed, local rows (n_local, n_s)
    K_z: Array
    K_v: Array

    @property
    def block(self) -> Block:
        """K' as columns of the size of the state."""
        return Block(self.K_s.T, np.concatenate([self.K_z, self.K_v]))

    @classmethod
    def of_block(cls, K: Block) -> Gain:
        """The gain whose columns K' are given."""
        n = len(K.tall) // 2
        return cls(np.ascontiguousarray(K.hand.T), np.asfortranarray(K.tall[:n]), np.asfortranarray(K.tall[n:]))

    def apply(self, comm: MPI.Intracomm, x: PlantState) -> Array:
        """K x, (n_s,), on every rank. Collective."""
        tissue = total(comm, self.K_z.T @ x.z + self.K_v.T @ x.v_z)
        return np.asarray(self.K_s @ np.concatenate([x.q_s, x.v_s]) + tissue)
