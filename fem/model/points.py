"""The quadrature points of a discretised scene, for effects.finite_strain only."""

from __future__ import annotations

import basix
import dolfinx.fem
import numpy as np

from softgrasp.fem.mesh.tissue_mesh import cell_nodes
from softgrasp.fem.model.assembly import Discretisation, layer_numbers
from softgrasp.fem.scene.scene import FiniteStrain, Scene
from softgrasp.fem.strain.points import Ints, Points, make_gradient


def make_points(space: Discretisation, scene: Scene, effect: FiniteStrain) -> Points:
    """Points of the owned cells; K(0) = K_ee to rounding. Collective."""
    d, V, order = space.mesh.dimension, space.V, scene.tissue.order
    mesh = space.mesh.mesh
    cells = mesh.topology.index_map(d).size_local
    shape = basix.CellType.triangle if d == 2 else basix.CellType.tetrahedron
    element = basix.create_element(basix.ElementFamily.P, shape, order, basix.LagrangeVariant.gll_warped)
    # exact for K(0), all weights positive
    at, weights = basix.make_quadrature(shape, 1 if order == 1 else 2 * order)
    table = element.tabulate(1, at)[1:, :, :, 0]  # (d, points, nodes)
    x = mesh.geometry.x[cell_nodes(mesh)[:cells], :d]
    edges = x[:, 1:] - x[:, :1]  # rows are the columns of dX/dxi
    gradients = np.einsum("kqa,cjk->cqaj", table, np.linalg.inv(edges))
    volume = np.abs(np.linalg.det(edges)) * scene.tissue.thickness
    vol = (volume[:, None] * weights).ravel()
    layer = layer_numbers(space.mesh, scene)[1]
    first = mesh.topology.index_map(d).local_range[0]
    layout, each = space.layout, len(weights)
    B = make_gradient(layout.comm, gradients, _free_nodes(space)[V.dofmap.list[:cells]], (layout.n_local, layout.n_e))
    cell = np.repeat(np.arange(first, first + cells), each)
    places = (x[:, None, 0] + at @ edges).reshape(-1, d)
    return Points(B, vol, np.repeat(layer, each), cell, places, d, effect.law, effect.tol)


def _free_nodes(space: Discretisation) -> Ints:
    """Number among all free nodes of each local node, ghosts included; -1 where it follows the hand. Collective."""
    d, layout = space.layout.dimension, space.layout
    numbers = dolfinx.fem.Function(space.V)
    at = numbers.x.array.reshape(-1, d)
    at[:] = -1.0
    at[space.free] = layout.start // d + np.arange(len(space.free))[:, None]
    numbers.x.scatter_forward()
    return np.asarray(np.rint(numbers.x.array.reshape(-1, d)[:, 0]), dtype=np.intp)
