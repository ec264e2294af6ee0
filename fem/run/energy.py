"""Energy of a state for the balance: its terms cancel by the ratio of the cells' sides times that of cell to body."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.petsc import Array, PETSc, rows_on_all
from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState

ENTRIES = 1 << 20  # of a matrix that are multiplied together, for little memory


def wide_product(A: PETSc.Mat, x: Array) -> NDArray[np.longdouble]:
    """A x on this rank's rows for all rows of x, in the widest type of NumPy. Collective."""
    first, last = A.getOwnershipRange()
    most = max(1, int(A.getInfo()["nz_used"]) // ENTRIES)
    parts, result = int(A.comm.tompi4py().allreduce(most, max)), np.zeros(last - first, np.longdouble)
    every = PETSc.IS().createStride(len(x), 0, 1, comm=PETSc.COMM_SELF)
    for part in np.array_split(np.arange(last - first), parts):
        rows = PETSc.IS().createStride(len(part), first + (int(part[0]) if len(part) else 0), 1, comm=PETSc.COMM_SELF)
        (some,) = A.createSubMatrices([rows], [every])
        indptr, columns, values = some.getValuesCSR()
        if len(values):
            result[part] = np.add.reduceat(values.astype(np.longdouble) * x[columns], indptr[:-1])
        some.destroy()
        rows.destroy()
    every.destroy()
    return result


def exact_energy(midpoint: TissueMidpoint, state: TissueState) -> float:
    """Energy (z'K z + pi'M^-1 pi) / 2 [J] of the momentum that a linear step carries, s pi = h + K z - f. Collective.

    That is the energy which the rounding of w leaves alone: v = 2 s w - v_n keeps a noise e = pi - M v, and the sum is
    (z'K z - v'M v) / 2 + v'pi but for the square of e. In double precision K z would lose the digits that the entries
    of K have over those of the product.
    """
    system, n = midpoint.system, midpoint.system.layout.n_local
    z, v = state.array[:n], state.array[n:]
    pull, momentum = (
        wide_product(A, rows_on_all(system.layout.comm, x)) for A, x in ((system.K_ee, z), (system.M_ee, v))
    )
    h = midpoint.r_array[midpoint.operators.rows] + system.G.astype(np.longdouble) @ midpoint.pending
    f = 0.0 if system.own_load is None else system.own_load
    twice = z @ pull + v @ (2 / np.longdouble(midpoint.s) * (h + pull - f) - momentum)
    return float(system.layout.comm.allreduce(twice)) / 2
