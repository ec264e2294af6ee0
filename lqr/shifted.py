"""One tissue solve a shift: S(p) = p^2 M_ee - p D_ee + K_ee, complex symmetric, of the order n_e."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Protocol

import numpy as np
import psutil
import scipy.sparse
import scipy.sparse.linalg
from mpi4py import MPI
from numpy.typing import NDArray

from fem.errors import ResourceError, SolverError, agree
from fem.layout import BlockLayout
from fem.petsc import Array, PETSc, petsc_options
from fem.system import BlockSystem

Complex = NDArray[np.complex128]
PREFIX = "softgrasp_shifted_"
# Every rank factors whole matrices up to here, each rank another shift: no messages in the factorisation, and SuperLU
# in complex numbers needs less than half the time of MUMPS on the real form of twice the order. Beyond, a whole factor
# on each rank costs too much memory (3D, n_e = 38 931: 0.9 GB).
GATHER_LIMIT = {1: 150_000, 2: 150_000, 3: 40_000}  # 1: systems without a mesh
AHEAD_FROM = 5_000  # n_e from which a second core, if one is idle, makes the next factor


class ShiftedTissue(Protocol):
    """Solves S(p) B = F for distributed F.

    Attributes:
        name: gathered or distributed.
        seconds: time by stage, factor and solve [s].
        factors: factorisations made by this rank's communicator.
    """

    name: str
    seconds: dict[str, float]
    factors: int

    def solve(self, p: complex, F: Array | Complex, ahead: Sequence[complex] = ()) -> Complex:
        """Local rows of S(p)^{-1} F, (n_local, k). Collective.

        Args:
            p: shift; 0 gives K_ee^{-1}.
            F: local rows.
            ahead: shifts that will probably come next.
        """

    def destroy(self) -> None:
        """Free the factors. Collective."""


def make_shifted(system: BlockSystem, wanted: str = "auto") -> ShiftedTissue:
    """The solver for a size: ``gathered`` or ``distributed``. Collective.

    Raises:
        SolverError: the name is unknown.
        ResourceError: the factor would not fit in the memory that is free now.
    """
    name = wanted
    if wanted == "auto":
        small = system.layout.n_e <= GATHER_LIMIT[system.layout.dimension]
        name = "gathered" if small else "distributed"
    if name == "gathered":
        return GatheredTissue(system)
    if name == "distributed":
        check_memory(system.layout)
        return DistributedTissue(system)
    raise SolverError(f"the shifted solver {wanted!r} is unknown; choose auto, gathered or distributed")


def factor_bytes(n: int, dimension: int) -> float:
    """What MUMPS asks for to factor S(p) of order n, all ranks together: 240 n log2 n in 2D, 800 n^(4/3) in 3D.

    Fitted to n = 6 558 to 103 038 in 2D and n = 7 227 to 52 857 in 3D. Not collective.
    """
    return 240 * n * float(np.log2(max(n, 2))) if dimension < 3 else 800 * n ** (4 / 3)


def check_memory(layout: BlockLayout) -> None:
    """The factor of S(p) fits in the memory that is free now. Collective.

    Raises:
        ResourceError: it does not.
    """
    needed = factor_bytes(layout.n_e, layout.dimension) / 2**30
    free = float(layout.comm.bcast(psutil.virtual_memory().available)) / 2**30
    if needed > free:
        raise ResourceError(
            f"the factor of the shifted tissue matrix (n_e = {layout.n_e} in {layout.dimension}D) needs about "
            f"{needed:.1f} GiB and {free:.1f} GiB are free; take fewer cells, or set control.method = 'modal'"
        )


class GatheredTissue:
    """Every rank holds all rows; the factors of ``comm.size`` shifts are made at the same time, one a rank.

    SuperLU in complex numbers with diagonal pivots and one fill-reducing order (nested dissection) for all shifts. A
    program of one rank that may use another core makes the next factor there while it works with the present one.

    Args:
        system: operators.
    """

    name = "gathered"

    def __init__(self, system: BlockSystem) -> None:
        layout = system.layout
        self.comm, self.n_local = layout.comm, layout.n_local
        self.counts = np.array(self.comm.allgather(layout.n_local))
        K = self._gather(system.K_ee)
        self.order = _dissection(K)
        self.K, self.M = self._permute(K), self._permute(self._gather(system.M_ee))
        damping = system.damping
        self.alpha, self.beta = damping.alpha, damping.beta
        self.D = None if damping.matrix is None else self._permute(self._gather(damping.matrix))
        parts = [self.K, self.M] + ([] if self.D is None else [self.D])
        self.same = all(np.array_equal(A.indices, self.K.indices) for A in parts)
        # filled in turn, because making one checks its indices
        self.shells = [scipy.sparse.csc_matrix(self.K) for _ in range(2)]
        self.cache: dict[complex, tuple[int, scipy.sparse.linalg.SuperLU | None]] = {}
        self.helper: ThreadPoolExecutor | None = None
        self.next: list[tuple[complex, Future[scipy.sparse.linalg.SuperLU]]] = []
        if MPI.COMM_WORLD.size == 1 and layout.n_e >= AHEAD_FROM and _cores() > 1:
            self.helper = ThreadPoolExecutor(1)
        self.seconds = {"factor": 0.0, "solve": 0.0}
        self.factors = 0

    def _gather(self, A: PETSc.Mat) -> scipy.sparse.csc_matrix:
        """All rows on every rank; the matrix is symmetric, so its rows serve as columns."""
        indptr, columns, values = A.getValuesCSR()
        parts = self.comm.allgather((np.diff(indptr), columns, values))
        lengths, columns, values = (np.concatenate([part[i] for part in parts]) for i in range(3))
        indptr = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
        n = len(lengths)
        return scipy.sparse.csc_matrix((values, columns.astype(np.int32), indptr), shape=(n, n))

    def _permute(self, A: scipy.sparse.csc_matrix) -> scipy.sparse.csc_matrix:
        result = A[self.order][:, self.order].tocsc()
        result.sort_indices()
        return result

    def _matrix(self, p: complex) -> scipy.sparse.csc_matrix:
        m, k = p * p - p * self.alpha, 1.0 - p * self.beta
        if not self.same:
            S = k * self.K + m * self.M
            return (S if self.D is None else S - p * self.D).tocsc()
        data = k * self.K.data + m * self.M.data
        if self.D is not None:
            data = data - p * self.D.data
        self.shells.reverse()
        self.shells[0].data = data
        return self.shells[0]

    def _factor(self, p: complex) -> scipy.sparse.linalg.SuperLU:
        S = self._matrix(p if p.imag else p.real)
        return self._decompose(p, S) if self.helper is None else self.helper.submit(self._decompose, p, S).result()

    @staticmethod
    def _decompose(p: complex, S: scipy.sparse.csc_matrix) -> scipy.sparse.linalg.SuperLU:
        try:
            return scipy.sparse.linalg.splu(S, permc_spec="NATURAL", diag_pivot_thresh=0.0, options=_SYMMETRIC)
        except RuntimeError as error:
            raise SolverError(f"the factorisation of S(p) failed at the shift p = {p:.4g} ({error})") from error

    def _prepare(self, shifts: Sequence[complex]) -> None:
        """Factor up to one shift a rank. Collective."""
        wanted = list(dict.fromkeys(shifts))[: self.comm.size]
        if self.comm.size == 1:
            lu = self._taken(wanted[0])
            self._forget()
            self.cache[wanted[0]] = (0, lu)
            self._send_ahead(shifts[1:2])
        else:
            self.cache = {p: (rank, None) for rank, p in enumerate(wanted)}
            with agree(self.comm):
                if self.comm.rank < len(wanted):
                    p = wanted[self.comm.rank]
                    self.cache[p] = (self.comm.rank, self._factor(p))
        self.factors += len(wanted)

    def _taken(self, p: complex) -> scipy.sparse.linalg.SuperLU:
        """The factor that the other core has made, or one made here."""
        stale, self.next = self.next, []
        if stale and stale[0][0] == p:
            return stale[0][1].result()
        if stale and self.helper is not None:
            wait([stale[0][1]])  # it reads a shell
            self.helper.submit(stale.clear)
        return self._factor(p)

    def _forget(self) -> None:
        """Let the factors go, in the thread that made them: SciPy frees the memory of a factor in no other."""
        old, self.cache = self.cache, {}
        if self.helper is not None:
            self.helper.submit(old.clear)

    def _send_ahead(self, shifts: Sequence[complex]) -> None:
        """Start the next factor on the other core."""
        if self.helper is not None and shifts:
            p = shifts[0]
            S = self._matrix(p if p.imag else p.real)
            self.next = [(p, self.helper.submit(self._decompose, p, S))]

    def solve(self, p: complex, F: Array | Complex, ahead: Sequence[complex] = ()) -> Complex:
        """Local rows of S(p)^{-1} F, (n_local, k); complex even where p is real. Collective.

        Args:
            p: shift; 0 gives K_ee^{-1}.
            F: local rows.
            ahead: shifts that will probably come next, for the other ranks.

        Raises:
            SolverError: a pivot vanishes.
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
        mine = self.comm.rank == owner
        whole = np.empty((int(self.counts.sum()), k), dtype=complex) if mine else None
        sizes = self.counts * k
        self.comm.Gatherv(local, None if whole is None else [whole, sizes], root=owner)
        if whole is not None and lu is not None:
            whole = np.ascontiguousarray(_lu_solve(lu, whole, self.order, real))
        result = np.empty((self.n_local, k), dtype=complex)
        self.comm.Scatterv(None if whole is None else [whole, sizes], result, root=owner)
        return result

    def destroy(self) -> None:
        """Free the factors. Not collective."""
        self._forget()
        if self.helper is not None:
            self.helper.submit(self.next.clear)
            self.helper.shutdown()


