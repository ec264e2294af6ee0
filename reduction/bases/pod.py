"""Proper orthogonal decomposition in a weighted inner product, and the paper's four POD bases [SBRH21]."""

from __future__ import annotations

from collections.abc import Callable, Mapping
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
        hand: Array,
        tissue: Callable[[], Array],
        by: Weight | None,
        k: int | None = None,
    ) -> Stack:
        """The snapshots of these rows in few coordinates, see :func:`softgrasp.reduction.bases.stack.stack_of`."""
        made = stack_of(self.snapshots.kept, (name, self.inner), rows, hand, tissue, by, self.engine, k)
        self.spared.append(made.spared)
        return made


def pod_part(title: str, stacks: Mapping[int, Stack]) -> Part:
    """POD_k(X): the k leading left singular vectors in the inner product W, U' W U = I. Collective.

    They minimise sum_j |x_j - U U' W x_j|_W^2.

    ``stacks``: the rows of X by the half of a basis that they are: 0 displacement, 1 velocity; the others are zero.
    """
    (one, *_), scale = stacks.values(), max(stack.scale for stack in stacks.values())
    rows, comm = one.rows, one.rows.layout.comm

    def place(U: Mapping[int, Array]) -> tuple[Columns, ...]:
        halves = {i: rows.split(part) for i, part in U.items()}
        ((hand, tissue), *_) = halves.values()
        (s_q, e_q), (s_p, e_p) = (
            halves[i] if i in halves else (np.zeros_like(hand), np.zeros_like(tissue)) for i in (0, 1)
        )
        return (Columns(s_q, s_p, e_q, e_p),)

    if not any(stack.R.any() for stack in stacks.values()):
        return Part(title, np.zeros(0), 0.0, 0, lambda _: place(dict.fromkeys(stacks, np.zeros((rows.local, 0)))))
    coordinates = [stack.orthonormal * (stack.scale / scale) for stack in stacks.values()]
    u, s, _ = small_svd(comm, np.vstack(coordinates))
    ends = np.cumsum([len(each) for each in coordinates])[:-1]

    def columns(k: int) -> tuple[Columns, ...]:
        parts = zip(stacks.items(), np.split(u[:, :k], ends), strict=True)
        U = {i: stack.vectors(C) for (i, stack), C in parts}
        if one.by is not None and k:
            # one more step removes the rounding of L^-1; it is triangular, so the nested spans stay
            W_U = {i: rows.weigh(part, stacks[i].by) for i, part in U.items()}
            repair = cholesky_of(comm, np.sum([rows.gram(U[i], W_U[i]) for i in U], axis=0))
            U = {i: part @ np.linalg.inv(repair.T) for i, part in U.items()}
        return place(U)

    square = float(np.sum(s**2))
    if one.by is None:
        square = sum(stack.factor.square * (stack.scale / scale) ** 2 for stack in stacks.values())
    noise = max(stack.factor.noise for stack in stacks.values())
    return Part(title, s, square, numerical_rank(s, noise), columns, scale)


def joint_parts(request: PartsRequest) -> tuple[Part, ...]:
    """Global POD: V = POD_k(X), X = [q_s; v_s; q_e; v_e].

    With fixed solid modes V = blkdiag(I, V_e), I of order 2 n_s for the hand, V_e = POD_k(X_e), X_e = [q_e; v_e].
    V' W V = I over displacement and velocity rows together. Collective.
    """
    return (pod_part("states", _halves(request, None)),)


def componentwise_parts(request: PartsRequest) -> tuple[Part, ...]:
    """Componentwise POD: V = blkdiag(POD_k1(X_q), POD_k2(X_v)), displacement and velocity by themselves.

    With fixed solid modes V = blkdiag(I, V_e), I of order 2 n_s for the hand, V_e the same of the tissue's rows.
    V_q' W_q V_q = I and V_v' W_v V_v = I. Collective.
    """
    halves = _halves(request, request.k)
    return tuple(pod_part(title, {i: halves[i]}) for i, title in enumerate(("displacements", "velocities")))


def _halves(request: PartsRequest, k: int | None) -> dict[int, Stack]:
    """Displacements and velocities, each in few coordinates, of which joint and componentwise bases are made."""
    b, rows = request.snapshots, Rows(request.states.layout, request.hand)
    by = weights(request.states.system, request.inner) or (None, None)
    k = k if request.engine != "tsqr" else None
    parts = (("displacements", b.s_q, b.e_q), ("velocities", b.s_p, b.e_p))
    return {
        i: request.stack(title, rows, hand, partial(np.asarray, tissue), by[i], k)
        for i, (title, hand, tissue) in enumerate(parts)
    }
