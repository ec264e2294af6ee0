"""Orthogonal tools for tall distributed blocks: triangular factor, norms, truncation."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.petsc import Array, on_root, total
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import EPS, ControlError
from softgrasp.lqr.plant.operators import damp
from softgrasp.reduction.bases.engines import triangle

COLUMNS = 64  # columns whose products are in memory at a time
PROBES = 8  # random sums of columns from which norms are estimated


def triangular(comm: MPI.Intracomm, X: Block) -> Array:
    """R of the thin QR factorisation X = Q R without Q, (k, k), the same on every rank. Collective."""
    return triangle(comm, X.tall, X.hand)


def gram(comm: MPI.Intracomm, X: Block, Y: Block) -> Array:
    """X'Y of blocks of k and l columns, (k, l), the same on every rank. Collective."""
    return np.asarray(X.hand.T @ Y.hand + total(comm, X.tall.T @ Y.tall))


def residual_weight(plant: Plant, Z: Block) -> Array:
    """Gram matrix (A'Z)'(A'Z) / r + r (E'Z)'(E'Z), r about |A'Z| / |E'Z|, (k, k), a few columns at a time. Collective.

    The tissue rows leave out the hand's share of a two-way coupling, the hand's rows drag in space: this is a weight,
    no exact norm.
    """
    n, s, k = plant.n_local, plant.n_s, Z.columns
    ratio = _ratio(plant, Z)
    damping = plant.system.damping
    G = np.zeros((k, k))
    coupling = np.empty((s, k))
    for first in range(0, k, COLUMNS):
        last = min(first + COLUMNS, k)
        c = last - first
        both, K_both, M_b, velocity = _tissue_products(plant, Z[first:last])
        # A A'Z / r + r E E'Z: tissue rows [K (v / r + r K a); (K K b - D v) / r + r M M b], v = K a - D b
        both[:, :c] = velocity / ratio + ratio * K_both[:, :c]
        both[:, c:] = (K_both[:, c:] - damping.beta * velocity) / ratio
        K_both = plant.stiff(both)
        weighted = np.empty((2 * n, c))
        weighted[:n] = K_both[:, :c]
        weighted[n:] = K_both[:, c:] + plant.mass(ratio * M_b - (damping.alpha / ratio) * velocity)
        if plant.viscous is not None:
            weighted[n:] -= plant.viscous(velocity) / ratio
        # the lower triangle is enough
        G[first:, first:last] = Z.tall[:, first:].T @ weighted
        coupling[:, first:last] = plant.G.T @ Z.tall[n:, first:last]
    G, coupling = total(plant.comm, G), total(plant.comm, coupling)
    E_hand = np.vstack([Z.hand[:s], plant.M_s @ Z.hand[s:] + coupling])
    G = np.tril(G) + np.tril(G, -1).T
    return np.asarray(G + Z.hand[:s].T @ Z.hand[:s] / ratio + ratio * E_hand.T @ E_hand)


def _tissue_products(plant: Plant, Z: Block) -> tuple[Array, Array, Array, Array]:
    """[a, b], K_ee [a, b], M_ee b and v = K_ee a - D_ee b for tissue rows a, b of Z. Collective."""
    c, both = Z.columns, np.hstack(Z.parts[2:])
    b, K_both = both[:, c:], plant.stiff(both)
    M_b = plant.mass(b)
    return both, K_both, M_b, K_both[:, :c] - damp(plant.system, b, M_b, K_both[:, c:])


def _ratio(plant: Plant, Z: Block) -> float:
    """|A'Z| / |E'Z|, estimated from a few sums of columns with random signs. Collective."""
    signs = np.random.default_rng(0).choice(np.array([-1.0, 1.0]), (Z.columns, PROBES))
    X = Z.times(signs)
    _, K_both, M_b, velocity = _tissue_products(plant, X)
    rates = np.sum(K_both[:, PROBES:] ** 2) + np.sum(velocity**2)
    square = total(plant.comm, np.array([rates, np.sum(K_both[:, :PROBES] ** 2) + np.sum(M_b**2)]))
    square += [np.sum(X.hand[: plant.n_s] ** 2), np.sum(plant.mass_adjoint(X).hand ** 2)]
    sizes = np.sqrt(np.maximum(square, 1e-300))
    return float(sizes[0] / sizes[1])


def compress(plant: Plant, Z: Block, allowed: float) -> Block:
    """Factor of fewest columns whose ZZ' changes the Riccati residual by ``allowed`` at most (2-norm). Collective.

    A dropped column z changes the residual by at most 2 |A'z| |E'z| <= |A'z|^2 / r + r |E'z|^2 for any r > 0: the
    eigenvalues of the Gram matrix in that norm are dropped from below until their sum is reached. They enter X
    linearly, so rounding of the Gram matrix is rounding of X.
    """
    G = residual_weight(plant, Z)
    return Z.times(on_root(plant.comm, lambda: _leading(G, allowed)))


def _leading(G: Array, allowed: float) -> Array:
    """Fewest columns U, U'U = I, (k, r), that leave out at most ``allowed`` of the trace of a semidefinite G (k, k).

    A Cholesky factorisation with pivots, G = L L', first removes the range of G, of about half its order; then
    L'L = V s V' of that order and U = L V s^{-1/2}. U'U = I to rounding of G / sqrt(s_i s_j): what that adds to
    U' G U is rounding of G.
    """
    k = len(G)
    factor, pivots, rank, info = scipy.linalg.lapack.dpstrf(
        G, lower=1, tol=k * EPS * float(np.diag(G).max(initial=0.0))
    )
    if info < 0:
        raise ControlError(f"the Gram matrix of order {k} was refused by LAPACK (info {info})")
    L = np.zeros((k, rank))
    L[pivots - 1] = np.tril(factor)[:, :rank]
    values, vectors = np.linalg.eigh(L.T @ L)
    rounding = k * EPS * float(values[-1]) if rank else 0.0
    keep = np.cumsum(values) > max(allowed, rounding)
    return np.ascontiguousarray((L @ (vectors[:, keep] / np.sqrt(values[keep])))[:, ::-1])
