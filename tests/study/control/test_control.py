"""``softgrasp control`` on small scenes: numbers against identities and a plain loop, files, refusals, marks."""

from __future__ import annotations

import csv
import io
import itertools
import json
import re
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from rich.console import Console

from softgrasp.fem.errors import SceneError, SoftgraspError
from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.model.build import build
from softgrasp.fem.scene.file import load_scene
from softgrasp.fem.shown import percent
from softgrasp.lqr.design.orders import BasisGains
from softgrasp.lqr.design.scene import actuation, with_control
from softgrasp.lqr.loop.controller import Controller, load_gain
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.reduced.riccati import GainReport
from softgrasp.study.control.plots import drawn, figure_gains, unstable
from softgrasp.study.control.result import settled
from softgrasp.study.control.run import run_control, unused_rate
from softgrasp.study.report.files import to_json
from tests.helpers.browser import look, words_of
from tests.helpers.models import make_scene

SCENES = Path(__file__).parents[3] / "demos" / "scenes"
SMALL = ["tissue.cells=[4,8]", "control.N=[4,8,12]", "output.fields='none'", "reduction.lambda_range=[50.0,50.0]"]
KEYS = {
    "states", "rank", "newton_steps", "adi_steps", "residual", "optimal_cost", "gain_translation",
    "gain_rigid_velocity", "closed_loop_abscissa", "reduced", "time",
}  # fmt: skip
TWINS = "control.outputs=[{kind='node',point=[0.5,0.0],name='tip'},{kind='hand',name='tip'}]"
POINT = {"N", "error_P", "error_K", "cost_excess", "abscissa_full", "time_are"}


def common(folder: Path) -> Path:
    return Path(MPI.COMM_WORLD.bcast(str(folder)))


@cache
def ran(folder: Path, method: str) -> tuple[dict[str, Any], str]:
    text = io.StringIO()
    console = Console(file=text, width=160, quiet=MPI.COMM_WORLD.rank != 0)
    overrides = [*SMALL, f"control.method='{method}'"]
    run_control(SCENES / "paper_lqr.toml", folder, overrides, console, quiet=True, pictures=False, retune=True)
    return json.loads((folder / "result.json").read_text()), text.getvalue()


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return common(tmp_path_factory.mktemp("control"))


@pytest.fixture(scope="module")
def result(out: Path) -> dict[str, Any]:
    return ran(out, "newton-adi")[0]


@pytest.mark.ranks(2)
def test_result_holds_what_design_names(result: dict[str, Any], out: Path) -> None:
    assert result.keys() >= KEYS
    assert result["time"]["are"] > 0
    assert result["states"] == 160
    assert result["rank"] > 20
    assert result["newton_steps"] >= 1
    assert result["adi_steps"] >= 10
    assert result["residual"] <= 1e-10  # the tolerance of the scene
    assert result["reduced"].keys() == {
        "pod", "weighted_pod", "pod_fixed_solid", "componentwise_pod", "pod_decomposed", "structured",
    }  # fmt: skip
    for points in result["reduced"].values():
        assert [p["N"] for p in points] == [4, 8, 12]
        assert all(p.keys() >= POINT for p in points)


def test_page_and_terminal_have_the_same_tables(result: dict[str, Any], out: Path) -> None:
    text, page = MPI.COMM_WORLD.bcast(ran(out, "newton-adi")[1]), words_of(out / "report.html")
    best = [
        min((p for p in points if p["stable"]), key=lambda p: p["cost_excess"]) for points in result["reduced"].values()
    ]
    for heading in ("best stable gain", "true relative residual", "unstable N"):
        assert heading in text
        assert heading in page
    for point in best:
        for key in ("error_K", "cost_excess_at_most"):
            assert percent(point[key]) in text
            assert percent(point[key]) in page


@pytest.mark.serial
def test_the_gain_alone_has_its_notes_on_page_and_terminal(tmp_path: Path) -> None:
    scene, text = tmp_path / "plain.toml", io.StringIO()
    lines = re.sub(r"(?ms)^\[control\].*?(?=^\[|\Z)", "", (SCENES / "paper_lqr.toml").read_text())
    scene.write_text(lines)
    console = Console(file=text, width=400)
    found = run_control(scene, tmp_path / "out", ["tissue.cells=[2,4]"], console, quiet=True, gain_only=True)
    assert "no [control] table" in found["notes"][0]
    assert found["notes"][0] in text.getvalue()
    assert found["notes"][0] in words_of(tmp_path / "out" / "report.html")


