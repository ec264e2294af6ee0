"""A mesh in arrays on rank 0, with marks on cells and facets, spread over the ranks."""

from __future__ import annotations

import basix.ufl
import dolfinx.io
import dolfinx.mesh
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx.graph import adjacencylist
from mpi4py import MPI

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Marks = dict[str, tuple[int, Integers, npt.NDArray[np.int32]]]  # dimension of entities, their nodes, one value each


def spread(
    comm: MPI.Intracomm, d: int, body: tuple[Floats, Integers] | None, marks: Marks
) -> tuple[dolfinx.mesh.Mesh, dict[str, dolfinx.mesh.MeshTags]]:
    """Distribute points and simplices, and mesh tags by name. Collective.

    Args:
        comm: communicator.
        d: dimension, on all ranks.
        body: points (n_points, d) [m] and cells (n_cells, d + 1) on rank 0, None elsewhere.
        marks: on rank 0, empty elsewhere.
    """
    points, cells = body or (np.zeros((0, d)), np.zeros((0, d + 1), dtype=np.int64))
    shape = {2: "triangle", 3: "tetrahedron"}[d]
    domain = ufl.Mesh(basix.ufl.element("Lagrange", shape, 1, shape=(d,)))
    mesh = dolfinx.mesh.create_mesh(comm, cells, domain, points.copy())
    tags = {}
    for name, dimension in comm.bcast({name: mark[0] for name, mark in marks.items()}).items():
        for a, b in ((dimension, 0), (dimension, d)):
            mesh.topology.create_entities(a)
            mesh.topology.create_connectivity(a, b)
        nothing = np.zeros((0, dimension + 1), dtype=np.int64), np.zeros(0, dtype=np.int32)
        nodes, values = marks[name][1:] if name in marks else nothing
        local, here = dolfinx.io.distribute_entity_data(
            mesh, dimension, np.ascontiguousarray(nodes), np.ascontiguousarray(values, dtype=np.int32)
        )
        entities = adjacencylist(np.ascontiguousarray(local, dtype=np.int32))
        tags[name] = dolfinx.mesh.meshtags_from_entities(mesh, dimension, entities, here.astype(np.int32))
    return mesh, tags
