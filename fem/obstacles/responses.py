"""Columns of S^-1 N' and the matrix N S^-1 N' of boundary nodes, each solved for when it is first needed, and kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Key = tuple[int, int]
"""A boundary node and a direction, by their numbers."""


class Responses:
    """Responses to unit forces on boundary nodes.

    Args:
        directions: unit vectors, (m, d).
        respond: response to forces (p d,) on the boundary, on the rows here and on the boundary (p d,). Collective.
        reach: T - theta S^-1 G on the boundary of a two-way hand, (p d, n_s), and its L^-1 / s^2; None where the hand
            feels no tissue.

    Attributes:
        columns: response of every key here, (rows here, capacity), the first ``count`` of them.
        surface: the same on the boundary, (p d, capacity).
        G: directions times responses, with the hand's part where it is two-way, (capacity, capacity).
        B: directions times reach, (capacity, n_s).
    """

    def __init__(
        self,
        directions: Array,
        respond: Callable[[Array], tuple[Array, Array]],
        size: int,
        reach: tuple[Array, Array] | None = None,
    ) -> None:
        self.directions, self.respond, self.size, self.reach = directions, respond, size, reach
        self.d = directions.shape[1]
        self.keys: list[Key] = []
        self.where: dict[Key, int] = {}
        self.columns, self.surface = np.zeros((0, 0), order="F"), np.zeros((size, 0), order="F")
        self.G = np.zeros((0, 0))
        self.B = np.zeros((0, 0 if reach is None else len(reach[1])))

    def enter(self, keys: list[Key]) -> None:
        """Make the columns of the keys that have none, in the order given. Collective."""
        for key in keys:
            if key not in self.where:
                self._add(key)

    def _add(self, key: Key) -> None:
        node, direction = key
        n, force = self.directions[direction], np.zeros(self.size)
        force[node * self.d : (node + 1) * self.d] = n
        column, there = self.respond(force)
        k = len(self.keys)
        if k == len(self.G):
            self._grow(max(16, 2 * k), len(column))
        self.keys.append(key)
        self.where[key] = k
        self.columns[:, k], self.surface[:, k] = column, there
        nodes, numbers = np.array(self.keys).T
        products = np.einsum("ij,ij->i", self.directions[numbers], there.reshape(-1, self.d)[nodes])
        if self.reach is not None:
            reach, inverse = self.reach
            self.B[k] = n @ reach[node * self.d : (node + 1) * self.d]
            products = products + self.B[: k + 1] @ (inverse @ self.B[k])
        self.G[k, : k + 1] = self.G[: k + 1, k] = products

    def _grow(self, size: int, rows: int) -> None:
        k = len(self.keys)

        def larger(x: Array, shape: tuple[int, int]) -> Array:
            y = np.zeros(shape, order="F" if x.flags.f_contiguous and not x.flags.c_contiguous else "C")
            y[: x.shape[0], : x.shape[1]] = x
            return y

        columns, surface = self.columns, self.surface
        self.columns, self.surface = np.zeros((rows, size), order="F"), np.zeros((self.size, size), order="F")
        if k:
            self.columns[:, :k], self.surface[:, :k] = columns[:, :k], surface[:, :k]
        self.G, self.B = larger(self.G, (size, size)), larger(self.B, (size, self.B.shape[1]))

    def forces(self, f: Array) -> Array:
        """Forces on the boundary (p d,) of strengths f (count,)."""
        total = np.zeros((self.size // self.d, self.d))
        on = np.flatnonzero(f)
        if len(on):
            nodes, numbers = np.array(self.keys)[on].T
            np.add.at(total, nodes, f[on, None] * self.directions[numbers])
        return total.ravel()