@pytest.mark.ranks(2)
def test_gains_and_cost_agree_with_the_exact_identities(result: dict[str, Any]) -> None:
    """K_T'K_T = Q = I for every mesh, and the cost of a rigid displacement d is d'K_T'K_V d."""
    K_T, K_V = np.array(result["gain_translation"]), np.array(result["gain_rigid_velocity"])
    assert np.abs(K_T.T @ K_T - np.eye(2)).max() < 1e-9  # the residual of the solution
    d = np.array([5.0, 3.0])
    assert result["optimal_cost"] == pytest.approx(d @ K_T.T @ K_V @ d, rel=1e-9)  # the residual of the solution
    assert result["closed_loop_abscissa"] < 0


@pytest.mark.ranks(2)
def test_the_loop_costs_what_the_riccati_equation_says(result: dict[str, Any]) -> None:
    loop = result["loop"]
    assert loop["cost"] + loop["cost_to_come"] == pytest.approx(result["optimal_cost"], rel=1e-9)  # midpoint: exact
    assert loop["distance_first"] == pytest.approx(np.hypot(5, 3))
    assert loop["distance_final"] < 5 * np.exp(300 * result["closed_loop_abscissa"]) * loop["distance_first"]
    assert 0 < loop["settled"] < 60
    for run in loop["reduced"]:
        assert not run["reason"]
        assert run["distance_final"] < 0.05, run  # every gain marked stable reaches the target in T = 300
        assert run["cost"] >= loop["cost"] * (1 - 1e-4)  # no gain beats the optimal one but for the cost to come


@pytest.mark.ranks(2)
def test_every_stable_gain_has_a_proved_bound(result: dict[str, Any]) -> None:
    points = [p for points in result["reduced"].values() for p in points]
    points = [p for p in [*points, *(p for r in result["retune"] for p in r["points"])] if p["stable"]]
    assert len(points) > 10
    for p in points:
        assert p["unbounded"] == ""
        # the excess of the loop without end, from an X with a residual of 1e-10 that the bound does not share
        assert p["cost_excess_at_most"] >= p["cost_excess"] * (1 - 1e-6) - 1e-12, p
        assert 0 <= p["cost_excess_proved"] <= p["cost_excess_at_most"], p
        # the run is made longer while the allowance is more than a tenth of the excess and 1e-6 of the cost
        assert p["cost_excess_at_most"] <= 1.1 * p["cost_excess"] + 1.1e-6, p


class _StopError(Exception):
    pass


@pytest.mark.ranks(2)
def test_an_interrupted_run_goes_on(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch, result: dict[str, Any]
) -> None:
    """Stopped after 30 solves, the second call starts at 26 and ends with the gain of an undisturbed run."""
    folder, solves = common(tmp_path_factory.mktemp("restart")), []

    def bar(stop: float) -> Any:
        def note(entry: dict[str, float]) -> None:
            solves.append(entry["solve"])
            if entry["solve"] == stop:
                raise _StopError

        return lambda *_: note

    def run() -> str:
        text = io.StringIO()
        overrides = [*SMALL, "control.method='newton-adi'", "control.N=[4]"]
        run_control(SCENES / "paper_lqr.toml", folder, overrides, Console(file=text, width=200), pictures=False)
        return text.getvalue()

    monkeypatch.setattr("softgrasp.study.control.run.RESTART_STATES", 0)
    clock = SimpleNamespace(monotonic=itertools.count(1e9, 20).__next__)  # a machine on which files are never too near
    monkeypatch.setattr("softgrasp.lqr.lowrank.newton.time", clock)
    monkeypatch.setattr("softgrasp.study.control.run.solver_bar", bar(30))
    with pytest.raises(_StopError):
        run()
    assert len(list(folder.glob("restart-*/newton-*-rank*.npz"))) == MPI.COMM_WORLD.size
    solves.clear()
    monkeypatch.setattr("softgrasp.study.control.run.solver_bar", bar(-1))
    assert "going on from" in run()
    assert solves[0] == 26
    assert not list(folder.glob("restart-*"))
    again = json.loads((folder / "result.json").read_text())
    assert again["solves"] == result["solves"]
    assert np.abs(np.array(again["gain_translation"]) - result["gain_translation"]).max() < 1e-12  # the same solves


