"""The few PETSc helpers that every package shares (no DOLFINx here)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc as PETSc

from softgrasp.fem import _stack as _stack
from softgrasp.fem.errors import meet
from softgrasp.fem.rows import DistributedRows

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
SAME = PETSc.Mat.Structure.SAME_NONZERO_PATTERN
FEW_COLUMNS = 2  # up to so many columns setting up a product of matrices needs more time than it saves
BLOCK_COLUMNS = 8  # least number of columns of a block
FEW_ENTRIES = 524_288  # up to so many entries of eight columns and more SciPy's product is the faster one
MANY_COLUMNS = 12  # from so many on the product with a copy of the local rows is the faster one on several ranks
COPIED_ENTRIES = 16_777_216  # of a matrix, for each rank, of which products on several ranks keep a copy (200 MB)
BLOCK_ENTRIES = 131_072  # approximate number of entries of a block, whose memory the C library keeps for reuse


@contextmanager
def petsc_options(prefix: str, entries: dict[str, object]) -> Iterator[None]:
    """Set prefixed options but those of the user, and remove them again: the database is global.

    A factor reads its options at its set-up, which therefore has to be inside the block.
    """
    database = PETSc.Options(prefix)
    ours = {key: value for key, value in entries.items() if not database.hasName(key)}
    for key, value in ours.items():
        database[key] = value
    try:
        yield
    finally:
        for key in ours:
            database.delValue(key)


def user_options(prefix: str = "softgrasp_") -> list[str]:
    """Names of the PETSc options that the user gave for a prefix, without the leading dash."""
    return [name for name in PETSc.Options().getAll() if name.startswith(prefix)]


def from_options(solver: Any) -> None:
    """Apply the user's options for the prefix of a solver (KSP, EPS, SVD) over ours, if there are any. Collective."""
    if user_options(solver.getOptionsPrefix()):
        solver.setFromOptions()


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
    rows, result, target = comm.gather(len(local)), None, None
    if rows is not None:
        result = np.empty((sum(rows), *local.shape[1:]), dtype=local.dtype)
        target = [result, np.multiply(rows, math.prod(local.shape[1:]))]
    comm.Gatherv(local, target)
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
    """Return sum_i a_i A_i for matrices of one pattern, a new matrix, symmetric in its bits if all are. Collective."""
    factor, first = terms[0]
    result = first.copy()
    result.scale(factor)
    for factor, term in terms[1:]:
        scaled = term.copy()
        scaled.scale(factor)  # a y + x in one call is rounded once or twice, by the place of an entry in its array
        result.axpy(1.0, scaled, SAME)
        scaled.destroy()
    return result


