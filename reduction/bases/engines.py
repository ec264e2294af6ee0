"""Engines that factor a tall distributed snapshot matrix: X = Q R with Q' Q = I, Q distributed, R small.

What follows (weights, complex structure, symplectic pairs) is small and dense, runs on rank 0 and is broadcast, so
every rank sees the same numbers. Limits, measured at sigma_j = 10^(-16 j / 599):

    engine  what runs                                             sigma right to 1e-8 relative down to sigma / sigma_1
    tsqr    SLEPc BV, tall-skinny QR: the default                 1e-10
    svd     SLEPc SVD: trlanczos for the leading k,               all k
            scalapack when all are wanted                         1e-10
    gram    X' X and its eigenvalues (method of snapshots),       1e-6; nothing below 6e-8, so never the default
            fast, then one Rayleigh-Ritz step

When a rank has fewer rows than the matrix has columns, it is small: each rank's QR and rank 0 do it, for tsqr and svd;
one rank alone factors nothing, as Q = I.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import scipy.linalg
from mpi4py import MPI
from slepc4py import SLEPc

from softgrasp.fem.errors import SolverError, raise_on_all_ranks
from softgrasp.fem.petsc import Array, PETSc, folded, from_options, on_root, total
from softgrasp.reduction.bases.states import BasisError

EngineName = Literal["tsqr", "svd", "gram"]
ENGINES: tuple[EngineName, ...] = get_args(EngineName)
EPS = float(np.finfo(float).eps)
# share of the largest singular value that the solves of a run leave as rounding in its snapshots, and that differs from
# one number of ranks to another: measured 4e-15 (absolute frame) to 9e-14 (relative to the hand) on block_3d
SNAPSHOT_ROUNDING = 1e-13
# sqrt(eps) is where eigenvalues of X'X drown; 4 keeps U = X V / s well enough conditioned for one repair step
GRAM_LIMIT = 4 * EPS**0.5
BLOCK_ROWS = 20_000  # rows of one LAPACK QR: fits the cache better than one tall one
SVD_PREFIX = "softgrasp_svd_"
SVD_TOLERANCE = 1e-13


@dataclass(frozen=True)
class Factor:
    """scale * Q R = X up to rounding, or its best approximation of rank r where leading triplets are enough."""

    Q: Array  # local rows (n_local, r), orthonormal columns over all ranks
    R: Array  # (r, c), the same bits on every rank; triangular where there are more rows than columns
    scale: float  # power of two that keeps squares of R from under- and overflow
    noise: float  # singular values below ``noise * sigma_1`` are rounding of the factorisation
    square: float  # sum of all sigma^2 of X / scale, also of those that are not in R


def numerical_rank(s: Array, noise: float = 0.0) -> int:
    """Number of singular values, descending, above the rounding of snapshots, :data:`SNAPSHOT_ROUNDING`.

    ``noise``: share of the first one that is rounding of the factorisation, where that is larger.
    """
    return int(np.count_nonzero(s > max(noise, SNAPSHOT_ROUNDING) * s[0])) if len(s) else 0


def magnitude(comm: MPI.Intracomm, *blocks: Array) -> float:
    """Power of two next to the largest entry over all ranks; 1 when all are zero. Collective."""
    own = float(np.max([max(X.max(), -X.min()) for X in blocks if X.size], initial=0.0))
    if comm.allreduce(not np.isfinite(own), MPI.LOR):
        raise BasisError("the snapshots contain NaN or infinity; a basis needs finite snapshots")
    largest = comm.allreduce(own, MPI.MAX)
    # 2^-1000 .. 2^1000 so that the inverse is finite too
    return float(2.0 ** np.clip(np.frexp(largest)[1], -1000, 1000)) if largest > 0 else 1.0


def factor(comm: MPI.Intracomm, X: Array, engine: EngineName = "tsqr", k: int | None = None) -> Factor:
    """Factor a row-distributed matrix. Collective.

    Args:
        X: local rows (n_local, c); read only.
        k: number of leading triplets that are enough; ``tsqr`` makes all the same.

    Raises:
        BasisError: the engine is unknown, X contains NaN or infinity, or X is zero.
        SolverError: SLEPc fails.
    """
    if engine not in ENGINES:
        raise BasisError(f"engine '{engine}' is unknown; choose one of {', '.join(ENGINES)}")
    scale = magnitude(comm, X)
    X = np.asfortranarray(X) if scale == 1.0 else np.asfortranarray(X / scale)
    square = float(comm.allreduce(float(np.vdot(X, X))))
    if square == 0.0:
        raise BasisError("all snapshots are zero; there is nothing to build a basis from")
    rows = int(comm.allreduce(X.shape[0]))
    if engine == "gram":
        Q, R, noise = *_gram(comm, X, k), GRAM_LIMIT
    else:
        # LAPACK's own bound on an absolute error in sigma, with its usual factor sqrt of the size
        noise = EPS * max(X.shape[1], 100) ** 0.5
        if comm.allreduce(X.shape[0], MPI.MIN) < X.shape[1]:
            # SLEPc loses columns of Q when a rank has fewer rows than columns and the snapshots are deficient
            Q, R = _flat(comm, X)
        elif engine == "tsqr" or X.shape[1] < comm.size:  # ScaLAPACK needs a column for every rank
            Q, R = _tsqr(comm, X, rows)
        else:
            Q, R = _svd(comm, X, rows, k)
    return Factor(Q, R, scale, noise, square)


def _dense(comm: MPI.Intracomm, X: Array, rows: int) -> PETSc.Mat:
    A = PETSc.Mat().createDense(((X.shape[0], rows), (None, X.shape[1])), array=X, comm=comm)
    A.assemble()
    return A


def _tsqr(comm: MPI.Intracomm, X: Array, rows: int) -> tuple[Array, Array]:
    """SLEPc BV: tall-skinny QR over the ranks."""
    m = X.shape[1]
    A = _dense(comm, X, rows)
    bv = SLEPc.BV().createFromMat(A)
    bv.setType(SLEPc.BV.Type.MAT)  # the default type has no tall-skinny QR
    small = PETSc.Mat().createDense((m, m), comm=MPI.COMM_SELF)
    small.setUp()
    try:
        bv.setOrthogonalization(block=SLEPc.BV.OrthogBlockType.TSQR)
        bv.orthogonalize(small)
        view = bv.getMat()  # BV.getArray reads past the local rows on two ranks
        Q = np.array(view.getDenseArray(), order="F")
        bv.restoreMat(view)
        R = np.triu(small.getDenseArray())
    except (PETSc.Error, SystemError) as error:
        raise SolverError(
            f"SLEPc BV: QR of {rows} x {m} snapshots failed ({error}); check memory, or use engine = 'svd'"
        ) from error
    finally:
        for each in (bv, A, small):
            each.destroy()
    return Q, np.asarray(comm.bcast(R) if comm.size > 1 else R)


def _svd(comm: MPI.Intracomm, X: Array, rows: int, k: int | None) -> tuple[Array, Array]:
    """SLEPc SVD: the leading k triplets by thick-restart Lanczos, or all by ScaLAPACK."""
    m = X.shape[1]
    A = _dense(comm, X, rows)
    svd = SLEPc.SVD().create(comm)
    svd.setOptionsPrefix(SVD_PREFIX)
    svd.setOperators(A)
    leading = k is not None and 3 * k < m  # beyond a third of them, all at once is cheaper
    svd.setType(SLEPc.SVD.Type.TRLANCZOS if leading else SLEPc.SVD.Type.SCALAPACK)
    if leading:
        svd.setDimensions(nsv=k)
        svd.setTolerances(SVD_TOLERANCE, 1000)
    from_options(svd)
    u, v = A.createVecLeft(), A.createVecRight()
    try:
        svd.solve()
        count = svd.getConverged()
        if leading and count < k:
            raise SolverError(
                f"SLEPc SVD: {count} of {k} singular values converged in {svd.getIterationNumber()} iterations; "
                "request fewer, or use engine = 'tsqr'"
            )
        count = k if leading and k is not None else count
        Q, sigma = np.empty((X.shape[0], count), order="F"), np.empty(count)
        for j in range(count):
            sigma[j] = svd.getSingularTriplet(j, u, v)
            Q[:, j] = u.array_r
    except (PETSc.Error, SystemError) as error:
        raise SolverError(f"SLEPc SVD failed on {rows} x {m} snapshots ({error}); use engine = 'tsqr'") from error
    finally:
        for each in (svd, A, u, v):
            each.destroy()
    return Q, total(comm, Q.T @ X)


def _flat(comm: MPI.Intracomm, X: Array) -> tuple[Array, Array]:
    """QR of what each rank has, then of the stacked triangles on rank 0, for few rows; of all rows I X itself."""
    if comm.size == 1:
        return np.eye(len(X), order="F"), X.copy()
    Q_local, R_local = np.linalg.qr(X)
    parts, blocks, R = comm.gather(R_local), None, None
    with raise_on_all_ranks(comm):
        if parts is not None:
            Q, R = np.linalg.qr(np.vstack(parts))
            blocks = np.split(Q, np.cumsum([len(part) for part in parts])[:-1])
    return np.asfortranarray(Q_local @ comm.scatter(blocks)), np.asarray(comm.bcast(R))


def triangle(comm: MPI.Intracomm, X: Array, top: Array | None = None) -> Array:
    """R of X = Q R, without Q, by QR of row blocks, then of triangles of two ranks at a time. Collective.

    Args:
        X: local rows (n_local, k).
        top: rows above those of rank 0, known to every rank.
    """

    def own() -> Array:
        R = np.zeros((0, X.shape[1])) if top is None or comm.rank else top
        for i in range(0, len(X), BLOCK_ROWS):
            R = np.linalg.qr(np.vstack([R, X[i : i + BLOCK_ROWS]]), mode="r")
        return R

    R = folded(comm, own, lambda upper, lower: np.linalg.qr(np.vstack([upper, lower]), mode="r"))
    return on_root(comm, lambda: R)


def _gram(comm: MPI.Intracomm, X: Array, k: int | None) -> tuple[Array, Array]:
    """Method of snapshots: X'X = V S^2 V', U = X V / s; for k triplets a few more than k."""
    C = total(comm, X.T @ X)
    s2, V = on_root(comm, lambda: scipy.linalg.eigh(C))
    s, V = np.sqrt(np.maximum(s2[::-1], 0.0)), V[:, ::-1]
    keep = s > GRAM_LIMIT * s[0]
    if k is not None:
        keep[k + k // 2 + 10 :] = False  # the last of those kept are not converged by the Rayleigh-Ritz step
    U = X @ (V[:, keep] / s[keep])
    # U is orthonormal to eps (sigma_1 / sigma_r)^2 only; dividing by its triangle keeps the nested spans
    Q = np.asfortranarray(scipy.linalg.solve_triangular(triangle(comm, U), U.T, trans="T", check_finite=False).T)
    return Q, total(comm, Q.T @ X)


def small_svd(comm: MPI.Intracomm, R: Any) -> tuple[Any, Array, Any]:
    """SVD of a small replicated matrix, the same bits everywhere, with fixed signs. Collective.

    The largest entry of every right singular vector is made real and positive, so that the answer does not depend on
    the rank count beyond rounding.
    """

    def call() -> tuple[Any, Array, Any]:
        try:
            U, s, V_h = np.linalg.svd(R, full_matrices=False)
        except np.linalg.LinAlgError:
            U, s, V_h = scipy.linalg.svd(R, full_matrices=False, lapack_driver="gesvd")
        pivot = V_h[np.arange(len(s)), np.abs(V_h).argmax(axis=1)]
        phase = np.where(pivot == 0, 1.0, pivot) / np.where(pivot == 0, 1.0, np.abs(pivot))
        return U * phase, s, V_h * phase.conj()[:, None]

    return on_root(comm, call)
