"""A small dense plant: the projection of the full one on a few shapes of the tissue, or any reduced model."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from softgrasp.fem.columns import labels
from softgrasp.fem.petsc import Array, PETSc, on_root, times_columns, total
from softgrasp.lqr.dense.modal import assemble_space
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.gain import Gain, PlantState
from softgrasp.lqr.plant.operators import damp, normalising
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.plant.target import steady_input
from softgrasp.reduction.lti import LTI, make_lti


@dataclass(frozen=True)
class SmallPlant:
    """E x' = A x + B u + f, y = C x, q_s = S_q x, v_s = S_v x, of dimension N."""

    # E, A: (N, N)
    E: Array
    A: Array
    B: Array  # (N, n_s)
    C: Array  # (p, N)
    f: Array  # constant load, gravity (N,)
    # S_q, S_v: (n_s, N)
    S_q: Array
    S_v: Array
    names: tuple[str, ...] = ()  # one per output

    @property
    def N(self) -> int:
        """Dimension."""
        return len(self.E)

    @property
    def hand_first(self) -> bool:
        """Whether the state begins with q_s and v_s."""
        n_s, one = len(self.S_q), np.eye(self.N)
        return np.array_equal(self.S_q, one[:n_s]) and np.array_equal(self.S_v, one[n_s : 2 * n_s])

    def lti(self) -> LTI:
        """The system for other packages, and for frequency responses; ``lti().under(K)`` is the closed loop."""
        return make_lti(self.E, self.A, self.B, self.C, self.names, self.hand_first)

    def rest_at(self, q_bar: Array) -> tuple[Array, Array]:
        """x_bar (N,) and u_bar (n_s,) with 0 = A x + B u + f and S_q x = q_bar.

        Raises ControlError: the plant has no such state, or more than one.
        """
        n_s = len(self.S_q)
        K = np.block([[self.A, self.B], [self.S_q, np.zeros((n_s, n_s))]])
        scale = np.abs(K).max(axis=1)
        right = np.concatenate([-self.f, np.asarray(q_bar, dtype=np.float64)])
        if (scale == 0).any() or not np.linalg.cond(K / scale[:, None]) < 1e14:  # rounding: no digit would be right
            raise ControlError("the reduced plant has no unique state of rest for a position of the hand")
        solution = np.linalg.solve(K / scale[:, None], right / scale)
        return solution[: self.N], solution[self.N :]


@dataclass(frozen=True)
class Shapes:
    """z ~ V eta with V of a few columns, and the filter eta = W' z that takes z to them."""

    V: Array  # local rows (n_local, k)
    W: Array  # M_ee V (V' M_ee V)^{-1}, local rows (n_local, k), so that W'V = I

    def reduce(self, problem: RiccatiProblem, x: PlantState) -> Array:
        """[q_s, v_s, W'z, W'v_z], (2 n_s + 2 k,), on every rank. Collective."""
        tissue = total(problem.layout.comm, np.stack([self.W.T @ x.z, self.W.T @ x.v_z]))
        return np.concatenate([x.q_s, x.v_s, tissue.ravel()])

    def expand(self, problem: RiccatiProblem, x: Array) -> PlantState:
        """The full state of a reduced one."""
        n_s, k = problem.layout.n_s, self.V.shape[1]
        q, v, eta, rate = np.split(np.asarray(x), [n_s, 2 * n_s, 2 * n_s + k])
        return PlantState(q, v, self.V @ eta, self.V @ rate)

    def reduce_gain(self, problem: RiccatiProblem, gain: Gain) -> Array:
        """K V = [K_s, K_z'V, K_v'V]: the full gain on states of the form V eta, (n_s, N). Collective."""
        tissue = total(problem.layout.comm, np.stack([gain.K_z.T @ self.V, gain.K_v.T @ self.V]))
        return np.hstack([gain.K_s, tissue[0], tissue[1]])

    def expand_gain(self, problem: RiccatiProblem, K: Array) -> Gain:
        """The gain on the full state that is u = K [q_s, v_s, W'z, W'v_z]."""
        n_s, k = problem.layout.n_s, self.V.shape[1]
        return Gain(K[:, : 2 * n_s], self.W @ K[:, 2 * n_s : 2 * n_s + k].T, self.W @ K[:, 2 * n_s + k :].T)


def galerkin(problem: RiccatiProblem, V: Array) -> tuple[SmallPlant, Shapes]:
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
    space = assemble_space(problem, M, K, D, G, C_z)
    f = np.zeros(len(space.E))
    if system.gravity is not None:
        f[2 * n_s + k :] = G @ system.gravity
    f[n_s : 2 * n_s] = -steady_input(system)
    S = np.eye(2 * n_s, len(f))
    plant = SmallPlant(space.E, space.A, space.B, space.C, f, S[:n_s], S[n_s:], labels(problem.columns))
    return plant, Shapes(V, np.linalg.solve(M, M_V.T).T)


def m_orthonormal(M: PETSc.Mat, V: Array, tolerance: float = 1e-10) -> Array:
    """Columns that span V with V' M V = I; directions below ``tolerance`` of the largest are dropped. Collective."""
    comm = M.comm.tompi4py()
    for _ in range(2):  # the second pass repairs what rounding left after the first
        V = V @ on_root(comm, partial(normalising, total(comm, V.T @ times_columns(M, V)), tolerance**2))
    return np.asfortranarray(V)
