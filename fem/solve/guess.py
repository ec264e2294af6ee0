"""A first guess for S w = r from the last solutions, the best in their span [F98].

With W the last w's, w_0 = W c minimises |w_0 - S^-1 r| in the norm of S where (W'S W) c = W'r; the product S w comes
with each solve, so that a guess takes vectors only.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from softgrasp.fem.petsc import Array, normalising, total

COLUMNS = 8  # half of them leave a half more iterations, twice as many no fewer
DEPENDENT = 1e-12  # of the largest squared length: directions of smooth motions that are rounding only


class Previous:
    """The last solutions on the rows of this rank, with |w| = 1 in the norm of S.

    Attributes:
        W: solutions, local rows (n, columns), Fortran order.
        gram: W'S W, on every rank.
        count: solutions ever added; the next one takes the place count % columns.
    """

    def __init__(self, comm: MPI.Intracomm, n: int, columns: int = COLUMNS) -> None:
        self.comm, self.count = comm, 0
        self.W, self.gram = np.zeros((n, columns), order="F"), np.zeros((columns, columns))

    def guess(self, r: Array) -> Array:
        """Local rows of W c for local rows of r; zero without solutions. Collective."""
        known = min(self.count, len(self.gram))
        if not known:
            return np.zeros_like(r)
        N = normalising(self.gram[:known, :known], DEPENDENT)
        W = self.W[:, :known]
        return np.asarray(W @ (N @ (N.T @ total(self.comm, W.T @ r))))

    def add(self, w: Array, product: Array, square: float) -> None:
        """Keep a solution w, local rows, with the product S w and w'S w > 0. Collective."""
        at, size = self.count % len(self.gram), np.sqrt(square)
        self.W[:, at] = w / size
        self.gram[at] = self.gram[:, at] = total(self.comm, self.W.T @ product) / size
        self.count += 1

    def clear(self) -> None:
        """Forget all."""
        self.count = 0
        self.W[:], self.gram[:] = 0.0, 0.0
