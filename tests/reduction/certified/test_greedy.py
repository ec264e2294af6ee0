"""The greedy: its loop on made-up bounds, and certified models that it builds for scenes."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem import forked
from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import times_columns, total
from softgrasp.reduction.certified import shared
from softgrasp.reduction.certified.archive import load_certified, save_certified
from softgrasp.reduction.certified.greedy import Greedy, greedy, start
from softgrasp.reduction.certified.trainer import (
    ADDED,
    Trainer,
    build_certified,
    motions_of,
    offline_mesh_estimate,
    state_of,
    train_key,
    validate,
)
from softgrasp.reduction.parameters import materials_at
from tests.helpers.certified import KELVIN_VOIGT, error_to, full_at
from tests.helpers.models import LAYERS, close, make_scene

BOX: dict[str, Any] = {"reduction": {"lambda_range": [30.0, 500.0], "mu_range": [20.0, 500.0], "grid": 5}}
SMALL: dict[str, Any] = {"time": {"steps": 40}}


class Made:
    """Bounds that fall by a factor at the trained point, and less around it."""

    def __init__(self, points: int = 30, factor: float = 0.1, adds: int = 2) -> None:
        self.x, self.values = np.linspace(0, 1, points), np.ones(points)
        self.factor, self.adds, self.k, self.asked, self.trained = factor, adds, 0, 0, []

    def train(self, i: int) -> int:
        self.trained.append(i)
        self.values *= 1 - (1 - self.factor) * np.exp(-20 * abs(self.x - self.x[i]))
        self.k += self.adds
        return self.k

    def bound(self, indices: Sequence[int]) -> list[float]:
        self.asked += len(indices)
        return [float(self.values[i]) for i in indices]


@pytest.mark.serial
def test_greedy_trains_the_worst_point_and_looks_where_it_could_be() -> None:
    made, seen = Made(), []
    state = greedy(made.train, made.bound, start(30), 15, 0.05, 1000, seen.append)
    assert state.reached
    assert made.trained[0] == 15
    assert state.rounds[-1].bound == made.values.max() <= 0.05
    assert state.rounds[-1].evaluations == made.asked
    assert made.asked < 0.7 * 30 * len(state.rounds)  # lazily
    assert len(seen) == len(state.rounds)
    # every round trains what was the worst point after the round before it
    brute = Made()
    brute.train(15)
    for i in made.trained[1:]:
        assert i == int(np.argmax(brute.values))
        brute.train(i)


@pytest.mark.serial
def test_greedy_goes_on_where_it_was_interrupted() -> None:
    whole = Made()
    state = greedy(whole.train, whole.bound, start(30), 15, 0.05, 1000)
    states: list[Greedy] = []
    made = Made()
    greedy(made.train, made.bound, start(30), 15, 0.3, 1000, states.append)
    again = greedy(made.train, made.bound, replace(states[-1], reason=""), 15, 0.05, 1000)
    assert made.trained == whole.trained
    assert [r.k for r in again.rounds] == [r.k for r in state.rounds]


@pytest.mark.serial
def test_greedy_names_why_it_stops() -> None:
    made = Made(factor=0.9999)
    assert greedy(made.train, made.bound, start(30), 0, 1e-3, 1000).reason == "stagnation"
    made = Made()
    assert greedy(made.train, made.bound, start(30), 0, 1e-9, 10).reason == "size"
    made = Made(adds=0)
    assert greedy(made.train, made.bound, start(30), 0, 1e-9, 10).reason == "exhausted"
    one = Made(points=1)
    assert greedy(one.train, one.bound, start(1), 0, 0.2, 10).reached


def trained(comm: MPI.Intracomm, tolerance: float, *changes: dict[str, Any]) -> tuple[Model, Trainer, Any]:
    model = build(make_scene(KELVIN_VOIGT, SMALL, BOX, *changes), comm=comm)
    trainer = Trainer(model)
    return model, trainer, build_certified(trainer, tolerance)


@pytest.mark.ranks(2)
def test_a_model_to_a_tolerance(comm: MPI.Intracomm) -> None:
    """Within the tolerance on the grid and between; the true error is below what is proved; all ranks agree."""
    model, trainer, certified = trained(comm, 0.1)
    assert certified.training["reason"] == "tolerance"
    assert certified.training["proved"] <= 0.1
    assert certified.k < certified.k2
    for values in comm.allgather((certified.training["proved"], certified.k, certified.training["chosen"])):
        assert values == (certified.training["proved"], certified.k, certified.training["chosen"])
    K, Phi = trainer.space.system.K_ee, trainer.Phi
    assert np.abs(total(comm, Phi.T @ times_columns(K, Phi)) - np.eye(certified.k2)).max() < 1e-9
    for place in ((40.0, 300.0), (123.0, 31.0), (499.0, 21.0)):
        materials = certified.materials(*place)
        run = certified.run(materials)
        system, full = full_at(model, materials)
        error, size = error_to(system, full, certified, run)
        assert (run.certificate.energy.values >= error - 1e-9 * size).all()
        assert error.max() / size <= run.certificate.reduction <= 0.1
    checked = validate(trainer, certified, 3)
    assert 0.5 < checked.factor < 1.5
    assert checked.share == pytest.approx(1 - 0.05 ** (1 / 3))
    trainer.destroy()


@pytest.mark.ranks(2)
def test_a_training_goes_on_from_its_file(comm: MPI.Intracomm, mpi_tmp_path: Any) -> None:
    model, trainer, coarse = trained(comm, 0.3)
    save_certified(coarse, mpi_tmp_path / "model.h5")
    old = load_certified(mpi_tmp_path / "model.h5", model.system.layout)
    assert old.training["key"] == train_key(model)
    again = Trainer(model, old)
    finer = build_certified(again, 0.1, state_of(old))
    _, other, whole = trained(comm, 0.1)
    assert finer.training["chosen"] == whole.training["chosen"]
    assert finer.k2 == whole.k2
    assert again.full_runs < other.full_runs
    a, b = (m.with_sizes(4, whole.k2).run(allow=True).certificate.energy.values for m in (finer, whole))
    assert close(a, b) < 1e-6
    for used in (trainer, again, other):
        used.destroy()


@pytest.mark.serial
def test_unit_motions_train_for_every_direction(comm: MPI.Intracomm) -> None:
    """Trained along x alone the bound knows that it was not trained along y; unit motions cover both."""
    along: dict[str, Any] = {"motion": {"target": [5.0, 0.0]}}
    unit: dict[str, Any] = {"reduction": {**BOX["reduction"], "motions": "unit", "grid": 2}}
    own: dict[str, Any] = {"reduction": {**BOX["reduction"], "grid": 2}}
    _, one, narrow = trained(comm, 0.2, along, own)
    _, both, wide = trained(comm, 0.2, along, unit)
    assert [m.scene.motion.target for m in motions_of(both.model)] == [[5.0, 0.0], [0.0, 5.0]]
    across = both.drives[1]
    materials = narrow.materials(122.0, 100.0)
    assert wide.run(materials, across, allow=True).certificate.reduction <= 0.2
    assert narrow.run(materials, across, allow=True).certificate.reduction > 0.2
    with pytest.raises(SceneError, match="needs a prescribed quintic"):
        motions_of(build(make_scene(unit, {"motion": {"target": None, "profile": "hold"}}), comm=comm))
    one.destroy()
    both.destroy()


@pytest.mark.serial
def test_random_parameters_above_the_grid_are_trained_too(comm: MPI.Intracomm) -> None:
    """One point of the grid alone leaves its box uncovered; the random ones that show it join the training."""
    one: dict[str, Any] = {"reduction": {**BOX["reduction"], "grid": 1, "certify": "proof"}}
    _, trainer, certified = trained(comm, 0.3, one)
    count = len(certified.training["added"])
    assert certified.training["reason"] == "tolerance"
    assert 0 < count < ADDED
    assert len(trainer.points) == 1 + count
    assert certified.training["proved"] <= 0.3
    last = certified.training["rounds"][-1]
    assert last["bound"] <= 0.3
    trainer.destroy()


@pytest.mark.serial
def test_layers_apart(comm: MPI.Intracomm) -> None:
    """Every layer has factors of its own; materials with other ratios are inside, and certified."""
    layers: dict[str, Any] = {"tissue": {"layers": {"low": {**LAYERS["low"], "beta": 0.002}}}}
    apart: dict[str, Any] = {"reduction": {**BOX["reduction"], "layers": "apart", "grid": 4}}
    model, trainer, certified = trained(comm, 0.3, layers, apart)
    ratios = {round(m[0].lam / m[1].lam, 6) for m in trainer.parameters}
    assert len(ratios) > 10
    first, second = certified.fine.materials
    mixed = (replace(first, lam=400.0, mu=30.0), replace(second, lam=second.lam, mu=2 * second.mu))
    run = certified.run(mixed, allow=True)
    assert run.certificate.inside
    assert not replace(certified, box=replace(certified.box, independent_layers=False)).inside(mixed)
    system, full = full_at(model, mixed)
    error, size = error_to(system, full, certified, run)
    assert (run.certificate.energy.values >= error - 1e-9 * size).all()
    trainer.destroy()


@pytest.mark.serial
def test_the_mesh_has_a_number(comm: MPI.Intracomm) -> None:
    model = build(make_scene(KELVIN_VOIGT, SMALL), comm=comm)
    number = offline_mesh_estimate(model, [materials_at(model, 50.0, 50.0), materials_at(model, 500.0, 50.0)])
    assert len(number.estimates) == 2
    assert 0.01 < number.largest < 1


@pytest.mark.serial
def test_scenes_that_cannot_be_trained(comm: MPI.Intracomm) -> None:
    outside: dict[str, Any] = {"reduction": {"lambda_range": [100.0, 500.0]}}
    with pytest.raises(SceneError, match=r"lies outside reduction\.lambda_range"):
        Trainer(build(make_scene(outside), comm=comm))


@pytest.mark.serial
def test_rounding_adds_no_modes() -> None:
    """A tolerance that no double reaches ends with a reason, not with modes of rounding that are dependent."""
    scene = make_scene(KELVIN_VOIGT, SMALL, {"reduction": {**BOX["reduction"], "grid": 2, "add": 20}})
    trainer = Trainer(build(scene, comm=MPI.COMM_SELF))
    certified = build_certified(trainer, 1e-14)
    trainer.destroy()
    assert certified.training["reason"] == "exhausted"
    assert certified.run(allow=True).certificate.reduction < 1e-9  # the bound at rounding


@pytest.mark.serial
def test_bounds_by_two_processes_are_those_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same bits, for even and odd numbers of parameters and another model; a lost process has no follower."""
    monkeypatch.setattr(forked, "cores", lambda: 2)
    monkeypatch.setattr(shared, "PAYS", 0.0)
    _, trainer, certified = trained(MPI.COMM_SELF, 0.3)
    here, asked = os.getpid(), list[int]()

    def counted(many: Any, model: Any) -> list[float]:
        if os.getpid() == here:
            asked.append(len(many))
        return trainer._own_bounds(many, model)

    two, many = shared.TwoProcesses(counted), trainer.parameters
    smaller = replace(certified, k=certified.k - 1, certify="two")
    alone = {id(model): trainer._own_bounds(many, model) for model in (certified, smaller)}
    assert two(many, certified) == alone[id(certified)]  # nothing is known of the times yet
    for model, count in ((certified, 25), (certified, 8), (smaller, 9)):
        assert two(many[:count], model) == alone[id(model)][:count]
    assert asked == [25, 13, 4, 5]
    assert two._other is not None
    two._other.process.kill()
    assert two(many, smaller) == alone[id(smaller)]
    assert asked[-1] == 25
    assert two(many, certified) == alone[id(certified)]
    assert asked[-1] == 25
    assert two._other is None
    trainer.destroy()
