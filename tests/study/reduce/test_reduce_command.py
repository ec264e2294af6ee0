"""`softgrasp reduce` as a command: its files, what it refuses, headlines, speed."""

from __future__ import annotations

import csv
import io
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from rich.console import Console

from softgrasp.fem.errors import SceneError, SoftgraspError
from softgrasp.fem.model.build import build
from softgrasp.fem.scene.file import load_scene
from softgrasp.reduction.archive import load
from softgrasp.reduction.bases.registry import METHODS, PAPER_METHODS
from softgrasp.reduction.bases.states import BasisError
from softgrasp.reduction.parameters import grid_of, outside
from softgrasp.reduction.replay import FullRun, replay_linear
from softgrasp.study.reduce.linear.measure import (
    FURTHER,
    headline_turns,
    sweep,
)
from softgrasp.study.reduce.linear.plots import instants
from softgrasp.study.reduce.linear.views import gather_views
from softgrasp.study.reduce.run import run_reduce
from softgrasp.study.reduce.times import FullTimes, Spread, Turns
from softgrasp.study.shell.timing import processor_seconds
from tests.helpers.browser import find_chromium, look
from tests.helpers.full_runs import PAPER, SMALL, made, wanted
from tests.helpers.models import make_scene

GRAVITY: dict[str, Any] = {
    "tissue": {"cells": [2, 4]},
    "time": {"steps": 40, "start": "equilibrium"},
    "effects": {"gravity": {"g": [0.0, -9.81]}},
    "motion": {"target": [0.5, 0.3], "duration": 1.0},
}


def reduced(path: Path, *overrides: str, pictures: bool = True, width: int = 200) -> tuple[dict[str, Any], str]:
    text = io.StringIO()
    console = Console(file=text, width=width, quiet=MPI.COMM_WORLD.rank != 0)
    result = run_reduce(PAPER, path, [*SMALL, *overrides], console, quiet=True, pictures=pictures)
    return result, text.getvalue()


KEYS = {
    "N", "N_tissue", "split", "error", "error_canonical", "error_deformation", "error_energy", "projection_error",
    "time_offline", "time_setup", "time_online", "spectral_abscissa", "stable",
}  # fmt: skip


@pytest.mark.ranks(2)
def test_command_writes_what_design_promises(mpi_tmp_path: Path, small: FullRun) -> None:
    names = ["global_pod", "psd_fixed", "craig_bampton"]
    result, text = reduced(mpi_tmp_path, f"reduction.methods={names}", "reduction.N=[4,14,20]")
    if MPI.COMM_WORLD.rank == 0:
        saved = json.loads((mpi_tmp_path / "result.json").read_text())
        assert list(saved["methods"]) == names
        assert all(row.keys() >= KEYS for rows in saved["methods"].values() for row in rows)
        assert [(row["N"], row["N_tissue"]) for row in saved["methods"]["psd_fixed"]] == [(14, 10), (20, 16)]
        assert [(row["N"], row["N_tissue"]) for row in saved["methods"]["global_pod"]] == [(N, N) for N in (4, 14, 20)]
        assert saved["findings"] == result["findings"]
        assert saved["about"]["psd_fixed"]["paper"] == "PSD with fixed solid modes"
        assert saved["about"]["craig_bampton"]["paper"] is None
        assert len(saved["box"]["points"]) == 9  # a 3 x 3 grid
        assert {row["method"] for row in saved["box"]["summary"]} <= set(names)
        assert len(saved["speed"]) == 3
        assert not any("paper" in note for note in saved["speed_notes"])  # its times are those of another mesh
        lines = list(csv.DictReader((mpi_tmp_path / "points.csv").open()))
        assert len(lines) == sum(map(len, saved["methods"].values()))
        for name in ("errors", "errors_beyond", "times", "sigma", "modes", "compare"):
            assert (mpi_tmp_path / f"{name}.png").stat().st_size > 5000, name
        assert (mpi_tmp_path / "compare.gif").stat().st_size > 5000
        assert "linear elasticity" in (mpi_tmp_path / "pull.html").read_text()
        assert 'href="pull.html"' in (mpi_tmp_path / "report.html").read_text()
        if MPI.COMM_WORLD.size == 1 and find_chromium():
            assert look(mpi_tmp_path / "report.html", figures=8) == []
        for words in ("PSD complex SVD, fixed", "Break-even mesh", "N counts all columns of V", "x new"):
            assert words in text
        for sentence in saved["findings"]:
            assert " ".join(sentence.split()) in " ".join(text.split())
    MPI.COMM_WORLD.Barrier()
    again = load(mpi_tmp_path / "models" / "psd_fixed.h5", small.model.system.layout)
    assert again.N == 20  # the best stable model, with the hand's columns
    assert again.split == (16,)
    assert (
        np.abs(replay_linear(again, small.model, small).outputs - small.trajectory.outputs).max() < 1e-2
    )  # m, of a way of 5 m


