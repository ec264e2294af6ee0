"""``softgrasp control`` with an observer: what page, result.json and files say, and what off costs."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from softgrasp.fem.errors import SceneError
from softgrasp.lqr.loop.controller import Controller
from softgrasp.lqr.observer.seen import Seen
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.study.control.observer.report import modes_section
from softgrasp.study.control.observer.result import seen_mode
from softgrasp.study.control.run import run_control

SMALL = ["tissue.cells=[4,8]", "control.N=[8]", "output.fields='none'", "output.frames=2"]
OBSERVER = "control.observer={markers=[[0,0],[1,0],[0,1],[1,1]],delay=2,disturbance={box=[[0,0],[1,0]]}}"


def control(out: Path, *overrides: str) -> tuple[dict, str]:
    text = io.StringIO()
    run_control(Path("paper_lqr"), out, [*SMALL, *overrides], Console(file=text, width=160), quiet=True,
                pictures=False, gain_only=True)  # fmt: skip
    return json.loads((out / "result.json").read_text()), text.getvalue()


def test_page_file_and_numbers_agree(tmp_path: Path) -> None:
    result, text = control(tmp_path, OBSERVER)
    found = result["observer"]
    assert found["N"] == 14
    assert found["samples"][:3] == ["q1", "q2", "marker1_x"]
    assert found["marker_nodes"][3] == [1.0, 1.0]
    assert found["abscissa"] < 0.98 * found["abscissa_known"]
    assert 0 < found["cost_excess"] < 0.003  # 0.17 % without delay
    assert found["abscissa_without"]["all but the hand"] < 0
    assert found["solves"] <= 60
    assert np.all(np.array(found["sd_full"]) < np.array(found["sd_estimate"]))  # the best there is
    assert f"abscissa is {found['abscissa']:.4g} 1/s" in " ".join(text.split())
    assert "10 a tick of 1 ms, 2 ticks late" in text
    own = Controller.load(tmp_path / "observer.npz").observer
    assert own is not None
    assert own.delay == 2
    assert list(own.names) == found["samples"]
    assert Controller.load(tmp_path / "controller.npz").observer is None
    assert [mode["mode"] for mode in found["modes"]] == [1, 2, 3]
    assert list(found["modes"][0]["share"]) == found["samples"][2:]
    assert "Modes that the markers see" in (tmp_path / "report.html").read_text()
    assert "Standard deviation of one sample" in (tmp_path / "report.html").read_text()


def test_modes_that_a_marker_does_not_see_are_named() -> None:
    share = np.array([[0.94, 0.005, 0.0], [0.007, 0.96, 0.009]])
    seen = Seen(
        np.array([0, 1, 4]), np.array([0.688, 1.61, 2.2]), share, np.array([9e-6, 2e-5, np.inf]), ("a_x", "a_y")
    )
    section = modes_section(seen)
    assert section.text.startswith("Mode 1 (0.688 Hz) is not seen by a_y. Mode 2 (1.61 Hz) is not seen by a_x. ")
    assert "Mode 5 (2.2 Hz) is not seen by any marker." in section.text
    assert section.rows[2][3] is None
    assert seen_mode(seen, 2)["hidden"] is None  # JSON has no infinity


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("control.observer={markers=[]}", "markers or noise.force is missing"),
        ("control.observer={markers=[[0,0]],N=9}", "N is 9; displacements and velocities come in pairs"),
        ("control.observer={markers=[[0,0]],noise={marker=0}}", "noise.marker"),
    ],
)
def test_tables_that_are_no_observer_are_refused(override: str, sentence: str, tmp_path: Path) -> None:
    with pytest.raises(SceneError) as error:
        control(tmp_path, override)
    assert sentence in str(error.value)


def test_what_has_no_observer_is_refused_before_the_riccati_equation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("softgrasp.study.control.run.design", lambda *_: pytest.fail("the equation was solved"))
    with pytest.raises(ControlError, match="checked for a hand that does not feel the tissue; this scene has"):
        control(tmp_path, OBSERVER, "tissue.cells=[30,60]", "effects.reaction=true")
    with pytest.raises(ControlError, match=r"a plan with control\.observer knows all modes of the plant, at most 1300"):
        control(tmp_path, OBSERVER, "tissue.cells=[30,60]", "obstacle=[{kind='disc', center=[3.4, 1.2], radius=0.7}]",
                "control.constraints={force=8.0}")  # fmt: skip


def test_a_scene_without_tables_imports_neither_plan_nor_observer_and_keeps_its_bits(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from rich.console import Console;"
        "from softgrasp.study.control.run import run_control;"
        f"run_control(Path('paper_lqr'), Path(sys.argv[1]), {SMALL}, Console(quiet=True), quiet=True, pictures=False);"
        "rooms = ('observer', 'loop.filter', 'constrained', 'control.obstacle');"
        "sys.exit(any(room in name for room in rooms for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code, tmp_path / "out"], check=False).returncode == 0
    control(tmp_path / "with", OBSERVER)
    with np.load(tmp_path / "out" / "controller.npz") as off, np.load(tmp_path / "with" / "controller.npz") as on:
        assert all(np.array_equal(off[key], on[key]) for key in off.files if key != "meta")  # meta has the scene's hash
