"""Measures of a displacement: its gradient, its lowest frequency, and how much it magnifies rounding."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.effects.sag import SMALL_SHARE, Gradient
from softgrasp.fem.fields.series import FullField
from softgrasp.fem.mesh.tissue_mesh import cell_nodes
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array, times_columns, total
from softgrasp.fem.system import BlockSystem

SMALL_STRAIN = 0.1  # linear elasticity neglects terms of this relative size
EPS = float(np.finfo(float).eps)
SEEN = 1e-8  # share of the largest squared amplitude that a motion needs to count: far above rounding


def gradient(model: Model, z: Array) -> Gradient:
    """Gradient of a displacement against the hand. Collective.

    Args:
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
    parts = np.array([volume[size > SMALL_STRAIN].sum(), volume.sum(), volume @ size**2])
    large, whole, square = total(comm, parts)
    # cells of equal volume may make the share exactly; rounding must not decide
    limit = SMALL_SHARE * whole * (1 + 1e-9)
    steepest = _top(np.column_stack([size, volume]), limit)
    merged = _top(np.concatenate(comm.allgather(steepest)), limit)
    return Gradient(float(merged[0, 0]), float(merged[-1, 0]), float(large / whole), float(np.sqrt(square / whole)))


def _top(rows: Array, limit: float) -> Array:
    """The steepest rows [size, volume], down to the one with which their volume exceeds the limit."""
    ordered = rows[np.argsort(-rows[:, 0], kind="stable")]
    return ordered[: int(np.searchsorted(np.cumsum(ordered[:, 1]), limit, side="right")) + 1]


def magnified(system: BlockSystem, z: Array) -> float:
    """Share by which one rounding of K_ee may change the deformation z: eps sum K_ii z_i^2 / z'Kz [1]. Collective.

    Neither residual nor drift knows of it, since both take the rounded matrix for the true one; close to nu = 1/2 they
    are ten to a hundred times smaller than the error.

    Args:
        z: local rows of a displacement against the hand, (n_local,).
    """
    diagonal = system.K_ee.getDiagonal()
    parts = np.array([np.dot(diagonal.array_r, z * z), np.dot(z, times_columns(system.K_ee, z[:, None])[:, 0])])
    diagonal.destroy()
    largest, energy = total(system.layout.comm, parts)
    if largest == 0:
        return 0.0
    return float(EPS * largest / energy) if energy > 0 else np.inf


def slowest(system: BlockSystem, Z: Array) -> float:
    """Lowest frequency [1/s] of the clamped tissue in the span of Z - mean(Z), 0 when nothing moves. Collective.

    A Ritz value, omega^2 = min_z z'K z / z'M z: at least the lowest frequency, near it if the run excites its mode.

    Args:
        Z: displacements against the hand, local rows (n_local, k) [m].
    """
    comm, centre = system.layout.comm, np.eye(Z.shape[1]) - 1 / Z.shape[1]
    M, K = (total(comm, Z.T @ times_columns(A, Z)) for A in (system.M_ee, system.K_ee))
    squares, Q = np.linalg.eigh(centre @ (M + M.T) @ centre / 2)
    kept = squares > SEEN * np.trace(M)
    if not kept.any():
        return 0.0
    Q = centre @ (Q[:, kept] / np.sqrt(squares[kept]))
    return float(np.sqrt(max(np.linalg.eigvalsh(Q.T @ (K + K.T) @ Q / 2)[0], 0.0)))