def times_columns(A: PETSc.Mat, X: Array) -> Array:
    """A X for local rows of dense columns, (n_local, k), in the storage of the faster way. Collective.

    On one rank X stored by rows, or of eight columns and more with few entries, goes by SciPy's product, for which the
    matrix keeps a copy, and other X by PETSc's in blocks. On more ranks X of :data:`MANY_COLUMNS` goes by SciPy's
    product with a copy of the local rows, where they have at most :data:`COPIED_ENTRIES`, other X by PETSc's. One or
    two columns go by the product with vectors, as do all where a rank has no rows, on which PETSc's product crashes.
    Times of the ways: docs/benchmarks.md.
    """
    k, serial, entries = X.shape[1], A.comm.size == 1, A.getType() != PETSc.Mat.Type.PYTHON
    few = k >= BLOCK_COLUMNS and X.size <= FEW_ENTRIES
    if serial and entries and k > 1 and (few or not X.flags.f_contiguous):
        return np.asarray(_kept(A, to_scipy) @ X)
    if not serial and entries and k >= MANY_COLUMNS and (rows := _kept(A, _distributed_rows)) is not None:
        return rows.times(X)
    result = np.empty((A.getLocalSize()[0], k), order="F")
    if entries and k > FEW_COLUMNS and np.diff(A.getOwnershipRanges()).min() > 0:
        _by_blocks(A, X, result, max(1, min(X.size // BLOCK_ENTRIES, k // BLOCK_COLUMNS)) if serial else 1)
    else:
        _by_vectors(A, X, result)
    return result


def _kept[Rows](A: PETSc.Mat, make: Callable[[PETSc.Mat], Rows]) -> Rows:
    """What serves products with a matrix, kept with it until its entries change. Collective."""
    kept: Any = A.getAttr("rows")
    if kept is None or kept[0] != A.stateGet():
        kept = (A.stateGet(), make(A))
        A.setAttr("rows", kept)
    rows: Rows = kept[1]
    return rows


def _distributed_rows(A: PETSc.Mat) -> DistributedRows | None:
    """Rows for products on several ranks; None where a copy of them needs too much memory. Collective."""
    return DistributedRows(A) if A.getInfo()["nz_used"] <= COPIED_ENTRIES * A.comm.size else None


def _by_vectors(A: PETSc.Mat, X: Array, result: Array) -> None:
    """A X column by column. Collective."""
    x, y = A.createVecs()
    for j in range(X.shape[1]):
        x.array_w[:] = X[:, j]
        A.mult(x, y)
        result[:, j] = y.array_r
    x.destroy()
    y.destroy()


def _by_blocks(A: PETSc.Mat, X: Array, result: Array, blocks: int) -> None:
    """A X by PETSc's product with a dense matrix, which reads A once for several columns. Collective."""
    width = -(-X.shape[1] // blocks)
    for first in range(0, X.shape[1], width):
        part = np.asfortranarray(X[:, first : first + width])
        dense = PETSc.Mat().createDense((A.getSizes()[1], (None, part.shape[1])), array=part, comm=A.comm)
        product = A.matMult(dense)
        result[:, first : first + width] = product.getDenseArray(readonly=True)
        product.destroy()
        dense.destroy()


def normalising(gram: Array, share: float, least: float = 0.0) -> Array:
    """S with S'gram S = I on the eigenvectors of gram above ``least`` and a share of the largest eigenvalue."""
    sizes, vectors = np.linalg.eigh((gram + gram.T) / 2)
    keep = sizes > max(least, share * float(sizes.max(initial=0.0)))
    return np.asarray(vectors[:, keep] / np.sqrt(sizes[keep]))


def driven_by_root(
    comm: MPI.Intracomm, call: Callable[[Array], Array], method: Callable[[Callable[[Array], Array]], Array]
) -> Array:
    """Result of ``method(call)``, a method that runs on rank 0 alone and whose calls run on every rank. Collective.

    Raises Exception: of the method, or of ``call``, which must raise it on all ranks alike.
    """

    def lead() -> Array:
        try:
            return method(lambda x: call(np.array(comm.bcast(x))))  # a copy: the method may write into its own later
        finally:
            comm.bcast(None)

    while comm.rank > 0 and (x := comm.bcast(None)) is not None:
        with suppress(Exception):  # rank 0 reports it to all
            call(x)
    return on_root(comm, lead)


def folded[R](comm: MPI.Intracomm, make: Callable[[], R], fold: Callable[[R, R], R]) -> R:
    """Parts that ranks make, folded two at a time in a tree, in the order of the ranks; right on rank 0. Collective.

    Raises Exception: what making or folding raises on one rank, on every rank.
    """
    part: Any
    part, failure = _tried(make)
    step = 1
    while step < comm.size:
        place = comm.rank % (2 * step)
        if place == step:
            comm.send((part, failure), comm.rank - step)
        elif place == 0 and comm.rank + step < comm.size:
            other, later = comm.recv(source=comm.rank + step)
            failure = failure or later
            if failure is None:
                part, failure = _tried(partial(fold, part, other))
        step *= 2
    meet(comm)
    failure = comm.bcast(failure)
    if failure is not None:
        raise failure
    result: R = part
    return result


def _tried(call: Callable[[], Any]) -> tuple[Any, Exception | None]:
    """What a call returns, and what it raises."""
    try:
        return call(), None
    except Exception as error:
        return None, error


def on_root[R](comm: MPI.Intracomm, call: Callable[[], R]) -> R:
    """Run small dense work on rank 0 and broadcast what it returns or raises. Collective."""
    value: Any
    answer = _tried(call) if comm.rank == 0 else (None, None)
    meet(comm)
    value, failure = comm.bcast(answer) if comm.size > 1 else answer
    if failure is not None:
        raise failure
    result: R = value
    return result


def to_ranks(comm: MPI.Intracomm, rank: NDArray[Any], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Send row i of ``rows`` (k, ...) to rank ``rank[i]``; return the rows sent here, by sender. Collective."""
    width = int(np.prod(rows.shape[1:]))
    counts = width * np.bincount(rank, minlength=comm.size).astype(np.int64)
    coming = np.empty_like(counts)
    comm.Alltoall(counts, coming)
    found = np.empty((int(coming.sum()) // width, *rows.shape[1:]), dtype=np.int64)
    sent = np.ascontiguousarray(rows[np.argsort(rank, kind="stable")])
    comm.Alltoallv([sent, counts], [found, coming])
    return found
