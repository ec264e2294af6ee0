"""Bases for the reduced Riccati equation, from the low-rank factor of P in the paper's coordinates [SBRH21].

P = Z Z' is never formed. With the triangular factor R_c of some rows Z_c = Q_c R_c, the left singular vectors of a
block P_rc = Z_r Z_c' are those of Z_r R_c', a matrix with as many columns as Z.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from softgrasp.fem.petsc import Array, on_root, times_columns, total
from softgrasp.fem.solve.statics import solve_columns
from softgrasp.lqr.dense.modal import ModalPlant, closed_loop_rates, lowest_plant
from softgrasp.lqr.lowrank.compress import gram, triangular
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.operators import costates_to_absolute, costates_to_relative, states_to_relative
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.reduction.bases.engines import EPS, factor, small_svd
from softgrasp.reduction.bases.states import BasisError

A_PRIORI = "structured"  # the basis that needs no P
STRUCTURED_MODES = 60  # candidates; more of them hardly enter an order that runs in a control loop


@dataclass(frozen=True)
class RiccatiBasis:
    """P_hat = V P_N V' with A_N = W' A_rel U, both in hand-relative coordinates.

    For the paper's bases W = L'^{-1} V and U = S V, so that W' A_rel U = V' A V. The structured basis has states from
    U and costates from W; P_hat is then W P_N W' with the same equations of reduced form.
    """

    name: str  # key of BASES
    W: Block  # costate basis, hand (2 n_s, N), local rows (2 n_local, N)
    U: Block  # state basis, hand (2 n_s, N), local rows (2 n_local, N)

    @property
    def N(self) -> int:
        """Order of the reduced Riccati equation."""
        return self.W.columns

    @property
    def modes(self) -> Array:
        """Of an a-priori basis the modes V of the tissue in z = V eta, local rows (n_local, (N - 2 n_s) / 2)."""
        n_s = len(self.U.hand) // 2
        return self.U.parts[3][:, n_s + self.N // 2 :]


@dataclass(frozen=True)
class BasisFamily:
    """Nested bases of one method."""

    name: str  # key of BASES
    smallest: int  # smallest order
    largest: int  # largest order
    step: int  # distance of neighbouring orders
    sigma: tuple[Array, ...]  # singular values behind the truncation, one array per POD
    make: Callable[[int], RiccatiBasis]  # function from the order N to its basis

    def orders(self, sizes: Sequence[int]) -> list[int]:
        """Those of the orders that exist."""
        return [N for N in sizes if self.smallest <= N <= self.largest and (N - self.smallest) % self.step == 0]

    def at(self, N: int) -> RiccatiBasis:
        """The basis of order N. Collective. Raises ControlError: no such order."""
        if not self.orders([N]):
            raise ControlError(
                f"basis {self.name} has no order N = {N}; choose {self.smallest} to {self.largest} "
                f"in steps of {self.step}"
            )
        return self.make(N)


def left_singular(problem: RiccatiProblem, X: Block) -> tuple[Block, Array]:
    """Left singular vectors and values of a tall block, without those that are rounding. Collective."""
    comm = problem.layout.comm
    rows = np.vstack([X.hand, X.tall]) if comm.rank == 0 else X.tall
    f = factor(comm, rows)
    u, s, _ = small_svd(comm, f.R)
    keep = s > f.noise * s[0]
    U = f.Q @ u[:, keep]
    k = len(X.hand)
    hand = np.ascontiguousarray(comm.bcast(U[:k] if comm.rank == 0 else None))
    return Block(hand, U[k:] if comm.rank == 0 else U), s[keep] * f.scale


def _whole(problem: RiccatiProblem, name: str, V: Block, sigma: Array) -> BasisFamily:
    return BasisFamily(name, 1, V.columns, 1, (sigma,), lambda N: _basis(problem, name, V[:N]))


def _basis(problem: RiccatiProblem, name: str, V: Block) -> RiccatiBasis:
    return RiccatiBasis(name, costates_to_relative(problem.system, V), states_to_relative(problem.system, V))


def _tissue(
    problem: RiccatiProblem, name: str, columns: Callable[[int], Array], count: int, step: int, sigma: tuple[Array, ...]
) -> BasisFamily:
    """V = blkdiag(I_{2 n_s}, V_e) with V_e = columns(k), local rows (2 n_local, k)."""
    n_s = problem.layout.n_s

    def make(N: int) -> RiccatiBasis:
        V_e = columns(N - 2 * n_s)
        hand = np.hstack([np.eye(2 * n_s), np.zeros((2 * n_s, V_e.shape[1]))])
        return _basis(problem, name, Block(hand, np.hstack([np.zeros((len(V_e), 2 * n_s)), V_e])))

    return BasisFamily(name, 2 * n_s, 2 * n_s + count, step, sigma, make)


def pod(problem: RiccatiProblem, Z: Block) -> BasisFamily:
    """V = POD_k(P): the left singular vectors of Z, sigma(P) = sigma(Z)^2. Collective."""
    V, s = left_singular(problem, Z)
    return _whole(problem, "pod", V, s**2)


def weighted_pod(problem: RiccatiProblem, Z: Block) -> BasisFamily:
    """V = W^{-1/2} POD_k(W^{1/2} P), W = (E + E')/2, so that V'WV = I. Collective.

    W^{1/2} P has the left singular vectors of W^{1/2} Y, Y = Z R_Z'; with Y = Q R, Q'W Q = LL', L'R = u s v' this gives
    V = Q L^{-T} u: no root of W is needed. Raises ControlError: W is not positive definite.
    """
    check_weight(problem)
    comm = problem.layout.comm
    Q, _ = left_singular(problem, Z)
    weighted = weight_times(problem, Q)
    G = gram(comm, Q, weighted)
    lower = np.linalg.cholesky((G + G.T) / 2)
    R_Z = triangular(comm, Z)
    coordinates = gram(comm, Q, Z) @ R_Z.T
    u, s, _ = small_svd(comm, lower.T @ coordinates)
    keep = s > 100 * EPS * s[0]
    V = Q.times(scipy.linalg.solve_triangular(lower.T, u[:, keep]))
    return _whole(problem, "weighted_pod", V, s[keep])


def pod_fixed_solid(problem: RiccatiProblem, Z: Block) -> BasisFamily:
    """V = blkdiag(I, POD_k([P_es, P_ee])). Collective."""
    R_Z = triangular(problem.layout.comm, Z)
    V, s = left_singular(problem, Block(np.zeros((0, len(R_Z))), Z.tall @ R_Z.T))
    return _tissue(problem, "pod_fixed_solid", lambda k: V.tall[:, :k], V.columns, 1, (s,))


def componentwise_pod(problem: RiccatiProblem, Z: Block) -> BasisFamily:
    """V = blkdiag(I, POD_k1([P_es11, P_ee11, P_ee12]), POD_k2([P_es21, P_ee21, P_ee22])). Collective.

    k1 = k2, or k1 = k2 + 1 when N is odd.
    """
    q_s, _, z, v = Z.parts
    R_c = triangular(problem.layout.comm, Block(q_s, Z.tall))
    none = np.zeros((0, len(R_c)))
    (V_q, s_q), (V_v, s_v) = (left_singular(problem, Block(none, part @ R_c.T)) for part in (z, v))

    def columns(k: int) -> Array:
        return np.asarray(scipy.linalg.block_diag(V_q.tall[:, : (k + 1) // 2], V_v.tall[:, : k // 2]))

    count = 2 * min(V_q.columns, V_v.columns)
    return _tissue(problem, "componentwise_pod", columns, count, 1, (s_q, s_v))


def pod_decomposed(problem: RiccatiProblem, Z: Block) -> BasisFamily:
    """V = blkdiag(I, V_1, V_1), V_1 = POD_k([P_ee11, P_ee12, P_ee21, P_ee22]). Collective."""
    R_e = triangular(problem.layout.comm, Block(Z.hand[:0], Z.tall))
    both = np.hstack([part @ R_e.T for part in np.vsplit(Z.tall, 2)])
    V, s = left_singular(problem, Block(np.zeros((0, both.shape[1])), both))

    def columns(k: int) -> Array:
        V_1 = V.tall[:, : k // 2]
        return np.asarray(scipy.linalg.block_diag(V_1, V_1))

    return _tissue(problem, "pod_decomposed", columns, 2 * V.columns, 2, (s,))


def structured(problem: RiccatiProblem) -> BasisFamily:
    """A priori: z = Phi eta with natural modes in the order |c_k|^2 / (|Re p_k| omega_k^2) in which they cost.

    No Riccati equation is solved. States [q_s, v_s, Phi eta, Phi eta'], costates [q_s, v_s, M Phi omega, Phi]: the
    reduced plant is a second-order system with definite matrices, stable for every N, in energy scaling. Collective.
    """
    plant = lowest_plant(problem, min(STRUCTURED_MODES, problem.layout.n_e))
    rate = np.maximum(closed_loop_rates(problem, plant).rate, np.finfo(float).tiny)
    weight = np.sum(plant.c**2, axis=0) * np.sum(plant.g**2, axis=1) / (rate * plant.omega**2)
    order, n_s = np.argsort(-weight, kind="stable"), problem.layout.n_s

    def make(N: int) -> RiccatiBasis:
        return modal_basis(problem, A_PRIORI, plant, order[: (N - 2 * n_s) // 2])

    return BasisFamily(A_PRIORI, 2 * n_s, 2 * n_s + 2 * len(order), 2, (weight[order],), make)


def modal_basis(problem: RiccatiProblem, name: str, plant: ModalPlant, pick: NDArray[np.int64]) -> RiccatiBasis:
    """States [q_s, v_s, Phi/omega, Phi] and costates [q_s, v_s, M Phi omega, Phi] of some modes."""
    omega, Phi, massed = plant.omega[pick], plant.Phi[:, pick], plant.massed[:, pick]
    n_s, n, k = problem.layout.n_s, problem.layout.n_local, len(omega)
    N = 2 * (n_s + k)
    hand = np.hstack([np.eye(2 * n_s), np.zeros((2 * n_s, 2 * k))])
    U, W = np.zeros((2 * n, N)), np.zeros((2 * n, N))
    q, v = slice(2 * n_s, 2 * n_s + k), slice(2 * n_s + k, N)
    U[:n, q], U[n:, v] = Phi / omega, Phi
    W[:n, q], W[n:, v] = massed * omega, Phi
    return RiccatiBasis(name, Block(hand, W), Block(hand, U))


def energy_scaled(problem: RiccatiProblem, basis: RiccatiBasis) -> RiccatiBasis:
    """The same span with columns orthonormal in the energy of hand and tissue, U'HU = I. Collective.

    V P_N V' depends on the span alone; in this form the reduced equation needs no balancing. The hand's displacement
    has no energy of its own and gets the stiffness (C_s'QC_s)^{1/2} of the feedback.
    """
    system, (q_s, v_s, z, v) = problem.system, basis.U.parts
    spring = np.sqrt(np.linalg.norm(problem.C_s.T @ problem.Q @ problem.C_s, 2)) or 1.0
    H_U = Block.of_parts(spring * q_s, problem.M_s @ v_s, times_columns(system.K_ee, z), times_columns(system.M_ee, v))
    G = gram(system.layout.comm, basis.U, H_U)
    scale = 1 / np.sqrt(np.maximum(np.diag(G), np.finfo(float).tiny))

    def inverse() -> Array | None:
        try:
            lower = np.linalg.cholesky((G + G.T) / 2 * scale[:, None] * scale)
        except np.linalg.LinAlgError:  # dependent to rounding: scaled columns must do
            return None
        return np.asarray(scale[:, None] * scipy.linalg.solve_triangular(lower, np.eye(len(G)), lower=True).T)

    T = on_root(system.layout.comm, inverse)
    T = np.diag(scale) if T is None else T
    return RiccatiBasis(basis.name, basis.W.times(T), basis.U.times(T))


def weight_blocks(problem: RiccatiProblem) -> tuple[Array, Array]:
    """Hand block and coupling column of W = (E + E')/2 in the paper's coordinates, [., v_s] rows."""
    system = problem.system
    if not system.two_way:
        return system.M_hand, system.M_es / 2
    tissue = sum(m.dense * layer.M_1.ss for layer, m in zip(system.layers, system.materials, strict=True))
    return np.asarray(system.M_hand + tissue), system.M_es


def weight_times(problem: RiccatiProblem, X: Block) -> Block:
    """W X for states in the paper's coordinates. Collective."""
    system, (q_s, v_s, q, v) = problem.system, X.parts
    M_ss, coupling = weight_blocks(problem)
    hand = M_ss @ v_s + total(system.layout.comm, coupling.T @ v)
    return Block.of_parts(q_s, hand, q, times_columns(system.M_ee, v) + coupling @ v_s)


def check_weight(problem: RiccatiProblem) -> None:
    """W is positive definite: M_ss - N' M_ee^{-1} N > 0 for its coupling block N. Collective.

    Raises ControlError: it is not; the hand is too light.
    """
    system = problem.system
    M_ss, coupling = weight_blocks(problem)
    schur = M_ss - total(system.layout.comm, coupling.T @ solve_columns(system.M_ee, system.layout, coupling))
    least = float(np.linalg.eigvalsh((schur + schur.T) / 2)[0])
    if not least > 0:
        raise ControlError(
            f"weighted_pod: W = (E + E')/2 is not positive definite, its Schur complement on the hand has the "
            f"eigenvalue {least:.3g}; the coupling M_es outweighs a hand of mass {system.M_hand[0, 0]:.3g}: use pod "
            "or a heavier hand"
        )


BASES: dict[str, Callable[[RiccatiProblem, Block], BasisFamily]] = {
    "pod": pod,
    "weighted_pod": weighted_pod,
    "pod_fixed_solid": pod_fixed_solid,
    "componentwise_pod": componentwise_pod,
    "pod_decomposed": pod_decomposed,
    A_PRIORI: lambda problem, _: structured(problem),
}


def make_family(name: str, problem: RiccatiProblem, Z: Block) -> BasisFamily:
    """The nested bases of a method. Collective.

    Args:
        name: key of :data:`BASES`.
        Z: factor of X in hand-relative coordinates, see :class:`softgrasp.lqr.plant.problem.RiccatiSolution`.

    Raises ControlError: the name is unknown, or the method does not apply.
    """
    if name not in BASES:
        raise ControlError(f"basis '{name}' is unknown; choose one of {', '.join(BASES)}")
    try:
        return BASES[name](problem, costates_to_absolute(problem.system, Z))
    except BasisError as error:
        raise ControlError(f"nothing to build this basis from ({error})") from error
