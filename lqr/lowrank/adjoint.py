"""The shifted adjoint equation (A - B K + p E)'V = W of the closed loop, by one tissue solve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, Complex, total
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.lowrank.shifted import ShiftedTissue
from softgrasp.lqr.plant.block import Block


class AdjointRhs(Block):
    """Right-hand side W; ``tall`` has the rows z, v_z and those of a = K_ee^{-1} W_z, (3 n_local, k)."""

    @property
    def block(self) -> Block:
        """W alone (views)."""
        return Block(self.hand, self.tall[: 2 * len(self.tall) // 3])

    @property
    def parts(self) -> tuple[Array, Array, Array, Array]:
        """Rows q_s, v_s, z and v_z of W (views)."""
        return self.block.parts

    def plus(self, E_V: AdjointRhs, small: Array) -> AdjointRhs:
        """W + E'V small."""
        return AdjointRhs(self.hand + E_V.hand @ small, self.tall + E_V.tall @ small)


@dataclass(frozen=True)
class AdjointSolution:
    """V = [a_s; b_s; a; b] = (solutions of the open loop for K' and W) mix, a = (a_0 + b) / p."""

    p: complex  # shift [1/s]
    hand: Complex  # a_s and b_s of the open loop, (2 n_s, k)
    b: Complex  # velocity part b of the open loop, local rows (n_local, k), C-contiguous
    a: Array  # a_0 = K_ee^{-1} W_z, local rows (n_local, k)
    mix: Complex  # coefficients of the Sherman-Morrison-Woodbury formula, (k, q)

    def real(self, coefficients: Complex) -> Block:
        """Re(V c) for a (q, l) matrix c, without V: one real product each for a and b."""
        n, weight_b = len(self.b), self.mix @ coefficients
        weight_a = weight_b / self.p
        pairs = _pairs(self.b)
        tall = np.empty((2 * n, weight_b.shape[1]))
        np.matmul(self.a, weight_a.real, out=tall[:n])
        tall[:n] += pairs @ _paired(weight_a)
        np.matmul(pairs, _paired(weight_b), out=tall[n:])
        return Block(np.asarray((self.hand @ weight_b).real), tall)


def _pairs(b: Complex) -> Array:
    """Real and imaginary parts of each column side by side (a view), (n, 2 k)."""
    return b.view(np.float64).reshape(len(b), 2 * b.shape[1])


def _paired(weight: Complex) -> Array:
    """Matrix w with pairs(b) w = Re(b weight), (2 k, l)."""
    result = np.empty((2 * len(weight), weight.shape[1]))
    result[0::2], result[1::2] = weight.real, -weight.imag
    return result


def _total(plant: Plant, X: Array, b: Complex) -> Complex:
    """X'b summed over the ranks, (columns of X, k). Collective."""
    parts = total(plant.comm, X.T @ _pairs(b))
    return np.asarray(parts[:, 0::2] + 1j * parts[:, 1::2])


def _solve_small(A: Complex, B: Complex) -> Complex:
    """A^{-1} B by LAPACK itself, because the checks around it need longer than matrices of this order."""
    if A.size == 0:
        return np.zeros(B.shape, dtype=complex)
    _, _, X, info = scipy.linalg.lapack.zgesv(A, B)
    if info:
        raise SolverError(f"a matrix of order {len(A)} of the feedback or the hand is singular at a shift")
    return np.asarray(X)


def adjoint_rhs(plant: Plant, tissue: ShiftedTissue, block: Block) -> AdjointRhs:
    """Add a = K_ee^{-1} W_z: one factorisation and solve. Collective."""
    a = tissue.solve(0.0, block.tall[: plant.n_local])
    return AdjointRhs(block.hand, np.vstack([block.tall, a.real]))


def mass_rhs(plant: Plant, V: Block) -> AdjointRhs:
    """E'V of real columns in costate form; its a is the displacement part of V. Collective."""
    n = plant.n_local
    rows = np.empty((3 * n, V.columns))
    E_V = plant.mass_adjoint(V, rows[: 2 * n])
    rows[2 * n :] = V.tall[:n]
    return AdjointRhs(E_V.hand, rows)


def open_adjoint(
    plant: Plant, tissue: ShiftedTissue, p: complex, W: AdjointRhs, ahead: Sequence[complex] = ()
) -> tuple[Complex, Complex]:
    """Solve (A + p E)'V = W; returns a_s and b_s (2 n_s, k), and b (n_local, k).

    Elimination of a_s = W_q / p and the displacement part a = (K^{-1} W_z + b) / p leaves

        S(p) b + p (p - drag) H b_s = p W_v - W_z,
        (p M_s - D_ss) b_s + (p - drag) G'b = W_vs - W_q / p,

    H = G for two-way coupling, else 0: back substitution one-way, the Schur complement of order n_s two-way.
    Collective.
    """
    n, s, q = plant.n_local, plant.n_s, W.columns
    p = complex(p)
    factor, hand = p - plant.drag_es, W.hand
    F = np.asarray(p * W.tall[n : 2 * n] - W.tall[:n], dtype=complex)
    if plant.two_way:
        F = np.hstack([F, plant.G])
    b = np.ascontiguousarray(tissue.solve(p, F, ahead))
    small = p * plant.M_s - plant.drag_hand * plant.system.M_rigid
    G_b = _total(plant, plant.G, b)
    right = hand[s:] - hand[:s] / p - factor * G_b[:, :q]
    if plant.two_way:
        weight = p * (p - plant.drag_hand)
        b_s = _solve_small(np.asarray(small - factor * weight * G_b[:, q:], dtype=complex), right)
        b = np.ascontiguousarray(b[:, :q] - b[:, q:] @ (weight * b_s))
    else:
        b_s = _solve_small(np.asarray(small), right)
    return np.vstack([hand[:s] / p, b_s]), b


def closed_adjoint(
    plant: Plant, tissue: ShiftedTissue, p: complex, right: AdjointRhs, ahead: Sequence[complex] = ()
) -> AdjointSolution:
    """Solve (A - B K + p E)'V = W by the Sherman-Morrison-Woodbury formula.

    [N, L] = (A + pE)^{-T} [K', W],  V = L + N (I - B'N)^{-1} B'L. Collective.

    ``right``: [K', W]; ``ahead``: shifts that will probably come next.
    """
    hand, b = open_adjoint(plant, tissue, p, right, ahead)
    B_V = plant.B.T @ hand[plant.n_s :] if plant.B_z is None else _total(plant, plant.B_z, b)
    m = plant.inputs
    small = _solve_small(np.eye(m, dtype=complex) - B_V[:, :m], B_V[:, m:])
    mix = np.vstack([small, np.eye(right.columns - m)])
    return AdjointSolution(complex(p), hand, b, right.tall[2 * plant.n_local :], mix)
