"""Certificates of gains, one gain a rank, against those that all ranks make together."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.errors import SolverError
from softgrasp.fem.model.build import build
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.design.feedback import design, judge
from softgrasp.lqr.design.orders import reduce_gains
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.lowrank.modal_start import modal_start
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.reduced.bases import A_PRIORI
from softgrasp.lqr.spectrum import divided
from softgrasp.lqr.spectrum.certificate import Abscissa, abscissa
from softgrasp.lqr.spectrum.divided import Certificates
from tests.helpers.models import LAYERS, make_scene

SCENE = Path(__file__).parents[2] / "demos" / "scenes" / "paper_lqr.toml"
CONTROL = {"control": {"outputs": [{"kind": "node", "point": [0.5, 0.0]}]}, "tissue": {"cells": [4, 8]}}
KELVIN: dict[str, Any] = {"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.003}}}
LAYERED: dict[str, Any] = {**KELVIN, "tissue": {"layers": LAYERS}}
SPACE: dict[str, Any] = {
    "effects": {"damping": {"kind": "rayleigh", "alpha": 0.3, "beta": 0.003, "drag": "space"}, "reaction": True}
}


@pytest.mark.ranks
@pytest.mark.parametrize("changes", [KELVIN, LAYERED, SPACE], ids=["kelvin", "layered", "space"])
def test_each_rank_certifies_some_gains(comm: MPI.Intracomm, changes: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = make_problem(build(make_scene(CONTROL, changes), comm=comm))
    K = modal_start(Plant(problem)).gain.times(-np.linalg.inv(np.linalg.cholesky(problem.R)))
    gains = [Gain.of_block(K.times(np.eye(2) * scale)) for scale in (1.0, 0.8, -1.0, 1.1)]  # the third unstable
    together = [abscissa(problem, gain) for gain in gains]
    made = []

    def counted(plant: Any, *arguments: Any) -> Abscissa:
        made.append(plant.layout.comm.size)
        return abscissa(plant, *arguments)

    monkeypatch.setattr(divided, "abscissa", counted)
    alone = Certificates(problem, gains[0]).of(gains)
    assert made == [1] * len(range(comm.rank, len(gains), comm.size))
    for one, all_ in zip(alone, together, strict=True):
        assert isinstance(one, Abscissa)
        assert comm.allgather(one.value) == [one.value] * comm.size
        assert (one.certified, one.stable) == (all_.certified, all_.stable)
        assert abs(one.value - all_.value) < 1e-8 * max(1.0, abs(all_.value))  # tolerance 1e-9 of poles of size 10


@pytest.mark.ranks
def test_a_gain_that_all_ranks_certify_has_one_shift(comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = make_problem(build(make_scene(CONTROL, KELVIN), comm=comm))
    K = modal_start(Plant(problem)).gain.times(-np.linalg.inv(np.linalg.cholesky(problem.R)))
    gains = [Gain.of_block(K.times(np.eye(2) * scale)) for scale in (1.0, 0.8)]  # none for the third rank
    certificates = Certificates(problem, gains[0])
    certificates.of(gains)

    def together(plant: Any, gain: Gain, modes: Any, shift: float | None) -> Abscissa:
        assert comm.allgather(shift) == [shift] * comm.size
        return abscissa(plant, gain, modes, shift)

    monkeypatch.setattr(divided, "abscissa", together)
    monkeypatch.setattr(divided, "factor_on_every_rank", lambda *_, **__: False)
    (last,) = certificates.of(gains[1:])
    assert isinstance(last, Abscissa)


@pytest.mark.ranks(2)
def test_a_gain_without_a_spectrum_leaves_no_rank_waiting(comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = make_problem(build(make_scene(CONTROL, KELVIN), comm=comm))
    K = modal_start(Plant(problem)).gain.times(-np.linalg.inv(np.linalg.cholesky(problem.R)))
    gains = [Gain.of_block(K), Gain.of_block(K.times(np.eye(2) * 0.5))]

    def fails(plant: Any, gain: Gain, *arguments: Any) -> Abscissa:
        if np.array_equal(gain.K_s, gains[1].K_s):
            raise SolverError("none converges")
        return abscissa(plant, gain, *arguments)

    monkeypatch.setattr(divided, "abscissa", fails)
    first, second = Certificates(problem, gains[0]).of(gains)
    assert isinstance(first, Abscissa)
    assert str(second) == "none converges"


@pytest.mark.ranks
def test_the_optimal_gain_is_judged_beside_a_reduced_one(comm: MPI.Intracomm) -> None:
    scene = load_scene(SCENE, ["tissue.cells=[8,16]"])
    before, later = (design(build(scene, comm=comm), judged=judged) for judged in (True, False))
    tables = [reduce_gains(made, [6, 8, 12], names=(A_PRIORI,), offered_only=True) for made in (before, later)]
    judge(later)
    assert abs(later.quality.abscissa - before.quality.abscissa) < 1e-8  # tolerance 1e-9 of poles of size 10
    for one, other in zip(*(table[0].reports for table in tables), strict=True):
        assert (one.examined, one.stable) == (other.examined, other.stable)
        assert abs(one.abscissa_full - other.abscissa_full) < 1e-8
