"""Mesh files of any format meshio reads: parsed and checked on rank 0, then distributed."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from softgrasp.fem.checksums import digest
from softgrasp.fem.errors import MeshError, raise_on_all_ranks
from softgrasp.fem.mesh.cells import (
    DIMENSIONS,
    check_interfaces,
    check_straight,
    corners,
    cut_cells,
    shape_of,
    simplices,
)
from softgrasp.fem.mesh.check import (
    SEAM,
    Flags,
    Floats,
    Integers,
    Ints,
    check_cells,
    doubled_nodes,
    doubled_text,
    outer_facets,
    sort_facets,
)
from softgrasp.fem.mesh.foreign import read_foreign
from softgrasp.fem.mesh.text import read_text
from softgrasp.fem.mesh.tissue_mesh import MeshArrays, Sets, TissueMesh, inspected, spread


def _text(sets: Sets) -> str:
    """Text of named sets, whatever the order in which they were read."""
    return repr(sorted((repr(name), tuple(int(mark) for mark in marks)) for name, marks in sets.items()))


_TAG_NAMES = ("gmsh:physical", "medit:ref", "CellEntityIds")  # preferred names of integer cell data
_NOT_TAGS = ("gmsh:geometrical",)  # numbers of CAD entities, not marks of the user


def read_mesh(
    comm: MPI.Intracomm,
    path: Path,
    scale: float = 1.0,
    repair: bool = False,
    seam: float = SEAM,
    limit: float | None = None,
) -> TissueMesh:
    """Read a mesh and cut its cells into linear triangles or tetrahedra, with its facet and cell tags.

    Quadrilaterals, hexahedra, wedges and pyramids are cut as in `fem.mesh.cells.simplices`, cells of higher order with
    straight edges are reduced to their corners, and slightly curved ones of second order too, with a note. Cells of
    the highest dimension make the body, those one dimension lower carry the facet tags.

    Collective. Rank 0 reads and checks.

    Args:
        scale: factor of all coordinates, e.g. 1e-3 for a file in millimetres.
        repair: turn inverted cells round instead of refusing them, and join doubled nodes instead of warning of them.
        seam: boundary nodes closer than this share of the shortest edge there count as doubled [1].
        limit: longest processor time for a file that meshio may never end [s]; by its size if None.

    Raises MeshError: the file is missing or unreadable, needs longer than the limit, has polygons, polyhedra or
    strongly curved cells, a mesh of surfaces only is not in the plane z = 0, or a cell is flat, inverted or too
    distorted.
    """
    arrays: MeshArrays | None = None
    with raise_on_all_ranks(comm):
        if comm.rank == 0:
            arrays = load_arrays(path, scale, repair, seam, limit)
    return spread(comm, arrays)


@dataclass(frozen=True)
class Body:
    """What a mesh file says of the body, in linear simplices that are not checked."""

    path: Path  # of the file
    points: Floats  # coordinates of the nodes that cells use, (n_points, d) [m]
    cells: Integers  # nodes of the cells, (n_cells, d + 1)
    cell_tags: Ints | None  # their marks
    facets: Integers  # nodes of the marked facets, (n, d)
    facet_tags: Ints | None  # their marks
    cell_sets: Sets  # marks in cell_tags of each tag number and named set
    facet_sets: Sets  # marks in facet_tags, likewise
    notes: tuple[str, ...]  # on curved cells, one sentence each

    @property
    def digest(self) -> str:
        """SHA-256 of all that but the notes; some formats spread it over several files."""
        sets = [np.frombuffer(_text(each).encode(), dtype=np.uint8) for each in (self.cell_sets, self.facet_sets)]
        return digest(self.points, self.cells, self.cell_tags, self.facets, self.facet_tags, *sets)


def load_arrays(path: Path, scale: float, repair: bool, seam: float = SEAM, limit: float | None = None) -> MeshArrays:
    """Read and check a mesh file. Raises MeshError: see `read_mesh`."""
    return checked(load_body(path, scale, limit), repair, seam)


def load_body(path: Path, scale: float, limit: float | None = None) -> Body:
    """Read a mesh file and cut its cells into simplices. Raises MeshError: see `read_mesh`."""
    raw = _read(path, limit)
    kinds = sorted({block.type for block in raw.cells})
    shapes = [shape_of(block.type) for block in raw.cells]
    filled = [shape for shape, block in zip(shapes, raw.cells, strict=True) if shape and len(block.data)]
    dimension = max((DIMENSIONS[shape] for shape in filled), default=0)
    if None in shapes or dimension < 2:
        raise MeshError(
            f"{path} has cells of type {', '.join(kinds) or 'none'}: only triangles, quadrilaterals, tetrahedra, "
            "hexahedra, wedges and pyramids are accepted, export the mesh with these."
        )
    if None in raw.cell_sets:  # of Abaqus, as "*Elset, elset,=far"
        raise MeshError(f"{path} has a set of cells without a name: give it one, as in elset=NAME.")
    for block in raw.cells:
        if block.data.size and not 0 <= block.data.min() <= block.data.max() < len(raw.points):
            raise MeshError(f"{path} has cells with node numbers outside 0 to {len(raw.points) - 1}: export it again.")
    points = np.asarray(raw.points, dtype=np.float64) * scale
    tag_name = _tag_name(raw)
    bodies = _blocks(raw, dimension)
    flags = np.zeros(len(points), dtype=np.bool_)
    for _, shape, nodes in bodies:
        flags[corners(nodes, shape)] = True
    used, number = np.flatnonzero(flags), np.cumsum(flags) - 1
    if dimension == 2:
        points = _in_plane(points, used, path)
    curved = [check_straight(points, nodes, shape, raw.cells[i].type, str(path)) for i, shape, nodes in bodies]
    cut = [cut_cells(points, corners(nodes, shape), shape, str(path)) for _, shape, nodes in bodies]
    check_interfaces(points, [(corners(nodes, shape), shape) for _, shape, nodes in bodies], str(path))
    cells, cell_tags, cell_sets = _marked(raw, bodies, cut, tag_name, dimension)
    shells = _blocks(raw, dimension - 1)
    cut = [simplices(corners(nodes, shape), shape) for _, shape, nodes in shells]
    facets, facet_tags, facet_sets = _marked(raw, shells, cut, tag_name, dimension - 1)
    if not flags.all():
        points, cells = points[used], number[cells]
        kept = flags[facets].all(axis=1)  # facets with a node that no cell uses belong to leftover geometry
        facets, facet_tags = number[facets[kept]], None if facet_tags is None else facet_tags[kept]
    notes = tuple(itertools.chain(*curved))
    return Body(path, points, cells, cell_tags, facets, facet_tags, cell_sets, facet_sets, notes)


def checked(body: Body, repair: bool, seam: float = SEAM) -> MeshArrays:
    """The arrays of a body that is one. Raises MeshError: see `read_mesh`."""
    body = mended(body, seam, repair)
    known: dict[str, Any] = {"source": body.path.name, "notes": body.notes, "digest": body.digest}
    known |= {"facet_sets": body.facet_sets, "cell_sets": body.cell_sets}
    own = body.points, body.cells, body.cell_tags
    return inspected(own, (body.facets, body.facet_tags), sort_facets(body.cells), known, seam, str(body.path))


def mended(body: Body, seam: float, repair: bool = True) -> Body:
    """The body with inverted cells turned round and doubled nodes joined, if it may be, or notes of these.

    Raises MeshError: see `read_mesh`.
    """
    points, facets, facet_tags, name = body.points, body.facets, body.facet_tags, str(body.path)
    cells = check_cells(points, body.cells, repair, name)
    first = doubled_nodes(points, cells, outer_facets(cells, len(points)), seam)
    notes = (*body.notes, *doubled_text(points, first, seam, repair, name))
    if repair and notes:
        used, number = np.unique(first, return_inverse=True)
        points, cells = points[used], check_cells(points[used], number[cells], False, name)
        _, sole = np.unique(np.sort(number[facets], axis=1), axis=0, return_index=True)  # one of both sides of a seam
        facets, facet_tags = number[facets][sole], None if facet_tags is None else facet_tags[sole]
    return replace(body, points=points, cells=cells, facets=facets, facet_tags=facet_tags, notes=notes)


def _read(path: Path, limit: float | None) -> meshio.Mesh:
    try:
        if not path.is_file():
            given = " ('given' is a mesh that a program passes to softgrasp.build)" if path.name == "given" else ""
            raise MeshError(f"The mesh file {path} does not exist: tissue.mesh is relative to the scene file{given}.")
        return read_text(path) or read_foreign(path, limit)
    except TimeoutError as error:
        raise MeshError(
            f"meshio did not end within {error} s of processor time on {path}, as on damaged files: export it again, "
            "or raise tissue.read_limit for a large file."
        ) from None
    except OSError as error:
        raise MeshError(f"{path} cannot be read ({error.strerror or error}): name a readable mesh file.") from None
    except ValueError as error:
        raise MeshError(f"meshio cannot read {path} ({error}): check format and suffix.") from error


def _tag_name(raw: meshio.Mesh) -> str | None:
    names: list[str] = [
        name
        for name, blocks in raw.cell_data.items()
        if name not in _NOT_TAGS and all(np.issubdtype(b.dtype, np.integer) and b.ndim == 1 for b in blocks)
    ]
    preferred = [name for name in _TAG_NAMES if name in names]
    return next(iter(preferred + names), None)


def _blocks(raw: meshio.Mesh, dimension: int) -> list[tuple[int, str, Integers]]:
    """Place in the file, shape and nodes of the blocks of cells of one dimension."""
    return [
        (i, shape, np.asarray(block.data, dtype=np.int64))
        for i, block in enumerate(raw.cells)
        if len(block.data) and (shape := shape_of(block.type)) and DIMENSIONS[shape] == dimension
    ]


def _marked(
    raw: meshio.Mesh,
    blocks: list[tuple[int, str, Integers]],
    cut: list[tuple[Integers, Integers]],
    tag_name: str | None,
    dimension: int,
) -> tuple[Integers, Ints | None, Sets]:
    """The simplices of all blocks, one mark each, and the marks of each tag number and named set.

    The marks count from 0: tag numbers of a file may need more than the 32 bits of a mark.
    """
    if not blocks:
        return np.zeros((0, dimension + 1), dtype=np.int64), None, {}
    nodes = cut[0][0] if len(cut) == 1 else np.concatenate([part[0] for part in cut])
    tags = np.zeros(len(nodes), dtype=np.int64)
    values: list[int] = []
    if tag_name is not None:
        # Numbers of any size, signed or not, by their place among all: one array of both kinds would be of floats.
        parts = [_numbered(np.asarray(raw.cell_data[tag_name][i])) for i, *_ in blocks]
        values = sorted({value for own, _ in parts for value in own})
        place = {value: k for k, value in enumerate(values)}
        of = [np.array([place[value] for value in own])[k] for own, k in parts]
        tags = np.concatenate([each[p] for each, (_, p) in zip(of, cut, strict=True)])
    named = _named(raw, blocks, cut)
    if tag_name is None and not named:
        return nodes, None, {}
    marks = tags
    for member in named.values():
        count = int(marks.max()) + 1
        inside = np.bincount(marks[member], minlength=count)
        mixed = (inside > 0) & (inside < np.bincount(marks, minlength=count))
        if mixed.any():
            marks = _numbered(2 * marks + (member & mixed[marks]))[1]
    sets: Sets = {}
    if tag_name is not None:
        count = int(marks.max()) + 1
        for pair in _numbered(tags * count + marks)[0]:
            tag, mark = divmod(pair, count)
            sets[values[tag]] = (*sets.get(values[tag], ()), mark)
    for name, number in _physical_names(raw, dimension).items():
        if tag_name == "gmsh:physical" and number in sets:
            sets[name] = sets[number]
    for name, member in named.items():
        sets[name] = tuple(np.flatnonzero(np.bincount(marks[member])).tolist())
    return nodes, marks.astype(np.int32), sets


def _numbered(numbers: npt.NDArray[np.integer]) -> tuple[list[int], Integers]:
    """The values that occur, ascending, and the place of each number among them: few and close ones are not sorted."""
    low, high = int(numbers.min()), int(numbers.max())
    if low == high:
        return [low], np.zeros(len(numbers), dtype=np.int64)
    if high - low > len(numbers):
        values, places = np.unique(numbers, return_inverse=True)
        return values.tolist(), places
    above = ((numbers if numbers.itemsize == 8 else numbers.astype(np.int64)) - low).astype(np.int64)
    occurs = np.bincount(above) > 0
    return [low + k for k in np.flatnonzero(occurs).tolist()], (np.cumsum(occurs) - 1)[above]


def _named(
    raw: meshio.Mesh, blocks: list[tuple[int, str, Integers]], cut: list[tuple[Integers, Integers]]
) -> dict[str, Flags]:
    """Simplices of each named set of the file, without empty sets.

    A set must have one list of cells a block; others (sets of sets) are left out, and so are unknown names then.
    """
    holds = {}
    for name, lists in raw.cell_sets.items():
        if name.startswith("gmsh:"):  # numbers of CAD entities, not of cells
            continue
        if len(lists) != len(raw.cells) or not all(_is_cell_list(part) for part in lists):
            continue
        members = []
        for (i, _, nodes), (_, parents) in zip(blocks, cut, strict=True):
            inside = np.zeros(len(nodes), dtype=np.bool_)
            if i < len(lists) and lists[i] is not None and len(lists[i]):
                inside[np.asarray(lists[i], dtype=np.int64)] = True
            members.append(inside[parents])
        if (member := np.concatenate(members)).any():
            holds[name] = member
    return holds


def _is_cell_list(part: object) -> bool:
    """Whether a block's share of a set is an array of cell numbers, or nothing."""
    if part is None:
        return True
    array = part if isinstance(part, np.ndarray) else None
    return array is not None and array.ndim == 1 and (array.size == 0 or np.issubdtype(array.dtype, np.integer))


def _physical_names(raw: meshio.Mesh, dimension: int) -> dict[str, int]:
    """Gmsh's names of tag numbers, {name: [number, dimension]} in the field data."""
    pairs = {name: np.asarray(pair) for name, pair in (raw.field_data or {}).items()}
    return {
        name: int(pair[0])
        for name, pair in pairs.items()
        if pair.shape == (2,) and np.issubdtype(pair.dtype, np.integer) and pair[1] == dimension
    }


def _in_plane(points: Floats, used: Integers, path: Path) -> Floats:
    if points.shape[1] == 3:
        height = np.abs(points[used, 2]).max()
        if not height <= 1e-10 * np.ptp(points[used, :2], axis=0).max():  # also false for NaN
            raise MeshError(
                f"{path} has surface cells only, and they leave the plane z = 0 (|z| up to {height:.3g}): "
                "give a flat mesh in x and y, or one of solid cells."
            )
    return np.ascontiguousarray(points[:, :2])
