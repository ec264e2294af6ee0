"""The free boundary of the tissue: the nodes and points that obstacles can touch, the same on every rank."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import dolfinx.mesh
import numpy as np
import scipy.sparse
from mpi4py import MPI
from numpy.typing import NDArray

from softgrasp.fem.errors import SceneError
from softgrasp.fem.mesh.tissue_mesh import cell_nodes
from softgrasp.fem.model.assembly import Discretisation
from softgrasp.fem.model.contact import rigid_modes
from softgrasp.fem.model.points import Parts, facet_points
from softgrasp.fem.petsc import Array, rows_on_all, total
from softgrasp.fem.system import BlockSystem

if TYPE_CHECKING:
    from softgrasp.fem.obstacles import Obstacle


@dataclass(frozen=True)
class Surface:
    """Nodes of the boundary that do not follow the hand, in the order of their numbers, and points after them."""

    comm: MPI.Intracomm  # ranks of the tissue
    X: Array  # coordinates of the points at rest, the m nodes first, (p, d) [m]
    T: Array  # rigid modes of the hand there, (p d, n_s) [1, m]
    dofs: NDArray[np.intp]  # numbers of the nodes' unknowns among all tissue unknowns, (m d,)
    mine: NDArray[np.intp]  # places here of the unknowns that this rank owns
    rows: NDArray[np.intp]  # rows of those among the owned ones
    B: Any = None  # values of the nodes' shape functions at all points (p, m), sparse; None: nodes alone

    def places(self, q: Array, z: Array | float = 0.0) -> Array:
        """Coordinates of the points with the hand at q (n_s,) and displacements z (p d,) of the tissue, (p, d) [m]."""
        return self.X + (z + self.T @ q).reshape(self.X.shape)

    def gather(self, x: Array) -> Array:
        """Values at the points (p d,) of a vector given by its owned rows. Collective."""
        if self.comm.size == 1:
            return self.at_points(x[self.rows])
        part = np.zeros(len(self.dofs))
        part[self.mine] = x[self.rows]
        return self.at_points(total(self.comm, part))

    def at_points(self, x: Array) -> Array:
        """Values at the points (p d,) of values (m d,) at the nodes."""
        return x if self.B is None else np.asarray(self.B @ x.reshape(self.B.shape[1], -1)).ravel()

    def on_nodes(self, f: Array) -> Array:
        """Forces (m d,) on the nodes of forces (p d,) on the points."""
        return f if self.B is None else np.asarray(self.B.T @ f.reshape(self.B.shape[0], -1)).ravel()

    def weights(self, points: NDArray[np.intp]) -> tuple[NDArray[np.intp], Array]:
        """Nodes (k,) on which forces on points (n,) act, and the share of each point in them, (n, k)."""
        assert self.B is not None
        rows = self.B[points]
        nodes = np.unique(rows.indices)
        return nodes, rows[:, nodes].toarray()


def node_distance(space: Discretisation) -> float:
    """Largest distance of neighbouring nodes on a boundary edge [m], that of straight cells. Collective."""
    mesh = space.V.mesh
    mesh.topology.create_connectivity(space.mesh.dimension - 1, space.mesh.dimension)
    facets = dolfinx.mesh.exterior_facet_indices(mesh.topology)
    longest = mesh.comm.allreduce(mesh.h(space.mesh.dimension - 1, facets).max(initial=0.0), MPI.MAX)
    return float(longest / space.V.element.basix_element.degree)


def make_surface(space: Discretisation, system: BlockSystem, parts: Parts | None = None) -> Surface:
    """The free boundary of a model: its nodes, and with ``parts`` points that divide edges of facets. Collective."""
    layout = system.layout
    nodes = np.flatnonzero(space.surface()[0])
    rows = (nodes[:, None] * layout.dimension + np.arange(layout.dimension)).ravel()
    dofs = rows_on_all(layout.comm, layout.start + rows)
    first = sum(layout.comm.allgather(len(rows))[: layout.comm.rank])
    mine = np.arange(first, first + len(rows))
    X, T, B = rows_on_all(layout.comm, layout.nodes[nodes]), rows_on_all(layout.comm, system.T[rows]), None
    if parts is not None:
        d = layout.dimension
        places, B = facet_points(space, dofs[::d] // d, parts)
        modes = rigid_modes(places, d, T.shape[1] > d, layout.reference)
        B = scipy.sparse.vstack([scipy.sparse.eye_array(len(X)), B], format="csr") if len(places) else None
        X, T = np.vstack([X, places]), np.vstack([T, modes])
    return Surface(layout.comm, X, T, dofs, mine, rows, B)


def contains(space: Discretisation, points: Array) -> NDArray[np.bool_]:
    """Whether a cell of the body at rest contains each of a few points (k, d) [m], on every rank. Collective."""
    d, mesh = space.mesh.dimension, space.V.mesh
    corners = mesh.geometry.x[cell_nodes(mesh), :d]
    low, high = corners.min(axis=1), corners.max(axis=1)
    found = np.zeros(len(points), dtype=bool)
    for i, point in enumerate(points):
        near = corners[((low <= point) & (point <= high)).all(axis=1)]
        edges = (near[:, 1:] - near[:, :1]).transpose(0, 2, 1)
        shares = np.linalg.solve(edges, (point - near[:, 0])[:, :, None])[:, :, 0]
        found[i] = ((shares >= 0).all(axis=1) & (shares.sum(axis=1) <= 1)).any()
    space.layout.comm.Allreduce(MPI.IN_PLACE, found, MPI.LOR)
    return found


def refuse_within(space: Discretisation, obstacles: Sequence[Obstacle], boundary: Array, shift: Array | float) -> None:
    """Refuse an obstacle that the boundary goes round at the start, which nothing can touch. Collective.

    Args:
        space: of the undeformed body.
        boundary: places of its nodes at the start, (p, d) [m].
        shift: way of the hand until then, (d,) [m].

    Raises SceneError: there is one.
    """
    middles = [(o, x + o.shift(0.0)) for o in obstacles if (x := o.shape.middle()) is not None]
    if not middles:
        return
    within = contains(space, np.array([x for _, x in middles]) - shift)
    for (o, _), inside in zip(middles, within, strict=True):
        if inside and o.gap(boundary).min() > 0:
            raise SceneError(
                f"obstacle '{o.name}' has its middle within the tissue at the start, and no point of the boundary in "
                "it; move it"
            )
