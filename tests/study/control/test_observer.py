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
from softgrasp.lqr.plant.checks import ControlError
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
    assert "Standard deviation of one sample" in (tmp_path / "report.html").read_text()


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
    with pytest.raises(ControlError, match="at most 1300; this scene has"):
        control(tmp_path, OBSERVER, "tissue.cells=[30,60]")


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