def test_instants_show_large_deformations_apart_from_each_other(small: FullRun) -> None:
    views = gather_views(small.model, small, [sweep("craig_bampton", small, wanted(small, [6]))])
    if views is None:
        return  # rank 0 draws
    chosen = instants(views)
    hand = np.column_stack([np.interp(views.times, views.table[:, 0], q) for q in views.table[:, 1:].T])
    size = [np.abs(u - views.picture.rigid(q)).max() for u, q in zip(views.full, hand, strict=True)]
    assert chosen == sorted(chosen)
    assert 2 <= len(chosen) <= 3
    assert max(size[k] for k in chosen) > 0.8 * max(size)  # all but those that would touch: 0.87
    boxes = [(x.min(axis=0), x.max(axis=0)) for x in (views.picture.points + views.full[k] for k in chosen)]
    for i, (low, high) in enumerate(boxes):
        assert all((low > top).any() or (bottom > high).any() for bottom, top in boxes[:i])


def test_without_pictures(mpi_tmp_path: Path) -> None:
    reduced(mpi_tmp_path, "reduction.methods=['craig_bampton']", "reduction.N=[6]", pictures=False)
    MPI.COMM_WORLD.Barrier()
    assert {p.name for p in mpi_tmp_path.iterdir()} == {
        "result.json", "points.csv", "scene.toml", "report.html", "models", "softgrasp.files",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("override", "error", "words"),
    [
        ("reduction.methods=['pod','psd']", BasisError, ("'pod'", "psd_fixed")),
        ("output.snapshots='none'", SceneError, ("output.snapshots", "'memory'")),
    ],
)
def test_wrong_input_is_one_sentence(
    mpi_tmp_path: Path, override: str, error: type[SoftgraspError], words: tuple[str, ...]
) -> None:
    with pytest.raises(error) as caught:
        reduced(mpi_tmp_path / "out", override)
    message = str(caught.value)
    assert all(word in message for word in words)
    assert "\n" not in message
    assert not (mpi_tmp_path / "out").exists()


REFUSED = {  # N asked for, with the words of its reason; the snapshots of [5, 10] cells carry less than 300 columns
    "pod_fixed": {4: "the 4 columns of the hand count; request N >= 5", 300: "snapshots", 2000: "snapshots"},
    "psd_fixed": {4: "request N >= 6", 13: "only even N", 300: "snapshots", 2000: "snapshots"},
    "craig_bampton": {4: "request N >= 6", 13: "only even N", 300: "modes", 2000: "modes"},
}


@pytest.mark.parametrize("name", REFUSED)
def test_every_refused_size_has_its_own_reason(small: FullRun, name: str) -> None:
    asked = [4, 13, 14, 40, 300, 2000]
    swept = sweep(name, small, wanted(small, asked))
    assert [p.N for p in swept.points] == [N for N in asked if N not in REFUSED[name]]
    assert swept.refused.keys() == REFUSED[name].keys()
    for N, reason in swept.refused.items():
        assert REFUSED[name][N] in reason
        assert name not in reason
    most = int(swept.refused[2000].rpartition(" ")[2])
    again = sweep(name, small, wanted(small, [most, most + 2]))
    assert [p.N for p in again.points] == [most]  # what the reason offers exists, the next does not
    assert list(again.refused) == [most + 2]


def test_more_vectors_than_few_snapshots_carry() -> None:
    against = made(load_scene(PAPER, [*SMALL, "output.every=20"]))
    swept = sweep("psd_fixed", against, wanted(against, [8, 40]))
    assert [p.N for p in swept.points] == [8]
    assert list(swept.refused) == [40]
    assert "request N <=" in swept.refused[40]


def test_a_share_that_cannot_be_kept_refuses_no_size(small: FullRun) -> None:
    gram = {"engine": "gram", "energy": 1 - 1e-16}  # it sees singular values down to 1e-8 of the first only
    swept = sweep("psd_fixed", small, wanted(small, [8, 14]).model_copy(update=gram))
    assert [p.N for p in swept.points] == [8, 14]
    assert swept.refused == {}
    assert swept.N_energy is None


