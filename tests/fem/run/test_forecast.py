"""What a run would cost on other ranks: against a run, and by what must hold of any model."""

from __future__ import annotations

import time

import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.fem.run.contact.expected import expected_contact
from softgrasp.fem.run.forecast import RANKS, START, forecast, forecasts, told
from softgrasp.fem.run.simulate import Run, RunOptions, simulate
from tests.helpers.models import make_scene

BLOCK = ["tissue.refine=false", "tissue.order=2", "tissue.cells=[8, 6, 16]", "output.fields=none"]


@pytest.mark.ranks
def test_a_scene_is_told_for_its_own_ranks_and_others(comm: MPI.Intracomm) -> None:
    model = build("block_3d", BLOCK, comm)
    found = forecasts(model)
    assert [f.ranks for f in found] == sorted({*RANKS, comm.size})
    assert comm.allgather(found) == [found] * comm.size
    seconds = [f.seconds for f in found]
    assert seconds == sorted(seconds, reverse=True), "21 177 unknowns gain from 128 ranks yet"
    assert [f.memory for f in found] == sorted(f.memory for f in found)
    text = told(found)
    assert all(f" on {f.ranks}" in text for f in found)
    parts = found[0]
    assert parts.seconds == START + parts.build + parts.setup + parts.equilibrium + parts.steps
    assert parts.fields == 0, "no field files are asked for"


def test_nothing_is_told_at_finite_strain(comm: MPI.Intracomm) -> None:
    model = build(make_scene(effects={"finite_strain": {}}), comm=comm)
    assert forecasts(model) == ()
    assert told(()) == ""


def test_growth_and_small_runs() -> None:
    """A start of its own, then at least like n; a small run gains nothing by ranks."""
    scene = make_scene()
    small, large, larger = (forecast(scene, n, 2, n, 1) for n in (1_000, 100_000, 400_000))
    assert small.seconds < 1.2 * START
    assert larger.build == 4 * large.build
    assert 4 <= larger.steps / large.steps < 4**1.6  # the solver changes between them
    assert forecast(scene, 1_000, 2, 1_000, 128).seconds > 0.9 * small.seconds


@pytest.mark.serial
@pytest.mark.parametrize(
    ("scene", "overrides"),
    [("set_down", []), ("set_down_3d", ["tissue.order=1", "tissue.cells=[6, 6, 3]", "time={steps=60, end=0.05}"])],
)
def test_contact_is_expected_where_a_run_has_it(scene: str, overrides: list[str]) -> None:
    model = build(scene, overrides)
    runs: list[Run] = []
    expected, contact = expected_contact(model), simulate(model, RunOptions(begin=runs.append)).contact
    assert expected is not None
    assert contact is not None
    # one node or two of a side may touch by their height, not by the deformation
    assert contact.columns <= expected.columns <= contact.columns + 2
    n, plain = model.system.layout.n_e, model.scene.model_copy(update={"obstacle": None})
    with_it, without = (forecast(plain, n, model.system.layout.dimension, model.cells, 1, touching=each)
                        for each in (expected, None))  # fmt: skip
    swept = runs[0].contact.responses.swept
    kept = 8 * int(swept.at[swept.count])
    assert with_it.memory - without.memory > kept  # columns alone; the rest is measured on 1089 nodes
    assert with_it.seconds > without.seconds


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.parametrize(
    ("scene", "overrides"),
    [
        ("block_3d", [*BLOCK, "time.solver=mumps"]),
        ("block_3d", [*BLOCK, "time.solver=stars"]),
        (
            "set_down_3d",  # 169 nodes slip and stick; without the part of friction a third is expected
            [
                "tissue.order=1", "tissue.cells=[12, 12, 3]",
                "obstacle=[{kind='halfspace', normal=[0, 0, 1], offset=-0.001, friction=0.3}]",
            ],
        ),
    ],
)  # fmt: skip
def test_a_run_takes_what_is_told(scene: str, overrides: list[str]) -> None:
    """Within a factor of three: caches and clocks of machines differ, and what else runs."""
    begin = time.process_time()
    model = build(scene, overrides)
    simulate(model)
    spent, expected = time.process_time() - begin, forecasts(model)[0]
    assert (expected.seconds - START) / 3 < spent < 3 * (expected.seconds - START)
