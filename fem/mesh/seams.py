"""Where a mesh is open although its cells touch: doubled and hanging nodes (numpy only, not collective)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from softgrasp.fem.mesh.check import counted, longest_edges, place_text

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

SEAM = 1e-4  # of the shortest edge: above coordinates of 6 digits, far below any cell


@dataclass(frozen=True)
class Facets:
    """The facets of all cells, sorted so that equal ones are neighbours."""

    nodes: Integers  # sorted nodes of each facet, shape ((d + 1) n_cells, d)
    cells: Integers  # the cell of each facet
    same: npt.NDArray[np.bool_]  # whether a facet equals the next one, shape ((d + 1) n_cells - 1,)

    @property
    def outer(self) -> npt.NDArray[np.bool_]:
        """The facets that bound one cell only."""
        pair = np.concatenate([[False], self.same, [False]])
        return np.asarray(~(pair[1:] | pair[:-1]))


def sort_facets(cells: Integers) -> Facets:
    """The facets of simplices, shape (n_cells, d + 1)."""
    n, corners = cells.shape
    nodes = np.sort(np.concatenate([np.delete(cells, i, axis=1) for i in range(corners)]), axis=1)
    order = np.lexsort(nodes.T)
    nodes = nodes[order]
    return Facets(nodes, order % n, (nodes[1:] == nodes[:-1]).all(axis=1))


def doubled_nodes(points: Floats, cells: Integers, facets: Facets, tolerance: float) -> Integers:
    """The node that stands for each node: itself, or the first of the boundary nodes at its place.

    Two boundary nodes are at one place if |x - y| <= tolerance h, h the shortest edge of the boundary cells at both.

    Args:
        points: shape (n_points, d) [m].
        cells: simplices, shape (n_cells, d + 1).
        facets: their facets.
        tolerance: share of h, < 1/2 [1].
    """
    owners = cells[np.unique(facets.cells[facets.outer])]
    h = np.full(len(points), np.inf)
    for i, j in combinations(range(cells.shape[1]), 2):
        length = np.linalg.norm(points[owners[:, i]] - points[owners[:, j]], axis=1)
        np.minimum.at(h, owners[:, i], length)
        np.minimum.at(h, owners[:, j], length)
    nodes = np.unique(facets.nodes[facets.outer])
    tree = cKDTree(points[nodes])
    radius = tolerance * h[nodes]
    near = np.flatnonzero(tree.query_ball_point(points[nodes], radius, return_length=True) > 1)
    lists = tree.query_ball_point(points[nodes[near]], radius[near])
    one = nodes[np.repeat(near, [len(entry) for entry in lists])]
    other = nodes[np.concatenate([*lists, []]).astype(np.int64)]
    close = np.linalg.norm(points[one] - points[other], axis=1) <= tolerance * h[other]
    n = len(points)
    graph = coo_array((np.ones(int(close.sum()), dtype=np.int8), (one[close], other[close])), shape=(n, n))
    _, labels = connected_components(graph.tocsr(), directed=False)
    _, first = np.unique(labels, return_index=True)
    return np.asarray(first[labels], dtype=np.int64)


def hanging_nodes(points: Floats, cells: Integers, facets: Facets, tolerance: float) -> Integers:
    """Boundary nodes inside a boundary facet, or an edge of one, that is not their own.

    Args:
        points: shape (n_points, d) [m].
        cells: simplices, shape (n_cells, d + 1).
        facets: their facets.
        tolerance: largest distance from the facet over its longest edge, and least from its corners [1].
    """
    faces, owners = facets.nodes[facets.outer], cells[facets.cells[facets.outer]]
    nodes = np.unique(faces)
    middles = points[faces].mean(axis=1)
    radii = np.linalg.norm(points[faces] - middles[:, None], axis=2).max(axis=1)
    lists = cKDTree(points[nodes]).query_ball_point(middles, radii)  # its corners lie on that ball, and count not
    face = np.repeat(np.arange(len(faces)), [len(entry) for entry in lists])
    node = nodes[np.concatenate([*lists, []]).astype(np.int64)]
    foreign = (node[:, None] != owners[face]).all(axis=1)
    face, node = face[foreign], node[foreign]
    start = points[faces[face, 0]]
    edges = (points[faces[face, 1:]] - start[:, None]).transpose(0, 2, 1)
    away = points[node] - start
    shares = np.einsum("nij,nj->ni", np.linalg.pinv(edges), away)  # barycentric coordinates but the first
    off = np.linalg.norm(away - np.einsum("nji,ni->nj", edges, shares), axis=1)
    shares = np.column_stack([1 - shares.sum(axis=1), shares])
    on = (off <= tolerance * longest_edges(points, faces)[face]) & (shares.min(axis=1, initial=1) >= -tolerance)
    return np.unique(node[on & (shares.max(axis=1, initial=0) < 1 - tolerance)])


def doubled_text(points: Floats, first: Integers, tolerance: float, joined: bool, name: str) -> list[str]:
    """The warning about doubled nodes, from :func:`doubled_nodes`; empty if there are none."""
    nodes = np.flatnonzero(first != np.arange(len(first)))
    if not nodes.size:
        return []
    count, place = counted(nodes.size, "doubled node"), _where(points[first[nodes]])
    near = f"closer than {tolerance:g} of the shortest edge to another"
    if joined:
        return [f"{name} had {count} {place}, {near}: tissue.repair joined {'it' if nodes.size == 1 else 'them'}."]
    return [
        f"{name} has {count} {place}, {near}, and the body is open there as along a crack: "
        "set tissue.repair = true to join them, unless a crack is meant."
    ]


def hanging_text(points: Floats, nodes: Integers, name: str) -> list[str]:
    """The warning about hanging nodes, from :func:`hanging_nodes`; empty if there are none."""
    if not nodes.size:
        return []
    return [
        f"{name} has {counted(nodes.size, 'hanging node')} {_where(points[nodes])} on a side of a cell that has no "
        "corner there, and the body is open there as along a crack: remesh so that cells meet corner to corner."
    ]


def _where(x: Floats) -> str:
    low, high = place_text(x.min(axis=0)), place_text(x.max(axis=0))
    return f"at {low}" if low == high else f"between {low} and {high}"
