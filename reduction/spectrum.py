"""Eigenvalues of a small model, with the free hand's exact zeros set apart, and coordinates that balance it.

The hand is free, so that s^2 divides the characteristic polynomial n_s times. Rounding splits such a double zero by the
square root of eps, which would drown every test of stability; here the zeros are removed by structure instead:
the hand's own columns where the basis keeps them, else a staircase of exact null spaces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array

# Of the largest |eigenvalue|: rounding of a non-normal problem of this size stays below; a mode that grows more
# slowly than this gains less than 1e-5 over 1e4 of the model's fastest radians.
GROWTH_TOLERANCE = 1e-9
NULL_TOLERANCE = 1e-12  # of the largest singular value: exact null vectors come out at a few N eps
SKEW_TOLERANCE = 1e-8  # a conservative block is skew in energy coordinates; the Cholesky factor's condition enters


@dataclass(frozen=True)
class Spectrum:
    """Eigenvalues that decide on stability."""

    eigenvalues: np.ndarray  # eigenvalues of E x' = A x without the zeros of the free hand [1/s]
    abscissa: float  # largest real part [1/s]; exactly 0 for a conservative block
    zeros: int  # number of eigenvalues set apart
    tolerance: float  # growth rate [1/s] up to which the model counts as stable

    @property
    def stable(self) -> bool:
        """Whether no eigenvalue lies to the right of the imaginary axis beyond the tolerance."""
        return self.abscissa <= self.tolerance


def energy_factor(Q: Array) -> Array | None:
    """Lower L with L L' = Q, or None when Q is not definite to rounding."""
    if not len(Q):
        return Q.copy()
    scale = np.sqrt(np.abs(np.diag(Q)))
    if not (scale > 0).all() or not np.isfinite(scale).all():
        return None
    try:
        L = np.linalg.cholesky(Q / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return None
    # below this pivot the balanced coordinates would be all rounding
    return None if np.diag(L).min() < 1e-7 else scale[:, None] * L


def balanced(E: Array, A: Array, L: Array | None) -> Array:
    """E^-1 A in the coordinates w = L' x, where the energy is |w|^2 / 2; E^-1 A itself without L."""
    if L is None:
        return np.linalg.solve(E, A)
    # w' = L' E^-1 A L^-T w
    return np.asarray(L.T @ np.linalg.solve(E, scipy.linalg.solve_triangular(L, A.T, lower=True).T))


def skew_modes(S: Array) -> tuple[Array, Array]:
    """Orthonormal U and omega >= 0 with U' S U = blocks [0, -omega; omega, 0], then zeros, for a skew S.

    Returns U, (n, n); omega, (m,) with 2 m <= n, descending.
    """
    n = len(S)
    omega, vectors = np.linalg.eigh(1j * S)
    largest = float(np.abs(omega).max(initial=0.0))
    keep = np.flatnonzero(omega > NULL_TOLERANCE * largest)[::-1]
    U = np.empty((n, 2 * len(keep)))
    # i S z = omega z with z = (a + i b) / sqrt 2 gives S a = omega b, S b = -omega a
    U[:, 0::2] = np.sqrt(2) * vectors[:, keep].real
    U[:, 1::2] = np.sqrt(2) * vectors[:, keep].imag
    Q, R = np.linalg.qr(U, mode="complete")
    signs = np.where(np.diag(R) < 0, -1.0, 1.0)
    # QR of nearly orthonormal columns only removes rounding; the rest of Q spans the null space
    Q[:, : len(signs)] *= signs
    return Q, omega[keep]


def spectrum(E: Array, A: Array, Q: Array, conservative: bool) -> Spectrum:
    """Eigenvalues of a block E x' = A x with the energy x' Q x / 2.

    Where the structure proves that nothing grows, a positive real part can only be rounding and is not reported.

    Args:
        E, A: (n, n), E nonsingular.
        Q: (n, n), positive semidefinite; used to balance, and to see that a conservative block is one.
        conservative: the block is meant to conserve x' Q x, so that its eigenvalues are imaginary by structure.

    Raises:
        LinAlgError: E is singular.
    """
    n, bounded = len(A), passive(E, A)
    if conservative and bounded:
        # E skew, A = R^2: the eigenvalues of E^-1 A are those of the skew matrix R E^-1 R
        squares, vectors = np.linalg.eigh(A)
        R = (vectors * np.sqrt(np.maximum(squares, 0.0))) @ vectors.T
        S = R @ np.linalg.solve(E, R)
        return _imaginary(S, n)
    L = energy_factor(Q)
    if L is None:
        F, Q = quotient(np.linalg.solve(E, A), Q)
        E, A, L = np.eye(len(F)), F, energy_factor(Q)
    S = balanced(E, A, L)
    if conservative and L is not None and is_skew(S):
        return _imaginary(S, n)
    values = np.linalg.eigvals(S)
    largest = float(np.abs(values).max(initial=0.0))
    abscissa = float(values.real.max(initial=-np.inf))
    if bounded and abscissa > 0:
        abscissa = 0.0
    return Spectrum(values, abscissa, n - len(values), GROWTH_TOLERANCE * largest)


def _imaginary(S: Array, n: int) -> Spectrum:
    """Spectrum of a matrix that is skew up to rounding, without its zeros."""
    omega = np.linalg.eigvalsh(0.5j * (S - S.T))
    largest = float(np.abs(omega).max(initial=0.0))
    omega = omega[np.abs(omega) > NULL_TOLERANCE * largest]
    return Spectrum(1j * omega, 0.0, n - len(omega), GROWTH_TOLERANCE * largest)


def passive(E: Array, A: Array) -> bool:
    """Whether A is symmetric and >= 0 and E + E' <= 0: then x' A x / 2 never grows along E x' = A x."""
    scale = np.sqrt(np.abs(np.diag(A)))
    if not len(A) or not (scale > 0).all():
        scale = np.ones(len(A))
    A, E = A / np.outer(scale, scale), E / np.outer(scale, scale)
    eps = len(A) * np.finfo(float).eps
    if np.abs(A - A.T).max(initial=0.0) > eps * np.abs(A).max(initial=0.0):
        return False
    values = np.linalg.eigvalsh(A)
    growth = np.linalg.eigvalsh((E + E.T) / 2)
    return bool(
        values.min(initial=0.0) >= -eps * values.max(initial=0.0)
        and growth.max(initial=0.0) <= eps * np.abs(E).max(initial=0.0)
    )


def is_skew(S: Array) -> bool:
    """Whether a matrix in energy coordinates conserves the energy, up to the condition of the Cholesky factor."""
    return bool(np.abs(S + S.T).max(initial=0.0) <= SKEW_TOLERANCE * np.abs(S).max(initial=0.0))


def quotient(F: Array, Q: Array) -> tuple[Array, Array]:
    """F and Q without the exact zeros of F: pass to the quotient by the null space until there is none."""
    scale = np.abs(F).max(initial=0.0)
    while len(F):
        _, s, V_t = np.linalg.svd(F)
        keep = s > NULL_TOLERANCE * scale
        if keep.all():
            break
        X = V_t[keep].T
        F, Q = X.T @ F @ X, X.T @ Q @ X
    return F, (Q + Q.T) / 2
