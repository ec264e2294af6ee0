"""The shifted adjoint equation (A - B K + p E)'V = W of the closed loop, by one tissue solve."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fem.petsc import Array, Complex, total
from lqr.plant import Block, Plant
from lqr.shifted import ShiftedTissue


@dataclass(frozen=True)
class Right:
    """A right-hand side W together with a = K_ee^{-1} of its z-row.

    Attributes:
        block: W with the z-row as it stands.
        a: local rows (n_local, k).
    """

    block: Block
    a: Array

    @property
    def columns(self) -> int:
        """Number of columns."""
        return self.block.columns

    def __getitem__(self, part: slice) -> Right:
        return Right(self.block[part], self.a[:, part])

    def plus(self, E_V: Block, a: Array, small: Array) -> Right:
        """W + E'V small, where a is the displacement part of V. Not collective."""
        block = Block(self.block.hand + E_V.hand @ small, self.block.tall + E_V.tall @ small)
        return Right(block, self.a + a @ small)

    @classmethod
    def join(cls, parts: list[Right]) -> Right:
        """Columns side by side. Not collective."""
        return Right(Block.join([p.block for p in parts]), np.hstack([p.a for p in parts]))


@dataclass(frozen=True)
class Solution:
    """V = [a_s; b_s; a; b], complex."""

    hand: Complex
    tall: Complex

    def parts(self, real: Array, imag: Array) -> Block:
        """Re V @ real + Im V @ imag for (k, l) matrices. Not collective."""
        return Block(
            np.asarray(self.hand.real @ real + self.hand.imag @ imag),
            np.asarray(self.tall.real @ real + self.tall.imag @ imag),
        )


def _part(V: Solution, part: Callable[[Complex], Array]) -> Block:
    return Block(part(V.hand), part(V.tall))


def make_right(plant: Plant, tissue: ShiftedTissue, block: Block) -> Right:
    """Add a = K_ee^{-1} W_z: one factorisation and solve. Collective."""
    a = tissue.solve(0.0, block.tall[: plant.n_local])
    return Right(block, np.ascontiguousarray(a.real))


def open_adjoint(plant: Plant, tissue: ShiftedTissue, p: complex, W: Right, ahead: Sequence[complex] = ()) -> Solution:
    """Solve (A + p E)'V = W.

    Eliminating a_s = W_q / p and the displacement part a = (K^{-1} W_z + b) / p leaves

        S(p) b + p (p - drag) H b_s = p W_v - W_z,
        (p M_s - D_ss) b_s + (p - drag) G'b = W_vs - W_q / p,

    H = G for two-way coupling, else 0: back substitution one-way, the Schur complement of order n_s two-way.
    Collective.
    """
    n, s, q = plant.n_local, plant.n_s, W.columns
    factor = p - plant.drag_es
    tall, hand = W.block.tall, W.block.hand
    F = np.asarray(p * tall[n:] - tall[:n], dtype=complex)
    if plant.two_way:
        F = np.hstack([F, plant.G])
    b = tissue.solve(p, F, ahead)
    g = total(plant.comm, np.vstack([plant.G.T @ b.real, plant.G.T @ b.imag]))
    G_b = g[:s] + 1j * g[s:]
    small = p * plant.M_s - plant.drag_hand * plant.system.M_rigid
    right = hand[s:] - hand[:s] / p - factor * G_b[:, :q]
    if plant.two_way:
        weight = p * (p - plant.drag_hand)
        b_s = np.linalg.solve(small - factor * weight * G_b[:, q:], right)
        b = b[:, :q] - b[:, q:] @ (weight * b_s)
    else:
        b_s = np.linalg.solve(small, right)
    V = np.empty((2 * n, q), dtype=complex)
    V[:n] = (W.a + b) / p
    V[n:] = b
    return Solution(np.vstack([hand[:s] / p, b_s]), V)


def closed_adjoint(
    plant: Plant, tissue: ShiftedTissue, p: complex, W: Right, gain: Right, ahead: Sequence[complex] = ()
) -> Solution:
    """Solve (A - B K + p E)'V = W with K' = ``gain`` by the Sherman-Morrison-Woodbury formula.

    [L, N] = (A + pE)^{-T} [W, K'],  V = L + N (I - B'N)^{-1} B'L. Collective.
    """
    q = W.columns
    both = open_adjoint(plant, tissue, p, Right.join([W, gain]), ahead)
    real, imag = (plant.felt(Block(V.hand, V.tall)) for V in (_part(both, np.real), _part(both, np.imag)))
    B_V = (real + 1j * imag).T
    small = np.linalg.solve(np.eye(plant.inputs) - B_V[:, q:], B_V[:, :q])
    return Solution(both.hand[:, :q] + both.hand[:, q:] @ small, both.tall[:, :q] + both.tall[:, q:] @ small)