def test_marks_follow_the_spectrum(result: dict[str, Any]) -> None:
    for points in result["reduced"].values():
        for p in points:
            assert p["stable"] == (not p["reason"] and p["certified"] and p["abscissa_full"] < 0), p
            assert (p["cost_excess"] is not None) == p["stable"], p
    best = result["reduced"]["structured"][-1]
    assert best["stable"]
    assert best["error_K"] < 1e-4  # measured 5e-6
    assert best["time_are"] < 0.05  # s; below 1 ms on a quiet machine


def test_re_tuning_covers_the_box(result: dict[str, Any]) -> None:
    tuned = {r["method"]: r for r in result["retune"]}
    assert "structured" in tuned
    assert len(tuned) == 2
    mu = {p["mu"] for p in tuned["structured"]["points"]}
    assert [min(mu), max(mu)] == pytest.approx([20.0, 500.0])
    assert all(p["stable"] and p["cost_excess"] < 1e-3 for p in tuned["structured"]["points"])  # measured 4e-6


@pytest.mark.serial
def test_page_in_a_browser(result: dict[str, Any], out: Path) -> None:
    assert look(out / "report.html", figures=0) == []


def test_files_can_be_used(result: dict[str, Any], out: Path) -> None:
    names = {"result.json", "trajectory.csv", "reduced.csv", "retune.csv", "scene.toml", "report.html"}
    assert names <= {p.name for p in out.iterdir()}
    table = list(csv.reader((out / "trajectory.csv").open()))
    assert len(table) == 602
    assert float(table[-1][1]) == pytest.approx(5.0, abs=1e-5)  # of 5 m after T = 300, 3e-7 is left
    assert len(list(csv.reader((out / "reduced.csv").open()))) == 19
    load_scene(out / "scene.toml", [])
    controller = Controller.load(out / "controller.npz", result["scene_hash"])
    assert controller.plant.N == result["controller"]["N"] == 12
    u = controller.step(np.zeros(2), np.zeros(2))
    assert np.linalg.norm(u) == pytest.approx(np.hypot(5, 3), rel=1e-4)  # |K_T d| = |d|, at the error of this gain
    exported = controller.plant
    labels = [name.split()[0] for name in exported.to_control().output_labels]
    assert labels == result["loop"]["output_names"] == [n.split()[0] for n in table[0][3:5]]
    small = controller.plant
    poles = np.linalg.eigvals(np.linalg.solve(small.E, small.A + small.B @ controller.K))
    closed = exported.under(controller.K).to_control()
    assert closed.poles().real.max() == pytest.approx(poles.real.max(), rel=1e-9)  # one matrix, twice
    assert result["controller"]["sampled_radius"] < 1
    model = build(load_scene(SCENES / "paper_lqr.toml", SMALL), comm=MPI.COMM_WORLD)
    gain, target = load_gain(out / "gain.npz", model.system.layout)
    assert np.allclose(gain.K_s[:, :2], result["gain_translation"], rtol=0, atol=1e-14)  # the same numbers
    assert target.q_s.tolist() == [5.0, 3.0]


def test_the_gain_alone_is_that_of_the_whole_command(result: dict[str, Any], tmp_path: Path) -> None:
    out, same = common(tmp_path) / "alone", [*SMALL, "control.method='newton-adi'"]
    alone = run_control(SCENES / "paper_lqr.toml", out, same, Console(quiet=True), quiet=True, gain_only=True)
    assert "loop" not in alone
    for key in ("residual", "optimal_cost", "gain_translation", "gain_rigid_velocity", "closed_loop_abscissa"):
        assert alone[key] == result[key], key  # the same computation on the same ranks
    assert alone["controller"]["N"] == result["controller"]["N"]
    assert not list(out.glob("*.png"))
    assert (out / "controller.npz").exists()


