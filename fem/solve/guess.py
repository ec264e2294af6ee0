"""A first guess for S w = r from the last solutions, the best in their span [F98].

With W the last w's, w_0 = W c minimises |w_0 - S^-1 r| in the norm of S where (W'S W) c = W'r; the product S w comes
with each solve, so that a guess needs vectors only.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from softgrasp.fem.petsc import Array, normalising, total

COLUMNS = 8  # number of kept solutions [1]: with half of them iterations are a half more, with twice as many no fewer
DEPENDENT = 1e-12  # squared length of a direction over the largest, below which it is rounding [1]


class Previous:
    """The last solutions on the rows of this rank, with |w| = 1 in the norm of S.

    Attributes:
        W: solutions, local rows (n, columns), Fortran order [m/sqrt(J)].
        gram: W'S W, on every rank, (columns, columns) [1].
        count: number of solutions ever added [1]; the next one goes to column count % columns.
    """

    def __init__(self, comm: MPI.Intracomm, n: int, columns: int = COLUMNS) -> None:
        self.comm, self.count = comm, 0
        self.W, self.gram = np.zeros((n, columns), order="F"), np.zeros((columns, columns))

    def guess(self, r: Array) -> Array:
        """First guess W c, local rows (n,), for the local rows of r; zero without solutions. Collective."""
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
        """Remove all solutions."""
        self.count = 0
        self.W[:], self.gram[:] = 0.0, 0.0
