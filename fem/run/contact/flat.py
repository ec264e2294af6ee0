"""Contact before half-spaces, whose normals stay: `contact.c` looks at the gaps and takes the forces in.

Every pair of half-space and node keeps its row in W = N S^-1 N' from the step in which it first meets, so that the
small problem keeps its factor as long as the set of pressed rows stays. A step that touches costs a pass over the
columns S^-1 N' of the pressed nodes beside the step without contact.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.model.build import Model
from softgrasp.fem.obstacles import HalfSpace
from softgrasp.fem.obstacles.compiled import contact_library
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.contact.general import MOST, ROUNDING, STILL, Contact, unsettled
from softgrasp.fem.run.contact.rows import Ints, Rows
from softgrasp.fem.run.hand import HandStep
from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState
from softgrasp.fem.run.motion import Driven

KINDS = {np.dtype(float): "double[]", np.dtype(np.intc): "int[]", np.dtype(bool): "char[]"}
"""Types in C."""


class FlatContact(Contact):
    """`Contact` of one run with half-spaces; there must be a compiler."""

    def __init__(self, model: Model, midpoint: TissueMidpoint, steps: int, hand: HandStep | None) -> None:
        super().__init__(model, midpoint, steps, hand)
        self.ffi, self.c = contact_library()
        shapes = [o.shape for o in self.obstacles]
        self.normals = np.array([s.normal for s in shapes if isinstance(s, HalfSpace)])
        self.along = self._axes()
        self.offsets = np.array([s.offset for s in shapes if isinstance(s, HalfSpace)])
        self.moving = [(i, o) for i, o in enumerate(self.obstacles) if o.path is not None]
        self.x = np.zeros(0)
        self.f, self.arrays, self.reached = self.ffi.new("Flat *"), dict[str, NDArray[Any]](), self.ffi.new("double *")
        self._describe()
        self.row, self.W, self.pressed = np.zeros((0, 4), np.intc), np.zeros((0, 0)), False
        self._grow(16, 0)

    def _axes(self) -> Array:
        """Directions of the rows of a pair, the normal first, (obstacles, rows, d)."""
        return self.normals[:, None]

    def _describe(self) -> None:
        """Fill the struct of `contact.c`."""
        m, f, table, (obstacles, d), size = self.midpoint, self.f, self.table, self.normals.shape, self.p * self.d
        at = np.full(size, -1, np.intc)
        if self.surface.B is None:
            at[self.order] = self.places
        f.p, f.d, f.n_s, f.obstacles, f.m = self.p, d, self.layout.n_s, obstacles, self.along.shape[1] - 1
        f.n, f.whole, f.k = len(m.w_array), at.min(initial=0) >= 0, 0
        self.v, self.q, self.qdot = np.zeros(size), np.zeros(f.n_s), np.zeros(f.n_s)
        self.level, self.rate, self.least = self.offsets.copy(), np.zeros((obstacles, d)), np.zeros(obstacles)
        self.q0, self.slide = np.zeros(f.n_s), np.zeros((obstacles, d))
        self.gaps, self.after = np.zeros((2, obstacles, self.p))
        self.entered = np.zeros((obstacles, self.p), dtype=bool)
        self._point(
            X=self.surface.X, T=np.ascontiguousarray(self.surface.T), along=np.ascontiguousarray(self.along), at=at,
            w=m.w_array, r=m.r_array, z=self.z, moved=self.moved, v=self.v, q=self.q, qdot=self.qdot, q0=self.q0,
            slide=self.slide, level=self.level, rate=self.rate, gap=self.gaps, after=self.after,
            entered=self.entered, least=self.least, force=table.force, touching=table.touching, hand=table.hand,
            gaps=table.gap, energy=table.energy,
        )  # fmt: skip

    def _point(self, **arrays: NDArray[Any]) -> None:
        """Let fields of the struct point at arrays, which are kept."""
        for name, array in arrays.items():
            setattr(self.f, name, self.ffi.from_buffer(KINDS[array.dtype], array))
            self.arrays[name] = array

    # ---- the run

    def start(self, state: TissueState, q: Array, n: int = 0) -> None:
        """See :meth:`Contact.start`. Collective."""
        z, gaps, whole = self.z, self.gaps, self.f.whole
        super().start(state, q, n)
        z[:], self.moved[:], self.q[:], self.f.whole = self.z, 0.0, q, False
        self._place(n)
        self.c.softgrasp_look(self.f)  # the bits of a run that is not restarted here
        gaps[:], self.z, self.gaps, self.f.whole = self.after, z, gaps, whole

    def _place(self, n: int) -> None:
        """Put moving half-spaces where they are at step n."""
        for i, obstacle in self.moving:
            self.level[i] = self.offsets[i] + float(self.normals[i] @ obstacle.shift(n * self.dt))
            self.rate[i] = obstacle.rate(n * self.dt)
            self.slide[i] = obstacle.shift(n * self.dt) - obstacle.shift((n - 1) * self.dt)

    def _look(self, n: int) -> float:
        """Gaps at the end of step n, with the tolerance of their rounding. Collective."""
        assert self.drive is not None
        if not self.f.whole:
            self.moved[:] = self._take(self.midpoint.w_array)
        self.q[:] = self.drive.q[n + 1]
        self.tol = ROUNDING * (float(self.c.softgrasp_look(self.f)) + self.layout.extent)
        return self.tol

    def press(self, n: int, drive: Driven) -> None:
        """See :meth:`Contact.press`. Collective."""
        self.n, self.drive, self.q0[:] = n, drive, drive.q[n]
        self._place(n + 1)
        tol = self._look(n)
        self.pressed = bool((self.least < 0).any())
        if not self.pressed:
            return
        self.c.softgrasp_begin(self.f)
        self._settle_flat(n, tol, drive)
        self._add_between()
        self.c.softgrasp_account(self.f, n)

    def _settle_flat(self, n: int, tol: float, drive: Driven) -> None:
        """Forces of the step, by rounds in which rows enter. Collective."""
        c, f, responses = self.c, self.f, self.responses
        if c.softgrasp_missing(f, 0.0, self.reached):
            self._enter(np.argwhere((self.after < 0) & ~self.entered))
        for _ in range(MOST):
            x = self._balance(tol / 4)
            c.softgrasp_apply(f, responses.count, self.ffi.from_buffer("double[]", x))
            self._push_hand(n, self.change[: responses.count], drive)
            self._look(n)
            if c.softgrasp_missing(f, tol, self.reached):
                self._enter(np.argwhere((self.after < -tol) & ~self.entered))
            elif self.reached[0] <= tol:
                self.midpoint.w.stateIncrease()
                self.midpoint.r.stateIncrease()
                return
            else:
                self._refresh()  # what rounding left
        raise unsettled(float(self.reached[0]))

    def _balance(self, tol: float) -> Array:
        """Forces of the rows that leave no gap below -tol."""
        return self.small.solve(self.f.k, self.W, self.free, tol)

    def _enter(self, pairs: Ints) -> None:
        """Give pairs of half-space and node, (m, 2), their rows in W. Collective."""
        each = self.along.shape[1]
        have, k = len(self.row), len(self.row) + each * len(pairs)
        keys = [(int(i), number) for o, i in pairs for number in self.numbers[o]]
        self.responses.enter(keys)
        columns = [[self.responses.where[key], j % each] for j, key in enumerate(keys)]
        self.row = np.ascontiguousarray(np.vstack([self.row, np.hstack([np.repeat(pairs, each, 0), columns])]), np.intc)
        self.entered[pairs[:, 0], pairs[:, 1]] = True
        if k > len(self.W):
            self._grow(max(16, 2 * k), have)
        self.f.k = k
        self._point(row=self.row, columns=self.responses.columns.T)
        every = self.row[:, 2]
        G = self.responses.G[np.ix_(every, every[have:])]
        self.W[:k, have:k], self.W[have:k, :k] = G, G.T
        self._refresh()

    def _grow(self, size: int, have: int) -> None:
        """Room for rows, beside the first ones."""
        W, x = np.zeros((size, size)), np.zeros(size)
        W[:have, :have] = self.W[:have, :have]
        x[:have] = self.x[:have]
        self.W, self.x, self.free, self.stops, self.change = W, x, *np.zeros((3, size))
        self._point(x=self.x, free=self.free, b=self.stops, change=self.change)

    def _refresh(self) -> None:
        """Gaps of the rows without their forces, from the gaps with them."""
        k = len(self.row)
        self.c.softgrasp_values(self.f, self.ffi.from_buffer("double[]", self.free))
        self.free[:k] -= self.W[:k, :k] @ self.x[:k]

    def finish(self, state: TissueState) -> None:
        """See :meth:`Contact.finish`. Collective."""
        self.c.softgrasp_carry(self.f, self.n, self.pressed)
        if self.surface.B is not None:
            self._carry_between(state)
        if not self.pressed:
            return
        assert self.drive is not None
        n = self.n + 1
        self.midpoint.r.stateIncrease()
        self.v[:], self.qdot[:] = self.surface.gather(state.v.array_r), self.drive.v[n]
        self.reached[0] = self.fastest
        most = self.c.softgrasp_rates(self.f, self.reached)
        self.fastest = self.reached[0]
        still = max(STILL * self.fastest, self.s * self.tol)
        if most > still:
            self._halt_flat(state, n, still)

    def _add_between(self) -> None:
        """Give r the forces on points, which are not on single unknowns. Collective."""
        if self.surface.B is not None:
            self.forces = self.pressing().ravel()
            self._add_to_r()

    def _carry_between(self, state: TissueState) -> None:
        """Carry the points on to the bits that a restart finds, and r with them. Collective."""
        self.z[:], self.moved[:] = self.surface.gather(state.z.array_r), 0.0
        self.c.softgrasp_look(self.f)
        self.gaps[:], self.table.gap[self.n + 1] = self.after, self.least
        if self.pressed:
            self._add_to_r()

    def _halt_flat(self, state: TissueState, n: int, still: float) -> None:
        """The impulse on pressed rows, one of which is faster than ``still``. Collective."""
        rows = self._pressed_rows()
        assert self.drive is not None
        self.strike.stop(state, self.drive, n, rows.obstacle, rows.node, rows.normal, self.stops[: len(rows.node)])

    def _pressed_rows(self) -> Rows:
        on = np.flatnonzero(self.x[: len(self.row)] > 0)
        obstacle, node, *_ = self.row[on].T
        return Rows(obstacle.astype(np.intp), node.astype(np.intp), self.normals[obstacle], self.x[on])

    def pressing(self) -> Array:
        """See :meth:`Contact.pressing`."""
        forces = np.zeros((self.p, self.d))
        if self.pressed:
            rows = self._pressed_rows()
            np.add.at(forces, rows.node, rows.forces())
        return forces

    def _sets(self) -> list[NDArray[Any]]:
        """See :meth:`Contact._sets`: the rows in their order, and the set with its factor."""
        m = len(self.small.active)
        return [self._pairs().ravel(), self.small.active, self.small.L[:m, :m].ravel()]

    def _pairs(self) -> Ints:
        """Pairs of half-space and node, (m, 2), in the order of their rows."""
        return self.row[:: self.along.shape[1], :2].astype(np.intp)

    def _resume(self, sets: list[Array]) -> None:
        """See :meth:`Contact._resume`. Collective."""
        rows, order, L = sets
        self._enter(rows.reshape(-1, 2).astype(int))
        self.small.resume(order.astype(int), L, len(self.W))
