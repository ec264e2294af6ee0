"""Motions that train reduced models with contact: the motion of a scene, and others made of it.

Landings by other ways; the same way slower and faster; back a part of it and forth again, which lifts and lands twice;
ways on which the hand sways along the obstacle, from the start or once it is down.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import quintic

# Landings: factors on the way of the scene along the obstacle and on that towards it [1].
LANDINGS = (1.0, 1.0), (0.0, 1.05), (-1.5, 1.1), (2.0, 1.15), (0.5, 1.0), (-0.5, 1.05)
# Landings twice: the same factors, the time on the way of the scene at which the way back ends, and the times of the
# three moves, over that of the whole way.
AGAIN = (1.0, 1.0, 0.65, (0.5, 0.25, 0.35)), (-1.0, 1.1, 0.55, (0.6, 0.3, 0.45)), (0.3, 1.05, 0.7, (0.45, 0.2, 0.3))
# Sways: the same factors, periods in the time of the way, phase [rad], and whether it begins with the way.
SWAYS = (
    (0.0, 1.05, 0.7, 0.0, True), (0.5, 1.1, 1.5, 2.0, True), (-1.0, 1.0, 3.0, 4.0, True), (0.3, 1.05, 4.5, 1.0, True),
    (0.0, 1.1, 0.8, 1.0, False), (-0.5, 1.0, 1.7, 3.0, False), (1.0, 1.1, 2.7, 5.0, False), (0.5, 1.0, 4.0, 0.0, False),
)  # fmt: skip
WIDE = 0.4  # largest sway over the way along the obstacle [1]
SHARP = 0.5  # the same times periods squared, which bounds accelerations [1]
PACES = 0.65, 1.35  # times of the way of the scene, over its own [1]
DOWN = 0.7  # time over that of the way at which the hand is down where it sways then [1]
FADE = 0.2  # the same of the begin and the end of a sway [1]
ASIDE = 0.5  # way along the obstacle over that towards it, where the motion of the scene has none [1]
STRAIGHT = 1e-3  # way along it over that towards it, which is none [1]
STILL = 1e-6  # speed of the hand over its largest, which is rest [1]


@dataclass(frozen=True)
class Motion:
    """One motion of the hand."""

    q: Array  # position, (steps + 1, n_s) [m, rad]
    v: Array  # velocity, (steps + 1, n_s) [m/s, rad/s]
    landing: bool  # whether it goes one way and lands


@dataclass(frozen=True)
class _Way:
    """The way of a scene."""

    spline: Any  # of SciPy, (n_s,) [m, rad] over time
    normal: Array  # of the obstacle, (d,)
    begin: Array  # position at the start, without rotation, (n_s,) [m]
    axis: Array  # unit vector along the obstacle, (d,)
    straight: bool  # whether it goes towards the obstacle alone

    def at(self, s: Array, rate: Array, f: float, deep: float, across: bool) -> tuple[Array, Array]:
        """Positions and velocities at times s of it, whose rates are given, with factors along it and towards it."""
        x, v = self.spline(s) - self.begin, self.spline(s, 1) * rate[:, None]
        return self.begin + self._turned(x, f, deep, across), self._turned(v, f, deep, across)

    def _turned(self, x: Array, f: float, deep: float, across: bool) -> Array:
        d, n = len(self.normal), self.normal
        down = x[:, :d] @ n
        aside = x[:, :d] - np.outer(down, n)
        if self.straight:
            aside = aside + ASIDE * np.outer(down, self.axis)
        if across:
            aside = np.cross(n, aside)
        return np.hstack([f * aside + deep * np.outer(down, n), x[:, d:]])


def training_motions(q: Array, v: Array, dt: float, normal: Array) -> Iterator[Motion]:
    """The motion of the scene and the others.

    Args:
        q, v: of the scene, (steps + 1, n_s) [m, rad; m/s, rad/s].
        dt: step [s].
        normal: of the first obstacle, (d,).
    """
    from scipy.interpolate import CubicHermiteSpline

    t, d = np.linspace(0.0, dt * (len(q) - 1), len(q)), len(normal)
    speed = np.abs(v).max(axis=1)
    moving = np.flatnonzero(speed > STILL * speed.max())
    whole = float(t[min(moving[-1] + 1, len(t) - 1)]) if len(moving) else float(t[-1])  # time of the way
    path = q[:, :d] - q[0, :d]
    towards = path @ normal
    along = path - np.outer(towards, normal)
    size, depth = float(np.linalg.norm(along, axis=1).max()), float(np.abs(towards).max())
    straight = size <= STRAIGHT * depth
    furthest = along[np.linalg.norm(along, axis=1).argmax()]
    axis = tangent(normal) if straight else furthest / size
    begin = np.concatenate([q[0, :d], np.zeros(q.shape[1] - d)])
    way = _Way(CubicHermiteSpline(t, q, v), normal, begin, axis, straight)
    yield Motion(q, v, True)
    for i, (f, deep) in enumerate(LANDINGS[1:]):
        yield Motion(*way.at(t, np.ones(len(t)), f, deep, d == 3 and i % 2 == 1), True)
    for pace in PACES:
        yield Motion(*way.at(*_paced(t, whole, pace), 1.0, 1.05, False), False)
    for i, (f, deep, back, (first, lift, last)) in enumerate(AGAIN):
        s, rate = _paced(t, whole, first)
        for start, time, step in ((first, lift, back - 1), (first + lift, last, 1 - back)):
            x, dx, _ = quintic(np.maximum(t - start * whole, 0.0), time * whole)
            s, rate = s + step * whole * x, rate + step * whole * dx
        yield Motion(*way.at(s, rate, f, deep, d == 3 and i % 2 == 1), False)
    for i, (f, deep, periods, phase, early) in enumerate(SWAYS):
        x, dx = way.at(*_paced(t, whole, 1.0 if early else DOWN), f, deep, False)
        wave, dwave = _wave(t, 2 * np.pi * periods / whole, phase, FADE * whole, *(
            (0.0, (1 + FADE) * whole) if early else (DOWN * whole, float(t[-1]))
        ))  # fmt: skip
        wide = min(WIDE, SHARP / periods**2) * (ASIDE * depth if straight else size)
        aside = wide * (np.cross(normal, axis) if d == 3 and i % 2 else axis)
        x[:, :d] += np.outer(wave, aside)
        dx[:, :d] += np.outer(dwave, aside)
        yield Motion(x, dx, False)


def _paced(t: Array, whole: float, pace: float) -> tuple[Array, Array]:
    """Times on the way of the scene at another pace, and their rates."""
    s = t / pace
    return np.minimum(s, whole), np.where(s < whole, 1 / pace, 0.0)


def _wave(t: Array, omega: float, phase: float, fade: float, begin: float, end: float) -> tuple[Array, Array]:
    """A sine that fades in from ``begin`` on and out up to ``end``, and its rate."""
    up, dup, _ = quintic(np.maximum(t - begin, 0.0), fade)
    down, ddown, _ = quintic(np.maximum(t - end + fade, 0.0), fade)
    sine, dsine = np.sin(omega * t + phase), omega * np.cos(omega * t + phase)
    return up * (1 - down) * sine, (dup * (1 - down) - up * ddown) * sine + up * (1 - down) * dsine


def tangent(n: Array) -> Array:
    """A unit tangent of a plane."""
    axis = np.eye(len(n))[int(np.abs(n).argmin())]
    t = axis - float(axis @ n) * n
    return np.asarray(t / np.linalg.norm(t))
