"""Energy of a state for the balance: its terms cancel by the ratio of the cells' sides times that of cell to body."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.compiled import address
from softgrasp.fem.petsc import Array, PETSc, rows_on_all
from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState
from softgrasp.fem.solve.differences import product_code

ENTRIES = 1 << 20  # of a matrix that NumPy multiplies together, for little memory


def wide_product(A: PETSc.Mat, x: Array) -> NDArray[np.longdouble]:
    """A x on this rank's rows for all rows of x, in the widest type of NumPy."""
    result, code = np.zeros(A.getLocalSize()[0], np.longdouble), product_code()
    if not x.any():
        return result
    first, columns, values = A.getValuesCSR()
    if code is not None:
        first, columns = (
            numbers.astype(np.intc, copy=False) for numbers in (first, columns)
        )  # PETSc's may have 64 bits
        code.softgrasp_wide(len(result), *map(address, (first, columns, values, x, result)))
        return result
    every = np.append(np.arange(0, len(values), ENTRIES), len(values))
    ends = np.unique(np.searchsorted(first, every))
    for begin, end in itertools.pairwise(ends):
        some = slice(first[begin], first[end])
        terms = values[some].astype(np.longdouble) * x[columns[some]]
        result[begin:end] = np.add.reduceat(terms, first[begin:end] - first[begin])
    return result


def wide_pull(midpoint: TissueMidpoint, state: TissueState) -> tuple[NDArray[np.longdouble], NDArray[np.longdouble]]:
    """Both words of z, and K z, on the owned rows in the widest type of NumPy. Collective."""
    system, n = midpoint.system, midpoint.system.layout.n_local
    low, y = state.z.duplicate(), state.z.duplicate()
    low.array_w[:] = midpoint.low.array_r[midpoint.operators.rows]
    system.K_ee.mult(low, y)
    z = state.array[:n].astype(np.longdouble) + low.array_r
    pull = wide_product(system.K_ee, rows_on_all(system.layout.comm, state.array[:n])) + y.array_r
    for vector in (low, y):
        vector.destroy()
    return z, pull


def exact_energy(midpoint: TissueMidpoint, state: TissueState) -> float:
    """Energy (z'K z + pi'M^-1 pi) / 2 [J] of the momentum that a linear step carries, s pi = h + K z - f. Collective.

    That is the energy which the rounding of w leaves alone: v = 2 s w - v_n keeps a noise e = pi - M v, and the sum is
    (z'K z - v'M v) / 2 + v'pi but for the square of e. In double precision K z would lose the digits that the entries
    of K have over those of the product.
    """
    system, n = midpoint.system, midpoint.system.layout.n_local
    v = state.array[n:]
    z, pull = wide_pull(midpoint, state)
    momentum = wide_product(system.M_ee, rows_on_all(system.layout.comm, v))
    h = midpoint.r_array[midpoint.operators.rows] + system.G.astype(np.longdouble) @ midpoint.pending
    f = 0.0 if system.own_load is None else system.own_load
    twice = z @ pull + v @ (2 / np.longdouble(midpoint.s) * (h + pull - f) - momentum)
    return float(system.layout.comm.allreduce(twice)) / 2
