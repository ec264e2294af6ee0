"""Accuracy against time of feedback: Riccati equation and reduced equations; each against something else."""

from __future__ import annotations

import csv
import json
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from rich.console import Console

from softgrasp.fem.errors import Interrupted, SceneError
from softgrasp.fem.model.build import build
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.reduced.riccati import gain_error
from softgrasp.lqr.riccati import solve
from softgrasp.study.precision import plots as work_plots
from softgrasp.study.precision import riccati as wp_riccati
from softgrasp.study.precision.cache import Cache
from softgrasp.study.precision.points import CONTROL, ReducedRiccatiPoint, Request, RiccatiPoint
from softgrasp.study.precision.result import Question, RiccatiReference, WorkStudy
from softgrasp.study.precision.run import run_study, study_scene
from softgrasp.study.precision.tables import paper_of, question_table, reference_text
from tests.helpers.browser import look
from tests.helpers.models import make_scene, rough_save, write_scene

SMALL: dict[str, Any] = {
    "name": "small",
    "tissue": {"cells": [3, 4]},
    "effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.01}},
    "motion": {"target": [1.0, 0.5], "duration": 3.0},
    "time": {"steps": 64, "end": 6.0},
    "control": {"outputs": [{"kind": "node", "point": [0.5, 0.0], "name": "tip"}], "Q": 10.0, "N": [4, 6, 8]},
    "study": {"repeats": 1},
}
ALL = ",".join(CONTROL)


