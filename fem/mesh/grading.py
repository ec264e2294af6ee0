"""Graded meshes: cell sizes that fall towards singular ends, bisection down to them, boxes whose lines meet the ends.

DOLFINx bisects distributed meshes too, but passes tags on only where no cell is shared by ranks, and keeps children on
the rank of their parent. On rank 0 the mesh is the same for every rank count and is spread evenly; contact zone, tags
and layers pass to the children.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import dolfinx.mesh
import numpy as np
from mpi4py import MPI

from softgrasp.fem.errors import MeshError
from softgrasp.fem.mesh.check import (
    FLAT,
    Floats,
    Ints,
    find_parts,
    longest_edges,
    place_text,
    quality,
    sort_facets,
)
from softgrasp.fem.mesh.singular import Ends
from softgrasp.fem.mesh.tissue_mesh import Marks, MeshArrays, TissueMesh, Whole, spread, structured_mesh
from softgrasp.fem.petsc import on_root
from softgrasp.fem.shown import counted

if TYPE_CHECKING:
    from softgrasp.fem.scene.scene import Scene


MOST_LEVELS = 60  # each halves the longest edge at most; 2^-30 of a body is below any useful cell


def bisect(whole: Whole, marked: Ints) -> Whole:
    """Split the marked cells, and others until no node hangs, through their longest edges [PC00].

    ``marked``: numbers of the cells to split, in the order of ``whole.simplices``. Raises MeshError: a child would be
    flat to rounding.
    """
    mesh, d = whole.mesh, whole.dimension
    for a, b in ((d, 1), (1, d), (d - 1, d), (d, d - 1)):
        mesh.topology.create_connectivity(a, b)
    edges = dolfinx.mesh.compute_incident_entities(mesh.topology, np.sort(marked).astype(np.int32), d, 1)
    option = dolfinx.mesh.RefinementOption.parent_cell_and_facet
    fine, parent, parent_facet = dolfinx.mesh.refine(mesh, edges, option=option)
    for a, b in ((d - 1, d), (d, d - 1)):
        fine.topology.create_connectivity(a, b)
    facets = {
        name: dolfinx.mesh.transfer_meshtag(tags, fine, parent, parent_facet) for name, tags in whole.facets.items()
    }
    above = parent[fine.topology.original_cell_index]  # DOLFINx numbers parents in the order before its own reordering
    result = replace(whole, mesh=fine, cells={k: v[above] for k, v in whole.cells.items()}, facets=facets)
    points, cells = result.points, result.simplices
    shape = np.abs(quality(points, cells))
    if (flat := shape <= FLAT).any():
        place = place_text(points[cells[int(np.argmin(shape))]].mean(axis=0))
        raise MeshError(
            f"{whole.source} cannot be bisected further: {counted(int(flat.sum()), 'cell')} would be flat, the worst "
            f"around {place}; remesh the body there or use a larger tissue.refine.tolerance."
        )
    return result


def bisect_to(whole: Whole, size: Callable[[Floats], Floats], slack: float, most: int) -> Whole:
    """Bisect until no cell is larger than ``slack`` times its size(points (n, d)) [m], or there are more than ``most``.

    Raises MeshError: see :func:`bisect`.
    """
    for _ in range(MOST_LEVELS):
        points, cells = whole.points, whole.simplices
        large = longest_edges(points, cells) > slack * size(points[cells].mean(axis=1))
        if not large.any() or len(cells) > most:
            break
        whole = bisect(whole, np.flatnonzero(large).astype(np.int32))
    return whole


def distribute(comm: MPI.Intracomm, whole: Whole | None) -> TissueMesh:
    """Spread a mesh from rank 0 over the ranks (None on the others), with all it carries. Collective.

    ``mesh.topology.original_cell_index`` of the result counts the cells as ``whole.simplices`` does.
    """
    return replace(spread(comm, None if whole is None else _arrays(whole)), whole=whole)


def _arrays(whole: Whole) -> MeshArrays:
    points, cells, d = whole.points, whole.simplices, whole.dimension
    marks: Marks = {name: (d, cells, values) for name, values in whole.cells.items()}
    marks |= {name: (d - 1, whole.facet_nodes(name), tags.values) for name, tags in whole.facets.items()}
    known: dict[str, Any] = {name: getattr(whole, name) for name in ("source", "facet_sets", "cell_sets")}
    if (parts := find_parts(points, cells, sort_facets(cells), whole.source)) is not None:
        marks["part_tags"], known["parts"] = (d, cells, parts[0]), parts[1]
    return MeshArrays(points, cells, marks, known)


# mu < alpha / p with alpha about 1/2 gives elements of order p their full order; below it the cells next to the end
# shrink so fast that the smallest size, not mu, decides where they stop.
BISECTION = {1: 0.45, 2: 0.15, 3: 0.1}
LINES = {1: 0.45, 2: 0.3, 3: 0.2}
STEEPEST = 50.0  # largest over smallest distance of lines: the aspect of cells, and the digits that solves lose by it
SLACK = 1.5  # a cell is split when it is larger than its size by this factor
SAMPLES = 400


@dataclass(frozen=True)
class SizeField:
    """h(r) = max(smallest, h0 min(1, r / R)^(1 - mu)) at the distance r from the nearest end."""

    ends: Ends  # the singular ends
    h0: float  # size far from them [m]
    radius: float  # R [m]
    mu: float  # grading [1]; 1 is uniform
    smallest: float  # smallest size [m]

    def __call__(self, x: Floats) -> Floats:
        """Size at points (n, d), (n,) [m]."""
        return self.at_distance(self.ends.distance(x))

    def at_distance(self, r: Floats) -> Floats:
        """Size at distances from the nearest end, (n,) [m]."""
        r = np.minimum(r, self.radius)
        return np.maximum(self.h0 * (r / self.radius) ** (1 - self.mu), min(self.smallest, self.h0))


def graded_line(cuts: Sequence[float], ends: Sequence[float], n: int, mu: float, radius: float) -> Floats:
    """N + 1 coordinates with a line at every cut, whose distances fall as min(1, r / R)^(1 - mu) towards the ends.

    Each stretch between cuts gets its share of the n cells by int dx / h(x) and places them so that all are equal in
    this measure; no distance falls below 1 / `STEEPEST` of the largest size.

    Args:
        cuts: sorted coordinates, the first and last bound the line [m].
        ends: those towards which distances fall [m].
        n: number of cells; raised to the number of stretches.
        mu: grading, 0 < mu <= 1 [1].
        radius: R [m].
    """
    measures, places = [], []
    for a, b in pairwise(cuts):
        half = (b - a) / 2
        t = half * np.linspace(0.0, 1.0, SAMPLES + 1) ** 3  # dense where h is small
        x = np.concatenate([a + t, (b - t)[-2::-1]])
        r = np.full(len(x), np.inf)
        for end in ends:
            r = np.minimum(r, np.abs(x - end))
        density = 1 / np.maximum(np.minimum(1.0, r / radius) ** (1 - mu), 1 / STEEPEST)
        count = np.concatenate([[0.0], np.cumsum(np.diff(x) * (density[1:] + density[:-1]) / 2)])
        measures.append(count[-1])
        places.append((count, x))
    weights = np.array(measures)
    n = max(n, len(weights))
    share = np.maximum(1, np.floor(n * weights / weights.sum())).astype(int)
    while share.sum() < n:
        share[np.argmax(weights / share)] += 1
    while share.sum() > n:
        share[np.argmin(np.where(share > 1, weights / share, np.inf))] -= 1
    line = [np.array([cuts[0]])]
    for k, (count, x) in zip(share, places, strict=True):
        part = np.interp(np.arange(1, k + 1) / k * count[-1], count, x)
        part[-1] = x[-1]
        line.append(part)
    return np.concatenate(line)


def merged(cuts: Sequence[float], others: Sequence[float], gap: float) -> list[float]:
    """Sorted cuts, and those of the others that keep a distance from all before them."""
    result = list(cuts)
    for other in others:
        if all(abs(other - c) > gap for c in result):
            result.append(other)
    return sorted(result)


SAME = 1e-9  # of the side: far above rounding of coordinates, far below any cell
CLOSE = 0.1  # of the side: a line through a point of an output keeps this distance from others


@dataclass(frozen=True)
class BoxAxis:
    """One axis of a box."""

    cuts: tuple[float, ...]  # coordinates that a line must meet, the sides first and last [m]
    ends: tuple[float, ...]  # cuts at which the contact zone ends [m]


def box_axes(scene: Scene) -> tuple[BoxAxis, ...]:
    """Constraints on the lines of a structured box.

    Lines meet the box of the contact zone, the boxes of layers and the points of outputs, and the zone ends at its
    sides and at its box.
    """
    tissue, contact = scene.tissue, scene.contact
    size = tissue.size or []
    d = len(size)
    origin = tissue.origin or [0.0] * d
    sides = contact.axes(d)
    result = []
    for axis, (low, length) in enumerate(zip(origin, size, strict=True)):
        high = low + length

        def inner(values: Sequence[float], low: float = low, high: float = high) -> list[float]:
            return [v for v in values if low + SAME * (high - low) < v < high - SAME * (high - low)]

        ends = [high if end > 0 else low for a, end in sides if a == axis]
        across = {a for a, _ in sides} - {axis} or not sides
        if across:
            ends += [low, high]
            if contact.box is not None:
                lo, hi = (corner[axis] for corner in contact.box)
                ends = [e for e in ends if lo - SAME * length <= e <= hi + SAME * length] + inner([lo, hi])
        cuts = [low, high, *inner(ends)]
        cuts += inner([corner[axis] for layer in tissue.layers.values() for corner in layer.box or []])
        points = [o.point[axis] for o in (scene.control.outputs if scene.control else []) if o.point is not None]
        unique = merged([], sorted(cuts), SAME * length)
        result.append(BoxAxis(tuple(merged(unique, inner(points), CLOSE * length)), tuple(sorted(set(ends)))))
    return tuple(result)


def even_cells(scene: Scene, h: float) -> list[int]:
    """Numbers of cells along the sides of the box, none longer than h between the cuts."""
    return [sum(int(np.ceil((b - a) / h - SAME)) for a, b in pairwise(axis.cuts)) for axis in box_axes(scene)]


def box_of_lines(comm: MPI.Intracomm, scene: Scene, cells: Sequence[int], mu: float, radius: float) -> TissueMesh:
    """The structured box with lines at all cuts that crowd towards the ends; mu = 1: even between cuts. Collective.

    ``mu``, ``radius``: see :func:`graded_line`.
    """
    axes, tissue = box_axes(scene), scene.tissue
    lines = [graded_line(a.cuts, a.ends, n, mu, radius) for a, n in zip(axes, cells, strict=True)]
    return _on_lines(comm, tissue.size or [], tissue.origin, lines)


def _on_lines(
    comm: MPI.Intracomm, size: Sequence[float], origin: Sequence[float] | None, lines: Sequence[Floats]
) -> TissueMesh:
    """The structured box with these lines, from side to side. Collective."""
    box = structured_mesh(comm, size, [len(line) - 1 for line in lines], origin)
    x = box.mesh.geometry.x
    for i, (line, length) in enumerate(zip(lines, size, strict=True)):
        x[:, i] = line[np.rint((x[:, i] - line[0]) / length * (len(line) - 1)).astype(np.int64)]
    return box


def on_each_rank(mesh: TissueMesh, scene: Scene) -> TissueMesh:
    """A graded mesh of the scene on each rank alone: the mesh that one rank makes. Collective."""
    comm, tissue = mesh.mesh.comm, scene.tissue
    whole = on_root(comm, lambda: None if mesh.whole is None else _arrays(mesh.whole))
    if whole is not None:
        return spread(MPI.COMM_SELF, whole)
    parts = comm.allgather([np.unique(mesh.mesh.geometry.x[:, i]) for i in range(mesh.dimension)])
    lines = [np.unique(np.concatenate(along)) for along in zip(*parts, strict=True)]
    return _on_lines(MPI.COMM_SELF, tissue.size or [], tissue.origin, lines)
