"""The mesh that a scene names."""

from __future__ import annotations

from mpi4py import MPI

from softgrasp.fem.mesh.tissue_mesh import TissueMesh, structured_mesh
from softgrasp.fem.scene.scene import Scene


def make_mesh(comm: MPI.Intracomm, scene: Scene) -> TissueMesh:
    """Build the mesh of a scene: the given one, structured if ``tissue.size`` is set, else from ``tissue.mesh``.

    Collective.

    Raises:
        SceneError: the cells do not fit the size.
        MeshError: the mesh file cannot be read or its mesh cannot carry the model.
    """
    tissue = scene.tissue
    if scene._given is not None:
        mesh: TissueMesh = scene._given.on(comm)
        return mesh
    if tissue.size:
        return structured_mesh(comm, tissue.size, tissue.cells or [], tissue.origin)
    from softgrasp.fem.mesh.file import read_mesh  # meshio is needed for mesh files only

    path = scene.directory / str(tissue.mesh)
    result = read_mesh(comm, path, tissue.scale, tissue.repair, tissue.seam, tissue.read_limit)
    scene._mesh_digest = result.digest  # the hash of the scene is of what was read, not of a later state of the file
    return result
