"""The contact problem of a step with Coulomb friction, W = N S^-1 N' with rows n and t of every node.

    0 <= x_n,  y_n >= 0,  x_n y_n = 0,   |x_t| <= mu x_n,  x_t = -mu x_n y_t / |y_t| where y_t is not 0,   y = W x + q,

y_t half the slip of the step; a node has one tangent in 2D and two in 3D. Newton's method on the sets open, stick
and slip [AC91]: in 2D it is exact when the sets stay, in 3D the directions of slipping nodes converge with it. The
unknowns of its equations are forces of pressed nodes or, once factors have cost as much as W^-1, slips of slipping
nodes, which are fewer; conjugate residuals [EES83] solve them from a factor of earlier sets, until a new one costs
less. For many nodes factors and these steps are in single precision, unless this leads nowhere. Where the method comes
back to sets seen before, or moves the borders of wide sets node by node, a few sweeps of Gauss-Seidel find others from
which it goes on. In 2D an interior point method follows (`interior.py`), then pivots (`lemke.py`), which end at a
solution but for rounding; in 3D friction that grows, then pivots by pyramids with edges nearer and nearer to the slips.
`friction.c` does so; without a compiler NumPy takes the same rounds (`newton.py`), each with a factor of its own.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgetrf, sgetrf

from softgrasp.fem.errors import SolverError
from softgrasp.fem.obstacles.compiled import KINDS, friction_library
from softgrasp.fem.obstacles.inverse import NONE, Inverse
from softgrasp.fem.obstacles.newton import NEARLY, OPEN, ROUNDS, SLIP, STICK, STILL, SWEEPS, Rounds

Array = NDArray[Any]
KEPT = 24  # steps of a round that are kept, as rub.h says
SINGLE = 100  # nodes from which factors in 3D are in single precision, in half the time
LITTLE, GROWTH, LEAST = 0.2, 1.4, 1.04  # first coefficient of friction that grows, by how much it does, and must
REFINED = 6  # pyramids, each with edges three times as near to the last directions
KNOWN = "rows", "slips0", "single", "age", "work", "slips", "had"  # what a restart needs of the struct
HERE, OPENED, FIRST = range(3)  # where rounds begin, see friction.c
SOLVED, WANTED, _, DRIFTED = range(4)  # what `softgrasp_rub` says, see rub.h


class Coulomb(Rounds):
    """The problem with its last solution, sets and factor; the number of nodes may grow.

    Args:
        tangents: of a node.
        engine: "C" or "NumPy"; empty takes C where there is a compiler.
        inverse: of W, shared with other problems of the same W.

    Attributes:
        x: forces, the normal one and then the tangential ones of every node, (k, 1 + tangents).
        y: W x + q, (k, 1 + tangents).
        kind: sets of the nodes, (k,).
        e: directions of the forces of slipping nodes, and a number of the method, (k, 1 + tangents).
        tally: rounds and sweeps since the start, and one more number.
    """

    def __init__(self, tangents: int, engine: str = "", inverse: Inverse | None = None) -> None:
        self.m, self.inverse = tangents, inverse or Inverse()
        self.code: Any = None if engine == "NumPy" else friction_library(tangents)
        self.tally = np.zeros(3, np.int64)
        self.arrays = dict[str, NDArray[Any]]()
        self.f: Any = None if self.code is None else self.code[0].new("Rub *")
        self.x = self.y = self.e = np.zeros((0, 1 + tangents))
        self.kind = np.zeros(0, np.intc)
        self.fit(0)

    @property
    def rounds(self) -> int:
        """Rounds of Newton's method since the start [1]."""
        return int(self.tally[0])

    def fit(self, k: int) -> None:
        """Room for k nodes; those there keep their forces and sets, the factor goes."""
        have, s = min(k, len(self.x)), 1 + self.m
        x, y, e, kind = np.zeros((k, s)), np.zeros((k, s)), np.zeros((k, s)), np.full(k, OPEN, np.intc)
        e[:, 0] = 1.0
        x[:have], e[:have], kind[:have] = self.x[:have], self.e[:have], self.kind[:have]
        self.x, self.y, self.e, self.kind = x, y, e, kind
        self.kind0, self.e0 = kind.copy(), e.copy()
        self.before, self.before_y = np.zeros((k, s)), np.zeros((k, s))
        if self.code is None:
            return
        K = k * s
        self.pivot, self.q, self.mu = np.zeros(K, np.intc), np.zeros(K), np.zeros(k)
        self._use(self.m > 1 and k >= SINGLE)
        self._point(
            before=self.before, before_y=self.before_y, x=x, y=y, kind=kind, e=e, pivot=self.pivot, kind0=self.kind0,
            q=self.q, mu=self.mu, e0=self.e0, solved=np.zeros(K), lacks=np.zeros(K), follows=np.zeros(K),
            base=np.zeros(K), Z=np.zeros((KEPT, K)), C=np.zeros((KEPT, K)), V=np.zeros((KEPT, K)), room=np.zeros(8 * K),
            seen=np.zeros((ROUNDS[self.m], k), np.int8), tally=self.tally,
        )  # fmt: skip
        self.f.k, self.f.rows, self.f.slips, self.f.had, self.f.based = k, 0, 0, 0, 0

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
        """Drop the factor and the inverse, as W is another one now."""
        self.inverse.forget()
        if self.f is not None:
            self.f.rows = 0

    def solve(
        self, k: int, W: Array, q: Array, mu: Array, tol: float, first: bool = False, known: bool = False
    ) -> Array:
        """Forces x (k, 1 + tangents) of the first k nodes, from the forces and sets of the last call.

        Args:
            W: symmetric, positive definite, rows of a node side by side; contiguous, may have room for more. Its
                factor is kept while the same array comes again: call `forget` where its entries have changed.
            q: half the gap and half the slip without forces, (k (1 + tangents),) [m]; or ``self.q`` that C has filled.
            mu: coefficients of friction, (k,).
            tol: by how much gaps may be negative, and slips of the wrong sign [m].
            first: whether a step begins here: from forces that continue those of the last two steps.
            known: whether y is that of x already.

        Raises SolverError: neither rounds nor sweeps find a solution, nor does what follows them.
        """
        if k != len(self.kind):
            self.fit(k)
        if not self._attempt(W, q, mu, tol, FIRST if first else OPENED, known):
            others = (self._go_inside, self._pivot, self._grow) if self.m == 1 else (self._grow, self._pivot)
            if not any(other(W, q, mu, tol) for other in others):
                raise SolverError(
                    f"no solution was found for the friction of {k} nodes; raise time.steps, or use less friction"
                )
        return self.x

    def _attempt(self, W: Array, q: Array, mu: Array, tol: float, where: int = HERE, known: bool = False) -> bool:
        """Whether rounds and sweeps from the present forces and sets find a solution."""
        if self.code is not None:
            return self._in_c(W, q, mu, tol, where, known)
        if where != HERE:
            self.kind[(self.kind == OPEN) & (q[:: 1 + self.m] < 0)] = STICK
        found = self._in_numpy(W, q, mu, tol)
        self.y[:] = (W[: len(q), : len(q)] @ self.x.ravel() + q).reshape(self.y.shape)
        return found

    def _go_inside(self, W: Array, q: Array, mu: Array, tol: float) -> bool:
        """Whether sets of an interior point method lead to a solution."""
        from softgrasp.fem.obstacles.interior import interior_sets  # few runs need it

        K = len(q)
        if (found := interior_sets(W[:K, :K], q, mu)) is None:
            return False
        self.x[:], self.kind[:] = found
        self.e[:, 0], self.e[:, 1] = np.where(self.x[:, 1] < 0, -1.0, 1.0), 0.0
        return self._attempt(W, q, mu, tol)

    def _pivot(self, W: Array, q: Array, mu: Array, tol: float) -> bool:
        """Whether the law with pyramids, in 2D the law itself, leads to a solution."""
        from softgrasp.fem.obstacles.lemke import pyramid_forces  # few runs need it

        K, near, turn = len(q), None, math.pi / 4
        for _ in range(1 if self.m == 1 else REFINED):
            x = pyramid_forces(W[:K, :K], q, mu, self.m, near, turn)
            if x is None:
                return False
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

    def _grow(self, W: Array, q: Array, mu: Array, tol: float) -> bool:
        """Whether solutions under friction that grows up to mu lead to one."""
        self.x[:], self.kind[:] = 0.0, np.where(q[:: 1 + self.m] < 0, STICK, OPEN)
        reached, more = LITTLE / GROWTH, GROWTH
        kept = self.x.copy(), self.kind.copy(), self.e.copy()
        while more > LEAST:
            if not self._attempt(W, q, np.minimum(mu, reached * more), tol):
                more = math.sqrt(more)
                self.x[:], self.kind[:], self.e[:] = kept
                continue
            if (reached := reached * more) >= mu.max():
                return True
            kept = self.x.copy(), self.kind.copy(), self.e.copy()
        return False

    def _in_c(self, W: Array, q: Array, mu: Array, tol: float, where: int, known: bool) -> bool:
        self._describe(W, q, mu, tol)
        kept = self.x.copy(), self.kind.copy(), self.e.copy()
        end = self._rounds(where, known)
        if end == DRIFTED:
            self._refuse()
            self.x[:], self.kind[:], self.e[:] = kept
            end = self._rounds(min(where, OPENED))
        for sweeps in SWEEPS[self.m] if end != SOLVED else ():
            self.code[1].softgrasp_sweep(self.f, sweeps, STILL)
            kept = self.x.copy(), self.kind.copy(), self.e.copy()
            self.f.rows = 0
            if (end := self._rounds()) == SOLVED:
                break
        if end != SOLVED and self.f.single:  # in double precision from now on
            self.x[:], self.kind[:], self.e[:] = kept
            self._use(False)
            self._matrices()
            end = self._rounds()
        if end == SOLVED:
            return True
        self.x[:], self.kind[:], self.e[:] = kept
        self.f.rows = 0
        return bool(self.code[1].softgrasp_wrong(self.f) <= tol)

    def _describe(self, W: Array, q: Array, mu: Array, tol: float) -> None:
        """Let the struct have the problem."""
        self.inverse.of(W, len(q))
        if q is not self.q:
            self.q[:], self.f.based = q, 0
        self.mu[:], self.f.tol = mu, tol
        if W is not self.arrays.get("W"):
            self._point(W=W)
            self.f.rows, self.f.ld = 0, W.shape[1]
        elif self.inverse.made is self.arrays.get("inverse"):
            return
        self._matrices()

    def _matrices(self) -> None:
        """Let the struct have W^-1 and both matrices in single precision, where they are."""
        made, self.f.sure = self.inverse.made, self.inverse.error
        low = (self.inverse.single(False), self.inverse.single(True)) if self.f.single else (NONE, NONE)
        for name, array in (("inverse", made), ("low", low[0]), ("inverse_low", low[1])):
            if len(array):
                self._point(**{name: array})
            elif array is not self.arrays.get(name):
                setattr(self.f, name, self.code[0].NULL)
                self.arrays[name] = array

    def _refuse(self) -> None:
        """Do without W^-1."""
        self.inverse.refuse()
        self._matrices()

    def _rounds(self, where: int = HERE, known: bool = False) -> int:
        """How Newton's method from the present forces and sets ends."""
        code, f, begin = self.code[1], self.f, 0
        code.softgrasp_begin(f, where, known)
        while (end := code.softgrasp_rub(f, begin, ROUNDS[self.m])) == WANTED:
            self._factor()
            begin = int(self.tally[2])
        return int(end)

    def _factor(self) -> None:
        """The factor of the matrix of the present sets."""
        done = self.code[1].softgrasp_matrix(self.f)
        if (n := int(self.f.size)) and not done:  # without unknowns all is known
            matrix = self.LU[: n * n].reshape(n, n).T
            lu, self.pivot[:n], _ = (sgetrf if self.f.single else dgetrf)(matrix, overwrite_a=True)
            if not np.shares_memory(lu, self.LU):
                matrix[:] = lu
            if not self.f.slips:
                self.inverse.add(n)

    # ---- restart

    def state(self) -> Array:
        """Numbers from which a run continues with the same bits."""
        known = [0 if self.f is None else getattr(self.f, name) for name in KNOWN]
        inverse = self.inverse.k, self.inverse.spent, len(self.inverse.made)
        head = np.array([len(self.kind), *inverse, *self.tally[:2], *known], dtype=float)
        parts = self.x, self.y, self.kind, self.e, self.kind0, self.e0, self.before, self.before_y
        return np.concatenate([head, *(np.asarray(part, dtype=float).ravel() for part in parts)])

    def resume(self, numbers: Array, W: Array, mu: Array) -> None:
        """Continue with what `state` returned, and the W and mu of the last call."""
        head, numbers = np.split(numbers, [6 + len(KNOWN)])
        k, s, spent, (rows, slips0, single, age, work, slips, had) = int(head[0]), 1 + self.m, head[2], head[6:]
        self.fit(k)
        self.tally[:2] = head[4:6]
        arrays: tuple[NDArray[Any], ...]
        arrays = self.x, self.y, self.kind, self.e, self.kind0, self.e0, self.before, self.before_y
        parts = np.split(numbers, np.cumsum([array.size for array in arrays]))
        for i, array in enumerate(arrays):
            array[:] = parts[i].reshape(array.shape)
        if self.f is None or not k:
            return
        self.f.slips, self.f.had = int(slips), int(had)
        self._use(bool(single))
        if head[1] != k * s:  # nodes came since, of which the next call makes a new factor
            return
        self.inverse.of(W, k * s)
        self.inverse.spent = spent
        if head[3]:
            self.inverse.make()
        self._point(W=W)
        self.mu[:], self.f.ld = mu, W.shape[1]
        self._matrices()
        if rows and (len(self.inverse.made) or not slips0):  # else W was refused an inverse since
            kind, e = self.kind.copy(), self.e.copy()
            self.kind[:], self.e[:], self.f.slips = self.kind0, self.e0, int(slips0)
            self._factor()
            self.kind[:], self.e[:], self.f.slips = kind, e, int(slips)
            self.inverse.spent, self.f.age, self.f.work = spent, int(age), work
