"""The tissue as a distributed simplex mesh, structured or read from a file."""

from __future__ import annotations

from collections.abc import Sequence

import dolfinx.mesh
import numpy as np
from mpi4py import MPI

from softgrasp.fem.errors import SceneError
from softgrasp.fem.mesh.tissue_mesh import TissueMesh
from softgrasp.fem.scene.scene import Scene


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

    path = scene.directory / tissue.mesh
    result = read_mesh(comm, path, tissue.scale, tissue.repair, tissue.seam, tissue.read_limit)
    scene._mesh_digest = result.digest  # the hash of the scene is of what was read, not of what the file says later
    return result


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
