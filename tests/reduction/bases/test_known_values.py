"""The engines of a basis on a matrix whose singular values are known over sixteen decades."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray

from softgrasp.fem.petsc import Array
from softgrasp.reduction.bases.engines import ENGINES, EngineName, factor, small_svd
from tests.helpers.models import same_everywhere

CHUNK = 2_000  # rows in extended precision at a time
DECADES = 16  # of singular values, evenly spread


def spectrum_of(m: int) -> Array:
    """Singular values from 1 to 10^-DECADES."""
    return 10.0 ** (-DECADES * np.arange(m) / (m - 1))


def known_matrix(comm: MPI.Intracomm, n: int, m: int, complex_valued: bool) -> NDArray[Any]:
    """U diag(sigma) C^H with known sigma: U are cosines, orthonormal on n points, C mixes all columns. F order.

    It is made in extended precision and rounded once: a product in double precision alone would change
    sigma = 1e-10 in its eighth digit. Every rank makes its own rows.
    """
    start, stop = n * comm.rank // comm.size, n * (comm.rank + 1) // comm.size
    X = np.empty((stop - start, m), dtype=complex if complex_valued else float, order="F")
    j, wide = np.arange(1, m + 1), np.longdouble
    turn = 2 * np.arccos(wide(-1)) / (4 * n)
    sigma = wide(10) ** (-DECADES * np.arange(m, dtype=wide) / (m - 1))
    for first in range(start, stop, CHUNK):
        i = np.arange(first, min(first + CHUNK, stop))[:, None]
        # whole turns go first, in integers
        rows = np.sqrt(wide(2) / n) * np.cos(turn * ((2 * i + 1) * j % (4 * n)).astype(wide)) * sigma
        real, imaginary = rows, np.zeros_like(rows)
        random = np.random.default_rng(0)
        for _ in range(3):  # reflections I - 2 w w^H
            a, b = random.standard_normal((2, m)).astype(wide)
            b = b if complex_valued else np.zeros_like(b)
            factor_2 = 2 / (np.sum(a * a) + np.sum(b * b))
            x = (factor_2 * (real * a - imaginary * b).sum(axis=1))[:, None]
            y = (factor_2 * (real * b + imaginary * a).sum(axis=1))[:, None]
            real, imaginary = real - (x * a + y * b), imaginary - (y * a - x * b)
        X[first - start : first - start + len(i)] = real + 1j * imaginary if complex_valued else real
    return X


def right_down_to(sigma: Array, true: Array, tolerance: float) -> float:
    """Smallest sigma / sigma_1 down to which all values are right to a relative tolerance."""
    k = min(len(sigma), len(true))
    wrong = np.abs(sigma[:k] / true[:k] - 1) > tolerance
    count = int(np.argmax(wrong)) if wrong.any() else k
    return float(true[count - 1] / true[0]) if count else float("inf")


@pytest.mark.ranks
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("complex_valued", [False, True])
def test_singular_values_are_right_down_to_the_stated_limit(
    comm: MPI.Intracomm, engine: EngineName, complex_valued: bool
) -> None:
    n, m = 3000, 150
    X = known_matrix(comm, n, m, complex_valued)
    f = factor(comm, np.asfortranarray(np.hstack([X.real, X.imag])) if complex_valued else X, engine)
    s = small_svd(comm, f.R[:, :m] + 1j * f.R[:, m:] if complex_valued else f.R)[1] * f.scale
    limit = 1e-6 if engine == "gram" else 1e-9  # the 1e-10 at its 600 columns: see the next test
    assert right_down_to(s, spectrum_of(m), 1e-8) <= limit  # 8 digits
    assert same_everywhere(comm, s)


def test_default_is_right_to_1e_8_down_to_1e_10(comm: MPI.Intracomm) -> None:
    X = known_matrix(comm, 6000, 400, False)
    f = factor(comm, X)
    assert right_down_to(f.scale * small_svd(comm, f.R)[1], spectrum_of(400), 1e-8) <= 1e-10  # the numbers
