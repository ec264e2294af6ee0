"""A coarser copy of a large simplex mesh: the lattice cells that its body fills, their corners moved to its boundary.

    n_v = sum over cells T of |T| grad phi_v = integral of phi_v n over the boundary

vanishes at the nodes v inside, and the sizes of the others add up to the surface. Each lattice cell that the body fills
by half is cut in 2 triangles or 6 tetrahedra; corners on the boundary of these move to the nearest node of that of the
body, as far as no cell loses nine tenths of its volume. Lattice lines meet the ends of given boxes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softgrasp.fem.compiled import functions, packed
from softgrasp.fem.mesh.cells import simplices
from softgrasp.fem.mesh.check import (
    MOST_PAIRS,
    SEAM,
    Facets,
    Flags,
    Floats,
    Integers,
    Ints,
    signed_volumes,
    sizes_of,
    sort_facets,
)
from softgrasp.fem.mesh.tissue_mesh import MeshArrays, inspected

if TYPE_CHECKING:
    from softgrasp.fem.mesh.file import Body

INSIDE = 1e-6  # size of a nodal normal over that of its parts, below which the node is inside [1]: far above rounding
NEAR_END = 0.3  # of a cell: an end of a box so near to another line needs none [1]
LEAST = 0.1  # of its volume, which a cell keeps [1]
PLACES, MOST_SHARES = 200, 6  # points a lattice cell that tell how full it is, and most of them along an edge [1]
MOST_FILLS = 10_000_000  # numbers that tell how full each lattice cell is of each mark: 80 MB [1]
SAMPLE = 2000  # cells whose volumes give the lattice its edges, about [1]
MOVES = 16  # attempts to move the corners, each by half as far around cells that would lose more


@dataclass(frozen=True)
class LatticeCopy:
    """A body on lattice cells, and what both have of it."""

    arrays: MeshArrays  # the copy
    outer: Integers  # nodes of its facets on the boundary, (n, d)
    ends: Flags  # nodes of the body that lie on its boundary, (n_points,)
    area: Floats  # surface of the body that goes with each node [m^(d-1)], (n_points,)
    volume: float  # of the copy over that of the body, less 1 [1]
    surface: float  # likewise of the boundary [1]
    buried: float  # share of the boundary of the body, as that of a slit, that lies inside the copy [1]
    finer: float  # edge of a cell of the body over that of a cell of the copy, both of mean volume [1]


def lattice_copy(body: Body, most: int, boxes: Sequence[Any]) -> LatticeCopy | None:
    """The body on at most about so many lattice cells; None without compiled code, or where a cell is inverted.

    None too of a thin body that lies across the box around it, where most lattice cells are empty.

    ``boxes``: [low, high] of zones and layers, whose ends lattice lines shall meet.
    """
    code = functions(Path(__file__).with_name("body.c"), "large mesh files are assembled to explain them")
    if code is None:
        return None
    points, d = body.points, body.points.shape[1]
    some = body.cells[:: max(len(body.cells) // SAMPLE, 1)]
    mean = float(signed_volumes(points, some).mean())
    h = (max(mean, 0.0) * len(body.cells) / most) ** (1 / d)
    low, high = points.min(axis=0), points.max(axis=0)
    if not h > 0:
        return None
    lines = [_lines(low[k], high[k], [x for box in boxes for x in (box[0][k], box[1][k])], h) for k in range(d)]
    marks = 1 if body.cell_tags is None else int(body.cell_tags.max()) + 1
    if marks * math.prod(len(each) - 1 for each in lines) > MOST_FILLS:
        return None
    fill, normals, parts, least = _measured(code, body, lines, marks)
    area, volume = np.linalg.norm(normals, axis=1), float(fill.sum())
    ends = area > INSIDE * parts
    full = _half_full(lines, fill)
    corners, cells, cell_marks = _cut(lines, fill, full)
    if not least > 0 or not len(cells):
        return None
    sides = sort_facets(cells)
    corners = _moved(corners, cells, np.unique(sides.nodes[sides.outer]), points[ends], h)
    facets, tags = _tagged(body, corners, sides, np.flatnonzero(ends))
    known: dict[str, Any] = {"source": body.path.name, "notes": body.notes, "digest": body.digest}
    known |= {"facet_sets": body.facet_sets, "cell_sets": body.cell_sets}
    own = corners, cells, None if body.cell_tags is None else cell_marks
    arrays = inspected(own, (facets, tags), sides, known, SEAM, str(body.path))
    outer = sides.nodes[sides.outer]
    surface = float(sizes_of(corners, outer).sum() / area[ends].sum()) - 1
    buried = float(area[ends][_buried(lines, full, points[ends])].sum() / area[ends].sum())
    copied = float(signed_volumes(corners, cells).sum())
    finer = (volume / len(body.cells) / (copied / len(cells))) ** (1 / d)
    return LatticeCopy(arrays, outer, ends, area, copied / volume - 1, surface, buried, float(finer))


def _lines(low: float, high: float, ends: Sequence[float], h: float) -> Floats:
    """Lattice lines about h apart that meet both sides and the ends between them."""
    met = [low]
    for x in sorted(ends):
        if min(x - met[-1], high - x) > NEAR_END * h:
            met.append(x)
    gaps = [*pairwise(met), (met[-1], high)]
    return np.concatenate([[low], *(np.linspace(a, b, max(round((b - a) / h), 1) + 1)[1:] for a, b in gaps)])


def _measured(code: Any, body: Body, lines: list[Floats], marks: int) -> tuple[Floats, Floats, Floats, float]:
    """Volume by lattice cell and mark, nodal normals, size of their parts, and the least volume of a cell."""
    points, cells = np.ascontiguousarray(body.points), np.ascontiguousarray(body.cells)
    count = np.array([len(each) - 1 for each in lines], dtype=np.int64)
    fill, normals, parts = np.zeros((*count, marks)), np.zeros_like(points), np.zeros(len(points))
    least, every = np.full(1, np.inf), np.concatenate(lines)
    tags = None if body.cell_tags is None else np.ascontiguousarray(body.cell_tags)
    shares = _shares(points.shape[1], PLACES * count.prod() / len(cells))
    arrays = (cells, points, tags, count, every, shares, fill, normals, parts, least)
    code.softgrasp_body(packed(len(cells), points.shape[1], marks, len(shares), *arrays))
    return fill, normals, parts, float(least[0])


def _shares(d: int, least: float) -> Floats:
    """Barycentric coordinates but the first of at least so many points spread over a simplex, (n, d)."""
    q = next(q for q in range(MOST_SHARES) if math.comb(q + d, d) >= least or q == MOST_SHARES - 1)
    steps = np.array([step for step in product(range(q + 1), repeat=d) if sum(step) <= q], dtype=np.float64)
    return np.ascontiguousarray((steps + 1 / (d + 1)) / (q + 1))


def _half_full(lines: list[Floats], fill: Floats) -> Flags:
    """Whether each lattice cell is full by half or more."""
    size = np.diff(lines[0])
    for each in lines[1:]:
        size = np.multiply.outer(size, np.diff(each))
    return np.asarray(fill.sum(axis=-1) >= size / 2)


def _buried(lines: list[Floats], full: Flags, places: Floats) -> Flags:
    """Whether places lie in lattice cells that are full with all their neighbours."""
    deep = np.pad(full, 1)
    for axis in range(full.ndim):
        deep = deep & np.roll(deep, 1, axis) & np.roll(deep, -1, axis)
    cells = [np.searchsorted(each[1:-1], x, side="right") + 1 for each, x in zip(lines, places.T, strict=True)]
    return np.asarray(deep[tuple(cells)])


def _cut(lines: list[Floats], fill: Floats, full: Flags) -> tuple[Floats, Integers, Ints]:
    """Corners, simplices of positive volume, and their marks, of the full lattice cells."""
    square, shape = [(0, 0), (1, 0), (1, 1), (0, 1)], [len(each) for each in lines]
    steps = np.array(square if len(lines) == 2 else [(*step, z) for z in (0, 1) for step in square])
    boxes = np.ravel_multi_index(tuple(np.moveaxis(np.argwhere(full)[:, None] + steps, -1, 0)), shape)
    cells, parents = simplices(boxes, "quad" if len(lines) == 2 else "hexahedron")
    marks = fill[full].argmax(axis=1)[parents].astype(np.int32)
    used, numbers = np.unique(cells, return_inverse=True)
    places = np.unravel_index(used, shape)
    corners = np.stack([each[place] for each, place in zip(lines, places, strict=True)], axis=1)
    return corners, numbers.reshape(cells.shape), marks


def _nearest(points: Floats, places: Floats) -> Integers:
    """Number of the point nearest to each place: SciPy's trees take longer to import."""
    middle = points.mean(axis=0)
    points, places = points - middle, places - middle
    half = np.einsum("ij,ij->i", points, points) / 2
    rows = max(MOST_PAIRS // len(points), 1)
    parts = [np.argmin(half - places[k : k + rows] @ points.T, axis=1) for k in range(0, len(places), rows)]
    return np.concatenate(parts)


def _moved(corners: Floats, cells: Integers, outer: Integers, ends: Floats, h: float) -> Floats:
    """The corners, those on the boundary of the copy moved to the nearest node of that of the body."""
    before = signed_volumes(corners, cells)
    step = np.zeros_like(corners)
    step[outer] = ends[_nearest(ends, corners[outer])] - corners[outer]
    step[np.linalg.norm(step, axis=1) > h] = 0.0
    share = np.ones(len(corners))
    for attempt in range(MOVES):
        moved = corners + share[:, None] * step
        bad = signed_volumes(moved, cells) < LEAST * before
        if not bad.any():
            return moved
        share[np.unique(cells[bad])] *= 0.5 if attempt < MOVES // 2 else 0.0
    return corners


def _tagged(body: Body, corners: Floats, sides: Facets, ends: Integers) -> tuple[Integers, Ints | None]:
    """Facets on the boundary of the copy, with the mark of the marked facets of the body nearest to each."""
    nodes = sides.nodes[sides.outer]
    if body.facet_tags is None:
        return nodes[:0], None
    on = np.zeros(len(body.points), dtype=np.bool_)
    on[ends] = True
    inner = on[body.facets].all(axis=1)
    marks = np.full(len(body.points), -1, dtype=np.int32)
    marks[body.facets[inner]] = body.facet_tags[inner, None]
    found = marks[ends[_nearest(body.points[ends], corners[nodes].mean(axis=1))]]
    return nodes[found >= 0], found[found >= 0]
