"""The contact problem of a step with Coulomb friction in 2D, W = N S^-1 N' with rows n and t of every node.

    0 <= x_n,  y_n >= 0,  x_n y_n = 0,   |x_t| <= mu x_n,  x_t = -mu x_n sign(y_t) where y_t is not 0,   y = W x + q,

y_t half the slip of the step. Newton's method on the sets open, stick and slip of either sign [AC91], which is exact
when the sets stay; where it comes back to sets seen before, sweeps of Gauss-Seidel over the nodes find others.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lu_factor, lu_solve

from softgrasp.fem.errors import SolverError
from softgrasp.fem.obstacles.small import RIDGE

Array = NDArray[Any]
OPEN, STICK, FORWARD, BACK = range(4)  # sets; FORWARD: x_t = mu x_n, BACK: x_t = -mu x_n
ROUNDS = 40  # of Newton's method, before and after the sweeps
SWEEPS = 3000
STILL = 1e-14  # change of the forces by a sweep over the largest, at which sweeps end


class Coulomb:
    """The problem with its last factor.

    Attributes:
        rounds: of Newton's method since the start [1].
        sweeps: of Gauss-Seidel since the start [1].
    """

    def __init__(self) -> None:
        self.rounds = self.sweeps = 0
        self.W = np.zeros((0, 0))
        self.sets, self.factor = b"", (np.zeros((0, 0)), np.zeros(0, dtype=np.intc))

    def solve(self, W: Array, q: Array, mu: Array, kind: Array, tol: float) -> tuple[Array, Array]:
        """Forces x (2k,), all normal ones before all tangential ones, and the sets of the nodes (k,).

        Args:
            W: symmetric, positive definite, (2k, 2k); its factor is kept while the same array comes again.
            q: (2k,).
            mu: coefficients of friction, (k,).
            kind: sets to begin with, (k,).
            tol: by how much gaps may be negative, and slips of the wrong sign.

        Raises SolverError: neither rounds nor sweeps find a solution.
        """
        if W is not self.W:
            self.W, self.sets = W, b""
        kind = np.where((kind == OPEN) & (q[: len(mu)] < 0), STICK, kind)
        x, kind, found = self._newton(q, mu, kind, tol)
        if not found:
            x = self._sweep(q, mu, np.maximum(x[: len(mu)], 0.0))
            x, kind, found = self._newton(q, mu, _sets(x, mu), tol)
        if not found:
            raise SolverError(
                f"the friction of {len(mu)} nodes has no solution that {SWEEPS} sweeps find; take more time.steps, or "
                "less friction"
            )
        return x, kind

    def _newton(self, q: Array, mu: Array, kind: Array, tol: float) -> tuple[Array, Array, bool]:
        """Forces, sets, and whether they belong together."""
        k, seen = len(mu), set[bytes]()
        for _ in range(ROUNDS):
            self.rounds += 1
            x = self._forces(q, mu, kind)
            n, t, y = x[:k], x[k:], self.W @ x + q
            new, on, stick = kind.copy(), kind != OPEN, kind == STICK
            new[~on & (y[:k] < -tol)] = STICK
            # without friction a node slips whatever its velocity
            new[(mu > 0) & (((kind == FORWARD) & (y[k:] > tol)) | ((kind == BACK) & (y[k:] < -tol)))] = STICK
            new[stick & (t > mu * n)], new[stick & (t < -mu * n)] = FORWARD, BACK
            new[on & (n <= 0)] = OPEN
            if np.array_equal(new, kind):
                return x, kind, True
            seen.add(kind.tobytes())
            kind = new
            if kind.tobytes() in seen:
                break
        return x, kind, False

    def _forces(self, q: Array, mu: Array, kind: Array) -> Array:
        """Forces for which open nodes carry none, sticking ones stay, and slipping ones carry mu x_n."""
        k = len(mu)
        on, stick = np.flatnonzero(kind != OPEN), np.flatnonzero(kind == STICK)
        share = np.select([kind == FORWARD, kind == BACK], [mu, -mu], 0.0)
        rows, x = np.concatenate([on, k + stick]), np.zeros(2 * k)
        if len(rows) == 0:
            return x
        if kind.tobytes() != self.sets:
            matrix = self.W[np.ix_(rows, rows)]
            matrix[np.diag_indices(len(rows))] *= 1 + RIDGE
            matrix[:, : len(on)] += self.W[np.ix_(rows, k + on)] * share[on]
            self.factor, self.sets = lu_factor(matrix, overwrite_a=True, check_finite=False), kind.tobytes()
        x[rows] = lu_solve(self.factor, -q[rows], check_finite=False)
        x[k:] += share * x[:k]
        return x

    def _sweep(self, q: Array, mu: Array, n: Array) -> Array:
        """Forces by projected Gauss-Seidel from normal forces n (k,) on."""
        k, W, diagonal = len(mu), self.W, np.diag(self.W)
        x = np.concatenate([n, np.zeros(k)])
        for _ in range(SWEEPS):
            self.sweeps += 1
            most, change = 0.0, 0.0
            for i in range(k):
                a, b = x[i], x[k + i]
                x[i] = max(0.0, a - (W[i] @ x + q[i]) / diagonal[i])
                x[k + i] = np.clip(b - (W[k + i] @ x + q[k + i]) / diagonal[k + i], -mu[i] * x[i], mu[i] * x[i])
                most, change = max(most, x[i]), max(change, abs(x[i] - a), abs(x[k + i] - b))
            if change <= STILL * most:
                break
        return x


def _sets(x: Array, mu: Array) -> Array:
    """Sets of forces x (2k,)."""
    k = len(mu)
    n, t = x[:k], x[k:]
    inside = np.abs(t) < mu * n * (1 - 1e-9)
    return np.select([n <= 0, inside, t >= 0], [OPEN, STICK, FORWARD], BACK)
