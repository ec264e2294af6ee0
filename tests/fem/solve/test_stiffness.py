"""One factor of K and one set of modes serve all who ask, and those of other matrices are made anew."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.accuracy.krylov import krylov_model
from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import times_columns, total
from softgrasp.fem.solve import stiffness
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.fem.solve.statics import equilibrium, mass_columns
from softgrasp.fem.solve.stiffness import sharing_factors, static_columns
from tests.helpers.models import CUBE, make_scene

WEIGHT: dict[str, Any] = {"effects": {"gravity": {"g": [0.0, -9.81]}}}


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the solvers that were set up for a stiffness."""
    names: list[str] = []
    make = stiffness.make_solver

    def counted(K: Any, name: Any, *args: Any) -> Any:
        names.append(name)
        return make(K, name, *args)

    monkeypatch.setattr(stiffness, "make_solver", counted)
    return names


@pytest.mark.ranks
@pytest.mark.parametrize("solver", ["cholesky", "mumps"])
def test_equilibrium_modes_and_estimate_share_a_factor(
    comm: MPI.Intracomm, made: list[str], monkeypatch: pytest.MonkeyPatch, solver: str
) -> None:
    for module in ("stiffness", "modes"):
        monkeypatch.setattr(f"softgrasp.fem.solve.{module}.static_solver", lambda *_: solver)
    model = build(make_scene(WEIGHT), comm=comm)
    system = model.system
    z = equilibrium(system)
    residual = times_columns(system.K_ee, z[:, None])[:, 0] - system.G @ system.fall
    assert np.sqrt(total(comm, residual @ residual)) < 1e-11 * np.abs(system.M_rigid @ system.fall).max()
    omega, Phi = lowest_modes(system, 8)
    krylov_model(model)
    few, some = lowest_modes(system, 3)
    assert (few == omega[:3]).all()
    assert (some == Phi[:, :3]).all()
    assert made == [solver]
    shared = replace(system, damping=replace(system.damping, alpha=1.0))
    equilibrium(shared)
    assert made == [solver]


@pytest.mark.ranks
def test_other_materials_have_a_factor_and_modes_of_their_own(comm: MPI.Intracomm, made: list[str]) -> None:
    model = build(make_scene(WEIGHT), comm=comm)
    z, (omega, _) = equilibrium(model.system), lowest_modes(model.system, 2)
    stiff = model.with_materials(lam=200.0, mu=200.0).system
    assert equilibrium(stiff) == pytest.approx(z / 4, rel=1e-9, abs=1e-12)  # K is four times as large
    assert lowest_modes(stiff, 2)[0] == pytest.approx(2 * omega, rel=1e-9)
    assert len(made) == 2
    model.system.K_ee.scale(4.0)  # the entries change in place: what was kept is of no use
    assert equilibrium(model.system) == pytest.approx(z / 4, rel=1e-9, abs=1e-12)
    assert len(made) == 3


def test_a_large_factor_is_freed(comm: MPI.Intracomm, made: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stiffness, "KEPT_LIMIT", dict.fromkeys((1, 2, 3), 10))
    system = build(make_scene(CUBE), comm=comm).system
    first, second = (static_columns(system, system.G) for _ in range(2))
    assert (first == second).all()
    assert len(made) == 2
    assert "factor" not in system.kept


@pytest.mark.ranks
def test_a_large_factor_is_shared_to_the_end_of_a_block(
    comm: MPI.Intracomm, made: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stiffness, "KEPT_LIMIT", dict.fromkeys((1, 2, 3), 10))
    system = build(make_scene(CUBE), comm=comm).system
    with sharing_factors(system):
        first = static_columns(system, system.G)
        with sharing_factors(system):
            second = static_columns(system, system.G)
        third = static_columns(system, system.G)
        assert len(made) == 1
        system.K_ee.scale(2.0)
        fourth = static_columns(system, system.G)
        assert len(made) == 2
    assert (first == second).all()
    assert (first == third).all()
    assert fourth == pytest.approx(first / 2, rel=1e-9, abs=1e-14)  # two factors of rounding
    assert not {"factor", stiffness.SHARED} & set(system.kept)


@pytest.mark.ranks
@pytest.mark.parametrize("changes", [{}, {"tissue": {"order": 2}}])
def test_momenta_are_solved_without_a_factor(comm: MPI.Intracomm, made: list[str], changes: dict[str, Any]) -> None:
    system = build(make_scene(CUBE, changes), comm=comm).system
    X = mass_columns(system, system.G)
    error = times_columns(system.M_ee, X) - system.G
    size, wrong = total(comm, np.array([np.sum(system.G**2), np.sum(error**2)]))
    assert wrong < 1e-22 * size  # the square of ten times its tolerance
    assert not made


def test_static_solves_have_the_solver_of_the_least_modelled_time() -> None:
    """By contrast, grading and allowed memory of the system."""
    nearly: dict[str, Any] = {"tissue": {"material": {"lambda": 49.0, "mu": 1.0, "rho": 1.0}}}
    names = []
    for changes in ([CUBE], [CUBE, nearly], [CUBE, {"tissue": {"refine": {}}}]):
        system = build(make_scene({"tissue": {"order": 2}}, *changes), comm=MPI.COMM_SELF).system
        large = replace(system, layout=replace(system.layout, n_e=200_000), kept={})
        names.append(stiffness.static_solver(large))
        assert stiffness.static_solver(replace(large, memory=1e10)) == names[-1]
        assert stiffness.static_solver(replace(large, memory=1e9)) == "stars"  # a factor takes 2.7 GB
    assert names == ["stars", "mumps", "mumps"]
    assert stiffness.static_solver(replace(large, materials=(), kept={})) == "mumps"  # iterations are not known
    assert stiffness.static_solver(large, "cholesky") == "cholesky"
    assert large.memory == np.inf  # with output.memory = "auto"
    some = build(make_scene(CUBE, {"output": {"memory": 2.0}}), comm=MPI.COMM_SELF).system
    assert 0.99 < some.memory / (2 * 2.0**30) < 1  # mesh and matrices of some cells are taken off
    alone = replace(large, graded=False, kept={})
    assert stiffness.static_solver(alone, solves=stiffness.resting_solves(200_000, 3)) == "stars"  # K's factor not kept
    assert stiffness.resting_solves(100_000, 3) == stiffness.FEW_SOLVES
