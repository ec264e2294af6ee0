"""One tissue solve a shift: S(p) = p^2 M_ee - p D_ee + K_ee, complex symmetric, of the order n_e."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from mpi4py import MPI
from numpy.typing import NDArray

from softgrasp.fem.errors import SolverError, raise_on_all_ranks
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, Complex, PETSc, from_options, petsc_options, whole_copy
from softgrasp.fem.resources import cores
from softgrasp.fem.solve.cholesky import direct_solves, package_of
from softgrasp.fem.system import BlockSystem
from softgrasp.lqr.lowrank.ahead import FactorsAhead
from softgrasp.lqr.lowrank.memory import check_gathered_memory, check_shifted_memory

PREFIX = "softgrasp_shifted_"
WORKSPACE: dict[str, object] = {"mat_mumps_icntl_14": 40}  # percent beyond the estimate: pivots of an indefinite matrix
# Every rank factors whole matrices up to here, each rank another shift: no messages in the factorisation, and SuperLU
# in complex numbers is about as fast as MUMPS on the real form of twice the order in 2D, faster in 3D
# (docs/benchmarks.md). Beyond, a whole factor on each rank needs too much memory.
GATHER_LIMIT = {1: 150_000, 2: 150_000, 3: 40_000}  # 1: systems without a mesh
# n_e up to which SuperLU works column by column in 2D, where it is the faster way; in 3D it needs its panels
THIN_UP_TO = 20_000
AHEAD_FROM = 5_000  # n_e from which other cores, if there are, make the next factors
# Threads that do: two in 2D, where this rank would wait for one. Up to four factors are then alive at a time, too much
# memory in 3D.
THREADS = {1: 2, 2: 2, 3: 1}
Factors = dict[complex, tuple[int, scipy.sparse.linalg.SuperLU | None]]
"""By shift: the rank that has the factor, and there the factor."""
_SYMMETRIC = {"SymmetricMode": True, "Equil": False}


class ShiftedTissue(ABC):
    """Solves S(p) B = F for distributed F."""

    name: str  # gathered or distributed
    package: str = ""  # that made the last factor; where it is PETSc's, as PETSc reports it

    def __init__(self, system: BlockSystem) -> None:
        layout, self.damping = system.layout, system.damping
        self.comm, self.n_local, self.n_e = layout.comm, layout.n_local, layout.n_e
        self.seconds = {"factor": 0.0, "solve": 0.0}  # time by stage [s]
        self.factors = 0  # factorisations made by this rank's communicator

    def solve(self, p: complex, F: Array | Complex, ahead: Sequence[complex] = ()) -> Complex:
        """Local rows of S(p)^{-1} F, (n_local, k), complex even where p is real. Collective.

        Args:
            p: shift; 0 gives K_ee^{-1}.
            ahead: shifts that will probably come next.

        Raises SolverError: the factorisation or the solve fails.
        """
        return self.solve_each([complex(p)], [F], ahead)[0]

    def solve_each(
        self, shifts: Sequence[complex], rights: Sequence[Array | Complex], ahead: Sequence[complex] = ()
    ) -> list[Complex]:
        """Local rows of S(p_i)^{-1} F_i of the first shifts, of :meth:`group` at most. Collective.

        Raises SolverError: a factorisation or a solve fails.
        """
        begin = time.perf_counter()
        self._factor([*shifts, *(complex(q) for q in ahead)])
        middle = time.perf_counter()
        results = self._solve_each(shifts, rights)
        self.seconds["factor"] += middle - begin
        self.seconds["solve"] += time.perf_counter() - middle
        return results

    def group(self, shifts: Sequence[complex]) -> int:
        """How many of the first shifts are solved with at the same time."""
        return 1

    @property
    def about(self) -> str:
        """Kind of solves and who factored, in words."""
        return f"{self.name} tissue solves" + (f" by {self.package}" if self.package else "")

    @abstractmethod
    def _factor(self, shifts: list[complex]) -> None:
        """Have the factor of the first shift, made now or before. Collective."""

    @abstractmethod
    def _solve_each(self, shifts: Sequence[complex], rights: Sequence[Array | Complex]) -> list[Complex]:
        """S(p_i)^{-1} F_i with these factors. Collective."""

    @abstractmethod
    def destroy(self) -> None:
        """Free the factors. Collective."""

    def _combined(self, p: complex, K: Any, M: Any, D: Any) -> Any:
        """S(p) from the matrices or their entries; D None without a damping matrix."""
        S = (1.0 - p * self.damping.beta) * K + (p * p - p * self.damping.alpha) * M
        return S if D is None else S - p * D


class GatheredTissue(ShiftedTissue):
    """Every rank stores all rows; factors of ``comm.size`` shifts are made, and solve, at the same time, one a rank.

    SuperLU in complex numbers with diagonal pivots and one fill-reducing order (nested dissection) for all shifts. A
    program of one rank that may use another core makes the next factors there while it works with the present one.
    """

    name, package = "gathered", "SuperLU"  # of SciPy

    def __init__(self, system: BlockSystem) -> None:
        super().__init__(system)
        layout, matrix = system.layout, system.damping.matrix
        self.counts = np.array(self.comm.allgather(layout.n_local))
        parts, self.order = self._permuted([system.K_ee, system.M_ee] + ([] if matrix is None else [matrix]))
        self.K, self.M, self.D = (*parts, None)[:3]
        self.same = all(
            np.array_equal(A.indptr, self.K.indptr) and np.array_equal(A.indices, self.K.indices) for A in parts
        )
        thin = layout.dimension < 3 and layout.n_e <= THIN_UP_TO
        self.blocking = {"panel_size": 1, "relax": 16} if thin else {}
        self.cache: Factors = {}
        self.ahead: FactorsAhead | None = None
        threads = THREADS[layout.dimension]
        if makes_ahead(layout):
            self.ahead = FactorsAhead(self._make, threads)
        # one for each thread, filled anew for each shift, because making one checks its indices
        self.shells = [scipy.sparse.csc_matrix(self.K) for _ in range(1 if self.ahead is None else threads)]

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

    def _make(self, p: complex, shell: int = 0) -> scipy.sparse.linalg.SuperLU:
        """Factor of the permuted S(p); its values overwrite matrix number ``shell`` of ``self.shells``."""
        p = p if p.imag else p.real
        if self.same:
            S = self.shells[shell]
            S.data = self._combined(p, self.K.data, self.M.data, None if self.D is None else self.D.data)
        else:
            S = self._combined(p, self.K, self.M, self.D).tocsc()
        try:
            return scipy.sparse.linalg.splu(
                S, permc_spec="NATURAL", diag_pivot_thresh=0.0, options=_SYMMETRIC, **self.blocking
            )
        except RuntimeError as error:
            raise SolverError(f"the factorisation of S(p) failed at the shift p = {p:.4g} ({error})") from error

    def _factor(self, shifts: list[complex]) -> None:
        """That of the first shift, unless it is there. On one rank."""
        if shifts[0] in self.cache:
            return
        distinct = list(dict.fromkeys(shifts))
        self._forget()
        self.cache[shifts[0]] = (0, self._make(shifts[0]) if self.ahead is None else self.ahead.take(distinct))
        self.factors += 1

    def _forget(self) -> None:
        """Empty the cache; a factor is freed in the thread that made it."""
        old, self.cache = self.cache, {}
        if self.ahead is not None and old:
            (_, factor) = old.popitem()[1]
            box: list[object] = [factor]
            del factor
            self.ahead.free(box)

    def group(self, shifts: Sequence[complex]) -> int:
        """One a rank, of those that have factors if the first has one."""
        first = list(dict.fromkeys(shifts[: self.comm.size]))
        if first[0] in self.cache:
            first = [p for p in first if p in self.cache]
        return next((i for i, (p, q) in enumerate(zip(first, shifts, strict=False)) if p != q), len(first))

    def _solve_each(self, shifts: Sequence[complex], rights: Sequence[Array | Complex]) -> list[Complex]:
        """That with the one factor. On one rank."""
        ((p,), (F,)) = shifts, rights
        return [_lu_solve(self.cache[p][1], F, self.order, p.imag == 0)]

    def solve_each(
        self, shifts: Sequence[complex], rights: Sequence[Array | Complex], ahead: Sequence[complex] = ()
    ) -> list[Complex]:
        """On several ranks: rows to those that have the factors or will make them, factors and solves there, rows back.

        Ranks wait for each other once a call, after their factors and solves. See the base class. Collective.
        """
        if self.comm.size == 1:
            return super().solve_each(shifts, rights, ahead)
        begin = time.perf_counter()
        known: Factors = self.cache
        if shifts[0] not in known:  # one new factor a rank
            distinct = list(dict.fromkeys([*shifts, *map(complex, ahead)]))[: self.comm.size]
            known = {p: (rank, None) for rank, p in enumerate(distinct)}
            self.cache = {}
            self.factors += len(distinct)
        whole: dict[int, Complex] = {}
        for i, (p, F) in enumerate(zip(shifts, rights, strict=True)):
            k, owner = F.shape[1], known[p][0]
            if self.comm.rank == owner:
                whole[i] = np.empty((int(self.counts.sum()), k), dtype=complex)
            rows = [whole[i], self.counts * k] if i in whole else None
            self.comm.Gatherv(np.ascontiguousarray(F, dtype=complex), rows, root=owner)
        middle = time.perf_counter()
        factoring = 0.0
        with raise_on_all_ranks(self.comm):
            for p, (rank, factor) in known.items():
                if rank == self.comm.rank and factor is None:
                    known[p] = rank, self._make(p)
            factoring = time.perf_counter() - middle
            for i, F in whole.items():
                p = shifts[i]
                whole[i] = np.ascontiguousarray(_lu_solve(known[p][1], F, self.order, p.imag == 0))
        self.cache = known
        results = [np.empty(F.shape, dtype=complex) for F in rights]
        for i, (p, result) in enumerate(zip(shifts, results, strict=True)):
            rows = [whole[i], self.counts * result.shape[1]] if i in whole else None
            self.comm.Scatterv(rows, result, root=known[p][0])
        self.seconds["factor"] += factoring
        self.seconds["solve"] += time.perf_counter() - begin - factoring
        return results

    def destroy(self) -> None:
        """Free the factors."""
        self._forget()
        if self.ahead is not None:
            self.ahead.close()


def _lu_solve(
    lu: scipy.sparse.linalg.SuperLU | None, F: Array | Complex, order: NDArray[np.int64], real: bool
) -> Complex:
    """Solve with a factor of the permuted matrix; real factors solve real and imaginary part in turn."""
    assert lu is not None  # of another rank
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


class DistributedTissue(ShiftedTissue):
    """MUMPS on the symmetric real form of twice the order, [X, -Y; -Y, -X] for S = X + iY, unknowns interleaved.

    One matrix object for all shifts: the symbolic factorisation is made once, and nothing is made ahead.
    """

    name = "distributed"

    def __init__(self, system: BlockSystem) -> None:
        super().__init__(system)
        self.indptr, self.columns, self.K = system.K_ee.getValuesCSR()
        matrix = system.damping.matrix
        self.M, self.D = self._values(system.M_ee), None if matrix is None else self._values(matrix)
        self.shift: complex | None = None
        S, n = self._real_form(0.0), self.n_local
        self.S = PETSc.Mat().createAIJ(((2 * n, 2 * self.n_e),) * 2, csr=(S.indptr, S.indices, S.data), comm=self.comm)
        self.S.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self.ksp = PETSc.KSP().create(self.comm)
        self.ksp.setOptionsPrefix(PREFIX)
        self.ksp.setOperators(self.S)
        self.ksp.setType("preonly")
        pc = self.ksp.getPC()
        pc.setType("cholesky")  # LDL' for an indefinite matrix
        pc.setFactorSolverType("mumps")
        from_options(self.ksp)

    def _values(self, A: PETSc.Mat) -> Array:
        indptr, columns, values = A.getValuesCSR()
        with raise_on_all_ranks(self.comm):
            if not (np.array_equal(indptr, self.indptr) and np.array_equal(columns, self.columns)):
                raise SolverError("mass, stiffness and damping have different sparsity patterns; assemble them on one")
        return np.asarray(values)

    def _real_form(self, p: complex) -> scipy.sparse.csr_matrix:
        """Local rows of the real form of S(p), a block of 2 x 2 an entry."""
        S = np.asarray(self._combined(p, self.K, self.M, self.D), dtype=complex)
        blocks = np.stack([S.real, -S.imag, -S.imag, -S.real], axis=-1).reshape(-1, 2, 2)
        shape = (2 * self.n_local, 2 * self.n_e)
        return scipy.sparse.bsr_matrix((blocks, self.columns, self.indptr), shape=shape).tocsr()

    def _factor(self, shifts: list[complex]) -> None:
        p = shifts[0]
        if p == self.shift:
            return
        S = self._real_form(p)
        self.S.setValuesCSR(S.indptr, S.indices, S.data)
        self.S.assemble()
        self.ksp.setOperators(self.S)  # without it setUp considers the old factor valid
        try:
            with petsc_options(PREFIX, WORKSPACE):
                self.ksp.setUp()
        except PETSc.Error as error:
            raise SolverError(f"MUMPS failed at the shift p = {p:.4g} (PETSc error {error.ierr})") from error
        if self.ksp.getPC().getFailedReason():
            raise SolverError(f"MUMPS failed at the shift p = {p:.4g}: S(p) is singular or memory ran out")
        self.shift, self.package = p, package_of(self.ksp.getPC())
        self.factors += 1

    def _solve_each(self, shifts: Sequence[complex], rights: Sequence[Array | Complex]) -> list[Complex]:
        ((p,), (F,)) = shifts, rights
        n, k = self.n_local, F.shape[1]
        right = np.empty((2 * n, k), order="F")
        right[0::2], right[1::2] = F.real, -F.imag
        sizes = ((2 * n, 2 * self.n_e), (None, k))
        answer = np.zeros((2 * n, k), order="F")
        B, X = (PETSc.Mat().createDense(sizes, array=array, comm=self.S.comm) for array in (right, answer))
        try:
            direct_solves(self.ksp).matSolve(B, X)
        except PETSc.Error as error:
            raise SolverError(f"MUMPS failed to solve at the shift p = {p:.4g} (PETSc error {error.ierr})") from error
        finally:
            B.destroy()
            X.destroy()
        return [answer[0::2] + 1j * answer[1::2]]

    def destroy(self) -> None:
        """Free matrix and factor. Collective."""
        self.ksp.destroy()
        self.S.destroy()


def makes_ahead(layout: BlockLayout) -> bool:
    """Whether other cores make the next factors of a program of one rank."""
    return MPI.COMM_WORLD.size == 1 and layout.n_e >= AHEAD_FROM and cores() > 1


def make_shifted(system: BlockSystem, name: str = "auto") -> ShiftedTissue:
    """The solver for a size: ``gathered`` or ``distributed``. Collective.

    Raises:
        SolverError: the name is unknown.
        ResourceError: the factor would not fit in the memory that is free now.
    """
    if name == "auto":
        small = system.layout.n_e <= GATHER_LIMIT[system.layout.dimension]
        name = "gathered" if small else "distributed"
    if name == "gathered":
        check_gathered_memory(system.layout, makes_ahead(system.layout))
        return GatheredTissue(system)
    if name == "distributed":
        check_shifted_memory(system.layout)
        return DistributedTissue(system)
    raise SolverError(f"the shifted solver {name!r} is unknown; choose auto, gathered or distributed")
