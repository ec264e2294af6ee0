"""``softgrasp control`` past obstacles: what result.json, page and files say, what is refused, and what off costs."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from softgrasp.fem.errors import SceneError, SoftgraspError
from softgrasp.fem.model.build import Stopwatch, build
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.design.constrained import plan_sizes
from softgrasp.lqr.design.feedback import design
from softgrasp.study.control.obstacle.measure import planned_study
from softgrasp.study.control.run import run_control

SMALL = [
    "tissue.cells=[4,8]",
    "control.N=[8]",
    "output.fields='none'",
    "output.frames=2",
    "time.steps=60",
    "time.end=60.0",
]


def control(out: Path, *overrides: str, pictures: bool = False) -> tuple[dict, str]:
    text = io.StringIO()
    run_control(Path("paper_obstacle"), out, [*SMALL, *overrides], Console(file=text, width=160), quiet=True,
                pictures=pictures)  # fmt: skip
    return json.loads((out / "result.json").read_text()), text.getvalue()


def test_page_files_and_numbers_agree(tmp_path: Path) -> None:
    result, text = control(tmp_path, pictures=True)
    found = result["obstacle"]
    assert found["certified"]
    assert found["names"] == ["disc", "wall"]
    assert min(found["gap_min"]) >= 0
    assert max(found["gap_min_without_plan"]) < -0.1  # LQR goes through both
    assert found["cost_excess_held"] < found["cost_excess"] < 0.04
    assert abs(found["cost"] / found["cost_predicted"] - 1) < 1e-5  # error of the reduced plant and of the steps
    assert max(found["input_largest"]) <= 8
    assert "keeps every gap and limit under the plan at every time: this is proved" in " ".join(text.split())
    rows = list(csv.DictReader((tmp_path / "plan.csv").open()))
    assert len(rows) == found["intervals"]
    assert np.allclose([[float(row["u_x [N]"]), float(row["u_y [N]"])] for row in rows], found["inputs"], atol=1e-12)
    assert min(float(row["least gap to wall [m]"]) for row in rows) == found["gap_min"][1]
    assert 0 < found["time_warm"][0] < found["time_warm"][1]
    assert found["tick"] == 1e-3
    for name in ("obstacle.png", "gaps.png", "times.png"):
        assert (tmp_path / name).stat().st_size > 10_000
    page = (tmp_path / "report.html").read_text()
    assert "knows no obstacles" in page


def test_page_of_named_nodes_speaks_of_them_alone(tmp_path: Path) -> None:
    result, text = control(tmp_path, "control.constraints.body=['tip']", "tissue.cells=[2,4]")
    found, words = result["obstacle"], " ".join(text.split())
    assert found["body"] == [[0.5, 0.0]]
    assert min(found["gap_min"]) >= 0 > -0.1 > max(found["gap_min_boundary"])
    assert (
        "keeps every limit, and every gap of the node at (0.5, 0) under the plan at every time: this is proved, but"
        in words
    )
    assert "which the plan does not look at" in words


def test_explain_names_the_program_that_control_solves() -> None:
    overrides = [*SMALL, "control.constraints.horizon=34", "control.constraints.margin=1e-3"]
    model = build(load_scene("paper_obstacle", overrides))
    found = planned_study(design(model), model, Stopwatch(model.system.layout.comm), lambda *_: None).result()
    sizes = plan_sizes(model)
    assert sizes is not None
    for key in ("N", "grid", "intervals", "variables", "rows"):
        assert getattr(sizes, key) == found[key]
    assert found["margin"]["reduced_plant"] == 1e-3
    assert not found["certified"]  # a number is no bound
    assert "control.constraints.margin is a number" in found["reason"]


def test_plan_of_the_linear_plant_runs_at_finite_strain(tmp_path: Path) -> None:
    finite = "effects.finite_strain={law='neo-hooke'}"
    soft, _ = control(tmp_path / "soft", finite, "tissue.cells=[2,4]")
    hard, text = control(
        tmp_path / "hard", finite, "tissue.cells=[2,4]", "tissue.material={lambda=500.0,mu=500.0,rho=1.0}"
    )
    errors = [result["obstacle"]["finite_strain"]["error"] for result in (soft, hard)]
    # deformations of the stiffer tissue are a tenth, the error of the linear plant is of their square: 0.29 mm and 4 um
    assert 0 < errors[1] < 0.03 * errors[0] < 0.03 * 1e-3
    found = soft["obstacle"]["finite_strain"]
    assert found["violation"] == max(0.0, -min(found["gap_min"]))
    assert min(found["gap_min"]) > min(soft["obstacle"]["gap_min"]) - found["error"]
    assert "the linear plant has an error of up to" in text


@pytest.mark.slow
def test_error_of_the_linear_plant_becomes_a_margin_on_request(tmp_path: Path) -> None:
    changes = ["effects.finite_strain={law='neo-hooke'}", "tissue.cells=[2,4]"]
    first, _ = control(tmp_path / "first", *changes)
    second, text = control(tmp_path / "second", *changes, "control.constraints.finite_strain=true")
    before, after = first["obstacle"], second["obstacle"]
    assert after["margin"]["finite_strain"] == pytest.approx(before["finite_strain"]["error"], rel=1e-12)
    assert after["margin"]["clearance"] == before["margin"]["clearance"] == 0
    # the new plan stays farther off by the margin, to the bend of another way
    assert min(after["gap_min"]) > min(before["gap_min"]) + 0.5 * after["margin"]["finite_strain"]
    assert after["finite_strain"]["violation"] == 0
    assert "margin for finite strain" in text


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("control.constraints.force=false", "control.constraints.force"),
        ("control.constraints.force=[1.0, 1.0, 1.0]", "force has 3 numbers; give one, or 2, one per axis"),
        ("control.loop.limit=2.0", "control.loop.limit cuts the forces at 2 N"),
        ("obstacle.1.offset=-5.99", "at the target the gap to obstacle wall is -0.01 m"),
        ("obstacle.0.path={velocity=[0.01, 0.01]}", "obstacle disc moves towards the body at the target until the end"),
        ("effects.reaction=true", "control.constraints.speed limits a hand whose speed changes linearly"),
        ("effects.gravity=[0, -0.1]", "a plan starts with the tissue in equilibrium"),
        ("control.constraints.horizon=1e9", "a plan of 1e+09 intervals would need about"),
        ("control.constraints.grid=1e4", "raise control.constraints.N or lower grid"),
        ("control.constraints.N=9", "N is 9; displacements and velocities come in pairs"),
        ("obstacle=[{kind='disc', center=[0.4, 1.1], radius=0.1}]", "'disc1' has its middle within the tissue"),
        ("control.constraints=false", "obstacle is given but nothing in this scene uses it"),
    ],
)
def test_what_has_no_plan_is_refused_in_a_sentence(override: str, sentence: str, tmp_path: Path) -> None:
    with pytest.raises((SoftgraspError, SceneError)) as error:
        control(tmp_path, override)
    assert sentence in str(error.value)
    assert not (tmp_path / "result.json").exists()
