"""Snapshots in few coordinates: one tall factorisation of the tissue's rows for all bases that use these rows."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.petsc import Array, on_root
from softgrasp.reduction.bases.engines import EPS, EngineName, Factor, factor
from softgrasp.reduction.bases.inner import Rows, Weight
from softgrasp.reduction.bases.states import BasisError


@dataclass(frozen=True)
class Stack:
    """X = blockdiag(I, Q) R: rows of the hand as they are, those of the tissue in orthonormal columns Q."""

    rows: Rows  # order of the rows of X
    factor: Factor  # Q, and what belongs to it
    R: Array  # coordinates [hand; tissue] of X / scale, the same on every rank
    L: Array | None  # Cholesky factor of the weight in these coordinates; None without weight
    by: Weight | None  # weight; None is Euclidean
    spared: float = 0.0  # processor time that another basis spent on the factor [s]

    @property
    def scale(self) -> float:
        """Power of two divided out of the snapshots."""
        return self.factor.scale

    @property
    def orthonormal(self) -> Array:
        """L'R, the coordinates in columns that are orthonormal in the weight."""
        return self.R if self.L is None else self.L.T @ self.R

    def vectors(self, C: Array) -> Array:
        """Local rows of the vectors with coordinates C in these orthonormal columns."""
        C = C if self.L is None else scipy.linalg.solve_triangular(self.L.T, C)
        top = len(self.R) - self.factor.Q.shape[1]
        hand = C[:top] if self.rows.layout.comm.rank == 0 else C[:0]
        return np.asfortranarray(np.vstack([hand, self.factor.Q @ C[top:]]))


def stack_of(
    kept: dict[object, Any],
    name: object,
    rows: Rows,
    hand: Array,
    tissue: Callable[[], Array],
    by: Weight | None,
    engine: EngineName,
    k: int | None = None,
) -> Stack:
    """Factor the tissue's rows, or take the factor that another basis made of them. Collective.

    Because Q is orthonormal, the condition of Q'WQ is at most that of W, not that of X. The hand's few rows stay out of
    the tall factorisation, so that bases with and without fixed solid modes share it; engines that stop at ``k``
    leading triplets have them in it.

    Args:
        kept: factors that are there, by name.
        name: of the tissue's rows and of the weight.
        hand: rows of the hand (n_s, m), on every rank.
        tissue: makes the tissue's local rows.
        by: weight; None is Euclidean.
        k: leading triplets that are enough, None for all.

    Raises:
        BasisError: the snapshots are not finite, or the inner product is not positive definite.
        SolverError: the factorisation fails.
    """
    comm, whole = rows.layout.comm, None if by is not None else k
    apart = engine == "tsqr" or not rows.hand
    inner = rows if not apart else replace(rows, hand=False)
    key = name, by is None, engine, whole, apart or rows.hand
    spared = kept[key][2] if key in kept else 0.0
    if key not in kept:
        begin = time.thread_time()
        X = tissue()
        if not apart:
            X = rows.stack(hand, X)
        some = comm.allreduce(bool(np.any(X)), MPI.LOR)
        f = factor(comm, X, engine, whole) if some else Factor(X[:, :0], np.zeros((0, X.shape[1])), 1.0, EPS, 0.0)
        L = None if by is None else cholesky_of(comm, inner.gram(f.Q, inner.weigh(f.Q, by)))
        kept[key] = f, L, time.thread_time() - begin
    f, L, _ = kept[key]
    if not apart or not rows.hand:
        return Stack(rows, f, f.R, L, by, spared)
    top = hand / f.scale
    f = replace(f, square=f.square + float(np.vdot(top, top)))
    if by is not None:
        L = scipy.linalg.block_diag(cholesky_of(comm, by.hand), L)
    return Stack(rows, f, np.vstack([top, f.R]), L, by, spared)


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
