"""The reduced plant on a grid: inputs held over Delta, stabilised by the gain of its own discrete Riccati equation.

With x = [q - q_bar, v, eta, eta'], the exact step x_{k+1} = A_d x_k + B_d u_k, the exact integral of the cost over it
(Van Loan), P and K of the discrete Riccati equation and L L' = (R_d + B_d'P B_d)^{-1},

    u_k = K x_k + L c_k    gives    J = x_0'P x_0 + sum |c_k|^2,

so that a plan is a problem of least distance in c, and |c|^2 is what obstacles and limits cost.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array
from softgrasp.lqr.constrained.tissue import ModalTissue
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.problem import RiccatiProblem

DOUBLINGS = 64  # more than any loop takes that is stable in double precision


@dataclass(frozen=True)
class HeldPlant:
    """Hand and a few modes of the tissue under held inputs."""

    A: Array  # x' = A x + B u, (N, N)
    B: Array  # (N, n_s)
    Y: Array  # displacement of the nodes, from their places at the target, (nodes, d, N)
    grid: float  # length of an interval Delta [s]
    parts: int  # instants of an interval at which the rows of a plan are
    P: Array  # cost x'P x of the gain K without limits, (N, N)
    K: Array  # gain, (n_s, N)
    L: Array  # u = K x + L c, (n_s, n_s)
    tissue: ModalTissue  # of the reduced plant

    @property
    def N(self) -> int:
        """States of the plant."""
        return len(self.A)

    @property
    def n_s(self) -> int:
        """Freedoms of the hand."""
        return int(self.B.shape[1])

    @cached_property
    def held(self) -> tuple[tuple[Array, Array], ...]:
        """A_s and B_s of x(t_k + s) = A_s x_k + B_s u_k at the instants of an interval, the first at s = 0."""
        return tuple(held(self.A, self.B, self.grid * i / self.parts) for i in range(self.parts + 1))

    @cached_property
    def closed(self) -> Array:
        """A_d + B_d K, (N, N)."""
        A_d, B_d = self.held[-1]
        return np.asarray(A_d + B_d @ self.K)


def held(A: Array, B: Array, s: float) -> tuple[Array, Array]:
    """x(s) = A_s x(0) + B_s u of x' = A x + B u with u held."""
    N, m = B.shape
    E = scipy.linalg.expm(np.block([[A, B], [np.zeros((m, N + m))]]) * s)
    return E[:N, :N], E[:N, N:]


def held_plant(problem: RiccatiProblem, tissue: ModalTissue, grid: float, parts: int) -> HeldPlant:
    """Gain and cost of the plant with a reduced tissue. Raises ControlError: none is found on this grid."""
    n_s, k = problem.layout.n_s, len(tissue.omega)
    N = 2 * (n_s + k)
    q, v, z, w = slice(n_s), slice(n_s, 2 * n_s), slice(2 * n_s, 2 * n_s + k), slice(2 * n_s + k, N)
    inertia = np.linalg.inv(problem.M_s)
    A, B, Y = np.zeros((N, N)), np.zeros((N, n_s)), np.zeros((*tissue.seen.shape[:2], N))
    A[q, v], A[z, w], A[w, z], A[w, w] = np.eye(n_s), np.eye(k), -np.diag(tissue.omega**2), -2 * np.diag(tissue.delta)
    B[v], B[w] = inertia, -tissue.g @ inertia
    Y[:, :, q], Y[:, :, z] = np.eye(n_s) if tissue.rigid is None else tissue.rigid, tissue.seen
    C = np.zeros((len(problem.Q), N))
    C[:, q], C[:, z] = problem.C_s, tissue.c
    A_d, B_d = held(A, B, grid)
    with np.errstate(over="ignore", invalid="ignore"):  # refused below
        W = held_cost(A, B, scipy.linalg.block_diag(C.T @ problem.Q @ C, problem.R), grid)
    Q_d, S_d, R_d = W[:N, :N], W[:N, N:], W[N:, N:]
    try:
        P = scipy.linalg.solve_discrete_are(A_d, B_d, Q_d, R_d, s=S_d)
    except ValueError as error:  # not finite, not definite, or LinAlgError: no solution
        raise ControlError(
            f"no gain is found for forces held over {grid:g} s ({error}); lower control.constraints.grid"
        ) from None
    weight = R_d + B_d.T @ P @ B_d
    K = -np.linalg.solve(weight, B_d.T @ P @ A_d + S_d.T)
    P = _sum_of_costs(A_d + B_d @ K, W, K)
    return HeldPlant(A, B, Y, grid, parts, P, K, np.linalg.inv(np.linalg.cholesky(weight)).T, tissue)


