"""Orthogonal tools for tall distributed blocks: triangular factor, norms, truncation."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from fem.petsc import Array, total
from lqr.checks import EPS
from lqr.plant import Block, Plant

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
    G_A, G_E = np.zeros((k, k)), np.zeros((k, k))
    A_hand, E_hand = np.empty((2 * s, k)), np.empty((2 * s, k))
    for first in range(0, k, COLUMNS):
        part = slice(first, min(first + COLUMNS, k))
        a, b, b_s = Z.tall[:n, part], Z.tall[n:, part], Z.hand[s:, part]
        K_a, K_b, M_b = plant.stiff(a), plant.stiff(b), plant.mass(b)
        velocity = K_a - plant.damp(b, M_b=M_b, K_b=K_b)
        weighted = np.vstack([plant.stiff(velocity), plant.stiff(K_b) - plant.damp(velocity)])
        G_A[:, part] = Z.tall.T @ weighted
        weighted = np.vstack([plant.stiff(K_a), plant.mass(M_b)])
        G_E[:, part] = Z.tall.T @ weighted
        local = np.vstack([plant.G.T @ b])
        E_hand[:s, part] = Z.hand[:s, part]
        E_hand[s:, part] = plant.M_s @ b_s + total(plant.comm, local)
        A_hand[:s, part], A_hand[s:, part] = 0.0, Z.hand[:s, part]
    G_A = total(plant.comm, G_A) + A_hand.T @ A_hand
    G_E = total(plant.comm, G_E) + E_hand.T @ E_hand
    return (G_A + G_A.T) / 2, (G_E + G_E.T) / 2


def compress(plant: Plant, Z: Block, allowed: float) -> Block:
    """Fewest columns that keep the Riccati residual within ``allowed`` (absolute, 2-norm). Collective.

    A dropped column z changes the residual by at most 2 |A'z| |E'z| <= |A'z|^2 / r + r |E'z|^2 for any r > 0: the
    eigenvalues of the Gram matrix in that norm are dropped from below until their sum is reached. They enter X
    linearly, so rounding of the Gram matrix is rounding of X.
    """
    G_A, G_E = residual_weights(plant, Z)
    basis = None
    if plant.comm.rank == 0:
        ratio = np.sqrt(max(np.trace(G_A), 1e-300) / max(np.trace(G_E), 1e-300))
        values, vectors = np.linalg.eigh(G_A / ratio + G_E * ratio)
        floor = len(values) * EPS * float(values[-1])
        keep = np.cumsum(np.maximum(values, 0.0)) > max(allowed, floor)
        basis = np.ascontiguousarray(vectors[:, keep][:, ::-1])
    return Z.times(plant.comm.bcast(basis))
