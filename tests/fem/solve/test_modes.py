"""Modes by LOBPCG where no factor fits, against those by a factor."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.errors import SolverError
from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import times_columns, total
from softgrasp.fem.solve.modes import _finish, lowest_modes
from softgrasp.fem.solve.solvers import SolverName
from softgrasp.fem.solve.stiffness import factored_stiffness

SQUARE = ["tissue.refine=false", "contact.sides=['top']", "tissue.cells=[2,2,4]"]  # bending in x and y are alike


@pytest.mark.parametrize(
    ("order", "name"),
    [pytest.param(1, "cg", marks=pytest.mark.ranks), pytest.param(2, "stars", marks=pytest.mark.serial)],
)
def test_modes_without_a_factor(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch, order: int, name: SolverName
) -> None:
    system = build("block_3d", [*SQUARE, f"tissue.order={order}"], comm).system
    omega, Phi = lowest_modes(system, 12)
    system.kept.clear()
    monkeypatch.setattr("softgrasp.fem.solve.modes.static_solver", lambda *_: name)
    found, others = lowest_modes(system, 12)
    assert system.kept["factor"][1].name == name if comm.size == 1 else "factor" not in system.kept
    # residuals of 1e-8 enter omega squared; the solves of the factor are right to 1e-11
    assert np.abs(found / omega - 1).max() < 1e-10
    cosines = np.linalg.svd(total(comm, times_columns(system.M_ee, Phi).T @ others))[1]
    assert np.abs(cosines - 1).max() < 1e-12  # of angles of 1e-8 between the spans


@pytest.mark.serial
def test_a_shared_solver_keeps_its_tolerance_where_no_mode_passes() -> None:
    system = build("block_3d", [*SQUARE, "tissue.order=1"]).system
    with factored_stiffness(system, "cg") as solver:
        before = solver.ksp.getTolerances()
        vector = system.K_ee.createVecRight()
        vector.set(1.0)  # no mode
        with pytest.raises(SolverError, match="mode 1 has the relative residual"):
            _finish(solver, system, [vector])
        assert solver.ksp.getTolerances() == before
