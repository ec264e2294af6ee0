"""Products of a distributed matrix with many columns: SciPy's product of the local rows, one message for each rank."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mpi4py import MPI
    from petsc4py import PETSc


class DistributedRows:
    """A X with a copy of this rank's rows of A: rows of X travel while each rank multiplies with its own. Collective.

    Attributes:
        own: entries in the columns of this rank, (n_local, m_local).
        other: entries in those of other ranks, (k, ghosts), in the k rows that have any.
        sent: local rows of X that other ranks need, by rank.
    """

    def __init__(self, A: PETSc.Mat) -> None:
        self.comm: MPI.Intracomm = A.comm.tompi4py()
        (first, last), ranges = A.getOwnershipRangeColumn(), A.getOwnershipRangesColumn()
        indptr, columns, values = A.getValuesCSR()
        rows = scipy.sparse.csr_matrix((values, columns, indptr), shape=(A.getLocalSize()[0], A.getSize()[1]))
        self.own = rows[:, first:last]
        ghosts = np.unique(columns[(columns < first) | (columns >= last)])
        other = rows[:, ghosts]
        self.rows = np.flatnonzero(np.diff(other.indptr))
        self.other = other[self.rows]
        self.coming = np.bincount(np.searchsorted(ranges, ghosts, side="right") - 1, minlength=self.comm.size)
        self.going = np.empty_like(self.coming)
        self.comm.Alltoall(self.coming, self.going)
        self.sent = np.empty(int(self.going.sum()), dtype=ghosts.dtype)
        self.comm.Alltoallv([ghosts, self.coming], [self.sent, self.going])
        self.sent -= first

    def times(self, X: NDArray[np.float64]) -> NDArray[np.float64]:
        """Local rows of A X, (n_local, k), for local rows of X, (m_local, k). Collective."""
        k = X.shape[1]
        found = np.empty((int(self.coming.sum()), k))
        messages = self.comm.Ialltoallv([np.ascontiguousarray(X[self.sent]), self.going * k], [found, self.coming * k])
        result = np.asarray(self.own @ X)
        messages.Wait()
        result[self.rows] += self.other @ found
        return result
