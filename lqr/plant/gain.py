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

    @property
    def parts(self) -> tuple[Array, Array, Array, Array]:
        """Rows q_s, v_s, z and v_z (views)."""
        n_s, n = len(self.hand) // 2, len(self.tall) // 2
        return self.hand[:n_s], self.hand[n_s:], self.tall[:n], self.tall[n:]

    @classmethod
    def of_parts(cls, q_s: Array, v_s: Array, z: Array, v_z: Array) -> Self:
        """The block with these rows."""
        return cls(np.concatenate([q_s, v_s]), np.concatenate([z, v_z]))

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

    q_s: Array  # hand [m, rad], (n_s,), on every rank
    v_s: Array  # [m/s, rad/s]
    z: Array  # displacement of the tissue [m], local rows (n_local,)
    v_z: Array  # [m/s]

    def __sub__(self, other: PlantState) -> PlantState:
        return PlantState(self.q_s - other.q_s, self.v_s - other.v_s, self.z - other.z, self.v_z - other.v_z)

    @property
    def block(self) -> Block:
        """The state as one column."""
        return Block.of_parts(*(part[:, None] for part in (self.q_s, self.v_s, self.z, self.v_z)))


@dataclass(frozen=True)
class Gain:
    """u = K x = K_s [q_s; v_s] + K_z' z + K_v' v_z."""

    K_s: Array  # gain on the hand [N/m, N s/m; N m for torques], (n_s, 2 n_s), on every rank
    K_z: Array  # gain on z, transposed, local rows (n_local, n_s)
    K_v: Array  # gain on v_z

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
