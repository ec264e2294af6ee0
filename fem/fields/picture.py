"""Small copies of mesh and displacement on rank 0, for pictures: plain arrays, nothing of DOLFINx."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import dolfinx.mesh
import numpy as np
import numpy.typing as npt

from softgrasp.fem.mesh.tissue_mesh import cell_nodes
from softgrasp.fem.model.build import Model
from softgrasp.fem.model.contact import contact_facets, rigid_modes
from softgrasp.fem.petsc import Array, rows_on_root

if TYPE_CHECKING:
    from softgrasp.fem.obstacles import Obstacle

Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class PictureMesh:
    """The mesh of the whole body in arrays, on rank 0."""

    points: Array  # vertices [m], shape (n, d)
    cells: Integers  # vertices of the cells, shape (m, d + 1)
    facets: Integers  # vertices of the boundary facets, shape (k, d), the body to their left or below
    contact: Integers  # vertices of the facets in the contact zone, shape (c, d)
    layers: Integers  # number of the layer of each cell, shape (m,)
    names: tuple[str, ...]  # name of each layer
    reference: Array  # point the hand turns about [m], shape (d,)
    n_s: int  # number of degrees of freedom of the hand [1]
    obstacles: tuple[Obstacle, ...] = ()  # what the tissue may touch
    turning: bool = False  # whether the hand turns by any angle, by rotation vectors

    @property
    def dimension(self) -> int:
        """Space dimension d."""
        return int(self.points.shape[1])

    def rigid(self, q_s: npt.ArrayLike, points: Array | None = None) -> Array:
        """Displacement R q_s of points that move with the hand, shape (n, d) [m]; the vertices by default."""
        x = self.points if points is None else points
        modes = rigid_modes(x, self.dimension, self.n_s > self.dimension, self.reference)
        linear = np.asarray(modes @ np.asarray(q_s, dtype=np.float64)).reshape(len(x), self.dimension)
        if not self.turning:
            return linear
        from softgrasp.fem.frame.rotation import Pose  # only such scenes pay for it

        return Pose.of(np.asarray(q_s, dtype=np.float64), self.dimension).rigid(linear)

    def path(self, table: Array, point: Array) -> Array:
        """Places of a point that moves with the hand, (steps, d) [m], for its motion (steps, n_s) [m, rad]."""
        if self.turning:
            return np.array([point + self.rigid(q, point[None, :])[0] for q in table])
        return np.asarray(point + table @ np.vstack([self.rigid(unit, point[None, :]) for unit in np.eye(self.n_s)]))


def gather_picture(model: Model) -> PictureMesh | None:
    """Copy the mesh to rank 0; None on the other ranks. Collective."""
    tissue, layout = model.space.mesh, model.space.layout
    mesh, d, comm = tissue.mesh, tissue.dimension, layout.comm
    nodes = mesh.geometry.index_map()
    mesh.topology.create_connectivity(d - 1, d)

    def facet_nodes(facets: npt.NDArray[np.int32]) -> Integers:
        return _numbered(nodes, _outward(mesh, d, facets))

    outer = dolfinx.mesh.exterior_facet_indices(mesh.topology)
    held = contact_facets(tissue, model.scene.contact)
    points = np.ascontiguousarray(mesh.geometry.x[: nodes.size_local, :d])
    parts = [
        points,
        _numbered(nodes, cell_nodes(mesh)[: tissue.owned]),
        facet_nodes(outer),
        facet_nodes(held),
        model.space.layer,
    ]
    whole = [rows for rows in (rows_on_root(comm, part) for part in parts) if rows is not None]
    if not whole:
        return None
    points, cells, facets, contact, layers = whole
    obstacles: tuple[Obstacle, ...] = ()
    if model.scene.effects.obstacles:
        from softgrasp.fem.obstacles import make_obstacles  # only such scenes pay for it

        obstacles = make_obstacles(model.scene, layout.dimension)
    return PictureMesh(
        points, cells, facets, contact, layers, model.space.layers, layout.reference, layout.n_s, obstacles,
        model.system.frame is not None,
    )  # fmt: skip


def vertex_displacement(model: Model, z: Array, q_s: Array) -> Array | None:
    """Absolute displacement of the vertices on rank 0, ordered as ``PictureMesh.points``; None elsewhere.

    Collective.

    Args:
        z: relative displacement on the owned free dofs [m], shape (n_local,), or (n_local, k) for k instants.
        q_s: hand [m, rad], shape (n_s,) or (n_s, k).

    Returns:
        Shape (n, d), or (k, n, d) for k instants.
    """
    columns = z[:, None] if z.ndim == 1 else z  # a rank may own no row
    hands = np.asarray(q_s, dtype=np.float64).reshape(len(q_s), -1)
    d = model.space.layout.dimension
    fields = [model.displacement(columns[:, j], hands[:, j]).x.array.reshape(-1, d) for j in range(columns.shape[1])]
    rows = vertex_values(model, np.hstack(fields))
    if rows is None or z.ndim == 1:
        return rows
    return np.ascontiguousarray(rows.reshape(len(rows), -1, d).transpose(1, 0, 2))


def vertex_values(model: Model, values: Array) -> Array | None:
    """Rows of the vertices from those of the local nodes (m, k) of the elements, on rank 0, (n, k); None elsewhere.

    Collective.
    """
    space = model.space
    geometry, dofmap = space.mesh.mesh.geometry, space.V.dofmap
    # The first d + 1 dofs of a Lagrange cell sit on its vertices, in the order of the geometry; a vertex may belong
    # to another rank as dof than as mesh node, so ghosts count too.
    node_dof = np.zeros(len(geometry.x), dtype=np.int64)
    node_dof[cell_nodes(space.mesh.mesh)] = dofmap.list[:, : space.mesh.dimension + 1]
    return rows_on_root(space.layout.comm, values[node_dof[: geometry.index_map().size_local]])


def _outward(mesh: Any, d: int, facets: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Local mesh nodes of exterior facets, ordered so that (b - a) turned right, or (b - a) x (c - a), points out."""
    if len(facets) == 0:
        return np.zeros((0, d), dtype=np.int32)
    nodes = dolfinx.mesh.entities_to_geometry(mesh, d - 1, facets).reshape(len(facets), d)
    cells = mesh.topology.connectivity(d - 1, d)
    inside = cell_nodes(mesh)[cells.array[cells.offsets[facets]]]
    opposite = inside.sum(axis=1) - nodes.sum(axis=1)
    x = mesh.geometry.x[:, :d]
    edges = x[nodes[:, 1:]] - x[opposite][:, None, :]
    volume = np.linalg.det(np.concatenate([(x[nodes[:, 0]] - x[opposite])[:, None, :], edges], axis=1))
    flipped = volume < 0
    nodes[flipped] = nodes[flipped][:, ::-1]
    return np.asarray(nodes)


def _numbered(index_map: Any, local: npt.NDArray[np.int32]) -> Integers:
    """Global node numbers of local ones, same shape."""
    flat = np.ascontiguousarray(local, dtype=np.int32).ravel()
    return np.asarray(index_map.local_to_global(flat), dtype=np.int64).reshape(local.shape)
