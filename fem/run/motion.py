"""How the hand moves: tables at the time steps where it does not feel the tissue, else forces on it in each step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from softgrasp.fem.columns import hand_columns
from softgrasp.fem.errors import SceneError, SolverError
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.hand import HandStep
from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.scene.table import read_motion
from softgrasp.fem.system import BlockSystem


@dataclass(frozen=True)
class HandTable:
    """Hand trajectory on the time grid."""

    q: Array  # positions [m, rad], shape (steps + 1, n_s)
    v: Array  # velocities, shape (steps + 1, n_s)
    a: Array  # mean acceleration of each step, (v_{n+1} - v_n) / dt, shape (steps, n_s)


def quintic(t: Array, duration: float) -> tuple[Array, Array, Array]:
    """Rest-to-rest profile s = 10 x^3 - 15 x^4 + 6 x^5 of x = t / duration, with first and second derivative.

    Source: minimum-jerk motion [FlashHogan1985].
    """
    x = np.clip(t / duration, 0.0, 1.0)
    s = x**3 * (10 + x * (-15 + 6 * x))
    ds = 30 * x**2 * (1 - x) ** 2 / duration
    dds = 60 * x * (1 - x) * (1 - 2 * x) / duration**2
    return s, ds, dds


@dataclass(frozen=True)
class Profile:
    """Time law of the hand: a rest-to-rest quintic to a target (0: at rest), or a table that a CSV file gave."""

    drive: Literal["motion", "force"]  # columns: the motion of the hand, or the force on it
    end: float  # end of the run [s]
    target: Array  # target of the quintic [m, rad], (n_s,)
    duration: float  # duration of the quintic [s]
    table: tuple[Array, Array] | None = None  # times (m,) [s] and values (m, n_s) [m, rad; N, N m], or None

    @staticmethod
    def of(scene: Scene, n_s: int) -> Profile:
        """The law of a scene. Raises SceneError: a CSV file does not fit."""
        motion, end = scene.motion, scene.time_end
        target = np.array(motion.target or [], dtype=float)
        table = None
        if motion.profile == "csv":
            table = read_motion(scene, n_s)
        return Profile(motion.drive, end, np.pad(target, (0, n_s - len(target))), motion.duration, table)

    @property
    def fewest(self) -> int:
        """Steps that a run must have at least."""
        quintic_moves = self.drive == "motion" and self.table is None and self.target.any()
        # less rounding, so that half a duration may be a step
        return max(1, int(np.ceil(2 * self.end / self.duration - 1e-9))) if quintic_moves else 1

    def motion(self, steps: int) -> HandTable:
        """The hand on a time grid; a table is joined by a cubic spline, at rest at both ends."""
        t = self.end * np.arange(steps + 1) / steps
        if self.table is not None:
            from scipy.interpolate import CubicSpline  # brings scipy.optimize

            spline = CubicSpline(*self.table, bc_type="clamped")
            q, v = spline(t), spline(t, 1)
        else:
            s, ds, _ = quintic(t, self.duration)
            q, v = (np.outer(x, self.target) for x in (s, ds))
        return HandTable(q, v, np.diff(v, axis=0) * (steps / self.end))

    def force(self, steps: int, M_hand: Array) -> Array:
        """Force u on the hand at the step midpoints, (steps, n_s) [N, N m]; a table is joined by straight lines.

        The quintic is the feed-forward M_hand a(t) that would carry the bare hand to the target.
        """
        t = self.end * (np.arange(steps) + 0.5) / steps
        if self.table is not None:
            times, values = self.table
            return np.stack([np.interp(t, times, column) for column in values.T], axis=1)
        rate = np.where(t < self.duration, quintic(t, self.duration)[2], 0.0)
        return np.asarray(np.outer(rate, self.target) @ M_hand.T)


def motion_table(scene: Scene, n_s: int) -> HandTable:
    """The prescribed motion of a scene (drive = "motion") on its time grid, see :meth:`Profile.motion`.

    Raises SceneError: a CSV file does not fit, or the steps are too long for the move.
    """
    profile, steps = Profile.of(scene, n_s), scene.time.steps
    if steps < profile.fewest:
        raise SceneError(
            f"time.steps = {steps} gives steps of {profile.end / steps:g} s, too long for a move of "
            f"{profile.duration:g} s; use at least {profile.fewest}"
        )
    return profile.motion(steps)


def force_values(scene: Scene, n_s: int, M_hand: Array) -> Array:
    """Force u of a scene on the hand at the step midpoints, (steps, n_s) [N, N m], see :meth:`Profile.force`.

    Raises SceneError: a CSV file does not fit.
    """
    return Profile.of(scene, n_s).force(scene.time.steps, M_hand)


def largest_acceleration(scene: Scene, n_s: int, M_hand: Array) -> Array:
    """The largest acceleration that a motion, or a force on the bare hand, gives the hand [m/s^2, rad/s^2], (n_s,).

    Raises SceneError: a CSV file does not fit.
    """
    if scene.motion.profile == "quintic":
        return np.asarray(10 / np.sqrt(3) / scene.motion.duration**2 * Profile.of(scene, n_s).target)
    if scene.motion.drive == "motion":
        a = motion_table(scene, n_s).a
    else:
        a = np.linalg.solve(M_hand, force_values(scene, n_s, M_hand).T).T
    return np.asarray(a[int(np.argmax(np.abs(a).max(axis=1)))])


def free_table(system: BlockSystem, scene: Scene, dt: float) -> tuple[HandTable, Array | None]:
    """Motion of a hand that does not feel the tissue, and the force (steps, n_s) behind it; None where prescribed.

    Raises SceneError: a CSV file does not fit.
    """
    n_s = system.layout.n_s
    if scene.motion.drive == "motion":
        return motion_table(scene, n_s), None
    force, zero = force_values(scene, n_s, system.M_hand), np.zeros(n_s)
    return driven_table(system.M_hand, force + system.weight, dt, zero, zero), force


def driven_table(M_hand: Array, force: Array, dt: float, q0: Array, v0: Array) -> HandTable:
    """Midpoint rule for the free hand M_hand a = u: exact for the given mean forces."""
    a = np.ascontiguousarray(np.linalg.solve(M_hand, force.T).T)  # a row a step, as C reads the motion
    v = np.vstack([v0, v0 + dt * np.cumsum(a, axis=0)])
    q = np.vstack([q0, q0 + dt * np.cumsum((v[1:] + v[:-1]) / 2, axis=0)])
    return HandTable(q, v, a)


Force = Callable[[int, float, Array, Array], Array]
"""u = force(step, t_mid [s], q_s, v_s) [N, N m], hand state at the start of the step."""


class Driven(Protocol):
    """Histories of a hand that contact corrects, one step at a time."""

    q: Array
    """Displacement, (steps + 1, n_s) [m, rad]."""
    v: Array
    """Velocity, (steps + 1, n_s)."""
    c: Array
    """Coefficients of the load G c of each step, (steps, n_s)."""


class TableDrive:
    """Hand known beforehand: load l = G c, c = -(a - g + alpha v) with alpha only when damping drags in space.

    Attributes:
        q, v, c: hand, (steps + 1, n_s), and load coefficients, (steps, n_s).
        u: force behind it without the weight, (steps, n_s) [N, N m]; None when it is prescribed.
    """

    def __init__(self, system: BlockSystem, table: HandTable, force: Array | None = None) -> None:
        self.q, self.v, self.u = table.q, table.v, force
        c = table.a - system.fall + system.damping.drag * (table.v[1:] + table.v[:-1]) / 2
        self.c = np.ascontiguousarray(-c)  # a row a step

    def solve(self, n: int, midpoint: TissueMidpoint, state: TissueState) -> None:
        """One product with the n_s columns of G and one solve. Collective."""
        midpoint.solve_midpoint(self.c[n])

    def check(self, begin: int, end: int) -> None:
        """Nothing to look at: tables are checked when they are read."""


class ForceDrive:
    """Hand driven by a force, see :class:`softgrasp.fem.run.hand.HandStep`. Making one is collective."""

    def __init__(
        self, system: BlockSystem, force: Force, midpoint: TissueMidpoint, steps: int, q0: Array, v0: Array
    ) -> None:
        n_s = system.layout.n_s
        self.system, self.dt, self.step = system, midpoint.dt, HandStep(system, midpoint)
        self.force: Force = self._checked(force)
        self.q, self.v, self.c = np.zeros((steps + 1, n_s)), np.zeros((steps + 1, n_s)), np.zeros((steps, n_s))
        self.u = np.zeros((steps, n_s))
        self.q[0], self.v[0] = q0, v0

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

    def solve(self, n: int, midpoint: TissueMidpoint, state: TissueState) -> None:
        """One step of tissue and hand. Collective."""
        v = self.v[n]
        self.u[n] = self.force(n, (n + 0.5) * self.dt, self.q[n], v)
        a = self.step.push(v, self.u[n], state)
        self.c[n] = midpoint.c
        self.v[n + 1] = v + self.dt * a
        self.q[n + 1] = self.q[n] + self.dt * (v + self.v[n + 1]) / 2

    def check(self, begin: int, end: int) -> None:
        """Check the forces of these steps, once a segment, so that a step needs no time for it.

        Raises SolverError: a force is not finite; the message names the first.
        """
        for i, j in np.argwhere(~np.isfinite(self.u[begin:end]))[:1]:
            layout = self.system.layout
            n, axis = begin + int(i), hand_columns(layout.n_s, layout.dimension)[j].axis
            raise SolverError(
                f"the force on the hand is {self.u[n, j]} in {axis} in step {n + 1}, at t = {(n + 0.5) * self.dt:.6g} "
                "s; it must be finite"
            )


def force_taken(system: BlockSystem, pulls: Array, v: Array, c: Array, dt: float, kicks: Array | float = 0.0) -> Array:
    """Mean force u [N, N m] in each step that leads the hand against inertia and tissue, shape (steps, n_s).

        u = M_hand a + M_rigid (a - g + alpha v_mid) + G' (z'' + alpha z'_mid) - weight

    with alpha only when damping drags in space. With w = z_mid - z_n and s = 2/dt the tissue has z'_mid = s w and
    z'' = s (s w - z'_n), and G' z'_n follows from G' z'_{n+1} = 2 s G' w - G' z'_n, from rest on.

    Args:
        pulls: G' w of each step, (steps, n_s), w = (z_1 - z_0) / 2; or beside it that with (v_0 + v_1) / 2s, which
            differs where a step is divided, (steps, 2 n_s).
        v: velocity of the hand, (steps + 1, n_s).
        c: load of each step, -(a - g + alpha v_mid), (steps, n_s).
        dt: step [s].
        kicks: jumps of G'z' at the end of each step, (steps, n_s), of impulses.
    """
    s = 2 / dt
    turn = np.where(np.arange(len(pulls) + 1) % 2 == 0, 1.0, -1.0)[:, None]
    rates, n_s = np.zeros_like(v), v.shape[1]
    work, speed = pulls[:, :n_s], pulls[:, -n_s:] if pulls.shape[1] >= 2 * n_s else pulls[:, :n_s]
    rates[1:] = -turn[1:] * np.cumsum(turn[:-1] * (2 * s * speed + kicks), axis=0)
    tissue = s * (s * speed - rates[:-1]) + system.damping.drag * s * work + kicks / dt
    known = system.weight + system.own_wrench
    return np.asarray(np.diff(v, axis=0) / dt @ system.M_hand.T - c @ system.M_rigid.T + tissue - known)
