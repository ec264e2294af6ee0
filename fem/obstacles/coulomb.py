"""The contact problem of a step with Coulomb friction, W = N S^-1 N' with rows n and t of every node.

    0 <= x_n,  y_n >= 0,  x_n y_n = 0,   |x_t| <= mu x_n,  x_t = -mu x_n y_t / |y_t| where y_t is not 0,   y = W x + q,

y_t half the slip of the step; a node has one tangent in 2D and two in 3D. Newton's method on the sets open, stick
and slip [AC91]: in 2D it is exact when the sets stay, in 3D the directions of slipping nodes converge with it. Its
factor stays while few rows of the matrix are others, which a small matrix of their own takes in; in 3D Broyden's update
takes in the directions, and rounds that reduce the residual little have it made anew; for many nodes it is in single
precision, unless this leads nowhere. Where the method comes back to sets seen before, sweeps of Gauss-Seidel find
others; then pivots do (`lemke.py`), which in 2D end at a solution but for rounding, and in 3D lead to one by pyramids
with edges nearer and nearer to the slips, or friction that grows. `friction.c` does so; without a compiler NumPy takes
the same rounds, each with a factor of its own.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgetrf, sgetrf

from softgrasp.fem.errors import SolverError
from softgrasp.fem.obstacles.compiled import KINDS, RIDGE, friction_library

Array = NDArray[Any]
OPEN, STICK, SLIP = range(3)
ROUNDS = 0, 40, 60  # of Newton's method, before and after the sweeps, by the number of tangents
SWEEPS = 3000
PAST = 16  # steps of the method that are kept, one more than friction.c says
SINGLE = 100  # nodes from which factors in 3D are in single precision, in half the time
STILL = 1e-14  # change of the forces by a sweep over the largest, at which sweeps end
LITTLE, GROWTH, LEAST = 0.2, 1.4, 1.04  # first coefficient of friction that grows, by how much it does, and must
REFINED = 6  # pyramids, each with edges three times as near to the last directions
NEARLY = 1e-9  # of a force, below which its node slips, or is open [1]
SOLVED, WANTED = 0, 1  # what `softgrasp_rub` says; else the rounds lead nowhere


class Coulomb:
    """The problem with its last solution, sets and factor; the number of nodes may grow.

    Args:
        tangents: of a node.
        engine: "C" or "NumPy"; empty takes C where there is a compiler.

    Attributes:
        x: forces, the normal one and then the tangential ones of every node, (k, 1 + tangents).
        kind: sets of the nodes, (k,).
        e: directions of the forces of slipping nodes, and a number of the method, (k, 1 + tangents).
        tally: rounds and sweeps since the start, and one more number.
    """

    def __init__(self, tangents: int, engine: str = "") -> None:
        self.m = tangents
        self.code: Any = None if engine == "NumPy" else friction_library()
        self.tally = np.zeros(3, np.int64)
        self.x, self.kind, self.e = np.zeros((0, 1 + tangents)), np.zeros(0, np.intc), np.zeros((0, 1 + tangents))
        self.before = np.zeros((0, 1 + tangents))  # forces at which the step before the last ended
        self.had = False  # whether it had any
        self.kind0, self.e0, self.other = np.zeros(0, np.intc), np.zeros((0, 1 + tangents)), np.zeros(0, np.intc)
        self.W, self.arrays = np.zeros((0, 0)), dict[str, NDArray[Any]]()
        self.f: Any = None if self.code is None else self.code[0].new("Rub *")

    @property
    def rounds(self) -> int:
        """Rounds of Newton's method since the start [1]."""
        return int(self.tally[0])

    def fit(self, k: int) -> None:
        """Room for k nodes; those there keep their forces and sets, the factor goes."""
        have, s = min(k, len(self.x)), 1 + self.m
        x, e, kind = np.zeros((k, s)), np.zeros((k, s)), np.full(k, OPEN, np.intc)
        e[:, 0] = 1.0
        x[:have], e[:have], kind[:have] = self.x[:have], self.e[:have], self.kind[:have]
        self.x, self.e, self.kind = x, e, kind
        self.kind0, self.e0, self.before, self.had = kind.copy(), e.copy(), np.zeros_like(x), False
        if self.code is None:
            return
        K, most = k * s, max(6, min(k * s // 6, 24))
        self.other = np.zeros(most, np.intc)
        self.pivot, self.y = np.zeros(K, np.intc), np.zeros(K)
        self._use(self.m > 1 and k >= SINGLE)
        self._point(
            before=self.before, x=self.x, y=self.y, kind=self.kind, e=self.e, pivot=self.pivot,
            kind0=self.kind0, e0=self.e0, other=self.other, Z=np.zeros((most, K)), V=np.zeros((most, K)),
            C=np.zeros((most, most)), room=np.zeros(6 * K + most), past=np.zeros((PAST, K)),
            seen=np.zeros((ROUNDS[self.m], k), np.int8), tally=self.tally,
        )  # fmt: skip
        self.f.k, self.f.m, self.f.most, self.f.rows, self.f.count = k, self.m, most, 0, 0

    def _use(self, single: bool) -> None:
        """Room for a factor in single precision or in double."""
        self.LU, self.f.single, self.f.rows = np.zeros(len(self.pivot) ** 2, np.float32 if single else float), single, 0
        self._point(**{"LU_single" if single else "LU": self.LU})

    def _point(self, **arrays: NDArray[Any]) -> None:
        """Let fields of the struct point at arrays, which are kept."""
        for name, array in arrays.items():
            if self.arrays.get(name) is array:
                continue
            setattr(self.f, name, self.code[0].from_buffer(KINDS[array.dtype], array))
            self.arrays[name] = array

    def forget(self) -> None:
        """Drop the factor, as W is another one now."""
        if self.f is not None:
            self.f.rows = 0

    def solve(self, k: int, W: Array, q: Array, mu: Array, tol: float, first: bool = False) -> Array:
        """Forces x (k, 1 + tangents) of the first k nodes, from the forces and sets of the last call.

        Args:
            W: symmetric, positive definite, rows of a node side by side; contiguous, may have room for more. Its
                factor is kept while the same array comes again: call `forget` where its entries have changed.
            q: half the gap and half the slip without forces, (k (1 + tangents),) [m].
            mu: coefficients of friction, (k,).
            tol: by how much gaps may be negative, and slips of the wrong sign [m].
            first: whether a step begins here: from forces that continue those of the last two steps.

        Raises SolverError: neither rounds nor sweeps find a solution, nor do pivots or friction that grows.
        """
        if k != len(self.kind):
            self.fit(k)
        if not (first and self._lead(W, q, mu, tol)):
            self.kind[(self.kind == OPEN) & (q[:: 1 + self.m] < 0)] = STICK
        if not self._attempt(W, q, mu, tol):
            others = (self._pivot, self._grow) if self.m == 1 else (self._grow, self._pivot)
            if not any(other(W, q, mu, tol) for other in others):
                raise SolverError(
                    f"the friction of {k} nodes has no solution that {SWEEPS} sweeps find; raise time.steps, or use "
                    "less friction"
                )
        return self.x

    def _lead(self, W: Array, q: Array, mu: Array, tol: float) -> bool:
        """Forces that continue those of the last two steps, with their sets and directions; whether there were two."""
        if self.code is None:
            return False
        had, self.had = self.had, bool(self.x.any())
        if not (had and self.had):
            self.before[:] = self.x
            return False
        self._describe(W, q, mu, tol)
        self.code[1].softgrasp_lead(self.f)
        return True

    def _attempt(self, W: Array, q: Array, mu: Array, tol: float) -> bool:
        """Whether rounds and sweeps from the present forces and sets find a solution."""
        return self._in_numpy(W, q, mu, tol) if self.code is None else self._in_c(W, q, mu, tol)

    def _pivot(self, W: Array, q: Array, mu: Array, tol: float) -> bool:
        """Whether the law with pyramids, in 2D the law itself, leads to a solution."""
        from softgrasp.fem.obstacles.lemke import pyramid_forces  # few runs need it

        K, near, turn = len(q), None, math.pi / 4
        for _ in range(1 if self.m == 1 else REFINED):
            x = pyramid_forces(W[:K, :K], q, mu, self.m, near, turn)
            if x is None:
                return False
            self.forget()
            self.x[:] = x
            small = NEARLY * float(np.abs(x).max(initial=0.0))
            if self.m == 1:
                self._set_kinds(mu, small)
                return self._attempt(W, q, mu, tol)
            near = self._set_kinds_by_slip(W[:K, :K], q, mu, small)
            if self._attempt(W, q, mu, tol):
                return True
            turn /= 3
        return False

    def _set_kinds_by_slip(self, W: Array, q: Array, mu: Array, small: float) -> Array:
        """Sets and directions of forces under pyramids, inside the cone where nodes slip too; directions, (k, 2)."""
        y, w = (W @ self.x.ravel() + q).reshape(self.x.shape), W.diagonal().reshape(self.x.shape)[:, 1:2]
        size = np.linalg.norm(y[:, 1:], axis=1)
        slips = (self.x[:, 0] > small) & (size > small * w[:, 0])
        self.kind[:] = np.select([self.x[:, 0] <= small, slips], [OPEN, SLIP], STICK)
        near = np.where(slips[:, None], -y[:, 1:] / np.where(size > 0, size, 1.0)[:, None], np.nan)
        self.e[slips, :-1] = near[slips]
        self.e[slips, -1] = (mu * self.x[:, 0])[slips] / np.linalg.norm(self.x[:, 1:] - y[:, 1:] / w, axis=1)[slips]
        return near

    def _set_kinds(self, mu: Array, small: float = 0.0) -> None:
        """Sets and directions of the present forces, of which ``small`` ones are rounding [N]."""
        sizes = np.linalg.norm(self.x[:, 1:], axis=1)
        inside = sizes < mu * self.x[:, 0] * (1 - NEARLY) - small
        self.kind[:] = np.select([self.x[:, 0] <= small, inside], [OPEN, STICK], SLIP)
        self.e[:] = 0.0
        self.e[:, 0] = 1.0
        on = sizes > 0
        self.e[on, :-1] = self.x[on, 1:] / sizes[on, None]

    def _grow(self, W: Array, q: Array, mu: Array, tol: float) -> bool:
        """Whether solutions under friction that grows up to mu lead to one."""
        self.x[:], self.kind[:] = 0.0, np.where(q[:: 1 + self.m] < 0, STICK, OPEN)
        reached, more = LITTLE / GROWTH, GROWTH
        kept = self.x.copy(), self.kind.copy(), self.e.copy()
        while more > LEAST:
            self.forget()
            if not self._attempt(W, q, np.minimum(mu, reached * more), tol):
                more = math.sqrt(more)
                self.x[:], self.kind[:], self.e[:] = kept
                continue
            if (reached := reached * more) >= mu.max():
                return True
            kept = self.x.copy(), self.kind.copy(), self.e.copy()
        return False

    def _in_c(self, W: Array, q: Array, mu: Array, tol: float) -> bool:
        self._describe(W, q, mu, tol)
        if self._rounds():
            return True
        self.code[1].softgrasp_sweep(self.f, SWEEPS, STILL)
        self.forget()
        kept = self.x.copy(), self.kind.copy(), self.e.copy()
        for single in (True, False) if self.f.single else (False,):
            if self.f.single != single:  # from now on
                self._use(single)
            if self._rounds():
                return True
            self.x[:], self.kind[:], self.e[:] = kept
        self.forget()
        return bool(self.code[1].softgrasp_wrong(self.f) <= tol)

    def _describe(self, W: Array, q: Array, mu: Array, tol: float) -> None:
        """Let the struct have the problem."""
        if W is not self.arrays.get("W"):
            self.forget()
        self._point(W=W, q=q, mu=mu)
        self.f.ld, self.f.tol = W.shape[1], tol

    def _rounds(self) -> bool:
        """Whether Newton's method finds a solution from the present sets."""
        code, f, begin = self.code[1], self.f, 0
        while (end := code.softgrasp_rub(f, begin, ROUNDS[self.m])) == WANTED:
            self._factor()
            begin = int(self.tally[2])
        return bool(end == SOLVED)

    def _factor(self) -> None:
        """The factor of the matrix of the present sets."""
        self.code[1].softgrasp_matrix(self.f)
        if n := int(self.f.size):  # else all nodes are open
            matrix = self.LU[: n * n].reshape(n, n).T
            lu, self.pivot[:n], _ = (sgetrf if self.f.single else dgetrf)(matrix, overwrite_a=True)
            if not np.shares_memory(lu, self.LU):
                matrix[:] = lu

    # ---- restart

    def state(self) -> Array:
        """Numbers from which a run continues with the same bits."""
        count, rows, single = (0, 0, 0) if self.f is None else (self.f.count, self.f.rows, self.f.single)
        head = np.array([len(self.kind), rows, count, *self.tally[:2], self.had, single], dtype=float)
        parts = self.x, self.kind, self.e, self.kind0, self.e0, self.other[:count], self.before
        return np.concatenate([head, *(np.asarray(part, dtype=float).ravel() for part in parts)])

    def resume(self, numbers: Array, W: Array, mu: Array) -> None:
        """Continue with what `state` returned, and the W and mu of the last call."""
        k, rows, count = (int(n) for n in numbers[:3])
        s = 1 + self.m
        self.fit(k)
        self.tally[:2] = numbers[3:5]
        sizes = [k * s, k, k * s, k, k * s, count]
        x, kind, e, kind0, e0, other, before = np.split(numbers[7:], np.cumsum(sizes))
        self.before[:], self.had = before.reshape(k, s), bool(numbers[5])
        self.x[:], self.e[:] = x.reshape(k, s), e.reshape(k, s)
        if self.f is not None:
            self._use(bool(numbers[6]))
        if rows and self.f is not None:
            self._point(W=W, mu=mu)
            self.f.ld = W.shape[1]
            self.kind[:], self.e[:] = kind0, e0.reshape(k, s)
            self._factor()
            self.other[:count], self.f.count = other, count
            self.code[1].softgrasp_units(self.f)
        self.kind[:], self.e[:] = kind, e.reshape(k, s)

    # ---- without a compiler

    def _in_numpy(self, W: Array, q: Array, mu: Array, tol: float) -> bool:
        K = len(q)
        W = W[:K, :K]
        if self._newton(W, q, mu, tol):
            return True
        self._sweep(W, q, mu)
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

    def _sweep(self, W: Array, q: Array, mu: Array) -> None:
        """Projected Gauss-Seidel from the present normal forces on."""
        k, s = len(mu), 1 + self.m
        x = np.where(np.isfinite(self.x) & (self.x[:, :1] > 0), self.x, 0.0)
        w = W.diagonal().reshape(k, s)
        flat = x.ravel()
        for _ in range(SWEEPS):
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
