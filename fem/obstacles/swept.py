"""Columns F N' of a solve S^-1 = B F in two sweeps, kept where they are not zero, and N S^-1 N' = (F N')'D F N'."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from softgrasp.fem.obstacles.compiled import KINDS
from softgrasp.fem.obstacles.responses import Array, Responses, larger


class SweptColumns:
    """The first sweep F n of rows n, see :mod:`softgrasp.fem.solve.sweeps`.

    Args:
        D: blocks on the diagonal of D, (nodes, d, d).
        code: (ffi, library) of `contact.c`.

    Attributes:
        count: number of columns.
        runs: entry with which each run of entries begins, and its length, (.., 2).
        first: run with which each column begins, (count + 1, and room).
        at: value with which each column begins, the same.
        values: of all columns.
        f: struct of `swept.h`.
    """

    def __init__(self, D: Array, code: Any) -> None:
        (self.ffi, self.c), self.arrays = code, dict[str, Array]()
        self.f, self.f.d, self.count = self.ffi.new("Swept *"), D.shape[1], 0
        self.on = np.zeros(len(D), dtype=bool)  # nodes on which a column has entries
        self.first, self.at = np.zeros(1, np.intc), np.zeros(1, np.int64)
        self.runs, self.values = np.zeros((0, 2), np.intc), np.zeros(0)
        self.point(D=np.ascontiguousarray(D), z=np.zeros(D.shape[0] * D.shape[1]))

    def point(self, **arrays: Array) -> None:
        """Let fields of the struct point at arrays, which are kept."""
        for name, array in arrays.items():
            if self.arrays.get(name) is not array:
                setattr(self.f, name, self.ffi.from_buffer(KINDS[array.dtype], array))
                self.arrays[name] = array

    def append(self, columns: Array) -> None:
        """Keep further columns, (n, k)."""
        have, k = self.count, columns.shape[1]
        number, place = np.nonzero(columns.T)
        begin = np.flatnonzero((np.diff(place, prepend=-2) != 1) | (np.diff(number, prepend=-1) != 0))
        runs, values = int(self.first[have]), int(self.at[have])
        self.first, self.at = _room(self.first, have + 1 + k), _room(self.at, have + 1 + k)
        self.runs, self.values = _room(self.runs, runs + len(begin)), _room(self.values, values + len(place))
        new = slice(have + 1, have + 1 + k)
        self.first[new] = runs + np.cumsum(np.bincount(number[begin], minlength=k))
        self.at[new] = values + np.cumsum(np.bincount(number, minlength=k))
        self.runs[runs : runs + len(begin)] = np.column_stack([place[begin], np.diff(begin, append=len(place))])
        self.values[values : values + len(place)] = columns[place, number]
        self.on[place // self.f.d] = True
        nodes = np.flatnonzero(self.on).astype(np.intc)
        self.count = self.f.columns = have + k
        self.f.reached = len(nodes)
        self.point(first=self.first, at=self.at, runs=self.runs, values=self.values, nodes=nodes)

    def products(self, j: int) -> Array:
        """(F N')'D F n of column j, for the columns up to it."""
        products = np.zeros(j + 1)
        self.c.softgrasp_products(self.f, j, self.ffi.from_buffer("double[]", products))
        return products

    def combine(self, t: Array, to: Array) -> None:
        """Add columns t (count,) to a vector (n,)."""
        self.c.softgrasp_combine(self.f, *(self.ffi.from_buffer("double[]", x) for x in (t, to)))


def _room(x: Array, size: int) -> Array:
    """An array that begins with x and has the size or more."""
    return x if len(x) >= size else larger(x, (2 * size, *x.shape[1:]))


class SweptResponses(Responses):
    """`Responses` with the first sweep of each column alone.

    Args:
        directions, size, reach: see `Responses`.
        respond: F of forces (p d, k) on the boundary, (n, k).
        swept: columns, none yet.

    Attributes:
        y: first sweep of a step, (n,).
    """

    def __init__(
        self,
        directions: Array,
        respond: Callable[[Array], Array],
        size: int,
        reach: tuple[Array, Array] | None,
        swept: SweptColumns,
    ) -> None:
        super().__init__(directions, respond, size, reach)
        self.swept, self.y = swept, np.zeros(len(swept.arrays["z"]))
        swept.point(y=self.y)

    def _solve(self, first: int, forces: Array) -> None:
        """See :meth:`Responses._solve`. Collective."""
        self.swept.append(self.respond(forces))

    def _products(self, j: int) -> Array:
        """See :meth:`Responses._products`."""
        return self.swept.products(j)
