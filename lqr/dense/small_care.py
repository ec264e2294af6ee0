"""The reduced Riccati equation in well below a millisecond: one Schur form, one residual, no diagnosis on the way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array
from softgrasp.lqr.dense.care import balanced_hamiltonian, care, lyapunov, smallest_singular_value
from softgrasp.lqr.plant.checks import EPS, ControlError

FAST_RESIDUAL = 1e-9  # relative to C'QC; the structured plant in energy scaling reaches 1e-13
FAST_BACKWARD = 1e-12  # relative to all four terms, where P is so large that C'QC drowns in their rounding
# Distance of a Hamiltonian matrix to a singular one, over its norm, that is the rounding of a projection: the paper's
# bases with too few columns show 1e-20 to 8e-14, all others 4e-10 or more.
UNSEEN = 1e4 * EPS


@dataclass(frozen=True)
class ReducedMatrices:
    """E_N, A_N (N, N), B_N (N, m), C_N (p, N), Q (p, p), R (m, m)."""

    E: Array
    A: Array
    B: Array
    C: Array
    Q: Array
    R: Array

    @property
    def N(self) -> int:
        """Order."""
        return len(self.A)


def solve_reduced(matrices: ReducedMatrices) -> Array:
    """P_N of E'PA + A'PE - E'PB R^{-1} B'PE + C'QC = 0, (N, N).

    The Hamiltonian matrix, scaled by one number so that its off-diagonal blocks have like size, is brought to ordered
    real Schur form. When the residual shows that this is not good enough, :func:`softgrasp.lqr.dense.care.care`
    balances, polishes and explains. Raises ControlError: there is no stabilising solution.
    """
    P = fast_solution(matrices)
    if P is not None:
        return P
    m = matrices
    return care(m.A, m.B, m.C, m.Q, m.R, m.E).X


def fast_solution(m: ReducedMatrices) -> Array | None:
    """P_N without balancing, or None when it is not accurate or not stabilising.

    Raises ControlError: see :func:`check_seen`.
    """
    n = m.N
    lu, pivots, info = scipy.linalg.lapack.dgetrf(m.E)
    if info:
        return None
    solved, _ = scipy.linalg.lapack.dgetrs(lu, pivots, np.hstack([m.A, m.B]))
    A, B = solved[:, :n], solved[:, n:]
    G = B @ np.linalg.solve(m.R, B.T)
    H = m.C.T @ m.Q @ m.C
    g, h = np.linalg.norm(G), np.linalg.norm(H)
    if not (g > 0 and h > 0 and np.isfinite(g) and np.isfinite(h)):
        return None
    c = np.sqrt(h / g)
    hamiltonian = np.empty((2 * n, 2 * n), order="F")
    hamiltonian[:n, :n], hamiltonian[:n, n:] = A, -c * G
    hamiltonian[n:, :n], hamiltonian[n:, n:] = H / -c, -A.T
    _, stable, real, imag, U, _, info = scipy.linalg.lapack.dgees(
        lambda x, _: x < 0, hamiltonian, sort_t=1, overwrite_a=1
    )
    if info or stable != n or not real[:n].max() < -1e-10 * np.abs(real).max():
        return None
    if real[:n].max() > -(EPS**0.25) * np.hypot(real, imag).max():
        check_seen(A, G, H, float(imag[np.argmax(real[:n])]))
    lu_1, pivots_1, info = scipy.linalg.lapack.dgetrf(U[:n, :n].T)
    if info:
        return None
    Y = c * scipy.linalg.lapack.dgetrs(lu_1, pivots_1, U[n:, :n].T)[0].T
    Y = (Y + Y.T) / 2
    R, parts = _residual(A, G, H, Y)
    if not np.linalg.norm(R) <= FAST_RESIDUAL * h:  # P is large: one Newton step
        T, W = scipy.linalg.schur(A - G @ Y, output="real", check_finite=False)
        Y = Y + lyapunov(T, W, R)
        R, parts = _residual(A, G, H, Y)
        if not np.linalg.norm(R) <= FAST_BACKWARD * parts:
            return None
    half, _ = scipy.linalg.lapack.dgetrs(lu, pivots, Y, trans=1)
    P, _ = scipy.linalg.lapack.dgetrs(lu, pivots, half.T, trans=1)
    return np.asarray((P + P.T) / 2)


def check_seen(A: Array, G: Array, H: Array, omega: float) -> None:
    """The Hamiltonian matrix is farther from one with the eigenvalue i omega than a projection rounds.

    A rigid motion that inputs do not reach or outputs do not see makes a quadruple eigenvalue 0, which rounding moves
    by eps^(1/4): a solution exists then, but another one on another number of ranks. Raises ControlError: it is not.
    """
    hamiltonian, _, _ = balanced_hamiltonian(A, G, H)
    if smallest_singular_value(hamiltonian, 1j * omega) <= UNSEEN * float(np.linalg.norm(hamiltonian)):
        raise ControlError(
            f"the reduced equation of order {len(A)} has a solution by rounding alone: a mode that does not decay by "
            "itself is not reached by the inputs or not seen by the outputs; take another order N"
        )


def _residual(A: Array, G: Array, H: Array, Y: Array) -> tuple[Array, float]:
    """A'Y + YA - YGY + H and the sum of the norms of its terms."""
    product, square = A.T @ Y, Y @ G @ Y
    size = 2 * np.linalg.norm(product) + np.linalg.norm(square) + np.linalg.norm(H)
    return product + product.T - square + H, float(size)
