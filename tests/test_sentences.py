"""Sentences of errors that no other test asks for: what is wrong, and what would be right."""

from __future__ import annotations

import re
import socket
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import h5py
import meshio
import numpy as np
import pytest
from rich.console import Console

import softgrasp as sg
from benchmarks import figures
from softgrasp.fem.errors import SoftgraspError, SolverError
from softgrasp.lqr.constrained.tissue import require_plannable
from softgrasp.lqr.design.feedback import Design
from softgrasp.lqr.loop.controller import layout_hash, load_gain, write_npz
from softgrasp.lqr.loop.filter import Filter
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.program.least_distance import nearest
from softgrasp.lqr.reduced.bases import make_family
from softgrasp.reduction import ReductionError
from softgrasp.reduction.bases.states import _check
from softgrasp.reduction.identify.unknowns import parse_unknowns
from softgrasp.reduction.online import prepared
from softgrasp.reduction.propagator import propagator
from softgrasp.reduction.strain.model import refuse
from softgrasp.study.cli import scenes
from softgrasp.study.export.run import run_export
from softgrasp.study.identify.suggest.run import parse_motions
from softgrasp.study.query.request import drive_of, materials_of
from softgrasp.study.query.run import run_query
from softgrasp.study.reduce.strain import measure as strain
from softgrasp.study.reduce.turning import measure as turning
from softgrasp.study.runs.listing import compare
from softgrasp.study.runs.start import new_scene
from softgrasp.study.runs.sweep import parse_axis
from softgrasp.study.serve.run import make_server, served_model

pytestmark = pytest.mark.serial
NOWHERE = Path("nowhere")


def scene(name: str, *keys: str) -> Callable[[], Any]:
    return lambda: sg.load_scene(name, list(keys))


def build(name: str, *keys: str, **given: Any) -> Callable[[], Any]:
    return lambda: sg.build(name, ["tissue.cells=[4, 8]", *keys], **given)


def nothing() -> Any:
    """A form that is never made."""


def filtered(names: tuple[str, ...], delay: int) -> Callable[[], Any]:
    A, B, C = np.eye(2), np.ones((2, 1)), np.ones((1, 2))
    return lambda: Filter(A, B, np.zeros(2), C, C.T, names, delay=delay)


def fitted(word: str, *keys: str) -> Callable[[], Any]:
    return lambda: parse_unknowns([word], build("paper_forward", *keys)())


def fallen_back() -> Any:
    return run_query(NOWHERE, Console(quiet=True), fallback="half")


def exported_as_zip() -> Any:
    return run_export(Path("a.h5"), Console(quiet=True), c=None, fmu=Path("a.zip"), tick=1e-3)


def asked(**setting: float) -> Callable[[], Any]:
    """A query of a plane model with lambda = mu = rho = 1."""
    one = SimpleNamespace(lam=1.0, mu=1.0, rho=1.0)
    model: Any = SimpleNamespace(fine=SimpleNamespace(materials=[one]), norms=SimpleNamespace(dimension=2))
    return lambda: materials_of(model, {"lambda" if key == "lam" else key: x for key, x in setting.items()})


def plant(*keys: str) -> RiccatiProblem:
    return sg.problem(sg.build("paper_lqr", ["tissue.cells=[2, 4]", *keys]))


def other_runs() -> tuple[Any, ...]:
    """Layout of a mesh, with system and snapshots of another."""
    other = sg.build("paper_forward", ["tissue.cells=[2, 4]", "time.steps=4", "output.snapshots='memory'"])
    return sg.build("paper_forward", ["tissue.cells=[4, 8]"]).system.layout, other.system, sg.simulate(other).snapshots


def other_step() -> Any:
    model = sg.build("paper_forward", ["tissue.cells=[2, 4]", "time.steps=4", "output.snapshots='memory'"])
    system = sg.reduce(model, sg.simulate(model), "craig_bampton", N=8).at()
    return prepared(propagator(system, 0.1, True), 0.2, True)


def no_costates() -> Any:
    problem = plant()
    return make_family("pod", problem, Block(np.zeros((4, 1)), np.zeros((2 * problem.layout.n_local, 1))))


def no_controller() -> Any:
    """No radius of a loop is small enough."""
    made = sg.design(sg.build("paper_lqr", ["tissue.cells=[2, 4]"]))
    with patch.object(Design, "largest_radius", 0.0):
        return sg.make_controller(made, 8)


