"""The symmetric part of a matrix in blocks of nodes, (A + A') / 2, with the same bits on both sides of the diagonal.

Rounding in the sums over points and cells differs between A_ij and A_ji. Where the entries of K are large against those
of K z, as near nu = 0.5, the part that is not symmetric would do work on the tissue in every step.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse
from mpi4py import MPI
from numpy.typing import NDArray

from softgrasp.fem.petsc import Array, to_ranks

Ints = NDArray[np.int64]


def symmetric_part(comm: MPI.Intracomm, first: int, indptr: NDArray[Any], columns: Ints, blocks: Array) -> Array:
    """Blocks of (A + A') / 2 for the rows of A from ``first`` on, (blocks, d, d). Collective.

    Args:
        indptr: block with which each row begins, (rows + 1,).
        columns: number of the column of each block among all; the pattern is symmetric, with no pair twice.
        blocks: of A, (blocks, d, d).
    """
    n, result = len(indptr) - 1, blocks.copy()
    row = np.repeat(np.arange(n), np.diff(indptr))
    mine = np.flatnonzero((columns >= first) & (columns < first + n))
    # places by row and column, and by column and row: that of A_ij and that of A_ji stand at the same position
    places = scipy.sparse.csr_matrix((mine, (row[mine], columns[mine] - first)), shape=(n, n))
    places.sort_indices()
    result[places.data] += blocks[places.tocsc().data].transpose(0, 2, 1)
    if comm.size > 1:
        other, starts = np.setdiff1d(np.arange(len(columns)), mine), np.array(comm.allgather(first))
        bits = blocks[other].reshape(len(other), blocks.shape[1] * blocks.shape[2]).view(np.int64)
        numbers = np.column_stack([row[other] + first, columns[other], bits])
        owner = np.searchsorted(starts, columns[other], side="right") - 1
        found = to_ranks(comm, owner, numbers)
        found = found[np.lexsort((found[:, 0], found[:, 1]))]
        other = other[np.lexsort((columns[other], row[other]))]
        result[other] += found[:, 2:].copy().view(np.float64).reshape(blocks[other].shape).transpose(0, 2, 1)
    result /= 2
    return result
