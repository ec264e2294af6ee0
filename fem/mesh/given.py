"""A DOLFINx mesh of the user's own in the place of a mesh file: checked, named by its contents, used as it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import dolfinx.mesh
import numpy as np
from mpi4py import MPI

from softgrasp.fem.checksums import digest
from softgrasp.fem.errors import MeshError, raise_on_all_ranks
from softgrasp.fem.mesh.check import SEAM, Floats, Integers, Ints, check_cells, doubled_nodes, doubled_text, sort_facets
from softgrasp.fem.mesh.tissue_mesh import MeshArrays, Sets, TissueMesh, cell_nodes, inspected, spread
from softgrasp.fem.petsc import rows_on_root

if TYPE_CHECKING:
    from softgrasp.fem.scene.scene import Scene

GIVEN, NAME = "given", "The given mesh"  # tissue.mesh of its scene, and the beginning of a message
SHAPES = ("triangle", "tetrahedron")
type Tags = dolfinx.mesh.MeshTags | None


@dataclass(frozen=True)
class GivenMesh:
    """A mesh that was given to `softgrasp.build`, for models of its scene and of changed copies of it."""

    tissue: TissueMesh  # on the given mesh
    arrays: MeshArrays | None  # the whole mesh, to bisect it; on rank 0, None elsewhere

    def on(self, comm: MPI.Intracomm) -> TissueMesh:
        """The given mesh on its own ranks, or a copy on rank 0 alone.

        Raises MeshError: the communicator is another.
        """
        if comm.size == self.tissue.mesh.comm.size:
            return self.tissue
        if comm.size > 1 or self.arrays is None:
            raise MeshError("The given mesh lies on other ranks than the model; build both on one communicator.")
        return spread(comm, self.arrays)


def with_given_mesh(
    scene: Scene, comm: MPI.Intracomm, mesh: Any, cell_tags: Tags = None, facet_tags: Tags = None
) -> Scene:
    """The scene with a DOLFINx mesh in the place of its box or mesh file. Collective.

    Args:
        mesh: of linear triangles or tetrahedra on ``comm``, or what `dolfinx.io.gmsh.model_to_mesh` returns, with tags
            and names of physical groups.
        cell_tags: marks that ``tissue.layers.NAME.tag`` names.
        facet_tags: marks that ``contact.facet_tag`` names.

    Raises:
        MeshError: the mesh has other cells, is a surface in space, lies on another communicator or is broken.
    """
    groups: dict[str, Any] = {}
    if not isinstance(mesh, dolfinx.mesh.Mesh):
        if not isinstance(getattr(mesh, "mesh", None), dolfinx.mesh.Mesh):
            kind = type(mesh).__name__
            raise MeshError(
                f"mesh is a {kind}; give a dolfinx.mesh.Mesh or the result of dolfinx.io.gmsh.model_to_mesh."
            )
        groups = dict(getattr(mesh, "physical_groups", None) or {})
        cell_tags, facet_tags = cell_tags or mesh.cell_tags, facet_tags or mesh.facet_tags
        mesh = mesh.mesh
    _check_kind(mesh, comm)
    d = mesh.topology.dim
    with raise_on_all_ranks(comm):  # their counts are those of a rank
        for tags, dimension, key in ((cell_tags, d, "cell"), (facet_tags, d - 1, "facet")):
            if tags is not None and (tags.dim != dimension or _entities(tags.topology) != _entities(mesh.topology)):
                raise MeshError(f"{key}_tags are not of the {key}s of the given mesh; give tags of this mesh.")
    if (scale := scene.tissue.scale) != 1.0 or scene.tissue.repair:
        raise MeshError(f"tissue.scale = {scale:g} and tissue.repair are for mesh files; change the given mesh itself.")

    def edit(keys: dict[str, Any]) -> None:
        tissue = keys["tissue"]
        for key in ("size", "cells", "origin"):
            tissue.pop(key, None)
        tissue["mesh"] = GIVEN

    result = scene.changed(edit)
    result._given = _given(comm, mesh, (cell_tags, facet_tags), groups)
    return result


def _entities(topology: dolfinx.mesh.Topology) -> list[int]:
    """Numbers of vertices and cells on this rank and on all, which distinguish two meshes."""
    maps = [topology.index_map(dimension) for dimension in (0, topology.dim)]
    return [number for each in maps for number in (each.size_local, each.size_global)]


def _check_kind(mesh: dolfinx.mesh.Mesh, comm: MPI.Intracomm) -> None:
    d, cell, geometry = mesh.topology.dim, mesh.topology.cell_type.name, mesh.geometry
    # DOLFINx 0.10 has no list of maps, 0.11 warns of the single one
    order = (geometry.cmaps[0] if hasattr(geometry, "cmaps") else geometry.cmap).degree
    if cell not in SHAPES or order != 1:
        raise MeshError(
            f"The given mesh has cells of type {cell} and order {order}; give linear triangles or tetrahedra."
        )
    if mesh.geometry.dim != d:
        raise MeshError(
            f"The given mesh is a surface in space (gdim {mesh.geometry.dim}); make a plane mesh with gdim = 2."
        )
    if mesh.geometry.x.dtype != np.float64:
        raise MeshError(f"The given mesh has coordinates of {mesh.geometry.x.dtype}; make it with float64.")
    if MPI.Comm.Compare(mesh.comm, comm) not in (MPI.IDENT, MPI.CONGRUENT):
        raise MeshError("The given mesh lies on other ranks than the model; build both on one communicator.")


def _given(comm: MPI.Intracomm, mesh: dolfinx.mesh.Mesh, tags: tuple[Tags, Tags], groups: dict[str, Any]) -> GivenMesh:
    """Check the mesh on rank 0 as a file is. Collective."""
    d = mesh.topology.dim
    for a, b in ((d - 1, 0), (d - 1, d), (d, d - 1)):
        mesh.topology.create_connectivity(a, b)
    cells, facets = (_marked(mesh, dimension, each) for dimension, each in ((d, tags[0]), (d - 1, tags[1])))
    sets = [_sets(comm, each, groups, dimension) for dimension, each in ((d, tags[0]), (d - 1, tags[1]))]
    points = _points(comm, mesh)
    arrays = labels = None
    with raise_on_all_ranks(comm):
        if points is not None and cells is not None and facets is not None:
            arrays, labels = _arrays(points, (cells, facets), sets)
    known = comm.bcast(None if arrays is None else arrays.known)
    known |= {"part_tags": _part_tags(mesh, comm.bcast(labels)) if known["parts"] is not None else None}
    marks = {key: each for key, each in zip(("cell_tags", "facet_tags"), tags, strict=True) if each is not None}
    return GivenMesh(TissueMesh(mesh, d, **known, **marks), arrays)


def _sets(comm: MPI.Intracomm, tags: Tags, groups: dict[str, Any], dimension: int) -> Sets:
    """Marks of each tag number and physical group, on all ranks. Collective."""
    own: set[int] = set() if tags is None else set(np.unique(tags.values).tolist())
    values: set[int] = set().union(*comm.allgather(own))
    sets: Sets = {value: (value,) for value in sorted(values)}
    for group, pair in groups.items():
        of, tag = (int(number) for number in tuple(pair)[:2])
        if of == dimension and tag in values:
            sets[group] = (tag,)
    return sets


def _points(comm: MPI.Intracomm, mesh: dolfinx.mesh.Mesh) -> Floats | None:
    """Coordinates by global number, on rank 0. Collective."""
    return rows_on_root(comm, mesh.geometry.x[: mesh.geometry.index_map().size_local, : mesh.geometry.dim])


def _marked(mesh: dolfinx.mesh.Mesh, dimension: int, tags: Tags) -> tuple[Integers, Ints | None] | None:
    """Global nodes of the owned cells, or of the marked owned facets, with their marks; on rank 0. Collective."""
    comm, owned = mesh.comm, mesh.topology.index_map(dimension).size_local
    if dimension == mesh.topology.dim:
        local = cell_nodes(mesh)[:owned]
        values = np.zeros(owned, dtype=np.int32)
        if tags is not None:
            mine = tags.indices < owned
            values[tags.indices[mine]] = tags.values[mine]
    else:
        mine = np.zeros(0, dtype=bool) if tags is None else tags.indices < owned
        entities = np.zeros(0, dtype=np.int32) if tags is None else tags.indices[mine]
        values = np.zeros(0, dtype=np.int32) if tags is None else tags.values[mine]
        local = dolfinx.mesh.entities_to_geometry(mesh, dimension, entities)
    numbers = mesh.geometry.index_map().local_to_global(np.ascontiguousarray(local, dtype=np.int32).ravel())
    nodes = rows_on_root(comm, numbers.reshape(-1, dimension + 1).astype(np.int64))
    marks = rows_on_root(comm, np.asarray(values, dtype=np.int32))
    return None if nodes is None else (nodes, None if tags is None else marks)


def _arrays(
    points: Floats, entities: Sequence[tuple[Integers, Ints | None]], sets: list[Sets]
) -> tuple[MeshArrays, Ints | None]:
    """The whole mesh in an order that its contents alone decide, and the number of the part of each cell as given.

    Raises MeshError: a point is not finite, or a cell is flat.
    """
    order = np.lexsort(points.T[::-1])
    number = np.argsort(order)
    points = points[order]
    rows = [np.sort(number[nodes], axis=1) for nodes, _ in entities]
    by = [np.lexsort(each.T[::-1]) for each in rows]
    sorted_ = [each[place] for each, place in zip(rows, by, strict=True)]
    marks = [None if values is None else values[place] for (_, values), place in zip(entities, by, strict=True)]
    cells, facets = check_cells(points, sorted_[0], True, NAME), sorted_[1]  # DOLFINx uses cells of any orientation
    sides = sort_facets(cells)
    notes = doubled_text(points, doubled_nodes(points, cells, sides, SEAM), SEAM, False, NAME, "join them")
    text = digest(points, sorted_[0], marks[0], facets, marks[1])
    known: dict[str, Any] = {"source": GIVEN, "notes": tuple(notes), "digest": text}
    known |= {"cell_sets": sets[0], "facet_sets": sets[1]}
    arrays = inspected((points, cells, marks[0]), (facets, marks[1]), sides, known, SEAM, NAME)
    labels = None
    if (part_tags := arrays.marks["part_tags"][2]) is not None:
        labels = np.empty(len(cells), dtype=np.int32)
        labels[by[0]] = part_tags
    return arrays, labels


def _part_tags(mesh: dolfinx.mesh.Mesh, labels: Ints) -> dolfinx.mesh.MeshTags:
    """Number of the part of each cell, ghosts too, from numbers by global cell."""
    index = mesh.topology.index_map(mesh.topology.dim)
    local = np.arange(index.size_local + index.num_ghosts, dtype=np.int32)
    return dolfinx.mesh.meshtags(mesh, mesh.topology.dim, local, labels[index.local_to_global(local)])
