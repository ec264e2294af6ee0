"""How steep a displacement is: linear elasticity neglects terms of the size of its gradient."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.effects.sag import SMALL_SHARE, Gradient
from softgrasp.fem.fields.series import FullField
from softgrasp.fem.mesh.tissue_mesh import cell_nodes
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array, total

SMALL_STRAIN = 0.1  # linear elasticity neglects terms of this relative size


def gradient(model: Model, z: Array) -> Gradient:
    """Gradient of a displacement against the hand. Collective.

    Args:
        model: the model.
        z: displacement against the hand, local rows (n_local,) [m].
    """
    space, d = model.space, model.space.mesh.dimension
    mesh, comm = space.mesh.mesh, space.layout.comm
    cells = mesh.topology.index_map(d).size_local
    nodal = FullField(model).fill(z, np.zeros(space.layout.n_s)).x.array.reshape(-1, d)
    u = nodal[space.V.dofmap.list[:cells, : d + 1]]  # the first d + 1 dofs of a cell sit on its vertices
    x = mesh.geometry.x[cell_nodes(mesh)[:cells], :d]
    edges = x[:, 1:] - x[:, :1]
    size = np.linalg.norm(np.linalg.solve(edges, u[:, 1:] - u[:, :1]), axis=(1, 2))
    volume = np.abs(np.linalg.det(edges))
    large, whole = total(comm, np.array([volume[size > SMALL_STRAIN].sum(), volume.sum()]))
    # cells of equal volume may make the share exactly; rounding must not decide
    limit = SMALL_SHARE * whole * (1 + 1e-9)
    steepest = _top(np.column_stack([size, volume]), limit)
    merged = _top(np.concatenate(comm.allgather(steepest)), limit)
    return Gradient(float(merged[0, 0]), float(merged[-1, 0]), float(large / whole))


def _top(rows: Array, limit: float) -> Array:
    """The steepest rows [size, volume], down to the one with which their volume exceeds the limit. Not collective."""
    ordered = rows[np.argsort(-rows[:, 0], kind="stable")]
    return ordered[: int(np.searchsorted(np.cumsum(ordered[:, 1]), limit, side="right")) + 1]
