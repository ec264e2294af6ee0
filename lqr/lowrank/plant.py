"""The plant in the form the low-rank solvers use: weights folded in, products and shifted solves with E' and A'."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.linalg

from softgrasp.fem.errors import SolverError, agree
from softgrasp.fem.petsc import Array, Complex, on_root, times_columns, total
from softgrasp.lqr.lowrank.shifted import ShiftedTissue
from softgrasp.lqr.plant.checks import ControlError, check_finite, check_weights, square_root
from softgrasp.lqr.plant.gain import Block
from softgrasp.lqr.plant.problem import RiccatiProblem


class Plant:
    """E x' = A x + B u, y = C x with B <- B R^{-1/2}, C <- Q^{1/2} C, in hand-relative coordinates.

    Costates are kept as [a_s, b_s, a, b] with the displacement part scaled by the stiffness, z-row = K_ee a: in this
    form the energy [K_ee, M_ee] is their natural inner product. The adjoint operators are

        E'X = [a_s; M_s b_s + G'b; K a; M b + H b_s],
        A'X = [0; a_s - D_ss b_s - D_es'b; -K b; K a - D b - D_se'b_s],

    with H = G, D_ss = alpha M_rigid, D_se = alpha G' for two-way coupling (alpha only when damping acts in space).
    Without a hand its rows are empty and the inputs act on the tissue, B = [0; B_z].

    Raises:
        ControlError: R is not positive definite, Q has a negative eigenvalue or sees nothing, or a number is not
            finite.
    """

    def __init__(self, problem: RiccatiProblem) -> None:
        system = problem.system
        self.problem, self.system, self.layout, self.comm = problem, system, system.layout, system.layout.comm
        self.n_s, self.n_local = self.layout.n_s, self.layout.n_local
        with agree(self.comm):
            check_weights(problem.Q, problem.R, problem.C_s.shape[0], problem.inputs)
            check_finite(C_s=problem.C_s, C_z=problem.C_z, G=system.G, M_hand=system.M_hand, B_z=problem.B_z)
            check_finite(K_ee=system.K_ee, M_ee=system.M_ee)
        weight = np.linalg.inv(np.linalg.cholesky(problem.R)).T
        self.B = weight if problem.B_z is None else np.zeros((0, len(weight)))
        self.B_z = None if problem.B_z is None else problem.B_z @ weight
        F = square_root(problem.Q)
        self.C_s, self.C_z = F @ problem.C_s, problem.C_z @ F.T
        self.M_s, self.G = problem.M_s, system.G
        self.two_way = system.two_way
        drag = system.damping.alpha if system.damping.in_space else 0.0
        self.drag_es = drag
        self.drag_hand = drag if self.two_way else 0.0
        self.mass, self.stiff = (partial(times_columns, A) for A in (system.M_ee, system.K_ee))
        viscous = system.damping.matrix
        self.viscous = None if viscous is None else partial(times_columns, viscous)
        seen = self.C_s @ self.C_s.T + total(self.comm, self.C_z.T @ self.C_z)
        # the same bits on every rank: the solvers stop by residuals over it
        self.scale = float(on_root(self.comm, partial(np.linalg.norm, seen, 2)))
        if self.scale == 0:
            raise ControlError("the outputs weighted with Q are all zero; give an output and a Q that is not zero")

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return int(self.B.shape[1])

    def inputs_of(self, V: Block) -> Array:
        """V'B, (k, m), on every rank. Collective without a hand."""
        if self.B_z is None:
            return np.asarray(V.hand[self.n_s :].T @ self.B)
        return total(self.comm, V.tall[self.n_local :].T @ self.B_z)

    def outputs(self) -> Block:
        """C' as a block (z-row unscaled)."""
        hand = np.vstack([self.C_s.T, np.zeros_like(self.C_s.T)])
        return Block(hand, np.vstack([self.C_z, np.zeros_like(self.C_z)]))

    def mass_adjoint(self, V: Block, out: Array | None = None) -> Block:
        """E'V of a costate block; the z-row of the result is unscaled. Collective.

        ``out``: room for the tissue rows of the result.
        """
        n, (a_s, b_s, a, b) = self.n_local, V.parts
        tall = np.empty(V.tall.shape) if out is None else out
        tall[:n] = self.stiff(a)
        tall[n:] = self.mass(b)
        if self.two_way:
            tall[n:] += self.G @ b_s
        return Block(np.vstack([a_s, self.M_s @ b_s + total(self.comm, self.G.T @ b)]), tall)


class Right(Block):
    """A right-hand side W; below its rows z, as they stand, and v_z those of a = K_ee^{-1} W_z, (3 n_local, k)."""

    @property
    def block(self) -> Block:
        """W alone (views)."""
        return Block(self.hand, self.tall[: 2 * len(self.tall) // 3])

    def plus(self, E_V: Right, small: Array) -> Right:
        """W + E'V small."""
        return Right(self.hand + E_V.hand @ small, self.tall + E_V.tall @ small)


@dataclass(frozen=True)
class Solution:
    """V = [a_s; b_s; a; b] = (solutions of the open loop for K' and W) mix, a = (a_0 + b) / p."""

    p: complex
    hand: Complex  # open loop, a_s and b_s, (2 n_s, k)
    b: Complex  # open loop, local rows (n_local, k), rows side by side in memory
    a: Array  # a_0 = K_ee^{-1} of the z-rows, local rows (n_local, k)
    mix: Complex  # (k, q), of the Sherman-Morrison-Woodbury formula

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
    """A^{-1} B by LAPACK itself, because the checks around it take longer than matrices of this order."""
    if A.size == 0:
        return np.zeros(B.shape, dtype=complex)
    _, _, X, info = scipy.linalg.lapack.zgesv(A, B)
    if info:
        raise SolverError(f"a matrix of order {len(A)} of the feedback or the hand is singular at a shift")
    return np.asarray(X)


def make_right(plant: Plant, tissue: ShiftedTissue, block: Block) -> Right:
    """Add a = K_ee^{-1} W_z: one factorisation and solve. Collective."""
    a = tissue.solve(0.0, block.tall[: plant.n_local])
    return Right(block.hand, np.vstack([block.tall, a.real]))


def mass_right(plant: Plant, V: Block) -> Right:
    """E'V of real columns in costate form; its a is the displacement part of V. Collective."""
    n = plant.n_local
    rows = np.empty((3 * n, V.columns))
    E_V = plant.mass_adjoint(V, rows[: 2 * n])
    rows[2 * n :] = V.tall[:n]
    return Right(E_V.hand, rows)


def open_adjoint(
    plant: Plant, tissue: ShiftedTissue, p: complex, W: Right, ahead: Sequence[complex] = ()
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
    plant: Plant, tissue: ShiftedTissue, p: complex, right: Right, ahead: Sequence[complex] = ()
) -> Solution:
    """Solve (A - B K + p E)'V = W by the Sherman-Morrison-Woodbury formula.

    [N, L] = (A + pE)^{-T} [K', W],  V = L + N (I - B'N)^{-1} B'L. Collective.

    ``right``: [K', W]; ``ahead``: shifts that will probably come next.
    """
    hand, b = open_adjoint(plant, tissue, p, right, ahead)
    B_V = plant.B.T @ hand[plant.n_s :] if plant.B_z is None else _total(plant, plant.B_z, b)
    m = plant.inputs
    small = _solve_small(np.eye(m, dtype=complex) - B_V[:, :m], B_V[:, m:])
    mix = np.vstack([small, np.eye(right.columns - m)])
    return Solution(complex(p), hand, b, right.tall[2 * plant.n_local :], mix)