def once(code: str, limit: float = 60.0) -> Callable[[], Any]:
    """A command of a benchmark."""

    def act() -> Any:
        with patch.object(figures, "LIMIT", limit):
            return figures.run_once(figures.Command("a", f"python -c '{code}'", ()))

    return act


LAW = "tissue.energy='law.py:W'"
SENTENCES: list[tuple[Callable[[], Any], str]] = [
    (scene("turn_over", "effects.rotation=false"), "effects.rotation is off; set effects.rotation to true"),
    (scene("paper_forward", LAW, "tissue.parameters={'a b'=1.0}"), "parameters has 'a b'; a name is a word of letters"),
    (
        scene("paper_forward", LAW, "tissue.parameters={a=1.0}",
              "tissue.layers.top={box=[[0, 1], [1, 2]], parameters={c=2.0}, material={mu=50.0, lambda=50.0, rho=1.0}}"),
        "parameters has 'c', which tissue.parameters lacks; give it there too",
    ),
    (
        build("paper_forward", "tissue.layers.far={box=[[7, 7], [8, 8]], material={mu=50.0, lambda=50.0, rho=1.0}}"),
        "tissue.layers.far has no cell of the mesh; check its tag or box",
    ),
    (build("paper_forward", terms=["bed"]), "terms has 'bed'; give softgrasp.Term(name, form, value)"),
    (build("paper_forward", terms=[sg.Term("bed", nothing, 1.0, adds="heat")]), "the term bed adds 'heat'; choose "),
    (lambda: sg.contact_model(build("paper_forward")()), "contact_model needs effects.obstacles, motion.drive"),
    (filtered(("x", "y"), 0), "a filter of 1 samples has 2 names and a delay of 0 ticks"),
    (filtered(("x",), -1), "a filter of 1 samples has 1 names and a delay of -1 ticks"),
    (lambda: nearest(np.zeros((1, 2)), np.array([-1.0])), "a row without entries is violated"),
    (lambda: nearest(np.array([[1.0], [-1.0]]), np.array([-1.0, -1.0])), "no point keeps all rows"),
    (exported_as_zip, "simulators recognise an FMU by its ending; name it a.fmu"),
    (lambda: parse_motions(["duration=" + ";".join("1" * 51)]), "51 motions are too many; give at most"),
    (lambda: compare(NOWHERE, NOWHERE), "nowhere/result.json is not there; name folders that `softgrasp list` prints"),
    (lambda: served_model(NOWHERE, "heat"), "--inputs heat: give some of "),
    (lambda: make_server(None, "127.0.0.1", -1), "--port -1: "),  # type: ignore[arg-type]
    (fitted("mu", "tissue.layers.all={box=[[-9, -9], [9, 9]], material='fat'}"), "all cells are in layers; name one"),
    (scene("paper_forward", "time.steps=" + "9" * 5000), ": it has an integer of thousands of digits"),
    (fallen_back, "--fallback half: the only model to fall back on is full"),
    (asked(mu=-1.0), "mu = -1 must be positive"),
    (asked(lam=-9.0), "lambda = -9 Pa must be above -1 Pa, else a material with mu = 1 Pa collapses"),
    (lambda: drive_of(SimpleNamespace(drive=None)), "the model contains no motion; reduce its scene again"),  # type: ignore[arg-type]
    (lambda: parse_axis("tissue.material.mu=ten"), "'tissue.material.mu=ten' is no sweep; "),
    (lambda: parse_axis("a=1:2:900000"), "'a=1:2:900000' has 900000 values; a sweep has at most "),
    (lambda: refuse("mu = 9 lies outside", outside=False), "; train the model there, or allow it with "),
    (lambda: _check(*other_runs()), "all snapshots must come from one mesh and one contact zone"),
    (other_step, "the propagator was made for another time step or another kind of input"),
    (lambda: require_plannable(plant("tissue.order=2")), "a plan past obstacles is made for "),
    (no_costates, "nothing to build this basis from ("),
    (no_controller, "has the spectral radius "),
    (once("import time; time.sleep(9)", 0.1), "no end after 0.1 s"),
    (once("raise SystemExit(7)"), "status 7: it printed nothing"),
]  # fmt: skip


