"""The displacement at points of the body that need not be nodes, y(p) = R(p) q_s + sum_i phi_i(p) z_i.

phi_i are the shape functions of the cell that contains p, so that y(p) is the same quantity on every mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import dolfinx.geometry
import numpy as np
from mpi4py import MPI

from softgrasp.fem.mesh.tissue_mesh import cell_nodes
from softgrasp.fem.model.assembly import Discretisation
from softgrasp.fem.model.contact import rigid_modes
from softgrasp.fem.petsc import Array, total


@dataclass(frozen=True)
class Probe:
    """Outputs on one mesh, y = weights z[dofs] + C_s q_s, d components an output."""

    dofs: np.ndarray  # local tissue dofs that enter, (k,)
    weights: Array  # (p, k), p = outputs times d
    C_s: Array  # rigid part, (p, n_s), on every rank
    dimension: int  # d

    def of_rows(self, comm: MPI.Intracomm, L: Array) -> Array:
        """Weights on the columns of a distributed block of displacements (n_local, N): (p, N). Collective."""
        return total(comm, self.weights @ L[self.dofs])


def make_probe(space: Discretisation, places: Sequence[Array], rotation: bool) -> Probe:
    """Means of the displacement over several sets of points. Collective.

    Args:
        places: one array of points (k, d) [m] an output, the same on every rank; empty for the hand's displacement.
        rotation: the hand turns.
    """
    layout, index_map = space.layout, space.V.dofmap.index_map
    d, n_s = layout.dimension, layout.n_s
    position = np.full(index_map.size_local, -1)
    position[space.free] = np.arange(len(space.free))
    C_s = np.zeros((len(places) * d, n_s))
    entries = []  # of each output: free nodes and their weights
    for i, points in enumerate(places):
        if not len(points):
            C_s[i * d : (i + 1) * d, :d] = np.eye(d)
            continue
        nodes, values, where = locate(space, points)
        for row in rigid_modes(where, d, rotation, layout.reference).reshape(len(points), d, n_s):
            C_s[i * d : (i + 1) * d] += row / len(points)
        own = nodes - index_map.local_range[0]
        here = (own >= 0) & (own < len(position))
        columns, shares = position[own[here]], values[here] / len(points)
        entries.append((i, columns[columns >= 0], shares[columns >= 0]))
    free = np.unique(np.concatenate([np.zeros(0, dtype=int), *[columns for _, columns, _ in entries]]))
    weights = np.zeros((len(places), len(free)))
    for i, columns, shares in entries:
        np.add.at(weights[i], np.searchsorted(free, columns), shares)
    dofs = (free[:, None] * d + np.arange(d)).ravel()
    return Probe(dofs, np.asarray(np.kron(weights, np.eye(d))), C_s, d)


def locate(space: Discretisation, points: Array) -> tuple[np.ndarray, Array, Array]:
    """Global nodes of the cells that contain points (k, d), their shape functions there, and the places. Collective.

    A point outside the body moves to the nearest point of the body.

    Returns:
        Nodes (k, n) and values (k, n) of the n shape functions of a cell, places (k, d); the same on every rank.
    """
    mesh, comm = space.mesh.mesh, space.layout.comm
    padded = np.zeros((len(points), 3))
    padded[:, : space.layout.dimension] = points
    cells = _nearest_cells(space, padded)
    distance = np.full(len(points), np.inf)
    if (cells >= 0).all():
        distance = dolfinx.geometry.squared_distance(mesh, space.mesh.dimension, cells, padded)
    # the first rank of those equally near to rounding: a point between two parts belongs to both
    distances = np.array(comm.allgather(distance))
    roots = np.argmax(distances <= distances.min(axis=0) + (1e-12 * space.layout.extent) ** 2, axis=0)
    local = {k: _shapes(space, cells[k], padded[k]) for k in range(len(points)) if roots[k] == comm.rank}
    shapes = {k: value for part in comm.allgather(local) for k, value in part.items()}
    nodes, values, where = (np.array([shapes[k][i] for k in range(len(points))]) for i in range(3))
    return nodes, values, where


def _nearest_cells(space: Discretisation, points: Array) -> np.ndarray:
    """Nearest owned cell of each point (k, 3), -1 on a rank without cells."""
    mesh, d = space.mesh.mesh, space.mesh.dimension
    owned = np.arange(space.mesh.owned, dtype=np.int32)
    if not len(owned):
        return np.full(len(points), -1, dtype=np.int32)
    boxes = dolfinx.geometry.bb_tree(mesh, d, padding=1e-12 * space.layout.extent, entities=owned)
    middles = dolfinx.geometry.create_midpoint_tree(mesh, d, owned)
    return np.asarray(dolfinx.geometry.compute_closest_entity(boxes, middles, mesh, points))


def _shapes(space: Discretisation, cell: int, point: Array) -> tuple[np.ndarray, Array, Array]:
    """Global nodes of a cell, their shape functions at its point nearest to (3,), and that point."""
    mesh, d = space.mesh.mesh, space.mesh.dimension
    corners = mesh.geometry.x[cell_nodes(mesh)[cell]]
    where = (point + dolfinx.geometry.compute_distance_gjk(corners, point[None, :]))[:d]
    X = np.linalg.solve((corners[1:, :d] - corners[0, :d]).T, where - corners[0, :d])  # cells are affine
    values = space.V.element.basix_element.tabulate(0, X[None, :])[0, 0, :, 0]
    nodes = space.V.dofmap.index_map.local_to_global(space.V.dofmap.cell_dofs(cell))
    return nodes, values, where
