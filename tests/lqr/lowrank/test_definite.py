"""Responses at real shifts: each solve against SciPy, the gain against Newton-ADI, and no other factor is made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import scipy.sparse.linalg
from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.solve.costs import COSTS, ITERATIVE
from softgrasp.fem.solve.solvers import TissueSolver
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.lowrank import definite, galerkin
from softgrasp.lqr.lowrank.definite import DefiniteTissue, well_damped
from softgrasp.lqr.lowrank.galerkin import StructuredGalerkin
from softgrasp.lqr.lowrank.newton import NewtonADI
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.spectrum.certificate import abscissa
from tests.helpers.models import gather_matrix, gather_rows
from tests.helpers.riccati import gain_error

BLOCK = [
    "tissue.order=1",
    "tissue.refine=false",
    "tissue.cells=[4,3,6]",
    "tissue.material={young=69e3,poisson=0.45,rho=1070}",
]


@cache
def block(beta: float) -> RiccatiProblem:
    changes = [*BLOCK, f"effects.damping.beta={beta}"]
    return make_problem(build("block_3d", changes, comm=MPI.COMM_WORLD))


@pytest.mark.ranks
@pytest.mark.parametrize("name", ["cholesky", "cg"])
def test_solves_are_those_of_scipy(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softgrasp.fem.solve.costs.Work.choose", lambda *_: [name])
    problem = block(5e-3)
    system, layout = problem.system, problem.layout
    K, M = (gather_matrix(layout, A) for A in (system.K_ee, system.M_ee))
    tissue = DefiniteTissue(system, system.G.shape[1])
    G, made = gather_rows(layout, system.G), 0
    for s in (0.0, 30.0, 3000.0):
        exact = scipy.sparse.linalg.spsolve((K + s * (5e-3 * K) + s**2 * M).tocsc(), G)
        found = gather_rows(layout, tissue.solve(complex(-s), system.G).real)
        allowed = 1e-6 if name == "cg" and s else 1e-10  # a residual of 1e-8 times the condition; rounding
        assert np.linalg.norm(found - exact) < allowed * np.linalg.norm(exact)
        made += s > 0
        assert tissue.factors == made  # K_ee has that of the system
    assert tissue.about == f"definite tissue solves by {'GAMG' if name == 'cg' else 'PETSc'}"
    tissue.destroy()


@pytest.mark.ranks(2)
@pytest.mark.parametrize("beta", [5e-3, 4e-4])
def test_gain_is_that_of_newton(beta: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(galerkin, "DEFINITE_FROM", 0)
    problem = block(beta)
    reference = NewtonADI().solve(problem)
    found = StructuredGalerkin().solve(problem)
    assert "definite" in found.about
    assert found.counts["solves"] <= 9
    assert gain_error(problem, found, reference) < 1e-6  # its own tolerance
    assert _tissue(problem, found.gain.K_z - reference.gain.K_z) < 2e-5 * _tissue(problem, reference.gain.K_z)  # a row
    assert found.residual < 1e-4  # 2e-7 and 1e-5 measured


@pytest.mark.serial  # on ranks stars send thousands of messages, which take long on a busy machine
@pytest.mark.parametrize(("order", "cells", "names"), [(1, "[4,3,6]", {"cg"}), (2, "[3,2,4]", {"cg", "stars"})])
def test_no_factor_is_made_above_the_direct_limits(
    order: int, cells: str, names: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Modes, responses and certificate as on a mesh that is too large for one; cg also inverts the mass."""
    changes, found, used = [*BLOCK, f"tissue.order={order}", f"tissue.cells={cells}"], [], set[str]()
    monkeypatch.setattr(TissueSolver, "__init__", _noting(used))
    for most in (1e6, 0.0):
        for key, cost in COSTS.items():
            monkeypatch.setitem(COSTS, key, replace(cost, most=np.inf if key[0] in ITERATIVE else most))
        problem = make_problem(build("block_3d", changes, comm=MPI.COMM_WORLD))
        used.clear()
        solution = StructuredGalerkin(tissue="definite").solve(problem)
        found.append((solution.gain.K_s, abscissa(problem, solution.gain)))
    assert used == names
    (K, direct), (L, iterated) = found
    assert np.abs(L - K).max() < 1e-10 * np.abs(K).max()  # measured 1e-14
    assert direct.certified
    assert iterated.certified
    assert iterated.value == pytest.approx(direct.value, rel=1e-8)  # TOLERANCE of the search


def _noting(used: set[str]) -> Callable[..., None]:
    """The initialiser of a solver that notes its name too."""
    made = TissueSolver.__init__

    def note(self: TissueSolver, *args: Any, **named: Any) -> None:
        made(self, *args, **named)
        used.add(self.name)

    return note


def _tissue(problem: RiccatiProblem, rows: Array) -> float:
    return float(np.sqrt(total(problem.layout.comm, np.array([np.sum(rows**2)])))[0])


def test_light_damping_keeps_complex_shifts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(galerkin, "DEFINITE_FROM", 0)
    problem = block(2e-5)  # the first mode left out has the damping ratio 0.01
    assert not well_damped(problem.system, 1100.0)
    assert "gathered" in StructuredGalerkin(tol=1e-4).solve(problem).about


def test_tolerance_of_a_response_leaves_the_gain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softgrasp.fem.solve.costs.Work.choose", lambda *_: ["cg"])
    problem, found = block(5e-3), []
    for rtol in (definite.RESPONSE_RTOL, 1e-12):
        monkeypatch.setattr(definite, "RESPONSE_RTOL", rtol)
        found.append(StructuredGalerkin(tissue="definite").solve(problem))
    assert gain_error(problem, *found) < 1e-9  # what the constant promises
