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

# Of shifts that are solved with side by side a later solution loses the digits of its distance, in parts of the larger
# shift, from each one before it: where the product of these distances is less, shifts are solved with in turn.
APART = 0.05


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
class OpenSolution:
    """X = (A + p E)^{-T} R of the open loop, without its displacement part a = (K^{-1} R_z + b) / p."""

    p: complex  # shift [1/s]
    hand: Complex  # a_s and b_s, (2 n_s, k)
    b: Complex  # velocity part b, local rows (n_local, k), C-contiguous

    def moved(self, V: AdjointSolution, coefficients: Complex, small: Array) -> OpenSolution:
        """(A + p E)^{-T} (R + E' Re(V c) s) for the V of another shift q and the same R, without a solve.

        V = Y mix with Y = (A + q E)^{-T} R, and the resolvent identity gives (A + p E)^{-T} E'Y = (Y - X) / (p - q).

        Args:
            coefficients: c.
            small: s, (columns of c, k).
        """
        Y, u = V.open, V.mix @ coefficients / 2
        direct = u @ small / (self.p - Y.p)
        conjugate = u.conj() @ small / (self.p - Y.p.conjugate())
        rest = np.eye(len(direct)) - direct - conjugate

        def combined(X: Complex, other: Complex) -> Complex:
            return np.asarray(X @ rest + other @ direct + other.conj() @ conjugate)

        return OpenSolution(self.p, combined(self.hand, Y.hand), combined(self.b, Y.b))


@dataclass(frozen=True)
class AdjointSolution:
    """V = [a_s; b_s; a; b] = (solutions of the open loop for K' and W) mix, a = (a_0 + b) / p."""

    open: OpenSolution  # of the open loop, for K' and W, k columns
    a: Array  # a_0 = K_ee^{-1} W_z, local rows (n_local, k)
    mix: Complex  # coefficients of the Sherman-Morrison-Woodbury formula, (k, q)

    def real(self, coefficients: Complex) -> Block:
        """Re(V c) for a (q, l) matrix c, without V: one real product each for a and b."""
        n, weight_b = len(self.a), self.mix @ coefficients
        weight_a = weight_b / self.open.p
        pairs = _pairs(self.open.b)
        tall = np.empty((2 * n, weight_b.shape[1]))
        np.matmul(self.a, weight_a.real, out=tall[:n])
        tall[:n] += pairs @ _paired(weight_a)
        np.matmul(pairs, _paired(weight_b), out=tall[n:])
        return Block(np.asarray((self.open.hand @ weight_b).real), tall)


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


def adjoint_rhs(plant: Plant, tissue: ShiftedTissue, block: Block, ahead: Sequence[complex] = ()) -> AdjointRhs:
    """Add a = K_ee^{-1} W_z: one factorisation and solve. Collective.

    ``ahead``: shifts that come next.
    """
    a = tissue.solve(0.0, block.tall[: plant.n_local], ahead)
    return AdjointRhs(block.hand, np.vstack([block.tall, a.real]))


def mass_rhs(plant: Plant, V: Block) -> AdjointRhs:
    """E'V of real columns in costate form; its a is the displacement part of V. Collective."""
    n = plant.n_local
    rows = np.empty((3 * n, V.columns))
    E_V = plant.mass_adjoint(V, rows[: 2 * n])
    rows[2 * n :] = V.tall[:n]
    return AdjointRhs(E_V.hand, rows)


def open_adjoints(plant: Plant, tissue: ShiftedTissue, shifts: Sequence[complex], W: AdjointRhs) -> list[OpenSolution]:
    """Solve (A + p E)'V = W for the first shift p, and for those after it that ranks solve with at the same time.

    Elimination of a_s = W_q / p and the displacement part a = (K^{-1} W_z + b) / p leaves

        S(p) b + p (p - drag) H b_s = p W_v - W_z,
        (p M_s - D_ss) b_s + (p - drag) G'b = W_vs - W_q / p,

    H = G for two-way coupling, else 0: back substitution one-way, the Schur complement of order n_s two-way.
    Collective.
    """
    n = plant.n_local
    shifts = [complex(p) for p in shifts]
    count = min(tissue.group(shifts), far_apart(shifts))
    rights = [np.asarray(p * W.tall[n : 2 * n] - W.tall[:n], dtype=complex) for p in shifts[:count]]
    if plant.two_way:
        rights = [np.hstack([F, plant.G]) for F in rights]
    answers = tissue.solve_each(shifts[:count], rights, shifts[count:])
    return [_with_hand(plant, p, W, np.ascontiguousarray(b)) for p, b in zip(shifts, answers, strict=False)]


def far_apart(shifts: Sequence[complex]) -> int:
    """How many of the first shifts lie so far apart that :meth:`OpenSolution.moved` keeps its digits."""
    for i, q in enumerate(shifts):
        if np.prod([min(1.0, abs(q - p) / max(abs(p), abs(q))) for p in shifts[:i]]) < APART:
            return i
    return len(shifts)


def _with_hand(plant: Plant, p: complex, W: AdjointRhs, b: Complex) -> OpenSolution:
    """The solution of the open loop from b of the tissue alone and, two-way, the responses to G. Collective."""
    s, q = plant.n_s, W.columns
    factor, hand = p - plant.drag_es, W.hand
    small = p * plant.M_s - plant.drag_hand * plant.system.M_rigid
    G_b = _total(plant, plant.G, b)
    right = hand[s:] - hand[:s] / p - factor * G_b[:, :q]
    if plant.two_way:
        weight = p * (p - plant.drag_hand)
        b_s = _solve_small(np.asarray(small - factor * weight * G_b[:, q:], dtype=complex), right)
        b = np.ascontiguousarray(b[:, :q] - b[:, q:] @ (weight * b_s))
    else:
        b_s = _solve_small(np.asarray(small), right)
    return OpenSolution(p, np.vstack([hand[:s] / p, b_s]), b)


def closed_adjoint(plant: Plant, solution: OpenSolution, right: AdjointRhs) -> AdjointSolution:
    """Solve (A - B K + p E)'V = W by the Sherman-Morrison-Woodbury formula.

    [N, L] = (A + pE)^{-T} [K', W],  V = L + N (I - B'N)^{-1} B'L. Collective.

    ``solution``: [N, L]; ``right``: [K', W].
    """
    hand, b = solution.hand, solution.b
    B_V = plant.B.T @ hand[plant.n_s :] if plant.B_z is None else _total(plant, plant.B_z, b)
    m = plant.inputs
    small = _solve_small(np.eye(m, dtype=complex) - B_V[:, :m], B_V[:, m:])
    mix = np.vstack([small, np.eye(right.columns - m)])
    return AdjointSolution(solution, right.tall[2 * plant.n_local :], mix)
