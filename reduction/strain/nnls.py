"""Sparse non-negative least squares: few weights x >= 0 with |G x - b| <= tau |b|.

Lawson and Hanson's active set method [LH74] with the early stop of energy-conserving sampling [FCA15]: SciPy's has
none, and would go on to weights for hundreds of columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.petsc import Array, rows_on_root
from softgrasp.reduction.bases.basis import ReductionError

LEAST_TAU = 1e-6  # normal equations lose half of the digits, so that a smaller residual may be rounding


@dataclass(frozen=True)
class Weights:
    """Answer of :func:`nnls`."""

    x: Array  # weights >= 0, most of them zero, (n,)
    residual: float  # |G x - b| / |b|
    rounds: int  # columns that were added one after the other


def nnls(G: Array, b: Array, tau: float) -> Weights:
    """Columns added by largest gradient G'(b - G x) until |G x - b| <= tau |b|, x >= 0 throughout. Serial.

    Each round solves the normal equations of the columns in use by Cholesky; what turns negative leaves again.
    ``G``: (m, n); ``b``: (m,); ``tau``: relative residual to reach, at least 1e-6 [1].

    Raises:
        ReductionError: tau is too small, or no non-negative weights reach it.
    """
    if not LEAST_TAU <= tau < 1:
        raise ReductionError(f"tau = {tau:g} must lie between {LEAST_TAU:g} and 1")
    size = float(np.linalg.norm(b))
    x, used, banned = np.zeros(G.shape[1]), np.zeros(0, dtype=int), np.zeros(0, dtype=int)
    gram, right = np.zeros((0, 0)), np.zeros(0)
    rest, rounds = b.astype(float), 0
    while (left := float(np.linalg.norm(rest))) > tau * size:
        gradient = G.T @ rest
        gradient[used] = gradient[banned] = -np.inf
        j = int(np.argmax(gradient))
        # rounding of the gradient leaves about eps |G_j| |b|
        if not gradient[j] > 1e-14 * size * np.linalg.norm(G[:, j]) or rounds > 3 * G.shape[1]:
            raise ReductionError(
                f"no non-negative weights reach a residual of {tau:.1e}; it stays at {left / size:.1e}"
            )
        rounds += 1
        cross = G[:, used].T @ G[:, j]
        gram = np.block([[gram, cross[:, None]], [cross[None], G[:, j] @ G[:, j]]])
        used, right = np.append(used, j), np.append(right, G[:, j] @ b)
        y = _solve(gram, right)
        while not (y > 0).all():
            low = y <= 0
            step = float(np.min(x[used][low] / (x[used][low] - y[low])))
            x[used] += step * (y - x[used])
            keep = ~(low & (x[used] <= 1e-14 * x.max()))
            if keep.all():  # rounding hid the column that reached zero
                keep[np.argmin(np.where(low, x[used], np.inf))] = False
            x[used[~keep]] = 0.0
            used, right, gram = used[keep], right[keep], gram[np.ix_(keep, keep)]
            y = _solve(gram, right)
        # a column that left at once would be chosen again for ever
        banned = np.zeros(0, dtype=int) if j in used else np.append(banned, j)
        x[:] = 0.0
        x[used] = y
        rest = b - G[:, used] @ y
    return Weights(x, left / size if size > 0 else 0.0, rounds)


def _solve(gram: Array, right: Array) -> Array:
    """Normal equations; by least squares where columns are dependent to rounding."""
    try:
        return np.asarray(scipy.linalg.cho_solve(scipy.linalg.cho_factor(gram, check_finite=False), right))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(gram, right, rcond=None)[0])


def on_one_rank(comm: MPI.Intracomm, G: Array) -> tuple[Array, Array]:
    """G (m, n) and b = G 1 on rank 0, empty elsewhere, from the columns (m, n_local) of every rank. Collective.

    With more rows than columns, the triangle of G = Q R and Q'b instead: the same least squares problem.
    """
    columns = rows_on_root(comm, G.T)
    if columns is None:
        return np.zeros((0, 0)), np.zeros(0)
    whole = np.ascontiguousarray(columns.T)
    b = whole.sum(axis=1)
    if whole.shape[0] <= whole.shape[1]:
        return whole, b
    R = np.linalg.qr(np.hstack([whole, b[:, None]]), mode="r")
    return np.ascontiguousarray(R[:-1, :-1]), R[:-1, -1]
