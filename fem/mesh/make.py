"""The tissue as a distributed simplex mesh, structured or read from a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import dolfinx.mesh
import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from softgrasp.fem.errors import SceneError

if TYPE_CHECKING:
    from softgrasp.fem.mesh.bisect import Whole
    from softgrasp.fem.mesh.parts import Parts
    from softgrasp.fem.scene.scene import Scene


@dataclass(frozen=True)
class TissueMesh:
    """A mesh of linear triangles or tetrahedra and what is known of it.

    Attributes:
        mesh: distributed mesh; the topological dimension equals the geometric one.
        dimension: 2 or 3.
        facet_tags: integer marks of boundary facets, or None.
        cell_tags: integer marks of cells (layers), or None.
        source: "structured" or the name of the mesh file, for messages.
        part_tags: number of the part of each cell, parts hanging together through facets; None if it is one.
        parts: what is known of these parts, or None.
        facet_sets: marks in ``facet_tags`` of each tag number and named set of the file, on all ranks.
        cell_sets: marks in ``cell_tags`` of each tag number and named set of the file, on all ranks.
        contact: facets of the contact zone that a refined mesh inherits; None: they are selected on this mesh.
        layers: number of the layer of each cell that a refined mesh inherits, -1 for none; None likewise.
        whole: a bisected mesh on rank 0, to bisect it further; None elsewhere and on other meshes.
    """

    mesh: dolfinx.mesh.Mesh
    dimension: int
    facet_tags: dolfinx.mesh.MeshTags | None
    cell_tags: dolfinx.mesh.MeshTags | None
    source: str
    part_tags: dolfinx.mesh.MeshTags | None = None
    parts: Parts | None = None
    facet_sets: dict[int | str, tuple[int, ...]] = field(default_factory=dict)
    cell_sets: dict[int | str, tuple[int, ...]] = field(default_factory=dict)
    contact: dolfinx.mesh.MeshTags | None = None
    layers: dolfinx.mesh.MeshTags | None = None
    whole: Whole | None = None


def make_mesh(comm: MPI.Intracomm, scene: Scene) -> TissueMesh:
    """Build the mesh of a scene: structured if ``tissue.size`` is given, else from ``tissue.mesh``.

    Collective.

    Raises:
        SceneError: neither a size nor a mesh file is given, or the cells do not fit the size.
        MeshError: the mesh file cannot be read or its mesh cannot carry the model.
    """
    tissue = scene.tissue
    if tissue.size:
        if not tissue.cells:
            raise SceneError("tissue.cells is missing: a tissue with a size needs one number of cells per side.")
        return structured_mesh(comm, tissue.size, tissue.cells, tissue.origin)
    if tissue.mesh is None:
        raise SceneError("tissue.size and tissue.mesh are both missing: give one of them.")
    from softgrasp.fem.mesh.file import read_mesh  # meshio is needed for mesh files only

    return read_mesh(comm, scene.directory / tissue.mesh, tissue.scale, tissue.repair)


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
        comm: communicator of the mesh.
        size: side lengths, 2 or 3 positive numbers [m].
        cells: cells per side.
        origin: lower corner [m]; zero if None or empty.

    Raises:
        SceneError: the lengths of ``size``, ``cells`` and ``origin`` differ or are not positive.
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
    return TissueMesh(mesh, dimension, None, None, "structured")


def cell_nodes(mesh: dolfinx.mesh.Mesh) -> npt.NDArray[np.int32]:
    """Local node numbers of the cells, shape (n_cells, d + 1). Not collective."""
    geometry = mesh.geometry
    # DOLFINx 0.10 has no list of dofmaps, 0.11 warns of the single one
    return np.asarray(geometry.dofmaps[0] if hasattr(geometry, "dofmaps") else geometry.dofmap)
