"""Solves with the factor of a sparse matrix, compiled, in blocks of neighbouring columns that share their rows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, tril

Array = NDArray[Any]
DECLARATION = """
typedef struct {
  int count;
  const int *begin, *first, *rows;
  const long *at;
  double *values, *room;
} Lower;
int softgrasp_mass(int n, const int *ptr, const int *col, const double *M, const double *inverse, int most, double rtol,
  int *order, int count, double *x, double *room, char *in);
void softgrasp_invert(const Lower *L);
void softgrasp_ahead(const Lower *L, double *x);
void softgrasp_back(const Lower *L, int several, int n, double *x);
"""
GROUP = 4
WASTE = 16


class LowerFactor:
    """L with ones on its diagonal, as elimination leaves it: rows of a column are rows of its first one below too.

    Args:
        L: factor, (n, n).
        code: (ffi, library) of `mass.c`.
    """

    def __init__(self, L: csc_matrix, code: Any) -> None:
        (self.ffi, self.c), below = code, tril(L, -1, format="csc")
        below.sort_indices()
        ptr, rows, n = below.indptr, below.indices, L.shape[0]
        begin = _blocks(ptr, rows)
        sizes = np.diff(begin)
        of = np.repeat(np.arange(len(sizes)), sizes)[np.repeat(np.arange(n), np.diff(ptr))]
        inside = rows < begin[of + 1]
        # the rows of all columns of a block: SuperLU leaves out entries that cancel, in the last column too
        keys, of_key = np.unique(of[~inside] * n + rows[~inside], return_inverse=True)
        block, beneath = np.divmod(keys, n)
        count = np.bincount(block, minlength=len(sizes))
        first = np.concatenate([[0], np.cumsum(count)])
        width = -(-sizes // GROUP) * GROUP
        ends = np.cumsum(width * (sizes + count))
        at = ends - width * (sizes + count)
        column = np.repeat(np.arange(n), np.diff(ptr))
        place = rows - begin[of]
        place[~inside] = of_key - first[of[~inside]] + sizes[of[~inside]]
        values = np.zeros(int(ends[-1]))
        values[at[of] + place * width[of] + column - begin[of]] = below.data
        self.f, self.f.count = self.ffi.new("Lower *"), len(sizes)
        self.arrays: dict[str, Array] = {
            "begin": begin.astype(np.intc), "first": first.astype(np.intc), "rows": beneath.astype(np.intc),
            "at": at.astype(np.int64), "values": values, "room": np.zeros(2 * int((sizes + count).max()) + GROUP),
        }  # fmt: skip
        for name, array in self.arrays.items():
            kind = {"i": "int[]", "l": "long[]", "d": "double[]"}[array.dtype.char]
            setattr(self.f, name, self.ffi.from_buffer(kind, array))
        self.c.softgrasp_invert(self.f)

    def ahead(self, x: Array) -> None:
        """L^-1 x in place, (n,)."""
        self.c.softgrasp_ahead(self.f, self.ffi.from_buffer("double[]", x))

    def back(self, x: Array) -> None:
        """L^-T x in place, (n,), or of every row of x (k, n)."""
        self.c.softgrasp_back(self.f, x.size // x.shape[-1], x.shape[-1], self.ffi.from_buffer("double[]", x))


def _blocks(ptr: Array, rows: Array) -> Array:
    """Columns with which blocks begin, and n: a column joins the next one where that is its first row below."""
    n, length = len(ptr) - 1, np.diff(ptr).tolist()
    follows = np.zeros(n, dtype=bool)
    some = np.flatnonzero(np.diff(ptr))
    follows[some] = rows[ptr[some]] == some + 1
    joins, full = follows.tolist(), 0
    begin = [n]
    for k in range(n - 1, -1, -1):
        full += 1  # rows of column k as one of the block
        if k == n - 1 or not joins[k] or full > length[k] + WASTE:
            if k < n - 1:
                begin.append(k + 1)
            full = length[k]
    return np.array([*begin, 0])[::-1]
