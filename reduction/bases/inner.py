"""Inner products of hand and tissue, and how stacks of their rows are kept on the ranks.

    name        (q, v) coordinates                        canonical (q, p)
    euclidean   q'q + v'v                                 q'q + p'p
    mass        q' M q + v' M v                           c q' M q + p' M^-1 p / c
    energy      q' K q + v' M v                           c q' K q + p' K^-1 p / c

M = blkdiag(M_hand, M_ee) and K = blkdiag(T' K_ee T, K_ee), the diagonal blocks of the coupled matrices. In canonical
coordinates a basis can be orthonormal and symplectic at once only if the weight of p is the inverse of that of q, hence
K^-1 in place of M^-1. The rate c [1/s or s] makes both halves of the snapshots equally large, whatever the units are.

Euclidean products of q and p compare lengths with momenta, whose nodal entries shrink with the mesh. Errors of
[q_s, p_s, q_e, p_e] (:meth:`softgrasp.reduction.errors.ModelComparison.state_error`), the paper's forward scene, solid
modes fixed, N = 18: 14 vectors beside the hand's four:

    basis                            euclidean    mass     energy
    PSD complex SVD                   8.5e-4     6.2e-5    4.7e-5
    PSD complex SVD, hand-relative    8.4e-4     2.5e-5    3.3e-5
    PSD cotangent lift                9.6e-4     6.4e-5    2.7e-5
    PSD SVD-like                      4.3e-5     4.3e-5    4.3e-5

The last is symplectic, not orthonormal: its pairs hardly depend on the product. Hence canonical bases beyond the
paper's six are built in the energy product unless another is requested.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, PETSc, times_columns, total
from softgrasp.fem.solve.statics import solve_columns
from softgrasp.fem.system import BlockSystem
from softgrasp.reduction.bases.basis import Basis

InnerName = Literal["euclidean", "mass", "energy"]
INNERS: tuple[InnerName, ...] = get_args(InnerName)


@dataclass(frozen=True)
class Weight:
    """Symmetric positive definite weight of one half: hand (n_s, n_s) and tissue (n_e, n_e)."""

    hand: Array  # block of the hand, (n_s, n_s)
    tissue: PETSc.Mat  # block of the tissue, (n_e, n_e)


def weights(system: BlockSystem, inner: InnerName) -> tuple[Weight, Weight] | None:
    """Weights of displacement and velocity in (q, v); None for the Euclidean product. Collective."""
    if inner == "euclidean":
        return None
    mass = Weight(system.M_hand, system.M_ee)
    if inner == "mass":
        return mass, mass
    K_ss = total(system.layout.comm, system.T.T @ times_columns(system.K_ee, system.T))
    return Weight((K_ss + K_ss.T) / 2, system.K_ee), mass


@dataclass(frozen=True)
class Rows:
    """How the row blocks of one half are stacked on a rank: hand rows (rank 0 only), then tissue rows."""

    layout: BlockLayout  # sizes and ownership
    hand: bool  # whether the hand's rows are included

    @property
    def top(self) -> int:
        """Hand rows on this rank."""
        return self.layout.n_s if self.hand and self.layout.comm.rank == 0 else 0

    @property
    def local(self) -> int:
        """Rows on this rank."""
        return self.top + self.layout.n_local

    def stack(self, s: Array, e: Array) -> Array:
        """Rows of hand and tissue as one stack, Fortran order."""
        X = np.empty((self.local, e.shape[1]), order="F")
        X[: self.top], X[self.top :] = s[: self.top], e
        return X

    def split(self, X: Array) -> tuple[Array, Array]:
        """Undo :meth:`stack`; the hand's rows come to every rank, zero when it is not included. Collective."""
        s = np.zeros((self.layout.n_s, X.shape[1]))
        if self.hand:
            s = self.layout.comm.bcast(np.array(X[: self.top]))
        return s, np.asfortranarray(X[self.top :])

    def weigh(self, X: Array, by: Weight | None) -> Array:
        """Return W X; X itself without weight. Collective."""
        if by is None:
            return X
        result = np.empty_like(X, order="F")
        result[self.top :] = times_columns(by.tissue, X[self.top :])
        if self.top:
            result[: self.top] = by.hand @ X[: self.top]
        return result

    def gram(self, X: Array, Y: Array) -> Array:
        """X' Y over all ranks. Collective."""
        return total(self.layout.comm, X.T @ Y)


def orthonormality(basis: Basis, system: BlockSystem) -> float:
    """Largest entry of V' W V - I in the basis's own inner product, from the blocks alone. Collective.

    With fixed solid modes the tissue columns alone count: those of the hand are unit vectors.
    """
    rows, by = Rows(basis.layout, hand=True), weights(system, basis.inner)
    first = 2 * basis.layout.n_s if basis.fixed_solid else 0
    (s_q, s_p), (e_q, e_p) = (
        (X[:, first:] for X in pair) for pair in ((basis.V_sq, basis.V_sv), (basis.V_q, basis.V_p))
    )
    q, p = rows.stack(s_q, e_q), rows.stack(s_p, e_p)
    W_q, W_p = q, p
    if by is not None:
        W_q = basis.rate * rows.weigh(q, by[0])
        if basis.coordinates == "qp":
            inverse = np.linalg.solve(by[0].hand, s_p), solve_columns(by[0].tissue, basis.layout, e_p)
            W_p = rows.stack(*inverse) / basis.rate
        else:
            W_p = rows.weigh(p, by[0 if basis.pairs else 1])
    return float(np.abs(rows.gram(q, W_q) + rows.gram(p, W_p) - np.eye(basis.N - first)).max(initial=0.0))
