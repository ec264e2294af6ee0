"""Sentences of `reduction` that no other test asks for: the bad call, and the sentence that refuses it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
import ufl
from mpi4py import MPI

import softgrasp as sg
from softgrasp.fem.run.states.trajectory import Trajectory
from softgrasp.reduction.bases.engines import factor
from softgrasp.reduction.bases.pod import cholesky_of
from softgrasp.reduction.bases.truncation import Truncation
from softgrasp.reduction.bridges.mujoco import MujocoTissue, mujoco_body
from softgrasp.reduction.certified.oscillators import SecondOrder
from softgrasp.reduction.certified.trainer import Trainer
from softgrasp.reduction.contact.replay import errors_contact
from softgrasp.reduction.export.c import write_files
from softgrasp.reduction.export.fmu import write_fmu
from softgrasp.reduction.identify.data import Measurements
from softgrasp.reduction.identify.near import _write_table, experiment
from softgrasp.reduction.identify.posterior import check_posterior
from softgrasp.reduction.identify.unknowns import parse_unknowns
from softgrasp.reduction.online import prepared
from softgrasp.reduction.online import run as run_online
from softgrasp.reduction.strain.nnls import nnls
from softgrasp.reduction.strain.training import train
from tests.helpers.sentences import refused

pytestmark = pytest.mark.serial
Act = Callable[[Path, pytest.MonkeyPatch], Any]


def model(*keys: str, **given: Any) -> sg.Model:
    return sg.build(
        "paper_forward", ["tissue.cells=[2, 4]", "time.steps=4", "output.snapshots='memory'", *keys], **given
    )


@cache
def made() -> tuple[sg.Model, Trajectory, Any]:
    """A scene, its run, and a reduced model of it."""
    full = model()
    run = sg.simulate(full)
    return full, run, sg.reduce(full, run, "craig_bampton", 8)


def rom() -> Any:
    return made()[2]


@cache
def growing() -> tuple[sg.Model, Trajectory, Any]:
    """The same with a basis that makes an unstable model."""
    full = model("time.steps=40")
    run = sg.simulate(full)
    return full, run, sg.reduce(full, run, "global_pod", 10)


@cache
def turning() -> Any:
    """A model in the frame of the hand, in the plane."""
    keys = ["tissue.cells=[2, 4]", "time.steps=30", "output.snapshots='memory'", "effects.finite_strain=false"]
    full = sg.build("turn_over", keys)
    return sg.reduce(full, sg.simulate(full), N=14)


def own(*keys: str) -> sg.Model:
    def W(F: Any, p: Any) -> Any:
        return p.a * (ufl.tr(F.T * F) - 2 - 2 * ufl.ln(ufl.det(F)) + (ufl.det(F) - 1) ** 2)

    return model("tissue.parameters={a=1.0}", *keys, energy=W)


def other_steps(*_: Any) -> None:
    model: Any = SimpleNamespace(V=np.eye(1), layout=0)
    full: Any = SimpleNamespace(trajectory=SimpleNamespace(contact=None))
    errors_contact(model, full, full)


def dependent(*_: Any) -> None:
    one: Any = SimpleNamespace(materials=(), stiffness=lambda *_: np.eye(2), density=lambda _: np.zeros((2, 2)))
    SecondOrder(*np.zeros((4, 2, 2))).modes(one)


def two_motions(folder: Path, _: Any) -> None:
    data = Measurements("a.csv", np.zeros(1), np.zeros((1, 2)), (np.zeros(2), np.zeros((2, 2))))
    experiment(model("motion.drive='force'", "effects.reaction=true"), data, folder / "a")


def damaged(folder: Path, _: Any) -> Any:
    sg.save(rom(), folder / "a.h5")
    with h5py.File(folder / "a.h5", "r+") as file:
        file["outputs/C_s"][...] += 7.0
    return sg.load(folder / "a.h5")


def below_a_file(folder: Path) -> Path:
    (folder / "file").write_text("")
    return folder / "file" / "folder" / "a.h5"


def basis(name: str, **how: Any) -> Act:
    return lambda *_: sg.reduce(*made()[:2], name, 8, **how)


SENTENCES: list[tuple[Act, str]] = [
    (lambda *_: MujocoTissue(rom(), None),
     "the model is one of small angles; reduce a scene with effects.frame = 'hand'"),
    (lambda *_: train(made()[0], [], 8), "the scene has no effects.finite_strain; softgrasp.reduce makes its linear "),
    (lambda *_: train(model("effects.finite_strain={}"), [], 8), "there is no full run to train on; give at least one"),
    (lambda *_: sg.identify(made()[0], Measurements("a", np.zeros(2), np.zeros((2, 3))), "mu", 1e-3),
     "a: values have the shape (2, 3); the scene has 2 outputs"),
    (lambda folder, _: sg.save(rom(), below_a_file(folder)), "a.h5 cannot be written (Not a directory); "),
    (damaged, "a.h5 is damaged: it is not what was written; reduce the scene again"),
    (lambda *_: factor(MPI.COMM_SELF, np.eye(2), "fast"), "engine 'fast' is unknown; choose one of "),  # type: ignore[arg-type]
    (lambda *_: cholesky_of(MPI.COMM_SELF, -np.eye(2)), "the inner product is not positive definite on the snapshots"),
    (basis("best"), "basis 'best' is unknown; choose one of "),
    (basis("global_pod", inner="heat"), "inner product 'heat' is unknown; choose one of "),
    (lambda *_: Truncation(), "give exactly one of N, energy and tol"),
    (lambda *_: Truncation(tol=2.0), "tol = 2.0 must lie between 0 and 1"),
    (lambda *_: Truncation(N=0), "N = 0 must be at least 1"),
    (lambda *_: check_posterior(1), "--posterior 1: give at least "),
    (lambda *_: nnls(np.eye(2), np.ones(2), 2.0), "tau = 2 must lie between 1e-06 and 1"),
    (lambda *_: Trainer(model(terms=[sg.Term("bed", lambda u, v: ufl.inner(u, v) * ufl.ds, 1.0)])),
     "own terms have no certificate: their share of the stiffness has no known sign; drop them"),
    (lambda *_: Trainer(model("effects.finite_strain={law='neo-hooke'}")), "its bound needs linear tissue"),
    (lambda *_: sg.identify(own(), [], "mu", 1e-3), "identify fits lambda, mu, rho and beta, and cannot go with "),
    (lambda *_: sg.suggest_markers(own(), "mu", 1e-3, 1),
     "markers are chosen for lambda, mu, rho and beta; leave out "),
    (lambda *_: sg.suggest_markers(model("effects.finite_strain={law='neo-hooke'}"), "mu", 1e-3, 1),
     "markers are chosen by linear elasticity, and effects.finite_strain is on; use "),
    (lambda *_: parse_unknowns(["beta"], model("effects.damping=false")), "--fit beta: beta needs effects.damping; "),
    (lambda *_: parse_unknowns(["lambda"], model("tissue.material={lambda=0.0, mu=1.0, rho=1.0}")),
     "--fit lambda: the scene's value is 0; the fit starts there and needs one > 0"),
    (lambda *_: rom().at(()), "0 materials are given; the model has 1 layers"),
    (lambda *_: prepared(rom().at(), None, True), "give the time step dt [s]"),
    (lambda *_: sg.gradient(rom(), lambda y: 0.0), "the gradient of a reduced model needs the step dt [s]"),
    (lambda *_: Trainer(own("reduction.layers='apart'")),
     "reduction.layers = 'apart' cannot go with parameters of an own"),
    (lambda *_: MujocoTissue(turning(), None), "the model is plane; MuJoCo needs one of three dimensions"),
    (lambda *_: mujoco_body(turning()), "the model is plane; MuJoCo needs one of three dimensions"),
    (lambda *_: turning().at(0.01).run(force=lambda *_: np.zeros(3), steps=0),
     "steps = 0: a run under a force has at "),
    (lambda *_: turning().at(0.01).run(force=lambda *_: np.full(3, np.nan), steps=1),
     "the force on the hand in step 1 is "),
    (lambda folder, _: write_fmu(growing()[2], folder / "a.fmu"), "; export another N or a structure-preserving basis"),
    (lambda *_: sg.replay(growing()[2], *growing()[:2]),
     "; choose another N or a structure-preserving basis, or run with "),
    (lambda folder, _: write_files(below_a_file(folder), {"a.c": ""}),
     "cannot be written (Not a directory); name another fo"),
    (lambda folder, _: write_fmu(rom(), below_a_file(folder)),
     "cannot be written (Not a directory); name another file"),
    (lambda folder, _: _write_table(below_a_file(folder), np.eye(2)),
     ": the measured motion cannot be written there (Not a "),
    (other_steps, "the full run has other steps than the reduced one, or no contact"),
    (dependent, "the reduced mass is singular; its basis vectors are linearly dependent"),
    (two_motions, "a.csv: the scene gives the force on the hand, so its motion q_* cannot be given too"),
    (lambda *_: run_online(rom().at(), hand=(np.zeros((3, 1)), np.zeros((3, 2))), dt=0.1),
     "the hand's tables have the shapes (3, 1) and (3, 2); both must be (steps + 1, 2)"),
    (lambda *_: replace(rom().at(), E=np.full_like(rom().at().E, np.nan)).check_independent(),
     "the reduced matrices are not finite; check basis and materials"),
    (lambda *_: sg.reduce(model(), sg.simulate(model("output.snapshots='none'")), "global_pod"),
     "output.snapshots must be 'memory' for a reduction; bases are built from the states in memory"),
]  # fmt: skip


@pytest.mark.parametrize(("act", "sentence"), SENTENCES, ids=[sentence[:40] for _, sentence in SENTENCES])
def test_sentence_names_what_is_wrong(act: Act, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with refused(sentence):
        act(tmp_path, monkeypatch)
