"""What PETSc stores of a factor in blocks, against dense algebra."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, PETSc
from softgrasp.fem.solve.cholesky import factor_blocks
from softgrasp.fem.solve.entries import last_rows, stored


def in_blocks(A: Array, d: int) -> PETSc.Mat:
    P = PETSc.Mat().createDense(A.shape, array=np.asfortranarray(A), comm=PETSc.COMM_SELF).convert("aij")
    P.setBlockSizes(d, d)
    P.setOption(PETSc.Mat.Option.SPD, True)
    return P.convert("baij", PETSc.Mat())


@pytest.mark.parametrize("d", [2, 3])
def test_the_last_rows_of_a_factor_are_those_of_the_schur_complement(d: int) -> None:
    nodes, k = 9, 4
    S = np.zeros((nodes, d, nodes, d))
    rng = np.random.default_rng(0)
    for i, j in [*((a, a + 3) for a in range(nodes - 3)), *((a, b) for a in range(5, nodes) for b in range(a))]:
        S[i, :, j], S[j, :, i] = (block := rng.standard_normal((d, d))), block.T
    A = S.reshape(nodes * d, -1)
    A += np.diag(1 + np.abs(A).sum(axis=1))
    ksp = factor_blocks(in_blocks(A, d), "test_")
    factor, first = ksp.getPC().getFactorMatrix(), (nodes - k) * d
    assert factor.getType() == "seqsbaij"
    found = last_rows(factor, k)
    assert found is not None
    U, D = found
    schur = A[first:, first:] - A[first:, :first] @ np.linalg.solve(A[:first, :first], A[:first, first:])
    assert np.abs(U.T @ D @ U - schur).max() < 1e-13 * np.abs(A).max()  # rounding of 40 sums
    blocks = U.reshape(k, d, k, d).transpose(0, 2, 1, 3)
    assert all(np.array_equal(blocks[i, j], np.eye(d) * (i == j)) for i in range(k) for j in range(i + 1))
    inverse = stored(factor, 1)
    assert inverse is not None
    assert np.abs(inverse[0] @ A[:d, :d] - np.eye(d)).max() < 1e-14  # one block
    ksp.destroy()


@pytest.mark.parametrize("entries", ["petsc", "mumps"])
@pytest.mark.parametrize("d", [1, 2, 3])
def test_a_matrix_is_refused_where_one_eigenvalue_is_negative(d: int, entries: Any) -> None:
    """Wherever in the order of elimination the negative pivot comes."""
    rng = np.random.default_rng(d)
    for negative in [*range(4), 0] * 3:
        B = rng.standard_normal((6 * d, 6 * d))
        values, vectors = np.linalg.eigh(B + B.T)
        shift = values[0] - 1.0 if negative == 0 else values[negative - 1 : negative + 1].mean()
        A = (vectors * (values - shift)) @ vectors.T
        A = (A + A.T) / 2
        assert np.sum(np.linalg.eigvalsh(A) < 0) == negative
        if negative:
            with pytest.raises(SolverError, match="not definite"):
                factor_blocks(in_blocks(A, d), "test_", entries)
        else:
            factor_blocks(in_blocks(A, d), "test_", entries).destroy()
