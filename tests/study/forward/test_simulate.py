"""A run in legs leaves what the whole run leaves."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
from mpi4py import MPI
from rich.console import Console

import softgrasp as sg
from softgrasp.fem.errors import CheckpointError, SceneError, SolverError
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.run.forecast import forecasts
from softgrasp.fem.scene.file import shipped_scenes
from softgrasp.study.forward import run as run_module
from softgrasp.study.forward.run import run_simulate
from tests.helpers.models import rough_save

SMALL = ["tissue.cells=[3,6]", "time.steps=40", "output.frames=8", "effects.reaction=true"]


def run(out: Path, *changes: str, **how: Any) -> str:
    """What the run says on this rank; also when it is stopped as asked. Collective."""
    said = io.StringIO()
    console = Console(file=said, width=400)
    call = (shipped_scenes()["paper_forward"], out, [*SMALL, *changes], console)
    run_simulate(*call, quiet=True, **how)
    return said.getvalue()


def times(file: Path) -> list[float]:
    """Instants of a field series."""
    return sorted({float(t) for t in re.findall(r'timestep="(.*?)"', file.read_text())})


@pytest.mark.ranks(2)
def test_three_legs_show_what_the_whole_run_shows(
    comm: MPI.Intracomm, mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("softgrasp.study.pictures.body.save", rough_save)
    monkeypatch.setattr("softgrasp.study.pictures.style.save", rough_save)
    whole, legs = mpi_tmp_path / "whole", mpi_tmp_path / "legs"
    run(whole)
    run(legs, until=15)
    run(legs, until=30, resume=True)
    said = run(legs, resume=True)
    if comm.rank > 0:
        return
    series = [legs / f"fields{leg}.pvd" for leg in ("", "-from15", "-from30")]
    assert [len(times(file)) for file in series] == [4, 3, 2]  # frames are five steps apart
    assert [t for file in series for t in times(file)] == times(whole / "fields.pvd")
    assert "resumed from step 30 of 40\n" in said
    assert all(f"{file}\n" in said for file in series)
    assert "10 of 40, since the run was resumed," in said
    assert json.loads((legs / "result.json").read_text())["time"]["steps_timed"] == 10
    for name in ("move.gif", "move.png", "trajectory.csv"):
        assert (legs / name).read_bytes() == (whole / name).read_bytes(), name


def test_fields_of_another_run_in_the_folder_are_left_out(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    run(mpi_tmp_path, until=15, pictures=False)
    run(mpi_tmp_path, "motion.target=[1.0,-2.0]", pictures=False)
    said = run(mpi_tmp_path, resume=True, pictures=False)
    if comm.rank == 0:
        assert "the fields before are left out" in said
        assert sorted(path.name for path in mpi_tmp_path.glob("fields*")) == [
            "fields-from15", "fields-from15.pvd",
        ]  # fmt: skip


def test_frames_that_nobody_kept_are_told(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    run(mpi_tmp_path, until=15, pictures=False)
    said = run(mpi_tmp_path, until=20, resume=True)
    if comm.rank == 0:
        assert "resumed from step 15 of 40; 4 earlier frames are not kept" in said
        next(mpi_tmp_path.glob("checkpoint/*-frame20.npz")).write_bytes(b"PK torn")
    comm.Barrier()
    with pytest.raises(CheckpointError, match=r"frame20\.npz is damaged"):
        run(mpi_tmp_path, resume=True)


@pytest.mark.ranks(2)
def test_the_force_that_the_motion_takes_is_written(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    turned = ("effects.rotation=true", "hand.inertia=3.0", "motion.target=[5.0,3.0,0.1]")
    said = run(mpi_tmp_path, *turned, pictures=False)
    if comm.rank > 0:
        return
    with (mpi_tmp_path / "trajectory.csv").open() as file:
        first = file.readline().split(",").index("force_x [N]")
        assert file.readline().split(",")[first : first + 3] == ["nan"] * 3  # no step ends at the start
        forces = np.loadtxt(file, delimiter=",")[:, first : first + 3]
    peak = json.loads((mpi_tmp_path / "result.json").read_text())["force_peak"]
    assert peak == dict(zip(("x", "y", "rz"), np.abs(forces).max(axis=0).tolist(), strict=True))
    assert f"rz {peak['rz']:.4g} N m" in said


def test_results_are_written_before_the_estimate(
    comm: MPI.Intracomm, mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An estimate that ends the program leaves result and trajectory; one that fails also page and sentence."""

    def ends(_: Model, **how: Any) -> NoReturn:
        raise RuntimeError("no estimate")

    def fails(_: Model, **how: Any) -> NoReturn:
        raise np.linalg.LinAlgError("not definite")

    ended, failed = mpi_tmp_path / "ended", mpi_tmp_path / "failed"
    monkeypatch.setattr("softgrasp.study.forward.accuracy.estimated", ends)
    with pytest.raises(RuntimeError, match="no estimate"):
        run(ended, pictures=False)
    monkeypatch.setattr("softgrasp.study.forward.accuracy.estimated", fails)
    with pytest.raises(SolverError, match="could not be estimated: not definite"):
        run(failed, pictures=False, certify=True)
    if comm.rank > 0:
        return
    early, whole = (json.loads((folder / "result.json").read_text()) for folder in (ended, failed))
    assert (ended / "trajectory.csv").read_bytes() == (failed / "trajectory.csv").read_bytes()
    assert whole.keys() - early.keys() == set()
    assert early["files"] == ["result.json", "scene.toml", "trajectory.csv"]
    assert "The error of the mesh could not be estimated: not definite" in whole["warnings"]
    assert "not definite" in (failed / "report.html").read_text()


def test_the_library_and_the_command_refine_alike(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    changes = ["tissue.refine={tolerance=1e-2}", "time.steps=300", "effects.reaction=true"]  # order 1 needs a pass
    run(mpi_tmp_path, *changes, pictures=False)
    model = sg.build("paper_forward", [*SMALL, *changes])
    assert model.accuracy is not None
    if comm.rank == 0:
        result = json.loads((mpi_tmp_path / "result.json").read_text())
        assert result["mesh_error"]["passes"] == model.accuracy.passes > 0
        assert result["mesh_error"]["n_e"] == model.system.layout.n_e


def test_certify_at_finite_strain_is_refused_before_the_run(mpi_tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="for linear elasticity only: leave out --certify"):
        run(mpi_tmp_path / "out", "effects.finite_strain={law='neo-hooke'}", certify=True)
    assert not (mpi_tmp_path / "out").exists()


@pytest.mark.parametrize("least", [0.0, 1e9])
def test_a_slow_equilibrium_is_announced(least: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_module, "SLOW_START", least)
    model = build("block_3d", ["tissue.refine=false", "tissue.cells=[2,2,4]", "tissue.order=1"], comm=MPI.COMM_SELF)
    lines = list(run_module._announced(model))
    (seconds,) = [f.equilibrium for f in forecasts(model) if f.ranks == 1]
    line = f"about {seconds:.2g} s of that are the equilibrium, before the first step"
    assert lines[0].startswith("cost model: about")
    assert (lines[1:2] == [line]) is (least == 0.0)
