"""Faults of a simplex mesh in arrays: flat or inverted cells, open seams, loose parts (not collective).

``points`` are coordinates (n_points, d) [m], d = 2 or 3, ``cells`` nodes (n_cells, d + 1), ``facets`` those of
:func:`sort_facets`, and ``name`` is that of the mesh, for messages.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from softgrasp.fem.compiled import functions, packed
from softgrasp.fem.errors import MeshError
from softgrasp.fem.shown import counted

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Ints = npt.NDArray[np.int32]  # numbers and marks as DOLFINx has them
Flags = npt.NDArray[np.bool_]

MOST_PAIRS = 500_000  # of balls and points that are compared one by one [1], 12 MB: the tree is slow to import
ALONG = np.array([1.0, 2**0.5, 3**0.5])  # few nodes have the same place in this direction, those of lattices neither
FLAT = 1e-12  # volume over (longest edge)^d: far above round-off (1e-16), far below any usable cell


def _compiled() -> Any:
    return functions(Path(__file__).with_name("skin.c"), "meshes are checked by NumPy, more slowly")


def signed_volumes(points: Floats, cells: Integers) -> Floats:
    """V = det [x_1 - x_0, ..., x_d - x_0] / d! of each simplex, negative if inverted."""
    edges = points[cells[:, 1:]] - points[cells[:, :1]]
    return np.asarray(np.linalg.det(edges) / math.factorial(points.shape[1]), dtype=np.float64)


def sizes_of(points: Floats, facets: Integers) -> Floats:
    """Lengths or areas of facets (n, d), (n,) [m^(d-1)]."""
    edges = points[facets[:, 1:]] - points[facets[:, :1]]
    gram = np.linalg.det(edges @ edges.transpose(0, 2, 1))
    return np.asarray(np.sqrt(gram) / math.factorial(edges.shape[1]))


def longest_edges(points: Floats, cells: Integers) -> Floats:
    """Longest edge of each simplex [m]."""
    longest = np.zeros(len(cells))
    for i in range(cells.shape[1]):
        for j in range(i):
            longest = np.maximum(longest, np.linalg.norm(points[cells[:, i]] - points[cells[:, j]], axis=1))
    return longest


def quality(points: Floats, cells: Integers) -> Floats:
    """Signed volume of each simplex over (longest edge)^d [1]: at most `FLAT` in size if flat, negative if inverted."""
    if (code := _compiled()) is not None:
        x, nodes = np.ascontiguousarray(points), np.ascontiguousarray(cells, dtype=np.int64)
        shape = np.empty(len(nodes))
        code.softgrasp_skin(packed(len(nodes), x.shape[1], nodes, x, shape, None))
        return shape
    volumes, edges = signed_volumes(points, cells), longest_edges(points, cells)
    return np.asarray(np.divide(volumes, edges ** points.shape[1], out=np.zeros_like(volumes), where=edges != 0))


def check_cells(points: Floats, cells: Integers, repair: bool, name: str) -> Integers:
    """Return cells of positive volume, or refuse the mesh.

    Flat cells are refused always; inverted cells (also if all of them are) unless ``repair`` turns them round by
    swapping their last two nodes. Raises MeshError: a coordinate is not finite, or a cell is flat or inverted.
    """
    bad_points = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad_points.size:
        raise MeshError(
            f"{name} has {counted(bad_points.size, 'point')} with NaN or infinite coordinates, "
            f"the first is {bad_points[0]}: export the mesh again."
        )
    shape = quality(points, cells)
    flat = np.abs(shape) <= FLAT
    if flat.any():
        worst = int(np.argmin(np.abs(shape)))
        raise MeshError(
            f"{name} has {counted(int(flat.sum()), 'cell')} of zero volume, the worst is cell {worst} around "
            f"{_middle(points, cells, worst)}: remove or remesh them."
        )
    inverted = shape < 0
    if not inverted.any():
        return cells
    if not repair:
        worst = int(np.argmin(shape))
        raise MeshError(
            f"{name} has {counted(int(inverted.sum()), 'inverted cell')} of {len(cells)}, the worst is cell {worst} "
            f"around {_middle(points, cells, worst)}: set tissue.repair = true to turn them round, "
            "or export the mesh again."
        )
    turned = cells.copy()
    turned[np.ix_(inverted, [-2, -1])] = cells[np.ix_(inverted, [-1, -2])]
    return turned


def linked(one: Integers, other: Integers, n: int) -> Integers:
    """The smallest item that each of n items is connected with by these links, itself perhaps.

    Each link passes the smaller number on, and each item takes over that of the item whose number it has.
    """
    label = np.arange(n)
    while True:
        low = np.minimum(label[one], label[other])
        lower = label.copy()
        np.minimum.at(lower, label[one], low)
        np.minimum.at(lower, label[other], low)
        lower = lower[lower]
        if np.array_equal(lower, label):
            return label
        label = lower


def components(cells: Integers, n_points: int) -> tuple[int, Ints]:
    """Count the parts of a mesh that share no node, and label each cell with its part (from 0)."""
    rows = np.repeat(cells[:, 0], cells.shape[1] - 1)
    columns = cells[:, 1:].ravel()
    used, parts = np.unique(linked(rows, columns, n_points)[cells[:, 0]], return_inverse=True)
    return len(used), parts.astype(np.int32)


def place_text(point: Floats) -> str:
    """A point for a message, "(1, 0.5)"."""
    return "(" + ", ".join(f"{x:.6g}" for x in point) + ")"


def _middle(points: Floats, cells: Integers, cell: int) -> str:
    return place_text(points[cells[cell]].mean(axis=0))


SEAM = 1e-4  # of the shortest edge: above coordinates of 6 digits, far below any cell


@dataclass(frozen=True)
class Facets:
    """The facets of all cells, sorted so that equal ones are neighbours."""

    nodes: Integers  # sorted nodes of each facet, shape ((d + 1) n_cells, d)
    cells: Integers  # the cell of each facet
    same: Flags  # whether a facet equals the next one, shape ((d + 1) n_cells - 1,)

    @property
    def outer(self) -> Flags:
        """The facets that bound one cell only."""
        pair = np.concatenate([[False], self.same, [False]])
        return np.asarray(~(pair[1:] | pair[:-1]))

    @property
    def pairs(self) -> tuple[Integers, Integers]:
        """The two cells of each inner facet."""
        return self.cells[:-1][self.same], self.cells[1:][self.same]


def sort_facets(cells: Integers, among: Flags | None = None) -> Facets:
    """The facets of simplices, shape (n_cells, d + 1); with ``among`` those whose nodes all have this flag."""
    n, corners = cells.shape
    nodes, owners = np.concatenate([np.delete(cells, i, axis=1) for i in range(corners)]), np.arange(n * corners) % n
    if among is not None:
        kept = among[nodes].all(axis=1)
        nodes, owners = nodes[kept], owners[kept]
    nodes = np.sort(nodes, axis=1)
    order = np.lexsort(nodes.T)
    nodes = nodes[order]
    return Facets(nodes, owners[order], (nodes[1:] == nodes[:-1]).all(axis=1))


def on_boundary(cells: Integers, n_points: int) -> Flags:
    """Whether nodes lie on facets that bound one cell, or another odd number, (n_points,); all without compiled code.

    Each facet adds a number, which its nodes alone decide, to those of its nodes by exclusive or: the numbers of a
    facet between two cells cancel, so that nothing is left at a node inside.
    """
    if (code := _compiled()) is None:
        return np.ones(n_points, dtype=np.bool_)
    nodes, fold = np.ascontiguousarray(cells, dtype=np.int64), np.zeros(n_points, dtype=np.uint64)
    code.softgrasp_skin(packed(len(nodes), nodes.shape[1] - 1, nodes, None, None, fold))
    return np.asarray(fold != 0)


def outer_facets(cells: Integers, n_points: int) -> Facets:
    """Those of :func:`sort_facets` whose nodes all lie on the boundary, all outer ones among them."""
    on = on_boundary(cells, n_points)
    some = with_nodes(cells, on, cells.shape[1] - 1)
    sides = sort_facets(cells[some], on)
    return Facets(sides.nodes, some[sides.cells], sides.same)


def with_nodes(cells: Integers, flags: Flags, least: int) -> Integers:
    """Numbers of the cells that have so many of the flagged nodes or more."""
    count = flags[cells[:, 0]].astype(np.int8)
    for nodes in cells.T[1:]:
        count += flags[nodes]
    return np.flatnonzero(count >= least)


def _within(points: Floats, middles: Floats, radii: Floats) -> tuple[Integers, Integers]:
    """Numbers of a ball and of a point in it, for all pairs of both."""
    along = ALONG[: points.shape[1]]
    at, places = points @ along, middles @ along
    order = np.argsort(at, kind="stable")
    reach = radii * (np.linalg.norm(along) * (1 + 1e-9)) + 1e-14 * np.abs(at).max(initial=0.0)  # and rounding
    begin = np.searchsorted(at[order], places - reach)
    count = np.searchsorted(at[order], places + reach, side="right") - begin
    if count.sum() <= MOST_PAIRS:
        ball = np.repeat(np.arange(len(middles)), count)
        point = order[np.arange(len(ball)) + np.repeat(begin - np.cumsum(count) + count, count)]
        inside = ((middles[ball] - points[point]) ** 2).sum(axis=1) <= radii[ball] ** 2
        return ball[inside], point[inside]
    from scipy.spatial import cKDTree  # slow to import

    lists = cKDTree(points).query_ball_point(middles, radii)
    return np.repeat(np.arange(len(lists)), [len(entry) for entry in lists]), np.concatenate([*lists, []]).astype(int)


def doubled_nodes(points: Floats, cells: Integers, facets: Facets, tolerance: float) -> Integers:
    """Representative of each node: itself, or the first of the boundary nodes at its place.

    Two boundary nodes are at one place if |x - y| <= tolerance h, h the shortest edge of the boundary cells at both.

    ``tolerance``: share of h, < 1/2 [1].
    """
    owners = cells[np.unique(facets.cells[facets.outer])]
    h = np.full(len(points), np.inf)
    for i, j in combinations(range(cells.shape[1]), 2):
        length = np.linalg.norm(points[owners[:, i]] - points[owners[:, j]], axis=1)
        np.minimum.at(h, owners[:, i], length)
        np.minimum.at(h, owners[:, j], length)
    nodes = np.unique(facets.nodes[facets.outer])
    at, near = _within(points[nodes], points[nodes], tolerance * h[nodes])
    one, other = nodes[at], nodes[near]
    close = np.linalg.norm(points[one] - points[other], axis=1) <= tolerance * h[other]
    return linked(one[close], other[close], len(points))


def hanging_nodes(points: Floats, cells: Integers, facets: Facets, tolerance: float) -> Integers:
    """Boundary nodes inside a boundary facet, or an edge of one, that is not their own.

    ``tolerance``: largest distance from the facet over its longest edge, and least from its corners [1].
    """
    faces, owners = facets.nodes[facets.outer], cells[facets.cells[facets.outer]]
    nodes = np.unique(faces)
    middles = points[faces].mean(axis=1)
    radii = np.linalg.norm(points[faces] - middles[:, None], axis=2).max(axis=1)
    face, near = _within(points[nodes], middles, radii)  # its corners lie on that ball, and count not
    node = nodes[near]
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


def doubled_text(
    points: Floats,
    first: Integers,
    tolerance: float,
    joined: bool,
    name: str,
    advice: str = "set tissue.repair = true to join them",
) -> list[str]:
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
        f"{advice}, unless a crack is meant."
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


@dataclass(frozen=True)
class Parts:
    """The parts of a mesh that hang together through facets; small, replicated on all ranks.

    Parts of one group share nodes, but no facet: they may turn about each other.
    """

    cells: Integers  # number of cells of each part, shape (n_parts,)
    middles: Floats  # mean of the cell midpoints of each part, shape (n_parts, d) [m]
    radii: Floats  # largest distance of a node from the middle, shape (n_parts,) [m]
    groups: Integers  # number of the group of each part, shape (n_parts,)
    points: Floats  # nodes that several parts share, shape (n_shared, d) [m]
    joints: Integers  # rows (shared node, part), sorted, shape (n, 2)


def find_parts(points: Floats, cells: Integers, facets: Facets, name: str) -> tuple[Ints, Parts] | None:
    """Label the cells of each facet-connected part from 0; None if the mesh is one part.

    Raises MeshError: a facet has more than two cells.
    """
    if (crowded := facets.same[1:] & facets.same[:-1]).any():
        place = points[facets.nodes[np.argmax(crowded)]].mean(axis=0)
        raise MeshError(
            f"{name} has facets with more than two cells, the first around {place_text(place)}: remove doubled cells."
        )
    used, labels = np.unique(linked(*facets.pairs, len(cells)), return_inverse=True)
    count = len(used)
    if count == 1:
        return None
    total = np.bincount(labels, minlength=count)
    midpoints = points[cells].mean(axis=1)
    middles = np.stack([np.bincount(labels, weights=x, minlength=count) for x in midpoints.T], axis=1) / total[:, None]
    radii = np.zeros(count)
    np.maximum.at(radii, labels, np.linalg.norm(points[cells] - middles[labels, None], axis=2).max(axis=1))
    groups = np.zeros(count, dtype=np.int64)
    groups[labels] = components(cells, len(points))[1]
    pairs = np.unique(cells.astype(np.int64) * count + labels[:, None])  # (node, part) in one number, sorted
    nodes, parts = np.divmod(pairs, count)
    shared, times = np.unique(nodes, return_counts=True)
    shared = shared[times > 1]
    kept = np.isin(nodes, shared)
    joints = np.stack([np.searchsorted(shared, nodes[kept]), parts[kept]], axis=1)
    return labels.astype(np.int32), Parts(total, middles, radii, groups, points[shared], joints)
