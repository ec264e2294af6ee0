"""Contact with Coulomb friction: forces x_t along the tangents of a pressed node, |x_t| <= mu x_n.

The slip of a step is that of the node against the obstacle, hand included, over the step; a slipping node has x_t
against it. So x_t does the work x_t'slip <= 0 at an obstacle at rest, exactly, and sticking nodes do none. What sticks
stops along its tangents too when the impulse y comes, as far as the impulse of the whole step, p = dt x + y, allows:

    0 <= p_n,  v_n >= 0,  p_n v_n = 0,   |p_t| <= mu p_n,  p_t = -mu p_n v_t / |v_t| where v_t is not 0

for the velocities v after it; v_t of a node that slips in the step is that of the step, with what the impulse adds, so
that where all is at rest but for rounding the impulse is rounding too. So the mean force of a step obeys Coulomb's law
with its impulses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsymv

from softgrasp.fem.model.build import Model
from softgrasp.fem.obstacles import HalfSpace
from softgrasp.fem.obstacles.compiled import friction_library
from softgrasp.fem.obstacles.coulomb import Coulomb
from softgrasp.fem.obstacles.inverse import Inverse
from softgrasp.fem.obstacles.newton import OPEN, SLIP, STICK
from softgrasp.fem.obstacles.obstacle import Obstacle
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.contact.flat import FlatContact
from softgrasp.fem.run.contact.general import Contact
from softgrasp.fem.run.contact.rows import Flags, Ints, Rows
from softgrasp.fem.run.hand import HandStep
from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState
from softgrasp.fem.run.motion import Driven


def tangents(normal: Array) -> Array:
    """Unit vectors (k, d - 1, d) that are perpendicular to normals (k, d) of any length, and to each other."""
    if normal.shape[1] == 2:
        turned = np.stack([-normal[:, 1], normal[:, 0]], axis=1)[:, None]
        return np.asarray(turned / np.linalg.norm(turned, axis=2)[:, :, None])
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(normal, first)
    return np.stack([first, second / np.linalg.norm(second, axis=1)[:, None]], axis=1)


@dataclass
class RubbingRows(Rows):
    """Contact rows with friction."""

    tangent: Array  # unit tangents of the step, (k, d - 1, d)
    x_t: Array  # forces along them [N], (k, d - 1)
    slip: Array  # slips along them in the step [m], (k, d - 1)
    kind: NDArray[np.intc]  # sets, see `softgrasp.fem.obstacles.coulomb`, (k,)
    e: Array  # directions of slipping nodes, see there, (k, d)

    def forces(self) -> Array:
        """See :meth:`Rows.forces`."""
        return np.asarray(self.x[:, None] * self.normal + np.einsum("ka,kad->kd", self.x_t, self.tangent))


def rubbing_impulse(
    contact: Contact, jolt: Coulomb, x: Array, rubbed: float, mu: Array, A: Array, v: Array, mean: Array, still: float
) -> Array | None:
    """Impulse with friction (k d,) that stops rows; None where friction would not dissipate energy in the step.

    Args:
        jolt: problem of the impulses, with room for the rows, and sets to begin from.
        x: forces of the step on the rows [N], (k, d).
        rubbed: work of friction on slipping nodes in the step [J].
        mu: coefficients of friction, (k,).
        A: N M^-1 N' of the rows, a normal and then its tangents, (k d, k d).
        v: velocities along them, (k, d).
        mean: the same, but of slipping nodes along their tangents those of the step, (k, d).
        still: velocity that is rounding [m/s].
    """
    pushed = contact.dt * x
    jolt.x[:], jolt.y[:] = pushed, mean
    q = mean.ravel() - dsymv(1.0, A.T, pushed.ravel())
    y = (jolt.solve(len(x), A, q, mu, still, known=True) - pushed).ravel()
    taken = -y * (v + (jolt.y - mean) / 2).ravel()
    along = float(taken[:: v.shape[1]].sum())
    across = float(taken.sum()) - along
    if across - rubbed < 0:
        return None
    contact.table.energy[2:] += along, across
    return y


class FrictionContact(Contact):
    """Contact of one run in which an obstacle has friction, see :class:`softgrasp.fem.run.contact.general.Contact`."""

    rows: RubbingRows

    def __init__(self, model: Model, midpoint: TissueMidpoint, steps: int, hand: HandStep | None) -> None:
        super().__init__(model, midpoint, steps, hand)
        self.mu = np.array([entry.friction for entry in model.scene.obstacle or []])
        self.coulomb, self.jolt = Coulomb(self.d - 1), Coulomb(self.d - 1)
        self.flat = all(isinstance(o.shape, HalfSpace) for o in self.obstacles)
        self.pairs, self.C, self.W = np.zeros((0, 2), dtype=int), np.zeros((0, 0)), np.zeros((0, 0))

    def _basis(self, obstacle: Obstacle) -> Array:
        """See :meth:`Contact._basis`: all directions."""
        return np.eye(self.d)

    def _make_rows(self, pairs: Ints) -> RubbingRows:
        """See :meth:`Contact._make_rows`."""
        rows, k, m = super()._make_rows(pairs), len(pairs), self.d - 1
        return RubbingRows(
            rows.obstacle, rows.node, rows.normal, rows.x, np.zeros((k, m, self.d)), np.zeros((k, m)), np.zeros((k, m)),
            np.full(k, OPEN, np.intc), np.zeros((k, self.d)),
        )  # fmt: skip

    def press(self, n: int, drive: Driven) -> None:
        """See :meth:`Contact.press`. Collective."""
        super().press(n, drive)
        self.table.energy[3] -= np.einsum("ka,ka->", self.rows.x_t, self.rows.slip)
        self.small.tally[0] = self.coulomb.rounds

    def _forces(
        self, known: Flags, active: Flags, n: int, x0: Array, free: Array, x1: Array, tol: float
    ) -> tuple[Array, RubbingRows]:
        """See :meth:`Contact._forces`. Collective."""
        pairs = np.argwhere(known)
        rows, k, s, before = self._make_rows(pairs), len(pairs), self.d, self.rows
        q = np.zeros((k, s))
        q[:, 0] = self._look_along(rows, n, x0, free, x1)
        rows.tangent = tangents(rows.normal)
        shifts = [o.shift((n + 1) * self.dt) - o.shift(n * self.dt) + np.zeros(self.d) for o in self.obstacles]
        moved = (free - x0)[rows.node] - np.array(shifts)[rows.obstacle]
        q[:, 1:] = np.einsum("kad,kd->ka", rows.tangent, moved) / 2
        coulomb, stays = self.coulomb, np.array_equal(pairs, self.pairs)
        if not (self.flat and stays):  # where normals stay, W stays with the pairs
            directions = np.concatenate([rows.normal[:, None], rows.tangent], axis=1).reshape(-1, s)
            self.C, self.pairs = self.select(self.responses, np.repeat(pairs, s, axis=0), directions), pairs
            m = self.C.shape[1]
            self.W = np.ascontiguousarray(self.C @ self.responses.G[:m, :m] @ self.C.T)
            coulomb.fit(k)
            if len(before.node):
                number = np.full(known.shape, -1)
                number[before.obstacle, before.node] = np.arange(len(before.node))
                at = number[rows.obstacle, rows.node]
                there, at = at >= 0, at[at >= 0]
                coulomb.kind[there], coulomb.e[there] = before.kind[at], before.e[at]
                coulomb.x[there] = np.column_stack([before.x, before.x_t])[at]
        load = q.ravel()
        x = coulomb.solve(k, self.W, load, self.mu[rows.obstacle], tol / 4)
        rows.x, rows.x_t, rows.kind, rows.e = x[:, 0].copy(), x[:, 1:].copy(), coulomb.kind.copy(), coulomb.e.copy()
        rows.slip = 2 * (load + self.W @ x.ravel()).reshape(k, s)[:, 1:]
        return self.C.T @ x.ravel(), rows

    def _halt(self, state: TissueState, n: int, rows: Rows, normal: Array, v: Array, still: float) -> None:
        """See :meth:`Contact._halt`. Collective."""
        assert isinstance(rows, RubbingRows)
        along = np.concatenate([normal[:, None], tangents(normal)], axis=1)
        speed = np.einsum("kad,kd->ka", along, v)
        stuck = rows.kind == STICK
        if max(np.abs(speed[:, 0]).max(), np.abs(speed[stuck]).max(initial=0.0)) <= still:
            return
        obstacle, node, axes = (np.repeat(rows.obstacle, d := self.d), np.repeat(rows.node, d), along.reshape(-1, d))
        A = np.ascontiguousarray(self.strike.reactions().matrix(node, axes))
        self.jolt.fit(len(rows.node))
        self.jolt.forget()  # a restart does not find what an A that stays has led to
        self.jolt.kind[:], self.jolt.e[:] = rows.kind, rows.e
        x, slips, mean = np.column_stack([rows.x, rows.x_t]), rows.kind == SLIP, speed.copy()
        rubbed = float(np.einsum("ka,ka->", rows.x_t[slips], rows.slip[slips]))  # of others it is rounding
        mean[slips, 1:] = rows.slip[slips] / self.dt
        y = rubbing_impulse(self, self.jolt, x, rubbed, self.mu[rows.obstacle], A, speed, mean, still)
        if y is None:
            super()._halt(state, n, rows, normal, v, still)
            return
        assert self.drive is not None
        self.strike.strike(state, self.drive, n, obstacle, node, axes, y)

    def _sets(self) -> list[NDArray[Any]]:
        """See :meth:`Contact._sets`."""
        return [*super()._sets(), self.pairs.ravel().astype(float), self.coulomb.state()]

    def _resume(self, sets: list[Array]) -> None:
        """See :meth:`Contact._resume`. Collective."""
        super()._resume(sets[:1])
        self.pairs = sets[1].reshape(-1, 2).astype(int)
        k, s = len(self.pairs), self.d
        if k:
            normal = np.array([self._flat_normal(o) for o in self.pairs[:, 0]])
            directions = np.concatenate([normal[:, None], tangents(normal)], axis=1).reshape(-1, s)
            self.C = self.select(self.responses, np.repeat(self.pairs, s, axis=0), directions)
            m = self.C.shape[1]
            self.W = np.ascontiguousarray(self.C @ self.responses.G[:m, :m] @ self.C.T)
        self.coulomb.resume(sets[2], self.W, self.mu[self.pairs[:, 0]])
        number = {(int(o), int(i)): j for j, (o, i) in enumerate(self.pairs)}
        at = [number[int(o), int(i)] for o, i in zip(self.rows.obstacle, self.rows.node, strict=True)]
        x = self.coulomb.x[at]
        self.rows.x, self.rows.x_t = x[:, 0].copy(), x[:, 1:].copy()
        self.rows.kind, self.rows.e = self.coulomb.kind[at], self.coulomb.e[at]

    def _flat_normal(self, obstacle: int) -> Array:
        """Normal of a half-space; any vector for other shapes, whose W does not stay."""
        shape = self.obstacles[obstacle].shape
        return shape.normal if isinstance(shape, HalfSpace) else np.eye(self.d)[0]


class Side:
    """What every other step continues: steps of the midpoint rule alternate, and with them sets and forces.

    Args:
        tangents: of a node.
        inverse: of N S^-1 N', which all sides share.

    Attributes:
        coulomb: problem of the steps.
        jolt: problem of their impulses.
        stopped: rows of the last impulse, (k d,).
        A: N M^-1 N' of these rows, (k d, k d).
        mu: coefficients of friction of their nodes, (k,).
        forces, sets: where C finds the forces of ``coulomb`` and its sets.
        rows: where it finds ``stopped``.
    """

    def __init__(self, tangents: int, inverse: Inverse) -> None:
        self.coulomb, self.jolt = Coulomb(tangents, inverse=inverse), Coulomb(tangents)
        self.stopped, self.A, self.mu, self.x = np.zeros(0, np.intc), np.zeros((0, 0)), np.zeros(0), np.zeros(0)
        self.ffi, self.c = friction_library(tangents)
        self._point()

    def _point(self) -> None:
        self.rows = self.ffi.from_buffer("int[]", self.stopped)

    def stop(self, rows: Ints, A: Array, mu: Array, other: Side) -> None:
        """Room for impulses on other rows, of all N M^-1 N'; while they stay, their problem keeps its factor.

        What belongs to the rows alone is shared with the other side where its rows are the same.
        """
        if np.array_equal(rows, other.stopped):
            self.A, self.jolt.inverse = other.A, other.jolt.inverse
        else:
            self.A, self.jolt.inverse = np.ascontiguousarray(A[np.ix_(rows, rows)]), Inverse(1 + self.jolt.m)
        self.stopped, self.mu = rows.astype(np.intc), mu
        self._point()
        self.jolt.fit(len(rows) // (1 + self.jolt.m))

    def answer(self, f: Any) -> None:
        """Let the struct of `flat.h` have the forces and sets of the step."""
        if self.x is not self.coulomb.x:
            self.x, sets = self.coulomb.x, self.coulomb.kind
            self.forces, self.sets = self.ffi.from_buffer("double[]", self.x), self.ffi.from_buffer("int[]", sets)
        f.to, f.kind = self.forces, self.sets


class FlatFriction(FlatContact):
    """`FrictionContact` before half-spaces; there must be a compiler."""

    def __init__(self, model: Model, midpoint: TissueMidpoint, steps: int, hand: HandStep | None) -> None:
        self.mu = np.array([entry.friction for entry in model.scene.obstacle or []])
        d = 3 if len((model.scene.obstacle or [])[0].normal or []) == 3 else 2
        inverse = Inverse()
        self.sides = Side(d - 1, inverse), Side(d - 1, inverse)
        super().__init__(model, midpoint, steps, hand)

    @property
    def side(self) -> Side:
        """What the step in work continues."""
        return self.sides[self.n % 2]

    def _basis(self, obstacle: Obstacle) -> Array:
        """See :meth:`Contact._basis`: the normal, then its tangents."""
        assert isinstance(obstacle.shape, HalfSpace)
        normal = obstacle.shape.normal[None]
        return np.vstack([normal, tangents(normal)[0]])

    def _axes(self) -> Array:
        """See :meth:`FlatContact._axes`."""
        return np.concatenate([self.normals[:, None], tangents(self.normals)], axis=1)

    def _enter(self, pairs: Ints) -> None:
        """See :meth:`FlatContact._enter`. Collective."""
        super()._enter(pairs)
        self.friction, self.load = self.mu[self._pairs()[:, 0]], self.free[: self.f.k]

    def _fit(self, size: int) -> None:
        """See :meth:`FlatContact._fit`: without the problem of normal forces alone."""

    def _balance(self, tol: float) -> None:
        """See :meth:`FlatContact._balance`."""
        side, f = self.side, self.f
        side.coulomb.solve(f.k // self.d, self.W, self.load, self.friction, tol, f.round == 0)
        side.answer(f)
        self.small.tally[0] = self.sides[0].coulomb.rounds + self.sides[1].coulomb.rounds

    def _pressed_rows(self) -> RubbingRows:
        s, k = self.d, len(self.row)
        x, on = self.x[:k].reshape(-1, s), np.flatnonzero(self.x[:k:s] > 0)
        obstacle, node = self._pairs()[on].T
        slip, coulomb = np.zeros(k), self.side.coulomb
        self.c.softgrasp_values(self.f, self.ffi.from_buffer("double[]", slip))
        return RubbingRows(
            obstacle, node, self.normals[obstacle], x[on, 0], self.along[obstacle, 1:], x[on, 1:],
            2 * slip.reshape(-1, s)[on, 1:], coulomb.kind[on], coulomb.e[on],
        )  # fmt: skip

    def _halt_flat(self, state: TissueState, v: Any) -> None:
        """See :meth:`FlatContact._halt_flat`. Collective."""
        f, side = self.f, self.side
        step, jolt = side.coulomb.f, side.jolt
        if not side.c.softgrasp_stays(f, side.rows, len(side.stopped)):
            self._stop_others(side)
        side.c.softgrasp_jolt(f, step, side.rows, jolt.f)
        jolt.solve(len(side.mu), side.A, jolt.q, side.mu, f.still, known=True)
        if not side.c.softgrasp_jolted(f, step, side.rows, jolt.f):
            on = side.stopped[:: self.d]
            b = self.rates[on]
            if np.abs(b).max() <= f.still:
                return
            self.struck[on] = np.linalg.solve(self.stops.A[np.ix_(on, on)], b)
            self.table.energy[2] += self.struck[on] @ b / 2
        self._strike_flat(state, v)

    def _stop_others(self, side: Side) -> None:
        """Let impulses act on the rows that are pressed now. Collective."""
        s, k = self.d, len(self.row)
        nodes = np.flatnonzero(self.x[:k:s] > 0)
        rows = (s * nodes[:, None] + np.arange(s)).ravel()
        if rows[-1] >= self.f.struck:
            self.stops.enter()
        side.stop(rows, self.stops.A, self.friction[nodes], self.sides[1 - self.n % 2])
        side.jolt.kind[:], side.jolt.e[:] = side.coulomb.kind[nodes], side.coulomb.e[nodes]

    def _sets(self) -> list[NDArray[Any]]:
        """See :meth:`Contact._sets`."""
        sides = [[side.coulomb.state(), side.stopped, side.jolt.state()] for side in self.sides]
        return [self._pairs().ravel(), *sides[0], *sides[1]]

    def _resume(self, sets: list[Array]) -> None:
        """See :meth:`Contact._resume`. Collective."""
        pairs = sets[0].reshape(-1, 2).astype(int)
        if not len(pairs):
            return
        self._enter(pairs)
        for side, coulomb, stopped, jolt in zip(self.sides, sets[1::3], sets[2::3], sets[3::3], strict=True):
            side.coulomb.resume(coulomb, self.W, self.friction)
            if len(rows := stopped.astype(np.intp)):
                other = self.sides[1 - self.sides.index(side)]
                side.stop(rows, self.stops.A, self.friction[rows[:: self.d] // self.d], other)
                side.jolt.resume(jolt, side.A, side.mu)
