"""Sentences of solves that fail, which no sound problem makes: a part is replaced, and the sentence is read."""

from __future__ import annotations

import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from petsc4py import PETSc
from scipy.sparse import csr_matrix

import softgrasp as sg
from softgrasp.fem.errors import SoftgraspError, SolverError
from softgrasp.fem.obstacles import mass
from softgrasp.fem.reduced import ReducedSystem
from softgrasp.fem.run.stepping import Stepped
from softgrasp.fem.solve import modes, solvers
from softgrasp.lqr.lowrank import radi, shifted
from softgrasp.lqr.lowrank.newton import NewtonADI
from softgrasp.lqr.observer.reduced import _stationary
from softgrasp.lqr.spectrum import certificate
from softgrasp.reduction.bases import engines

pytestmark = pytest.mark.serial
Patch = pytest.MonkeyPatch


class Failing:
    """An object of PETSc or SLEPc, of which some calls are replaced; the others do nothing."""

    def __init__(self, **calls: Callable[..., Any]) -> None:
        self.calls = calls

    def __getattr__(self, name: str) -> Callable[..., Any]:
        return self.calls.get(name, lambda *_, **__: self)


def broken(*_: Any, **__: Any) -> Any:
    raise PETSc.Error(76)


def plant(*keys: str) -> Any:
    return sg.problem(sg.build("paper_lqr", ["tissue.cells=[2, 4]", *keys]))


def stopped_steps(_: Patch) -> None:
    run = SimpleNamespace(reached=3, checking=0.0, solver=("mumps", "", ""))
    Stepped.advance_to(run, Failing(getConvergedReason=lambda: -7), 9)  # type: ignore[arg-type]


def singular_factor(_: Patch) -> None:
    S = PETSc.Mat().createAIJ((2, 2), csr=([0, 1, 2], [0, 1], [0.0, 0.0]), comm=PETSc.COMM_SELF)
    ksp = PETSc.KSP().create(PETSc.COMM_SELF)
    ksp.setOperators(S)
    ksp.setType("preonly")
    ksp.getPC().setType("lu")
    solvers._factor(ksp, S, "cholesky")


def stars(patch: Patch) -> None:
    def singular(*_: Any) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    patch.setattr(solvers, "Stars", singular)
    sg.simulate(sg.build("paper_forward", ["tissue.cells=[2, 4]", "tissue.order=2", "time.solver='stars'"]))


def no_modes(_: Patch) -> None:
    system = sg.build("paper_forward", ["tissue.cells=[2, 4]"]).system
    eps = Failing(getConverged=lambda: 0, getIterationNumber=lambda: 500, getConvergedReason=lambda: -3)
    modes._solve(eps, system, 2, [], [])  # type: ignore[arg-type]


def replaced(patch: Patch, name: str, **calls: Callable[..., Any]) -> None:
    """Objects of this class of SLEPc are failing ones with its constants."""
    true, fake = getattr(engines.SLEPc, name), Failing(**calls)
    fake.calls |= {"create": lambda *_: fake, "createFromMat": lambda *_: fake}

    class Replaced:
        def __new__(cls) -> Any:
            return fake

    for constant in ("Type", "OrthogBlockType"):
        if hasattr(true, constant):
            setattr(Replaced, constant, getattr(true, constant))
    patch.setattr(engines.SLEPc, name, Replaced)


def qr(patch: Patch) -> None:
    replaced(patch, "BV", orthogonalize=broken)
    engines._tsqr(PETSc.COMM_SELF.tompi4py(), np.eye(5, 2), 5)


def svd(**calls: Callable[..., Any]) -> Callable[[Patch], None]:
    def act(patch: Patch) -> None:
        patch.setattr(engines, "from_options", lambda _: None)
        replaced(patch, "SVD", getConverged=lambda: 1, getIterationNumber=lambda: 1000, **calls)
        engines._svd(PETSc.COMM_SELF.tompi4py(), np.eye(9, 7), 9, 2)

    return act


def shift(**calls: Callable[..., Any]) -> Callable[[Patch], None]:
    def act(_: Patch) -> None:
        tissue = shifted.DistributedTissue(plant().system)
        tissue.ksp = Failing(**calls)
        tissue._factor([2j])

    return act


def shifted_solve(patch: Patch) -> None:
    tissue = shifted.DistributedTissue(plant().system)
    patch.setattr(shifted, "direct_solves", lambda _: Failing(matSolve=broken))
    tissue._solve_each([2j], [np.ones((tissue.n_local, 1))])


def spectrum(patch: Patch) -> None:
    problem = plant()
    patch.setattr(certificate, "ERROR", -1.0)
    sg.abscissa(problem, sg.solve(problem).gain)


def no_filter(_: Patch) -> None:
    E, A, C = np.eye(2), np.diag([1.0, -1.0]), np.array([[0.0, 1.0]])  # the growing state is not seen
    system = ReducedSystem(E, A, np.ones((2, 1)), C, np.zeros(2), np.zeros((0, 2)), np.zeros((0, 2)))
    _stationary(system, C, np.eye(2), np.eye(1), 0.1)


FAILED: list[tuple[Callable[[Patch], Any], str]] = [
    (stopped_steps, "mumps: TS stopped at step 3 of 9 (reason -7)"),
    (singular_factor, "cholesky: set-up failed (reason "),
    (stars, "stars: the set-up failed (Singular matrix); check material and mesh"),
    (no_modes, "modes: 0 of 2 converged in 500 iterations (SLEPc reason -3); request fewer modes or check the mesh"),
    (qr, "SLEPc BV: QR of 5 x 2 snapshots failed ("),
    (svd(), "SLEPc SVD: 1 of 2 singular values converged in 1000 iterations; request fewer, or use engine = 'tsqr'"),
    (svd(solve=broken), "SLEPc SVD failed on 9 x 7 snapshots ("),
    (shift(setUp=broken), "MUMPS failed at the shift p = 0+2j (PETSc error 76)"),
    (shift(getFailedReason=lambda: 3), "MUMPS failed at the shift p = 0+2j: S(p) is singular or memory ran out"),
    (shifted_solve, "MUMPS failed to solve at the shift p = 0+2j (PETSc error 76)"),
    (lambda _: radi.RADI(max_iterations=1).solve(plant()), "after 1 solves, tolerance "),
    (lambda _: NewtonADI(max_solves=1).solve(plant()), "after 1 solves of one sweep, tolerance "),
    (spectrum, "closed-loop spectrum: an eigenpair has the residual "),
    (no_filter, "no filter of 2 states exists for these samples and disturbances ("),
]


@pytest.mark.parametrize(("act", "sentence"), FAILED, ids=[sentence[:40] for _, sentence in FAILED])
def test_a_failed_solve_says_which_and_why(
    act: Callable[[Patch], Any], sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SoftgraspError, match=re.escape(sentence)):
        act(monkeypatch)


@pytest.mark.parametrize("engine", ["C", "NumPy"])
def test_the_impulse_of_contact_has_a_bound_of_iterations(engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The compiled iteration and that in NumPy end with the same sentence."""
    M = csr_matrix(np.diag([2.0, 3.0, 4.0]) + 0.5 * np.ones((3, 3)))
    monkeypatch.setattr(mass, "MOST", 0)
    with pytest.raises(SolverError, match="did not converge in 0 iterations; improve the mesh"):
        mass.NodalMass(M, 1, engine).solve(np.array([1]), np.ones(1))
