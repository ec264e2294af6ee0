"""The figures of README and pages: read from what the commands write, run again only where they are missing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mpi4py import MPI
from typer.testing import CliRunner

from benchmarks import figures as bench
from benchmarks.__main__ import app
from softgrasp.fem.accuracy.estimate import estimate
from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.model.build import build

pytestmark = pytest.mark.serial
SCENE = ("tissue.cells=[2, 4]", "time.steps=20")
LINE = "softgrasp simulate paper_forward -s 'tissue.cells=[2, 4]' -s time.steps=20 --no-pictures"
TINY = bench.Command(
    "tiny", LINE, (bench.Figure("error of a tiny mesh", (bench.Number("%", bench.at("mesh_error.estimate", 100)),)),)
)


def test_a_figure_is_what_the_command_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "COMMANDS", (TINY,))
    line = ["figures", "--repeats", "2", "--out", str(tmp_path)]
    first = CliRunner().invoke(app, line)
    assert first.exit_code == 0, first.output
    kept = json.loads((tmp_path / "bench_figures.json").read_text())["commands"]["tiny"]
    model = build("paper_forward", SCENE, MPI.COMM_SELF)
    assert kept["values"] == [[pytest.approx(100 * estimate(model).estimate, rel=1e-6)] * 2]  # digits of the file
    assert min(kept["cpu"]) > 0.1  # a process that imports and runs takes longer
    assert LINE in (tmp_path / "bench_figures.md").read_text()

    def refuse(command: bench.Command) -> None:
        raise SoftgraspError("it runs again")

    monkeypatch.setattr(bench, "run_once", refuse)
    assert CliRunner().invoke(app, line).exit_code == 0  # enough runs are kept
    with pytest.raises(SoftgraspError, match="it runs again"):
        CliRunner().invoke(app, [*line, "--only", "tiny"], catch_exceptions=False)


def test_a_command_that_fails_is_one_sentence() -> None:
    with pytest.raises(SoftgraspError, match=r"softgrasp simulate nowhere: status \d"):
        bench.run_once(bench.Command("wrong", "softgrasp simulate nowhere", ()))


def test_the_page_has_ten_figures_with_their_commands() -> None:
    page = (Path(__file__).parents[2] / "docs" / "benchmarks.md").read_text()
    figures = [(figure.text, command.line) for command in bench.COMMANDS for figure in command.figures]
    assert len(figures) == 10
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    assert [text for text, line in figures if not any(text in row and f"`{line}`" in row for row in rows)] == []
