"""Traction of contact on the boundary, t_i = F_i / A_i at each vertex i.

F_i = sum_j phi_i(y_j) f_j takes the forces f_j on nodes y_j to the linear shape functions phi_i, and A_i is the
integral of phi_i over the free facets that face F_i. So an even pressure comes out even whatever the order of the
elements, where forces on single nodes of quadratic elements in 3D alternate between zero and twice the mean.
"""

from __future__ import annotations

from math import factorial

import dolfinx.fem
import dolfinx.la
import dolfinx.mesh
import numpy as np
import scipy.sparse

from softgrasp.fem.mesh.tissue_mesh import cell_nodes
from softgrasp.fem.model.build import Model
from softgrasp.fem.model.contact import contact_facets
from softgrasp.fem.model.surface import Surface
from softgrasp.fem.petsc import Array

FACING = 0.5  # cosine of the largest angle between the inward normal of a facet and a force that acts on it [1]


class ContactTraction:
    """Forces on the nodes of the boundary as traction on the undeformed body. Making one is collective."""

    def __init__(self, model: Model) -> None:
        space, d = model.space, model.space.mesh.dimension
        self.space, self.d, mesh, nodes = space, d, space.mesh.mesh, space.V.dofmap.list
        mesh.topology.create_connectivity(d - 1, d)
        mesh.topology.create_connectivity(d, d - 1)
        held = contact_facets(space.mesh, model.scene.contact)
        facets = np.setdiff1d(dolfinx.mesh.exterior_facet_indices(mesh.topology), held)
        inside, around = mesh.topology.connectivity(d - 1, d), mesh.topology.connectivity(d, d - 1)
        cells = inside.array[inside.offsets[facets]]
        opposite = (around.array.reshape(-1, d + 1)[cells] == facets[:, None]).argmax(axis=1)
        x = mesh.geometry.x[cell_nodes(mesh)[cells], :d]
        edges = x[:, 1:] - x[:, :1]
        slopes = np.linalg.inv(edges).transpose(0, 2, 1)  # gradients of phi_1 .. phi_d in the cell
        slopes = np.concatenate([-slopes.sum(axis=1, keepdims=True), slopes], axis=1)
        volume = np.abs(np.linalg.det(edges)) / factorial(d)
        # area times inward normal of each facet, (facets, d) [m^2]
        inward = d * volume[:, None] * slopes[np.arange(len(facets)), opposite] * model.scene.tissue.thickness
        on = np.arange(d + 1) != opposite[:, None]
        self.corners, self.inward = nodes[cells, : d + 1][on].reshape(-1, d), inward  # vertices of each facet
        free, fixed = space.surface()
        mine = np.sort(np.concatenate([space.free[free], space.contact[fixed]]))
        used, first = np.unique(nodes, return_index=True)  # each node with one of the cells around it
        cell, place = np.divmod(first[np.searchsorted(used, mine)], nodes.shape[1])
        at = space.V.element.basix_element.points
        phi = np.column_stack([1 - at.sum(axis=1), at])[place]
        rows, count = np.repeat(mine, d + 1), int(nodes.max(initial=-1)) + 1
        # phi_i(y_j) for the nodes j of the boundary that this rank owns
        self.phi = scipy.sparse.csr_matrix((phi.ravel(), (rows, nodes[cell, : d + 1].ravel())), shape=(count, count))

    def __call__(self, surface: Surface, forces: Array) -> Array:
        """Traction (local nodes, d) [Pa] of forces (p, d) [N] on boundary points, ghosts updated. Collective."""
        part = np.zeros(self.space.layout.n_local)
        part[surface.rows] = surface.on_nodes(forces.ravel())[surface.mine]
        f = self.space.nodal(part).x.array.reshape(-1, self.d)
        F = self._exchanged(self.phi.T @ f, add=True)
        size = np.linalg.norm(F, axis=1)
        there = F[self.corners] / np.where(size > 0, size, 1.0)[self.corners][..., None]  # directions, (facets, d, d)
        area = np.linalg.norm(self.inward, axis=1)
        facing = np.einsum("fcd,fd->fc", there, self.inward) > FACING * area[:, None]
        share = np.zeros((len(F), self.d))
        for column, counts in enumerate((facing, np.ones_like(facing))):
            np.add.at(share[:, column], self.corners, area[:, None] / self.d * counts)
        share = self._exchanged(share, add=True)
        A = np.where(share[:, 0] > 0, share[:, 0], share[:, 1])  # an edge that is hit from aside faces nothing
        return self._exchanged(self.phi @ (F / np.where(A > 0, A, 1.0)[:, None]), add=False)

    def _exchanged(self, values: Array, *, add: bool) -> Array:
        """Values (local nodes, d), ghosts from their owners, to which they were added before. Collective."""
        function = dolfinx.fem.Function(self.space.V)
        function.x.array[:] = values.ravel()
        if add:
            function.x.scatter_reverse(dolfinx.la.InsertMode.add)
        function.x.scatter_forward()
        return np.array(function.x.array.reshape(-1, self.d))
