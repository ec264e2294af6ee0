"""The numbers that PETSc stores of a factor in symmetric blocks of d x d, by a call that petsc4py leaves out.

With S = U'D U, U with ones on its diagonal: first D^-1, one block a node, then the blocks of -U above the diagonal, row
by row, those of a row in the order of its columns; each block by columns.
"""

from __future__ import annotations

import ctypes

import numpy as np

from softgrasp.fem.petsc import Array, PETSc


def stored(factor: PETSc.Mat, blocks: int) -> Array | None:
    """The first blocks x d x d entries, a view of the factor's memory; None without access to them."""
    try:
        get = ctypes.CDLL(PETSc.__file__).MatSeqSBAIJGetArray
    except (OSError, AttributeError):
        return None
    entries, d = ctypes.POINTER(ctypes.c_double)(), factor.getBlockSize()
    if PETSc.ScalarType != np.float64 or get(ctypes.c_void_p(factor.handle), ctypes.byref(entries)):
        return None
    return np.ctypeslib.as_array(entries, (blocks, d, d))


def definite(factor: PETSc.Mat) -> bool:
    """Whether no pivot of Cholesky is negative, as where S > 0 (Sylvester); True where PETSc does not show them."""
    if factor.getType() == "mumps":
        return bool(factor.getMumpsInfog(12) == 0)
    if factor.getType() != "seqsbaij":
        return True
    if (d := factor.getBlockSize()) == 1:
        return bool(factor.getInertia()[0] == 0)
    inverse = stored(factor, factor.getSize()[0] // d)
    try:
        return inverse is None or np.linalg.cholesky(inverse) is not None
    except np.linalg.LinAlgError:
        return False


def last_rows(factor: PETSc.Mat, k: int) -> tuple[Array, Array] | None:
    """U and D of the last k nodes, dense, (k d, k d); None without access to them.

    Each of these rows has to have an entry in all columns behind its own.
    """
    d, above = factor.getBlockSize(), k * (k - 1) // 2
    nodes, used = factor.getSize()[0] // d, round(factor.getInfo()["nz_used"]) // d**2
    blocks = stored(factor, used)
    if blocks is None:
        return None
    U, D = np.zeros((k, k, d, d)), np.zeros((k, k, d, d))
    at = np.arange(k)
    U[at, at] = np.eye(d)
    U[np.triu_indices(k, 1)] = -blocks[used - above :].transpose(0, 2, 1)
    D[at, at] = np.linalg.inv(blocks[nodes - k : nodes])
    whole = (k * d, k * d)
    return U.transpose(0, 2, 1, 3).reshape(whole), D.transpose(0, 2, 1, 3).reshape(whole)