_SYMMETRIC = {"SymmetricMode": True, "Equil": False}


def _cores() -> int:
    """Cores that this process may use. Not collective."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _dissection(A: scipy.sparse.csc_matrix) -> NDArray[np.int64]:
    """Nested dissection order of a symmetric pattern. Not collective."""
    serial = PETSc.Mat().createAIJ(A.shape, csr=(A.indptr, A.indices, A.data), comm=PETSc.COMM_SELF)
    rows, columns = serial.getOrdering("nd")
    order = np.array(rows.getIndices(), dtype=np.int64)
    for item in (rows, columns, serial):
        item.destroy()
    return order


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


class DistributedTissue:
    """MUMPS on the symmetric real form of twice the order, [X, -Y; -Y, -X] for S = X + iY, unknowns interleaved.

    One matrix object for all shifts: the symbolic factorisation is made once. Collective throughout.

    Args:
        system: operators.
    """

    name = "distributed"

    def __init__(self, system: BlockSystem) -> None:
        layout = system.layout
        self.comm, self.n_local, self.n_e = layout.comm, layout.n_local, layout.n_e
        self.indptr, self.columns, self.K = system.K_ee.getValuesCSR()
        self.M = self._values(system.M_ee)
        damping = system.damping
        self.alpha, self.beta = damping.alpha, damping.beta
        self.D = None if damping.matrix is None else self._values(damping.matrix)
        self.seconds = {"factor": 0.0, "solve": 0.0}
        self.factors = 0
        self.shift: complex | None = None
        self._set_up(layout.comm)

    def _values(self, A: PETSc.Mat) -> Array:
        indptr, columns, values = A.getValuesCSR()
        with agree(self.comm):
            if not (np.array_equal(indptr, self.indptr) and np.array_equal(columns, self.columns)):
                raise SolverError("mass, stiffness and damping have different sparsity patterns; assemble them on one")
        return np.asarray(values)

    def _set_up(self, comm: MPI.Intracomm) -> None:
        n = self.n_local
        lengths = np.repeat(2 * np.diff(self.indptr), 2)
        self.real_indptr = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
        # rows 2i and 2i + 1 have the same columns: 2j and 2j + 1 for every j of row i
        pair = (2 * np.repeat(self.columns, 2).reshape(-1, 2) + [0, 1]).astype(np.int32)
        entry = np.repeat(np.arange(n), np.diff(self.indptr))
        first = self.real_indptr[2 * entry] + 2 * (np.arange(len(entry)) - self.indptr[entry])
        second = self.real_indptr[2 * entry + 1] + 2 * (np.arange(len(entry)) - self.indptr[entry])
        self.at = (first, first + 1, second, second + 1)
        self.real_columns = np.empty(int(self.real_indptr[-1]), dtype=np.int32)
        for position, column in zip(self.at, (pair[:, 0], pair[:, 1]) * 2, strict=True):
            self.real_columns[position] = column
        sizes = ((2 * n, 2 * self.n_e), (2 * n, 2 * self.n_e))
        data = self._data(0.0)
        self.S = PETSc.Mat().createAIJ(sizes, csr=(self.real_indptr, self.real_columns, data), comm=comm)
        self.S.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self.ksp = PETSc.KSP().create(comm)
        self.ksp.setOptionsPrefix(PREFIX)
        self.ksp.setOperators(self.S)
        self.ksp.setType("preonly")
        pc = self.ksp.getPC()
        pc.setType("cholesky")  # LDL' for an indefinite matrix
        pc.setFactorSolverType("mumps")
        # compressed ordering of 2 x 2 pivots: two to three times faster on these matrices than the default
        with petsc_options(PREFIX, {"mat_mumps_icntl_12": 1, "mat_mumps_icntl_14": 40}):
            self.ksp.setFromOptions()

    def _data(self, p: complex) -> Array:
        m, k = p * p - p * self.alpha, 1.0 - p * self.beta
        S = np.asarray(k * self.K + m * self.M, dtype=complex)
        if self.D is not None:
            S -= p * self.D
        data = np.empty(int(self.real_indptr[-1]))
        for position, value in zip(self.at, (S.real, -S.imag, -S.imag, -S.real), strict=True):
            data[position] = value
        return data

    def _factor(self, p: complex) -> None:
        self.S.setValuesCSR(self.real_indptr, self.real_columns, self._data(p))
        self.S.assemble()
        self.ksp.setOperators(self.S)  # without it setUp takes the old factor for good
        try:
            self.ksp.setUp()
        except PETSc.Error as error:
            raise SolverError(f"MUMPS failed at the shift p = {p:.4g} (PETSc error {error.ierr})") from error
        if self.ksp.getPC().getFailedReason():
            raise SolverError(f"MUMPS failed at the shift p = {p:.4g}: S(p) is singular or memory ran out")
        self.shift = p
        self.factors += 1

    def solve(self, p: complex, F: Array | Complex, ahead: Sequence[complex] = ()) -> Complex:
        """Local rows of S(p)^{-1} F, (n_local, k). Collective.

        Args:
            p: shift; 0 gives K_ee^{-1}.
            F: local rows.
            ahead: not used.

        Raises:
            SolverError: the factorisation fails.
        """
        p = complex(p)
        begin = time.perf_counter()
        if p != self.shift:
            self._factor(p)
        middle = time.perf_counter()
        n, k = self.n_local, F.shape[1]
        right = np.empty((2 * n, k), order="F")
        right[0::2], right[1::2] = F.real, -F.imag
        sizes = ((2 * n, 2 * self.n_e), (None, k))
        answer = np.zeros((2 * n, k), order="F")
        B = PETSc.Mat().createDense(sizes, array=right, comm=self.S.comm)
        X = PETSc.Mat().createDense(sizes, array=answer, comm=self.S.comm)
        self.ksp.getPC().getFactorMatrix().matSolve(B, X)
        result = answer[0::2] + 1j * answer[1::2]
        B.destroy()
        X.destroy()
        self.seconds["factor"] += middle - begin
        self.seconds["solve"] += time.perf_counter() - middle
        return result

    def destroy(self) -> None:
        """Free matrix and factor. Collective."""
        self.ksp.destroy()
        self.S.destroy()