@pytest.mark.parametrize(("act", "sentence"), SENTENCES, ids=[sentence[:40] for _, sentence in SENTENCES])
def test_sentence_names_what_is_wrong_and_what_would_be_right(act: Callable[[], Any], sentence: str) -> None:
    with pytest.raises(SoftgraspError, match=re.escape(sentence)) as caught:
        act()
    assert "\n" not in str(caught.value).strip()


def saved(path: Path, meta: dict[str, Any]) -> Path:
    return write_npz(path, meta, {"K": np.eye(2)})


def test_damaged_controllers_and_gains_are_named(tmp_path: Path) -> None:
    text, new, bare = tmp_path / "text.npz", tmp_path / "new.npz", tmp_path / "bare.npz"
    text.write_text("no archive")
    saved(new, {"format": 99})
    layout = plant().layout
    saved(bare, {"format": 1, "names": [], "layout_hash": layout_hash(layout)})
    for path, sentence in (
        (text, "text.npz is damaged or no controller ("),
        (new, "new.npz has the format 99, this version reads 1 and 2; save it again"),
        (bare, "bare.npz has no controller ('plant_"),
    ):
        with pytest.raises(SoftgraspError, match=re.escape(sentence)):
            sg.Controller.load(path)
    full = write_npz(tmp_path / "gain.npz", {"format": 1, "layout_hash": ""}, {"tissue": np.eye(2)})
    with pytest.raises(
        SoftgraspError, match=r"gain\.npz is a gain of full order, for lqr\.load_gain; controller\.npz has"
    ):
        sg.Controller.load(full)
    with pytest.raises(SoftgraspError, match=r"bare\.npz has no full-order gain \(.*\); save it again"):
        load_gain(bare, layout)


def test_files_and_addresses_are_named(tmp_path: Path) -> None:
    broken = tmp_path / "broken.vtu"
    meshio.write(broken, meshio.Mesh(np.eye(3), [("triangle", np.array([[0, 1, 8]]))]))
    with pytest.raises(SoftgraspError, match="has cells with node numbers outside 0 to 2: export it again"):
        new_scene(tmp_path / "new.toml", mesh=broken)
    (tmp_path / "old.toml").write_text("")
    with pytest.raises(SoftgraspError, match=r"old\.toml: this file exists; name another one"):
        new_scene(tmp_path / "old.toml")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(SoftgraspError, match=rf"--port {port}: Address already in use; choose another address or"):
            make_server(None, "127.0.0.1", port)  # type: ignore[arg-type]


def test_models_without_motion_or_scenes_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with h5py.File(tmp_path / "m.h5", "w"):
        pass
    monkeypatch.setattr("softgrasp.study.serve.run.load_certified", lambda _: SimpleNamespace(drive=None))
    with pytest.raises(SoftgraspError, match=r"m\.h5 has no motion; reduce its scene again"):
        served_model(tmp_path / "m.h5", "mu")
    monkeypatch.setattr("softgrasp.fem.scene.file.shipped_scenes", dict)
    with pytest.raises(SoftgraspError, match="no scenes here: they ship with the checkout, in demos/scenes"):
        scenes()


def test_a_family_without_models_repeats_why(monkeypatch: pytest.MonkeyPatch) -> None:
    still: Any = SimpleNamespace(system=SimpleNamespace(frame=None))

    def refused(*_: Any) -> Any:
        raise ReductionError("too few snapshots")

    def fails(*_: Any) -> Any:
        raise SolverError("no step")

    monkeypatch.setattr(strain, "train", refused)
    with pytest.raises(SoftgraspError, match=r"no N of \[14\] fits: too few snapshots"):
        strain._family("own", still, [], [], [14], lambda *_: None)
    training = SimpleNamespace(Phi=None, family=fails)
    monkeypatch.setattr(strain, "train", lambda *_: training)
    with pytest.raises(SoftgraspError, match=r"no N of \[14\] gives a model: no step"):
        strain._family("own", still, [], [], [14], lambda *_: None)
    monkeypatch.setattr(turning, "possible_sizes", lambda *_: [])
    full: Any = SimpleNamespace(
        model=sg.build("turn_over", ["tissue.cells=[2, 4]"]), trajectory=SimpleNamespace(force=[])
    )
    with pytest.raises(SoftgraspError, match="no basis has any of N = "):
        turning.measure_turning(full, ["craig_bampton"], lambda *_: None)