def test_other_methods_find_the_same(result: dict[str, Any], tmp_path: Path) -> None:
    other = ran(common(tmp_path), "dense")[0]
    assert other["method"].startswith("dense")
    assert other["optimal_cost"] == pytest.approx(result["optimal_cost"], rel=1e-8)  # two solvers at their residuals
    # gain and poles of two residuals of 1e-10
    assert np.allclose(other["gain_rigid_velocity"], result["gain_rigid_velocity"], rtol=0, atol=1e-9)
    assert other["closed_loop_abscissa"] == pytest.approx(result["closed_loop_abscissa"], rel=1e-9)


def refused(name: str, out: Path, *overrides: str) -> str:
    console = Console(file=io.StringIO(), quiet=MPI.COMM_WORLD.rank != 0)
    with pytest.raises(SoftgraspError) as caught:
        run_control(SCENES / f"{name}.toml", out, [*SMALL, *overrides], console, quiet=True, pictures=False)
    MPI.COMM_WORLD.Barrier()  # rank 0 gives the folder back
    assert not out.exists()  # nothing half-written
    return str(caught.value)


def test_no_damping_is_diagnosed_and_modal_feedback_offered(tmp_path: Path) -> None:
    out = common(tmp_path) / "out"
    sentence = refused("paper_lqr_undamped", out)
    assert "no damping" in sentence
    assert "control.method = 'modal'" in sentence
    overrides = [*SMALL, "control.method='modal'"]
    console = Console(file=io.StringIO(), quiet=MPI.COMM_WORLD.rank != 0)
    found = run_control(SCENES / "paper_lqr_undamped.toml", out, overrides, console, quiet=True, pictures=False)
    assert not found["stable"]
    assert found["reduced"] == {}
    assert "stay on the imaginary axis" in found["method"]
    assert found["loop"]["distance_final"] < 0.1  # the body arrives; its swings are not damped by anything


@pytest.mark.ranks(2)
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("control.Q=[[0.0,0.0],[0.0,1.0]]", "not detectable"),
        ("motion={profile='hold'}", "motion.target"),
        ("motion.target=[0.0,0.0]", "motion.target"),
        ("control.R=0.0", "control.R"),
        ("control.outputs=[{kind='node', point=[9.0,9.0]}]", "outside"),
        ("control.loop.sampling='held'", "rate"),
        ("control.Q=[[1.0]]", "control.Q"),
        ("control.R=1e40", "too far apart for double precision"),
        ("control.Q=1e40", "too far apart for double precision"),
        ("control.loop.limit_torque=1.0", "does not turn"),
        (TWINS, "both named tip"),
    ],
)
def test_wrong_scenes_get_a_sentence(tmp_path: Path, change: str, words: str) -> None:
    assert words in refused("paper_lqr", common(tmp_path) / "out", change)


HELD = "control.loop={{sampling='held',rate={rate},delay=true}}"
FAST = ["tissue.cells=[2,4]", "time.end=10.0", "control.Q=1e4", "control.N=[4,6]", "output.fields='none'"]


def quietly(out: Path, *overrides: str, retune: bool = False) -> dict[str, Any]:
    console = Console(file=io.StringIO(), quiet=MPI.COMM_WORLD.rank != 0)
    return run_control(
        SCENES / "paper_lqr.toml", out, list(overrides), console, quiet=True, pictures=False, retune=retune
    )


@pytest.mark.ranks(2)
def test_an_unstable_sampled_loop_writes_nothing_and_names_a_rate(tmp_path: Path) -> None:
    """Stable as a continuous law, lost at 5 Hz and one tick late; just above the rate of the sentence it settles."""
    out = common(tmp_path) / "out"
    with pytest.raises(SoftgraspError) as caught:
        quietly(out, *FAST, "time.steps=50", HELD.format(rate=5.0))
    MPI.COMM_WORLD.Barrier()  # rank 0 gives the folder back
    assert not out.exists()
    sentence = str(caught.value)
    assert "at 5 Hz and one tick late is unstable" in sentence
    rate, steps = re.findall(r"rate = ([\d.]+) with time.steps = (\d+)", sentence)[0]
    assert 9 < float(rate) < 12
    found = quietly(out, *FAST, f"time.steps={steps}", HELD.format(rate=rate), retune=True)
    assert found["closed_loop_abscissa"] < 0
    assert 0.99 < found["sampled_radius"] < 1
    assert found["sampled_certified"]
    assert (out / "controller.npz").exists()
    assert found["controller"]["sampled_radius"] < 1
    points = [p for part in found["reduced"].values() for p in part if not p["reason"]]
    lost = [p for p in points if p["abscissa_full"] < 0 and p["sampled_radius"] >= 1]
    assert lost  # stable as continuous laws
    assert not any(p["stable"] for p in lost)
    assert all(p["stable"] == (max(p["sampled_radius"] - 1, p["abscissa_full"]) < 0) for p in points)
    marks = {(row[0], int(row[1])): row[-1] for row in list(csv.reader((out / "reduced.csv").open()))[1:]}
    assert "unstable as sampled" in marks.values()
    assert all(
        p["stable"] == (p["sampled_radius"] < 1) for r in found["retune"] for p in r["points"] if not p["reason"]
    )


