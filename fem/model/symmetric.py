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


class Mirror:
    """Where A_ji stands for each A_ij of a symmetric pattern of blocks, which several matrices share."""

    def __init__(self, comm: MPI.Intracomm, first: int, indptr: NDArray[Any], columns: Ints) -> None:
        """Look for them. Collective.

        Args:
            comm: ranks that the rows are divided between.
            first: number of this rank's first row.
            indptr: block with which each row begins, (rows + 1,).
            columns: number of the column of each block among all; no pair is there twice.
        """
        n, row = len(indptr) - 1, np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
        own = (columns >= first) & (columns < first + n)
        mine = np.flatnonzero(own)
        # places by row and column, and by column and row: that of A_ij and that of A_ji stand at the same position
        places = scipy.sparse.csr_matrix((mine, (row[mine], columns[mine] - first)), shape=(n, n))
        places.sort_indices()
        self.place = np.arange(len(columns))
        self.place[places.data] = places.tocsc().data
        self.comm = comm
        if comm.size > 1:
            self.other = np.flatnonzero(~own)
            self.pairs = np.column_stack([row[self.other] + first, columns[self.other]])
            self.owner = np.searchsorted(np.array(comm.allgather(first)), self.pairs[:, 1], side="right") - 1

    def symmetric_part(self, blocks: Array) -> Array:
        """Blocks of (A + A') / 2 for this rank's rows from those of A, (blocks, d, d). Collective."""
        result = blocks + blocks[self.place].transpose(0, 2, 1)
        if self.comm.size > 1:
            theirs = blocks[self.other]
            bits = theirs.reshape(len(theirs), blocks.shape[1] * blocks.shape[2]).view(np.int64)
            found = to_ranks(self.comm, self.owner, np.column_stack([self.pairs, bits]))
            found = found[np.lexsort((found[:, 0], found[:, 1]))]
            other = self.other[np.lexsort((self.pairs[:, 1], self.pairs[:, 0]))]
            theirs = found[:, 2:].copy().view(np.float64).reshape(theirs.shape)
            result[other] = blocks[other] + theirs.transpose(0, 2, 1)
        result /= 2
        return result
