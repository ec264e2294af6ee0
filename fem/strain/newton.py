"""R(x) = 0 by a kept tangent with L-BFGS pairs [NW06], the tangent made anew where that does not converge."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from softgrasp.fem.petsc import Array

PAIRS = 4  # on 60 x 120 cells 2 cost more iterations, 12 save none
MOST, RENEW = 40, 8  # iterations, and after how many of them the tangent is made anew
SMALLEST = 2.0**-10  # part of a correction
GROWTH = 4.0  # of |R|, beyond which a correction is halved


class Root(NamedTuple):
    """Where R is small."""

    x: Array
    R: Array  # what is left there
    norm: float  # |R|, infinite where there is no R
    spent: int  # iterations, or -1 where R did not become small


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
    """How the steps of a run converged."""

    mean: float  # iterations of a step [1]
    max: int  # their largest number [1]
    factors: int  # tangents factored after the linear one
    min_det: float  # smallest det F at the end of any step
    divided: int  # steps taken in parts


class Pairs:
    """The last pairs dx, dr of corrections and what they changed of R, in slots that are filled in turn.

    Args:
        dots: A x, summed over all rows.
        rows: of a vector on this rank.

    Attributes:
        dx, dr: by slot, zero while it is empty, (PAIRS, rows).
        order: slots from the oldest pair to the last.
    """

    def __init__(self, dots: Callable[[Array, Array], Array], rows: int) -> None:
        self.dots, self.dx, self.dr = dots, np.zeros((PAIRS, rows)), np.zeros((PAIRS, rows))
        self.order: list[int] = []
        self.products = np.zeros((PAIRS, PAIRS))  # dx_i'dr_j of an older i and a newer j

    def clear(self) -> None:
        """Forget all."""
        self.order = []
        self.dx[:] = self.dr[:] = 0.0

    def append(self, dx: Array, dr: Array) -> None:
        """Take a pair if it has a positive curvature, in the place of the oldest. Collective."""
        slot = (self.order[-1] + 1) % PAIRS if self.order else 0
        if not self.dots(dx[None], dr)[0] > 0:
            return
        self.order = [*self.order[-PAIRS + 1 :], slot]
        self.dx[slot], self.dr[slot] = dx, dr
        self.multiply(slot)

    def multiply(self, slot: int) -> None:
        """The products with a new dr. Collective."""
        self.products[:, slot] = self.dots(self.dx, self.dr[slot])

    def improve(self, solve: Callable[[Array], Array], R: Array) -> Array:
        """About S^-1 R: the two loops of L-BFGS around a solve, four products of all pairs. Collective."""
        if not self.order:
            return solve(R)
        g, a, b = self.products, np.zeros(PAIRS), np.zeros(PAIRS)
        seen = self.dots(self.dx, R)
        for i in reversed(self.order):
            a[i] = (seen[i] - g[i] @ a) / g[i, i]  # a is zero yet where the pair is older
        x = solve(R - a @ self.dr)
        seen = self.dots(self.dr, x)
        for i in self.order:
            b[i] = a[i] - (seen[i] + g[:, i] @ b) / g[i, i]
        return np.asarray(x + b @ self.dx)


@dataclass(frozen=True)
class QuasiNewton:
    """Iterations that share their pairs, as the steps of a run do."""

    residual: Callable[[Array], tuple[Array, float]]  # R(x) and |R|, infinite or NaN where there is none
    solve: Callable[[Array], Array]  # about S^-1 q for the tangent S factored last
    renew: Callable[[Array], bool]  # factor the tangent at x; whether that worked
    pairs: Pairs  # of the iterations so far

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
            p, part = self.pairs.improve(self.solve, R), 1.0
            while True:
                new = x - p if part == 1.0 else x - part * p
                left, size = self.residual(new)
                if size < GROWTH * norm:  # false for what is not a number
                    break
                part /= 2
                if part < SMALLEST:
                    return Root(x, R, norm, -1)
            self.pairs.append(new - x, left - R)
            x, R, norm = new, left, size
        return Root(x, R, norm, -1)
