"""Sentences of `lqr` that no other test asks for: the bad call, and the sentence that refuses it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from petsc4py import PETSc

import softgrasp as sg
from softgrasp.lqr.dense import modal
from softgrasp.lqr.dense.paper import paper_form
from softgrasp.lqr.design.scene import actuation, weight
from softgrasp.lqr.loop.actuation import Actuation, ImplicitInput
from softgrasp.lqr.loop.filter import Filter
from softgrasp.lqr.lowrank import newton, radi
from softgrasp.lqr.lowrank.shifted import make_shifted
from softgrasp.lqr.observer.sensors import Noise, make_disturbance, make_sensors
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import check_weights
from softgrasp.lqr.plant.second_order import second_order
from softgrasp.lqr.reduced.bases import make_family
from softgrasp.lqr.reduced.retune import Retuner
from softgrasp.lqr.riccati import modal_lqr
from tests.helpers.sentences import refused

pytestmark = pytest.mark.serial
Act = Callable[[Path, pytest.MonkeyPatch], Any]
SMALL = "tissue.cells=[2, 4]"


@cache
def problem(*keys: str) -> Any:
    return sg.problem(sg.build("paper_lqr", [SMALL, *keys]))


@cache
def controller() -> sg.Controller:
    return sg.make_controller(sg.design(sg.build("paper_lqr", [SMALL])), 8)


def designed(*keys: str) -> Act:
    return lambda *_: sg.design(sg.build("paper_lqr", [SMALL, *keys]))


def below_a_file(folder: Path, _: Any) -> None:
    (folder / "file").write_text("")
    controller().save(folder / "file" / "folder" / "c.npz")


def of_another(folder: Path, _: Any) -> None:
    path = controller().save(folder / "c.npz")
    sg.Controller.load(path, scene_hash="0" * 64)


def no_steps(*_: Any) -> None:
    design = sg.design(sg.build("paper_lqr", [SMALL]))
    loop = sg.ClosedLoop(design.problem, 0.01)
    loop.run(design.gain, design.target, 0)


def turned(_: Path, patch: pytest.MonkeyPatch) -> None:
    """A step whose small matrix rounding has made indefinite."""
    patch.setattr(radi, "radi_columns", lambda plant, s, V: (V, V, -np.eye(2), np.zeros((2, 2)), 1.0))
    radi.RADI().solve(problem())


def one_newton_step(*_: Any) -> None:
    newton.NewtonADI(max_iterations=1, modes=0).solve(problem())


def unsettled(_: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(ImplicitInput, "max_iterations", 0)
    ImplicitInput(E / 2, np.ones(2)).solve(np.full(2, 9.0))


def no_space(*_: Any) -> None:
    raise OSError(28, "No space left on device")


def full_disk(folder: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(newton, "write_manifest", no_space)
    newton.NewtonADI(checkpoint=folder, checkpoint_every=1, checkpoint_after=0.0).solve(problem())


def other_density(*_: Any) -> None:
    old: Any = SimpleNamespace(reference=[SimpleNamespace(dense=1.0, rho=1.0)])
    Retuner.at(old, (SimpleNamespace(dense=2.0, rho=2.0),))  # type: ignore[arg-type]


def gyroscopic(*_: Any) -> None:
    M, D = (PETSc.Mat().createDense((2, 2), array=A, comm=PETSc.COMM_SELF) for A in (E, np.array([[0, 1.0], [-1, 0]])))
    second_order((M, D, M), E, E)


E = np.eye(2)
SENTENCES: list[tuple[Act, str]] = [
    (lambda *_: actuation(sg.build("paper_lqr", [SMALL, "control.loop.limit_torque=1.0"])),
     "control.loop.limit_torque limits a hand that does not turn; set effects.rotation = true, or leave it out"),
    (lambda *_: Actuation(rate=10.0, delay=-1).ticks(0.1), "delay = -1 ticks must be 0 or more"),
    (lambda *_: modal_lqr(problem(), modes=-1), "modal_lqr: modes = -1 must be 0 or more"),
    (lambda *_: make_disturbance(problem(), 1.0, 1.0, [[8.0, 8.0], [9.0, 9.0]]),
     "control.observer.disturbance.box = [[8.0, 8.0], [9.0, 9.0]] contains no free node of the body; enlarge it"),
    (lambda *_: check_weights(np.eye(3), E, 2, 2), "Q has the shape (3, 3); it must be (2, 2), one row per output"),
    (lambda *_: check_weights(np.array([[1.0, 2.0], [0.0, 1.0]]), E, 2, 2), "Q is not symmetric; give (Q + Q')/2"),
    (lambda *_: weight([[1.0]], 2, "control.R"), "control.R is 1 x 1; it must be 2 x 2 or one number"),
    (lambda *_: Actuation(rate=0.0).ticks(0.01), "rate = 0.0 Hz must be a positive number"),
    (lambda *_: ImplicitInput(E, None), "the implicit feedback of one step is singular (condition inf); use a smaller"),
    (lambda *_: sg.solve(problem(), "best"), "the Riccati method 'best' is unknown; choose one of "),  # type: ignore[arg-type]
    (lambda *_: make_family("best", problem(), Block(np.zeros((4, 1)), np.zeros((4, 1)))), "basis 'best' is unknown; "),
    (lambda *_: make_shifted(problem().system, "fast"),
     "the shifted solver 'fast' is unknown; choose auto, gathered or"),
    (lambda *_: modal.DenseRiccati(limit=3).solve(problem()),
     "states are more than 3; use newton_adi, radi or galerkin instead"),
    (lambda *_: modal.DenseRiccati(tolerance=1e-300).solve(problem()), "dense: the true residual is "),
    (lambda *_: modal._check_held(0.0, 1.0), "the stiffness has the eigenvalue 0.0e+00; the contact zone must fix the"),
    (one_newton_step, "newton_adi: relative residual "),
    (lambda *_: radi.RADI(max_iterations=1).solve(problem()), "radi: relative residual "),
    (turned, "is not definite; use newton_adi"),
    (lambda *_: replace(controller(), K=np.eye(3)), "K of the controller must be finite and of shape (2, "),
    (lambda *_: replace(controller(), period=0.0), "period = 0.0 s of the controller must be positive"),
    (lambda *_: replace(controller(), plant=replace(controller().plant, S_q=np.zeros_like(controller().plant.S_q))),
     "the plant of a controller must begin with q_s and v_s; make it with lqr.loop.small.galerkin"),
    (lambda *_: Filter(np.full((2, 2), np.nan), E, np.zeros(2), E, E, ("a", "b")),
     "A of the filter must be finite and of"),
    (below_a_file, "c.npz cannot be written ("),
    (lambda *_: sg.Controller.load("nowhere.npz"), "nowhere.npz does not exist; save the controller first"),
    (of_another, "was made for another scene (scene_hash "),
    (designed("motion.target=[0.0, 0.0]"),
     "motion.target is [0.0, 0.0], where the hand starts; give another place to go"),
    (lambda *_: sg.solve(problem("control.Q=0.0"), "radi"),
     "the outputs weighted with Q are all zero; give an output and a Q that is not zero"),
    (gyroscopic, "D is not symmetric; gyroscopic and circulatory terms are not covered"),
    (unsettled, "the saturated inputs did not settle in 0 rounds; use a smaller time step"),
    (full_disk, "newton.json cannot be written ([Errno 28] No space left on device); free the disk"),
    (other_density, "rho = 2 differs from 1; re-tuning covers lambda, mu and beta"),
    (lambda *_: paper_form(problem("effects.reaction=true")),
     "the paper's matrices are those of one-way coupling, on one "),
    (lambda *_: make_sensors(problem(), [[9.0, 9.0]], Noise(1e-3)),
     "markers[0] = [9.0, 9.0] lies outside the body; move"),
    (no_steps, "steps = 0 must be at least 1"),
]  # fmt: skip


@pytest.mark.parametrize(("act", "sentence"), SENTENCES, ids=[sentence[:40] for _, sentence in SENTENCES])
def test_sentence_names_what_is_wrong(act: Act, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with refused(sentence):
        act(tmp_path, monkeypatch)
