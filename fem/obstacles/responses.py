"""Columns of S^-1 N' and the matrix N S^-1 N' of boundary nodes, each solved for when it is first needed, and kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Key = tuple[int, int]
"""A boundary node and a direction, by their numbers."""
TOGETHER = 16  # columns of one call, which MUMPS solves as one block


def larger(x: Array, shape: tuple[int, ...], order: Literal["C", "F"] = "C") -> Array:
    """An array of a larger shape that begins with x, zero beyond."""
    y = np.zeros(shape, x.dtype, order)
    y[tuple(slice(n) for n in x.shape)] = x
    return y


class Responses:
    """Responses to unit forces on boundary nodes.

    Args:
        directions: unit vectors, (m, d).
        respond: responses on the rows here to forces (p d, k) on the boundary, (rows here, k). Collective.
        reach: T - theta S^-1 G on the boundary of a two-way hand, (p d, n_s), and its L^-1 / s^2; None where the hand
            feels no tissue.
        take: values on the boundary (p d,) of a response. Collective.

    Attributes:
        keys: boundary node and direction of every column, by their numbers, (capacity, 2), the first ``count`` of them.
        where: column of every key.
        blocks: numbers of columns that were solved for together, on which their bits depend.
        columns: response of every key here, (rows here, capacity).
        surface: the same on the boundary, (p d, capacity).
        G: directions times responses, with the hand's part where it is two-way, (capacity, capacity).
        B: directions times reach, (capacity, n_s).
    """

    def __init__(
        self,
        directions: Array,
        respond: Callable[[Array], Array],
        size: int,
        reach: tuple[Array, Array] | None = None,
        take: Callable[[Array], Array] | None = None,
    ) -> None:
        self.directions, self.respond, self.size, self.reach, self.take = directions, respond, size, reach, take
        self.d = directions.shape[1]
        self.keys = np.zeros((0, 2), dtype=int)
        self.where: dict[Key, int] = {}
        self.blocks: list[int] = []
        self.columns, self.surface = np.zeros((0, 0), order="F"), np.zeros((size, 0), order="F")
        self.G = np.zeros((0, 0))
        self.B = np.zeros((0, 0 if reach is None else len(reach[1])))

    @property
    def count(self) -> int:
        """Number of columns [1]."""
        return len(self.where)

    def enter(self, keys: list[Key]) -> None:
        """Make the columns of the keys that have none, in the order given. Collective."""
        new = [key for key in dict.fromkeys(keys) if key not in self.where]
        for first in range(0, len(new), TOGETHER):
            self._add(new[first : first + TOGETHER])

    def again(self, keys: list[Key], blocks: list[int]) -> None:
        """Make the first columns with the bits of another run, which solved for them in these blocks. Collective."""
        for block in blocks:
            self._add(keys[self.count : self.count + block])

    def _add(self, keys: list[Key]) -> None:
        self.blocks.append(len(keys))
        forces = np.zeros((self.size, len(keys)))
        for j, (node, direction) in enumerate(keys):
            forces[node * self.d : (node + 1) * self.d, j] = self.directions[direction]
        have, k = self.count, self.count + len(keys)
        if k > len(self.G):
            size = max(16, 2 * k)
            self.keys, self.G = larger(self.keys, (size, 2)), larger(self.G, (size, size))
            self.B = larger(self.B, (size, self.B.shape[1]))
        self.keys[have:k] = keys
        self.where.update(zip(keys, range(have, k), strict=True))
        self._solve(have, forces)
        for j in range(have, k):
            self._relate(j)

    def _solve(self, first: int, forces: Array) -> None:
        """The columns from ``first`` on, of forces (p d, k). Collective."""
        columns = self.respond(forces)
        assert self.take is not None
        new = slice(first, first + forces.shape[1])
        if self.columns.shape[1] < len(self.G):
            self.columns = larger(self.columns, (len(columns), len(self.G)), "F")
            self.surface = larger(self.surface, (self.size, len(self.G)), "F")
        self.columns[:, new] = columns
        self.surface[:, new] = np.column_stack([self.take(column) for column in columns.T])

    def _relate(self, j: int) -> None:
        """Products of column j with those before it."""
        products, (node, number) = self._products(j), self.keys[j]
        if self.reach is not None:
            reach, inverse = self.reach
            self.B[j] = self.directions[number] @ reach[node * self.d : (node + 1) * self.d]
            products = products + self.B[: j + 1] @ (inverse @ self.B[j])
        self.G[j, : j + 1] = self.G[: j + 1, j] = products

    def _products(self, j: int) -> Array:
        """N S^-1 n of column j for the columns up to it."""
        nodes, numbers = self.keys[: j + 1].T
        there = self.surface[:, j].reshape(-1, self.d)
        return np.asarray(np.einsum("ij,ij->i", self.directions[numbers], there[nodes]))

    def forces(self, f: Array) -> Array:
        """Forces on the boundary (p d,) of strengths f (count,)."""
        total = np.zeros((self.size // self.d, self.d))
        on = np.flatnonzero(f)
        if len(on):
            nodes, numbers = self.keys[on].T
            np.add.at(total, nodes, f[on, None] * self.directions[numbers])
        return total.ravel()
