"""softgrasp reduce of a scene with contact: its numbers are those of the saved models; refusals."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from rich.console import Console

import softgrasp as sg
from softgrasp.fem.errors import SceneError, SoftgraspError
from softgrasp.fem.scene.file import shipped_scenes
from softgrasp.reduction.archive import write_checksums
from softgrasp.reduction.bases.basis import ReductionError
from softgrasp.reduction.certified.archive import load_certified
from softgrasp.reduction.contact.model import ContactModel
from softgrasp.reduction.system import ModelError
from softgrasp.study.reduce.contact.measure import measure_contact
from softgrasp.study.reduce.run import run_reduce
from softgrasp.study.reduce.times import measured_run

SMALL = ["tissue.cells=[6, 4]", "time.steps=200"]


def reduce(folder: Path, *overrides: str) -> None:
    with (folder / "log").open("w") as log:
        run_reduce(shipped_scenes()["set_down"], folder / "out", [*SMALL, *overrides], Console(file=log), quiet=True)


@pytest.mark.serial
def test_numbers_are_those_of_the_saved_models(tmp_path: Path) -> None:
    reduce(tmp_path, "reduction.N=[3, 12, 18]")
    out = tmp_path / "out"
    result = json.loads((out / "result.json").read_text())
    model = sg.build("set_down", SMALL, comm=MPI.COMM_SELF)
    run = sg.simulate(model)
    assert [p["N"] for p in result["contact"]] == [18, 12]
    assert "N = 3" in result["refused"]  # 2 columns of the hand leave no room for two more
    for point in result["contact"]:
        rom = sg.load(out / "models" / f"{point['model']}.h5", model.system.layout)
        assert isinstance(rom, ContactModel)
        found = sg.errors(rom, sg.replay(rom, model, run), model, run)
        assert point["error"] == pytest.approx(found.z, rel=1e-6)
        assert point["error_force"] == pytest.approx(found.force, rel=1e-6)
    best = result["contact"][0]
    assert result["best"] == best["model"] == "contact_18"
    assert best["error"] < 1e-3  # measured 7e-5
    assert best["error_held_out"] < 1e-3
    assert best["error_force_held_out"] < 1e-2  # measured 5e-3
    assert len(result["held_out"]) == 3
    assert all(motion["touching"] > 0.1 for motion in result["held_out"])
    page = (out / "report.html").read_text()
    assert "No certificate covers contact" in page
    assert (out / "force.png").stat().st_size > 1000


@pytest.mark.serial
@pytest.mark.parametrize("cells", ["[24, 16]", "[36, 24]"])
def test_thirty_columns_are_enough_for_motions_that_made_no_model(cells: str) -> None:
    model = sg.build("set_down", [f"tissue.cells={cells}", "reduction.N=[30]"], comm=MPI.COMM_SELF)
    study = measure_contact(*measured_run(model, lambda *_: None), lambda *_: None)
    point = study.points["contact_30"]
    assert point.N == 30
    assert point.error_held_out is not None
    assert point.error_force_held_out is not None
    assert point.error_held_out < 1e-3  # asked for; measured 2.1e-5 and 2.0e-5
    assert point.error_force_held_out < 1e-2  # asked for; measured 1.5e-3 and 3.0e-3


@pytest.mark.ranks(3)
def test_every_rank_count_gives_the_same_errors() -> None:
    studies = []
    for comm in (MPI.COMM_SELF, MPI.COMM_WORLD):
        model = sg.build("set_down", [*SMALL, "time.steps=100", "reduction.N=[12]"], comm=comm)
        studies.append(measure_contact(*measured_run(model, lambda *_: None), lambda *_: None))
    (one,), (every,) = (list(study.points.values()) for study in studies)
    assert one.N == every.N == 12
    for key in ("error", "error_force", "error_held_out", "error_force_held_out"):
        assert getattr(every, key) == pytest.approx(getattr(one, key), rel=1e-5), key  # rounding over the error, 1e-4
    for a, b in zip(*(study.motions for study in studies), strict=True):
        assert a.touching == b.touching > 0.1


@pytest.mark.parametrize(
    ("override", "error", "text"),
    [
        ("reduction.train='greedy'", SceneError, "no certificate covers contact; leave out --tolerance"),
        ("reduction.methods=['psd']", SceneError, r"reduction\.methods does not go with effects\.obstacles"),
        ("reduction.N=[3]", ReductionError, "reduction.N has no possible dimension: the hand has 2 columns"),
        ("effects.reaction=true", ModelError, r"effects\.reaction = false"),
    ],
)
@pytest.mark.serial
def test_what_contact_models_lack_is_refused(
    override: str, error: type[SoftgraspError], text: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=text):
        reduce(tmp_path, override)
    assert not (tmp_path / "out" / "result.json").exists()


@pytest.mark.serial
def test_a_file_keeps_the_model_bit_for_bit(tmp_path: Path) -> None:
    (tmp_path / "lift.csv").write_text("0,0,0\n0.3,0,0.001\n0.9,0,0.002\n")
    table = "{kind='halfspace',normal=[0.1,1],offset=-0.018,path={csv='%s'}}" % (tmp_path / "lift.csv")
    wall = "{kind='halfspace',normal=[-1,0],offset=-0.5,path={velocity=[-0.01,0]}}"
    rom = sg.contact_model(sg.build("set_down", [*SMALL, f"obstacle=[{table},{wall}]"], comm=MPI.COMM_SELF), N=12)
    sg.save(rom, tmp_path / "rom.h5")
    again = sg.load(tmp_path / "rom.h5")
    assert isinstance(again, ContactModel)
    assert again.V is None
    with pytest.raises(ModelError, match="loaded without its columns on the mesh"):
        again.deformation(again.run(*again.motion(), again.dt))
    one, other = (each.run(*each.motion(), each.dt) for each in (rom, again))
    assert np.array_equal(one.a, other.a)
    assert np.array_equal(one.force, other.force)
    assert one.force.any()
    with pytest.raises(ModelError, match="with obstacle"):  # another scene
        again.check_scene(sg.build("set_down", SMALL, comm=MPI.COMM_SELF).scene_keys)
    with pytest.raises(ModelError, match="has contact, which no certificate covers"):
        load_certified(tmp_path / "rom.h5")
    shutil.copy(tmp_path / "rom.h5", tmp_path / "bad.h5")
    with h5py.File(tmp_path / "bad.h5", "r+") as file:
        file["parts/stiffness"][0] *= 2
    with pytest.raises(ModelError, match="is damaged"):
        sg.load(tmp_path / "bad.h5")
    with h5py.File(tmp_path / "bad.h5", "r+") as file:
        del file["hand"]
        write_checksums(file)
    with pytest.raises(ModelError, match="cannot be read as a reduced model"):
        sg.load(tmp_path / "bad.h5")
