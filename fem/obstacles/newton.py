"""Newton's method and sweeps for the problem of `coulomb.py` in NumPy, for machines without a compiler."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.obstacles.compiled import RIDGE

Array = NDArray[Any]
OPEN, STICK, SLIP = range(3)
ROUNDS = 0, 40, 60  # of Newton's method, before and after sweeps, by the number of tangents
SWEEPS = (), (3, 30), (3, 30, 300, 3000)  # between rounds, by tangents: few mend sets that are wrong at few nodes
STILL = 1e-14  # change of the forces by a sweep over the largest, at which sweeps end
NEARLY = 1e-9  # of a force, below which its node slips, or is open [1]


class Rounds:
    """Rounds of Newton's method, each with a factor of its own, and sweeps."""

    m: int
    """Tangents of a node."""
    x: Array
    """Forces."""
    kind: NDArray[np.intc]
    """Sets."""
    e: Array
    """Directions."""
    tally: NDArray[np.int64]
    """Rounds and sweeps."""

    def _set_kinds(self, mu: Array, small: float = 0.0) -> None:
        """Sets and directions of the present forces, of which ``small`` ones are rounding [N]."""
        sizes = np.linalg.norm(self.x[:, 1:], axis=1)
        inside = sizes < mu * self.x[:, 0] * (1 - NEARLY) - small
        self.kind[:] = np.select([self.x[:, 0] <= small, inside], [OPEN, STICK], SLIP)
        self.e[:] = 0.0
        self.e[:, 0] = 1.0
        on = sizes > 0
        self.e[on, :-1] = self.x[on, 1:] / sizes[on, None]

    def _in_numpy(self, W: Array, q: Array, mu: Array, tol: float) -> bool:
        K = len(q)
        W = W[:K, :K]
        if self._newton(W, q, mu, tol):
            return True
        for sweeps in SWEEPS[self.m]:
            self._sweep(W, q, mu, sweeps)
            kept = self.x.copy(), self.kind.copy(), self.e.copy()
            if self._newton(W, q, mu, tol):
                return True
        self.x[:], self.kind[:], self.e[:] = kept
        return self._wrong(W, q, mu) <= tol

    def _newton(self, W: Array, q: Array, mu: Array, tol: float) -> bool:
        """Rounds of Newton's method from the present sets."""
        k, s, seen = len(mu), 1 + self.m, set[bytes]()
        w = W.diagonal().reshape(k, s)
        for _ in range(ROUNDS[self.m]):
            self.tally[0] += 1
            seen.add(self._key())
            J, r = np.zeros_like(W), np.zeros((k, s))
            y = (W @ self.x.ravel() + q).reshape(k, s)
            for i in range(k):
                J[i * s : (i + 1) * s], r[i] = self._rows(W, w, i, mu[i], y[i])
            try:
                self.x -= np.linalg.solve(J, r.ravel()).reshape(k, s)
            except np.linalg.LinAlgError:
                return False
            self.x[self.kind == OPEN] = 0.0
            slips = self.kind == SLIP
            if self.m == 1:
                self.x[slips, 1] = mu[slips] * self.x[slips, 0] * self.e[slips, 0]
            y = (W @ self.x.ravel() + q).reshape(k, s)
            before = self.kind.copy()
            self._classify(w, y, mu, tol)
            changed = not np.array_equal(before, self.kind)
            left = max(float(np.abs(self._rows(W, w, i, mu[i], y[i])[1]).max()) for i in range(k)) if k else 0.0
            if not changed and left <= tol:
                return True
            if not np.isfinite(left) or (changed and self.m == 1 and self._key() in seen):
                return False
        return False

    def _key(self) -> bytes:
        sides: Array = np.sign(self.e[:, 0]) * (self.kind == SLIP)
        return bytes(self.kind.tobytes() + sides.tobytes())

    def _rows(self, W: Array, w: Array, i: int, mu: float, y: Array) -> tuple[Array, Array]:
        """Rows of the matrix of node i, and its residual."""
        s, e, x, rows = 1 + self.m, self.e[i, : self.m], self.x[i], slice(i * (1 + self.m), (i + 1) * (1 + self.m))
        J = W[rows].copy()
        J[np.arange(s), np.arange(rows.start, rows.stop)] *= 1 + RIDGE
        if self.kind[i] == OPEN:
            J[:] = 0.0
            J[np.arange(s), np.arange(rows.start, rows.stop)] = w[i]
            return J, w[i] * x
        if self.kind[i] == STICK:
            return J, y
        c, P = self.e[i, -1] if self.m > 1 else 0.0, np.eye(self.m) - np.outer(e, e)
        J[1:] = c * P @ W[rows][1:]
        J[1:, rows.start + 1 : rows.stop] += w[i, 1] * (np.eye(self.m) - c * P)
        J[1:, rows.start] -= w[i, 1] * mu * e
        return J, np.concatenate([y[:1], w[i, 1] * (x[1:] - mu * x[0] * e)])

    def _classify(self, w: Array, y: Array, mu: Array, tol: float) -> None:
        """New sets and directions."""
        for i, (x, n) in enumerate(zip(self.x, mu * self.x[:, 0], strict=True)):
            kind, e = self.kind[i], self.e[i]
            if kind == OPEN:
                kind = STICK if y[i, 0] < -tol else OPEN
            elif not x[0] > 0:
                kind = OPEN
            elif kind == STICK:
                size = float(np.linalg.norm(x[1:]))
                if size > n:
                    kind, e[:-1], e[-1] = SLIP, x[1:] / size, n / size
            else:
                against, size = float(y[i, 1:] @ e[:-1]), 0.0
                if self.m > 1:
                    z = x[1:] - y[i, 1:] / w[i, 1]
                    size = float(np.linalg.norm(z))
                    if size > 0:
                        e[:-1], e[-1] = z / size, min(1.0, n / size)
                if mu[i] > 0 and against > tol and (self.m == 1 or size < n):
                    kind = STICK
            self.kind[i] = kind

    def _sweep(self, W: Array, q: Array, mu: Array, sweeps: int) -> None:
        """Projected Gauss-Seidel from the present normal forces on."""
        k, s = len(mu), 1 + self.m
        x = np.where(np.isfinite(self.x) & (self.x[:, :1] > 0), self.x, 0.0)
        w = W.diagonal().reshape(k, s)
        flat = x.ravel()
        for _ in range(sweeps):
            self.tally[1] += 1
            before = x.copy()
            for i in range(k):
                rows = W[i * s : (i + 1) * s]
                x[i, 0] = max(0.0, x[i, 0] - (rows[0] @ flat + q[i * s]) / w[i, 0])
                scale = w[i, 1:].max() + (abs(rows[1, i * s + 2]) if self.m > 1 else 0.0)
                x[i, 1:] -= (rows[1:] @ flat + q[i * s + 1 : (i + 1) * s]) / scale
                size, most = float(np.linalg.norm(x[i, 1:])), mu[i] * x[i, 0]
                if size > most:
                    x[i, 1:] *= most / size
            if np.abs(x - before).max() <= STILL * x[:, 0].max():
                break
        self.x[:] = x
        self._set_kinds(mu)
        if self.m > 1:
            self._classify(w, (W @ x.ravel() + q).reshape(k, s), mu, 0.0)

    def _wrong(self, W: Array, q: Array, mu: Array) -> float:
        """How far the forces are from the law, as a gap [m]."""
        x, w = self.x, W.diagonal().reshape(self.x.shape)
        y = (W @ x.ravel() + q).reshape(x.shape)
        z = x[:, 1:] - y[:, 1:] / w[:, 1:2]
        size, most = np.linalg.norm(z, axis=1), mu * np.maximum(x[:, 0], 0.0)
        z *= np.where(size > most, most / np.where(size > 0, size, 1.0), 1.0)[:, None]
        normal = np.abs(x[:, 0] - np.maximum(0.0, x[:, 0] - y[:, 0] / w[:, 0])) * w[:, 0]
        return float(max(normal.max(initial=0.0), (np.abs(x[:, 1:] - z) * w[:, 1:2]).max(initial=0.0)))
