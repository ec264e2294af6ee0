"""Proper orthogonal decomposition in a weighted inner product, and the paper's four POD bases [SBRH21]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.petsc import Array, on_root
from softgrasp.reduction.bases.basis import Coordinates
from softgrasp.reduction.bases.engines import EngineName, Factor, factor, numerical_rank, small_svd
from softgrasp.reduction.bases.inner import InnerName, Rows, Weight, weights
from softgrasp.reduction.bases.states import BasisError, Columns, States
from softgrasp.reduction.bases.truncation import Part


@dataclass(frozen=True)
class PartsRequest:
    """What a builder of parts gets."""

    states: States  # system and snapshots
    snapshots: Columns  # snapshots in the coordinates and the frame of the method
    hand: bool  # whether the hand's rows are part of the decomposition
    coordinates: Coordinates  # "qv" or "qp"
    inner: InnerName  # inner product
    engine: EngineName  # engine of the tall factorisation
    count: int | None  # largest N requested, None when only shares of energy are
    share: float | None  # smallest share of sum sigma^2 that may be dropped, None when only N are given

    @property
    def k(self) -> int | None:
        """Leading triplets that are enough, None when that is not known beforehand."""
        return self.count if self.share is None else None


def cholesky_of(comm: MPI.Intracomm, G: Array) -> Array:
    """Lower factor of a small Gram matrix (real or complex), the same bits on every rank. Collective.

    Raises BasisError: the inner product is not positive definite.
    """
    try:
        return on_root(comm, lambda: np.linalg.cholesky((G + G.T.conj()) / 2))
    except np.linalg.LinAlgError as error:
        raise BasisError(
            "the inner product is not positive definite on the snapshots; check density, stiffness and contact zone"
        ) from error


def weighted_factor(
    rows: Rows, X: Array, by: tuple[Weight, ...] | None, engine: EngineName, k: int | None = None
) -> tuple[Factor, Array | None]:
    """X = Q R with Q' Q = I, and the Cholesky factor L of Q' W Q (None without weight). Collective.

    The columns of Q L^-T are orthonormal in W, and L' R are the coordinates of X in them. Because Q is orthonormal,
    the condition of Q' W Q is at most that of W, not that of X.
    """
    f = factor(rows.layout.comm, X, engine, None if by is not None else k)
    if by is None:
        return f, None
    return f, cholesky_of(rows.layout.comm, rows.gram(f.Q, rows.weigh(f.Q, by)))


def pod_part(
    title: str,
    rows: Rows,
    X: Array,
    by: tuple[Weight, ...] | None,
    engine: EngineName,
    blocks: Sequence[int],
    k: int | None = None,
) -> Part:
    """POD_k(X): the k leading left singular vectors in the inner product W, U' W U = I. Collective.

    They minimise sum_j |x_j - U U' W x_j|_W^2.

    Args:
        X: snapshots, local rows (rows.local, m).
        by: weight of every half; None is Euclidean.
        blocks: which halves of a basis the rows of U are: 0 displacement, 1 velocity; the others are zero.
        k: leading triplets that are enough, None for all.
    """
    comm = rows.layout.comm

    def place(U: Array) -> tuple[Columns, ...]:
        halves = dict(zip(blocks, rows.split(U), strict=True))
        (hand, tissue), *_ = halves.values()
        (s_q, e_q), (s_p, e_p) = (
            halves[i] if i in halves else (np.zeros_like(hand), np.zeros_like(tissue)) for i in (0, 1)
        )
        return (Columns(s_q, s_p, e_q, e_p),)

    if not comm.allreduce(bool(np.any(X)), MPI.LOR):
        return Part(title, np.zeros(0), 0.0, 0, lambda _: place(np.zeros((rows.local, 0))))
    f, L = weighted_factor(rows, X, by, engine, k)
    u, s, _ = small_svd(comm, f.R if L is None else L.T @ f.R)
    C = u if L is None else scipy.linalg.solve_triangular(L.T, u)

    def columns(k: int) -> tuple[Columns, ...]:
        U = f.Q @ C[:, :k]
        if by is not None and k:
            # one more step removes the rounding of L^-1; it is triangular, so the nested spans stay
            repair = cholesky_of(comm, rows.gram(U, rows.weigh(U, by)))
            U = U @ np.linalg.inv(repair.T)
        return place(U)

    square = f.square if L is None else float(np.sum(s**2))
    return Part(title, s, square, numerical_rank(s, f.noise), columns, f.scale)


def joint_parts(request: PartsRequest) -> tuple[Part, ...]:
    """Global POD: V = POD_k(X), X = [q_s; v_s; q_e; v_e].

    With fixed solid modes V = blkdiag(I, V_e), I of order 2 n_s for the hand, V_e = POD_k(X_e), X_e = [q_e; v_e].
    V' W V = I over displacement and velocity rows together. Collective.
    """
    b, rows = request.snapshots, Rows(request.states.layout, 2, request.hand)
    X = rows.stack((b.s_q, b.e_q), (b.s_p, b.e_p))
    by = weights(request.states.system, request.inner)
    return (pod_part("states", rows, X, by, request.engine, (0, 1), request.k),)


def componentwise_parts(request: PartsRequest) -> tuple[Part, ...]:
    """Componentwise POD: V = blkdiag(POD_k1(X_q), POD_k2(X_v)), displacement and velocity by themselves.

    With fixed solid modes V = blkdiag(I, V_e), I of order 2 n_s for the hand, V_e the same of the tissue's rows.
    V_q' W_q V_q = I and V_v' W_v V_v = I. Collective.
    """
    b, rows = request.snapshots, Rows(request.states.layout, 1, request.hand)
    by = weights(request.states.system, request.inner)
    q, v = (None, None) if by is None else ((by[0],), (by[1],))
    return (
        pod_part("displacements", rows, rows.stack((b.s_q, b.e_q)), q, request.engine, (0,), request.k),
        pod_part("velocities", rows, rows.stack((b.s_p, b.e_p)), v, request.engine, (1,), request.k),
    )
