"""Orthogonal tools for tall distributed blocks: triangular factor, norms, truncation."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from mpi4py import MPI

from fem.petsc import Array, total
from lqr.checks import EPS, ControlError
from lqr.plant import Block, Plant
from reduction.engines import on_root

COLUMNS = 64  # columns whose products are held at a time
CHUNK = 20_000  # rows a QR takes at once; LAPACK copies its argument


def triangular(comm: MPI.Intracomm, X: Block) -> Array:
    """R of the thin QR factorisation X = Q R, the same on every rank, without Q. Collective."""
    k = X.columns
    rows = max(CHUNK, 4 * k)
    R = X.hand if comm.rank == 0 else np.empty((0, k))
    for first in range(0, len(X.tall), rows):
        R = np.linalg.qr(np.vstack([R, X.tall[first : first + rows]]), mode="r")
    if comm.size == 1:
        return R
    parts = comm.gather(R)
    stacked = None if parts is None else np.linalg.qr(np.vstack(parts), mode="r")
    return np.asarray(comm.bcast(stacked))


def gram(comm: MPI.Intracomm, X: Block, Y: Block) -> Array:
    """X'Y, the same on every rank. Collective."""
    return np.asarray(X.hand.T @ Y.hand + total(comm, X.tall.T @ Y.tall))


def residual_weights(plant: Plant, Z: Block) -> tuple[Array, Array]:
    """Gram matrices (A'Z)'(A'Z) and (E'Z)'(E'Z), a few columns at a time. Collective.

    The tissue rows leave out the hand's share of a two-way coupling: these are weights, no exact norms.
    """
    n, s, k = plant.n_local, plant.n_s, Z.columns
    sums = np.zeros((2, k, k))
    coupling = np.empty((s, k))
    for first in range(0, k, COLUMNS):
        last = min(first + COLUMNS, k)
        a, b = (np.ascontiguousarray(rows[:, first:last]) for rows in (Z.tall[:n], Z.tall[n:]))
        K_a, K_b, M_b = plant.stiff(a), plant.stiff(b), plant.mass(b)
        velocity = K_a - plant.damp(b, M_b=M_b, K_b=K_b)
        K_v = plant.stiff(velocity)
        weighted = np.empty((2 * n, 2 * (last - first)))
        weighted[:n, : last - first], weighted[n:, : last - first] = K_v, plant.stiff(K_b)
        weighted[n:, : last - first] -= plant.damp(velocity, K_b=K_v)
        weighted[:n, last - first :], weighted[n:, last - first :] = plant.stiff(K_a), plant.mass(M_b)
        # the lower triangle is enough
        part = Z.tall[:, first:].T @ weighted
        sums[:, first:, first:last] = np.split(part, 2, axis=1)
        coupling[:, first:last] = plant.G.T @ b
    sums, coupling = total(plant.comm, sums), total(plant.comm, coupling)
    E_hand = np.vstack([Z.hand[:s], plant.M_s @ Z.hand[s:] + coupling])
    G_A, G_E = (np.tril(G) + np.tril(G, -1).T for G in sums)
    return G_A + Z.hand[:s].T @ Z.hand[:s], G_E + E_hand.T @ E_hand


def compress(plant: Plant, Z: Block, allowed: float) -> Block:
    """Fewest columns that keep the Riccati residual within ``allowed`` (absolute, 2-norm). Collective.

    A dropped column z changes the residual by at most 2 |A'z| |E'z| <= |A'z|^2 / r + r |E'z|^2 for any r > 0: the
    eigenvalues of the Gram matrix in that norm are dropped from below until their sum is reached. They enter X
    linearly, so rounding of the Gram matrix is rounding of X.
    """
    G_A, G_E = residual_weights(plant, Z)
    ratio = np.sqrt(max(np.trace(G_A), 1e-300) / max(np.trace(G_E), 1e-300))
    return Z.times(on_root(plant.comm, lambda: _leading(G_A / ratio + G_E * ratio, allowed)))


def _leading(G: Array, allowed: float) -> Array:
    """Orthonormal columns, fewest, that leave out at most ``allowed`` of the trace of a semidefinite G.

    A Cholesky factorisation with pivots first takes out the range of G, of about half its order: an eigenvalue problem
    of that order costs an eighth. Not collective.
    """
    k = len(G)
    factor, pivots, rank, info = scipy.linalg.lapack.dpstrf(
        G, lower=1, tol=k * EPS * float(np.diag(G).max(initial=0.0))
    )
    if info < 0:
        raise ControlError(f"the Gram matrix of order {k} was refused by LAPACK (info {info})")
    L = np.zeros((k, rank))
    L[pivots - 1] = np.tril(factor)[:, :rank]
    # G = L L' but for a remainder of rounding
    basis, small = np.linalg.qr(L)
    vectors, sizes, _ = np.linalg.svd(small)
    values = sizes[::-1] ** 2
    floor = k * EPS * float(values[-1]) if rank else 0.0
    keep = np.cumsum(values) > max(allowed, floor)
    return np.ascontiguousarray(basis @ vectors[:, keep[::-1]])
