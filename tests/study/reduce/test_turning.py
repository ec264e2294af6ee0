"""softgrasp reduce in the frame of the hand: its numbers are those of the saved models; refusals."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from mpi4py import MPI
from rich.console import Console

import softgrasp as sg
from softgrasp.fem.errors import SceneError
from softgrasp.fem.scene.file import shipped_scenes
from softgrasp.reduction.bases.states import BasisError
from softgrasp.reduction.turning.model import TurningModel
from softgrasp.study.reduce.run import run_reduce

SMALL = ["tissue.cells=[3, 6]", "tissue.order=1", "time.steps=60", "effects.finite_strain=false"]


def reduce(folder: Path, *overrides: str) -> None:
    with (folder / "log").open("w") as log:
        console = Console(file=log, width=100)
        run_reduce(shipped_scenes()["turn_over"], folder / "out", [*SMALL, *overrides], console, quiet=True)


@pytest.mark.serial
def test_numbers_are_those_of_the_saved_models(tmp_path: Path) -> None:
    reduce(tmp_path, "reduction.N=[7, 12, 16]")
    out = tmp_path / "out"
    result = json.loads((out / "result.json").read_text())
    model = sg.build("turn_over", SMALL, comm=MPI.COMM_SELF)
    run = sg.simulate(model)
    assert [p["N"] for p in result["frame"]] == [12, 16, 12, 16]  # of the even ones
    for point in result["frame"][1::2]:
        rom = sg.load(out / "models" / f"{point['method']}.h5", model.system.layout)
        assert isinstance(rom, TurningModel)
        errors = sg.errors(rom, sg.replay(rom, model, run), model, run)
        assert point["error"] == pytest.approx(errors.z, rel=1e-6)
        assert point["error_energy_norm"] == pytest.approx(errors.energy_norm, rel=1e-6)
        assert point["error"] < 0.02  # measured 7e-3 and 1e-5
    assert result["best"]["error"] == min(p["error"] for p in result["frame"])
    with (out / "points.csv").open() as table:
        assert [row["N"] for row in csv.DictReader(table)] == ["12", "16", "12", "16"]
    assert (out / "errors.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("override", "error", "text"),
    [
        ("reduction.methods=['psd_fixed']", BasisError, "does not turn with effects.frame; name craig_bampton"),
        ("reduction.train='greedy'", SceneError, "a certified model cannot go with effects.frame"),
    ],
)
def test_what_cannot_turn_is_refused(override: str, error: type[Exception], text: str, tmp_path: Path) -> None:
    with pytest.raises(error, match=text):
        reduce(tmp_path, override)
    assert not (tmp_path / "out" / "result.json").exists()
