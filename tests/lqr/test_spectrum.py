"""The certified abscissa of large scenes against LAPACK: poles that accumulate, and what must not be said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.errors import SolverError
from softgrasp.fem.model.build import build
from softgrasp.fem.scene.file import load_scene
from softgrasp.fem.solve import costs
from softgrasp.fem.solve.solvers import TissueSolver
from softgrasp.fem.solve.stiffness import sharing_factors
from softgrasp.fem.solve.subtrees import SplitFactor
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.design.scene import with_control
from softgrasp.lqr.lowrank.modal_start import modal_start
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.riccati import solve
from softgrasp.lqr.spectrum import certificate
from softgrasp.lqr.spectrum.certificate import OpenLoop, abscissa
from softgrasp.lqr.spectrum.modal_loop import DENSE_LIMIT, ModalLoop
from softgrasp.lqr.spectrum.tail import TailBound
from tests.helpers.models import LAYERS, make_scene

SCENES = Path(__file__).parents[2] / "demos" / "scenes"
CONTROL = {"control": {"outputs": [{"kind": "node", "point": [0.5, 0.0]}]}, "tissue": {"cells": [4, 8]}}
KELVIN: dict[str, Any] = {"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.003}}}
RAYLEIGH: dict[str, Any] = {"effects": {"damping": {"kind": "rayleigh", "alpha": 0.3, "beta": 0.003}}}
SPACE: dict[str, Any] = {
    "effects": {"damping": {"kind": "rayleigh", "alpha": 0.3, "beta": 0.003, "drag": "space"}, "reaction": True}
}
LAYERED: dict[str, Any] = {**KELVIN, "tissue": {"layers": LAYERS}}


def shipped(name: str, *changes: str) -> RiccatiProblem:
    model, _ = with_control(build(load_scene(SCENES / name, list(changes)), comm=MPI.COMM_WORLD))
    return make_problem(model)


def small(*changes: dict[str, Any]) -> RiccatiProblem:
    return make_problem(build(make_scene(CONTROL, *changes), comm=MPI.COMM_WORLD))


def gain(problem: RiccatiProblem) -> Block:
    """That of hand and lowest modes, optimal to some digits, in the sign of u = K x."""
    return modal_start(Plant(problem)).gain.times(-np.linalg.inv(np.linalg.cholesky(problem.R)))


def poles(problem: RiccatiProblem, K: Block) -> np.ndarray:
    return ModalLoop(problem, DENSE_LIMIT).poles(K)


LINEAR = ("tissue.refine=false", "tissue.order=1")  # all poles are few then


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("paper_lqr.toml", ("tissue.cells=[4,8]",)),
        ("franka_muscle.toml", (*LINEAR, "tissue.cells=[4,8]")),
        ("franka_muscle.toml", (*LINEAR, "tissue.cells=[4,8]", "control.Q=1e6")),
        ("franka_muscle.toml", (*LINEAR, "tissue.cells=[4,8]", "control.Q=1e5", "effects.damping.beta=0.1")),
        ("block_3d.toml", (*LINEAR, "tissue.cells=[2,2,4]")),
    ],
    ids=["paper", "muscle", "muscle-stiff-gain", "muscle-overdamped", "block"],
)
def test_shipped_scenes_are_certified(name: str, changes: tuple[str, ...]) -> None:
    """Also where the poles of fast modes accumulate at -1/beta, before and behind those of the hand."""
    problem = shipped(name, *changes)
    K = solve(problem).gain.block if "control.Q=1e6" in changes else gain(problem)
    found, exact = abscissa(problem, Gain.of_block(K)), poles(problem, K)
    assert found.certified, found.reason
    assert found.bound < 1
    # rounding of LAPACK is eps |A| = 1e-12 of the fastest pole, that of the iteration 1e-9 of 1 / distance
    assert abs(found.value - exact.real.max()) < 1e-7 * abs(exact.real.max()) + 1e-12 * np.abs(exact).max()


@pytest.mark.parametrize("changes", [(RAYLEIGH,), (LAYERED,), (RAYLEIGH, {"effects": {"reaction": True}})], ids=str)
def test_the_bound_holds_where_damping_is_not_proportional(changes: tuple[dict[str, Any], ...]) -> None:
    """Layers and a floating hand under alpha have no modes of their own, the bound still lies above |h(i w)|."""
    problem = small(*changes)
    K = gain(problem)
    found = abscissa(problem, Gain.of_block(K))
    assert found.stable, found.reason
    loop = ModalLoop(problem, DENSE_LIMIT)
    assert abs(found.value - loop.poles(K).real.max()) < 1e-8  # tolerance 1e-9 of poles of size 10
    tail, k, one = TailBound(problem, K), loop.gain(K), np.eye(len(loop.A))
    for r in (0.3, 1.0, 10.0, 100.0):
        near = np.geomspace(r, 1e3 * r, 40)
        size = max(np.linalg.norm(k @ np.linalg.solve(1j * w * one - loop.A, loop.B), 2) for w in near)
        assert size <= tail.bound(r), r


def test_the_shifted_bound_holds_left_of_the_axis() -> None:
    """For Re s >= -a; half the decay of the slowest mode, and beyond it, where only |s| > omega_k helps."""
    problem = small(KELVIN)
    K = gain(problem)
    loop, tail = ModalLoop(problem, DENSE_LIMIT), TailBound(problem, K)
    k, one = loop.gain(K), np.eye(len(loop.A))
    own = 0.003 * tail.omega[0] ** 2 / 2
    for a, r in ((0.5 * own, 2.0), (0.5 * own, 20.0), (1.2 * own, 20.0)):
        line = -a + 1j * np.sqrt(np.geomspace(r, 1e3 * r, 40) ** 2 - a**2)
        size = max(np.linalg.norm(k @ np.linalg.solve(s * one - loop.A, loop.B), 2) for s in line)
        assert size <= tail.bound(r, a), (a, r)
    assert tail.bound(0.5 * tail.omega[0], 1.2 * own) == np.inf  # the first mode is not excluded there
    found = abscissa(problem, Gain.of_block(K))
    assert found.exact
    assert abs(found.value - loop.poles(K).real.max()) < 1e-8  # tolerance 1e-9 of poles of size 10


def test_no_unstable_mode_is_missed() -> None:
    """Feedback that drives one mode after the other, however far out: never called stable."""
    problem = small(KELVIN)
    loop, K = ModalLoop(problem, DENSE_LIMIT), gain(problem)
    n = problem.layout.n_local
    for mode in (0, 3, 9, 25, 60):
        push = loop.plant.space.B[2 * problem.layout.n_s + len(loop.plant.omega) :]  # none: the hand drives them by E
        assert not push.any()
        direction = loop.plant.g[mode]
        size = 4 * (0.003 * loop.plant.omega[mode] ** 2) / np.linalg.norm(np.linalg.solve(problem.M_s, direction))
        tall = K.tall.copy()
        tall[n:] -= size * np.outer(loop.plant.massed[:, mode], direction / np.linalg.norm(direction))
        loud = Block(K.hand, tall)
        exact, found = loop.poles(loud).real.max(), abscissa(problem, Gain.of_block(loud))
        assert exact > 0
        assert not found.stable, mode
        assert found.value >= 0 or found.reason


def test_reasons_where_there_is_no_bound() -> None:
    for changes, words in (
        ((SPACE,), "two-way coupling with alpha > 0 in space"),
        (({"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.0}}, "tissue": {"layers": LAYERS}},), "a layer"),
    ):
        problem = small(*changes)
        K = gain(problem)
        found = abscissa(problem, Gain.of_block(K))
        assert not found.certified
        assert words in found.reason
        assert abs(found.value - poles(problem, K).real.max()) < 1e-8  # tolerance 1e-9 of poles of size 10


@pytest.mark.ranks(2)
def test_gains_of_one_circle_share_a_factor(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, made = small(KELVIN), list[str]()
    make = certificate.make_solver

    def counted(*args: Any, **more: Any) -> Any:
        made.append(args[1])
        return make(*args, **more)

    monkeypatch.setattr(certificate, "make_solver", counted)
    gains = [Gain.of_block(gain(problem).times(np.eye(2) * scale)) for scale in (1.0, 0.9)]
    with sharing_factors(problem.system):
        shared = [abscissa(problem, K) for K in gains]
    assert shared[0].shift == shared[1].shift
    assert len(made) == 1
    alone = [abscissa(problem, K) for K in gains]
    assert len(made) == 3
    assert [a.value for a in alone] == [a.value for a in shared]


@pytest.mark.ranks
def test_a_plant_whose_solves_fail_keeps_no_factor(monkeypatch: pytest.MonkeyPatch) -> None:
    freed, free = list[TissueSolver](), TissueSolver.destroy

    def fails(*_: Any) -> Any:
        raise SolverError("mumps: no solve")

    def destroy(self: TissueSolver) -> None:
        freed.append(self)
        free(self)

    monkeypatch.setattr(TissueSolver, "columns", fails)
    monkeypatch.setattr(TissueSolver, "destroy", destroy)
    with pytest.raises(SolverError, match="no solve"):
        OpenLoop(small(KELVIN), 1.0)
    assert len(freed) == 1


@pytest.mark.ranks(3)
@pytest.mark.parametrize("changes", [KELVIN, SPACE])
def test_subtrees_on_ranks_find_the_same_poles(changes: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    problem, made = small(changes, {"tissue": {"cells": [8, 16]}}), list[bool]()
    K = Gain.of_block(gain(problem))
    whole = abscissa(problem, K)
    monkeypatch.setattr(costs, "SUBTREES_FROM", 0)
    make = OpenLoop.__init__

    def kept(self: OpenLoop, *args: Any) -> None:
        make(self, *args)
        made.append(isinstance(self.solver.factor, SplitFactor))

    monkeypatch.setattr(OpenLoop, "__init__", kept)
    split = abscissa(problem, K)
    assert made == [problem.layout.comm.size > 1]
    assert split.certified == whole.certified
    assert abs(split.value - whole.value) < 1e-8  # tolerance 1e-9 of poles of size 10
