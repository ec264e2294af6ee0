"""R(x) = 0 by a kept tangent with L-BFGS pairs [NW06], the tangent made anew where that does not converge."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from softgrasp.fem.petsc import Array

PAIRS = 2  # more save no iteration where the tangent is made anew in time
MOST, RENEW = 40, 8  # iterations, and after how many of them the tangent is made anew
SMALLEST = 2.0**-10  # part of a correction
GROWTH = 4.0  # of |R|, beyond which a correction is halved


class Root(NamedTuple):
    """Where R is small.

    Attributes:
        x, R: the point and what is left there.
        norm: |R|, infinite where there is no R.
        spent: iterations, or -1 where R did not become small.
    """

    x: Array
    R: Array
    norm: float
    spent: int


@dataclass
class Counts:
    """What a restart needs: figures, the rule for a new tangent, the largest of |f(z_0)| and |s pi + G c| so far."""

    iterations: int = 0
    steps: int = 0
    most: int = 0
    factors: int = 0
    divided: int = 0
    first: int = -1  # iterations of the first step with this tangent
    spent: int = 0  # iterations above these since then
    min_det: float = np.inf
    scale: float = 0.0


@dataclass(frozen=True)
class NewtonFigures:
    """How the steps of a run converged.

    Attributes:
        mean, max: iterations of a step [1].
        factors: tangents factored after the linear one.
        min_det: smallest det F at the end of any step.
        divided: steps taken in parts.
    """

    mean: float
    max: int
    factors: int
    min_det: float
    divided: int


class QuasiNewton:
    """Iterations that share their pairs (dx, dr, 1/dx'dr), as the steps of a run do.

    Args:
        residual: R(x) and |R|, infinite or NaN where there is none.
        solve: about S^-1 q for the tangent S factored last.
        renew: factor the tangent at x; whether that worked.
        dot: sum over all rows.
    """

    def __init__(
        self,
        residual: Callable[[Array], tuple[Array, float]],
        solve: Callable[[Array], Array],
        renew: Callable[[Array], bool],
        dot: Callable[[Array, Array], float],
    ) -> None:
        self.residual, self.solve, self.renew, self.dot = residual, solve, renew, dot
        self.pairs: deque[tuple[Array, Array, float]] = deque(maxlen=PAIRS)

    def find(self, x: Array, target: float) -> Root:
        """From x until |R| <= target: a correction is halved while R is none or grows fourfold."""
        R, norm = self.residual(x)
        if not math.isfinite(norm):
            x = np.zeros_like(x)
            R, norm = self.residual(x)
        for count in range(MOST + 1):
            if norm <= target:
                return Root(x, R, norm, count)
            if count and count % RENEW == 0 and not self.renew(x):
                break
            p, part = self.direction(R), 1.0
            while True:
                new = x - p if part == 1.0 else x - part * p
                left, size = self.residual(new)
                if size < GROWTH * norm:  # false for what is not a number
                    break
                part /= 2
                if part < SMALLEST:
                    return Root(x, R, norm, -1)
            change = new - x, left - R
            curvature = self.dot(*change)
            if curvature > 0:
                self.pairs.append((*change, 1 / curvature))
            x, R, norm = new, left, size
        return Root(x, R, norm, -1)

    def direction(self, R: Array) -> Array:
        """About S^-1 R: the two loops of L-BFGS around a solve."""
        q, kept = R.copy(), []
        for dx, dr, rho in reversed(self.pairs):
            kept.append(rho * self.dot(dx, q))
            q -= kept[-1] * dr
        x = self.solve(q)
        for (dx, dr, rho), a in zip(self.pairs, reversed(kept), strict=True):
            x += (a - rho * self.dot(dr, x)) * dx
        return x
