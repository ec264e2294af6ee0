"""R(x) = 0 by a kept tangent with L-BFGS pairs [NW06], the tangent factored anew where that does not converge."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from softgrasp.fem.petsc import Array

EPS = float(np.finfo(float).eps)
PAIRS = 4  # on 60 x 120 cells 2 need more iterations, 12 save none
MOST = 40  # largest number of iterations [1]
RENEW = 8  # iterations after which the tangent is factored anew [1]
SMALLEST = 2.0**-10  # smallest fraction of a correction [1]
GROWTH = 4.0  # growth of |R| beyond which a correction is halved [1]


class Root(NamedTuple):
    """Result of the iteration: x with |R(x)| below the target, or the last x where that was not reached."""

    x: Array  # last iterate, this rank's rows, (rows,)
    R: Array  # residual R(x), (rows,)
    norm: float  # |R(x)| over all ranks, infinite where the residual does not exist
    iterations: int  # number of corrections, or -1 without convergence [1]


@dataclass
class Counts:
    """Convergence record of a run, kept in restart files: it also decides when the tangent is factored anew."""

    iterations: int = 0  # corrections of all steps so far [1]
    steps: int = 0  # steps so far [1]
    most: int = 0  # largest number of corrections of a step [1]
    factors: int = 0  # tangents factored after the linear one [1]
    substepped: int = 0  # steps solved by substepping [1]
    first: int = -1  # corrections of the first step after the last factorisation [1]; -1 before that step
    iterations_since_factor: int = 0  # corrections since then in excess of ``first`` a step [1]
    min_det: float = np.inf  # smallest det F at the end of any step, on this rank's points [1]
    scale: float = 0.0  # largest of |f(z_0)| and |s pi + G c| so far, over all ranks [N]


@dataclass(frozen=True)
class NewtonFigures:
    """Convergence of the steps of a run."""

    mean: float  # mean number of iterations of a step [1]
    max: int  # largest number of iterations of a step [1]
    factors: int  # tangents factored after the linear one [1]
    min_det: float  # smallest det F at the end of any step, over all ranks [1]
    substepped: int  # steps solved by substepping [1]


class Pairs:
    """The last L-BFGS pairs: corrections dx and the changes dr of R, in slots that are filled in turn.

    Args:
        dots: products A x of rows on this rank, summed over all ranks, (m, rows) and (rows,) -> (m,).
        rows: length of a vector on this rank [1].

    Attributes:
        dx: correction of each slot, zero in an empty one, (PAIRS, rows).
        dr: change of R by the correction of each slot, (PAIRS, rows).
        order: slots of the pairs of this step, that of the oldest first; the others hold earlier pairs.
        products: dx_i'dr_j for a pair i older than j, (PAIRS, PAIRS).
    """

    def __init__(self, dots: Callable[[Array, Array], Array], rows: int) -> None:
        self.dots, self.dx, self.dr = dots, np.zeros((PAIRS, rows)), np.zeros((PAIRS, rows))
        self.order: list[int] = []
        self.products = np.zeros((PAIRS, PAIRS))  # dx_i'dr_j of an older i and a newer j

    def clear(self) -> None:
        """Remove all pairs."""
        self.order = []
        self.dx[:] = self.dr[:] = self.products[:] = 0.0

    def retire(self) -> None:
        """End a step: :meth:`improve` leaves its pairs out, as it would magnify rounding from step to step."""
        self.order = []

    def append(self, dx: Array, dr: Array) -> None:
        """Keep a pair of positive curvature dx'dr in the slot of the oldest one. Collective."""
        slot = (self.order[-1] + 1) % PAIRS if self.order else 0
        if not self.dots(dx[None], dr)[0] > 0:
            return
        self.order = [*self.order[-PAIRS + 1 :], slot]
        self.dx[slot], self.dr[slot] = dx, dr
        self.multiply(slot)

    def multiply(self, slot: int) -> None:
        """Update ``products`` for a new dr. Collective."""
        self.products[:, slot] = self.dots(self.dx, self.dr[slot])

    def cancel(self, x: Array, R: Array) -> Array | None:
        """Move x by a fraction of a correction, of earlier steps too, to x'R = 0; None if none is large. Collective."""
        work = self.dots(x[None], R)[0]
        if work == 0:
            return x
        bends = np.diag(self.products)  # dx'dr: x'R changes by -t (x'dr + dx'R) + t^2 dx'dr from x to x - t dx
        slopes = self.dots(self.dr, x) + self.dots(self.dx, R)  # zero in an empty slot
        # R bends along dx, and x'R is left with it: of this step's corrections the one with the least t dx'dr
        near = [i for i in self.order if abs(slopes[i]) > 100 * abs(work)]
        i = min(near, key=lambda i: bends[i] / abs(slopes[i])) if near else int(np.argmax(np.abs(slopes)))
        if abs(work) >= 0.1 * abs(slopes[i]):
            return None
        t = work / slopes[i]
        for _ in range(3):  # each adds two digits
            t = work / (slopes[i] - t * bends[i])
        return np.asarray(x - t * self.dx[i])

    def improve(self, solve: Callable[[Array], Array], R: Array) -> Array:
        """Approximation of J^-1 R, (rows,), J the Jacobian: L-BFGS's two loops around a solve with S. Collective."""
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
    """Quasi-Newton iteration for R(x) = 0; successive calls of ``find`` share its pairs."""

    residual: Callable[[Array], tuple[Array, float]]  # x -> R(x) and |R|, infinite or NaN where R does not exist
    solve: Callable[[Array], Array]  # q -> S^-1 q for the tangent S factored last, to its tolerance
    renew: Callable[[Array], bool]  # x -> whether the tangent at x was factored
    pairs: Pairs  # L-BFGS pairs of the iterations of the step so far

    def find(self, x: Array, target: float) -> Root:
        """Iterate from x until |R| <= target, halving corrections with R not finite or fourfold. Collective."""
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
