"""How many cells `bisect_to` would leave of a large mesh, from a sample of its cells, each split on its own.

In each pass all edges of a cell that is too large are halved, and those that it shares with such a neighbour, which the
cell mirrored at the middle of that edge stands for; then the longest edge of each triangle with a halved one [PC00].
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from softgrasp.fem.mesh.check import ALONG, Flags, Floats, Integers, with_nodes
from softgrasp.fem.mesh.grading import MOST_LEVELS, SLACK, SizeField
from softgrasp.fem.mesh.singular import Ends

SAMPLED = {2: 6000, 3: 1500}  # cells of the mesh that are split, and as many at singular ends, by dimension [1]
FOLLOWED = 4  # cells that are split further over these [1]
NEAREST = 8  # singular ends to which distances are measured [1]
MOST_COMPARED = 20_000_000  # ends and cells whose distances are all computed [1]: 160 MB
# More cells over those of the sample [1]: halved edges pass on to more cells than neighbours. With it 0.97 to 1.00 of
# the cells that bisection left in 2D and 0.87 to 1.08 in 3D, on bars of 2e3 to 4e4 cells, with a tolerance and without.
MORE = {2: 1.0, 3: 1.15}


def bisected_count(points: Floats, cells: Integers, size: SizeField) -> float:
    """Number of cells after :func:`softgrasp.fem.mesh.grading.bisect_to`, about."""
    d, random = points.shape[1], np.random.default_rng(0)
    near = _at_ends(points, cells, size.ends)
    rest = np.setdiff1d(np.arange(len(cells)), near, assume_unique=True) if len(near) else np.arange(len(cells))
    parts = [(part, random.choice(part, min(SAMPLED[d], len(part)), replace=False)) for part in (near, rest)]
    weights = np.concatenate([np.full(len(few), len(part) / max(len(few), 1)) for part, few in parts])
    x = points[cells[np.concatenate([few for _, few in parts])]]
    field = _Sizes(size, x.mean(axis=1))
    owner, before = np.arange(len(x)), len(cells)
    count = 0.0
    for _ in range(MOST_LEVELS):
        halved, large = _halved(x, field, owner)
        split = halved.any(axis=1)
        count += weights[~split].sum()
        if not split.any():
            break
        x, parent = _split(x[split], halved[split])
        weights, owner = weights[split][parent], owner[split][parent]
        if not large.any():
            count += weights.sum()
            break
        if len(x) > 2 * FOLLOWED * SAMPLED[d]:
            kept = random.choice(len(x), FOLLOWED * SAMPLED[d], replace=False)
            weights = weights[kept] * (weights.sum() / weights[kept].sum())
            x, owner = x[kept], owner[kept]
    else:
        count += weights.sum()
    return float(before + MORE[d] * (count - before))


def _at_ends(points: Floats, cells: Integers, ends: Ends) -> Integers:
    """Cells that share a node with those at singular ends."""
    d = points.shape[1]
    on = np.isin((points * ALONG[:d]).sum(axis=1), (ends.at.reshape(-1, d) * ALONG[:d]).sum(axis=1))
    on[cells[with_nodes(cells, on, 1)]] = True
    return with_nodes(cells, on, 1)


class _Sizes:
    """The size field near to sampled cells, from the ends that are nearest to each."""

    def __init__(self, size: SizeField, middles: Floats) -> None:
        self.size, at = size, size.ends.at
        self.near: Integers | None = None
        if len(at) > NEAREST:
            self.near = _nearest(at.mean(axis=1), middles)

    def __call__(self, x: Floats, owner: Integers) -> Floats:
        """Sizes at points (n, d) in, or beside, sampled cells (n,), [m]."""
        if self.near is None:
            return self.size(x)
        at = self.size.ends.at[self.near[owner]]  # (n, NEAREST, d - 1, d)
        r = x[:, None] - at[:, :, 0]
        if at.shape[2] == 2:
            edge = at[:, :, 1] - at[:, :, 0]
            share = np.einsum("nij,nij->ni", r, edge) / np.einsum("nij,nij->ni", edge, edge)
            r = r - np.clip(share, 0.0, 1.0)[..., None] * edge
        return self.size.at_distance(np.sqrt(np.einsum("nij,nij->ni", r, r).min(axis=1)))


def _nearest(points: Floats, places: Floats) -> Integers:
    """Numbers of the points that are nearest to each place, (places, NEAREST)."""
    if len(points) * len(places) > MOST_COMPARED:
        from scipy.spatial import cKDTree  # slow to import

        return np.asarray(cKDTree(points).query(places, NEAREST)[1])
    far = np.einsum("ij,ij->i", points, points) - 2 * places @ points.T  # squares of distances but for each place's own
    return np.argpartition(far, NEAREST, axis=1)[:, :NEAREST]


def _halved(x: Floats, size: _Sizes, owner: Integers) -> tuple[Flags, Flags]:
    """Which edges of each cell (n, d + 1, d) are halved in a pass, (n, edges), and which cells are too large, (n,)."""
    corners = x.shape[1]
    edges = list(combinations(range(corners), 2))
    lengths = _lengths(x, edges)
    longest, middle = lengths.max(axis=1), x.mean(axis=1)
    others = [x[:, i] + x[:, j] - middle for i, j in edges]
    sizes = size(np.concatenate([middle, *others]), np.tile(owner, len(edges) + 1)).reshape(len(edges) + 1, -1)
    large = longest > SLACK * sizes[0]
    halved = large[:, None] | (longest > SLACK * sizes[1:]).T
    for _ in edges:  # until it spreads no further
        for face in combinations(range(corners), 3):
            of = np.array([edges.index(edge) for edge in combinations(face, 2)])
            rows = np.flatnonzero(halved[:, of].any(axis=1))
            halved[rows, of[lengths[np.ix_(rows, of)].argmax(axis=1)]] = True
    return halved, large


def _lengths(x: Floats, edges: list[tuple[int, int]]) -> Floats:
    return np.stack([np.linalg.norm(x[:, i] - x[:, j], axis=1) for i, j in edges], axis=1)


def _split(x: Floats, halved: Flags) -> tuple[Floats, Integers]:
    """Cells cut in two through their longest halved edge until none is left, and the cell that each is part of."""
    edges = np.array(list(combinations(range(x.shape[1]), 2)))
    done: list[Floats] = []
    owners: list[Integers] = []
    owner = np.arange(len(x))
    while len(x):
        through = edges[np.where(halved, _lengths(x, [tuple(edge) for edge in edges]), -1.0).argmax(axis=1)]
        rows = np.arange(len(x))
        middle = x[rows[:, None], through].mean(axis=1)
        parts = []
        for k in range(2):
            part, moved = x.copy(), through[:, k]
            part[rows, moved] = middle
            parts.append((part, halved & (edges[None] != moved[:, None, None]).all(axis=2)))
        x, halved, owner = (np.concatenate(each) for each in (*zip(*parts, strict=True), (owner, owner)))
        ready = ~halved.any(axis=1)
        done.append(x[ready])
        owners.append(owner[ready])
        x, halved, owner = x[~ready], halved[~ready], owner[~ready]
    return np.concatenate(done), np.concatenate(owners)
