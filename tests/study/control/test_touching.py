"""``softgrasp control`` into an obstacle: result.json, page, tables and refusals."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from softgrasp.fem.errors import SceneError
from softgrasp.study.control.run import run_control

SMALL = [
    "tissue.cells=[4,8]", "control.N=[8]", "output.fields='none'", "output.frames=2", "time={steps=200, end=40.0}",
    "effects.reaction=true", "effects.obstacles=true", "motion.target=[2.0, -1.0]",
]  # fmt: skip
FLOOR = "obstacle=[{name='floor', kind='halfspace', normal=[0, 1], offset=-0.95}]"


def control(out: Path, *overrides: str, floor: str = FLOOR) -> tuple[dict, str]:
    text = io.StringIO()
    run_control(Path("paper_lqr"), out, [*SMALL, floor, *overrides], Console(file=text, width=160), quiet=True,
                pictures=False)  # fmt: skip
    return json.loads((out / "result.json").read_text()), " ".join(text.getvalue().split())


def test_page_tables_and_numbers_agree(tmp_path: Path) -> None:
    result, text = control(tmp_path)
    found = result["contact"]
    assert found["reason"] == ""
    assert found["obstacles"]["floor"]["nodes_max"] == 5
    assert found["penetration"] < 1e-13
    assert found["energy_drift"] < 1e-12
    assert found["distance_final"] > 0.04 > 5 * result["loop"]["distance_final"]  # the floor is 5 cm too high
    assert found["hand_final"][1] > -0.96 > result["loop"]["hand_final"][1]
    rows = list(csv.DictReader((tmp_path / "contact.csv").open()))
    force = np.array([float(row["floor_force_y [N]"]) for row in rows])
    assert len(rows) == 201
    assert force[-2:].mean() == pytest.approx(found["force_end"][1], rel=1e-9)  # digits written
    assert min(float(row["floor_gap [m]"]) for row in rows) == pytest.approx(-found["penetration"], abs=1e-15)
    assert f"the obstacles press with {abs(found['force_end'][1]):.4g} N" in text
    assert "no certificate covers contact" in text
    assert "At the obstacles" in (tmp_path / "report.html").read_text()


def test_a_hand_that_meets_the_obstacle_is_a_finding(tmp_path: Path) -> None:
    tall = "obstacle=[{name='ledge', kind='box', lo=[1.4, -0.2], hi=[1.8, 1.6]}]"  # as high as the grip
    result, text = control(tmp_path, floor=tall)
    assert "the hand meets obstacle 'ledge'" in result["contact"]["reason"]
    assert "With the obstacles the run of the optimal gain fails" in text
    assert result["loop"]["distance_final"] < 0.01


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["effects.finite_strain={law='neo-hooke'}", "effects.reaction=false"], "effects.finite_strain"),
        (["control.constraints={force=8.0}"], "control.constraints"),
    ],
)
def test_what_cannot_go_with_contact_is_refused_at_once(tmp_path: Path, overrides: list[str], words: str) -> None:
    with pytest.raises(SceneError, match=rf"control cannot go with effects.obstacles and {words} yet"):
        control(tmp_path, *overrides)
    assert not (tmp_path / "result.json").exists()
