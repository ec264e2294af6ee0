"""The free boundary of the tissue: the nodes that obstacles can touch, the same on every rank."""

from __future__ import annotations

from dataclasses import dataclass

import dolfinx.mesh
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from softgrasp.fem.model.assembly import Discretisation
from softgrasp.fem.petsc import Array, rows_on_all, total
from softgrasp.fem.system import BlockSystem


@dataclass(frozen=True)
class Surface:
    """Nodes of the boundary that do not follow the hand, in the order of their numbers."""

    comm: MPI.Intracomm  # ranks of the tissue
    X: Array  # coordinates at rest, (p, d) [m]
    T: Array  # rigid modes of the hand there, (p d, n_s) [1, m]
    dofs: NDArray[np.intp]  # numbers among all tissue unknowns, (p d,)
    mine: NDArray[np.intp]  # places here of the unknowns that this rank owns
    rows: NDArray[np.intp]  # rows of those among the owned ones

    def places(self, q: Array, z: Array | float = 0.0) -> Array:
        """Coordinates of the nodes with the hand at q (n_s,) and displacements z (p d,) of the tissue, (p, d) [m]."""
        return self.X + (z + self.T @ q).reshape(self.X.shape)

    def gather(self, x: Array) -> Array:
        """Values (p d,) of a vector given by its owned rows. Collective."""
        if self.comm.size == 1:
            return x[self.rows]
        part = np.zeros(len(self.dofs))
        part[self.mine] = x[self.rows]
        return total(self.comm, part)


def node_distance(space: Discretisation) -> float:
    """Largest distance of neighbouring nodes on a boundary edge [m], that of straight cells. Collective."""
    mesh = space.V.mesh
    mesh.topology.create_connectivity(space.mesh.dimension - 1, space.mesh.dimension)
    facets = dolfinx.mesh.exterior_facet_indices(mesh.topology)
    longest = mesh.comm.allreduce(mesh.h(space.mesh.dimension - 1, facets).max(initial=0.0), MPI.MAX)
    return float(longest / space.V.element.basix_element.degree)


def make_surface(space: Discretisation, system: BlockSystem) -> Surface:
    """The free boundary of a model. Collective."""
    layout = system.layout
    nodes = np.flatnonzero(space.surface()[0])
    rows = (nodes[:, None] * layout.dimension + np.arange(layout.dimension)).ravel()
    dofs = rows_on_all(layout.comm, layout.start + rows)
    first = sum(layout.comm.allgather(len(rows))[: layout.comm.rank])
    mine = np.arange(first, first + len(rows))
    return Surface(
        comm=layout.comm,
        X=rows_on_all(layout.comm, layout.nodes[nodes]),
        T=rows_on_all(layout.comm, system.T[rows]),
        dofs=dofs,
        mine=mine,
        rows=rows,
    )
