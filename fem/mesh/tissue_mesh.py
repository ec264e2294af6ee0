"""The mesh of the tissue, whole on one rank or spread over all: made, marked, and how its file was read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import basix.ufl
import dolfinx.io
import dolfinx.mesh
import numpy as np
import ufl
from dolfinx.graph import adjacencylist
from mpi4py import MPI

from softgrasp.fem.errors import SceneError
from softgrasp.fem.mesh.check import Facets, Floats, Integers, Ints, Parts, find_parts, hanging_nodes, hanging_text

Sets = dict[int | str, tuple[int, ...]]  # marks of each tag number and named set of a file
Marks = dict[str, tuple[int, Integers, Ints | None]]  # dimension of entities, their nodes, one value each or None


@dataclass(frozen=True)
class MeshArrays:
    """A simplex mesh in arrays, on one rank."""

    points: Floats  # shape (n_points, d) [m]
    cells: Integers  # shape (n_cells, d + 1)
    marks: Marks  # mesh tags by field of TissueMesh
    known: dict[str, Any]  # other fields of TissueMesh


def inspected(
    body: tuple[Floats, Integers, Ints | None],
    facets: tuple[Integers, Ints | None],
    sides: Facets,
    known: dict[str, Any],
    seam: float,
    name: str,
) -> MeshArrays:
    """The arrays of a mesh with the parts of its body and a note on its hanging nodes.

    Args:
        body: points (n_points, d) [m], cells (n_cells, d + 1) and their marks.
        facets: marked facets (n, d) and their marks.
        sides: the facets of all cells, from `sort_facets`.
        known: other fields of TissueMesh; its notes are those on doubled nodes.
        seam: share of the shortest edge, as of `read_mesh` [1].
        name: the mesh in messages.

    Raises MeshError: a facet has more than two cells.
    """
    points, cells, cell_tags = body
    d = points.shape[1]
    part_tags, parts = find_parts(points, cells, sides, name) or (None, None)
    notes = (*known["notes"], *hanging_text(points, hanging_nodes(points, cells, sides, seam), name))
    marks: Marks = {
        "facet_tags": (d - 1, *facets),
        "cell_tags": (d, cells, cell_tags),
        "part_tags": (d, cells, part_tags),
    }
    return MeshArrays(points, cells, marks, known | {"notes": notes, "parts": parts})


@dataclass(frozen=True)
class Whole:
    """A simplex mesh on one rank with the marks of its cells and facets."""

    mesh: dolfinx.mesh.Mesh  # whole mesh on MPI.COMM_SELF
    source: str  # name of the mesh, for messages
    cells: dict[str, Ints]  # mark of each cell, (n_cells,), for the fields cell_tags and layers of TissueMesh
    facets: dict[str, dolfinx.mesh.MeshTags]  # marks of facets for the fields facet_tags and contact of TissueMesh
    facet_sets: Sets = field(default_factory=dict)  # marks in facet_tags of each tag number and named set
    cell_sets: Sets = field(default_factory=dict)  # marks in cell_tags of each tag number and named set

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return int(self.mesh.topology.dim)

    @property
    def points(self) -> Floats:
        """Coordinates, (n_points, d) [m]."""
        return np.asarray(self.mesh.geometry.x[:, : self.dimension])

    @property
    def simplices(self) -> Integers:
        """Nodes of the cells, (n_cells, d + 1)."""
        return np.asarray(cell_nodes(self.mesh), dtype=np.int64)

    def facet_nodes(self, name: str) -> Integers:
        """Nodes of the marked facets, (n, d)."""
        indices = self.facets[name].indices
        self.mesh.topology.create_connectivity(self.dimension - 1, self.dimension)
        nodes = dolfinx.mesh.entities_to_geometry(self.mesh, self.dimension - 1, indices)
        return np.asarray(nodes, dtype=np.int64)


@dataclass(frozen=True)
class TissueMesh:
    """A distributed mesh of linear triangles or tetrahedra, its marks and its origin."""

    mesh: dolfinx.mesh.Mesh  # distributed mesh; the topological dimension equals the geometric one
    dimension: int  # 2 or 3
    source: str  # "structured" or the name of the mesh file, for messages
    facet_tags: dolfinx.mesh.MeshTags | None = None  # integer marks of boundary facets
    cell_tags: dolfinx.mesh.MeshTags | None = None  # integer marks of cells (layers)
    # number of the part of each cell, parts hanging together through facets; None if it is one
    part_tags: dolfinx.mesh.MeshTags | None = None
    parts: Parts | None = None  # size, place and joints of these parts; None if it is one
    facet_sets: Sets = field(default_factory=dict)  # marks in ``facet_tags``, on all ranks
    cell_sets: Sets = field(default_factory=dict)  # marks in ``cell_tags``, on all ranks
    notes: tuple[str, ...] = ()  # warnings about the file, one sentence each, on all ranks
    digest: str = ""  # SHA-256 of what was read from the file, on all ranks; empty without one
    # facets of the contact zone that a refined mesh inherits; None: they are selected on this mesh
    contact: dolfinx.mesh.MeshTags | None = None
    # number of the layer of each cell that a refined mesh inherits, -1 for none; None likewise
    layers: dolfinx.mesh.MeshTags | None = None
    whole: Whole | None = None  # a bisected mesh on rank 0, to bisect it further; None elsewhere and on other meshes

    @property
    def owned(self) -> int:
        """Number of the cells that this rank owns; they come first."""
        return int(self.mesh.topology.index_map(self.dimension).size_local)

    @property
    def vertices(self) -> Floats:
        """Coordinates of the vertices of the owned cells, (owned, d + 1, d) [m]."""
        return np.asarray(self.mesh.geometry.x[cell_nodes(self.mesh)[: self.owned], : self.dimension])

    @property
    def edges(self) -> Floats:
        """Edges from the first vertex of the owned cells to the others, one a row, (owned, d, d) [m]."""
        x = self.vertices
        return x[:, 1:] - x[:, :1]


def cell_nodes(mesh: dolfinx.mesh.Mesh) -> Ints:
    """Local node numbers of the cells, shape (n_cells, d + 1)."""
    geometry = mesh.geometry
    # DOLFINx 0.10 has no list of dofmaps, 0.11 warns of the single one
    return np.asarray(geometry.dofmaps[0] if hasattr(geometry, "dofmaps") else geometry.dofmap)


def spread(comm: MPI.Intracomm, arrays: MeshArrays | None) -> TissueMesh:
    """Distribute a mesh from rank 0, None elsewhere. Collective."""
    facts = None
    if arrays is not None:
        kept = {name: mark[0] for name, mark in arrays.marks.items() if mark[2] is not None}
        facts = arrays.points.shape[1], kept, arrays.known
    d, dimensions, known = comm.bcast(facts)
    if arrays is None:
        marks: Marks = {k: (n, np.zeros((0, n + 1), np.int64), np.zeros(0, np.int32)) for k, n in dimensions.items()}
        arrays = MeshArrays(np.zeros((0, d)), np.zeros((0, d + 1), np.int64), marks, known)
    shape = {2: "triangle", 3: "tetrahedron"}[d]
    domain = ufl.Mesh(basix.ufl.element("Lagrange", shape, 1, shape=(d,)))
    mesh = dolfinx.mesh.create_mesh(comm, arrays.cells, domain, arrays.points.copy())
    tags = {}
    for name, dimension in dimensions.items():
        for a, b in ((dimension, 0), (dimension, d)):
            mesh.topology.create_entities(a)
            mesh.topology.create_connectivity(a, b)
        _, nodes, values = arrays.marks[name]
        local, here = dolfinx.io.distribute_entity_data(
            mesh, dimension, np.ascontiguousarray(nodes), np.ascontiguousarray(values, dtype=np.int32)
        )
        entities = adjacencylist(np.ascontiguousarray(local, dtype=np.int32))
        tags[name] = dolfinx.mesh.meshtags_from_entities(mesh, dimension, entities, here.astype(np.int32))
    return TissueMesh(mesh=mesh, dimension=d, **known, **tags)


def structured_mesh(
    comm: MPI.Intracomm,
    size: Sequence[float],
    cells: Sequence[int],
    origin: Sequence[float] | None = None,
) -> TissueMesh:
    """Cut the box ``origin + [0, size]`` into regular triangles (2D) or tetrahedra (3D).

    A rectangle of nx x ny cells has 2 nx ny triangles, a box 6 nx ny nz tetrahedra.

    Collective.

    Args:
        size: side lengths, 2 or 3 positive numbers [m].
        origin: lower corner [m]; zero if None or empty.

    Raises SceneError: the lengths of ``size``, ``cells`` and ``origin`` differ or are not positive.
    """
    dimension = len(size)
    low = np.asarray(origin if origin is not None and len(origin) else np.zeros(dimension), dtype=np.float64)
    if dimension not in (2, 3) or len(cells) != dimension or len(low) != dimension:
        raise SceneError(
            f"tissue.size has {dimension}, tissue.cells {len(cells)} and tissue.origin {len(low)} entries: "
            "give 2 entries each for a rectangle or 3 for a box."
        )
    if min(size) <= 0 or min(cells) < 1:
        raise SceneError(f"tissue.size {list(size)} and tissue.cells {list(cells)} must be positive.")
    corners = [low, low + np.asarray(size, dtype=np.float64)]
    if dimension == 2:
        mesh = dolfinx.mesh.create_rectangle(comm, corners, list(cells))
    else:
        mesh = dolfinx.mesh.create_box(comm, corners, list(cells))
    return TissueMesh(mesh, dimension, "structured")
