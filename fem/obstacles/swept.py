"""Columns F N' of a solve S^-1 = B F in two sweeps, kept where they are not zero, and N S^-1 N' = (F N')'D F N'."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from softgrasp.fem.obstacles.compiled import KINDS
from softgrasp.fem.obstacles.responses import Array, Responses, larger


class SweptResponses(Responses):
    """`Responses` with the first sweep of each column alone, see :mod:`softgrasp.fem.solve.sweeps`.

    Args:
        directions: unit vectors, (m, d).
        respond: F of forces (p d, k) on the boundary, (n, k), and nothing.
        size, reach: see `Responses`.
        D: blocks on the diagonal of D, (nodes, d, d).
        code: (ffi, library) of `contact.c`.

    Attributes:
        y: first sweep of a step, (n,).
        f: struct of `swept.h`.
    """

    def __init__(
        self,
        directions: Array,
        respond: Callable[[Array], tuple[Array, Array]],
        size: int,
        reach: tuple[Array, Array] | None,
        D: Array,
        code: Any,
    ) -> None:
        super().__init__(directions, respond, size, reach)
        self.D, (self.ffi, self.c), self.arrays = D, code, dict[str, Array]()
        self.f, self.f.d = self.ffi.new("Swept *"), D.shape[1]
        self.y, z = np.zeros((2, D.shape[0] * D.shape[1]))
        self.on = np.zeros(len(D), dtype=bool)  # nodes on which a column has entries
        self.first, self.at, self.values = np.zeros(1, np.intc), np.zeros(1, np.int64), np.zeros(0)
        self.runs = np.zeros((0, 2), np.intc)
        self._point(y=self.y, z=z)

    def _point(self, **arrays: Array) -> None:
        """Let fields of the struct point at arrays, which are kept."""
        for name, array in arrays.items():
            setattr(self.f, name, self.ffi.from_buffer(KINDS[array.dtype], array))
            self.arrays[name] = array

    def _solve(self, first: int, forces: Array) -> None:
        """See :meth:`Responses._solve`. Collective."""
        for column in self.respond(forces)[0].T:
            places = np.flatnonzero(column)
            begin = np.flatnonzero(np.diff(places, prepend=-2) > 1)
            lengths = np.diff(begin, append=len(places))
            self.runs = np.vstack([self.runs, np.column_stack([places[begin], lengths])]).astype(np.intc)
            have = int(self.at[-1])
            self.first, self.at = np.append(self.first, len(self.runs)), np.append(self.at, have + len(places))
            if self.at[-1] > len(self.values):
                self.values = larger(self.values, (2 * int(self.at[-1]),))
            self.values[have : have + len(places)] = column[places]
            self.on[places // self.f.d] = True
        nodes = np.flatnonzero(self.on)
        self.f.columns, self.f.reached = len(self.at) - 1, len(nodes)
        self._point(
            first=self.first.astype(np.intc), at=self.at, runs=self.runs, values=self.values,
            nodes=nodes.astype(np.intc), D=self.D[nodes],
        )  # fmt: skip

    def _products(self, j: int) -> Array:
        """See :meth:`Responses._products`."""
        products = np.zeros(j + 1)
        self.c.softgrasp_products(self.f, j, self.ffi.from_buffer("double[]", products))
        return products
