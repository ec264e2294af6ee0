"""Points of the free boundary beside its nodes, each with the values of the shape functions there.

A displacement at point j is sum_i phi_i(x_j) z_i, and a force there is one of phi_i(x_j) times it on each node i. In 3D
the integral of a vertex function of quadratic elements over a facet is zero, so that forces x >= 0 on nodes alone are
not those of any pressure; forces on points within the facets are. And what is smaller than an edge passes between its
nodes, but not between points that are close enough.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import dolfinx.mesh
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from softgrasp.fem.model.assembly import Discretisation, free_nodes
from softgrasp.fem.petsc import Array, rows_on_all

Parts = Callable[[Array], NDArray[np.intp]]
"""Parts (k,) [1] in which the edges of facets are divided, by the longest edge of each facet (k,) [m]."""
NONE = 1e-12  # value of a shape function that is rounding [1]
SAME = 1e9  # points that differ by less than 1 / SAME of the body are one [1]


def lattice(d: int, parts: int) -> Array:
    """Barycentric coordinates of the points that divide the edges of a facet in d dimensions into parts, (m, d) [1]."""
    grid = np.array([i for i in product(range(parts + 1), repeat=d) if sum(i) == parts])
    return np.asarray(grid / parts)


def facet_points(space: Discretisation, nodes: NDArray[np.intp], parts: Parts) -> tuple[Array, Any]:
    """Places at rest (m, d) [m] of further points of the boundary, and values of the shape functions there. Collective.

    Args:
        space: of the tissue.
        nodes: numbers of the free boundary nodes among all free ones, ascending, (p,).
        parts: of the edges of a facet.

    Returns: places, and values (m, p) of the free nodes' shape functions, sparse. Points that are nodes, that follow
    the hand or that a facet before them has are left out; the order depends on the ranks.
    """
    d, mesh, element = space.mesh.dimension, space.V.mesh, space.V.element.basix_element
    for a, b in ((d - 1, d), (d, d - 1)):
        mesh.topology.create_connectivity(a, b)
    facets = dolfinx.mesh.exterior_facet_indices(mesh.topology)
    inside, around = mesh.topology.connectivity(d - 1, d), mesh.topology.connectivity(d, d - 1)
    cells = inside.array[inside.offsets[facets]]
    number = (around.array.reshape(-1, d + 1)[cells] == facets[:, None]).argmax(axis=1)
    divided = parts(mesh.h(d - 1, facets)) if len(facets) else np.zeros(0, dtype=np.intp)
    numbers, x = free_nodes(space), space.V.tabulate_dof_coordinates()[:, :d]
    corners, closures = np.vstack([np.zeros(d), np.eye(d)]), element.entity_closure_dofs[d - 1]
    size = len(closures[0])
    found = [np.zeros((0, 2 * size + d))]
    for face, k in sorted(set(zip(number.tolist(), divided.tolist(), strict=True))):
        mine = np.flatnonzero((number == face) & (divided == k))
        at = lattice(d, k) @ np.delete(corners, face, axis=0)
        phi = element.tabulate(0, at)[0, :, closures[face], 0].T  # (points, nodes of the facet)
        dofs = space.V.dofmap.list[cells[mine]][:, closures[face]]
        places = np.einsum("qa,fad->fqd", phi, x[dofs])
        shape = (len(mine), len(at), size)
        parts_of = np.broadcast_to(phi, shape), np.broadcast_to(numbers[dofs][:, None], shape), places
        found.append(np.concatenate(parts_of, axis=2).reshape(-1, 2 * size + d))
    every = rows_on_all(space.layout.comm, np.concatenate(found))
    phi, places = every[:, :size].copy(), every[:, 2 * size :]
    node = np.rint(every[:, size : 2 * size]).astype(np.intp)
    phi[(np.abs(phi) < NONE) | (node < 0)] = 0.0
    several = (np.abs(every[:, :size]) > NONE).sum(axis=1) > 1
    keep = np.flatnonzero(several & (phi != 0).any(axis=1))
    phi, node, places = phi[keep], np.where(phi[keep] != 0, np.searchsorted(nodes, node[keep]), 0), places[keep]
    # the two sides of a slit have the same places and other nodes
    mark = np.random.default_rng(0).random(len(nodes) + 1)
    key = np.column_stack([places / space.layout.extent, (phi * mark[node]).sum(axis=1)])
    _, first = np.unique(np.rint(SAME * key), axis=0, return_index=True)
    first.sort()
    B = scipy.sparse.csr_matrix(
        (phi[first].ravel(), node[first].ravel(), size * np.arange(len(first) + 1)), shape=(len(first), len(nodes))
    )
    B.sum_duplicates()
    B.eliminate_zeros()
    return np.ascontiguousarray(places[first]), B
