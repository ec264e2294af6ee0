"""A few columns of the size of the state, hand and tissue apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from softgrasp.fem.petsc import Array


@dataclass(frozen=True)
class Block:
    """A few columns of the size of the state."""

    hand: Array  # rows of q_s and v_s, (2 n_s, k), on every rank
    tall: Array  # local rows of z and v_z, one below the other, (2 n_local, k)

    @property
    def columns(self) -> int:
        """Number of columns."""
        return int(self.hand.shape[1])

    def __getitem__(self, part: slice | Array) -> Block:
        return Block(self.hand[:, part], self.tall[:, part])

    def times(self, small: Array) -> Block:
        """Block @ small."""
        return Block(self.hand @ small, self.tall @ small)

    @classmethod
    def join(cls, blocks: list[Self]) -> Block:
        """Columns side by side."""
        return Block(np.hstack([b.hand for b in blocks]), np.hstack([b.tall for b in blocks]))
