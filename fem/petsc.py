"""The few PETSc helpers that every package shares (no DOLFINx here)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import scipy.sparse
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc as PETSc

from softgrasp.fem import _stack as _stack

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
SAME = PETSc.Mat.Structure.SAME_NONZERO_PATTERN
MANY_COLUMNS = 8  # below, setting up a product of matrices costs more than it saves
BLOCK_ENTRIES = 32_768  # about so many of a block of columns


@contextmanager
def petsc_options(prefix: str, entries: dict[str, object]) -> Iterator[None]:
    """Set prefixed options for a ``setFromOptions`` call and remove them again: the database is global."""
    database = PETSc.Options(prefix)
    for key, value in entries.items():
        database[key] = value
    try:
        yield
    finally:
        for key in entries:
            database.delValue(key)


def total(comm: MPI.Intracomm, local: Array) -> Array:
    """Sum of a small array over the ranks. Collective."""
    local = np.ascontiguousarray(local, dtype=np.float64)
    if comm.size == 1:
        return local.copy()
    result = np.empty_like(local)
    comm.Allreduce(local, result)
    return result


def rows_on_all(comm: MPI.Intracomm, local: NDArray[Any]) -> NDArray[Any]:
    """Rows of all ranks, in their order, on every rank. Collective."""
    local = np.ascontiguousarray(local)
    rows = comm.allgather(len(local))
    result = np.empty((sum(rows), *local.shape[1:]), dtype=local.dtype)
    comm.Allgatherv(local, [result, np.multiply(rows, math.prod(local.shape[1:]))])
    return result


def rows_on_root(comm: MPI.Intracomm, local: NDArray[Any]) -> NDArray[Any] | None:
    """Rows of all ranks, in their order, on rank 0; None elsewhere. Collective."""
    local = np.ascontiguousarray(local)
    rows = comm.gather(len(local))
    if rows is None:
        comm.Gatherv(local, None)
        return None
    result = np.empty((sum(rows), *local.shape[1:]), dtype=local.dtype)
    comm.Gatherv(local, [result, np.multiply(rows, math.prod(local.shape[1:]))])
    return result


def whole_copy(A: PETSc.Mat) -> PETSc.Mat:
    """All rows of a distributed matrix, on every rank. Collective."""
    every = PETSc.IS().createStride(A.getSize()[0], 0, 1, comm=PETSc.COMM_SELF)
    every.setBlockSize(A.getBlockSize())
    (copy,) = A.createSubMatrices([every], [every])
    copy.setBlockSize(A.getBlockSize())
    copy.setOption(PETSc.Mat.Option.SPD, bool(A.isSymmetricKnown()[1]))
    every.destroy()
    return copy


def to_scipy(A: PETSc.Mat) -> Any:
    """This rank's rows of a matrix as SciPy's CSR, (n_local, n); a copy."""
    indptr, columns, values = A.getValuesCSR()
    return scipy.sparse.csr_matrix((values, columns, indptr), shape=(A.getLocalSize()[0], A.getSize()[1]))


def combine(terms: list[tuple[float, PETSc.Mat]]) -> PETSc.Mat:
    """Return sum_i a_i A_i for matrices of one pattern, as a new matrix. Collective."""
    factor, first = terms[0]
    result = first.copy()
    result.scale(factor)
    for factor, term in terms[1:]:
        result.axpy(factor, term, SAME)
    return result


def times_columns(A: PETSc.Mat, X: Array) -> Array:
    """Return the local rows of A X for dense columns, shape (n_local, k), Fortran order. Collective."""
    fewest = np.diff(A.getOwnershipRanges()).min()  # rows of a rank; PETSc's product crashes on one without any
    if X.shape[1] >= MANY_COLUMNS and fewest > 0 and A.getType() != PETSc.Mat.Type.PYTHON:
        return _times_dense(A, X)
    x, y = A.createVecs()
    result = np.empty((y.getLocalSize(), X.shape[1]), order="F")
    for j in range(X.shape[1]):
        x.array_w[:] = X[:, j]
        A.mult(x, y)
        result[:, j] = y.array_r
    x.destroy()
    y.destroy()
    return result


def _times_dense(A: PETSc.Mat, X: Array) -> Array:
    """The same by PETSc's product with a dense matrix, which reads A once for several columns. Collective.

    On one rank in blocks that the C library need not ask the system for: half the time of all columns at once (n = 3718
    and 14638, 30 to 120 columns), and as fast as SciPy's product. On more ranks every block costs messages.
    """
    (rows, n), k = A.getSizes()[0], X.shape[1]
    width = max(MANY_COLUMNS, BLOCK_ENTRIES // max(n, 1)) if A.comm.size == 1 else k
    result = np.empty((rows, k), order="F")
    for first in range(0, k, width):
        part = np.asfortranarray(X[:, first : first + width])
        sizes = (A.getSizes()[1], (None, part.shape[1]))
        dense = PETSc.Mat().createDense(sizes, array=part, comm=A.comm)
        product = A.matMult(dense)
        result[:, first : first + width] = product.getDenseArray(readonly=True)
        product.destroy()
        dense.destroy()
    return result


def on_root[R](comm: MPI.Intracomm, call: Callable[[], R]) -> R:
    """Run small dense work on rank 0 and broadcast what it returns or raises. Collective."""
    answer: tuple[Any, Exception | None] = (None, None)
    if comm.rank == 0:
        try:
            answer = (call(), None)
        except Exception as error:
            answer = (None, error)
    result, failure = comm.bcast(answer) if comm.size > 1 else answer
    if failure is not None:
        raise failure
    value: R = result
    return value
