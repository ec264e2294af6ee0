"""How the hand moves: tables of position, velocity and mean acceleration at the time steps.

A one-way coupled hand does not feel the tissue, so its whole trajectory is known before the first step, whether it is
prescribed or driven by a force.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from softgrasp.fem.errors import SceneError
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.scene.text import read_table


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


def read_csv(path: Path, columns: int, end: float | None = None, key: str = "motion.csv") -> tuple[Array, Array]:
    """Read times (steps,) and values (steps, columns) of a trajectory.

    Args:
        path: the file.
        columns: degrees of freedom of the hand.
        end: of the run [s]; None takes the file as long as it is, from 0 on.
        key: who names the file, for the messages.

    Raises:
        SceneError: the file is missing, not numeric, not increasing in time or does not cover [0, end].
    """
    try:
        table = np.array(read_table(path, columns + 1))
    except OSError as error:
        raise SceneError(f"{key}: {path} cannot be read ({error.strerror}); name an existing CSV file") from error
    except ValueError as error:
        raise SceneError(f"{key}: {path} {error} (time, then one per hand degree of freedom)") from error
    if len(table) < 2:
        raise SceneError(f"{key}: {path} has {len(table)} rows of numbers; it must have at least two")
    if (np.diff(table[:, 0]) <= 0).any():
        raise SceneError(f"{key}: the times in {path} must increase from row to row")
    if end is None and table[0, 0] != 0:
        raise SceneError(f"{key}: the times in {path} must begin at 0, not at {table[0, 0]:g} s")
    if end is not None and (table[0, 0] > 0 or table[-1, 0] < end * (1 - 1e-12)):
        raise SceneError(f"{key}: {path} covers {table[0, 0]:g} to {table[-1, 0]:g} s, the run needs 0 to {end:g} s")
    return table[:, 0], table[:, 1:]


def _target(scene: Scene, n_s: int) -> Array:
    target = scene.motion.target or []
    return np.pad(np.array(target, dtype=float), (0, n_s - len(target)))


def motion_table(scene: Scene, n_s: int) -> HandTable:
    """Positions of the prescribed motion (drive = "motion") on the time grid.

    A CSV table is joined by a cubic spline, at rest at both ends.

    Raises:
        SceneError: a CSV file does not fit.
    """
    steps, end = scene.time.steps, scene.time_end
    t = end * np.arange(steps + 1) / steps
    motion = scene.motion
    if motion.profile == "quintic":
        if end / steps > motion.duration / 2:
            raise SceneError(
                f"time.steps = {steps} gives steps of {end / steps:g} s, too long for a move of {motion.duration:g} s; "
                f"take at least {int(np.ceil(2 * end / motion.duration))}"
            )
        s, ds, _ = quintic(t, motion.duration)
        q, v = (np.outer(x, _target(scene, n_s)) for x in (s, ds))
    elif motion.profile == "csv":
        times, values = read_csv(scene.directory / (motion.csv or ""), n_s, end)
        spline = CubicSpline(times, values, bc_type="clamped")
        q, v = spline(t), spline(t, 1)
    else:
        q, v = np.zeros((steps + 1, n_s)), np.zeros((steps + 1, n_s))
    return HandTable(q, v, np.diff(v, axis=0) * (steps / end))


def force_values(scene: Scene, n_s: int, M_hand: Array) -> Array:
    """Force u [N, N m] on the hand at the step midpoints, shape (steps, n_s).

    A CSV table is joined by straight lines.

    With the quintic profile it is the feed-forward M_hand a(t) that would carry the bare hand to the target.

    Raises:
        SceneError: a CSV file does not fit.
    """
    steps, end = scene.time.steps, scene.time_end
    t = end * (np.arange(steps) + 0.5) / steps
    motion = scene.motion
    if motion.profile == "quintic":
        rate = np.where(t < motion.duration, quintic(t, motion.duration)[2], 0.0)
        return np.outer(rate, _target(scene, n_s)) @ M_hand.T
    if motion.profile == "csv":
        times, values = read_csv(scene.directory / (motion.csv or ""), n_s, end)
        return np.stack([np.interp(t, times, column) for column in values.T], axis=1)
    return np.zeros((steps, n_s))


def largest_acceleration(scene: Scene, n_s: int, M_hand: Array) -> Array:
    """The largest acceleration that a motion, or a force on the bare hand, gives the hand [m/s^2, rad/s^2], (n_s,).

    Raises:
        SceneError: a CSV file does not fit.
    """
    if scene.motion.profile == "quintic":
        return np.asarray(10 / np.sqrt(3) / scene.motion.duration**2 * _target(scene, n_s))
    if scene.motion.drive == "motion":
        a = motion_table(scene, n_s).a
    else:
        a = np.linalg.solve(M_hand, force_values(scene, n_s, M_hand).T).T
    return np.asarray(a[int(np.argmax(np.abs(a).max(axis=1)))])


def driven_table(M_hand: Array, force: Array, dt: float, q0: Array, v0: Array) -> HandTable:
    """Midpoint rule for the free hand M_hand a = u: exact for the given mean forces."""
    a = np.linalg.solve(M_hand, force.T).T
    v = np.vstack([v0, v0 + dt * np.cumsum(a, axis=0)])
    q = np.vstack([q0, q0 + dt * np.cumsum((v[1:] + v[:-1]) / 2, axis=0)])
    return HandTable(q, v, a)
