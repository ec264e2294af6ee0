"""Who really factors, asked of PETSc, on every number of ranks."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import whole_copy
from softgrasp.fem.run.midpoint import midpoint_matrix
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.solve.cholesky import make_ksp
from softgrasp.fem.solve.solvers import SolverName, make_solver
from tests.helpers.models import CUBE, close, gather_matrix, gather_rows, local_rows, make_scene

FINER = {"tissue": {"cells": [6, 6, 8]}}


@pytest.mark.ranks
@pytest.mark.parametrize("reproducible", [True, False])
def test_mumps_is_mumps_on_any_ranks(comm: MPI.Intracomm, reproducible: bool) -> None:
    """PETSc's own factor has 1.5 times the entries of MUMPS' at this size, and would solve as well."""
    system = build(make_scene(CUBE, FINER), comm=comm).system
    layout = system.layout
    S = midpoint_matrix(system, 0.01)
    alone = make_ksp(whole_copy(S), "alone_", "mumps")
    alone.setUp()
    dense = gather_matrix(layout, S).toarray()
    solver = make_solver(S, "mumps", layout, "test_", reproducible=reproducible)
    factor = solver.ksp.getPC().getFactorMatrix()
    assert solver.package == "MUMPS"
    assert solver.ksp.comm.size == (1 if reproducible else comm.size)
    if reproducible:
        assert factor.getMumpsInfog(9) == alone.getPC().getFactorMatrix().getMumpsInfog(9)  # entries of the factor
    full = np.random.default_rng(1).standard_normal(layout.n_e)
    r, w = S.createVecs()
    r.array_w[:] = local_rows(layout, full)
    solver.solve(r, w)
    assert close(gather_rows(layout, w.array_r), np.linalg.solve(dense, full)) < 1e-12  # condition about 1e2
    alone.destroy()
    solver.destroy()


@pytest.mark.ranks
@pytest.mark.parametrize(("name", "package"), [("cholesky", "PETSc"), ("mumps", "MUMPS"), ("cg", "GAMG")])
def test_a_run_says_who_factored(comm: MPI.Intracomm, name: SolverName, package: str) -> None:
    run = simulate(build(make_scene(CUBE, time={"solver": name, "steps": 2}), comm=comm))
    assert run.solver == (name, "asked for by the scene", package)
