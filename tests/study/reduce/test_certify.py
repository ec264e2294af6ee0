"""`softgrasp reduce --tolerance`: what it builds, writes and says, and how it goes on."""

from __future__ import annotations

import io
import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from softgrasp.reduction.archive import load
from softgrasp.reduction.certified.archive import load_certified
from softgrasp.reduction.model import ReducedModel
from softgrasp.study.reduce.run import run_reduce

PAPER = Path(__file__).parents[3] / "demos" / "scenes" / "paper_forward.toml"
SMALL = [
    "tissue.cells=[4,8]", "time.steps=60", "reduction.grid=4", "effects.damping.kind='kelvin-voigt'",
    "effects.damping.beta=0.002",
]  # fmt: skip


def reduced(folder: Path, tolerance: float, *changes: str) -> tuple[dict[str, Any], str]:
    text = io.StringIO()
    console = Console(file=text, width=200)
    result = run_reduce(PAPER, folder, [*SMALL, *changes], console, quiet=True, tolerance=tolerance)
    return result, text.getvalue()


@pytest.mark.serial
def test_a_certified_model_by_command(tmp_path: Path) -> None:
    _, text = reduced(tmp_path, 0.2, "reduction.validation=2")
    certified = load_certified(tmp_path / "models" / "certified.h5")
    about = json.loads((tmp_path / "result.json").read_text())["certified"]
    assert about["k"] == certified.k
    assert about["proved"] <= 0.2 == certified.tolerance
    assert certified.run(certified.materials(77.0, 60.0)).certificate.passed
    assert certified.mesh is not None
    own = about["own"]
    for error, bound in zip(own["outputs_error"], own["outputs_proved"], strict=True):
        assert error <= bound
    assert len((tmp_path / "greedy.csv").read_text().splitlines()) == len(about["rounds"]) + 1
    assert (tmp_path / "report.html").exists()
    for words in ("round 1: k = 4", "proved", "| time step", "| mesh", "2 random full runs", "A query takes"):
        assert words in text
    assert not list((tmp_path / "models").glob("*.part"))
    # a finer tolerance goes on from the coarser one
    finer, text = reduced(tmp_path, 0.1)
    assert f"going on from round {len(about['rounds'])}" in text
    assert finer["certified"]["rounds"][: len(about["rounds"])] == about["rounds"]
    assert finer["certified"]["proved"] <= 0.1


@pytest.mark.serial
def test_one_that_cannot_be_reached_says_so(tmp_path: Path) -> None:
    result, text = reduced(tmp_path, 0.01, "reduction.max_N=20")
    assert result["certified"]["reason"] == "size"
    assert result["certified"]["proved"] is None or result["certified"]["proved"] > 0.01  # None: infinite
    assert "as many modes as reduction.max_N allows" in text
    assert "runs above it are refused" in text


@pytest.mark.serial
def test_off_makes_no_residual(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a certificate nothing of it is imported, stands in a model, its file or result.json."""
    import gc
    import sys

    import h5py

    monkeypatch.setattr("softgrasp.reduction.certified.residual.ResidualSpace.__init__", None)  # cannot be made
    certified = ("softgrasp.reduction.certified", "softgrasp.study.reduce.certified")
    for name in [name for name in sys.modules if name.startswith(certified)]:
        monkeypatch.delitem(sys.modules, name)
    gc.collect()
    before = {id(x) for x in gc.get_objects()}
    options = ["reduction.N=[14]", "reduction.methods=['craig_bampton']", "reduction.train=[]"]
    run_reduce(PAPER, tmp_path, [*SMALL[:2], *options], Console(quiet=True), quiet=True, pictures=False)
    assert not [name for name in sys.modules if name.startswith(certified)]
    new = (type(x) for x in gc.get_objects() if id(x) not in before)
    assert not [t for t in new if t.__module__.startswith("softgrasp.reduction.certified")]
    assert {"certified", "tests"}.isdisjoint(json.loads((tmp_path / "result.json").read_text()))
    (path,) = (tmp_path / "models").glob("*.h5")
    with h5py.File(path) as file:
        assert set(file) <= {"parts", "outputs", "gravity", "reconstruction"}
    model = load(path)
    # triangles of residuals would have 2 + 3 k = 17 rows
    assert max(n for part in model.parts.values() for n in part.shape[-2:]) <= model.N == 14
    assert set(vars(model)) == {f.name for f in fields(ReducedModel)}