@pytest.fixture(autouse=True, scope="module")
def _rough() -> Iterator[None]:
    """No test looks at a time, or at more than the existence of a picture."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(work_plots, "save", rough_save)
        patch.setattr(wp_riccati, "REPEAT_SECONDS", 0.0)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    comm = MPI.COMM_WORLD
    return Path(comm.bcast(str(tmp_path_factory.mktemp("control")) if comm.rank == 0 else None))


@pytest.fixture(scope="module")
def result(folder: Path) -> dict[str, Any]:
    """The command on a small scene, once for all tests."""
    file = write_scene(MPI.COMM_WORLD, folder, make_scene(SMALL))
    return run_study(file, folder, [], Console(quiet=True), questions=[ALL], quiet=True)


def the_problem(comm: MPI.Intracomm) -> RiccatiProblem:
    return make_problem(build(make_scene(SMALL), comm=comm))


def asked(comm: MPI.Intracomm, cache: Path, changes: dict[str, Any], names: str = ALL) -> WorkStudy:
    return study_scene(make_scene(SMALL, changes), comm, cache, Request(names=(names,)))


# --- Riccati equation


def test_gain_errors_agree_with_the_dense_solution(comm: MPI.Intracomm, result: dict[str, Any]) -> None:
    rows = result["points"]["riccati"]
    assert {r["series"] for r in rows} == {"newton_adi", "radi", "galerkin", "dense"}
    problem = the_problem(comm)
    oracle = solve(problem, "dense").gain
    own = result["references"]["riccati"]["error"]
    # two low-rank methods to 1e-11 or better on a small plant
    assert own < 1e-9
    for row in rows:
        if row["series"] == "dense" or row["tolerance"] not in (1e-2, 1e-6) or not row["ok"]:
            continue
        true = gain_error(problem, oracle, solve(problem, row["series"], row["tolerance"]).gain)
        # rounding of the dense solution, and of a solution that is made again
        assert row["error"] == pytest.approx(true, rel=1e-3, abs=10 * own + 1e-11)
        if row["series"] != "galerkin":
            assert row["residual"] <= 2 * row["tolerance"]  # and what compression may add


def test_no_method_is_its_own_judge(result: dict[str, Any]) -> None:
    # a solution compared with itself would have the error 0
    assert all(r["error"] > 0 for r in result["points"]["riccati"] if r["ok"])


def test_a_tolerance_below_rounding_is_a_point_that_is_not_reached() -> None:
    bad = RiccatiPoint("radi", "RADI", np.inf, np.inf, False, method="radi", tolerance=1e-16, residual=np.inf)
    good = RiccatiPoint("radi", "RADI", 0.1, 1e-9, method="radi", tolerance=1e-8, residual=1e-9)
    rows = question_table("riccati", [good, bad]).rows
    assert rows[0][-1] == "*"
    assert rows[1][-1] == "not reached"
    assert rows[1][2] == "-"


# --- reduced Riccati equations


def test_reduced_gains_have_errors_costs_and_times(result: dict[str, Any]) -> None:
    rows = [r for r in result["points"]["reduced_riccati"] if r["ok"]]
    assert {r["series"] for r in rows} >= {"pod", "structured"}
    best = [r for r in rows if r["series"] == "structured"]
    assert [r["N"] for r in best] == [4, 6, 8]
    errors, costs = [r["error"] for r in best], [r["cost_excess"] for r in best]
    assert errors == sorted(errors, reverse=True)
    assert max(costs) < 1e-4  # below the square of the largest error, 1e-2
    assert all(0 < r["seconds"] < r["scratch"] for r in rows)


def test_unstable_gains_are_marked_and_never_on_the_front(tmp_path: Path) -> None:
    good = ReducedRiccatiPoint(
        "pod", "POD", 1e-3, 1e-2, method="pod", N=8, error_P=1e-2, error_K=1e-2, cost_excess=0.1,
        abscissa_full=-0.4, time_are=1e-3, stable=True,
        certified=True, reason="", sampled_radius=0.9, time_lift=0.0, time_basis=0.0, scratch=1.0,
    )  # fmt: skip
    bad = replace(good, seconds=1e-4, error=1e-9, ok=False, cost_excess=np.inf, abscissa_full=0.4, stable=False)
    assert [r[-1] for r in question_table("reduced_riccati", [bad, good]).rows] == ["unstable", "*"]
    assert [r["pareto"] for r in Question((bad, good)).rows] == [False, True]
    # a basis that has no look of its own is drawn too
    assert work_plots.figure_reduced_riccati([replace(good, series="other"), bad], False, tmp_path / "gains.png")


# --- resuming, refusing, files


@pytest.mark.serial
def test_interrupted_study_of_feedback_gives_the_same_table(
    comm: MPI.Intracomm, result: dict[str, Any], mpi_tmp_path: Path
) -> None:
    scene = make_scene(SMALL)
    seen: list[str] = []

    def stop_later(label: str, share: float) -> None:
        assert 0 <= share <= 1
        seen.append(label)
        if label.startswith("reduced Riccati equation"):
            signal.raise_signal(signal.SIGINT)  # Ctrl-C

    with pytest.raises(Interrupted, match="goes on from there"):
        study_scene(scene, comm, mpi_tmp_path, Request(names=(ALL,)), stop_later)
    comm.Barrier()
    kept = {f.name: f.read_text() for f in mpi_tmp_path.glob("*.json")}
    comm.Barrier()
    study = study_scene(scene, comm, mpi_tmp_path, Request(names=(ALL,)))
    assert study.cached >= len(kept)
    assert {name: (mpi_tmp_path / name).read_text() for name in kept} == kept
    for name in CONTROL:
        old, new = result["points"][name], study.questions[name].rows
        assert [r["label"] for r in new] == [r["label"] for r in old]
        assert [r["ok"] for r in new] == [r["ok"] for r in old]
        if name == "riccati":
            continue  # gain errors near rounding are noise
        for a, b in zip(new, old, strict=True):
            # solutions made again differ by rounding, which errors of 1e-6 see to a few digits
            assert (a["error"] is None) == (b["error"] is None)
            assert a["error"] is None or a["error"] == pytest.approx(b["error"], rel=1e-3, abs=1e-9)
    again = study_scene(scene, comm, mpi_tmp_path, Request(names=(ALL,)))
    assert again.measured == 0
    assert again.questions == study.questions


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.0}}}, "no damping"),
        ({"control": {"outputs": SMALL["control"]["outputs"], "method": "modal"}}, "control.method = 'modal'"),
        ({"motion": {"target": None, "profile": "hold"}}, "motion.target is missing"),
    ],
)
def test_scenes_without_an_answer_are_told_why(
    comm: MPI.Intracomm, mpi_tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    study = asked(comm, mpi_tmp_path, changes)
    assert set(study.skipped) == set(CONTROL)
    assert not study.points
    assert all(words in reason and "\n" not in reason for reason in study.skipped.values())


def test_a_scene_without_control_has_the_other_questions_only(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    study = study_scene(
        make_scene({k: v for k, v in SMALL.items() if k != "control"}, {"control": None}), comm, mpi_tmp_path,
        Request(names=("riccati", "reduced_riccati")),
    )  # fmt: skip
    assert study.skipped == dict.fromkeys(("riccati", "reduced_riccati"), "the scene has no [control] section")


def test_large_scenes_are_asked_by_name_only(
    comm: MPI.Intracomm, mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wp_riccati, "LARGE", {2: 10, 3: 10})
    model, store = build(make_scene(SMALL), comm=comm), Cache(mpi_tmp_path, comm, make_scene(SMALL))
    runs = [wp_riccati.ControlRuns(model, store, names) for names in ((), ("riccati",))]
    assert "--question" in runs[0].refused()
    assert runs[1].refused() == ""
    assert wp_riccati.tolerances_of("radi", runs[1].large) == wp_riccati.FEW_TOLERANCES


def test_questions_are_checked() -> None:
    assert Request().questions == ("forward", "reduced", "bases", *CONTROL)
    assert Request(names=("reduced_riccati, riccati",)).questions == ("riccati", "reduced_riccati")
    with pytest.raises(SceneError, match=r"^--question what: it must be one of forward, .*reduced_riccati$"):
        Request(names=("what",))
    with pytest.raises(SceneError, match=r"^--tolerance and --budget need the questions forward and reduced"):
        Request(tolerance=1e-3, names=("riccati",))


def test_files_hold_the_questions_of_control(result: dict[str, Any], folder: Path) -> None:
    saved = json.loads((folder / "result.json").read_text())
    assert saved["points"] == result["points"]
    assert saved["reference"] is None
    with (folder / "points.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {r["question"] for r in rows} == set(CONTROL)
    assert len(rows) == sum(len(v) for v in result["points"].values())
    page = (folder / "report.html").read_text()
    assert page.count("data:image/png") == 2
    assert "--question riccati,reduced_riccati" in page
    assert page.count("<h2>Equation") == 1  # that of the controlled hand: no question follows the scene's own motion
    assert "controlled by" in page
    assert "the motion is prescribed" not in page
    assert all((folder / f"work_{name}.png").stat().st_size > 0 for name in CONTROL)


@pytest.mark.serial
def test_page_in_a_browser(result: dict[str, Any], folder: Path) -> None:
    assert look(folder / "report.html", figures=2) == []


def test_the_paper_is_named_for_its_own_scene_only() -> None:
    question = Question(reference=RiccatiReference(("RADI to 1e-12",), None, (1e-12,)))
    scenes = [make_scene(SMALL, {"name": n, "tissue": {"cells": [10, 20]}}) for n in ("paper_lqr", "other")]
    told = [reference_text(question, paper_of(scene) == "control") for scene in scenes]
    assert "84.53 s" in told[0]
    assert "84.53 s" not in told[1]
    assert "no second method" in told[1]


@pytest.mark.ranks(2)
def test_numbers_do_not_depend_on_the_rank_count(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    study = asked(comm, mpi_tmp_path, {"control": SMALL["control"] | {"N": [4, 6]}}, "reduced_riccati")
    whole = make_scene(SMALL, {"control": SMALL["control"] | {"N": [4, 6]}})
    alone = study_scene(whole, MPI.COMM_SELF, mpi_tmp_path / f"alone{comm.rank}", Request(names=("reduced_riccati",)))
    pairs = zip(study.points["reduced_riccati"], alone.points["reduced_riccati"], strict=True)
    for a, b in pairs:
        assert a.label == b.label
        if a.series == "structured":  # small singular vectors of P, which the others contain, are rounding
            assert a.ok
            assert b.ok
            assert a.error == pytest.approx(b.error, rel=1e-6)  # modes by another solver
