"""Who really factors, asked of PETSc, on every number of ranks."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import PETSc, whole_copy
from softgrasp.fem.run.midpoint import midpoint_matrix
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.solve.cholesky import OrderedFactor, make_ksp
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
@pytest.mark.parametrize("name", ["cholesky", "mumps"])
def test_columns_are_divided_between_ranks(comm: MPI.Intracomm, name: SolverName) -> None:
    """Each rank has a share of the solves, which have the bits of one after the other but for MUMPS' blocks."""
    system = build(make_scene(CUBE), comm=comm).system
    solver = make_solver(system.K_ee.copy(), name, system.layout, "test_", reproducible=True)
    X = np.random.default_rng(2).standard_normal((system.layout.n_e, 7))
    X[:, 3] = 0.0  # costs nothing
    X = local_rows(system.layout, X)
    found = solver.columns(X, "a test")
    r, w = system.K_ee.createVecs()
    for j in range(X.shape[1]):
        r.array_w[:] = X[:, j]
        solver.solve(r, w)
        if name == "cholesky" and comm.size > 1:
            assert np.array_equal(found[:, j], w.array_r)
        assert close(found[:, j], w.array_r) < 1e-13  # MUMPS takes several at once; condition about 1e2
    if isinstance(solver.factor, OrderedFactor):
        counts = []
        factor, solver.factor.factor = solver.factor.factor, Counting(solver.factor.factor, counts)
        solver.columns(X)
        solver.factor.factor = factor
        assert sum(counts) == len(range(comm.rank, 6, comm.size))
        assert len(counts) == (1 if name == "mumps" else sum(counts))
    solver.destroy()


class Counting:
    """A factor that notes its solves."""

    def __init__(self, factor: PETSc.Mat, solves: list[int]) -> None:
        self.factor, self.solves = factor, solves

        self.comm, self.getSizes = factor.comm, factor.getSizes

    def solve(self, r: PETSc.Vec, w: PETSc.Vec) -> None:
        self.solves.append(1)
        self.factor.solve(r, w)

    def matSolve(self, B: PETSc.Mat, X: PETSc.Mat) -> None:  # noqa: N802  (PETSc's name)
        self.solves.append(B.getSize()[1])
        self.factor.matSolve(B, X)


@pytest.mark.ranks
@pytest.mark.parametrize(("name", "package"), [("cholesky", "PETSc"), ("mumps", "MUMPS"), ("cg", "GAMG")])
def test_a_run_says_who_factored(comm: MPI.Intracomm, name: SolverName, package: str) -> None:
    run = simulate(build(make_scene(CUBE, time={"solver": name, "steps": 2}), comm=comm))
    assert run.solver == (name, "requested by the scene", package)


@pytest.mark.ranks
def test_a_spread_factor_solves_several_columns_at_once(comm: MPI.Intracomm) -> None:
    system = build(make_scene(CUBE), comm=comm).system
    dense = gather_matrix(system.layout, system.K_ee).toarray()
    solver = make_solver(system.K_ee.copy(), "mumps", system.layout, "test_", reproducible=False)
    full = np.random.default_rng(3).standard_normal((system.layout.n_e, 17))  # one more than go at once
    full[:, 5] = 0.0
    found = solver.columns(local_rows(system.layout, full), "a test")
    assert close(gather_rows(system.layout, found), np.linalg.solve(dense, full)) < 1e-12  # condition about 1e2
    solver.destroy()
