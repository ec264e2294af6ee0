"""What moves the hand in a step: a table, or forces with the tissue pulling back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from softgrasp.fem.columns import hand_columns
from softgrasp.fem.errors import SceneError, SolverError
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.midpoint import Feedback, TissueMidpoint, TissueState
from softgrasp.fem.run.motion import HandTable
from softgrasp.fem.system import BlockSystem

Force = Callable[[int, float, Array, Array], Array]
"""u = force(step, t_mid [s], q_s, v_s) [N, N m], hand state at the start of the step."""


class Drive(Protocol):
    """Solves the midpoint equation of one step for tissue and hand."""

    q: Array
    v: Array
    c: Array
    """Load l = G c of each step, (steps, n_s)."""

    @property
    def u(self) -> Array | None:
        """Force applied in each step without the weight, (steps, n_s) [N, N m]; None when the motion is prescribed."""

    def solve(self, n: int, midpoint: TissueMidpoint, state: TissueState) -> None:
        """Leave w and load of step n in ``midpoint``; fill row n + 1 of ``q`` and ``v``. Collective."""

    def check(self, begin: int, end: int) -> None:
        """Look at what moved the hand in these steps; SolverError unless it is finite."""


class TableDrive:
    """Hand known beforehand: load l = -G (a - g + alpha v) with alpha only when damping drags in space.

    Args:
        system: operators.
        table: the hand's motion.
        force: that it comes from, (steps, n_s) [N, N m]; None when it is prescribed.
    """

    def __init__(self, system: BlockSystem, table: HandTable, force: Array | None = None) -> None:
        self.q, self.v, self.u = table.q, table.v, force
        c = table.a.copy()
        if system.gravity is not None:
            c -= system.gravity
        if system.damping.in_space:
            c += system.damping.alpha * (table.v[1:] + table.v[:-1]) / 2
        self.c = -c

    def solve(self, n: int, midpoint: TissueMidpoint, state: TissueState) -> None:
        """One product with the n_s columns of G and one solve. Collective."""
        midpoint.solve_midpoint(self.c[n])

    def check(self, begin: int, end: int) -> None:
        """Nothing to look at: tables are checked when they are read."""


class ForceDrive:
    """Hand driven by a force; with two-way coupling the Schur complement of the tissue acts on it.

    Two-way, with x = S^{-1}(h), Y = S^{-1} G, c = kappa a + alpha v - g and kappa = 1 + alpha dt/2 (alpha = 0 unless
    damping drags in space), w = x - Y c and

        (M_hand + kappa (M_rigid - theta G'Y)) a = u + weight - M_rigid c_0 - G'(theta (x - Y c_0) - s v),

    c_0 = alpha v - g, theta = s^2 + alpha s. With finite strain w is no linear function of c; the hand's equation
    M_hand a + M_rigid c = u + weight - G'(theta w - s v) then turns the load of the tissue into -G c = G (c_1 + C G'w)
    with C = kappa theta (M_hand + kappa M_rigid)^-1, and the tissue's step is solved under it.
    """

    def __init__(
        self, system: BlockSystem, force: Force, midpoint: TissueMidpoint, steps: int, q0: Array, v0: Array
    ) -> None:
        n_s = system.layout.n_s
        self.system, self.dt = system, midpoint.dt
        self.force: Force = self._checked(force)
        self.q, self.v, self.c = np.zeros((steps + 1, n_s)), np.zeros((steps + 1, n_s)), np.zeros((steps, n_s))
        self.u = np.zeros((steps, n_s))
        self.q[0], self.v[0] = q0, v0
        self.g = np.zeros(n_s) if system.gravity is None else system.gravity
        self.weight = system.M_hand @ self.g if system.hand_weight else np.zeros(n_s)
        self.alpha = system.damping.alpha if system.damping.in_space else 0.0
        self.kappa = 1 + self.alpha * self.dt / 2
        s = midpoint.s
        self.theta = s * s + self.alpha * s
        self.lhs = system.M_hand
        if system.two_way:
            self.Y = midpoint.make_responses()
            GY = total(system.layout.comm, system.G.T @ self.Y)
            self.GY = (GY + GY.T) / 2
            self.lhs = system.M_hand + self.kappa * (system.M_rigid - self.theta * self.GY)
        finite = system.two_way and system.points is not None
        if finite:
            self.lhs = system.M_hand + self.kappa * system.M_rigid
        self.inverse = np.linalg.inv(self.lhs)
        # chosen once, not in every step
        self.solve = self._finite if finite else self._two_way if system.two_way else self._one_way

    def _checked(self, force: Force) -> Force:
        """The force, with a look at the shape of its first value."""
        n_s = self.system.layout.n_s

        def first(n: int, t: float, q: Array, v: Array) -> Array:
            u = np.asarray(force(n, t, q, v), dtype=float)
            if u.shape != (n_s,):
                raise SceneError(f"the force has shape {u.shape}; return {n_s} numbers, one per hand degree of freedom")
            self.force = force
            return u

        return first

    def _applied(self, n: int) -> Array:
        self.u[n] = self.force(n, (n + 0.5) * self.dt, self.q[n], self.v[n])
        return np.asarray(self.u[n])

    def check(self, begin: int, end: int) -> None:
        """Look at the forces taken in these steps, once a segment: a step spends nothing on it.

        Raises:
            SolverError: a force is not finite; the message names the first.
        """
        for i, j in np.argwhere(~np.isfinite(self.u[begin:end]))[:1]:
            layout = self.system.layout
            n, axis = begin + int(i), hand_columns(layout.n_s, layout.dimension)[j].axis
            raise SolverError(
                f"the force on the hand is {self.u[n, j]} in {axis} in step {n + 1}, at t = {(n + 0.5) * self.dt:.6g} "
                "s; it must be finite"
            )

    def _one_way(self, n: int, midpoint: TissueMidpoint, state: TissueState) -> None:
        """One solve. Collective."""
        v = self.v[n]
        a = self.inverse @ (self._applied(n) + self.weight)
        self.c[n] = -(self.kappa * a + self.alpha * v - self.g)
        midpoint.solve_midpoint(self.c[n])
        self._move(n, a)

    def _two_way(self, n: int, midpoint: TissueMidpoint, state: TissueState) -> None:
        """One solve and one small reduction. Collective."""
        v = self.v[n]
        u = self._applied(n) + self.weight
        c0 = self.alpha * v - self.g
        G, layout = self.system.G, self.system.layout
        x = midpoint.respond()
        relative = self.theta * x - midpoint.s * state.array[layout.n_local :]
        pull = total(layout.comm, G.T @ relative) - self.theta * (self.GY @ c0)
        a = self.inverse @ (u - self.system.M_rigid @ c0 - pull)
        c = self.kappa * a + c0
        self.c[n] = -c
        midpoint.accelerate(c)
        self._move(n, a)

    def _finite(self, n: int, midpoint: TissueMidpoint, state: TissueState) -> None:
        """The same with finite strain: the hand's equation is part of the tissue's. Collective."""
        v, layout = self.v[n], self.system.layout
        u = self._applied(n) + self.weight
        c0 = self.alpha * v - self.g
        pull = -midpoint.s * total(layout.comm, self.system.G.T @ state.array[layout.n_local :])
        a = self.inverse @ (u - self.system.M_rigid @ c0 - pull)
        feedback = Feedback(self.kappa * self.theta * self.inverse, midpoint.G, np.array(midpoint.s**2 / self.theta))
        midpoint.solve_midpoint(-(self.kappa * a + c0), feedback)
        self.c[n] = midpoint.c
        self._move(n, -(midpoint.c + c0) / self.kappa)

    def _move(self, n: int, a: Array) -> None:
        v = self.v[n]
        self.v[n + 1] = v + self.dt * a
        self.q[n + 1] = self.q[n] + self.dt * (v + self.v[n + 1]) / 2


def force_taken(system: BlockSystem, pulls: Array, v: Array, c: Array, dt: float) -> Array:
    """Force u [N, N m] in each step that leads the hand against inertia and tissue, shape (steps, n_s).

        u = M_hand a + M_rigid (a - g + alpha v_mid) + G' (z'' + alpha z'_mid) - weight

    with alpha only when damping drags in space. With w = z_mid - z_n and s = 2/dt the tissue has z'_mid = s w and
    z'' = s (s w - z'_n), and G' z'_n follows from G' z'_{n+1} = 2 s G' w - G' z'_n, from rest on.

    Args:
        system: operators, two-way.
        pulls: G' w of each step, (steps, n_s), w = (z_1 - z_0) / 2; or beside it that with (v_0 + v_1) / 2s, which
            differs where a step is divided, (steps, 2 n_s).
        v: velocity of the hand, (steps + 1, n_s).
        c: load of each step, -(a - g + alpha v_mid), (steps, n_s).
        dt: step [s].
    """
    s = 2 / dt
    turn = np.where(np.arange(len(pulls) + 1) % 2 == 0, 1.0, -1.0)[:, None]
    rates, n_s = np.zeros_like(v), v.shape[1]
    work, speed = pulls[:, :n_s], pulls[:, -n_s:]
    rates[1:] = -turn[1:] * np.cumsum(turn[:-1] * (2 * s * speed), axis=0)
    alpha = system.damping.alpha if system.damping.in_space else 0.0
    tissue = s * (s * speed - rates[:-1]) + alpha * s * work
    u = np.diff(v, axis=0) / dt @ system.M_hand.T - c @ system.M_rigid.T + tissue
    if system.hand_weight and system.gravity is not None:
        u -= system.M_hand @ system.gravity
    return np.asarray(u)