def _sum_of_costs(F: Array, W: Array, K: Array) -> Array:
    """P = sum_k F'^k [I; K]'W [I; K] F^k, by doubling.

    A sum of what is positive: fast modes of small cost keep digits that the Riccati solver loses beside the large ones.
    """
    law = np.vstack([np.eye(len(F)), K])
    P = law.T @ W @ law
    for _ in range(DOUBLINGS):
        more = F.T @ P @ F
        P, F = P + more, F @ F
        if np.abs(more).max() <= np.finfo(float).eps * np.abs(P).max():
            break
    return np.asarray((P + P.T) / 2)


def held_cost(A: Array, B: Array, W: Array, s: float) -> Array:
    """W_d with int_0^s [x; u]'W [x; u] dt = [x_0; u]'W_d [x_0; u] for a held input [VL78].

    Of a part of s in which nothing decays by much, then doubled, W_2s = W_s + E_s'W_s E_s: e^{-F's} alone overflows.
    """
    n, m = len(W), B.shape[1]
    F = np.block([[A, B], [np.zeros((m, n))]])
    doublings = max(0, int(np.ceil(np.log2(max(float(np.linalg.norm(F, 1)) * s, 1.0)))))
    both = scipy.linalg.expm(np.block([[-F.T, W], [np.zeros((n, n)), F]]) * (s / 2**doublings))
    E = both[n:, n:]
    result = E.T @ both[:n, n:]
    for _ in range(doublings):
        result, E = result + E.T @ result @ E, E @ E
    return np.asarray((result + result.T) / 2)


@dataclass(frozen=True)
class Horizon:
    """x_k = F_k x_0 + G_k c over H intervals."""

    plant: HeldPlant  # on the grid
    steps: int  # intervals H

    @cached_property
    def states(self) -> tuple[Array, Array]:
        """F, (H + 1, N, N), and G, (H + 1, N, n_s H)."""
        plant, H, n_s = self.plant, self.steps, self.plant.n_s
        F, G = np.zeros((H + 1, plant.N, plant.N)), np.zeros((H + 1, plant.N, n_s * H))
        F[0], drive = np.eye(plant.N), plant.held[-1][1] @ plant.L
        for k in range(H):
            F[k + 1], G[k + 1] = plant.closed @ F[k], plant.closed @ G[k]
            G[k + 1][:, n_s * k : n_s * (k + 1)] += drive
        return F, G

    @cached_property
    def inputs(self) -> tuple[Array, Array]:
        """u_k = U_k x_0 + V_k c: (H, n_s, N) and (H, n_s, n_s H)."""
        F, G = self.states
        n_s = self.plant.n_s
        U, V = self.plant.K @ F[:-1], self.plant.K @ G[:-1]
        for k in range(self.steps):
            V[k][:, n_s * k : n_s * (k + 1)] += self.plant.L
        return U, V

    @cached_property
    def instants(self) -> tuple[Array, Array]:
        """States at the instants of all intervals: (H, parts + 1, N, N) and (H, parts + 1, N, n_s H)."""
        (F, G), (U, V) = self.states, self.inputs
        A = np.stack([a for a, _ in self.plant.held])
        B = np.stack([b for _, b in self.plant.held])
        return (
            np.einsum("sij,kjl->ksil", A, F[:-1], optimize=True) + np.einsum("sij,kjl->ksil", B, U, optimize=True),
            np.einsum("sij,kjl->ksil", A, G[:-1], optimize=True) + np.einsum("sij,kjl->ksil", B, V, optimize=True),
        )

    def input(self, x: Array, c: Array) -> Array:
        """Inputs u_k - u_bar of every interval, (H, n_s)."""
        U, V = self.inputs
        return np.asarray(U @ x + V @ c)

    def state(self, x: Array, c: Array) -> Array:
        """States at the instants of all intervals, (H, parts + 1, N)."""
        F, G = self.instants
        return np.asarray(F @ x + G @ c)
