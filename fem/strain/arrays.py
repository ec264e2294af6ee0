"""Tensors in every point as arrays (d, d, Q), the points last: their products and invariants for d = 2 and 3."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SIGNS = np.array([[1.0, -1.0], [-1.0, 1.0]])[:, :, None]


def identity(H: Array) -> Array:
    """F = I + H."""
    F = H.copy()
    for i in range(len(H)):
        F[i, i] += 1.0
    return F


def double_dot(A: Array, B: Array) -> Array:
    """A : B, (Q,)."""
    return np.asarray(np.einsum("ijq,ijq->q", A, B))


def cofactor(A: Array) -> Array:
    """Cof A = det(A) A^-T, (d, d, Q)."""
    if len(A) == 2:
        return np.asarray(SIGNS * A[::-1, ::-1])
    C = np.empty_like(A)
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            np.multiply(A[a, k], A[b, m], out=C[i, j])
            C[i, j] -= A[a, m] * A[b, k]
    return C


def invariants(H: Array) -> tuple[Array, Array]:
    """Tr H and det(I + H) - 1 - tr H, (Q,) each: their sum is J - 1 without cancellation."""
    if len(H) == 2:
        return H[0, 0] + H[1, 1], H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0]
    C = cofactor(H)
    rest = C[0, 0] + C[1, 1] + C[2, 2] + H[0, 0] * C[0, 0] + H[0, 1] * C[0, 1] + H[0, 2] * C[0, 2]
    return H[0, 0] + H[1, 1] + H[2, 2], rest


def volume_change(H: Array) -> Array:
    """J = det(I + H) - 1, (Q,)."""
    trace, rest = invariants(H)
    return trace + rest
