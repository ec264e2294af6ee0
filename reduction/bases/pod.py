"""Proper orthogonal decomposition in a weighted inner product, and the paper's four POD bases [SBRH21]."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.reduction.bases.basis import Coordinates
from softgrasp.reduction.bases.engines import EngineName, numerical_rank, small_svd
from softgrasp.reduction.bases.inner import InnerName, Rows, Weight, weights
from softgrasp.reduction.bases.stack import Stack, cholesky_of, stack_of
from softgrasp.reduction.bases.states import Columns, States
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
    spared: list[float] = field(default_factory=list)  # processor times that other bases spent on the factors [s]

    @property
    def k(self) -> int | None:
        """Leading triplets that are enough, None when that is not known beforehand."""
        return self.count if self.share is None else None

    def stack(
        self,
        name: str,
        rows: Rows,
        hand: Sequence[Array],
        tissue: Callable[[], Array],
        by: tuple[Weight, ...] | None,
        k: int | None = None,
    ) -> Stack:
        """The snapshots of these rows in few coordinates, see :func:`softgrasp.reduction.bases.stack.stack_of`."""
        made = stack_of(self.snapshots.kept, (name, self.inner), rows, hand, tissue, by, self.engine, k)
        self.spared.append(made.spared)
        return made


def pod_part(title: str, stack: Stack, blocks: Sequence[int]) -> Part:
    """POD_k(X): the k leading left singular vectors in the inner product W, U' W U = I. Collective.

    They minimise sum_j |x_j - U U' W x_j|_W^2.

    ``blocks``: which halves of a basis the rows of U are: 0 displacement, 1 velocity; the others are zero.
    """
    rows, comm = stack.rows, stack.rows.layout.comm

    def place(U: Array) -> tuple[Columns, ...]:
        halves = dict(zip(blocks, rows.split(U), strict=True))
        (hand, tissue), *_ = halves.values()
        (s_q, e_q), (s_p, e_p) = (
            halves[i] if i in halves else (np.zeros_like(hand), np.zeros_like(tissue)) for i in (0, 1)
        )
        return (Columns(s_q, s_p, e_q, e_p),)

    if not stack.R.any():
        return Part(title, np.zeros(0), 0.0, 0, lambda _: place(np.zeros((rows.local, 0))))
    u, s, _ = small_svd(comm, stack.orthonormal)

    def columns(k: int) -> tuple[Columns, ...]:
        U = stack.vectors(u[:, :k])
        if stack.by is not None and k:
            # one more step removes the rounding of L^-1; it is triangular, so the nested spans stay
            repair = cholesky_of(comm, rows.gram(U, rows.weigh(U, stack.by)))
            U = U @ np.linalg.inv(repair.T)
        return place(U)

    f = stack.factor
    square = f.square if stack.by is None else float(np.sum(s**2))
    return Part(title, s, square, numerical_rank(s, f.noise), columns, f.scale)


def joint_parts(request: PartsRequest) -> tuple[Part, ...]:
    """Global POD: V = POD_k(X), X = [q_s; v_s; q_e; v_e].

    With fixed solid modes V = blkdiag(I, V_e), I of order 2 n_s for the hand, V_e = POD_k(X_e), X_e = [q_e; v_e].
    V' W V = I over displacement and velocity rows together. Collective.
    """
    b, rows = request.snapshots, Rows(request.states.layout, 2, request.hand)
    by = weights(request.states.system, request.inner)
    stack = request.stack("states", rows, (b.s_q, b.s_p), lambda: np.vstack([b.e_q, b.e_p]), by, request.k)
    return (pod_part("states", stack, (0, 1)),)


def componentwise_parts(request: PartsRequest) -> tuple[Part, ...]:
    """Componentwise POD: V = blkdiag(POD_k1(X_q), POD_k2(X_v)), displacement and velocity by themselves.

    With fixed solid modes V = blkdiag(I, V_e), I of order 2 n_s for the hand, V_e the same of the tissue's rows.
    V_q' W_q V_q = I and V_v' W_v V_v = I. Collective.
    """
    b, rows = request.snapshots, Rows(request.states.layout, 1, request.hand)
    by = weights(request.states.system, request.inner)
    q, v = (None, None) if by is None else ((by[0],), (by[1],))
    halves = (("displacements", b.s_q, b.e_q, q), ("velocities", b.s_p, b.e_p, v))
    return tuple(
        pod_part(title, request.stack(title, rows, (hand,), partial(np.asarray, tissue), weight, request.k), (half,))
        for half, (title, hand, tissue, weight) in enumerate(halves)
    )
