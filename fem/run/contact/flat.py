"""Contact before half-spaces, whose normals stay: `contact.c` looks at the gaps and takes the forces in.

Every pair of half-space and node keeps its row in W = N S^-1 N' from the step in which it first meets, so that the
small problem keeps its factor as long as the set of pressed rows stays. With a Cholesky in blocks, S^-1 = B F, a step
that touches is one solve: between its sweeps the gaps of these rows are known, N w = (F N')'D F r, and the forces
enter, F r + F N'x (`softgrasp.fem.solve.sweeps`). With other solvers a step costs a pass over the columns S^-1 N' of
the pressed nodes beside the step without contact.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.errors import SolverError
from softgrasp.fem.model.build import Model
from softgrasp.fem.obstacles import HalfSpace
from softgrasp.fem.obstacles.compiled import BALANCE, DONE, ENTER, KINDS, SOLVE, SWEEP, TAKE, UNSETTLED, contact_library
from softgrasp.fem.obstacles.responses import Responses
from softgrasp.fem.obstacles.swept import SweptColumns, SweptResponses
from softgrasp.fem.petsc import Array, PETSc, total
from softgrasp.fem.run.contact.general import MOST, ROUNDING, STILL, Contact, unsettled
from softgrasp.fem.run.contact.rows import Ints, Rows
from softgrasp.fem.run.contact.stops import Stops
from softgrasp.fem.run.contact.touching import Touching
from softgrasp.fem.run.hand import HandStep
from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState
from softgrasp.fem.run.motion import Driven
from softgrasp.fem.solve.sweeps import sweeps_of

READS = 2  # of every entry of the factor by a solve


class FlatContact(Contact):
    """`Contact` of one run with half-spaces; there must be a compiler."""

    def __init__(self, model: Model, midpoint: TissueMidpoint, steps: int, hand: HandStep | None) -> None:
        self.ffi, self.c = contact_library()
        self.f, self.arrays = self.ffi.new("Flat *"), dict[str, NDArray[Any]]()
        super().__init__(model, midpoint, steps, hand)
        shapes = [o.shape for o in self.obstacles]
        self.normals = np.array([s.normal for s in shapes if isinstance(s, HalfSpace)])
        self.along = np.ascontiguousarray(self._axes())
        self.offsets = np.array([s.offset for s in shapes if isinstance(s, HalfSpace)])
        self.moving = [(i, o) for i, o in enumerate(self.obstacles) if o.path is not None]
        self.x = np.zeros(0)
        self.alone = self.layout.comm.size == 1 and self.surface.B is None
        self._describe()
        self._describe_hand()
        self.row, self.W, self.stops = np.zeros((0, 4), np.intc), np.zeros((0, 0)), Stops(self)
        self._grow(16, 0)

    @property
    def fastest(self) -> float:
        """Largest velocity of a boundary node in a step with contact [m/s]."""
        return float(self.f.fastest)

    @fastest.setter
    def fastest(self, speed: float) -> None:
        self.f.fastest = speed

    def _make_responses(self) -> Responses:
        """See :meth:`Contact._make_responses`: first sweeps alone, where one rank has the whole factor. Collective."""
        made, solver = super()._make_responses(), self.midpoint.solver
        self.sweeps = sweeps_of(solver, self.d) if self.whole and self.surface.B is None else None
        if self.sweeps is None:
            return made
        columns = SweptColumns(self.sweeps.D, (self.ffi, self.c))
        swept = SweptResponses(made.directions, self._respond_ahead, made.size, made.reach, columns)
        self.swept = PETSc.Vec().createWithArray(swept.y, comm=PETSc.COMM_SELF)
        return swept

    def _respond_ahead(self, forces: Array) -> Array:
        """F of forces (p d, k) on the boundary."""
        b = np.zeros((len(self.b.array_r), forces.shape[1]), order="F")
        b[self.places] = forces[self.order]
        return self._ahead(b)

    def _ahead(self, b: Array) -> Array:
        """F b of columns (n, k)."""
        assert self.sweeps is not None
        y = np.empty(b.shape, order="F")
        for j in range(b.shape[1]):
            self.b.array_w[:] = b[:, j]
            self.sweeps.forward(self.b, self.y)
            y[:, j] = self.y.array_r
        return y

    def _axes(self) -> Array:
        """Directions of the rows of a pair, the normal first, (obstacles, rows, d)."""
        return self.normals[:, None]

    def _describe(self) -> None:
        """Fill the struct of `flat.h`."""
        m, f, table, (obstacles, d), size = self.midpoint, self.f, self.table, self.normals.shape, self.p * self.d
        at = np.full(size, -1, np.intc)
        if self.surface.B is None:
            at[self.order] = self.places
        f.p, f.d, f.n_s, f.obstacles, f.m = self.p, d, self.layout.n_s, obstacles, self.along.shape[1] - 1
        f.n, f.here, f.whole = len(m.w_array), self.layout.n_local, at.min(initial=0) >= 0
        f.dt, f.s, f.extent, f.rounding, f.at_rest = self.dt, self.s, self.layout.extent, ROUNDING, STILL
        solved = m.solver.entries if self.surface.B is None else None
        f.entries = np.inf if solved is None else READS * solved
        f.most, f.most_each, f.compiled = MOST, self.small.most, f.m == 0 and self.surface.B is None
        self.v, self.q = np.zeros(size), np.zeros(f.n_s)
        self.level, self.rate, self.least = self.offsets.copy(), np.zeros((obstacles, d)), np.zeros(obstacles)
        self.slide = np.zeros((obstacles, d))
        self.gaps, self.after = np.zeros((2, obstacles, self.p))
        self.entered = np.zeros((obstacles, self.p), dtype=bool)
        rows = self.surface.rows.astype(np.intc) if self.alone else np.zeros(0, np.intc)
        self.point(
            X=self.surface.X, T=np.ascontiguousarray(self.surface.T), along=self.along, at=at, rows=rows,
            modes=np.ascontiguousarray(self.surface.T.T), places=np.zeros(size),
            w=m.w_array, r=m.r_array, z=self.z, low=self.low, moved=self.moved, v=self.v, q=self.q,
            slide=self.slide, level=self.level, rate=self.rate, gap=self.gaps, after=self.after,
            entered=self.entered, least=self.least, lately=table.lately, force=table.force, impulse=table.impulse,
            touching=table.touching, chattering=table.chattering, hand=table.hand, kick=table.kick, gaps=table.gap,
            energy=table.energy,
        )  # fmt: skip

    def _describe_hand(self) -> None:
        """The same of a hand that feels the tissue."""
        hand, f = self.hand, self.f
        f.feels = hand is not None
        self.pulled = np.zeros(f.n_s)
        if hand is not None:
            f.kappa = hand.kappa
            self.point(
                Y=np.ascontiguousarray(self.midpoint.Y.T), G=np.ascontiguousarray(self.midpoint.G.T),
                inverse=np.ascontiguousarray(hand.inverse), pulled=self.pulled,
            )  # fmt: skip

    def point(self, **arrays: NDArray[Any]) -> None:
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
        self.point(q=self.q, q0=self.q)
        self.f.largest = self.c.softgrasp_look(self.f)  # the bits of a run that is not restarted here
        gaps[:], self.z, self.gaps, self.f.whole = self.after, z, gaps, whole
        self.table.gap[n] = self.least

    def _place(self, n: int) -> None:
        """Put moving half-spaces where they are at step n."""
        for i, obstacle in self.moving:
            self.level[i] = self.offsets[i] + float(self.normals[i] @ obstacle.shift(n * self.dt))
            self.rate[i] = obstacle.rate(n * self.dt)
            self.slide[i] = obstacle.shift(n * self.dt) - obstacle.shift((n - 1) * self.dt)

    def press(self, n: int, drive: Driven) -> None:
        """See :meth:`Contact.press`. Collective."""
        f, step = self.f, self.c.softgrasp_step
        if drive is not self.drive:
            self.point(qs=drive.q, vs=drive.v, cs=drive.c)
        self.n, self.drive = n, drive
        self._place(n + 1)
        f.stage = 0
        while (wanted := step(f, n)) != DONE:
            if wanted == TAKE:
                self.moved[:] = self._take(self.midpoint.w_array)
            elif wanted == ENTER:
                self._enter(np.argwhere((self.after < -f.depth) & ~self.entered))
            elif wanted == BALANCE:
                self._balance(f.tol / 4)
            elif wanted == SOLVE:
                self._solve()
            elif wanted == SWEEP:
                self._sweep()
            else:
                raise unsettled(f.reached) if wanted == UNSETTLED else SolverError(self.small.unsolved(f.k))
        if not f.pressed:
            return
        self.midpoint.w.stateIncrease()
        self.midpoint.r.stateIncrease()
        self.midpoint.c = drive.c[n]
        if self.surface.B is not None:  # the forces on points are not on single unknowns
            self.forces = self.pressing().ravel()
            self._add_to_r()

    def _solve(self) -> None:
        """Take the changes of the forces into w by one more solve. Collective."""
        f = self.responses.forces(self.change[: self.responses.count])
        self.b.array_w[:] = 0.0
        self.b.array_w[self.places] = f[self.order]
        self.midpoint.solver.solve(self.b, self.y)
        self.midpoint.w.axpy(1.0, self.y)

    def lead(self) -> None:
        """See :meth:`Contact.lead`."""
        if not self.f.swept or self.f.ahead:
            return
        sweeps, y = self.sweeps, self.swept
        assert sweeps is not None
        assert isinstance(self.midpoint, Touching)
        self.f.ahead = True
        self.midpoint.solve_by(lambda r, w: sweeps.forward(r, y))
        if self.hand is not None:
            self.hand.feel_before()

    def _sweep(self) -> None:
        """Take y into w by the second sweep."""
        assert self.sweeps is not None
        assert isinstance(self.responses, SweptResponses)
        if self.f.ahead:
            self.sweeps.backward(self.swept, self.midpoint.w)
            return
        self.sweeps.backward(self.swept, self.y)
        self.midpoint.w.axpy(1.0, self.y)
        self.responses.y[:] = 0.0

    def _balance(self, tol: float) -> None:
        """Find forces of the rows that leave no gap below -tol."""
        self.point(to=self.small.solve(self.f.k, self.W, self.free, tol))

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
        self.f.k, self.f.count_columns = k, self.responses.count
        self.point(row=self.row, B=self.responses.B)
        if not isinstance(self.responses, SweptResponses):
            self.point(columns=self.responses.columns.T)
        elif not self.f.swept:
            self.f.swept = self.responses.swept.f
            if self.hand is not None:
                self.point(Y=np.ascontiguousarray(self._ahead(self.midpoint.G).T))
        every = self.row[:, 2]
        G = self.responses.G[np.ix_(every, every[have:])]
        self.W[:k, have:k], self.W[have:k, :k] = G, G.T
        self.c.softgrasp_refresh(self.f)
        self.stops.extend()

    def _grow(self, size: int, have: int) -> None:
        """Room for rows, beside the first ones."""
        W, x = np.zeros((size, size)), np.zeros(size)
        W[:have, :have] = self.W[:have, :have]
        x[:have] = self.x[:have]
        self.W, self.x, self.free, self.rates, self.struck, self.change = W, x, *np.zeros((4, size))
        self.point(W=W, x=x, free=self.free, b=self.rates, y=self.struck, change=self.change)
        self.f.ld = size
        self.stops.grow(size)
        self._fit(size)

    def _fit(self, size: int) -> None:
        """Room of the small problem."""
        small = self.small
        small.fit(size)
        self.point(
            count=small.count, order=small.order, L=small.L, to=small.x, side=small.side, room=small.room,
            tally=small.tally,
        )  # fmt: skip

    def finish(self, state: TissueState) -> None:
        """See :meth:`Contact.finish`. Collective."""
        f, n_local = self.f, self.layout.n_local
        v = self.ffi.from_buffer("double[]", state.array) + n_local
        if f.pressed and not self.alone:
            self.v[:] = self.surface.gather(state.v.array_r)
        moves = self.c.softgrasp_finish(f, self.n, v if self.alone else self.ffi.NULL)
        if self.surface.B is not None:
            self._carry_between(state)
        if not f.pressed:
            return
        self.midpoint.r.stateIncrease()
        if moves:
            if f.feels:
                self.pulled[:] = total(self.layout.comm, self.system.G.T @ state.v.array_r)
            self._halt_flat(state, v)

    def _carry_between(self, state: TissueState) -> None:
        """Carry the points on to the bits that a restart finds, and r with them. Collective."""
        self.z[:], self.low[:], self.moved[:] = self.surface.gather(state.z.array_r), 0.0, 0.0
        self.c.softgrasp_look(self.f)
        self.gaps[:], self.table.gap[self.n + 1] = self.after, self.least
        if self.f.pressed:
            self._add_to_r()

    def _halt_flat(self, state: TissueState, v: Any) -> None:
        """The impulse on pressed rows, one of which moves; v: pointer to the velocities here. Collective."""
        if self.surface.B is None:
            if self.c.softgrasp_stop(self.f) == ENTER:
                self.stops.enter()
                self.c.softgrasp_stop(self.f)
            self._strike_flat(state, v)
            return
        rows = self._pressed_rows()
        assert self.drive is not None
        b = self.rates[: len(self.row)][self.x[: len(self.row)] > 0]
        self.strike.stop(state, self.drive, self.n + 1, rows.obstacle, rows.node, rows.normal, b)

    def _strike_flat(self, state: TissueState, v: Any) -> None:
        """The impulses that are in y at the end of the step. Collective."""
        ways = self.c.softgrasp_strike(self.f, self.n, v)
        self.stops.mass.answer(ways)
        self.c.softgrasp_jump(self.f, v)
        state.v.stateIncrease()

    def _pressed_rows(self) -> Rows:
        on = np.flatnonzero(self.x[: len(self.row)] > 0)
        obstacle, node, *_ = self.row[on].T
        return Rows(obstacle.astype(np.intp), node.astype(np.intp), self.normals[obstacle], self.x[on])

    def pressing(self) -> Array:
        """See :meth:`Contact.pressing`."""
        forces = np.zeros((self.p, self.d))
        if self.f.pressed:
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
        if not len(rows):
            return
        self._enter(rows.reshape(-1, 2).astype(int))
        self.small.resume(order.astype(int), L, len(self.W))
        self._fit(len(self.W))
        self.stops.extend()
