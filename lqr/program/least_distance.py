"""min |x|^2 / 2 subject to G x <= h, the point of a polyhedron nearest to the origin, by a dual active set [GI83]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from softgrasp.fem.petsc import Array
from softgrasp.lqr.plant.checks import ControlError

VIOLATION = 1e-13  # of a unit row, over 1 + |x|: rounding of G x is a few times 1e-16
DEPENDENT = 1e-10  # part of a unit row outside the span of the active ones that is rounding


class InfeasibleError(ControlError):
    """No x keeps all rows."""


@dataclass(frozen=True)
class Nearest:
    """The solution, with G x <= h, x = -G'multipliers and multipliers'(G x - h) = 0."""

    x: Array  # point, (n,)
    multipliers: Array  # of the rows, >= 0, (m,)
    active: tuple[int, ...]  # rows that hold the point, linearly independent
    steps: int  # changes of the active set


def nearest(G: Array, h: Array, start: Sequence[int] = (), limit: int = 10_000) -> Nearest:
    """The solution of min |x|^2 / 2, G x <= h.

    Every step adds the row that is violated most and drops those whose multipliers would become negative; |x| grows
    with every row that is added, so no set comes twice.

    Args:
        G: rows, (m, n).
        h: right-hand side, (m,).
        start: rows to begin with, those that were active in a problem near to this one.
        limit: number of steps.

    Raises:
        InfeasibleError: no x keeps all rows.
        ControlError: more steps than ``limit``.
    """
    size = np.linalg.norm(G, axis=1)
    empty = size == 0
    if (h[empty] < 0).any():
        raise InfeasibleError("a row without entries is violated")
    size[empty] = 1.0
    G, h = G / size[:, None], np.where(empty, 0.0, h / size)
    x, active, multipliers = _restart(G, h, [i for i in start if not empty[i]])
    for step in range(limit):
        violation = G @ x - h
        worst = int(np.argmax(violation)) if len(h) else -1
        if worst < 0 or worst in active or violation[worst] <= VIOLATION * (1 + float(np.linalg.norm(x))):
            full = np.zeros(len(h))
            full[active] = multipliers / size[active]
            return Nearest(x, full, tuple(active), step)
        active, multipliers = _enter(G, active, multipliers, worst, float(violation[worst]))
        x = _point(G, h, active)
    raise ControlError(f"the active set of a plan did not settle in {limit} steps")


def _restart(G: Array, h: Array, active: list[int]) -> tuple[Array, list[int], Array]:
    """The point of the given rows, less those that are dependent or would pull."""
    if active:
        _, R, order = scipy.linalg.qr(G[active].T, mode="economic", pivoting=True)
        sizes = np.abs(np.diag(R))
        active = [active[i] for i in order[: int((sizes > DEPENDENT * sizes[0]).sum())]]
    while active:
        Q, R = scipy.linalg.qr(G[active].T, mode="economic")
        multipliers = -scipy.linalg.solve_triangular(R, scipy.linalg.solve_triangular(R, h[active], trans=1))
        if (multipliers >= 0).all():
            return Q @ scipy.linalg.solve_triangular(R, h[active], trans=1), active, multipliers
        active = [i for i, value in zip(active, multipliers, strict=True) if value >= 0]
    return np.zeros(G.shape[1]), [], np.zeros(0)


def _point(G: Array, h: Array, active: list[int]) -> Array:
    """The point nearest to the origin with equality in the active rows."""
    Q, R = scipy.linalg.qr(G[active].T, mode="economic")
    return np.asarray(Q @ scipy.linalg.solve_triangular(R, h[active], trans=1))


def _enter(G: Array, active: list[int], multipliers: Array, row: int, violation: float) -> tuple[list[int], Array]:
    """Raise the multiplier of a row until it holds, dropping rows whose multipliers reach zero."""
    own = 0.0
    while True:
        inside, outside = np.zeros(len(active)), G[row]
        if active:
            Q, R = scipy.linalg.qr(G[active].T, mode="economic")
            along = Q.T @ outside
            outside = outside - Q @ along
            again = Q.T @ outside  # a second projection: the first leaves rounding of the size of the row
            outside, along = outside - Q @ again, along + again
            try:
                inside = scipy.linalg.solve_triangular(R, along)
            except np.linalg.LinAlgError:  # x grows without end, until the rows that hold it are dependent by rounding
                raise InfeasibleError("no point keeps all rows, to rounding") from None
        square = float(outside @ outside)
        full = violation / square if square > DEPENDENT**2 else np.inf
        falls = np.flatnonzero(inside > 0)
        ratios = multipliers[falls] / inside[falls]
        first = int(np.argmin(ratios)) if len(falls) else -1
        length = min(full, float(ratios[first]) if first >= 0 else np.inf)
        if np.isinf(length):
            raise InfeasibleError("no point keeps all rows")
        multipliers, own = multipliers - length * inside, own + length
        violation -= length * square
        if length == full:
            return [*active, row], np.append(np.maximum(multipliers, 0.0), own)
        gone = int(falls[first])
        active, multipliers = active[:gone] + active[gone + 1 :], np.delete(multipliers, gone)


@dataclass(frozen=True)
class SoftNearest:
    """The solution with rows that may be exceeded."""

    x: Array  # point, (n,)
    slack: Array  # by how much the rows of each group are exceeded at most, (groups,)
    multipliers: Array  # of the soft rows, then of the hard ones, (m,)
    steps: int  # changes of the active set


def nearest_soft(
    G: Array,
    h: Array,
    group: NDArray[np.int64],
    hard: tuple[Array, Array],
    penalty: float,
    limit: int = 10_000,
    weight: float = 1.0,
) -> SoftNearest:
    """The solution of min |x|^2 / 2 + sum_i (penalty e_i + weight e_i^2 / 2), G x <= h + e of the row's group, e >= 0.

    The penalty is exact: e = 0 wherever some x keeps all rows and the multipliers of each group add to less than it.

    Args:
        G, h: soft rows, (m, n) and (m,).
        group: number of the group of each row, from 0, (m,).
        hard: rows that are never exceeded.
        penalty: price of a unit of e.
        weight: of the squares of e; with the square of the penalty all numbers are of the size of x.

    Raises InfeasibleError: the hard rows alone cannot be kept.
    """
    count, n = int(group.max(initial=-1)) + 1, G.shape[1]
    # with e = e' / root - penalty / weight the problem is one of least distance again
    root, free = weight**0.5, penalty / weight
    rows = np.zeros((len(h) + len(hard[1]) + count, n + count))
    rows[: len(h), :n], rows[len(h) : len(rows) - count, :n] = G, hard[0]
    rows[np.arange(len(h)), n + group] = -1.0 / root
    rows[len(rows) - count :, n:] = -np.eye(count)
    right = np.concatenate([h - free, hard[1], np.full(count, -root * free)])
    found = nearest(rows, right, range(len(rows) - count, len(rows)), limit)
    slack = np.maximum(found.x[n:] / root - free, 0.0)
    return SoftNearest(found.x[:n], slack, found.multipliers[: len(rows) - count], found.steps)
