"""Cells of any type meshio names, cut into linear lines, triangles or tetrahedra (numpy only, not collective).

``points`` are those of the whole mesh (n_points, 2 or 3) [m], ``cells`` corner nodes (n_cells, corners) unless stated
otherwise, ``shape`` is that of :func:`shape_of`, and ``name`` that of the mesh, for messages.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import numpy as np

from softgrasp.fem.errors import MeshError
from softgrasp.fem.mesh.check import FLAT, Floats, Integers, longest_edges, place_text, quality
from softgrasp.fem.shown import counted

LITTLE = 0.05, 0.01  # straightening moves a node by less of its cell's longest edge, and changes the volume by less
STRAIGHT = 1e-5  # of the longest edge: above the 6 digits of text files, far below the error of the elements

# Corners of the faces of each shape (edges in 2D), counterclockwise seen from outside; corners come first in a cell.
_FACES: dict[str, tuple[tuple[int, ...], ...]] = {
    "vertex": (),
    "line": ((0,), (1,)),
    "triangle": ((0, 1), (1, 2), (2, 0)),
    "quad": ((0, 1), (1, 2), (2, 3), (3, 0)),
    "tetra": ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)),
    "hexahedron": ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
    "wedge": ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "pyramid": ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
}
_CORNERS = {"vertex": 1, "line": 2, "triangle": 3, "quad": 4, "tetra": 4, "hexahedron": 8, "wedge": 6, "pyramid": 5}
DIMENSIONS = {"vertex": 0, "line": 1, "triangle": 2, "quad": 2, "tetra": 3, "hexahedron": 3, "wedge": 3, "pyramid": 3}
_FACE_SHAPES = {2: "line", 3: "triangle", 4: "quad"}
_LAGRANGE = {"CURVE": "line", "QUADRILATERAL": "quad", "TETRAHEDRON": "tetra"}  # VTK's names where they differ
_NODES: dict[str, Callable[[int], int]] = {  # nodes of the Lagrange cell of order p
    "vertex": lambda p: 1,
    "line": lambda p: p + 1,
    "triangle": lambda p: (p + 1) * (p + 2) // 2,
    "quad": lambda p: (p + 1) ** 2,
    "tetra": lambda p: (p + 1) * (p + 2) * (p + 3) // 6,
    "hexahedron": lambda p: (p + 1) ** 3,
    "wedge": lambda p: (p + 1) ** 2 * (p + 2) // 2,
    "pyramid": lambda p: (p + 1) * (p + 2) * (2 * p + 3) // 6,
}
# Quadratic cells without all their inner nodes.
_SERENDIPITY = {("quad", 8), ("hexahedron", 20), ("hexahedron", 24), ("wedge", 15), ("pyramid", 13)}


def shape_of(kind: str) -> str | None:
    """The straight shape behind a cell type of meshio ("tetra" of "tetra10"), or None for other types."""
    if kind.startswith("VTK_LAGRANGE_"):
        name = kind.removeprefix("VTK_LAGRANGE_")
        kind = _LAGRANGE.get(name, name.lower())
    known = re.fullmatch(r"([a-z]+)\d*", kind)
    return known[1] if known and known[1] in _FACES else None


def corners(cells: Integers, shape: str) -> Integers:
    """The corner nodes of cells of any order, shape (n_cells, corners)."""
    return cells[:, : _CORNERS[shape]]


def check_straight(points: Floats, cells: Integers, shape: str, kind: str, name: str) -> tuple[str, ...]:
    """Refuse cells of higher order that are curved, unless straightening them changes little.

    Curved are cells whose edge or face nodes leave the straight edges or flat faces. Triangles and tetrahedra of second
    order are accepted within `LITTLE`, which leaves the corners where they are; the note that is returned says by how
    much that changes the body. A cell of straight edges is the simplex (or the hexahedron, ...) of its corners,
    wherever on its edges the other nodes lie. Inner nodes do not shape a cell.

    Args:
        cells: all nodes of the cells, shape (n_cells, nodes of a cell): corners, edges, faces, inside.
        kind: meshio's name of the cell type, for messages.

    Raises:
        MeshError: the number of nodes fits no order, or cells are curved by more than that.
    """
    size, count = cells.shape[1], _CORNERS[shape]
    if size == count or not len(cells):
        return ()
    order = 2 if (shape, size) in _SERENDIPITY else next((p for p in range(1, 21) if _NODES[shape](p) == size), 0)
    if order < 2:
        raise MeshError(f"{name} has cells of type {kind} with {size} nodes: export the mesh with linear cells.")
    faces = _FACES[shape]
    loops = [list(zip(face, face[1:] + face[:1], strict=True)) for face in faces if len(face) > 2]
    edges = sorted({(min(e), max(e)) for loop in loops for e in loop}) or [f for f in faces if len(f) == 2]
    edges = edges or [(0, 1)]  # a line
    on_edges = len(edges) * (order - 1)
    inner = {3: (order - 1) * (order - 2) // 2, 4: (order - 1) ** 2}
    on_faces = sum(inner[len(face)] for face in faces if len(face) > 2)
    off, where = np.zeros(len(cells)), cells[:, 0].copy()
    for i, node in enumerate(cells[:, count : count + on_edges + on_faces].T):
        nearest = np.full(len(cells), np.inf)
        for part in edges if i < on_edges else [face for face in faces if len(face) > 2]:
            distance = _from_edge if i < on_edges else _from_plane
            nearest = np.minimum(nearest, distance(points[node], points[cells[:, part]]))
        where = np.where(nearest > off, node, where)
        off = np.fmax(off, np.where(np.isnan(nearest), np.inf, nearest))
    longest = longest_edges(points, corners(cells, shape))
    curved = (off > STRAIGHT * longest) & np.isfinite(longest)  # broken corners are named later
    if curved.any():
        relative = np.where(curved, off / np.where(longest > 0, longest, 1.0), 0.0)
        worst = int(np.argmax(relative))
        place = place_text(points[where[worst]])
        text = (
            f"{name} has {counted(int(curved.sum()), 'curved cell')} of type {kind}, the worst node lies "
            f"{off[worst]:.3g} m from its straight edge or flat face ({relative[worst]:.3g} of the longest edge) "
            f"at {place}"
        )
        simple = order == 2 and size == len(edges) + count and count == DIMENSIONS[shape] + 1
        change = volume_of_curves(points, cells, edges) if simple else np.inf
        share = -change / (1 + change) if simple else 0.0
        if relative[worst] > LITTLE[0] or abs(change) > LITTLE[1]:
            told = f", and straight cells would change its volume by {100 * share:.2f} %" if simple else ""
            raise MeshError(f"{text}{told}: export the mesh with smaller cells, straight edges or linear cells.")
        return (f"{text}; they are straightened, which changes the volume of the body by {100 * share:.2f} %.",)
    return ()


def volume_of_curves(points: Floats, cells: Integers, edges: Sequence[tuple[int, ...]]) -> float:
    """Volume between curved and straight second-order simplices, over that of the straight ones [1].

    To first order in the offsets d of the middle nodes: of a parabola over an edge 2/3 d.n |edge|, of a face with three
    of them (d_1 + d_2 + d_3).n |face| / 3; inside the body both sides cancel.
    """
    corner = points[cells[:, : cells.shape[1] - len(edges)]]
    offsets = {}
    for a, b in edges:  # the middle nodes may come in another order: take the nearest
        middle = (corner[:, a] + corner[:, b]) / 2
        nodes = points[cells[:, -len(edges) :]]
        nearest = np.linalg.norm(nodes - middle[:, None], axis=2).argmin(axis=1)
        offsets[min(a, b), max(a, b)] = nodes[np.arange(len(cells)), nearest] - middle
    d = corner.shape[1] - 1
    sides = corner[:, 1:] - corner[:, :1]
    whole = np.linalg.det(sides[..., :d]) / (2.0 if d == 2 else 6.0)
    total = np.zeros(len(cells))
    for face in _FACES["triangle" if d == 2 else "tetra"]:
        ends = corner[:, face]
        if d == 2:
            along = ends[:, 1] - ends[:, 0]
            offset = offsets[min(face), max(face)]
            total += 2 / 3 * (along[:, 1] * offset[:, 0] - along[:, 0] * offset[:, 1])
        else:
            normal = np.cross(ends[:, 1] - ends[:, 0], ends[:, 2] - ends[:, 0]) / 2
            for a, b in ((face[0], face[1]), (face[1], face[2]), (face[0], face[2])):
                total += (normal * offsets[min(a, b), max(a, b)]).sum(axis=1) / 3
    return float((np.sign(whole) * total).sum() / np.abs(whole).sum())


def simplices(cells: Integers, shape: str, turn: int = 0) -> tuple[Integers, Integers]:
    """Cut cells into simplices by pulling their smallest node: cone from it over the faces that do not touch it.

    Faces are cut in the same way, so two cells with a common face cut it alike (a quadrilateral through its
    smallest node), and so are quadrilaterals given as facets. A quadrilateral gives 2 triangles, a pyramid 2,
    a wedge 3 and a hexahedron 6 tetrahedra, fewer if nodes coincide by number.

    Args:
        cells: corner nodes in the numbering of the whole mesh, shape (n_cells, corners).
        shape: see `shape_of`.
        turn: pull the node this many places behind the smallest one (for single quadrilaterals in the plane).

    Returns:
        simplices: shape (n, dimension + 1), oriented as the cells, those of one cell one after another.
        parents: the cell of each simplex, shape (n,).
    """
    if cells.shape[1] == DIMENSIONS[shape] + 1:
        return cells, np.arange(len(cells))
    first = (cells.argmin(axis=1) + turn) % cells.shape[1]
    pieces = [np.zeros((0, DIMENSIONS[shape] + 1), dtype=np.int64)]
    parents = [np.zeros(0, dtype=np.int64)]
    for i in range(cells.shape[1]):
        rows = np.flatnonzero(first == i)
        for face in _FACES[shape]:
            if i in face:
                continue
            base, sub = simplices(cells[rows][:, face], _FACE_SHAPES[len(face)])
            pieces.append(np.column_stack([cells[rows[sub], i], base]))
            parents.append(rows[sub])
    cut, parent = np.concatenate(pieces), np.concatenate(parents)
    order = np.argsort(parent, kind="stable")
    cut, parent = cut[order], parent[order]
    ordered = np.sort(cut, axis=1)
    whole = (ordered[:, 1:] != ordered[:, :-1]).all(axis=1)
    # A hexahedron with coinciding nodes is a wedge: its collapsed tetrahedra go, unless nothing would be left.
    whole |= ~np.isin(parent, parent[whole])
    return cut[whole], parent[whole]


def cut_cells(points: Floats, cells: Integers, shape: str, name: str) -> tuple[Integers, Integers]:
    """`simplices` of the cells of a mesh, whose volumes must have one sign within each cell.

    A quadrilateral that its smallest node cuts badly (a concave one) is cut by its other diagonal. Wedges are turned as
    needed, since formats disagree on their orientation. The volume of a cell with flat faces is kept; warped faces are
    replaced by two triangles. Raises MeshError: a cell is so distorted that its parts overlap.
    """
    cut, parents = simplices(cells, shape)
    if cells.shape[1] == cut.shape[1]:
        return cut, parents
    low, high = _signs(points, cut, parents, len(cells))
    flat = np.flatnonzero((low == 0) & (high == 0))
    if flat.size:
        raise MeshError(
            f"{name} has {counted(flat.size, 'cell')} of type {shape} and zero volume, the first around "
            f"{place_text(points[cells[flat[0]]].mean(axis=0))}: remove or remesh them."
        )
    if shape == "quad":
        bad = np.flatnonzero(low * high < 1)
        cut, parents = _replace(cut, parents, bad, simplices(cells[bad], shape, 1))
        low, high = _signs(points, cut, parents, len(cells))
    tangled = np.flatnonzero((low * high < 0) | (low == 0) | (high == 0))
    if tangled.size:
        middle = points[cells[tangled[0]]].mean(axis=0)
        raise MeshError(
            f"{name} has {counted(tangled.size, 'cell')} of type {shape} so distorted that the simplices they are cut "
            f"into overlap or are flat, the first around {place_text(middle)}: remesh there, or export triangles or "
            "tetrahedra."
        )
    if shape == "wedge":
        turned = (high < 0)[parents]
        cut[np.ix_(turned, [-2, -1])] = cut[np.ix_(turned, [-1, -2])]
    return cut, parents


def check_interfaces(points: Floats, blocks: list[tuple[Integers, str]], name: str) -> None:
    """Refuse a mesh in which two triangles meet a quadrilateral face that `simplices` cuts by its other diagonal.

    ``blocks``: corner nodes and shape of the cells of each type. Raises MeshError: there are such faces; the body would
    be open there.
    """
    if all(shape == "tetra" for _, shape in blocks):
        return
    faces = [cells[:, face] for cells, shape in blocks if DIMENSIONS[shape] == 3 for face in _FACES[shape]]
    quads = [face for face in faces if face.shape[1] == 4]
    triangles = [face for face in faces if face.shape[1] == 3]
    if not quads or not triangles:
        return
    ring = np.concatenate(quads)
    ring = ring[(np.diff(np.sort(ring, axis=1), axis=1) > 0).all(axis=1)]  # a collapsed face is a triangle itself
    if not len(ring):
        return
    turn = (ring.argmin(axis=1)[:, None] + np.arange(4)) % 4
    ring = np.take_along_axis(ring, turn, axis=1)
    wrong = np.concatenate([ring[:, [0, 1, 3]], ring[:, [1, 2, 3]]])
    _, numbers = np.unique(np.sort(np.concatenate([wrong, *triangles]), axis=1), axis=0, return_inverse=True)
    clash = np.isin(numbers[: len(wrong)], numbers[len(wrong) :])
    if clash.any():
        place = place_text(points[wrong[np.argmax(clash)]].mean(axis=0))
        raise MeshError(
            f"{name} has {counted(len(np.unique(numbers[: len(wrong)][clash])), 'triangle')} on quadrilaterals cut by "
            f"the other diagonal, the first around {place}: put pyramids between them, or export tetrahedra only."
        )


def _replace(
    cut: Integers, parents: Integers, bad: Integers, new: tuple[Integers, Integers]
) -> tuple[Integers, Integers]:
    kept = ~np.isin(parents, bad)
    cut, parents = np.concatenate([cut[kept], new[0]]), np.concatenate([parents[kept], bad[new[1]]])
    order = np.argsort(parents, kind="stable")
    return cut[order], parents[order]


def _signs(points: Floats, cut: Integers, parents: Integers, count: int) -> tuple[Integers, Integers]:
    """Lowest and highest sign (-1, 0 if flat, 1) of the volumes in each parent."""
    shape = quality(points, cut)
    signs = np.where(np.abs(shape) <= FLAT, 0, np.sign(shape))
    low, high = np.ones(count, dtype=np.int64), -np.ones(count, dtype=np.int64)
    np.minimum.at(low, parents, signs.astype(np.int64))
    np.maximum.at(high, parents, signs.astype(np.int64))
    return low, high


def _from_edge(x: Floats, ends: Floats) -> Floats:
    """Distance of x (n, D) to the segments with these ends (n, 2, D)."""
    along, start = ends[:, 1] - ends[:, 0], ends[:, 0]
    square = np.maximum((along**2).sum(axis=1), np.finfo(float).tiny)
    place = np.clip(((x - start) * along).sum(axis=1) / square, 0.0, 1.0)
    return np.asarray(np.linalg.norm(x - start - place[:, None] * along, axis=1))


def _from_plane(x: Floats, face: Floats) -> Floats:
    """Distance of x (n, 3) to the plane through the middle of a face (n, 3 or 4, 3), along the diagonals' normal."""
    middle = face.mean(axis=1)
    normal = np.cross(face[:, 2] - face[:, 0], face[:, -1] - face[:, 1])
    size = np.maximum(np.linalg.norm(normal, axis=1), np.finfo(float).tiny)
    return np.asarray(np.abs(((x - middle) * normal).sum(axis=1)) / size)