def test_the_tolerance_holds_for_the_dense_method_too(tmp_path: Path) -> None:
    few = ["tissue.cells=[2,4]", "control.N=[4]", "control.method='dense'"]
    assert "allowed is 1.0e-15" in refused("paper_lqr", common(tmp_path) / "out", *few, "control.tolerance=1e-15")
    found = quietly(common(tmp_path) / "fine", *few, "control.tolerance=1e-11")
    assert found["residual"] <= 1e-11


def test_a_scene_takes_both_spellings_of_newton_adi() -> None:
    say = [load_scene(SCENES / "paper_lqr.toml", [f"control.method='newton{x}adi'"]) for x in "-_"]
    assert say[0] == say[1]
    assert scene_hash(say[0]) == scene_hash(say[1])


def test_galerkin_states_its_true_residual_and_the_part_of_the_tissue(tmp_path: Path) -> None:
    text = io.StringIO()
    changes = [*SMALL[:1], "control.method='galerkin'", "control.N=[8]"]
    out = common(tmp_path) / "out"
    found = run_control(
        SCENES / "paper_lqr.toml", out, changes, Console(file=text, width=200), quiet=True, gain_only=True
    )
    hand, tissue = found["gain_change"]["hand"], found["gain_change"]["tissue"]
    assert found["residual"] > 1e-4  # a long way from the tolerance of a low-rank method, and said so
    assert 0 < hand < 1e-2 * tissue < 1e-5
    assert f"{found['residual']:.1e}" in text.getvalue()
    assert f"rows of the hand {percent(hand)}, of the tissue {percent(tissue)}" in text.getvalue()
    page = words_of(out / "report.html")
    assert f"{found['residual']:.1e}" in page
    assert percent(tissue) in page


def test_galerkin_with_all_modes_is_exact(tmp_path: Path) -> None:
    """22 unknowns, fewer than the modes it starts from: the gain of the dense method."""
    few = ["tissue.cells=[2,4]", "control.N=[4]"]
    found = [quietly(common(tmp_path) / m, *few, f"control.method='{m}'") for m in ("galerkin", "dense")]
    assert "all 22 basis vectors" in found[0]["method"]
    for key in ("gain_translation", "gain_rigid_velocity"):
        assert np.allclose(found[0][key], found[1][key], rtol=0, atol=1e-8)  # residuals 2e-10 and 2e-13
    assert found[0]["closed_loop_abscissa"] == pytest.approx(found[1]["closed_loop_abscissa"], rel=1e-7)  # as above


def test_forces_and_torques_have_limits_of_their_own() -> None:
    loop = {"limit": 3.0, "limit_torque": 0.25}
    outputs = [{"kind": "node", "point": [0.5, 0.0]}, {"kind": "hand"}]
    for given, bound in (
        (loop, [3.0, 3.0, 0.25]),
        ({"limit": 3.0}, [3.0, 3.0, np.inf]),
        ({"limit_torque": 0.25}, [np.inf, np.inf, 0.25]),
    ):
        scene = make_scene(effects={"rotation": True}, control={"outputs": outputs, "loop": given})
        assert (actuation(build(scene, comm=MPI.COMM_WORLD)).bound(3) == bound).all()


