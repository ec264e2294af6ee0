"""The impulse that stops pressed nodes, on the mass matrix of tissue and hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_matrix

from softgrasp.fem.model.surface import Surface
from softgrasp.fem.obstacles.impulse import stop
from softgrasp.fem.petsc import Array, PETSc, total
from softgrasp.fem.system import BlockSystem

RIDGE = 1e-13  # share of the diagonal that makes equal rows share their impulse [1]


def stopping_impulse(
    system: BlockSystem,
    surface: Surface,
    nodes: NDArray[np.intp],
    normal: Array,
    b: Array,
    free: bool,
    room: tuple[PETSc.Vec, PETSc.Vec],
) -> tuple[Array, Array, Array]:
    """Jump u of the velocity with N u = b and least energy, M u, and the impulses y of the rows, M u = N'y. Collective.

    The owned rows of the tissue come first, then the hand where it is ``free`` and feels the tissue; there M has G and
    M_hand + M_rigid as well, and N has N_s = N T. ``room``: two vectors of the tissue, overwritten.
    """
    comm, n, (p, d) = system.layout.comm, system.layout.n_local, surface.X.shape
    columns, k = (nodes[:, None] * d + np.arange(d)).ravel(), len(b)
    N = csr_matrix((normal.ravel(), columns, np.arange(k + 1) * d), shape=(k, p * d))
    M_s, N_s = (system.M_hand + system.M_rigid, N @ surface.T) if free else (np.zeros((0, 0)), np.zeros((k, 0)))
    G = system.G if free else np.zeros((n, 0))
    at, of = room
    system.M_ee.getDiagonal(at)
    diagonal = np.concatenate([at.array_r, np.diag(M_s)])

    def multiply(u: Array) -> Array:
        at.array_w[:] = u[:n]
        system.M_ee.mult(at, of)
        if not free:
            return np.array(of.array_r)
        return np.concatenate([of.array_r + G @ u[n:], total(comm, G.T @ u[:n]) + M_s @ u[n:]])

    def transpose(y: Array) -> Array:
        result = np.zeros(n + len(M_s))
        result[surface.rows] = (N.T @ y)[surface.mine]
        result[n:] = N_s.T @ y
        return result

    def dot(a: Array, b: Array) -> float:
        return float(total(comm, np.array([a[:n] @ b[:n]]))[0] + a[n:] @ b[n:])

    invert = _inverse((N.multiply(1 / surface.gather(diagonal)) @ N.T).tocsr(), N_s / diagonal[n:] @ N_s.T)
    return stop(multiply, diagonal, dot, lambda u: N @ surface.gather(u) + N_s @ u[n:], transpose, invert, b)


def _inverse(small: csr_matrix, hand: Array) -> Callable[[Array], Array]:
    """R -> (small + hand)^-1 r; small is diagonal where no node has two rows."""
    diagonal = small.diagonal()
    if small.nnz == len(diagonal) and not hand.any():
        return lambda r: r / diagonal
    factor = cho_factor(small.toarray() + hand + RIDGE * np.diag(diagonal), lower=True, overwrite_a=True)
    return lambda r: np.asarray(cho_solve(factor, r, check_finite=False))
