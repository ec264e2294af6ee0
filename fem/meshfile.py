"""Mesh files of any format meshio reads: taken apart and checked on rank 0, then distributed."""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from pathlib import Path

import basix.ufl
import dolfinx.io
import dolfinx.mesh
import meshio
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx.graph import adjacencylist
from mpi4py import MPI

from fem.errors import MeshError, agree
from fem.geometry import TissueMesh
from fem.meshcheck import check_cells, components

Integers = npt.NDArray[np.int64]
Tags = npt.NDArray[np.int32]

_LINEAR = {"vertex": 0, "line": 1, "triangle": 2, "tetra": 3}  # dimension of the cell types we take
_SHAPES = {2: "triangle", 3: "tetrahedron"}
_TAG_NAMES = ("gmsh:physical", "medit:ref", "CellEntityIds")  # preferred names of integer cell data
_NOT_TAGS = ("gmsh:geometrical",)  # numbers of CAD entities, not marks of the user
_NO_TAGS: Tags = np.zeros(0, dtype=np.int32)


@dataclass(frozen=True)
class MeshArrays:
    """A simplex mesh in arrays, before distribution.

    Attributes:
        points: shape (n_points, d) [m].
        cells: shape (n_cells, d + 1).
        cell_tags: one integer a cell, or None.
        facets: tagged facets, shape (n_facets, d).
        facet_tags: one integer a tagged facet, or None.
        parts: number of the connected part of each cell, or None if there is one part only.
    """

    points: npt.NDArray[np.float64]
    cells: Integers
    cell_tags: Tags | None
    facets: Integers
    facet_tags: Tags | None
    parts: Tags | None


def read_mesh(comm: MPI.Intracomm, path: Path, scale: float = 1.0, repair: bool = False) -> TissueMesh:
    """Read a mesh of linear triangles or tetrahedra with its facet and cell tags.

    Collective. Rank 0 reads and checks.

    Args:
        comm: communicator of the mesh.
        path: mesh file in any format of meshio.
        scale: factor of all coordinates, e.g. 1e-3 for a file in millimetres.
        repair: turn inverted cells round instead of refusing them.

    Raises:
        MeshError: the file is missing or unreadable, holds other cells than linear simplices, a triangle mesh
            is not in the plane z = 0, or a cell is flat or inverted.
    """
    arrays: MeshArrays | None = None
    with agree(comm):
        if comm.rank == 0:
            arrays = load_arrays(path, scale, repair)
    facts = (arrays.points.shape[1], arrays.cell_tags is not None, arrays.facet_tags is not None,
             arrays.parts is not None) if arrays else None  # fmt: skip
    dimension, has_cell_tags, has_facet_tags, has_parts = comm.bcast(facts)
    if arrays is None:
        none = np.zeros((0, dimension))
        empty = np.zeros((0, dimension + 1), dtype=np.int64)
        arrays = MeshArrays(none, empty, _NO_TAGS, empty[:, 1:], _NO_TAGS, _NO_TAGS)
    domain = ufl.Mesh(basix.ufl.element("Lagrange", _SHAPES[dimension], 1, shape=(dimension,)))
    mesh = dolfinx.mesh.create_mesh(comm, arrays.cells, domain, arrays.points)
    return TissueMesh(
        mesh,
        dimension,
        _distribute(mesh, dimension - 1, arrays.facets, arrays.facet_tags) if has_facet_tags else None,
        _distribute(mesh, dimension, arrays.cells, arrays.cell_tags) if has_cell_tags else None,
        path.name,
        _distribute(mesh, dimension, arrays.cells, arrays.parts) if has_parts else None,
    )


