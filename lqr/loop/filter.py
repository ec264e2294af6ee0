"""A Kalman filter of a reduced plant from tick to tick, as a robot runs it.

    x^ = m + M (s - C m),    m_{+} = A x^ + B u + f,    u = the load that acts until the next tick.

Samples that come late by some ticks correct the state of their own time, which the loads since then lead to now.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.lqr.plant.checks import ControlError


@dataclass(frozen=True)
class Filter:
    """Stationary Kalman filter, sampled at the ticks of a controller."""

    A: Array  # state a tick later without load, (N, N)
    B: Array  # of a load that is held for the tick, (N, n_s)
    f: Array  # of the constant load, (N,)
    C: Array  # samples of a state, those of the hand first, (p, N)
    M: Array  # correction of the state by what a sample shows, (N, p)
    names: tuple[str, ...]  # of the samples, p
    speed: bool = False  # whether the velocity of the hand is a sample
    delay: int = 0  # ticks that samples come late

    def __post_init__(self) -> None:
        N, n_s, p = len(self.A), self.B.shape[1], len(self.C)
        shapes = {"A": (N, N), "B": (N, n_s), "f": (N,), "C": (p, N), "M": (N, p)}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape or not np.isfinite(value).all():
                raise ControlError(f"{name} of the filter must be finite and of shape {shape}, not {value.shape}")
        if len(self.names) != p or self.others < 0 or self.delay < 0:
            raise ControlError(f"a filter of {p} samples has {len(self.names)} names and a delay of {self.delay} ticks")

    @property
    def others(self) -> int:
        """Samples that are not those of the hand."""
        return len(self.C) - (1 + self.speed) * int(self.B.shape[1])


class Estimate:
    """What a filter carries from tick to tick, from ``start``, the state at the first tick (N,).

    Raises ControlError: the hand was not measured at the first tick.
    """

    def __init__(self, filter_: Filter, start: Array) -> None:
        if not np.isfinite(start @ start):
            raise ControlError("the first samples of the hand must be finite; begin when q_s and v_s are measured")
        self.filter, self.m = filter_, start
        self.samples: deque[Array] = deque(maxlen=filter_.delay + 1)  # of the hand, at the ticks that y is late
        self.inputs: deque[Array] = deque(maxlen=filter_.delay)  # since the time of m

    def correct(self, q_s: Array, v_s: Array, y: Array | None) -> Array:
        """The state now, from the samples of a tick; entries of y that are no numbers are lost, None is all of them.

        Raises ControlError: y has another number of entries.
        """
        own = self.filter
        self.samples.append(np.concatenate([q_s, v_s]) if own.speed else np.array(q_s, dtype=float))
        if y is not None and np.shape(y) != (own.others,):
            raise ControlError(f"y has the shape {np.shape(y)}; this controller needs {own.others} samples beside q_s")
        if len(self.samples) <= own.delay:  # nothing has arrived
            return self._ahead(self.m)
        sample = np.concatenate([self.samples[0], np.full(own.others, np.nan) if y is None else y])
        off = sample - own.C @ self.m
        x = self.m + own.M @ off
        if not np.isfinite(x @ x):  # a sample is lost
            x = self.m + own.M @ np.where(np.isfinite(off), off, 0.0)
            if not np.isfinite(x @ x):  # a sample is absurd
                x = self.m
        if own.delay == 0:
            self.m = x
            return x
        self.m = own.A @ x + own.B @ self.inputs[0] + own.f
        return self._ahead(self.m, 1)

    def _ahead(self, x: Array, done: int = 0) -> Array:
        """The state now from that at the time of the first input but ``done``."""
        for u in list(self.inputs)[done:]:
            x = self.filter.A @ x + self.filter.B @ u + self.filter.f
        return x

    def apply(self, u: Array) -> None:
        """The load (n_s,) that acts until the next tick."""
        if self.filter.delay:
            self.inputs.append(u)
        else:
            self.m = self.filter.A @ self.m + self.filter.B @ u + self.filter.f
