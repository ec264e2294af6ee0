"""Rows of a program that others imply: a node between others moves nearly as they do.

The hand moves all nodes alike. In the half-space of one interval the row of node j is left with, for weights w_a >= 0
of other nodes with sum 1, and n.S_j its row of the modes,

    left_j >= sum_a w_a left_a - d_j - c_j.z,    d_j = sum_a w_a v_a - v_j,    c_j = |n.(S_j - sum_a w_a S_a)|,

v the gaps of the first plan, and z how far the modes are from it, with what their swings add between two instants. The
rows that stay keep max(0, d_j + c_j.r) for all that they stand for, with r what z is near to the first plan, and where
a plan is judged what z has beyond r, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.petsc import Array

NEAREST = 6  # earlier nodes among which those about a node are sought
ROOM = 32  # nodes that stay, for which there is room at first, and more each time
BESIDE = 1e-9  # of the extent: a node so near to a mean of others lies there


@dataclass(frozen=True)
class Order:
    """Nodes of a surface from coarse to fine, each with means of earlier ones that stand for it."""

    nodes: NDArray[np.int64]  # all, coarse ones first, (nodes,)
    about: tuple[NDArray[np.int64], ...]  # of each in this order, earlier nodes, (<= d,)
    means: tuple[Array, ...]  # weights of these, the mean nearest to the node, then each alone, (means, <= d)


@dataclass(frozen=True)
class Thinned:
    """Nodes whose rows stay in a half-space, and what they keep for the others."""

    nodes: NDArray[np.int64]  # those that stay at some instant, (some,)
    stays: NDArray[np.bool_]  # where they do, (parts + 1, some)
    least: Array  # what every row keeps while z is at most r, (parts + 1, some) [m]
    spread: Array  # what it keeps more for a unit of z beyond that, (parts + 1, some, k)


def coarse_to_fine(places: Array) -> Order:
    """An order in which every node is the one farthest from all before it.

    ``places``: (nodes, d) [m].
    """
    count, extent = len(places), float(np.ptp(places, axis=0).max()) or 1.0
    nodes, near = np.zeros(count, dtype=np.int64), np.full((count, NEAREST), -1)
    off = np.linalg.norm(places - places.mean(axis=0), axis=1)
    for i in range(count):
        node = int(np.argmax(np.round(off / extent, 9)))  # the first of equal ones
        apart = np.linalg.norm(places - places[node], axis=1)
        earlier = np.round(apart[nodes[:i]] / extent, 9)
        some = np.arange(i)
        if i > NEAREST:
            some = np.flatnonzero(earlier <= np.partition(earlier, NEAREST - 1)[NEAREST - 1])
        some = some[np.argsort(earlier[some], kind="stable")[:NEAREST]]
        near[i, : len(some)] = nodes[some]
        off = np.minimum(off, apart) if i else apart
        nodes[i] = node
        off[node] = -1.0
    about = _nearest_means(places, nodes, near, BESIDE * extent)
    means = (np.vstack([weights, np.eye(len(some))]) if len(some) else np.zeros((0, 0)) for some, weights in about)
    return Order(nodes, tuple(some for some, _ in about), tuple(means))


def _nearest_means(
    places: Array, nodes: NDArray[np.int64], near: NDArray[np.int64], same: float
) -> list[tuple[NDArray[np.int64], Array]]:
    """Of every node at most d of those near to it, the closest ones, whose mean comes nearest, and its weights.

    ``near``: numbers of nodes, closest ones first, -1 behind the last one, (nodes, NEAREST).
    """
    count, d = places.shape
    least = np.full(count, np.inf)
    best, weights = np.full((count, d), -1), np.zeros((count, d))
    best[:, 0], weights[:, 0] = near[:, 0], 1.0
    for size in range(1, d + 1):
        for chosen in combinations(range(NEAREST), size):
            here = np.flatnonzero(near[:, chosen[-1]] >= 0)
            corners = places[near[here][:, chosen]]
            edges, off = (corners[:, 1:] - corners[:, :1]).swapaxes(1, 2), places[nodes[here]] - corners[:, 0]
            inner = np.einsum("ned,nd->ne", np.linalg.pinv(edges), off)  # edges in a line have the least weights
            w = np.column_stack([1 - inner.sum(axis=1), inner])
            distance = np.maximum(np.linalg.norm(off - np.einsum("nde,ne->nd", edges, inner), axis=1), same)
            better = (w >= 0).all(axis=1) & (distance < (1 - 1e-6) * least[here])
            at = here[better]
            least[at], best[at], weights[at] = distance[better], -1, 0.0
            best[at, :size], weights[at, :size] = near[at][:, chosen], w[better]
    return [(some[some >= 0], w[some >= 0]) for some, w in zip(best, weights, strict=True)]


def thinned(order: Order, v: Array, seen: Array, reach: Array, whole: Array, most: Array) -> Thinned:
    """The nodes whose rows stay.

    Args:
        v: gaps of the first plan at every instant, (parts + 1, nodes) [m].
        seen: n.S_j, (nodes, k).
        reach: r, (parts + 1, k).
        whole: the largest z of a plan that can be taken, (parts + 1, k).
        most: what a row may keep for others at every instant, (parts + 1,) [m].
    """
    instants, count = v.shape
    found: list[int] = []
    mean: Array = np.zeros((instants, count, 0))  # of every node, by those found
    least: Array = np.zeros((instants, 0))
    spread: Array = np.zeros((instants, 0, seen.shape[1]))
    for j, about, means in zip(order.nodes.tolist(), order.about, order.means, strict=True):
        w = np.einsum("mp,ipa->ima", means, mean[:, about, : len(found)])
        d = np.einsum("ima,ia->im", w, v[:, found]) - v[:, j, None]
        c = np.abs(seen[j] - w @ seen[found])
        near, far = (d + np.einsum("imk,ik->im", c, z) for z in (reach, whole))
        none = np.full((instants, 1), np.inf)
        needs = np.hstack([np.maximum(near, 0.0), none])
        best = np.argmin(needs, axis=1)
        stays = needs[np.arange(instants), best] > most
        if stays.any():
            if len(found) == mean.shape[2]:
                mean, least, spread = (
                    np.pad(x, [(0, ROOM if axis == at else 0) for axis in range(x.ndim)])
                    for x, at in ((mean, 2), (least, 1), (spread, 1))
                )
            mean[stays, j, len(found)] = 1.0
            found.append(j)
        for i in np.flatnonzero(~stays).tolist():
            m = int(best[i])
            mean[i, j, : w.shape[2]] = w[i, m]
            stand = np.flatnonzero(w[i, m])
            least[i, stand] = np.maximum(least[i, stand], near[i, m])
            # max(0, d + c.z), which is convex, where it begins behind r: its chord
            share = 1.0 if near[i, m] >= 0 else far[i, m] / (far[i, m] - near[i, m]) if far[i, m] > 0 else 0.0
            spread[i, stand] = np.maximum(spread[i, stand], share * c[i, m])
    some, every = len(found), np.array(found, dtype=np.int64)
    return Thinned(every, mean[:, every, np.arange(some)] == 1.0, least[:, :some], spread[:, :some])
