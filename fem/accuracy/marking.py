"""Which cells the error of the outputs comes from.

With e_j the differences of static solutions on the finer space and on the mesh, for the loads of the hand's motion (G),
of the lowest modes (M phi_k) and of the outputs (C'), a cell T owes [BR01]

    eta_T = max_t |k_T(e_C, e(t))| + sum_k |C phi_k| |xi_k| omega_k^3 end k_T(e_k, e_k) / 2,

the first for the static response to the momentary load and acceleration, e(t) = e_G c(t) - sum_k e_k xi_k''(t), the
second for the phase that the modes lose until the end.
"""

from __future__ import annotations

import basix
import dolfinx.fem
import numpy as np
import numpy.typing as npt

from softgrasp.fem.accuracy.small import Small, static_solves
from softgrasp.fem.mesh.tissue_mesh import cell_nodes
from softgrasp.fem.model.assembly import layer_numbers
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array, times_columns

MODES = 4  # 4 and 10 modes gave the same estimate to one percent on the paper's scene
INSTANTS = 100
DIGITS = 7  # of the largest eta_T that count: solves carry more, and cells that mirror each other stay together
GAIN = 1.2  # eta_T of the marked cells over what bisection takes away: it splits their neighbours too
LEAST, LARGEST = 0.15, 0.8  # share of the sum of eta_T that the marked cells hold [D96]


def marked_cells(small: Small, finer: Small, factor: float) -> npt.NDArray[np.int32] | None:
    """Cells to split, in the order of the mesh on rank 0; None on other ranks. Collective.

    Args:
        finer: that of elements of the next order on the same cells.
        factor: by which the error should fall, below 1.
    """
    share = float(np.clip((1 - factor) / GAIN, LEAST, LARGEST))
    eta = indicators(small, finer)
    topology = small.model.space.mesh.mesh.topology
    original = np.asarray(topology.original_cell_index)[: len(eta)]
    comm = small.model.system.layout.comm
    parts = comm.gather((original, eta))
    if parts is None:
        return None
    cells, values = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    values = np.round(values / (values.max() or 1.0), DIGITS)  # rounding must not choose, nor the number of ranks
    largest = np.sort(values)[::-1]
    total = np.cumsum(largest)
    least = largest[min(int(np.searchsorted(total, share * total[-1])), len(total) - 1)]
    return np.asarray(np.sort(cells[values >= least]), dtype=np.int32)


def indicators(small: Small, finer: Small) -> Array:
    """eta_T of the owned cells. Collective."""
    model, n_s, p, run = small.model, small.model.system.layout.n_s, len(small.C), small.run
    omega, Q = small.modes
    m = min(MODES, len(omega))
    Phi = small.V @ Q[:, :m]
    coarse = prolong(model, finer.model, np.hstack([small.X, Phi]))
    with static_solves(finer.model) as solve:
        modal = solve(times_columns(finer.model.system.M_ee, coarse[:, n_s + p :]))
    e = np.hstack([finer.X, modal]) - coarse / np.concatenate([np.ones(n_s + p), omega[:m] ** 2])
    at = np.unique(np.linspace(0, len(run.loads) - 1, INSTANTS).round().astype(int))
    accelerations = run.accelerations[at] @ (small.M @ Q[:, :m])  # xi'' = Phi' M z''
    s = np.hstack([run.loads[at], np.zeros((len(at), p)), -accelerations])
    E = cell_products(finer.model, e)
    statics = np.linalg.norm(np.einsum("ckj,tj->ckt", E[:, n_s : n_s + p], s, optimize=True), axis=1).max(axis=1)
    amplitude = np.abs(accelerations).max(axis=0) / omega[:m] ** 2
    reach = np.linalg.norm(small.C @ Q[:, :m], axis=0) * amplitude * omega[:m] ** 3 * model.scene.time_end / 2
    phases = np.einsum("ckk->ck", E[:, n_s + p :, n_s + p :]) @ np.minimum(reach, np.sqrt(reach.max() * reach))
    return np.asarray(statics + phases)


def prolong(model: Model, finer: Model, X: Array) -> Array:
    """Columns of the mesh's space in that of the next order, local rows. Collective."""
    d = model.space.mesh.dimension
    u, v = dolfinx.fem.Function(model.space.V), dolfinx.fem.Function(finer.space.V)
    Y = np.empty((finer.system.layout.n_local, X.shape[1]), order="F")
    for j in range(X.shape[1]):
        u.x.array[:] = 0.0
        u.x.array.reshape(-1, d)[model.space.free] = X[:, j].reshape(-1, d)
        u.x.scatter_forward()
        v.interpolate(u)
        Y[:, j] = v.x.array.reshape(-1, d)[finer.space.free].ravel()
    return Y


def cell_products(model: Model, X: Array) -> Array:
    """Elastic energy products k_T(x_i, x_j) of columns on the owned cells, (cells, k, k). Collective."""
    V, d, tissue = model.space.V, model.space.mesh.dimension, model.space.mesh
    _, layer = layer_numbers(tissue, model.scene)
    lam, mu = np.array([(m.lam, m.mu) for m in model.system.materials])[layer].T
    cells = len(layer)
    element = V.element.basix_element
    shape = basix.CellType.triangle if d == 2 else basix.CellType.tetrahedron
    points, weights = basix.make_quadrature(shape, max(2 * (element.degree - 1), 1))
    D = element.tabulate(1, points)[1 : d + 1, :, :, 0]
    x = tissue.mesh.geometry.x[cell_nodes(tissue.mesh)[:cells], :d]
    J = np.swapaxes(x[:, 1:] - x[:, :1], 1, 2)
    inverse, scale = np.linalg.inv(J), np.abs(np.linalg.det(J))[:, None] * weights * model.scene.tissue.thickness
    u = np.zeros((cells, D.shape[2], d, X.shape[1]))
    f = dolfinx.fem.Function(V)
    for j in range(X.shape[1]):
        f.x.array[:] = 0.0
        f.x.array.reshape(-1, d)[model.space.free] = X[:, j].reshape(-1, d)
        f.x.scatter_forward()
        u[..., j] = f.x.array.reshape(-1, d)[V.dofmap.list[:cells]]
    E = np.zeros((cells, X.shape[1], X.shape[1]))
    for q in range(len(weights)):  # one point at a time: gradients of all at once would be large
        gradient = np.einsum("an,cab,cnik->cibk", D[:, q], inverse, u, optimize=True)
        strain = (gradient + np.swapaxes(gradient, 1, 2)) / 2
        flat = strain.reshape(cells, d * d, -1)
        trace = np.einsum("ciik->ck", strain)
        E += (scale[:, q] * 2 * mu)[:, None, None] * (np.swapaxes(flat, 1, 2) @ flat)
        E += (scale[:, q] * lam)[:, None, None] * trace[:, :, None] * trace[:, None, :]
    return E
