"""A reduced plant on a few shapes of the tissue, with the maps of states and gains to it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from softgrasp.fem.columns import labels
from softgrasp.fem.petsc import Array, PETSc, normalising, on_root, times_columns, total
from softgrasp.fem.reduced import ReducedSystem
from softgrasp.lqr.dense.modal import TissueMatrices, assemble_space
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.gain import Gain, PlantState
from softgrasp.lqr.plant.operators import damp
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.plant.target import steady_input


@dataclass(frozen=True)
class Shapes:
    """Reduced displacement z ~ V eta of k columns, and the filter eta = W' z."""

    V: Array  # displacement basis, local rows (n_local, k)
    W: Array  # filter M_ee V (V' M_ee V)^{-1} with W'V = I, local rows (n_local, k)

    def reduce(self, problem: RiccatiProblem, x: PlantState) -> Array:
        """[q_s, v_s, W'z, W'v_z], (2 n_s + 2 k,), on every rank. Collective."""
        tissue = total(problem.layout.comm, np.stack([self.W.T @ x.z, self.W.T @ x.v_z]))
        return np.concatenate([x.q_s, x.v_s, tissue.ravel()])

    def reduce_gain(self, problem: RiccatiProblem, gain: Gain) -> Array:
        """K V = [K_s, K_z'V, K_v'V]: the full gain on states of the form V eta, (n_s, N). Collective."""
        tissue = total(problem.layout.comm, np.stack([gain.K_z.T @ self.V, gain.K_v.T @ self.V]))
        return np.hstack([gain.K_s, tissue[0], tissue[1]])


def galerkin(problem: RiccatiProblem, V: Array) -> tuple[ReducedSystem, Shapes]:
    """Galerkin on x = [q_s, v_s, V eta, V eta']: the hand stays whole, the tissue stays of second order.

    V'M V, V'D V and V'K V keep their definiteness, so the reduced plant is as stable as the full one, for every V.
    Collective. ``V``: shapes of z, local rows (n_local, k), linearly independent; k = 0 leaves the hand alone.

    Raises ControlError: the columns of V are linearly dependent.
    """
    system, comm = problem.system, problem.layout.comm
    M_V, K_V = times_columns(system.M_ee, V), times_columns(system.K_ee, V)
    D_V = damp(system, V)
    k, n_s = V.shape[1], problem.layout.n_s
    small = total(comm, np.stack([V.T @ M_V, V.T @ K_V, V.T @ D_V]))
    M, K, D = (small + small.transpose(0, 2, 1)) / 2
    G, C_z = total(comm, V.T @ system.G), total(comm, V.T @ problem.C_z)
    size = np.diag(M)
    values = np.linalg.eigvalsh(M / np.sqrt(np.outer(size, size))) if (size > 0).all() else np.zeros(1)
    if not values.min(initial=1.0) > 1e-12:  # rounding of the products is about 1e-15 k
        raise ControlError(f"the {k} shapes of the tissue are linearly dependent; orthonormalise them first")
    space = assemble_space(problem, TissueMatrices(M, K, D, G, C_z))
    f = np.zeros(len(space.E))
    if (load := system.static_load) is not None:
        f[2 * n_s + k :] = total(comm, V.T @ load)
    f[n_s : 2 * n_s] = -steady_input(system)
    S = np.eye(2 * n_s, len(f))
    plant = ReducedSystem(space.E, space.A, space.B, space.C, f, S[:n_s], S[n_s:], labels(problem.columns))
    return plant, Shapes(V, np.linalg.solve(M, M_V.T).T)


def m_orthonormal(M: PETSc.Mat, V: Array, tolerance: float = 1e-10) -> Array:
    """Columns that span V with V' M V = I; directions below ``tolerance`` of the largest are dropped. Collective."""
    comm = M.comm.tompi4py()
    for _ in range(2):  # the second pass repairs what rounding left after the first
        V = V @ on_root(comm, partial(normalising, total(comm, V.T @ times_columns(M, V)), tolerance**2))
    return np.asfortranarray(V)
