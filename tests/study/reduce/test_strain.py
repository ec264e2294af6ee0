"""softgrasp reduce on a scene with finite strain: held-out numbers are those of runs made here, files, refusals."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import softgrasp as sg
from softgrasp.fem.errors import SceneError
from softgrasp.fem.scene.file import shipped_scenes
from softgrasp.reduction.parameters import moved_to, run_at
from softgrasp.study.reduce.run import run_reduce

OVERRIDES = ["tissue.cells=[4, 8]", "time.steps=60", "effects.finite_strain={}", "reduction.N=[7, 8, 14]"]


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("strain") / "out"
    with (folder.parent / "log").open("w") as log:
        run_reduce(shipped_scenes()["paper_forward"], folder, OVERRIDES, Console(file=log, width=100), quiet=True)
    return folder


def test_numbers_are_those_of_the_saved_models(out: Path) -> None:
    """Every held-out run is made again, and repeated by the model in the file."""
    result = json.loads((out / "result.json").read_text())
    model = sg.build("paper_forward", OVERRIDES[:3])
    for key, runs in (("own", 1), ("box", 8)):
        family = result["finite_strain"][key]
        assert family["runs"] == runs
        assert [p["N"] for p in family["points"]] == [8, 14]
        rom = sg.load(out / "models" / f"{key}_N14.h5", model.system.layout)
        held = family["held_out"]
        for test in held[:1] + held[-1:]:
            full = run_at(moved_to(model, test["target"]), test["lam"], test["mu"])
            error = sg.errors(rom, sg.replay(rom, model, full), model, full).z
            assert error == pytest.approx(test["errors"]["14"], rel=1e-4)  # the target is read from a run
        point = family["points"][-1]
        kinds = {kind: [t["errors"]["14"] for t in held if t["kind"] == kind] for kind in ("material", "motion")}
        for kind, errors in kinds.items():
            known = [e for e in errors if e is not None]
            assert point[f"error_{kind}s"] == (max(known) if known else None)
        assert point["drift"] < 1e-8
        assert point["cells"] == rom.cells.count < 64
        again = result["time"]["full_steps_median"] / point["time_online"]
        assert point["speed_up"]["again"] == pytest.approx(again)
    trained = {(40.0, 40.0), (40.0, 120.0), (120.0, 40.0), (120.0, 120.0), (50.0, 50.0)}
    tested = {(t["lam"], t["mu"]) for t in held if t["kind"] == "material"}
    assert len(tested) == 5
    assert all(not np.allclose(a, b) for a in tested for b in trained)
    assert result["error_linear"] > point["error_training"]


def test_files(out: Path) -> None:
    for name in ("report.html", "strain_errors.png", "cells.png"):
        assert (out / name).stat().st_size > 10_000
    rows = list(csv.DictReader((out / "points.csv").open()))
    assert {row["N"] for row in rows} == {"8", "14"}
    taus = [float(row["tau"]) for row in rows if row["runs"] == "8" and row["N"] == "14"]
    cells = [int(row["cells"]) for row in rows if row["runs"] == "8" and row["N"] == "14"]
    assert len(taus) == 6
    assert sorted(cells) == [c for _, c in sorted(zip(taus, cells, strict=True), reverse=True)]
    text = (out / "report.html").read_text()
    assert "new material" in text
    assert "Linear elasticity has an error of" in text


def test_linear_methods_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"reduction\.methods"):
        run_reduce(
            shipped_scenes()["paper_forward"], tmp_path, [*OVERRIDES, 'reduction.methods=["psd"]'],
            Console(quiet=True),
        )  # fmt: skip
