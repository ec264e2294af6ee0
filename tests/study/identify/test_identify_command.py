"""The command: its files, its exit status, and that the other commands take the scene it writes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import softgrasp as sg
from softgrasp.study.cli import app

pytestmark = pytest.mark.serial
KEYS = [
    "tissue.order=2", "tissue.refine={tolerance=3e-2, grading='auto'}", "time.steps=150", "motion.duration=1.5",
    "effects.damping={kind='kelvin-voigt', beta=0.003}",
]  # fmt: skip
NOISE = 0.15


def sets(keys: list[str]) -> list[str]:
    return [word for key in keys for word in ("--set", key)]


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Outputs of a finer mesh at mu = 65, every other one missing in one column."""
    run = sg.simulate(sg.build("paper_forward", [*KEYS, "tissue.refine.tolerance=5e-3", "tissue.material.mu=65"]))
    y = run.outputs + np.random.default_rng(2).normal(0, NOISE, run.outputs.shape)
    file = tmp_path_factory.mktemp("identify") / "camera.csv"
    lines = [
        f"{t:.17g},{a:.6f},{'' if i % 2 else f'{b:.6f}'}"
        for i, (t, (a, b)) in enumerate(zip(run.times, y, strict=True))
    ]
    file.write_text("\n".join(["time [s],tip_x [m],tip_y [m]", *lines]))
    return file


def call(*words: str | Path) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=True)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        return 1, str(result.exception)
    return result.exit_code, result.output


def test_values_page_and_scene_of_a_fit_that_stands(measured: Path, tmp_path: Path) -> None:
    out = tmp_path / "fit"
    code, said = call(
        "identify", "paper_forward", measured, "--fit", "mu,beta", "--noise", NOISE, "--law", "linear", "--out", out,
        *sets(KEYS),
    )  # fmt: skip
    assert code == 0, said
    result = json.loads((out / "result.json").read_text())
    mu = result["values"]["mu"]
    assert abs(mu["value"] / 65 - 1) < 2 * mu["together"]
    assert mu["together"] == pytest.approx(
        mu["noise"] + abs(mu["mesh"]) + abs(mu["time step"]) + abs(mu["reduction"]),
        rel=1e-12,  # the same sum
    )
    assert result["refused"] == []
    page = (out / "report.html").read_text()
    for text in (
        "The data give mu = ",
        "Values and the parts of their errors",
        "What the data determine",
        "camera.csv",
    ):
        assert text in page
    for name in ("fit.png", "ellipses.png", "history.png", "values.csv", "residuals.csv", "fitted.toml"):
        assert name in result["files"]
    rows = (out / "residuals.csv").read_text().splitlines()
    assert len(rows) == 152
    assert rows[2].count(",,") == 1  # a missing sample
    fitted = (out / "fitted.toml").read_text()
    assert fitted.startswith("# mu = ")
    assert sg.load_scene(out / "fitted.toml").tissue.material.mu == mu["value"]


def test_the_page_shows_the_equation_of_the_law_that_was_fitted(tmp_path: Path) -> None:
    small = ["tissue.cells=[2, 4]", "time.steps=30", "motion.duration=2"]
    run = sg.simulate(sg.build("paper_forward", [*small, "effects.finite_strain={law='neo-hooke'}"]))
    data = tmp_path / "camera.csv"
    np.savetxt(
        data, np.column_stack([run.times, run.outputs]), "%.6g", ",", header="time [s],tip_x [m],tip_y [m]", comments=""
    )
    out = tmp_path / "fit"
    words = "--fit", "mu", "--noise", NOISE, "--law", "neo-hooke", "--no-pictures", "--out", out, *sets(small)
    assert call("identify", "paper_forward", data, *words)[0] in (0, 3)  # so coarse a mesh may be refused
    equation = (out / "report.html").read_text().split('class="equation"')[1].split("<h2")[0]
    assert "neo-hooke" in equation  # the scene that was given is linear


def test_other_commands_take_the_fitted_scene(measured: Path, tmp_path: Path) -> None:
    out = tmp_path / "fit"
    small = ["tissue.cells=[4, 8]", "time.steps=150", "time.end=1.5", "motion.duration=1.5"]
    code, said = call(
        "identify", "paper_lqr", measured, "--fit", "mu", "--noise", NOISE, "--law", "linear", "--out", out,
        "--no-pictures", *sets(small),
    )  # fmt: skip
    assert code == 3, said
    assert "The answer is refused; do not use its values." in said
    assert "# REFUSED: The mesh changes mu" in (out / "fitted.toml").read_text()
    assert json.loads((out / "result.json").read_text())["refused"]
    for words in (
        ["simulate", "--no-pictures"], ["reduce", "--no-pictures", "--set", "reduction.methods=['craig_bampton']"],
        ["control", "--gain-only", "--no-pictures"],
    ):  # fmt: skip
        code, said = call(words[0], out / "fitted.toml", *words[1:], "--out", tmp_path / words[0])
        assert code == 0, said


def test_bad_input_ends_with_a_sentence_and_leaves_nothing(measured: Path, tmp_path: Path) -> None:
    out = tmp_path / "fit"
    wrong = tmp_path / "wrong.csv"
    wrong.write_text("time [s],tip_x [m]\n0,1\n0,2\n")
    for data, fit, noise, says in (
        (wrong, "mu", "1e-3", "line 3: times must be given in each line and increase"),
        (measured, "nu", "1e-3", "--fit nu: the parameters are"),
        (measured, "mu", "0", "--noise 0: it must be a standard deviation > 0"),
        (tmp_path / "none.csv", "mu", "1e-3", "the measurements cannot be read"),
    ):
        code, said = call("identify", "paper_forward", data, "--fit", fit, "--noise", noise, "--out", out, *sets(KEYS))
        assert (code, says in said) == (1, True), said
        assert not (out / "result.json").exists()
        assert not (out / "fitted.toml").exists()