def load_arrays(path: Path, scale: float, repair: bool) -> MeshArrays:
    """Read and check a mesh file. Not collective.

    Raises:
        MeshError: see `read_mesh`.
    """
    raw = _read(path)
    found = sorted({block.type for block in raw.cells})
    dimension = max((_LINEAR.get(kind, 0) for kind in found), default=0)
    if any(kind not in _LINEAR for kind in found) or dimension < 2:
        raise MeshError(
            f"{path} holds cells of type {', '.join(found) or 'none'}: "
            "only linear triangles or tetrahedra are taken, export the mesh with these."
        )
    tag_name = _tag_name(raw)
    cells, cell_tags = _collect(raw, dimension, tag_name)
    facets, facet_tags = _collect(raw, dimension - 1, tag_name)
    for block in (cells, facets):
        if block.size and not 0 <= block.min() <= block.max() < len(raw.points):
            raise MeshError(f"{path} has cells with node numbers outside 0 to {len(raw.points) - 1}: export it again.")
    used, numbers = np.unique(cells, return_inverse=True)
    cells = numbers.reshape(cells.shape).astype(np.int64)
    points = np.asarray(raw.points, dtype=np.float64)[used] * scale
    points = _in_plane(points, path) if dimension == 2 else points
    cells = check_cells(points, cells, repair, str(path))
    if facet_tags is not None:
        # Facets with a node that no cell uses belong to leftover geometry.
        kept = np.isin(facets, used).all(axis=1)
        facets, facet_tags = np.searchsorted(used, facets[kept]).astype(np.int64), facet_tags[kept]
    count, parts = components(cells, len(points))
    return MeshArrays(points, cells, cell_tags, facets, facet_tags, parts if count > 1 else None)


def _read(path: Path) -> meshio.Mesh:
    if not path.is_file():
        raise MeshError(f"The mesh file {path} does not exist: tissue.mesh is taken relative to the scene file.")
    said = io.StringIO()
    try:
        # meshio prints its complaints and may end the process; one sentence is enough.
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            return meshio.read(path)
    except (Exception, SystemExit) as error:
        reason = " ".join(f"{error if not isinstance(error, SystemExit) else ''} {said.getvalue()}".split())
        raise MeshError(
            f"meshio cannot read {path} ({reason or type(error).__name__}): check format and suffix."
        ) from error


def _tag_name(raw: meshio.Mesh) -> str | None:
    names: list[str] = [
        name
        for name, blocks in raw.cell_data.items()
        if name not in _NOT_TAGS and all(np.issubdtype(b.dtype, np.integer) and b.ndim == 1 for b in blocks)
    ]
    preferred = [name for name in _TAG_NAMES if name in names]
    return next(iter(preferred + names), None)


def _collect(raw: meshio.Mesh, dimension: int, tag_name: str | None) -> tuple[Integers, Tags | None]:
    """All cells of one dimension, and their tags if the file has any."""
    chosen = [i for i, block in enumerate(raw.cells) if _LINEAR[block.type] == dimension]
    if not chosen:
        return np.zeros((0, dimension + 1), dtype=np.int64), None
    cells = np.concatenate([np.asarray(raw.cells[i].data, dtype=np.int64) for i in chosen])
    if tag_name is None:
        return cells, None
    return cells, np.concatenate([raw.cell_data[tag_name][i] for i in chosen]).astype(np.int32)


def _in_plane(points: npt.NDArray[np.float64], path: Path) -> npt.NDArray[np.float64]:
    if points.shape[1] == 3:
        height = np.abs(points[:, 2]).max()
        if not height <= 1e-10 * np.ptp(points[:, :2], axis=0).max():  # also false for NaN
            raise MeshError(
                f"{path} holds triangles only, and they leave the plane z = 0 (|z| up to {height:.3g}): "
                "give a flat mesh in x and y, or one of tetrahedra."
            )
    return np.ascontiguousarray(points[:, :2])


def _distribute(
    mesh: dolfinx.mesh.Mesh, dimension: int, entities: Integers, values: Tags | None
) -> dolfinx.mesh.MeshTags:
    """Mesh tags from entities in file numbering, given on rank 0. Collective."""
    mesh.topology.create_entities(dimension)
    mesh.topology.create_connectivity(dimension, 0)
    mesh.topology.create_connectivity(dimension, mesh.topology.dim)
    given = values if values is not None else _NO_TAGS
    local, local_values = dolfinx.io.distribute_entity_data(
        mesh, dimension, np.ascontiguousarray(entities), np.ascontiguousarray(given, dtype=np.int32)
    )
    vertices = adjacencylist(np.ascontiguousarray(local, dtype=np.int32))
    return dolfinx.mesh.meshtags_from_entities(mesh, dimension, vertices, local_values.astype(np.int32))
