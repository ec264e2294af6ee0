"""A few columns of the size of the state, hand and tissue apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from softgrasp.fem.petsc import Array


@dataclass(frozen=True)
class Block:
    """A few columns of the size of the state."""

    hand: Array  # rows q_s and v_s on every rank, (2 n_s, k)
    tall: Array  # local rows z, then v_z, (2 n_local, k)

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
        """Product of the columns with a matrix, (k, l)."""
        return Block(self.hand @ small, self.tall @ small)

    @classmethod
    def join(cls, blocks: list[Self]) -> Self:
        """Columns side by side."""
        return cls(np.hstack([b.hand for b in blocks]), np.hstack([b.tall for b in blocks]))
