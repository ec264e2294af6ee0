"""The energy of the balance against exact fractions, where cells are flat and its terms cancel."""

from __future__ import annotations

from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.sparse.linalg
from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.fem.run import energy
from softgrasp.fem.run.energy import exact_energy
from softgrasp.fem.run.simulate import Run, RunOptions
from softgrasp.fem.run.stepping import make_ts
from tests.helpers.models import gather_matrix, gather_rows, make_scene

pytestmark = pytest.mark.ranks

FLAT: dict[str, Any] = {"tissue": {"cells": [100, 2]}}  # cells 100 times as high as wide


def exact(numbers: Any) -> list[Fraction]:
    return [Fraction(float(x)) for x in numbers]


def product(A: scipy.sparse.csr_matrix, x: list[Fraction], y: list[Fraction]) -> Fraction:
    """x'A y."""
    A = A.tocoo()
    return sum((x[i] * Fraction(float(a)) * y[j] for i, j, a in zip(A.row, A.col, A.data, strict=True)), Fraction(0))


@pytest.mark.serial
def test_products_accept_indices_of_64_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a PETSc may have them, with C and without."""
    csr = scipy.sparse.random_array((30, 30), density=0.2, format="csr", rng=np.random.default_rng(2))
    csr = (csr + scipy.sparse.eye_array(30)).tocsr()
    A = SimpleNamespace(
        getLocalSize=lambda: (30, 30),
        getValuesCSR=lambda: (csr.indptr.astype(np.int64), csr.indices.astype(np.int64), csr.data),
    )
    x = np.arange(1.0, 31.0)
    for code in (energy.product_code(), None):
        monkeypatch.setattr(energy, "product_code", lambda code=code: code)
        np.testing.assert_allclose(energy.wide_product(A, x).astype(float), csr @ x, rtol=1e-14)  # sums of 30 terms


@pytest.mark.skipif(np.finfo(np.longdouble).nmant < 60, reason="NumPy has no type wider than double here")
@pytest.mark.parametrize("gravity", [False, True])
def test_energy_is_that_of_exact_fractions(comm: MPI.Intracomm, gravity: bool) -> None:
    effects = {"gravity": {"g": [1.0, -9.0]}} if gravity else {}
    run = Run(build(make_scene(FLAT, effects=effects), comm=comm), RunOptions())
    run.start()
    run.advance_to(make_ts(run), 20)
    midpoint, system, n = run.midpoint, run.model.system, run.layout.n_local
    K, M = (gather_matrix(run.layout, A) for A in (system.K_ee, system.M_ee))
    G, h = (gather_rows(run.layout, x) for x in (system.G, midpoint.r_array[midpoint.operators.rows]))
    z, v = (exact(gather_rows(run.layout, x)) for x in (run.state.array[:n], run.state.array[n:]))
    pending, s = exact(midpoint.pending), Fraction(midpoint.s)
    r = [a + sum(g * p for g, p in zip(exact(row), pending, strict=True)) for a, row in zip(exact(h), G, strict=True)]
    momentum = (sum(a * b for a, b in zip(v, r, strict=True)) + product(K, v, z)) / s
    energy = (product(K, z, z) - product(M, v, v)) / 2 + momentum
    found = exact_energy(midpoint, run.state)
    assert abs(found / float(energy) - 1) < 4e-16  # two roundings to double
    at, rest = (np.array([float(a) for a in x]) for x in (z, r))
    pi = (rest + K @ at) / midpoint.s
    double = (at @ K @ at + pi @ scipy.sparse.linalg.spsolve(M.tocsc(), pi)) / 2
    assert abs(found / double - 1) < 1e-10  # what K z loses: entries of K are 1e5 times those of the product
