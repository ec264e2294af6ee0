"""The sweeps of a factor against dense solves."""

from __future__ import annotations

import numpy as np
import pytest

from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import petsc_options, to_scipy
from softgrasp.fem.run.midpoint import TissueMidpoint
from softgrasp.fem.solve.sweeps import sweeps_of

SIZES = [("set_down", "tissue.cells=[7, 5]"), ("set_down_3d", "tissue.cells=[3, 3, 3]")]


@pytest.mark.serial
@pytest.mark.parametrize(("scene", "cells"), SIZES)
def test_rows_of_a_solution_are_known_after_the_first_sweep(scene: str, cells: str) -> None:
    model, rng = build(scene, [cells, "tissue.order=1"]), np.random.default_rng(5)
    midpoint, d = TissueMidpoint(model.system, 1e-3, "cholesky"), model.system.layout.dimension
    sweeps, S = sweeps_of(midpoint.solver, d), to_scipy(midpoint.solver.S).toarray()
    assert sweeps is not None
    n = len(S)

    def first(r: np.ndarray) -> np.ndarray:
        midpoint.r.array_w[:] = r
        sweeps.forward(midpoint.r, midpoint.w)
        return midpoint.w.array_r.copy()

    r, forces = rng.standard_normal(n), np.eye(n)[:, rng.permutation(n)[:6]]
    y, columns = first(r), np.column_stack([first(force) for force in forces.T])
    D = np.einsum("kab,kbj->kaj", sweeps.D, columns.reshape(n // d, d, -1)).reshape(n, -1)
    inverse = np.linalg.inv(S)
    scale = 1e-12 * np.abs(inverse).max()  # rounding of either, times the condition of S
    np.testing.assert_allclose(D.T @ y, forces.T @ inverse @ r, rtol=0, atol=scale * np.abs(r).sum())
    np.testing.assert_allclose(D.T @ columns, forces.T @ inverse @ forces, rtol=0, atol=scale)
    midpoint.w.array_w[:] = y + columns @ np.arange(6.0)
    sweeps.backward(midpoint.w, midpoint.r)
    expected = inverse @ (r + forces @ np.arange(6.0))
    np.testing.assert_allclose(midpoint.r.array_r, expected, rtol=0, atol=scale * (np.abs(r).sum() + 15))
    assert np.count_nonzero(columns) < columns.size / 2  # ancestors alone
    midpoint.destroy()


@pytest.mark.serial
def test_other_factors_have_no_sweeps() -> None:
    model = build("set_down", ["tissue.cells=[4, 4]"])
    midpoint = TissueMidpoint(model.system, 1e-3, "mumps")
    assert sweeps_of(midpoint.solver, 2) is None
    midpoint.destroy()
    with petsc_options("softgrasp_midpoint_", {"ksp_rtol": 1e-9}):
        midpoint = TissueMidpoint(model.system, 1e-3, "cholesky")
        assert sweeps_of(midpoint.solver, 2) is None
        midpoint.destroy()
