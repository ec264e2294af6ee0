"""S(p) with whole matrices on every rank: SuperLU in complex numbers, each rank another shift."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from mpi4py import MPI
from numpy.typing import NDArray

from softgrasp.fem.errors import SolverError, agree
from softgrasp.fem.petsc import Array, Complex, PETSc, whole_copy
from softgrasp.fem.system import BlockSystem
from softgrasp.lqr.lowrank.factor_ahead import FactorsAhead

# n_e up to which SuperLU works column by column in 2D, where it is the faster way; in 3D it needs its panels
THIN_UP_TO = 20_000
AHEAD_FROM = 5_000  # n_e from which other cores, if there are, make the next factors
# Threads that do: two in 2D, where this rank would wait for one. Up to four factors are then alive at a time, too much
# memory in 3D.
THREADS = {1: 2, 2: 2, 3: 1}


class GatheredTissue:
    """Every rank holds all rows; the factors of ``comm.size`` shifts are made at the same time, one a rank.

    SuperLU in complex numbers with diagonal pivots and one fill-reducing order (nested dissection) for all shifts. A
    program of one rank that may use another core makes the next factors there while it works with the present one.
    """

    name = "gathered"

    def __init__(self, system: BlockSystem) -> None:
        layout = system.layout
        self.comm, self.n_local = layout.comm, layout.n_local
        self.counts = np.array(self.comm.allgather(layout.n_local))
        damping = system.damping
        self.alpha, self.beta = damping.alpha, damping.beta
        matrices = [system.K_ee, system.M_ee] + ([] if damping.matrix is None else [damping.matrix])
        parts, self.order = self._permuted(matrices)
        self.K, self.M = parts[:2]
        self.D = None if damping.matrix is None else parts[2]
        self.same = all(
            np.array_equal(A.indptr, self.K.indptr) and np.array_equal(A.indices, self.K.indices) for A in parts
        )
        thin = layout.dimension < 3 and layout.n_e <= THIN_UP_TO
        self.blocking = {"panel_size": 1, "relax": 16} if thin else {}
        self.cache: dict[complex, tuple[int, scipy.sparse.linalg.SuperLU | None]] = {}
        self.ahead: FactorsAhead | None = None
        threads = THREADS[layout.dimension]
        if MPI.COMM_WORLD.size == 1 and layout.n_e >= AHEAD_FROM and _cores() > 1:
            self.ahead = FactorsAhead(self._factor, threads)
        # one for each thread, filled anew for each shift, because making one checks its indices
        self.shells = [scipy.sparse.csc_matrix(self.K) for _ in range(1 if self.ahead is None else threads)]
        self.seconds = {"factor": 0.0, "solve": 0.0}
        self.factors = 0

    def _permuted(self, matrices: Sequence[PETSc.Mat]) -> tuple[list[scipy.sparse.csc_matrix], NDArray[np.int64]]:
        """All rows on every rank in the nested dissection order of the first, and that order. Collective."""
        copies = [whole_copy(A) for A in matrices] if self.comm.size > 1 else []
        whole = copies or matrices
        rows, columns = whole[0].getOrdering("nd")
        parts = []
        for A in whole:
            permuted = A.permute(rows, rows)
            indptr, indices, values = permuted.getValuesCSR()
            permuted.destroy()
            # the matrix is symmetric, so its rows serve as columns
            parts.append(scipy.sparse.csc_matrix((values, indices, indptr), shape=A.getSize()))
        order = np.array(rows.getIndices(), dtype=np.int64)
        for item in (rows, columns, *copies):
            item.destroy()
        return parts, order

    def _matrix(self, p: complex, shell: int) -> scipy.sparse.csc_matrix:
        p = p if p.imag else p.real
        m, k = p * p - p * self.alpha, 1.0 - p * self.beta
        if not self.same:
            S = k * self.K + m * self.M
            return (S if self.D is None else S - p * self.D).tocsc()
        data = k * self.K.data + m * self.M.data
        if self.D is not None:
            data = data - p * self.D.data
        self.shells[shell].data = data
        return self.shells[shell]

    def _factor(self, p: complex, shell: int = 0) -> scipy.sparse.linalg.SuperLU:
        S = self._matrix(p, shell)
        try:
            return scipy.sparse.linalg.splu(
                S, permc_spec="NATURAL", diag_pivot_thresh=0.0, options=_SYMMETRIC, **self.blocking
            )
        except RuntimeError as error:
            raise SolverError(f"the factorisation of S(p) failed at the shift p = {p:.4g} ({error})") from error

    def _prepare(self, shifts: Sequence[complex]) -> None:
        """Factor up to one shift a rank. Collective."""
        distinct = list(dict.fromkeys(shifts))
        shifts = distinct[: self.comm.size]
        if self.comm.size == 1:
            self._forget()
            self.cache[shifts[0]] = (0, self._factor(shifts[0]) if self.ahead is None else self.ahead.take(distinct))
        else:
            self.cache = {}
            fresh: dict[complex, tuple[int, scipy.sparse.linalg.SuperLU | None]]
            fresh = {p: (rank, None) for rank, p in enumerate(shifts)}
            with agree(self.comm):
                if self.comm.rank < len(shifts):
                    p = shifts[self.comm.rank]
                    fresh[p] = (self.comm.rank, self._factor(p))
            self.cache = fresh
        self.factors += len(shifts)

    def _forget(self) -> None:
        """Let the factors go."""
        old, self.cache = self.cache, {}
        if self.ahead is not None and old:
            (_, factor) = old.popitem()[1]
            box: list[object] = [factor]
            del factor
            self.ahead.free(box)

    def solve(self, p: complex, F: Array | Complex, ahead: Sequence[complex] = ()) -> Complex:
        """See :class:`softgrasp.lqr.lowrank.shifted.ShiftedTissue`; other ranks or threads factor ahead. Collective.

        Complex even where p is real. Raises SolverError: a pivot vanishes.
        """
        p = complex(p)
        begin = time.perf_counter()
        if p not in self.cache:
            self._prepare([p, *(complex(q) for q in ahead)])
        middle = time.perf_counter()
        owner, lu = self.cache[p]
        result = (
            _lu_solve(lu, F, self.order, p.imag == 0)
            if self.comm.size == 1
            else self._solve_on(owner, lu, F, p.imag == 0)
        )
        self.seconds["factor"] += middle - begin
        self.seconds["solve"] += time.perf_counter() - middle
        return result

    def _solve_on(self, owner: int, lu: scipy.sparse.linalg.SuperLU | None, F: Array | Complex, real: bool) -> Complex:
        """Rows to the owner of the factor, solve there, rows back. Collective."""
        k = F.shape[1]
        local = np.ascontiguousarray(F, dtype=complex)
        owner_here = self.comm.rank == owner
        whole = np.empty((int(self.counts.sum()), k), dtype=complex) if owner_here else None
        sizes = self.counts * k
        self.comm.Gatherv(local, None if whole is None else [whole, sizes], root=owner)
        if whole is not None and lu is not None:
            whole = np.ascontiguousarray(_lu_solve(lu, whole, self.order, real))
        result = np.empty((self.n_local, k), dtype=complex)
        self.comm.Scatterv(None if whole is None else [whole, sizes], result, root=owner)
        return result

    def destroy(self) -> None:
        """Free the factors."""
        self._forget()
        if self.ahead is not None:
            self.ahead.close()


_SYMMETRIC = {"SymmetricMode": True, "Equil": False}


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _lu_solve(lu: scipy.sparse.linalg.SuperLU, F: Array | Complex, order: NDArray[np.int64], real: bool) -> Complex:
    """Solve with a factor of the permuted matrix; real factors take real and imaginary part one after the other."""
    right = F[order]
    result = np.empty(F.shape, dtype=complex)
    if not real:
        result[order] = lu.solve(np.asfortranarray(right, dtype=complex))
    elif np.iscomplexobj(right):
        result.real[order] = lu.solve(np.asfortranarray(right.real))
        result.imag[order] = lu.solve(np.asfortranarray(right.imag))
    else:
        result[order] = lu.solve(np.asfortranarray(right))
    return result