@pytest.mark.parametrize("method", ["auto", "modal"])
def test_outputs_that_see_only_the_hand(tmp_path: Path, method: str) -> None:
    """A point mass: K = -[sqrt(Q / R), sqrt(2 m sqrt(Q / R))] on displacement and velocity, m = 20."""
    out = common(tmp_path) / "out"
    outputs = "control.outputs=[{kind='hand',name='arm'}]"
    found = quietly(out, "tissue.cells=[2,4]", "control.N=[4]", outputs, f"control.method='{method}'")
    assert np.allclose(found["gain_translation"], -np.eye(2), rtol=0, atol=1e-9)  # residual of the equation
    assert np.allclose(found["gain_rigid_velocity"], -np.sqrt(40) * np.eye(2), rtol=0, atol=1e-9)  # as above
    assert found["loop"]["distance_final"] < 1e-6
    controller = Controller.load(out / "controller.npz")
    assert controller.plant.N == 4
    u = controller.step(np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    assert np.allclose(u, [4.0, 3.0 - np.sqrt(40)], rtol=0, atol=1e-9)  # as above
    labels = controller.plant.to_control().output_labels
    assert [name.split()[0] for name in labels] == ["arm_x", "arm_y"]


def test_a_scene_without_control_watches_tip_and_turning_hand() -> None:
    effects = {"damping": {"kind": "kelvin-voigt", "beta": 0.02}}
    for turning, kinds in ((False, ["node"]), (True, ["node", "hand"])):
        scene = make_scene(effects={**effects, "rotation": turning}, motion={"target": [1.0, 0.5]})
        model, note = with_control(build(scene, comm=MPI.COMM_WORLD))
        assert "no [control] table" in note
        control = model.scene.control
        assert control is not None
        assert [o.kind for o in control.outputs] == kinds
        assert (control.Q, control.R) == (1.0, 1.0)
        same, nothing = with_control(model)
        assert same is model
        assert not nothing


def points(name: str, *values: tuple[int, float, float]) -> BasisGains:
    return BasisGains(
        name, None, tuple(GainReport(name, N, e, 1e-3, error_K=e, cost_excess=e, abscissa_full=a) for N, e, a in values)
    )


def test_large_errors_break_the_line_and_unstable_gains_are_marked() -> None:
    basis = points("pod", (4, 0.5, -1.0), (6, 3.0, -1.0), (8, 0.2, 0.1), (10, 5.0, 0.1))
    N, values = drawn(basis, "error_P")
    assert N == [4, 6, 8, 10]
    assert np.isnan(values).tolist() == [False, True, False, True]
    assert unstable(basis, "error_P")[0] == [8, 10]
    best = basis.best()
    assert best is not None
    assert best.N == 4  # the least cost among the stable ones; N = 8 is nearer but unstable
    assert basis.best(3) is None


@pytest.mark.serial
def test_figure_of_the_errors(tmp_path: Path) -> None:
    bases = (points("pod", (4, 0.5, -1.0), (6, 30.0, 0.1)), points("structured", (4, 1e-3, -1.0), (6, 1e-5, -1.0)))
    (png,) = figure_gains(bases, tmp_path / "errors.png")
    assert png.stat().st_size > 10_000


def test_small_helpers() -> None:
    t = np.arange(5.0)
    assert settled(t, np.array([1.0, 0.5, 0.005, 0.02, 0.001])) == 4.0
    assert settled(t, np.array([1.0, 0.5, 0.005, 0.001, 0.02])) is None
    assert to_json({"a": [np.float64(np.nan), np.inf, 1.0, np.int64(2)], "b": True}) == {
        "a": [None, None, 1.0, 2],
        "b": True,
    }
    assert issubclass(ControlError, SoftgraspError)
    assert issubclass(SceneError, SoftgraspError)


def test_a_rate_without_sampling_is_said_to_do_nothing() -> None:
    base = {"outputs": [{"kind": "hand"}]}
    for loop, said in (({}, False), ({"rate": 2.0}, True), ({"rate": 2.0, "sampling": "held"}, False)):
        note = unused_rate(build(make_scene({"control": {**base, "loop": loop}})))
        assert bool(note) == said
        assert not said or "control.loop.rate = 2 Hz has no effect" in note
    ticking = {"loop": {"rate": 2.0}, "observer": {"markers": [[0.0, 0.0]]}}
    assert not unused_rate(build(make_scene({"control": {**base, **ticking}})))
