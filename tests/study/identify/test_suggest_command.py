"""``softgrasp identify --suggest-markers``: its files, its exit status, and what it refuses."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import softgrasp as sg
from softgrasp.fem.errors import SceneError
from softgrasp.study.cli import app
from softgrasp.study.identify.suggest.run import parse_motions

pytestmark = pytest.mark.serial
SMALL = ["--set", "tissue.cells=[3, 6]", "--set", "time.steps=40"]


def call(*words: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["identify", "paper_forward", *words, *SMALL])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        return 1, str(result.exception)
    return result.exit_code, result.output


def test_files_of_a_plan(tmp_path: Path) -> None:
    out = tmp_path / "plan"
    words = ["--fit", "mu,lambda", "--noise", "1e-3", "--suggest-markers", "2", "--columns", "14"]
    code, said = call(*words, "--motions", "duration=1;2", "--out", str(out))
    assert code == 0, said
    result = json.loads((out / "result.json").read_text())
    assert [each["motion"]["duration"] for each in result["motions"]] == [1, 2]
    best = result["motions"][0]["markers"]
    assert best[1]["deviations"]["mu"] < best[0]["deviations"]["mu"]
    assert result["motions"][0]["size"] < result["motions"][1]["size"]
    rows = list(csv.DictReader((out / "candidates.csv").open()))
    sizes = [float(row["size"]) for row in rows if row["size"] != "not seen"]
    assert (len(rows), sizes) == (result["candidates"], sorted(sizes))
    assert [float(rows[0][key]) for key in ("x [m]", "y [m]")] == best[0]["point"]
    assert float(rows[0]["mu"]) == pytest.approx(best[0]["deviations"]["mu"])
    planned = sg.build(out / "markers.toml")
    assert [list(o.point) for o in planned.outputs] == [each["point"] for each in best]
    assert np.isclose(planned.scene.time_end, 1.0)
    assert {"report.html", "markers.png", "markers.csv", "candidates.csv"} <= set(result["files"])
    assert "where to put markers" in (out / "report.html").read_text()


def test_what_no_marker_sees_is_refused(tmp_path: Path) -> None:
    out = str(tmp_path / "plan")
    words = ["--noise", "1e-3", "--suggest-markers", "2", "--columns", "14", "--no-pictures", "--out", out]
    code, said = call("--fit", "mu,lambda,rho", *words)
    assert code == 3
    assert "fit fewer parameters" in " ".join(said.split())


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--fit", "mu", "--noise", "1e-3"], "identify needs measurements"),
        (["data.csv", "--fit", "mu", "--noise", "1e-3", "--suggest-markers", "2"], "leave out data"),
        (["--fit", "mu", "--noise", "tip=1e-3", "--suggest-markers", "2"], "one standard deviation"),
        (["--fit", "mu", "--noise", "1e-3", "--suggest-markers", "2", "--motions", "duration"], "give a key of"),
        (["--fit", "mu", "--noise", "1e-3", "--suggest-markers", "2", "--motions", "duraton=1"], "motion.duraton"),
    ],
)
def test_bad_input_is_one_sentence(words: list[str], sentence: str, tmp_path: Path) -> None:
    out = tmp_path / "plan"
    code, said = call(*words, "--out", str(out))
    assert code == 1
    assert sentence in said
    assert not (out / "result.json").exists()


def test_families_of_motions() -> None:
    found = parse_motions(["duration=0.5;1", "target=[1.0, 0.0];[0.0, 1.0]"])
    assert len(found) == 4
    assert found[1] == {"duration": 0.5, "target": [0.0, 1.0]}
    assert parse_motions([]) == []
    with pytest.raises(SceneError, match="too many"):
        parse_motions(["duration=" + ";".join(["1"] * 51)])
