"""Exact line search of Newton's method for the Riccati equation, on low-rank residuals."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from softgrasp.fem.petsc import Array, on_root
from softgrasp.lqr.lowrank.compress import triangular
from softgrasp.lqr.plant.block import Block

SHORTEST = 1e-2


def best_step(comm: MPI.Intracomm, old: tuple[Block, Array], W: Block, change: Block) -> tuple[float, float, float]:
    """Minimise ||(1 - t) R_j + t W W' - t^2 dK'dK||_F over t in (0, 1] [BB98].

    Residual of X_j + t (X_new - X_j), exactly. Collective; chosen on one rank.

    Args:
        old: (U, signs) with R_j = U diag(signs) U'.
        W: residual factor of the Lyapunov equation.
        change: dK' = K_new' - K_j'.

    Returns t, ||R_j||_F and the norm at t = 1.
    """
    U, signs = old
    r = triangular(comm, Block.join([U, W, change]))
    return on_root(comm, lambda: _least(r, signs, U.columns, U.columns + W.columns))


def _least(r: Array, signs: Array, u: int, w: int) -> tuple[float, float, float]:
    """The same from the triangular factor r of [U, W, dK'], with U in the columns before u and W in those before w."""
    R_old = (r[:, :u] * signs) @ r[:, :u].T
    lyapunov, quadratic = r[:, u:w] @ r[:, u:w].T, r[:, w:] @ r[:, w:].T
    # R(t) = R_old + t (lyapunov - R_old) - t^2 quadratic; ||R(t)||^2 is a quartic
    terms = (R_old, lyapunov - R_old, -quadratic)
    product = [[float(np.sum(a * b)) for b in terms] for a in terms]
    (aa, ab, ac), (_, bb, bc), (_, _, cc) = product
    quartic = np.polynomial.Polynomial([aa, 2 * ab, bb + 2 * ac, 2 * bc, cc])
    roots = quartic.deriv().roots()
    real = [float(np.real(t)) for t in roots if abs(np.imag(t)) < 1e-8]
    inside = [t for t in real if SHORTEST <= t <= 1]
    t = min([*inside, 1.0, SHORTEST], key=lambda s: float(quartic(s)))
    return t, float(np.sqrt(max(aa, 0.0))), float(np.sqrt(max(float(quartic(1.0)), 0.0)))


def mixed_residual(old: tuple[Block, Array] | None, W: Block, change: Block, t: float) -> tuple[Block, Array]:
    """(U, signs) of (1 - t) R_j + t W W' - t^2 dK'dK."""
    parts = [W.times(np.sqrt(t) * np.eye(W.columns)), change.times(t * np.eye(change.columns))]
    signs = [np.ones(W.columns), -np.ones(change.columns)]
    if t < 1 and old is not None:
        U, weights = old
        parts.append(U.times(np.sqrt(1 - t) * np.eye(U.columns)))
        signs.append(weights)
    return Block.join(parts), np.concatenate(signs)
