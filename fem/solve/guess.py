"""First guesses: for S w = r from the last solutions, the best in their span [F98], and for the next of a sequence.

With W the last w's, w_0 = W c minimises |w_0 - S^-1 r| in the norm of S where (W'S W) c = W'r; the product S w comes
with each solve, so that a guess needs vectors only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from mpi4py import MPI

from softgrasp.fem.petsc import Array, normalising, total

COLUMNS = 8  # number of kept solutions [1]: with half of them iterations are a half more, with twice as many no fewer
STEPS = 5  # members that a sequence is extrapolated from: those of a cubic, and one to compare with [1]
BETTER = 0.5  # error of a polynomial over that of a lower degree, from which it is preferred [1]
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


def extrapolated(past: Sequence[Array], dot: Callable[[Array, Array], float]) -> Array:
    """The next of x_1, x_2, .. by the line, parabola or cubic through the last of them, (n,). Collective if ``dot`` is.

    The polynomial of degree k misses x_1 by the difference of order k + 1 of x_1, x_2, ..: the degree with the
    smallest miss is taken, a higher one only where it halves the miss, as it magnifies what alternates.

    Args:
        past: x_1, x_2, .., the latest first, one at least, (n,) each.
        dot: inner product of two of them.
    """
    rows, differences = list(past), [past[0]]
    while len(rows) > 1:
        rows = [a - b for a, b in pairwise(rows)]
        differences.append(rows[0])
    misses = [dot(x, x) / BETTER ** (2 * k) for k, x in enumerate(differences[2:])]  # of degrees 1, 2, ..
    degree = int(np.argmin(misses)) + 1 if misses else len(past) - 1
    return np.asarray(sum(differences[1 : degree + 1], differences[0]))
