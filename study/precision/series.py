"""Outputs of a run over time, its times, and how far it is from the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from softgrasp.fem.petsc import Array


@dataclass(frozen=True)
class Series:
    """Outputs over time: deformations y - rigid, what the tissue does, and displacements y, side by side.

    Attributes:
        times: (steps + 1,) [s].
        values: (steps + 1, 2 p) [m].
        dimension: d; p is a multiple of it.
    """

    times: Array
    values: Array
    dimension: int

    def at(self, times: Array) -> Array:
        """Values at other times, by cubic splines."""
        if len(times) == len(self.times) and np.allclose(times, self.times, rtol=0, atol=1e-12 * self.times[-1]):
            return self.values
        return np.asarray(CubicSpline(self.times, self.values)(times))


@dataclass(frozen=True)
class TimedRun:
    """One run of the full model.

    Attributes:
        mesh, assembly, factor, per_step: seconds, medians.
        n_e, states, dimension, steps: sizes.
        dt: step [s].
        p50, p99, max: quantiles of the seconds of a step.
        seconds: of the whole run.
        times, values: of its :class:`Series`.
    """

    mesh: float
    assembly: float
    n_e: int
    states: int
    dimension: int
    steps: int
    dt: float
    factor: float
    per_step: float
    p50: float
    p99: float
    max: float
    seconds: float
    times: Array
    values: Array

    @property
    def series(self) -> Series:
        """Its outputs."""
        return Series(self.times, self.values, self.dimension)


def largest(values: Array, d: int) -> tuple[float, float]:
    """Largest length of the vectors in the first half of the columns, and in the second."""
    places = values.reshape(len(values), 2, -1, d)
    lengths = np.linalg.norm(places, axis=3).max(axis=(0, 2))
    return float(lengths[0]), float(lengths[1])


def errors_of(series: Series, true: Series) -> tuple[float, float]:
    """Largest error over the largest value: of the deformation, the measure of a study, and of the displacement.

    The rigid motion of the hand is many times the deformation, and hides it in the second.
    """
    scale = largest(true.values, true.dimension)
    gap = largest(series.values - true.at(series.times), true.dimension)
    return tuple(g / s if s > 0 else 0.0 for g, s in zip(gap, scale, strict=True))  # type: ignore[return-value]