def test_terminal_says_what_is_refused(mpi_tmp_path: Path) -> None:
    changes = ["reduction.methods=['pod_fixed', 'psd_fixed', 'craig_bampton']", "reduction.N=[13, 2000]"]
    result, text = reduced(mpi_tmp_path, *changes, pictures=False, width=80)
    assert {key: list(map(int, about["N_refused"])) for key, about in result["about"].items()} == {
        "pod_fixed": [2000], "psd_fixed": [13, 2000], "craig_bampton": [13, 2000],
    }  # fmt: skip
    if MPI.COMM_WORLD.rank == 0:
        refused = " ".join(text[text.index("Refused") :].split())
        for words in ("13 PSD complex", "2000 POD, fixed", "only even N exist for this basis", "more than"):
            assert words in refused, words
        (row,) = (line for line in text.splitlines() if line.startswith("Craig-Bampton") and "refused" in line)
        assert set(row.split()) == {"Craig-Bampton", "-", "refused"}
        assert "stable N" in text  # the last column is whole
        page = (mpi_tmp_path / "report.html").read_text()
        assert "PSD complex SVD, fixed; Craig-Bampton" in page
        assert "only even N exist for this basis" in page


def test_dimension_counts_every_column_of_every_method(coarse: FullRun) -> None:
    hand = 2 * coarse.model.system.layout.n_s
    for name in (*PAPER_METHODS, *FURTHER):
        swept = sweep(name, coarse, wanted(coarse, [10]))
        (p,) = swept.points
        assert (p.N, swept.models[10].N, sum(p.split)) == (10, 10, p.N_tissue), name
        assert p.N_tissue == (10 - hand if METHODS[name].fixed else 10), name


def test_body_at_rest_is_refused_with_one_sentence(mpi_tmp_path: Path) -> None:
    rest = ["tissue.cells=[2,4]", "time.steps=10", "motion.target=[0,0]"]
    for more in ([], ["time.start=equilibrium", "effects.gravity.g=[0,-9.81]"]):
        with pytest.raises(SceneError, match="stay at rest for the whole run") as caught:
            reduced(mpi_tmp_path / "out", *rest, *more)
        assert "\n" not in str(caught.value)
        assert not (mpi_tmp_path / "out").exists()


def test_size_without_an_equilibrium_is_refused_alone() -> None:
    against = made(make_scene(GRAVITY))
    swept = sweep("componentwise_pod_fixed", against, wanted(against, [10, 11]))
    assert [p.N for p in swept.points] == [10]
    assert "no single equilibrium" in swept.refused[11]  # four displacements and three velocities


def test_default_box_follows_the_material() -> None:
    soft = {"tissue": {"cells": [2, 4], "material": {"lambda": 6e4, "mu": 1.5e4, "rho": 1e3}}, "time": {"steps": 10}}
    model = build(make_scene(soft), comm=MPI.COMM_SELF)
    assert outside(model) == ""
    assert grid_of(model)[0] == pytest.approx((3.6e4, 6e3))
    assert grid_of(model)[-1] == pytest.approx((6e5, 1.5e5))
    own = build(make_scene(soft, {"reduction": {"mu_range": [20.0, 500.0]}}), comm=MPI.COMM_SELF)
    assert "mu = 15000 Pa" in outside(own)


def test_a_headline_needs_quartiles_that_agree_and_names_the_error_at_new_materials() -> None:
    close, apart = Spread(24.0, 25.0, 26.0), Spread(20.0, 40.0, 60.0)
    said = Turns(close, close, 9).sentence(7e-3, "33.00% in the median and 84.00% at most at new materials")
    assert said.startswith("Its error of the deformation is 0.7 % at the scene's parameter")
    assert "; it runs 25 (24 to 26) times as fast" in said
    assert "84.00% at most at new materials" in said
    for turns in (Turns(apart, close, 9), Turns(close, apart, 9)):
        assert "too much to name a speed-up" in turns.sentence(7e-3, "")


def test_both_sides_are_timed_by_processor_time_in_turn(small: FullRun) -> None:
    comm = small.model.system.layout.comm
    assert processor_seconds(comm, lambda: time.sleep(0.1)) < 0.05  # as another program's work would pass
    swept = sweep("craig_bampton", small, wanted(small, [14]))
    turns = headline_turns(small, [swept])
    assert turns is not None
    assert turns.rounds == 9
    for spread in (turns.again, turns.new):
        assert 0 < spread.low <= spread.median <= spread.high
    assert turns.new.median < turns.again.median  # a new parameter costs a set-up that no run has
    headline = headline_turns(small, [])
    assert headline is None


def test_speed_counts_runs_to_break_even(small: FullRun) -> None:
    swept = sweep("craig_bampton", small, wanted(small, [6]))
    p = swept.points[0]
    new = p.time_setup + p.time_online
    found = FullTimes(steps=new + 0.4, factor=0.1).against(p)
    assert found.break_even_runs == pytest.approx(2 * p.time_offline)
    assert found.new == pytest.approx((new + 0.5) / new)
    slow = FullTimes(steps=p.time_online / 2, factor=p.time_setup / 2).against(p)
    assert slow.break_even_runs is None
    assert slow.again == pytest.approx(0.5)
