"""What is written needs room, and a folder to lie in."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.errors import ResourceError, SceneError
from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import RunOptions, simulate
from softgrasp.study.cli import app
from softgrasp.study.pictures.frames import Frames
from tests.helpers.models import make_scene

pytestmark = pytest.mark.ranks


def test_fields_without_room_leave_a_restart_file(
    comm: MPI.Intracomm, mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With room again the run ends as the whole run does."""
    scene = make_scene(tissue={"cells": [3, 6]}, time={"steps": 12}, output={"frames": 6})
    model = build(scene, comm=comm)
    frames = Frames(model, mpi_tmp_path, pictures=False)
    free = iter([2**30, 2**30, 2**30, 100])
    monkeypatch.setattr("softgrasp.fem.resources.shutil.disk_usage", lambda path: SimpleNamespace(free=next(free)))
    options = RunOptions(mpi_tmp_path, frame=frames, begin=frames.begin, keep=frames.keep)
    with pytest.raises(ResourceError, match=r"100 are free on the disk; free the disk; .*go on from step 6"):
        simulate(model, options)
    assert all(path.exists() for path in frames.close())
    rest = simulate(model, RunOptions(mpi_tmp_path, resume=True))
    assert np.array_equal(rest.final, simulate(build(scene, comm=comm)).final)


@pytest.mark.parametrize("output", [{"fields": "vtu"}, {"fields": "none", "snapshots": "hdf5"}])
def test_a_limit_on_files_is_one_sentence(
    comm: MPI.Intracomm, mpi_tmp_path: Path, small_files: Callable[[int], None], output: dict[str, str]
) -> None:
    scene = make_scene(tissue={"cells": [3, 6]}, time={"steps": 12}, output=output)
    model = build(scene, comm=comm)
    frames = Frames(model, mpi_tmp_path, pictures=False)
    small_files(2**18)  # less than the libraries may add at the end
    with pytest.raises(ResourceError, match=r"no file may pass 262144 bytes here; raise the limit"):
        simulate(model, RunOptions(mpi_tmp_path, frame=frames, begin=frames.begin))
    frames.close()


@pytest.mark.parametrize("below", ["", "deeper"])
def test_an_out_that_is_a_file_is_refused_before_the_scene_is_read(mpi_tmp_path: Path, below: str) -> None:
    (mpi_tmp_path / "file").touch()
    with pytest.raises(SceneError, match=r"--out .*file is a file; name a folder"):
        app(["simulate", "no.toml", "--out", str(mpi_tmp_path / "file" / below)], standalone_mode=False)
