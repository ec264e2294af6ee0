"""The contact problem of a step: 0 <= x, W x + q >= 0, x'(W x + q) = 0 with W = N S^-1 N' symmetric.

Block principal pivoting [JP94] from the last set: rows of a wrong sign change sides all at once, and one by one where
that stops to help. `contact.c` keeps the factor of the set; without a compiler NumPy takes the same rounds.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.errors import SolverError
from softgrasp.fem.obstacles.compiled import RETRIES, RIDGE, contact_library

Array = NDArray[Any]
MOST = 40  # rounds for each row, at most: few problems take ten in all


SHARES = 1e-10, 1e-8, 1e-6, 1e-4  # of the diagonal, that make dependent rows definite: the least that leads to an end
SOON = 2  # rounds for each row of such a problem before the next share
PASSES = 200  # until the share is without effect; three are usual


class SmallProblem:
    """The problem with its last set; W may grow by rows between the calls.

    Attributes:
        order: rows of the set A in the order of the factor, the first ``count`` of them.
        L: factor of W_AA in this order, (rows, rows).
        rounds: since the start [1].
        changes: rows that changed sides since the start [1].
    """

    most = MOST

    def __init__(self, engine: str = "") -> None:
        """``engine``: "C" or "NumPy"; empty takes C where there is a compiler. Raises SolverError: there is none."""
        code = None if engine == "NumPy" else contact_library()
        if engine == "C" and code is None:
            raise SolverError("compiled contact is not available here; leave the engine out")
        self.code = code
        self.count, self.order, self.L = np.zeros(1, np.intc), np.zeros(0, np.intc), np.zeros((0, 0))
        self.tally = np.zeros(2, np.int64)

    @property
    def rounds(self) -> int:
        """Rounds since the start [1]."""
        return int(self.tally[0])

    @property
    def active(self) -> Array:
        """Rows of the set, in the order of its factor."""
        return self.order[: self.count[0]]

    def fit(self, size: int) -> None:
        """Room for W of this size; the set stays."""
        L, order, have = np.zeros((size, size)), np.zeros(size, np.intc), int(self.count[0])
        L[:have, :have], order[:have] = self.L[:have, :have], self.order[:have]
        self.L, self.order = L, order
        self.x, self.side, self.room = np.zeros(size), np.zeros(size, np.intc), np.zeros(5 * size)
        if self.code is not None:  # asking for a pointer takes as long as a small problem
            at = self.code[0].from_buffer
            self.kept = (
                at("int[]", self.count), at("int[]", self.order), at("double[]", self.L), at("double[]", self.x),
                at("int[]", self.side), at("double[]", self.room), at("long[]", self.tally),
            )  # fmt: skip

    def restart(self, W: Array, active: Array) -> None:
        """Begin from a set of another W, whose factor is made anew, or from none where rounding leaves it without."""
        self.count[0] = 0
        self.fit(len(W))
        rows = np.sort(active)
        block = W[np.ix_(rows, rows)]
        block[np.diag_indices(len(rows))] *= 1 + RIDGE
        try:
            self.L[: len(rows), : len(rows)] = np.linalg.cholesky(block)
        except np.linalg.LinAlgError:
            return
        self.order[: len(rows)], self.count[0] = rows, len(rows)

    def resume(self, order: Array, L: Array, size: int) -> None:
        """Continue with a set and its factor, (m,) and (m, m)."""
        m = len(order)
        self.fit(max(size, m))
        self.order[:m], self.L[:m, :m], self.count[0] = order, L.reshape(m, m), m

    def solve(self, p: int, W: Array, q: Array, tol: float) -> Array:
        """X (p,) of the first p rows; W is contiguous and may have room for more.

        ``tol``: by how much W x + q may be negative. Raises SolverError: the rounds do not end, which is so where
        obstacles leave no room.
        """
        if len(W) != len(self.L):
            self.fit(len(W))
        failed = self._in_numpy(p, W, q, tol) if self.code is None else self._in_c(p, W, q, tol)
        if failed:
            raise SolverError(self.unsolved(p))
        return self.x[:p]

    def unsolved(self, p: int) -> str:
        """The sentence on p rows for which the rounds do not end."""
        return (
            f"the contact problem of {p} rows has no solution that {self.most * p} rounds find; obstacles that "
            "leave the tissue no room are the usual reason: move one, or raise time.steps"
        )

    def _in_c(self, p: int, W: Array, q: Array, tol: float) -> int:
        assert self.code is not None
        at = self.code[0].from_buffer
        result: int = self.code[1].softgrasp_complement(
            p, len(W), at("double[]", W), at("double[]", q), tol, self.most * p, *self.kept
        )
        return result

    def _in_numpy(self, p: int, W: Array, q: Array, tol: float) -> int:
        W, q = W[:p, :p], q[:p]
        inside = np.zeros(p, dtype=bool)
        inside[self.active] = True
        best, tries = p + 1, RETRIES
        for _ in range(self.most * p):
            self.tally[0] += 1
            rows, x = np.flatnonzero(inside), np.zeros(p)
            block = W[np.ix_(rows, rows)]
            block[np.diag_indices(len(rows))] *= 1 + RIDGE
            x[rows] = np.linalg.solve(block, -q[rows])
            wrong = np.where(inside, x < 0, q + W @ x < -tol)
            count = int(wrong.sum())
            if count == 0:
                self.x[:p], self.count[0] = x, len(rows)
                self.order[: len(rows)] = rows
                return 0
            if count < best:
                best, tries = count, RETRIES
            elif tries > 0:
                tries -= 1
            else:
                wrong[: np.flatnonzero(wrong)[-1]] = False
            self.tally[1] += int(wrong.sum())
            inside ^= wrong
        self.count[0] = 0
        return -1


class DependentProblem(SmallProblem):
    """The problem of rows that depend on each other, as those of points between nodes do.

    W is singular, x not unique while W x is. Proximal passes x <- solution for W + E and q - E x, E a share of the
    diagonal of W, end at a solution of the problem itself [Rockafellar76].
    """

    most = SOON

    def restart(self, W: Array, active: Array) -> None:
        """See :meth:`SmallProblem.restart`."""
        with _raised(W, len(W), SHARES[0]):
            super().restart(W, active)

    def solve(self, p: int, W: Array, q: Array, tol: float) -> Array:
        """See :meth:`SmallProblem.solve`."""
        for share in SHARES:
            try:
                if share > SHARES[0]:
                    self._guess(p, W, q, share)
                x = self._passes(p, W, q, tol, share)
            except SolverError:
                if share == SHARES[-1]:
                    raise
                continue
            if share > SHARES[0]:
                self.count[0] = 0  # the factor is that of another matrix
            return x
        raise AssertionError

    def _guess(self, p: int, W: Array, q: Array, share: float) -> None:
        """Begin from the set that non-negative least squares find [LH74]: slower, and without a cycle."""
        from scipy.linalg import solve_triangular  # few steps need it
        from scipy.optimize import nnls

        with _raised(W, p, share):
            try:
                L = np.linalg.cholesky(W[:p, :p])
                active = np.flatnonzero(nnls(L.T, -solve_triangular(L, q[:p], lower=True))[0])
            except (np.linalg.LinAlgError, RuntimeError):
                active = np.zeros(0, dtype=np.intp)
            super().restart(W, active)

    def _passes(self, p: int, W: Array, q: Array, tol: float, share: float) -> Array:
        x, right = np.zeros(p), q.copy()
        with _raised(W, p, share) as more:
            for _ in range(PASSES):
                right[:p] = q[:p] - more * x
                before, x = x, super().solve(p, W, right, tol / 2).copy()
                if np.abs(more * (x - before)).max(initial=0.0) <= tol / 2:
                    return x
        raise SolverError(f"contact: {PASSES} passes leave the forces of {p} points open; lower obstacle.parts")


@contextmanager
def _raised(W: Array, p: int, share: float) -> Iterator[Array]:
    """W with a diagonal of its first p rows that is larger by a share; yields by how much, (p,)."""
    every = np.arange(p)
    diagonal = W[every, every]
    W[every, every] += (more := share * diagonal)
    try:
        yield more
    finally:
        W[every, every] = diagonal
