"""Rows of hat functions h_j over the nodes of a face, N_j = sum_i h_j(x_i) N_i / sum_i h_j(x_i): mean gaps are >= 0."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.obstacles import Obstacle
from softgrasp.fem.petsc import Array
from softgrasp.reduction.contact.model import Ints, plane
from softgrasp.reduction.system import ModelError

# Power of the distance from the end by which hat functions crowd there, where pressures are steep; chosen on the
# motions whose errors docs/guide gives [1].
CROWD = 1.6
SAME = 1e-9  # of the face: nodes at one place along it [1]


def foremost(X: Array, kept: Ints, obstacles: tuple[Obstacle, ...], distance: float) -> Ints:
    """The kept nodes with no other one straight before them at rest, towards the obstacle that is nearest to them."""
    gaps = np.array([o.gap(X[kept]) for o in obstacles])
    first = np.ones(len(kept), dtype=bool)
    for j, o in enumerate(obstacles):
        n, mine = plane(o)[0], gaps.argmin(axis=0) == j
        beside = X[kept] - gaps[j][:, None] * n
        before = gaps[j][None, :] < gaps[j][:, None] - distance
        close = np.linalg.norm(beside[:, None] - beside[None], axis=2) < distance
        first &= ~(mine & (before & close).any(axis=1))
    return kept[first]


def hat_functions(X: Array, kept: Ints, obstacle: Obstacle, rows: int | None) -> Array:
    """Shares of the kept nodes in the rows of a half-space, (rows, nodes) [1]; fewer rows where there are fewer nodes.

    Raises ModelError: rows is less than 2, or the tissue is 3D.
    """
    if rows is None:
        return np.eye(len(kept))
    if X.shape[1] == 3 or rows < 2:
        raise ModelError(f"rows = {rows}; it must be at least 2, and in 3D every node has a row: leave it out")
    x = along(X[kept], obstacle)
    return hats_at(x, _ends(x, rows))


def along(X: Array, obstacle: Obstacle) -> Array:
    """Places of points along a half-space in 2D, (points,) [m]."""
    n = plane(obstacle)[0]
    return np.asarray(X @ np.array([-n[1], n[0]]))


def hats_at(x: Array, at: Array) -> Array:
    """Shares of nodes at places x in the hat functions that are 1 at some of them, (rows, nodes) [1]."""
    H = np.array([np.interp(x, np.sort(at), unit) for unit in np.eye(len(at))])
    return np.asarray(H / H.sum(axis=1, keepdims=True))


def nested_places(x: Array, C: Array, F: Array, most: int) -> Array:
    """Where hat functions are 1, such that the first few are the best few: both ends, then one place after another.

    Each is the one whose hat, from neighbour to neighbour, takes most of the responses to the forces, that is of
    tr F (C - C H' (H C H')^-1 H C), beside those before it.

    Args:
        x: places of the nodes, (nodes,) [m].
        C: inner products of the responses to a force on each, (nodes, nodes).
        F: products of the forces on them, (nodes, nodes); zero counts each node alike.
        most: number of places, at most; at least 2.
    """
    places = _distinct(x)
    if len(places) <= 2:
        return places
    F = F if F.any() else np.eye(len(x))
    chosen, left = [places[0], places[-1]], list(places[1:-1])
    for hat in hats_at(x, places[[0, -1]]):
        C = _without(C, hat)
    while left and len(chosen) < most:
        ends = np.sort(chosen)
        k = np.searchsorted(ends, left)
        between = zip(ends[k - 1], left, ends[k], strict=True)
        hats = np.array([np.interp(x, support, [0, 1, 0]) for support in between])
        answers = hats @ C
        size = np.einsum("ij,ij->i", answers, hats)
        taken = np.einsum("ij,ij->i", answers @ F, answers) / np.maximum(size, np.finfo(float).tiny)
        best = int(taken.argmax())
        C = _without(C, hats[best])
        chosen.append(left.pop(best))
    return np.array(chosen)


def _without(C: Array, hat: Array) -> Array:
    """Inner products of what is left of responses across that to one hat."""
    answer = C @ hat
    return np.asarray(C - np.outer(answer, answer) / float(hat @ answer))


def _distinct(x: Array) -> Array:
    places = np.sort(x)
    return np.asarray(places[np.diff(places, prepend=-np.inf) > SAME * np.ptp(x)])


def _ends(x: Array, rows: int) -> Array:
    """Where the hat functions are 1: different nodes, near places that crowd towards both ends, (rows,) [m]."""
    places = _distinct(x)
    rows = min(rows, len(places))
    s = np.linspace(-1.0, 1.0, rows)
    even = (1 + np.sign(s) * (1 - (1 - np.abs(s)) ** CROWD)) / 2
    nearest = np.abs(places[:, None] - (x.min() + np.ptp(x) * even)).argmin(axis=0)
    count = np.arange(rows)  # each end at least one node after that before it, and as many nodes are left behind it
    after = np.maximum.accumulate(nearest - count)
    return np.asarray(places[np.minimum(after, len(places) - rows) + count])
