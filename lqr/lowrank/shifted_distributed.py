"""S(p) with its rows on all ranks: MUMPS on the symmetric real form of twice the order."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
import scipy.sparse
from mpi4py import MPI

from softgrasp.fem.errors import SolverError, agree
from softgrasp.fem.petsc import Array, Complex, PETSc, petsc_options
from softgrasp.fem.system import BlockSystem

PREFIX = "softgrasp_shifted_"


class DistributedTissue:
    """MUMPS on the symmetric real form of twice the order, [X, -Y; -Y, -X] for S = X + iY, unknowns interleaved.

    One matrix object for all shifts: the symbolic factorisation is made once. Collective throughout.
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
        S, n = self._real_form(0.0), self.n_local
        sizes = ((2 * n, 2 * self.n_e), (2 * n, 2 * self.n_e))
        self.S = PETSc.Mat().createAIJ(sizes, csr=(S.indptr, S.indices, S.data), comm=comm)
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

    def _real_form(self, p: complex) -> scipy.sparse.csr_matrix:
        """Local rows of the real form of S(p), a block of 2 x 2 an entry."""
        m, k = p * p - p * self.alpha, 1.0 - p * self.beta
        S = np.asarray(k * self.K + m * self.M, dtype=complex)
        if self.D is not None:
            S -= p * self.D
        blocks = np.stack([S.real, -S.imag, -S.imag, -S.real], axis=-1).reshape(-1, 2, 2)
        shape = (2 * self.n_local, 2 * self.n_e)
        return scipy.sparse.bsr_matrix((blocks, self.columns, self.indptr), shape=shape).tocsr()

    def _factor(self, p: complex) -> None:
        S = self._real_form(p)
        self.S.setValuesCSR(S.indptr, S.indices, S.data)
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
        """See :class:`softgrasp.lqr.lowrank.shifted.ShiftedTissue`; nothing is made ahead. Collective.

        Raises SolverError: the factorisation or the solve fails.
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
        try:
            self.ksp.getPC().getFactorMatrix().matSolve(B, X)
        except PETSc.Error as error:
            raise SolverError(f"MUMPS failed to solve at the shift p = {p:.4g} (PETSc error {error.ierr})") from error
        finally:
            B.destroy()
            X.destroy()
        result = answer[0::2] + 1j * answer[1::2]
        self.seconds["factor"] += middle - begin
        self.seconds["solve"] += time.perf_counter() - middle
        return result

    def destroy(self) -> None:
        """Free matrix and factor. Collective."""
        self.ksp.destroy()
        self.S.destroy()
